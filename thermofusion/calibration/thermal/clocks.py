"""Two unrelated clocks joined: where the subject's outline stands in the thermal picture tells the moment.

The depth camera's subject, seen from the thermal camera through the rig, has an outline; the thermal picture has one
too. As rig or subject move, both go the same way. The offset between the clocks, however large, and their drift are
those at which the outlines' positions agree best, up to a constant for each place of the outline (a rig or a threshold
that is a little wrong).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...geometry.camera import project
from ...geometry.rigid import transform_points
from ...progress import Progress, silent
from ...robust import mad_sigma
from ...scans.thermal import ThermalFrames
from ...types import Camera, Float, Scan, ThermalCamera

BANDS = 12  # rows, and columns, of the thermal picture in which an outline's two sides are taken
MARGIN = 0.02  # of the picture's side: an outline so near to the border may go on beyond
FEWEST = 40  # points of the subject that make an outline in a band
STEP_PX = 2  # every so many depth pixels are looked at
MIN_FRAMES = 12  # thermal frames that must lie within the depth recording
MIN_SHARE = 0.5  # of the shorter recording that must lie within the other
COARSE_S, FINE_S = 0.05, 0.01  # steps of the search
CAP_PX = 12.0  # a side that is farther off is as wrong as can be
MAX_DRIFT = 200e-6  # of a clock: crystals are within 100 ppm
DRIFT_SIGMA = 50e-6  # what a crystal is expected to drift, where the recording says little
RIVAL_S, RIVAL = 0.5, 1.15  # another offset farther away must be worse by this factor
MAX_SIGMA_S = 0.01  # of the offset that is believed
CALMEST = 0.3  # of all places' spread: no place of an outline is believed to be steadier
GAP_M = 0.2  # between the subject and what is behind it
STARTS = 3  # of the fine search: the best offsets that are refined
GAP_S = 0.5  # depth frames farther apart are not interpolated between


@dataclass(frozen=True, eq=False)
class ClockJoin:
    """depth time = thermal time * (1 + drift) + offset_s, s. sigma_s : one sigma of the offset in the middle of the
    recording. frames : thermal frames used. residual_px : what the outlines still differ by."""

    offset_s: float
    drift: float
    sigma_s: float
    frames: int
    residual_px: float

    def on_depth_clock(self, times_s: NDArray) -> Float:
        """Times (N,) of the thermal clock on the depth clock, s."""
        return np.asarray(times_s, np.float64) * (1 + self.drift) + self.offset_s


def join_clocks(
    scan: Scan, frames: ThermalFrames, times_s: NDArray, camera: ThermalCamera, *, progress: Progress = silent
) -> ClockJoin:
    """From a depth recording and thermal frames at times_s (N,) s of their own clock, by the thermal camera on the rig.

    Raises ScanError where too little moves, or no offset stands out.
    """
    depth, thermal = [], []
    for i in range(len(scan.depth)):
        depth.append(depth_outline(scan.depth.load(i), scan.rig.depth, camera))
        progress("depth", i + 1, len(scan.depth))
    for i in range(len(frames)):
        thermal.append(thermal_outline(frames.load(i)))
        progress("thermal", i + 1, len(frames))
    return join_outlines(scan.depth.times_s, np.array(depth), np.asarray(times_s, np.float64), np.array(thermal))


def join_outlines(depth_s: NDArray, depth_px: NDArray, thermal_s: NDArray, thermal_px: NDArray) -> ClockJoin:
    """From outlines: depth_px (N, 4 * BANDS) px at depth_s (N,) s, thermal_px (M, 4 * BANDS) px at thermal_s (M,) s.

    NaN where an outline is not seen. Raises ScanError.
    """
    d, t = depth_s - depth_s[0], thermal_s - thermal_s[0]
    fit = _Fit(d, np.asarray(depth_px, np.float64), t, np.asarray(thermal_px, np.float64))
    overlap = MIN_SHARE * min(d[-1], t[-1])
    offsets = np.arange(overlap - t[-1], d[-1] - overlap + COARSE_S, COARSE_S)
    costs = np.array([fit.cost(o) for o in offsets])
    best = int(np.argmin(costs))
    rivals = costs[np.abs(offsets - offsets[best]) > RIVAL_S]
    hint = "move the rig to and fro while both record, or give --clock-offset SECONDS"
    if not np.isfinite(costs[best]) or (len(rivals) and rivals.min() < RIVAL * costs[best]):
        raise ScanError("no offset between the clocks stands out from the outlines' motion", hint=hint)
    near = offsets[best] + np.arange(-2 * COARSE_S, 2 * COARSE_S + FINE_S / 2, FINE_S)
    starts = near[np.argsort([fit.cost(o) for o in near])[:STARTS]]
    tried = [fit.refined(float(o)) for o in starts]
    offset, drift, sigma, residual, used = min(tried, key=lambda r: fit.cost(r[0], r[1]))
    if sigma > MAX_SIGMA_S or abs(offset - starts[0]) > 4 * COARSE_S:
        raise ScanError(f"the motion tells the offset between the clocks only to {sigma * 1e3:.0f} ms", hint=hint)
    return ClockJoin(float(offset + depth_s[0] - thermal_s[0] * (1 + drift)), drift, sigma, used, residual)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Outlines of both cameras, px, NaN = not seen; clocks begin at 0. depth_px : (N, D). thermal_px : (M, D)."""

    depth_s: Float
    depth_px: Float
    thermal_s: Float
    thermal_px: Float

    def predicted(self, times_s: Float) -> tuple[Float, Float]:
        """(M, D) px of the depth camera's outline at those times, and its speed, px/s; NaN where it is not known."""
        k = np.clip(np.searchsorted(self.depth_s, times_s, side="right") - 1, 0, len(self.depth_s) - 2)
        step = self.depth_s[k + 1] - self.depth_s[k]
        share = (times_s - self.depth_s[k]) / step
        a, b = self.depth_px[k], self.depth_px[k + 1]
        out = a + (b - a) * share[:, None]
        out[(share < 0) | (share > 1) | (step > GAP_S)] = np.nan
        return out, (b - a) / step[:, None]

    def residual(self, offset: float, drift: float = 0.0) -> tuple[Float, Float]:
        """(M, D) px between the outlines less each place's constant, and the outline's speed there."""
        at, speed = self.predicted(self.thermal_s * (1 + drift) + offset)
        r = self.thermal_px - at
        enough = np.isfinite(r).sum(axis=0) >= MIN_FRAMES
        if not enough.any():
            return np.full((0, 1), np.nan), np.full((0, 1), np.nan)
        r, speed = r[:, enough], speed[:, enough]
        return r - np.nanmedian(r, axis=0), speed

    def cost(self, offset: float, drift: float = 0.0) -> float:
        """Mean distance of the outlines, px, capped; infinite where too few frames are in common."""
        r, _ = self.residual(offset, drift)
        seen = np.isfinite(r)
        if seen.any(axis=1).sum() < MIN_FRAMES:
            return np.inf
        return float(np.minimum(np.abs(r[seen]), CAP_PX).mean())

    def refined(self, offset: float) -> tuple[float, float, float, float, int]:
        """(offset, drift, sigma of the offset in the middle, px left, frames) by Gauss-Newton with robust weights."""
        middle, drift = float(self.thermal_s.mean()), 0.0
        sigma = residual = np.inf
        used = 0
        for _ in range(8):
            r, speed = self.residual(offset, drift)
            seen = np.isfinite(r) & np.isfinite(speed)
            late = np.broadcast_to((self.thermal_s - middle)[:, None], r.shape)[seen]
            y, v = r[seen], speed[seen]
            residual = float(mad_sigma(y)) + 1e-9
            column = np.broadcast_to(np.arange(r.shape[1]), r.shape)[seen]
            spread = _spreads(r, CALMEST * residual)[column]
            w = (residual / spread) ** 2 / np.maximum(1, np.abs(y) / (1.5 * spread))
            v, late_v = _centred(v, column, w), _centred(v * late, column, w)
            A = np.column_stack([v, late_v * DRIFT_SIGMA])
            # frames, not places, are independent: the sides of one picture move together
            frames = seen.any(axis=1).sum()
            scale = residual**2 * len(y) / frames
            N = (A * w[:, None]).T @ A / scale + np.diag([0.0, 1.0])
            g = (A * w[:, None]).T @ y / scale - np.array([0.0, drift / DRIFT_SIGMA])
            step = np.linalg.solve(N, g)
            drift = float(np.clip(drift + step[1] * DRIFT_SIGMA, -MAX_DRIFT, MAX_DRIFT))
            offset += float(step[0]) - float(step[1]) * DRIFT_SIGMA * middle
            sigma, used = float(np.sqrt(np.linalg.inv(N)[0, 0])), int(frames)
        return offset, drift, sigma, residual, used


def _spreads(r: Float, least: float) -> Float:
    """(D,) px: the spread of each place's residuals (M, D), at least `least`: arms come and go, flanks do not."""
    return np.array([max(float(mad_sigma(c[np.isfinite(c)])), least) for c in r.T])


def _centred(x: Float, column: NDArray, weight: Float) -> Float:
    """x (K,) less the weighted mean of its column: what each place's constant leaves of it."""
    total = np.bincount(column, weight * x)
    return x - (total / np.maximum(np.bincount(column, weight), 1e-9))[column]


def depth_outline(depth_m: NDArray, camera: Camera, thermal: ThermalCamera) -> Float:
    """(4 * BANDS,) px in the thermal picture: left and right, upper and lower side of the depth image's subject.

    depth_m : (H, W) m, NaN = none. Where the subject leaves the depth image it is NaN.
    """
    h, w = depth_m.shape
    v, u = np.mgrid[0:h:STEP_PX, 0:w:STEP_PX]
    z = depth_m[::STEP_PX, ::STEP_PX].astype(np.float64)
    near = np.isfinite(z)
    near[near] = z[near] < _behind(z[near])
    u, v, z = u[near].astype(np.float64), v[near].astype(np.float64), z[near]
    K, lens = camera.K, thermal.lens
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=1)
    uv, _ = project(lens, transform_points(thermal.T_thermal_depth, points))
    edge = (u < 2 * STEP_PX) | (u >= w - 3 * STEP_PX), (v < 2 * STEP_PX) | (v >= h - 3 * STEP_PX)
    return _sides(uv, edge, (lens.height_px, lens.width_px))


def thermal_outline(stored: NDArray) -> Float:
    """(4 * BANDS,) px: left and right, upper and lower side of what is warm in a thermal picture (H, W) as stored."""
    x = stored.astype(np.float32)
    finite = np.isfinite(x)
    warm = finite & (x > _between(x[finite]))
    count, label, stats, _ = cv2.connectedComponentsWithStats(warm.astype(np.uint8))
    if count > 1:
        warm = label == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    v, u = np.nonzero(warm)
    uv = np.stack([u, v], axis=1).astype(np.float64)
    no = np.zeros(len(u), bool)
    return _sides(uv, (no, no), x.shape)


def _behind(z_m: NDArray) -> float:
    """The distance in m behind which a wall or a floor begins: the middle of the widest gap; infinite without one."""
    if len(z_m) < FEWEST:
        return np.inf
    steps = np.percentile(z_m, np.arange(5, 96))
    k = int(np.argmax(np.diff(steps)))
    return float(steps[k : k + 2].mean()) if steps[k + 1] - steps[k] > GAP_M else np.inf


def _between(values: NDArray) -> float:
    """The threshold that parts values into two groups best (Otsu 1979); beyond all where they are one group."""
    if len(values) < FEWEST:
        return np.inf
    low, high = np.percentile(values, [0.5, 99.5])
    if high <= low:
        return np.inf
    scaled = np.clip((values - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    level, _ = cv2.threshold(scaled.reshape(1, -1), 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    return float(low + (level + 0.5) / 255 * (high - low))


def _sides(uv: Float, at_edge: tuple[NDArray, NDArray], shape: tuple[int, int]) -> Float:
    """(4 * BANDS,) px: of points uv (N, 2) the lowest and highest u in bands of v, then v in bands of u.

    at_edge : (N,) whether a point lies at its own image's left or right border, and upper or lower one.
    """
    out = np.full((2, BANDS, 2), np.nan)
    for axis, size, other in ((0, shape[1], shape[0]), (1, shape[0], shape[1])):
        x, y = uv[:, axis], uv[:, 1 - axis]
        band = np.floor(np.nan_to_num(y, nan=-1) / other * BANDS).astype(int)
        for b in range(BANDS):
            rows = np.flatnonzero((band == b) & np.isfinite(x))
            if len(rows) < FEWEST:
                continue
            k = max(len(rows) // 100, 1)
            order = rows[np.argsort(x[rows], kind="stable")]
            for side, ends in enumerate((order[:k], order[-k:])):
                value = float(x[ends].mean())
                inside = MARGIN * size < value < (1 - MARGIN) * size
                if inside and not at_edge[axis][ends].any():
                    out[axis, b, side] = value
    return out.ravel()
