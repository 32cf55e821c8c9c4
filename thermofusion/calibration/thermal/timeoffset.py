"""How far the thermal clock is from the depth clock: a warm object moves before both cameras.

Where the object is in the thermal picture is, but for the rig, a projective function of where it is in the depth image.
The right offset is the one at which a simple linear relation fits best; the rig need not be known.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ...errors import ScanError
from ...progress import Progress, silent
from ...robust import mad_sigma
from ...types import Camera, Float, Scan

MIN_SAMPLES = 12  # of either camera: eight numbers of the relation and the offset are fitted to them
MIN_TRAVEL_PX = 15.0  # in the thermal picture: less and the centroid's own noise hides the motion
OBJECT_THICKNESS_M = 0.08  # what lies within a hand's thickness behind the nearest point is the object
STEP_S = 0.005  # of the search, far below a frame's time; a parabola refines the best one


@dataclass(frozen=True, eq=False)
class TimeOffset:
    """offset_s is added to a thermal frame's own time to get the depth clock's time (scan.json `time_offset_s`).

    sigma_s : one sigma. residual_px : rms of the thermal track at the best offset. frames : thermal frames used.
    """

    offset_s: float
    sigma_s: float
    residual_px: float
    frames: int


def scan_time_offset(scan: Scan, *, max_offset_s: float = 0.5, progress: Progress = silent) -> TimeOffset:
    """From a recording of something warm, nearer to the depth camera than all else, waved before both cameras.

    The whole offset from the thermal frames' own times, whatever the scan's `time_offset_s` says. Raises ScanError:
    no thermal frames, or as `estimate_time_offset`.
    """
    if scan.thermal is None:
        raise ScanError("the recording has no thermal frames", place=scan.root)
    depth, thermal = scan.depth, scan.thermal
    near = np.full((len(depth), 3), np.nan)
    for i in np.flatnonzero(depth.usable).tolist():
        near[i] = nearest_centroid(depth.load(i), scan.rig.depth)
        progress("depth", i + 1, len(depth))
    warm = np.full((len(thermal), 2), np.nan)
    for i in np.flatnonzero(thermal.usable).tolist():
        warm[i] = warm_centroid(thermal.load(i))
        progress("thermal", i + 1, len(thermal))
    return estimate_time_offset(depth.times_s, near, thermal.times_s, warm, max_offset_s=max_offset_s)


def estimate_time_offset(
    depth_times_s: NDArray,
    position_m: NDArray,
    thermal_times_s: NDArray,
    position_px: NDArray,
    *,
    max_offset_s: float = 0.5,
) -> TimeOffset:
    """From tracks: position_m (N, 3) in the depth frame at depth_times_s (N,), position_px (M, 2) at thermal_times_s
    (M,); rows with NaN are left out.

    The relation is u = a·(x/z, y/z, 1/z, 1), which holds exactly for cameras whose axes are parallel.
    Raises ScanError if the object hardly moves, moves steadily one way, or is seen too rarely.
    """
    td, p = _finite(depth_times_s, position_m)
    tt, q = _finite(thermal_times_s, position_px)
    inside = (tt > td[0] + max_offset_s) & (tt < td[-1] - max_offset_s) if len(td) else np.zeros(0, bool)
    if inside.sum() < MIN_SAMPLES or len(td) < MIN_SAMPLES:
        raise ScanError(
            f"the warm object is seen in {int(inside.sum())} thermal frames between depth frames, too few",
            hint="wave it for ten seconds in view of both cameras",
        )
    tt, q = tt[inside], q[inside]
    if np.ptp(q, axis=0).max() < MIN_TRAVEL_PX:
        raise ScanError("the warm object hardly moves", hint="wave it to and fro across the picture")
    spline = CubicSpline(td, np.column_stack([p[:, 0] / p[:, 2], p[:, 1] / p[:, 2], 1 / p[:, 2]]))
    tried = np.arange(-max_offset_s, max_offset_s + 1e-9, STEP_S)
    costs = np.array([_misfit(spline(tt + s), q) for s in tried])
    k = int(np.argmin(costs))
    if k in (0, len(tried) - 1):
        raise ScanError(
            f"no time offset within ±{max_offset_s} s fits",
            hint="wave to and fro, not steadily one way; or search wider",
        )
    around = slice(max(k - 4, 0), k + 5)
    a, b, c = np.polyfit(tried[around] - tried[k], costs[around], 2)
    if a <= 0:
        raise ScanError("the offset has no clear best value", hint="wave faster, to and fro")
    offset = float(tried[k] - b / (2 * a))
    floor = max(float(c - b * b / (4 * a)), 1e-12)
    # cost = mean of two coordinates' squares, of M points less 8 fitted numbers
    sigma = float(np.sqrt(floor / (2 * max(len(tt) - 4, 1)) / a))
    return TimeOffset(offset, sigma, float(np.sqrt(floor)), len(tt))


def _misfit(p: Float, q: Float) -> float:
    """Mean square px of a track q (M, 2) about the best linear function of p (M, 3), outliers capped."""
    A = np.column_stack([p, np.ones(len(q))])
    A[:, :3] -= A[:, :3].mean(0)
    A[:, :3] /= A[:, :3].std(0) + 1e-9
    weight = np.ones(len(q))
    r = np.zeros(len(q))
    for _ in range(5):  # an object half out of view is an outlier
        c, *_ = np.linalg.lstsq(A * weight[:, None], q * weight[:, None], rcond=None)
        r = np.linalg.norm(q - A @ c, axis=1)
        weight = 1 / np.sqrt(1 + (r / (3 * np.median(r) + 1e-9)) ** 2)
    return float(np.mean(np.minimum(r, 6 * np.median(r) + 1e-9) ** 2))


def warm_centroid(thermal: NDArray, *, share: float = 0.5) -> Float:
    """(2,) px of the warm object in a picture (H, W): centroid of what is above the middle between background and the
    hottest; NaN if the picture has no clear one, or it touches the border."""
    x = cv2.GaussianBlur(np.asarray(thermal, np.float32), (0, 0), 1.0)
    base, top = float(np.median(x)), float(np.percentile(x, 99.9))
    spread = mad_sigma(x - base) + 1e-9
    if top - base < 8 * spread:
        return np.full(2, np.nan)
    mask = (x > base + share * (top - base)).astype(np.uint8)
    n, _, stats, centers = cv2.connectedComponentsWithStats(mask)
    k = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])) if n > 1 else 0
    left, up, w, h = stats[k, :4]
    if k == 0 or left == 0 or up == 0 or left + w == x.shape[1] or up + h == x.shape[0]:
        return np.full(2, np.nan)
    return np.asarray(centers[k], np.float64)


def nearest_centroid(depth_m: NDArray, camera: Camera) -> Float:
    """(3,) m of the object nearest to the depth camera in an image (H, W): centroid of what lies within 8 cm behind its
    front; NaN if the image is empty or the object touches the border."""
    z = np.asarray(depth_m, np.float64)
    if np.isfinite(z).sum() < 50:
        return np.full(3, np.nan)
    front = np.nanpercentile(z, 0.3)
    mask = (np.isfinite(z) & (z < front + OBJECT_THICKNESS_M)).astype(np.uint8)
    n, label, stats, centers = cv2.connectedComponentsWithStats(mask)
    if n < 2:
        return np.full(3, np.nan)
    k = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    left, up, w, h = stats[k, :4]
    if stats[k, cv2.CC_STAT_AREA] < 30 or left == 0 or up == 0 or left + w == z.shape[1] or up + h == z.shape[0]:
        return np.full(3, np.nan)
    u, v = centers[k]
    d = float(np.nanmedian(z[label == k]))
    K = camera.K
    return np.array([(u - K[0, 2]) / K[0, 0] * d, (v - K[1, 2]) / K[1, 1] * d, d])


def _finite(times: NDArray, track: NDArray) -> tuple[Float, Float]:
    t, p = np.asarray(times, np.float64), np.asarray(track, np.float64)
    keep = np.isfinite(p).all(axis=1)
    return t[keep], p[keep]
