"""What a still recording and a hot edge tell of a thermal camera: NETD, drift, point spread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from ..errors import ScanError
from ..types import Float

MIN_STILL_FRAMES = 8
MIN_EDGE_ROWS = 12


@dataclass(frozen=True, eq=False)
class StillNoise:
    """netd_K : temporal noise of a pixel (median over pixels, the frame's common drift taken off).

    tau_s, allan_K : averaging times and Allan deviation of the image mean. drift_K_per_min : slope of the mean.
    best_tau_s : averaging beyond this no longer helps, drift takes over.
    """

    netd_K: float
    drift_K_per_min: float
    tau_s: Float
    allan_K: Float
    best_tau_s: float


def still_noise(frames_degC: NDArray, times_s: NDArray) -> StillNoise:
    """From frames (N, H, W) of a scene that does not move, at times (N,). Raises ScanError with fewer than 8 frames."""
    x, t = np.asarray(frames_degC, np.float64), np.asarray(times_s, np.float64)
    if len(x) < MIN_STILL_FRAMES:
        raise ScanError(f"{len(x)} frames are too few for noise and drift", hint="record a still scene for a minute")
    mean = np.nanmean(x, axis=(1, 2))
    d = np.diff(x - mean[:, None, None], axis=0)  # differences: slow pixel drift falls out
    netd = float(np.nanmedian(1.4826 * np.nanmedian(np.abs(d), axis=0))) / np.sqrt(2)
    tau, allan = allan_deviation(mean, float(np.median(np.diff(t))))
    slope = float(np.polyfit((t - t.mean()) / 60, mean, 1)[0])
    return StillNoise(netd, slope, tau, allan, float(tau[np.argmin(allan)]))


def allan_deviation(x: NDArray, step_s: float) -> tuple[Float, Float]:
    """Overlapping Allan deviation of an evenly sampled series: averaging times (M,) s and deviation (M,), unit of x.

    σ²(τ) = ½ <(mean of the next m samples - mean of these m)²> (NIST SP 1065, Eq. 9).
    """
    total = np.concatenate([[0.0], np.cumsum(np.asarray(x, np.float64))])
    sizes = np.unique(np.geomspace(1, max(len(x) // 3, 1), 24).astype(int))
    out = []
    for m in sizes:
        average = (total[m:] - total[:-m]) / m
        d = average[m:] - average[:-m]
        out.append(np.sqrt(0.5 * np.mean(d**2)))
    return sizes * step_s, np.array(out)


@dataclass(frozen=True)
class EdgeSpread:
    """sigma_px : Gaussian point spread across the edge, pixel included, and its one sigma; contrast, image units."""

    sigma_px: float
    sigma_sigma_px: float
    contrast: float
    angle_deg: float


def edge_spread(image: NDArray) -> EdgeSpread:
    """Point spread from a part of a picture (H, W) that shows one straight, slightly slanted hot edge.

    Slanted-edge method (ISO 12233): the edge's line is fitted to the rows' edge places, all pixels are sorted by their
    distance from it, and an error function is fitted to the over-sampled profile.
    Raises ScanError without a clear straight edge.
    """
    x = np.asarray(image, np.float64)
    if np.abs(np.nanmean(np.diff(x, axis=0))) > np.abs(np.nanmean(np.diff(x, axis=1))):
        x = x.T
    h, w = x.shape
    gradient = np.abs(np.diff(x, axis=1))
    gradient = np.maximum(gradient - 3 * np.median(gradient), 0)
    rows = gradient.sum(axis=1) > 0
    if rows.sum() < MIN_EDGE_ROWS:
        raise ScanError("no hot edge was found here", hint="cut out a part with one straight edge, 12 rows or more")
    place = (gradient[rows] @ (np.arange(w - 1) + 0.5)) / gradient[rows].sum(axis=1)
    y = np.flatnonzero(rows)
    slope, offset = np.polyfit(y, place, 1)
    for _ in range(5):
        r = place - (slope * y + offset)
        keep = np.abs(r) < 3 * (1.4826 * np.median(np.abs(r)) + 0.05)
        slope, offset = np.polyfit(y[keep], place[keep], 1)
    if np.std((place - (slope * y + offset))[keep]) > 1.0:
        raise ScanError("the hot edge is not straight", hint="cut out a part with one straight edge")
    vv, uu = np.mgrid[0:h, 0:w]
    distance = (uu - slope * vv - offset) / np.hypot(1, slope)
    near = np.abs(distance) < min(12.0, w / 2)
    d, g = distance[near], x[near]
    lo, hi = np.median(g[d < -4]), np.median(g[d > 4])

    def residual(p: Float) -> Float:
        return p[0] + p[1] * ndtr((d - p[2]) / np.exp(p[3])) - g

    fit = least_squares(residual, [lo, hi - lo, 0.0, 0.0], loss="soft_l1", f_scale=0.1 * abs(hi - lo) + 1e-9)
    s2 = np.mean(residual(fit.x) ** 2)
    C = np.linalg.inv(fit.jac.T @ fit.jac) * s2
    sigma = float(np.exp(fit.x[3]))
    angle = float(np.degrees(np.arctan(slope)))
    return EdgeSpread(sigma, sigma * float(np.sqrt(C[3, 3])), float(abs(fit.x[1])), angle)
