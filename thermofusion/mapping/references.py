"""Readings of references: what sets the level of a result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..physics.band import Band
from ..robust import mad_sigma
from ..types import Float, Int


@dataclass(frozen=True)
class BlackbodyReading:
    """A source of known temperature as one view saw it.

    measured, expected : in-band radiance, W m-2 sr-1. sigma_measured : noise of the mean over the polygon.
    sigma_expected : of the source's temperature, common to all its readings. u_px, v_px : middle of the polygon.
    """

    view: int
    measured: float
    expected: float
    sigma_measured: float
    sigma_expected: float
    u_px: float
    v_px: float


@dataclass(frozen=True, eq=False)
class ContactReading:
    """A thermometer on the skin: radiance of a black body at its reading, at one or more vertices around the spot."""

    vertices: Int
    expected: float
    sigma_expected: float


POLYGON_MARGIN_PX = 3.0  # blur at the source's rim stays outside the reading


def read_blackbody(
    radiance: NDArray,
    polygon_px: NDArray,
    *,
    view: int,
    T_K: float,
    sigma_K: float,
    emissivity: float,
    L_reflected: float,
    band: Band,
    netd_K: float,
) -> BlackbodyReading | None:
    """Reading of a blackbody in one radiance image (H, W): robust mean over the polygon less a margin for blur.

    Expected is ε L(T) + (1-ε) L_reflected. None if no pixel of the polygon is usable.
    """
    v, u, rim = _inside_polygon(radiance.shape, np.asarray(polygon_px, np.float64))
    deep = rim >= min(POLYGON_MARGIN_PX, 0.5 * float(rim.max(initial=0)))
    values = np.asarray(radiance[v[deep], u[deep]], np.float64)
    good = np.isfinite(values)
    if not good.any():
        return None
    values = values[good]
    slope = float(band.d_radiance_dT(T_K))
    spread = max(mad_sigma(values - np.median(values)), 0.2 * netd_K * slope)
    kept = values[np.abs(values - np.median(values)) <= 3 * spread]
    expected = emissivity * float(band.radiance(T_K)) + (1 - emissivity) * L_reflected
    return BlackbodyReading(
        view=view,
        measured=float(kept.mean()),
        expected=expected,
        sigma_measured=spread / np.sqrt(len(kept)),
        sigma_expected=emissivity * slope * sigma_K,
        u_px=float(u[deep][good].mean()),
        v_px=float(v[deep][good].mean()),
    )


def _inside_polygon(shape: tuple[int, ...], polygon: Float) -> tuple[NDArray, NDArray, Float]:
    """Pixels (v, u) inside a polygon (even-odd rule) and their distance to its rim, px."""
    lo = np.maximum(np.floor(polygon.min(0)).astype(int), 0)
    hi = np.minimum(np.ceil(polygon.max(0)).astype(int), [shape[1] - 1, shape[0] - 1])
    v, u = (a.ravel() for a in np.mgrid[lo[1] : hi[1] + 1, lo[0] : hi[0] + 1])
    inside, rim = np.zeros(len(u), bool), np.full(len(u), np.inf)
    for (x1, y1), (x2, y2) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y1 != y2:
            inside ^= ((y1 > v) != (y2 > v)) & (u < (x2 - x1) * (v - y1) / (y2 - y1) + x1)
        dx, dy = x2 - x1, y2 - y1
        t = np.clip(((u - x1) * dx + (v - y1) * dy) / max(dx * dx + dy * dy, 1e-12), 0, 1)
        rim = np.minimum(rim, np.hypot(u - x1 - t * dx, v - y1 - t * dy))
    inside &= rim > 0
    return v[inside], u[inside], rim[inside]
