"""Frame to frame: point to plane on half-resolution depth, colour where shape says too little, and when it fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .._open3d import o3d
from ..depthfilter import read_ahead
from ..geometry import invert, project, rotation_angle_deg, transform_points
from ..recipe import Recipe
from ..scans.pairing import pair_color
from ..segmentation import SubjectFrames
from ..types import Float, Float32, Scan
from .fragments import Fragment, Frame, build_fragment
from .registration import DepthMap, Partners, find_partners, register

SAMPLES = 3000  # points of a frame that are sent to its neighbour
REACHES_M = (0.06, 0.05, 0.04, 0.03, 0.02, 0.02, 0.015, 0.015)
WEAK_GEOMETRY = 1e-3  # smallest to largest eigenvalue of the motion's information: a wall, a table
COLOR_LEVELS = (6, 10)  # iterations of the dense odometry with colour, coarse to fine
COLOR_OUTLIER_M = 0.05
MAX_SPEED_M_S, MAX_SPEED_DEG_S = 2.5, 180.0  # faster is no walk: a failure
MIN_STEP_M, MIN_STEP_DEG = 0.06, 6.0
REACH_M = 0.05
RESCUE_REACHES_M = (0.15, 0.12, 0.1, 0.08, 0.06, 0.05, 0.04, 0.03, 0.02, 0.02)
MAX_GAP_FRAMES = 5  # empty frames that a segment may step over


class HalfFrames:
    """Loads frames at half resolution, ahead on threads.

    Attributes
    ----------
    intrinsics : (fx, fy, cx, cy) of the half image: pixel (u, v) of it is pixel (2u, 2v) of the full one.
    """

    def __init__(self, scan: Scan, recipe: Recipe) -> None:
        self._scan, self.subject = scan, SubjectFrames(scan, recipe)
        K = self.subject.camera.K
        self.intrinsics = (K[0, 0] / 2, K[1, 1] / 2, K[0, 2] / 2, K[1, 2] / 2)
        self._color_of = None
        if recipe.tracking.color and scan.color is not None:
            self._color_of = pair_color(scan, recipe.input.pair_tolerance_ms).color_index

    @property
    def has_color(self) -> bool:
        """Whether there is colour, and the recipe lets it help."""
        return self._color_of is not None

    def load(self, i: int) -> Frame:
        """Frame i of the depth stream."""
        depth = np.ascontiguousarray(self.subject.load(i)[::2, ::2])
        return Frame(i, float(self._scan.depth.times_s[i]), depth)

    def read_ahead(self, indices: NDArray[np.intp]) -> Iterator[Frame]:
        """Frames in order, a few decoded ahead."""
        return read_ahead(self.load, indices.tolist())

    def intensity(self, frame: Frame) -> Float32 | None:
        """Brightness 0..1 of the colour image at every depth pixel (H, W), or None where no colour frame is near."""
        rig, stream = self._scan.rig, self._scan.color
        if self._color_of is None or self._color_of[frame.index] < 0 or stream is None:
            return None
        assert rig.color is not None
        assert rig.T_color_depth is not None
        grey = cv2.cvtColor(stream.load(int(self._color_of[frame.index])), cv2.COLOR_RGB2GRAY)
        depth = frame.depth_m
        fx, fy, cx, cy = self.intrinsics
        v, u = np.nonzero(np.isfinite(depth))
        z = depth[v, u]
        points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1).astype(np.float32)
        uv, _ = project(rig.color, transform_points(rig.T_color_depth, points))
        with np.errstate(invalid="ignore"):
            inside = (uv >= 0).all(1) & (uv[:, 0] < grey.shape[1] - 1) & (uv[:, 1] < grey.shape[0] - 1)
        out = np.zeros(depth.shape, np.float32)
        pixel = np.rint(uv[inside]).astype(np.intp)
        out[v[inside], u[inside]] = grey[pixel[:, 1], pixel[:, 0]].astype(np.float32) / 255
        return out


@dataclass(frozen=True, eq=False)
class Segment:
    """Frames tracked without a break.

    frames : (N,) positions in the depth stream. T : (N, 4, 4) in the segment's own frame. fitness, residual_mm : (N,)
    of the step to each frame, NaN for the first. samples : (N,) points of each frame. fragments : of these frames.
    """

    frames: NDArray[np.intp]
    T: Float
    fitness: Float
    residual_mm: Float
    samples: tuple[DepthMap, ...]
    fragments: tuple[Fragment, ...]


def odometry(
    frames: HalfFrames, indices: NDArray[np.intp], recipe: Recipe, progress: Callable[[int, int], None]
) -> list[Segment]:
    """Tracks frames in order; a step that fails its test begins a new segment. Empty frames are left out."""
    segments: list[GrowingSegment] = []
    for n, frame in enumerate(frames.read_ahead(indices)):
        progress(n, len(indices))
        if frame.empty:
            continue
        if not (segments and segments[-1].take(frame)):
            segments.append(GrowingSegment(frame, frames, recipe))
    return [s.finished() for s in segments]


class GrowingSegment:
    """A segment while it grows: its last frame, the motion of the last step, and frames not yet in a fragment."""

    def __init__(self, frame: Frame, frames: HalfFrames, recipe: Recipe, T: Float | None = None) -> None:
        self._source, self._recipe = frames, recipe
        self._frames: list[int] = []
        self._T: list[Float] = []
        self._fitness: list[float] = []
        self._residual: list[float] = []
        self._samples: list[DepthMap] = []
        self._fragments: list[Fragment] = []
        self._pending: list[Frame] = []
        self._append(frame, np.eye(4) if T is None else T, self._map_of(frame), np.nan, np.nan)
        self._motion = np.eye(4)

    def take(self, frame: Frame) -> bool:
        """Append a frame if the motion to it can be believed."""
        if frame.index - self._frames[-1] > MAX_GAP_FRAMES:
            return False
        now, last = self._map_of(frame), [(self._map, np.eye(4))]
        for start, reaches in ((self._motion, REACHES_M), (np.eye(4), RESCUE_REACHES_M)):
            T_last_now, partners = register(now, last, start, reaches)
            if partners is not None and self._source.has_color and weak_geometry(partners):
                T_last_now = self._with_color(frame, T_last_now)
            partners = find_partners(now, self._map, T_last_now, REACH_M)
            gate = self._recipe.tracking
            believed = partners.share >= gate.min_fitness and partners.residual_mm_at_1m <= gate.max_residual_mm
            if believed and self._possible(T_last_now, frame.time_s - self._last.time_s):
                self._append(frame, self._T[-1] @ T_last_now, now, partners.share, partners.residual_mm_at_1m)
                self._motion = T_last_now
                return True
        return False

    def append_at(self, frame: Frame, T: Float) -> None:
        """Append a frame whose pose is known from elsewhere (a recorded trajectory)."""
        now = self._map_of(frame)
        partners = find_partners(now, self._map, invert(self._T[-1]) @ T, REACH_M)
        self._append(frame, T, now, partners.share, partners.residual_mm_at_1m)

    def finished(self) -> Segment:
        """The segment, its last frames in a last fragment."""
        if self._pending:
            self._close_fragment()
        return Segment(
            np.array(self._frames),
            np.array(self._T),
            np.array(self._fitness),
            np.array(self._residual),
            tuple(self._samples),
            tuple(self._fragments),
        )

    def _append(self, frame: Frame, T: Float, now: DepthMap, fitness: float, residual_mm: float) -> None:
        self._frames.append(frame.index)
        self._T.append(T)
        self._fitness.append(fitness)
        self._residual.append(residual_mm)
        self._samples.append(now.sample_only())
        self._pending.append(frame)
        self._last, self._map = frame, now
        if len(self._pending) == self._recipe.tracking.fragment_frames:
            self._close_fragment()

    def _close_fragment(self) -> None:
        poses = np.array(self._T[-len(self._pending) :])
        self._fragments.append(build_fragment(self._pending, poses, self._source.intrinsics))
        self._pending = []

    def _map_of(self, frame: Frame) -> DepthMap:
        return DepthMap.of(frame.depth_m, self._source.intrinsics, SAMPLES)

    def _with_color(self, frame: Frame, start: Float) -> Float:
        """Open3D's dense odometry with depth and colour, T_last_now; `start` where it cannot tell either."""
        images = [_rgbd(f, self._source.intensity(f)) for f in (frame, self._last)]
        if images[0] is None or images[1] is None:
            return start
        o = o3d.t.pipelines.odometry
        fx, fy, cx, cy = self._source.intrinsics
        K = o3d.core.Tensor(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
        levels = [o.OdometryConvergenceCriteria(n) for n in COLOR_LEVELS]
        loss = o.OdometryLossParams(COLOR_OUTLIER_M)
        try:
            result = o.rgbd_odometry_multi_scale(
                *images, K, o3d.core.Tensor(start), 1.0, 10.0, levels, o.Method.Hybrid, loss
            )
        except RuntimeError:  # a singular system: too little in common
            return start
        T = result.transformation.numpy().astype(np.float64)
        return T if np.isfinite(T).all() else start

    def _possible(self, T: Float, dt_s: float) -> bool:
        dt_s = max(dt_s, 1e-3)
        near = np.linalg.norm(T[:3, 3]) <= max(MAX_SPEED_M_S * dt_s, MIN_STEP_M)
        return bool(near and rotation_angle_deg(T) <= max(MAX_SPEED_DEG_S * dt_s, MIN_STEP_DEG))


def weak_geometry(partners: Partners) -> bool:
    """Whether the partners' planes leave some motion nearly free: all of them parallel, or round one axis."""
    p, n = partners.points, partners.normals
    if len(n) < 6:
        return True
    centred = p - p.mean(0)
    size = np.sqrt((centred**2).sum(1).mean())
    J = np.concatenate([np.cross(centred / size, n), n], axis=1)
    values = np.linalg.eigvalsh(J.T @ J)
    return bool(values[0] < WEAK_GEOMETRY * values[-1])


def _rgbd(frame: Frame, intensity: Float32 | None) -> o3d.t.geometry.RGBDImage | None:
    if intensity is None:
        return None
    image = o3d.t.geometry.RGBDImage()
    image.depth = o3d.t.geometry.Image(o3d.core.Tensor(np.nan_to_num(frame.depth_m)))
    image.color = o3d.t.geometry.Image(o3d.core.Tensor(np.repeat(intensity[..., None], 3, axis=2)))
    return image
