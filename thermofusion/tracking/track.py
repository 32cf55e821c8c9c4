"""Where the depth camera was: odometry, fragments, loops, one joint solution, frames against the model.

1. Frame to frame, point to plane on coarse depth, subject only; texture helps where the shape alone could slide.
   Every step is judged; one that fails begins a new segment.
2. Every few frames become a fragment: their depth averaged in the middle frame's view.
3. Segments that lost each other are joined again, by time, place or shape; what cannot be joined is left out, and said.
4. All fragments that see the same surface pull on each other, point to plane, in one solution (loops included).
5. Every frame is aligned with the fragments around it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..depth.filter import DepthFrames
from ..errors import ScanError
from ..geometry.rigid import interpolate_trajectory, invert, se3_exp, se3_log
from ..progress import Progress, silent
from ..recipe import InputSection, SubjectSection, TrackingSection
from ..types import Bool, Float, Scan, Trajectory, brief
from .ahead import Ahead
from .faults import PoseFault, refined
from .fragments import Fragment
from .frames import TrackingFrames
from .joint import LOOP_APART, overlapping, solve_jointly
from .odometry import GrowingSegment, Segment, odometry
from .recorded import believed
from .registration import register_view
from .relocalise import find_join
from .still import held_against_pictures

ROUNDS = ((0.08, 4), (0.03, 2), (0.015, 1))  # of the joint solution: reach of partners in m, every how many points
PARTNERS_PER_FRAGMENT = 8  # overlaps kept of each, about
MIN_OVERLAP = 0.2  # of a fragment's points
FRAME_REACHES_M = (0.02, 0.015, 0.01)  # reach of partners, one iteration each
FRAME_TARGETS = 3  # fragments, the nearest, that a frame is aligned with
SPEED_FRAMES = 5  # over which the motion before a break is taken
MIN_FLOOR_SHARE = 0.05  # of frames that must show a floor for it to count as found


@dataclass(frozen=True)
class LostRange:
    """Frames start..stop (positions in the depth stream, stop excluded) that broke tracking, and what was done."""

    start: int
    stop: int
    outcome: Literal["empty", "joined", "left out"]
    how: str


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """The trajectory, and how far it can be trusted.

    trajectory : of the tracked frames; world = the first tracked frame's camera (or the recording's own world).
    tracked : (N,) of the depth stream. fitness : (N,) share of a frame's visible points that found a partner;
    residual_mm : (N,) their median distance at 1 m; NaN where not tracked. lost : every break. loop_closures : pairs of
    fragments far apart in time that were tied. converged : of the joint solution. floor_plane : (4,) [n, d] in the
    world, n·p + d = height in m, or None. source : `recorded`, `estimated` or `refined`. faults : of recorded poses.
    """

    trajectory: Trajectory
    tracked: Bool
    fitness: Float
    residual_mm: Float
    lost: tuple[LostRange, ...]
    loop_closures: int
    converged: bool
    floor_plane: Float | None
    source: str
    messages: tuple[str, ...]
    faults: tuple[PoseFault, ...] = ()

    __repr__ = brief


def locate(
    scan: Scan,
    *,
    input: InputSection,
    subject: SubjectSection,
    tracking: TrackingSection,
    depth: DepthFrames | None = None,
    ahead: Ahead | None = None,
    progress: Progress = silent,
) -> TrackingResult:
    """Where the depth camera was: the recorded trajectory, or it refined, or estimated from the depth alone.

    depth : the scan's frames, if they are at hand. ahead : what was tracked while it was recorded; used up.
    A recorded trajectory is held against the depth first
    (`recorded.believed`); QualityError where it cannot be right.
    Raises ScanError if a recorded trajectory is asked for and there is none, or no frame shows the subject.
    """
    if tracking.source == "recorded" and scan.trajectory is None:
        raise ScanError("no trajectory was recorded", place=scan.root, hint="set tracking.source to auto or estimate")
    if scan.trajectory is None or tracking.source == "estimate":
        scan = replace(scan, trajectory=None)
        return track(scan, input=input, subject=subject, tracking=tracking, depth=depth, ahead=ahead, progress=progress)
    trajectory, faults = believed(scan)
    scan = replace(scan, trajectory=trajectory)
    if not tracking.refine:
        return replace(recorded(scan), faults=faults)
    result = track(scan, input=input, subject=subject, tracking=tracking, depth=depth, progress=progress)
    return replace(result, faults=refined(faults))


def recorded(scan: Scan) -> TrackingResult:
    """The recorded trajectory as it is. Depth frames outside it count as not tracked."""
    assert scan.trajectory is not None
    n = len(scan.depth)
    _, inside = interpolate_trajectory(scan.trajectory, scan.depth.times_s)
    nan = np.full(n, np.nan)
    return TrackingResult(scan.trajectory, inside, nan, nan, (), 0, True, None, "recorded", ())


def track(
    scan: Scan,
    *,
    input: InputSection,
    subject: SubjectSection,
    tracking: TrackingSection,
    depth: DepthFrames | None = None,
    ahead: Ahead | None = None,
    progress: Progress = silent,
) -> TrackingResult:
    """Track the depth camera through a scan; a recorded trajectory, if there is one, is the start.

    depth : the scan's frames, if they are at hand. ahead : what was tracked while it was recorded; used up.
    Raises ScanError if no frame shows the subject, QualityError if the camera seems to stand still though its pictures
    change.
    """
    frames = TrackingFrames.of(scan, input=input, subject=subject, tracking=tracking, depth=depth)
    indices = np.flatnonzero(scan.depth.usable)
    if scan.trajectory is not None:
        T, valid = interpolate_trajectory(scan.trajectory, scan.depth.times_s, max_gap_s=input.max_pose_gap_ms / 1e3)
        segments = _along(T, frames, indices[valid[indices]], tracking)
    else:
        begun = None if ahead is None else ahead.begun(frames, indices, subject, tracking)
        segments = odometry(frames, indices, tracking, progress, begun)
    if not segments:
        raise ScanError(
            "no depth frame shows a subject within input.min_depth_m and input.max_depth_m",
            place=scan.root,
            hint="check depth_unit_m and the recipe's range",
        )
    placed, lost = _join(segments, scan.depth.times_s, tracking)
    placed, loops, converged = _solve(placed, tracking)
    poses = _refined(placed) if tracking.refine_to_model else [p.frame_poses() for p in placed]
    result = _result(frames, placed, poses, lost, loops, converged)
    if scan.trajectory is None:
        alone = subject.background == "remove"
        held_against_pictures(frames, result.trajectory.T_world_depth, result.tracked, alone=alone)
    return result


@dataclass(frozen=True, eq=False)
class _Placed:
    """A segment with the pose of each of its fragments' middle frame in the world."""

    segment: Segment
    T_world_middle: tuple[Float, ...]

    @property
    def fragments(self) -> list[tuple[Fragment, Float]]:
        return list(zip(self.segment.fragments, self.T_world_middle, strict=True))

    def frame_poses(self) -> Float:
        """(N, 4, 4) T_world_depth of the segment's frames."""
        return np.concatenate([T @ f.T_middle_frame for f, T in self.fragments])


def _along(T: Float, frames: TrackingFrames, indices: NDArray[np.intp], tracking: TrackingSection) -> list[Segment]:
    """The frames `indices` (N,) as one segment at recorded poses T (F, 4, 4), one for each frame of the stream."""
    T = _zoomed(T, frames.zoom)
    growing: GrowingSegment | None = None
    for frame in frames.read_ahead(indices):
        if frame.empty:
            continue
        if growing is None:
            growing = GrowingSegment(frame, frames.intrinsics, tracking, T[frame.index])
        else:
            growing.append_at(frame, T[frame.index])
    return [] if growing is None else [growing.finished()]


def _zoomed(T: Float, zoom: float) -> Float:
    """Poses (N, 4, 4) in a world made larger."""
    out = T.copy()
    out[:, :3, 3] *= zoom
    return out


def _join(segments: list[Segment], times_s: Float, tracking: TrackingSection) -> tuple[list[_Placed], list[LostRange]]:
    """Put segments together around the longest; what cannot be joined is left out, and said."""
    longest = int(np.argmax([len(s.frames) for s in segments]))
    placed = {longest: _Placed(segments[longest], _in_segment(segments[longest]))}
    how, doubt = {longest: "the longest"}, dict[int, str]()
    waiting = {k for k in range(len(segments)) if k != longest}
    todo = sorted(waiting, key=lambda k: (abs(k - longest), k))
    while todo:
        k = todo.pop(0)
        main = [f for p in sorted(placed) for f in placed[p].fragments]
        own = list(zip(segments[k].fragments, _in_segment(segments[k]), strict=True))
        guesses = _neighbours(k, segments, placed, times_s)
        join = None
        for probe, T in _probes(own, k - 1 in placed, k + 1 in placed):
            join = find_join(main, probe, T, guesses, tracking)
            if join is not None and not join.ambiguous:
                break
        if join is None or join.ambiguous:
            doubt[k] = "no place in the model convinced" if join is None else "more than one place in the model fits"
            continue
        placed[k] = _Placed(segments[k], tuple(join.T_main_segment @ T for _, T in own))
        how[k] = join.how
        waiting.remove(k)
        # its neighbours in time have a new guess: they come next, again if they were tried
        todo = [n for n in (k - 1, k + 1) if n in waiting] + [n for n in todo if n not in (k - 1, k + 1)]
    return [placed[k] for k in sorted(placed)], _lost(segments, placed, how, doubt)


def _lost(
    segments: list[Segment], placed: dict[int, _Placed], how: dict[int, str], doubt: dict[int, str]
) -> list[LostRange]:
    """Every break between segments, and every segment that found no place."""
    lost = []
    for k in range(1, len(segments)):
        start, stop = int(segments[k - 1].frames[-1]) + 1, int(segments[k].frames[0])
        if stop > start:
            lost.append(LostRange(start, stop, "empty", "nothing of the subject in view"))
        if k in placed and k - 1 in placed:
            way = how[k] if how[k] != "the longest" else how[k - 1]
            lost.append(LostRange(stop, stop + 1, "joined", f"tracking broke here; joined again {way}"))
    for k, why in doubt.items():
        if k not in placed:
            s = segments[k].frames
            lost.append(LostRange(int(s[0]), int(s[-1]) + 1, "left out", why))
    return sorted(lost, key=lambda r: r.start)


def _in_segment(segment: Segment) -> tuple[Float, ...]:
    """Poses of the fragments' middle frames in the segment's own frame."""
    row = {int(f): n for n, f in enumerate(segment.frames)}
    return tuple(segment.T[row[int(f.frames[len(f.frames) // 2])]] for f in segment.fragments)


def _probes(own: list[tuple[Fragment, Float]], before: bool, after: bool) -> list[tuple[Fragment, Float]]:
    """The fragments to try: the end that is next to a placed segment first, then the other, then the middle."""
    order = [0, -1] if before or not after else [-1, 0]
    picked = [k % len(own) for k in (*order, len(own) // 2)]
    return [own[k] for k in dict.fromkeys(picked)]


def _neighbours(k: int, segments: list[Segment], placed: dict[int, _Placed], times_s: Float) -> list[Float]:
    """Guesses T_main_segment: the camera walked on as before (or as after) the break, or it stood."""
    guesses = []
    for other, here, there in ((k - 1, 0, -1), (k + 1, -1, 0)):
        if other not in placed:
            continue
        poses, frames, mine = placed[other].frame_poses(), segments[other].frames, segments[k]
        back = -min(SPEED_FRAMES, len(poses)) if there == -1 else min(SPEED_FRAMES, len(poses)) - 1
        dt_s = times_s[frames[there]] - times_s[frames[back]]
        gap_s = times_s[mine.frames[here]] - times_s[frames[there]]
        if dt_s != 0:
            velocity = se3_log(invert(poses[back]) @ poses[there]) / dt_s
            guesses.append(poses[there] @ se3_exp(velocity * gap_s) @ invert(mine.T[here]))
        guesses.append(poses[there] @ invert(mine.T[here]))
    return guesses


def _solve(placed: list[_Placed], tracking: TrackingSection) -> tuple[list[_Placed], int, bool]:
    """All fragments in one solution: (placed, loops closed, converged)."""
    fragments = [f for p in placed for f in p.fragments]
    maps, T = [f.map for f, _ in fragments], np.array([T for _, T in fragments])
    loops, converged = 0, True
    if len(fragments) > 1:
        for reach, stride in ROUNDS:
            edges = overlapping(maps, T, reach, per_map=PARTNERS_PER_FRAGMENT, min_share=MIN_OVERLAP)
            if not tracking.loop_closure:
                edges = [(i, j) for i, j in edges if abs(i - j) < LOOP_APART]
            fixed = len(fragments) // 2
            T, _, converged = solve_jointly(maps, T, edges, reach, fixed=fixed, stride=stride)
            loops = sum(abs(i - j) >= LOOP_APART for i, j in edges)
    solved, at = [], 0
    for p in placed:
        n = len(p.segment.fragments)
        solved.append(_Placed(p.segment, tuple(T[at : at + n])))
        at += n
    return solved, loops, converged


def _refined(placed: list[_Placed]) -> list[Float]:
    """Frame poses of every segment, each frame aligned with the fragments around it."""
    fragments = [f for p in placed for f in p.fragments]
    centres = np.array([T for _, T in fragments])
    out = []
    for p in placed:
        poses = p.frame_poses()
        for n, T in enumerate(poses):
            turn = np.arccos(np.clip(centres[:, :3, 2] @ T[:3, 2], -1, 1))
            near = np.argsort(turn + np.linalg.norm(centres[:, :3, 3] - T[:3, 3], axis=1), kind="stable")
            targets = [(fragments[k][0].map, fragments[k][1]) for k in near[:FRAME_TARGETS]]
            aligned, partners = register_view(p.segment.samples[n], targets, T, FRAME_REACHES_M, stride=2)
            if partners is not None and np.linalg.norm(aligned[:3, 3] - T[:3, 3]) < FRAME_REACHES_M[0]:
                poses[n] = aligned
        out.append(poses)
    return out


def _result(
    frames: TrackingFrames,
    placed: list[_Placed],
    refined: list[Float],
    lost: list[LostRange],
    loops: int,
    converged: bool,
) -> TrackingResult:
    """Everything about the frames of the stream, from the poses (N, 4, 4) of every placed segment's frames."""
    scan = frames.scan
    n = len(scan.depth)
    T, tracked = np.tile(np.eye(4), (n, 1, 1)), np.zeros(n, bool)
    fitness, residual = np.full(n, np.nan), np.full(n, np.nan)
    for p, poses in zip(placed, refined, strict=True):
        s = p.segment
        T[s.frames], tracked[s.frames] = poses, True
        fitness[s.frames], residual[s.frames] = s.fitness, s.residual_mm
    T = _zoomed(T, 1 / frames.zoom)
    if scan.trajectory is None:
        T = invert(T[int(np.argmax(tracked))]) @ T
    return TrackingResult(
        trajectory=Trajectory(scan.depth.times_s[tracked], T[tracked]),
        tracked=tracked,
        fitness=fitness,
        residual_mm=residual,
        lost=tuple(lost),
        loop_closures=loops,
        converged=converged,
        floor_plane=_floor(placed, T, int(scan.depth.usable.sum())),
        source="estimated" if scan.trajectory is None else "refined",
        messages=_messages(frames, lost, converged),
    )


def _messages(frames: TrackingFrames, lost: list[LostRange], converged: bool) -> tuple[str, ...]:
    messages = [] if converged else ["the joint solution of the fragments had not settled when it was stopped"]
    if frames.slides and frames.color_of is None:
        messages.append("the shape alone leaves some motion free (a cylinder, a sphere); no colour helped to hold it")
    out = [r for r in lost if r.outcome == "left out"]
    if out:
        count = sum(r.stop - r.start for r in out)
        ranges = ", ".join(f"{r.start}-{r.stop - 1}" if r.stop - r.start > 1 else f"{r.start}" for r in out)
        n = len(frames.scan.depth)
        frames_are = "frame could not be tracked and is" if count == 1 else "frames could not be tracked and are"
        messages.append(f"{count} of {n} depth {frames_are} left out: {ranges}")
    joined = [r for r in lost if r.outcome == "joined"]
    if joined:
        at = ", ".join(str(r.start) for r in joined)
        broke = f"once (before frame {at})" if len(joined) == 1 else f"{len(joined)} times (before frames {at})"
        messages.append(f"the camera path broke {broke}; its parts were joined again")
    return tuple(messages)


def _floor(placed: list[_Placed], T: Float, n: int) -> Float | None:
    """The floor in the world: the median of what the frames saw, if enough of n saw one and they agree."""
    seen = [(i, f) for p in placed for i, f in zip(p.segment.frames, p.segment.floors, strict=True) if f is not None]
    if len(seen) < max(3, MIN_FLOOR_SHARE * n):
        return None
    planes = np.array([_to_world(f, T[i]) for i, f in seen])
    middle = np.median(planes, axis=0)
    good = (np.abs(planes[:, 3] - middle[3]) < 0.05) & (planes[:, :3] @ middle[:3] > np.cos(np.radians(5)))
    if good.sum() < 0.5 * len(planes):
        return None
    plane = np.median(planes[good], axis=0)
    return np.asarray(plane / np.linalg.norm(plane[:3]))


def _to_world(plane: Float, T_world_depth: Float) -> Float:
    n = T_world_depth[:3, :3] @ plane[:3]
    return np.append(n, plane[3] - n @ T_world_depth[:3, 3])


__all__ = ["LostRange", "TrackingResult", "locate", "recorded", "track"]
