"""Blackbodies as the thermal views saw them. What they should have read is the temperature step's business."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..physics.band import ZERO_DEGC_K
from ..physics.signal import SignalConverter
from ..robust import mad_sigma
from ..types import BlackbodyReference, Float, Reference, ThermalStream, ThermalViews

POLYGON_MARGIN_PX = 3.0  # blur at the source's rim stays outside the reading
LEAST_SPREAD = 0.2  # of NETD: the spread of a reading's pixels is taken to be no smaller
KEPT_SIGMAS = 3.0  # a pixel farther from the median is no part of the source


@dataclass(frozen=True)
class BlackbodyReading:
    """A source of known temperature as one view saw it.

    view : row of the thermal views. reference : position in the scan's references. measured : in-band radiance,
    W m-2 sr-1; sigma_measured : noise of the mean over the polygon. u_px, v_px : middle of the polygon.
    """

    view: int
    reference: int
    measured: float
    sigma_measured: float
    u_px: float
    v_px: float


def read_blackbodies(
    stream: ThermalStream, views: ThermalViews, references: Sequence[Reference], converter: SignalConverter
) -> tuple[BlackbodyReading, ...]:
    """Every blackbody in every view that it was recorded in."""
    readings = []
    for number, reference in enumerate(references):
        if not isinstance(reference, BlackbodyReference):
            continue
        for view in np.flatnonzero(np.isin(stream.index[views.frame], reference.frames)).tolist():
            frame = int(views.frame[view])
            image = converter.radiance(stream.load(frame), stream.places[frame])
            netd_L = stream.camera.netd_K * float(converter.band.d_radiance_dT(reference.degC + ZERO_DEGC_K))
            found = read_polygon(image, reference.polygon_px, netd_L)
            if found is not None:
                readings.append(BlackbodyReading(view, number, *found))
    return tuple(readings)


def read_polygon(radiance: NDArray, polygon_px: NDArray, netd_L: float) -> tuple[float, float, float, float] | None:
    """A source in one radiance image (H, W) W m-2 sr-1: robust mean over the polygon less a margin for blur.

    polygon_px : (N, 2) corners. netd_L : a pixel's noise, as radiance. Returns mean, its sigma, and the
    middle u, v, px; None if no pixel of the polygon is usable.
    """
    v, u, rim = _inside_polygon(radiance.shape, np.asarray(polygon_px, np.float64))
    deep = rim >= min(POLYGON_MARGIN_PX, 0.5 * float(rim.max(initial=0)))
    values = np.asarray(radiance[v[deep], u[deep]], np.float64)
    good = np.isfinite(values)
    if not good.any():
        return None
    values = values[good]
    spread = max(mad_sigma(values - np.median(values)), LEAST_SPREAD * netd_L)
    kept = values[np.abs(values - np.median(values)) <= KEPT_SIGMAS * spread]
    middle = float(u[deep][good].mean()), float(v[deep][good].mean())
    return float(kept.mean()), spread / np.sqrt(len(kept)), *middle


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
