"""Frame to frame: each frame against the one before, judged step by step, and the moment it fails."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.rigid import invert, rotation_angle_deg, se3_exp, se3_log
from ..progress import Progress
from ..recipe import TrackingSection
from ..types import Float
from .fragments import Fragment, build_fragment
from .frames import TrackingFrame, TrackingFrames
from .maps import DepthMap, Intrinsics
from .registration import REACH_M, Partners, agreement, find_partners, image_shift, register_view

# Reach of partners, one iteration each: from what a fast walk moves in a frame down to what noise spreads.
REACHES_M = (0.08, 0.05, 0.03, 0.03, 0.03, 0.03, 0.03, 0.03, 0.03, 0.03)
# A second try from standing still, with a far reach: for a jerk that the last motion did not announce.
RESCUE_REACHES_M = (0.15, 0.15, 0.12, 0.12, 0.1, 0.1, 0.08, 0.06, 0.05, 0.04, 0.03, 0.03, 0.03, 0.03)
STEP_TOLERANCE = 2e-5  # rad and m: well below what one frame's noise allows
MIN_AGREEMENT = 0.75  # of what both frames could see, outlines included; neighbours have 0.86 to 1
MAX_SPEED_M_S, MAX_SPEED_DEG_S = 2.5, 180.0  # faster is no walk: a failure
MIN_STEP_M, MIN_STEP_DEG = 0.06, 6.0  # always possible, however near in time two frames stand
MAX_GAP_FRAMES = 5  # empty frames that a segment may step over


@dataclass(frozen=True, eq=False)
class Segment:
    """Frames tracked without a break.

    frames : (N,) positions in the depth stream. T : (N, 4, 4) in the segment's own frame. fitness, residual_mm : (N,)
    of the step to each frame, NaN for the first. samples : (N,) points of each frame. floors : N planes (4,) in
    each frame's camera, None where none was seen. fragments : of these frames.
    """

    frames: NDArray[np.intp]
    T: Float
    fitness: Float
    residual_mm: Float
    samples: tuple[DepthMap, ...]
    floors: tuple[Float | None, ...]
    fragments: tuple[Fragment, ...]


class Odometry:
    """Frames one after the other, as far as they came: what `track` begins with, or goes on from.

    taken : positions in the depth stream of all frames so far, empty ones too.
    """

    def __init__(self, intrinsics: Intrinsics, tracking: TrackingSection, *, timed: bool = True) -> None:
        """intrinsics : of the frames. timed : their times were recorded, so their speed counts."""
        self.taken: list[int] = []
        self._intrinsics, self._tracking, self._timed = intrinsics, tracking, timed
        self._segments: list[GrowingSegment] = []

    def take(self, frame: TrackingFrame) -> bool:
        """The next frame; False where its step fails its test, or it is the first: it begins a new segment.

        Empty frames are left out, and break nothing.
        """
        self.taken.append(frame.index)
        if frame.empty or (self._segments and self._segments[-1].take(frame, timed=self._timed)):
            return True
        self._segments.append(GrowingSegment(frame, self._intrinsics, self._tracking))
        return False

    @property
    def pose(self) -> Float:
        """(4, 4) of the last frame that shows something, in its segment's frame, m."""
        return self._segments[-1].pose

    @property
    def residual_mm(self) -> float:
        """Of the last segment, as `GrowingSegment.residual_mm`."""
        return self._segments[-1].residual_mm

    def finished(self) -> list[Segment]:
        """All segments; no frame may follow."""
        return [s.finished() for s in self._segments]


def odometry(
    frames: TrackingFrames,
    indices: NDArray[np.intp],
    tracking: TrackingSection,
    progress: Progress,
    begun: Odometry | None = None,
) -> list[Segment]:
    """Tracks frames (N,), positions in the depth stream, in order; a step that fails its test begins a new segment.

    Empty frames are left out. begun : has taken the first of these frames already; it is used up.
    """
    if begun is None:
        begun = Odometry(frames.intrinsics, tracking, timed=not frames.scan.times_assumed)
    first = len(begun.taken)
    for n, frame in enumerate(frames.read_ahead(indices[first:]), first):
        progress("track", n, len(indices))
        begun.take(frame)
    return begun.finished()


class GrowingSegment:
    """A segment while it grows: its last frame, the motion of the last step, and frames not yet in a fragment."""

    def __init__(
        self, frame: TrackingFrame, intrinsics: Intrinsics, tracking: TrackingSection, T: Float | None = None
    ) -> None:
        self._intrinsics, self._tracking = intrinsics, tracking
        self._frames: list[int] = []
        self._T: list[Float] = []
        self._chain: list[Float] = []  # as _T, but always from frame to frame: what holds a fragment together
        self._fitness: list[float] = []
        self._residual: list[float] = []
        self._samples: list[DepthMap] = []
        self._floors: list[Float | None] = []
        self._fragments: list[Fragment] = []
        self._pending: list[TrackingFrame] = []
        self._velocity = np.zeros(6)  # twist per second
        self._append(frame, np.eye(4) if T is None else T, None, np.eye(4))

    @property
    def pose(self) -> Float:
        """(4, 4) of the last frame, in the segment's own frame, m."""
        return self._T[-1]

    @property
    def residual_mm(self) -> float:
        """Median residual of the steps so far, mm at 1 m; NaN before the second frame."""
        steps = [r for r in self._residual if r == r]
        return float(np.median(steps)) if steps else float("nan")

    def take(self, frame: TrackingFrame, *, timed: bool = True) -> bool:
        """Append a frame if the motion to it can be believed; timed : its time was recorded, so its speed counts."""
        if frame.index - self._frames[-1] > MAX_GAP_FRAMES:
            return False
        dt_s, last = max(frame.time_s - self._last.time_s, 1e-3), [(self._last.map, np.eye(4))]
        for start, reaches in ((se3_exp(self._velocity * dt_s), REACHES_M), (np.eye(4), RESCUE_REACHES_M)):
            T_last_now, _ = register_view(frame.map, last, start, reaches, tolerance=STEP_TOLERANCE)
            partners = find_partners(frame.map, self._last.map, T_last_now, REACH_M)
            believed = _believed(partners, self._tracking) and (not timed or _possible(T_last_now, dt_s))
            if believed and agreement(frame.map, self._last.map, T_last_now, stride=2) >= MIN_AGREEMENT:
                self._append(frame, self._T[-1] @ T_last_now, partners, T_last_now)
                self._velocity = se3_log(T_last_now) / dt_s
                return True
        return False

    def append_at(self, frame: TrackingFrame, T: Float) -> None:
        """Append a frame whose pose T (4, 4), frame to segment [m], is known from elsewhere (a recorded trajectory).

        Within a fragment its motion is still measured: recorded poses may jitter.
        """
        start, last = invert(self._T[-1]) @ T, [(self._last.map, np.eye(4))]
        T_last_now, _ = register_view(frame.map, last, start, REACHES_M[1:], tolerance=STEP_TOLERANCE)
        partners = find_partners(frame.map, self._last.map, T_last_now, REACH_M)
        if not _believed(partners, self._tracking):
            T_last_now = start
        self._append(frame, T, partners, T_last_now)

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
            tuple(self._floors),
            tuple(self._fragments),
        )

    def _append(self, frame: TrackingFrame, T: Float, partners: Partners | None, T_last_now: Float) -> None:
        self._frames.append(frame.index)
        self._T.append(T)
        chained = self._chain[-1] @ T_last_now if self._chain else T
        if self._pending and self._shift_deg(frame, chained) > self._tracking.max_fragment_shift_deg:
            self._close_fragment()
        self._chain.append(chained)
        self._fitness.append(np.nan if partners is None else partners.share)
        self._residual.append(np.nan if partners is None else partners.residual_mm_at_1m)
        self._samples.append(frame.map.sample_only())
        self._floors.append(frame.floor)
        self._pending.append(frame)
        self._last = frame
        if len(self._pending) == self._tracking.fragment_frames:
            self._close_fragment()

    def _shift_deg(self, frame: TrackingFrame, chained: Float) -> float:
        """How far the frame's points have moved in the image since the first frame of the fragment that grows."""
        T_now_first = invert(chained) @ self._chain[-len(self._pending)]
        return float(np.degrees(np.arctan(image_shift(frame.map.sample.T, T_now_first))))

    def _close_fragment(self) -> None:
        poses = np.array(self._chain[-len(self._pending) :])
        self._fragments.append(build_fragment(self._pending, poses, self._intrinsics))
        self._pending = []


def _believed(partners: Partners, gate: TrackingSection) -> bool:
    """Most of what both frames see agrees, they see enough in common, and the surfaces fit."""
    overlap = partners.share >= gate.min_fitness and partners.fitness >= 0.5 * gate.min_fitness
    return overlap and partners.residual_mm_at_1m <= gate.max_residual_mm


def _possible(T_last_now: Float, dt_s: float) -> bool:
    """No faster than a person walks and turns."""
    near = np.linalg.norm(T_last_now[:3, 3]) <= max(MAX_SPEED_M_S * dt_s, MIN_STEP_M)
    return bool(near and rotation_angle_deg(T_last_now) <= max(MAX_SPEED_DEG_S * dt_s, MIN_STEP_DEG))
