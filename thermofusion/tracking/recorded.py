"""Recorded poses are held against the depth before they are believed, for `track.locate`.

Two depth frames half a second apart, put together by their recorded poses, must lie on each other. Where they do not,
the poses are read as other programs write them: world-to-camera, quaternions w first, other units, other axes; or lines
are missing, so that all later poses stand at the wrong frame. One reading that fits is taken, and said.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..depth.filter import read_ahead
from ..errors import QualityError
from ..files.tum import poses_of, rows_of
from ..geometry.rigid import interpolate_trajectory, invert, rotation_angle_deg, transform_points
from ..types import Camera, Float, Float32, Scan, Trajectory
from .faults import PoseFault, loose, misread, shifted

PAIR_S = 0.5  # between the frames of a pair: enough motion to tell readings apart, still much seen in common
MAX_PAIRS = 240  # of a recording; two minutes without a gap, then evenly spread
SOME_PAIRS = 8  # that tell one reading from another
STEP_PX = 8  # every so many pixels are carried over
CAP_MM = 50.0  # images that have no surface in common
SUSPECT_MM = 5.0  # median distance of the pairs above which other readings are tried
GOOD_MM = 12.0  # median distance of a pair that fits: sensor noise, and poses good to a centimetre
BAD_MM = 25.0  # of a pair that cannot be of these poses
CLEARLY = 0.4  # another reading must leave less than this share of the misfit
EDGE = 0.03  # relative step of depth beside a pixel that is an edge, no surface
HIDDEN_M = 0.1  # before or behind the surface by more: another surface
MIN_MET = 0.2  # of the points that stay in the image must meet a surface
MAX_LOST = 5  # lines that may be missing, or too many, in a row
MAX_BREAKS = 4  # places where lines are missing
REACH = 6  # frames around such a place that tell where it is
MIN_LATER = 3  # pairs that must speak for missing lines, or against a reading
GAIN = 0.1  # of the typical misfit, that those pairs must gain in the mean
CLEAR_SIGMAS, FLOOR = 3.0, 0.02  # by so many sigmas of that mean; of the typical misfit, below which none is
BAD_SHARE = 0.2  # of the pairs: more, and no mesh can come of it
TURN_DEG = 12.0  # recorded turn between the frames of a pair, where they turn so far in less time
MAX_SPEED_DEG_S = 400.0  # faster, and the images would be smeared
MAX_TURN_DEG = 30.0  # between neighbours: beyond, too little is seen in common
SAME_TIME_S = 2e-3  # a pose belongs to a depth frame


@dataclass(frozen=True)
class Reading:
    """One way to read the eight numbers of a pose. axes : (4, 4) of the camera that was meant, in ours."""

    name: str
    inverse: bool
    w_first: bool
    unit_m: float
    axes: Float

    def of(self, T: Float) -> Float:
        """Poses (N, 4, 4) T_world_depth [m] of poses that were read as ours."""
        out = T.copy()
        if self.w_first:
            out = poses_of(rows_of(T)[:, [0, 1, 2, 4, 5, 6, 3]])
        out[:, :3, 3] *= self.unit_m
        return (invert(out) if self.inverse else out) @ self.axes


_AXES = {
    "": np.eye(4),
    "OpenGL's axes (y up, z backward)": np.diag([1.0, -1, -1, 1]),
    "a robot's axes (x forward, z up)": np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
}
_UNITS = {"": 1.0, "millimetres": 1e-3, "centimetres": 1e-2}


def _readings() -> tuple[Reading, ...]:
    found = []
    for (axes, A), inverse, w_first, (unit, unit_m) in product(
        _AXES.items(), (False, True), (False, True), _UNITS.items()
    ):
        names = ("world-to-camera" if inverse else "", "quaternions w first" if w_first else "", unit, axes)
        found.append(Reading(", ".join(filter(None, names)), inverse, w_first, unit_m, A))
    return tuple(found[1:])  # the first is as they stand


_READINGS = _readings()


def believed(scan: Scan) -> tuple[Trajectory, tuple[PoseFault, ...]]:
    """The scan's trajectory as it is to be read, and what was wrong with it; the very object where nothing was.

    Raises QualityError if the depth frames do not lie on each other by any reading.
    """
    assert scan.trajectory is not None
    pairs = _Pairs.of(scan)
    if len(pairs.frames) < 2:
        return scan.trajectory, ()
    misfit = pairs.misfit_mm(scan.trajectory)
    if np.isfinite(misfit).sum() < MIN_LATER:
        return scan.trajectory, ()  # views too far apart to be held against each other
    trajectory, typical = scan.trajectory, float(np.nanmedian(misfit))
    faults: list[PoseFault] = []
    if typical > SUSPECT_MM:
        reading, left = _best_reading(trajectory, pairs)
        if left < min(CLEARLY * typical, GOOD_MM):
            read = replace(trajectory, T_world_depth=reading.of(trajectory.T_world_depth))
            faults.append(misread(reading.name, trajectory, read, (typical, left)))
            trajectory, misfit = read, pairs.misfit_mm(read)
        elif typical > BAD_MM:
            raise QualityError(
                f"the recorded poses do not fit the depth: neighbouring frames miss each other by {typical:.0f} mm "
                "(median), and no reading known here (inverse, w first, mm, OpenGL's axes) fits",
                place=scan.root,
                hint="set tracking.source to estimate, or mend the poses: T_world_depth in metres, qx qy qz qw",
            )
        elif typical > GOOD_MM:
            faults.append(loose(typical, "all recorded poses"))
    trajectory, more = _lost_lines(scan, trajectory, pairs, misfit)
    return trajectory, (*faults, *more)


def _best_reading(recorded: Trajectory, pairs: _Pairs) -> tuple[Reading, float]:
    """The other reading under which the frames lie on each other best, and their median misfit in mm then."""
    some, T = pairs.some(), recorded.T_world_depth
    left = [_median(some.misfit_mm(replace(recorded, T_world_depth=r.of(T)))) for r in _READINGS]
    best = int(np.argmin(left))
    return _READINGS[best], left[best]


def _lost_lines(
    scan: Scan, trajectory: Trajectory, pairs: _Pairs, misfit: Float
) -> tuple[Trajectory, tuple[PoseFault, ...]]:
    """The trajectory with later poses moved to their frames where lines are missing, or stand twice."""
    faults: list[PoseFault] = []
    while len(faults) < MAX_BREAKS and _one_by_one(scan, trajectory):
        found = _break(scan, trajectory, pairs, misfit)
        if found is None:
            break
        at, shift = found
        moved = _shifted(scan, trajectory, at, shift)
        before, misfit = misfit, pairs.misfit_mm(moved)
        worst = int(np.nanargmax(before - misfit))
        left = float(before[worst]), float(misfit[worst])
        faults.append(shifted(trajectory, moved, shift, int(scan.depth.index[at]), left))
        trajectory = moved
    bad = np.flatnonzero(misfit > BAD_MM)
    if len(bad):
        at_frames = ", ".join(str(int(scan.depth.index[pairs.frames[k]])) for k in bad[:5])
        where = f"at frames {at_frames}{' and more' * (len(bad) > 5)}"
        if len(bad) > BAD_SHARE * np.isfinite(misfit).sum():
            raise QualityError(
                f"the recorded poses do not fit the depth {where}",
                place=scan.root,
                hint="set tracking.source to estimate, or tracking.refine to true",
            )
        faults.append(loose(float(np.median(misfit[bad])), where))
    return trajectory, tuple(faults)


def _break(scan: Scan, trajectory: Trajectory, pairs: _Pairs, misfit: Float) -> tuple[int, int] | None:
    """(frame, lines missing at it; negative: too many) from where on shifted poses fit better; None: nowhere."""
    typical = float(np.nanmedian(misfit))
    far = np.nanmax(misfit) > 3 * typical
    best: tuple[float, int, int] | None = None
    for shift in sorted(range(-MAX_LOST, MAX_LOST + 1) if far else (-1, 1), key=abs):
        if shift == 0:
            continue
        gain = misfit - pairs.misfit_mm(_shifted(scan, trajectory, 0, shift))
        for k in range(len(gain) - MIN_LATER + 1):
            later = gain[k:][np.isfinite(gain[k:])]
            if len(later) < MIN_LATER or later.mean() < GAIN * typical:
                continue
            sigma = later.std() / np.sqrt(len(later)) + FLOOR * typical
            if later.mean() > CLEAR_SIGMAS * sigma and (best is None or later.sum() > best[0]):
                best = (float(later.sum()), k, shift)
    if best is None:
        return None
    _, k, shift = best
    first, last = pairs.frames[max(k - 1, 0)], pairs.frames[k + 1]
    return _place(scan, trajectory, first, last, shift), shift


def _place(scan: Scan, trajectory: Trajectory, first: int, last: int, shift: int) -> int:
    """The depth frame in first + 1 .. last at which lines are missing: the one that leaves least misfit around it."""
    frames = range(max(first - REACH, 0), min(last + REACH, len(scan.depth) - 1) + 1)
    depth = {i: scan.depth.load(i) for i in frames}
    left = {}
    for at in range(first + 1, last + 1):
        T, valid = interpolate_trajectory(_shifted(scan, trajectory, at, shift), scan.depth.times_s)
        near = [(i, j) for i in frames for j in range(i + 2, i + REACH + 1) if j in depth and valid[i] and valid[j]]
        each = [surface_misfit_mm(depth[i], depth[j], scan.rig.depth, invert(T[j]) @ T[i]) for i, j in near]
        left[at] = float(np.mean(each))
    return min(left, key=lambda at: left[at]) if left else last


def _one_by_one(scan: Scan, trajectory: Trajectory) -> bool:
    """Whether poses belong to depth frames one by one: only then can a line be missing."""
    t = scan.depth.times_s
    nearest = np.clip(np.searchsorted(t, trajectory.times_s - SAME_TIME_S), 0, len(t) - 1)
    return bool((np.abs(t[nearest] - trajectory.times_s) <= SAME_TIME_S).mean() > 0.95)


def _shifted(scan: Scan, trajectory: Trajectory, at: int, shift: int) -> Trajectory:
    """From depth frame `at` on every pose belongs to the frame `shift` later (missing lines) or earlier."""
    t, own = scan.depth.times_s, trajectory.times_s
    later = own >= t[at] - SAME_TIME_S
    nearest = np.clip(np.searchsorted(t, own - SAME_TIME_S), 0, len(t) - 1)
    frame, of_a_frame = nearest + shift, np.abs(t[nearest] - own) <= SAME_TIME_S  # others' frames are lost
    kept = ~later | (of_a_frame & (frame < len(t)) & (frame >= at))
    times = np.where(later, t[np.clip(frame, 0, len(t) - 1)], own)
    return Trajectory(times[kept], trajectory.T_world_depth[kept])


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Depth frames in a row, about `PAIR_S` apart, sparse: points to carry over and the image they must lie on.

    frames : N positions in the depth stream. times_s : (N,). depth_m : N images (H, W) m. timed : times were recorded.
    """

    camera: Camera
    frames: list[int]
    times_s: Float
    depth_m: list[Float32]
    timed: bool

    @classmethod
    def of(cls, scan: Scan) -> _Pairs:
        assert scan.trajectory is not None
        t = scan.depth.times_s
        T, inside = interpolate_trajectory(scan.trajectory, t)
        usable = np.flatnonzero(inside & scan.depth.usable)
        frames: list[int] = []
        for i in usable.tolist():
            if not frames or t[i] - t[frames[-1]] >= PAIR_S - 1e-6 or _turn_deg(T[frames[-1]], T[i]) >= TURN_DEG:
                frames.append(i)
        frames = frames[:: 1 + len(frames) // MAX_PAIRS]
        depth_m = list(read_ahead(scan.depth.load, frames))
        return cls(scan.rig.depth, frames, t[frames], depth_m, not scan.times_assumed)

    def some(self) -> _Pairs:
        """A few neighbours, evenly spread."""
        n = min(SOME_PAIRS + 1, len(self.frames))
        first = (len(self.frames) - n) // 2
        kept = slice(first, first + n)
        return _Pairs(self.camera, self.frames[kept], self.times_s[kept], self.depth_m[kept], self.timed)

    def misfit_mm(self, trajectory: Trajectory) -> Float:
        """(N - 1,) median distance in mm at 1 m between each image's points, carried over, and the next image.

        NaN where a pose is missing, or two neighbours look from too far apart.
        """
        T, valid = interpolate_trajectory(trajectory, self.times_s)
        out = np.full(len(self.frames) - 1, np.nan)
        for i in np.flatnonzero(valid[1:] & valid[:-1]).tolist():
            turn = _turn_deg(T[i], T[i + 1])
            if self.timed and turn > MAX_SPEED_DEG_S * (self.times_s[i + 1] - self.times_s[i]):
                out[i] = CAP_MM  # nobody turns a camera so fast
            elif turn <= MAX_TURN_DEG:
                T_next_now = invert(T[i + 1]) @ T[i]
                out[i] = surface_misfit_mm(self.depth_m[i], self.depth_m[i + 1], self.camera, T_next_now)
        return out


def _turn_deg(A: Float, B: Float) -> float:
    return float(rotation_angle_deg(invert(A) @ B))


def _median(misfit: Float) -> float:
    """Median of what is finite; `CAP_MM` where too little is."""
    return float(np.nanmedian(misfit)) if np.isfinite(misfit).sum() >= MIN_LATER else CAP_MM


def surface_misfit_mm(from_m: NDArray, to_m: NDArray, camera: Camera, T_to_from: Float) -> float:
    """Median distance in mm at 1 m from one depth image's points to another's surface, along its normals.

    from_m, to_m : (H, W) m, NaN = none, of one camera at two poses. T_to_from : (4, 4). Points that leave the image do
    not count; where too few of the others meet a surface it is `CAP_MM`.
    """
    K, (h, w) = camera.K, camera.shape
    v, u = np.mgrid[STEP_PX // 2 : h : STEP_PX, STEP_PX // 2 : w : STEP_PX]
    z = from_m[v, u].astype(np.float64).ravel()
    good = np.isfinite(z)
    x, y = (u.ravel() - K[0, 2]) / K[0, 0], (v.ravel() - K[1, 2]) / K[1, 1]
    p = transform_points(T_to_from, np.stack([x * z, y * z, z], axis=1)[good])
    p = p[p[:, 2] > 0.05]
    if len(p) < 50:
        return CAP_MM
    pu = np.rint(p[:, 0] / p[:, 2] * K[0, 0] + K[0, 2]).astype(int)
    pv = np.rint(p[:, 1] / p[:, 2] * K[1, 1] + K[1, 2]).astype(int)
    inside = (pu >= 3) & (pu < w - 3) & (pv >= 3) & (pv < h - 3)
    if inside.mean() < 0.2:
        return CAP_MM
    r = np.abs(_to_plane(p[inside], to_m, pu[inside], pv[inside], K))
    on = r < HIDDEN_M
    if on.mean() < MIN_MET:
        return CAP_MM
    scale = np.maximum(p[inside, 2][on], 1.0) ** 2  # noise grows with the square of the distance
    return float(min(np.median(r[on] / scale) * 1e3, CAP_MM))


def _to_plane(p: Float, depth_m: NDArray, u: NDArray, v: NDArray, K: Float) -> Float:
    """(N,) signed distance in m of points p (N, 3) from the surface under pixels (u, v); NaN at edges and holes."""
    at = np.stack([depth_m[v, u], depth_m[v, u - 3], depth_m[v, u + 3], depth_m[v - 3, u], depth_m[v + 3, u]])
    z, left, right, up, down = at.astype(np.float64)
    flat = (np.abs(at - at[0]) < EDGE * at[0]).all(axis=0)
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    zu, zv = (right - left) / 6, (down - up) / 6
    along_u = np.stack([z / K[0, 0] + x * zu, y * zu, zu], axis=1)
    along_v = np.stack([x * zv, z / K[1, 1] + y * zv, zv], axis=1)
    n = np.cross(along_u, along_v)
    n /= np.linalg.norm(n, axis=1, keepdims=True) + 1e-30
    on = np.stack([x * z, y * z, z], axis=1)
    return np.where(flat, ((p - on) * n).sum(axis=1), np.nan)
