"""What a still recording and a hot edge tell of a thermal camera: NETD, drift, point spread."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from ...errors import ScanError, counted
from ...robust import SIGMA_PER_MAD, mad_sigma
from ...types import Float

MIN_STILL_FRAMES = 8  # fewer differences of frames tell a pixel's noise to no better than a third
MIN_EDGE_ROWS = 12  # that cross the edge, each at another phase of the pixels
MIN_SLANT_PX = 1.0  # across all rows: an edge along the pixels is sampled at one phase only
BLOCK_PX = 8  # side of the blocks whose change tells motion: their own noise is an eighth of a pixel's
ALLAN_PIXELS = 2000  # of a frame, evenly spread: their rms is sure to 2 %
MOVING_FACTOR = 4.0  # rows and columns of real sensors share some noise: a block is not quieter by its side exactly
NETD_PIXELS = 5000  # of a frame, evenly spread: more say nothing new and fill the memory


@dataclass(frozen=True, eq=False)
class StillNoise:
    """netd_K : temporal noise of a pixel (median over pixels, the frame's common drift taken off).

    tau_s : averaging times; allan_K, allan_mean_K : Allan deviation of a pixel (rms over pixels) and of the image mean,
    over the longest stretch without a gap. best_tau_s : averaging a pixel for longer no longer helps, drift takes over.
    drift_K_per_min : slope of the image mean.
    frames, duration_s : of the recording. even_frames : in that stretch. moving_share : of the picture, where blocks
    of pixels change from frame to frame by far more than independent pixels would: the scene was not still there.
    """

    netd_K: float
    drift_K_per_min: float
    tau_s: Float
    allan_K: Float
    allan_mean_K: Float
    best_tau_s: float
    frames: int
    duration_s: float
    even_frames: int
    moving_share: float


def still_noise(frames_degC: Iterable[NDArray], times_s: NDArray) -> StillNoise:
    """From frames_degC, each (H, W), of a scene that does not move, at times_s (N,); they are read one after the other.

    Raises ScanError with fewer than 8 frames, or times that are not finite and rising.
    """
    means, some, coarse, side = [], [], [], 1
    for frame in frames_degC:
        x = np.asarray(frame, np.float64)
        means.append(np.nanmean(x))
        some.append(x.ravel()[:: x.size // NETD_PIXELS + 1].astype(np.float32))
        side = max(1, min(BLOCK_PX, *(n // 4 for n in x.shape)))
        coarse.append(_blocks(x, side))
    mean, t = np.array(means), np.asarray(times_s, np.float64)
    if len(mean) < MIN_STILL_FRAMES:
        raise ScanError(
            f"{counted(len(mean), 'frame')}: too few for noise and drift", hint="record a still scene for a minute"
        )
    if not (np.isfinite(t).all() and (np.diff(t) > 0).all()):
        raise ScanError("the frames state no rising times", hint="give --rate, in frames a second")
    d = np.diff(np.array(some) - mean[:, None], axis=0)  # differences: slow pixel drift falls out
    measured = ~np.isnan(d).all(axis=0)
    netd = float(np.median(SIGMA_PER_MAD * np.nanmedian(np.abs(d[:, measured]), axis=0))) / np.sqrt(2)
    change = np.sqrt(np.mean(np.diff(np.array(coarse) - mean[:, None], axis=0) ** 2, axis=0)) / np.sqrt(2)
    moving = float(np.mean(change > MOVING_FACTOR * netd / side))
    even = _longest_even(t)
    step = float(np.median(np.diff(t)))
    pixels = np.array(some)[even][:, measured]
    tau, allan = allan_deviation(pixels[:, :: pixels.shape[1] // ALLAN_PIXELS + 1], step)
    common = allan_deviation(mean[even], step)[1]
    slope = float(np.polyfit((t - t.mean()) / 60, mean, 1)[0])
    best = float(tau[np.argmin(allan)])
    return StillNoise(
        netd, slope, tau, allan, common, best, len(t), float(t[-1] - t[0]), even.stop - even.start, moving
    )


def _blocks(x: Float, side: int) -> Float:
    """Means of blocks of side x side px, (N,)."""
    h, w = (n // side for n in x.shape)
    return x[: h * side, : w * side].reshape(h, side, w, side).mean(axis=(1, 3)).ravel()


def _longest_even(t: Float) -> slice:
    """The longest stretch whose steps are all within half a step of the usual one (shutter frames leave gaps)."""
    step = np.diff(t)
    cuts = np.flatnonzero(np.abs(step / np.median(step) - 1) > 0.5) + 1
    edges = np.concatenate([[0], cuts, [len(t)]])
    k = int(np.argmax(np.diff(edges)))
    return slice(int(edges[k]), int(edges[k + 1]))


def allan_deviation(x: NDArray, step_s: float) -> tuple[Float, Float]:
    """Overlapping Allan deviation of an evenly sampled series (N,), or rms of that of several (N, K): averaging times
    (M,) s and deviation (M,), unit of x.

    σ²(τ) = ½ <(mean of the next m samples - mean of these m)²> (NIST SP 1065, Eq. 9).
    """
    x = np.asarray(x, np.float64)
    total = np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x - x.mean(axis=0), axis=0)])
    sizes = np.unique(np.geomspace(1, max(len(x) // 3, 1), 24).astype(int))
    out = []
    for m in sizes:
        average = (total[m:] - total[:-m]) / m
        d = average[m:] - average[:-m]
        out.append(np.sqrt(0.5 * np.nanmean(d**2)))
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
    (h, w), (slope, offset) = x.shape, _edge_line(x)
    vv, uu = np.mgrid[0:h, 0:w]
    distance = (uu - slope * vv - offset) / np.hypot(1, slope)
    near = np.abs(distance) < min(12.0, w / 2)
    d, g = distance[near], x[near]
    lo, hi = np.median(g[d < -4]), np.median(g[d > 4])

    def residual(p: Float) -> Float:
        level, contrast, place, log_sigma = p
        return level + contrast * ndtr((d - place) / np.exp(log_sigma)) - g

    fit = least_squares(residual, [lo, hi - lo, 0.0, 0.0], loss="soft_l1", f_scale=0.1 * abs(hi - lo) + 1e-9)
    s2 = np.mean(residual(fit.x) ** 2)
    variance = np.diag(np.linalg.inv(fit.jac.T @ fit.jac) * s2)
    _, contrast, _, log_sigma = fit.x
    sigma = float(np.exp(log_sigma))
    angle = float(np.degrees(np.arctan(slope)))
    return EdgeSpread(sigma, sigma * float(np.sqrt(variance[-1])), float(abs(contrast)), angle)


def _edge_line(x: Float) -> tuple[float, float]:
    """Slope and offset [px] of the edge's column over the row. Raises ScanError: no edge, bent, along the pixels."""
    w = x.shape[1]
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
        keep = np.abs(r) < 3 * (mad_sigma(r) + 0.05)
        slope, offset = np.polyfit(y[keep], place[keep], 1)
    if np.std((place - (slope * y + offset))[keep]) > 1.0:
        raise ScanError("the hot edge is not straight", hint="cut out a part with one straight edge")
    if np.abs(slope) * np.ptp(y) < MIN_SLANT_PX:
        raise ScanError("the hot edge runs along the pixels", hint="turn the edge by 3 to 10 degrees and record again")
    return slope, offset
