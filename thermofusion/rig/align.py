"""The thermal camera's place on the rig and its clock, refined per scan from the subject's own outline.

Unknowns: six numbers of T_thermal_depth, the thermal clock's offset, and one nuisance, the width by which the image's
outline lies outside the model's (fused surfaces shrink or swell a little, emissivity falls towards the limb). The
measurements are distances between the model's outline and the image's edge along its normal; robust Gauss-Newton
(`estimate`), with the calibrated rig as start and prior.

A camera carried round the subject at constant speed moves along a constant twist ξ, and a clock wrong by dt is then
exactly a rig wrong by exp(-ξ dt): only unsteadiness and the prior tell the two apart. The covariance says how well.
It is widened for what the points of one view have in common (its pose error), and those of one place of the body (the
model's error there).

The skin's own pattern, compared between views, was tried as further evidence and is not used: on smooth skin it says
twenty times less than the outline, and emissivity's fall with angle looks like a shift. Whether views agree after the
alignment is seen where they are calibrated against each other (`crosscal`) and where views are left out (`validate`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..geometry.rigid import interpolate_trajectory, invert
from ..motion.body import BodyMotion, Standing, parted
from ..progress import Progress, silent
from ..recipe import InputSection, RigSection
from ..robust import evenly
from ..types import Float, Scan, SurfaceMesh, ThermalCamera, ThermalStream, Trajectory, brief
from .estimate import (
    CLOCK,
    NAMES,
    PRIOR_TIME_S,
    RIG,
    ROTATION,
    TRANSLATION,
    TWIST,
    OutlineSet,
    Solved,
    Stamps,
    State,
    prior_covariance,
    solve,
)
from .free.place import FreeViews, place_views
from .jitter import frame_times
from .knock import Knocks, find_knocks, settled
from .outlines import read_outlines, search_shift
from .rows import ReadOut, readout_time

BodyAt = Callable[[Float], Standing]  # times, s -> the subject as it stood then
MAX_VIEWS = 30  # that enter: more cost time and say nothing new
MIN_VIEWS = 6
HELD_SHARE = 0.7  # a sigma this near to its prior's is the prior's
SUPPORT_CHI2 = 24.3  # 99.9 % of chi-square with 7 degrees of freedom: below it the data do not ask for a change
ALIKE = 0.9  # correlation above which the clock cannot be told from a motion of the rig
SCALE_SIGMAS = 4.0  # by which a scale of the depth must stand out
SCALE_LEFT_CHI2 = 16.8  # 99 % of chi-square with 6 degrees of freedom: more is left, and the scale is not the cause
MOST_NAMED = 8  # frames, in a message
TIMES_ROUNDS = 2  # of solving for the rig, where the time of each view is unknown, too
TOO_FEW = "too few points of the outline were found in the thermal images"
AROUND_VIEWS = 2  # of those that enter, on either side of a knock: its frame is looked for among all frames there
CLOCK_UNSURE = 0.1  # of its prior's sigma: a clock known better is known, whatever it correlates with


@dataclass(frozen=True, eq=False)
class RigResult:
    """The thermal camera with its place and clock refined, and how sure they are.

    residual_px_before, _after : robust RMS distance between the model's outline and the image's, NaN if not measured.
    covariance : (7, 7) of rotation vector [rad], translation [m] (left perturbation of T_thermal_depth) and time [s].
    outline_width_px : by how much the image's outline lies outside the model's (nuisance, not applied).
    changed : False = rig and clock are the scan's own. converged : the refinement came to rest.
    frame_dt_s : (F,) what the times of single thermal frames lack, None = nothing; jitter_s : one sigma of it.
    depth_scale : depth over truth less 1, where outlines ask for it or for cameras that stand farther apart by this
    share, and for nothing else; 0 = no news.
    readout : the time that reading an image's rows takes; None = no news.
    knocks : where the camera stood from some frame on, `camera` being where it stood first; None = it stayed there.
    free : where each view of a camera that is not on the rig was taken; rig and clock then mean nothing.
    """

    camera: ThermalCamera
    residual_px_before: float
    residual_px_after: float
    covariance: Float
    outline_width_px: float
    changed: bool
    converged: bool
    views_used: int
    messages: tuple[str, ...] = ()
    frame_dt_s: Float | None = None
    jitter_s: float = 0.0
    depth_scale: float = 0.0
    free: FreeViews | None = None
    readout: ReadOut | None = None
    knocks: Knocks | None = None

    __repr__ = brief

    @property
    def sigma_rotation_deg(self) -> float:
        """One sigma about the least certain axis."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[ROTATION, ROTATION])[-1])))

    @property
    def sigma_translation_mm(self) -> float:
        """One sigma along the least certain direction."""
        return float(1e3 * np.sqrt(np.linalg.eigvalsh(self.covariance[TRANSLATION, TRANSLATION])[-1]))

    @property
    def sigma_time_s(self) -> float:
        """One sigma of the clock."""
        return float(np.sqrt(self.covariance[CLOCK, CLOCK]))


def align(
    scan: Scan,
    mesh: SurfaceMesh,
    path: Trajectory | BodyMotion,
    *,
    input: InputSection,
    rig: RigSection,
    progress: Progress = silent,
) -> RigResult:
    """Refine T_thermal_depth and the thermal time offset of a scan; leave them where the data do not support a change.

    Parameters
    ----------
    mesh : the fused surface, world frame. path : T_world_depth on the depth clock; or with it how the subject moved.
    progress : called with ("rig", views read, views in all).

    Raises ScanError if the scan has no thermal stream, or an image cannot be read.
    """
    stream, (trajectory, body) = scan.thermal, parted(path)
    if stream is None:
        raise ScanError("the scan has no thermal stream", place=scan.root, hint="there is nothing to align")
    camera, start = stream.camera, State.of(stream.camera)
    if (camera.mount if rig.mount == "auto" else rig.mount) == "free":
        return _free(scan, mesh, trajectory, progress)
    if not rig.align:
        return _unchanged(camera, "alignment is switched off by the recipe")
    frames = _frames(stream, trajectory, input.max_pose_gap_ms / 1e3)
    T_world_depth, _ = interpolate_trajectory(trajectory, stream.depth_times_s[frames])
    T_world_thermal = T_world_depth @ invert(start.T_thermal_depth)
    body_at = partial(Standing, mesh, body)
    stands = body_at(stream.depth_times_s[frames])
    outlines, contrast = read_outlines(stream, stands, frames.tolist(), T_world_thermal, progress)
    if len(outlines) < MIN_VIEWS:
        return _unchanged(camera, f"fewer than {MIN_VIEWS} thermal views show an outline that could be used")
    begin = camera
    if contrast is None:  # nothing where it should be: perhaps the rig is off by degrees
        shift = search_shift(camera.lens, outlines, invert(T_world_thermal))
        if shift is not None:
            rotation = shift[::-1] / camera.lens.focal_px * [-1, 1]
            turned = start.moved(np.concatenate([rotation, np.zeros(6)]))
            begin = replace(camera, T_thermal_depth=turned.T_thermal_depth)
            T_world_thermal = T_world_depth @ invert(begin.T_thermal_depth)
            outlines, contrast = read_outlines(stream, stands, frames.tolist(), T_world_thermal, progress)
    if contrast is None or len(outlines) < MIN_VIEWS:
        return _unchanged(camera, "the outline does not stand out from the background in the thermal images")
    shown = frames[[v.row for v in outlines]]
    measured = OutlineSet(camera.lens, trajectory, outlines, stream.times_s[shown], contrast)
    result = _fitted(stream, body_at, measured, begin, input.max_pose_gap_ms / 1e3, shown)
    if begin is camera:
        return result
    if not result.converged:
        return _unchanged(camera, "the outline was found far from where the rig says, but did not come to rest there")
    text = f"{_described(State.of(result.camera).distance(start)[RIG])}: calibrate it again"
    return replace(result, changed=True, messages=(text, *result.messages[1:]))


def _fitted(
    stream: ThermalStream,
    body_at: BodyAt,
    measured: OutlineSet,
    begin: ThermalCamera,
    max_gap_s: float,
    shown: NDArray[np.intp],
) -> RigResult:
    """The rig; and where it does not fit all views, where the camera was knocked, the views' own times, the read-out.

    shown : (N,) frames of the views that are measured.
    """
    result = _refined(measured, begin)
    knocks = find_knocks(measured, State.of(result.camera), shown)
    if knocks is not None:
        knocks = _settled(stream, body_at, measured, knocks, begin, max_gap_s, shown)
        measured = measured.knocked(knocks.of(shown))
        result = _refined(measured, begin)
    jitter = frame_times(measured, State.of(result.camera))
    if jitter is not None:
        result = _with_times(stream, body_at, measured, begin, max_gap_s, knocks) or result
    if result.frame_dt_s is not None:
        measured = measured.later(result.frame_dt_s[shown])
    return replace(result, readout=readout_time(measured, State.of(result.camera)), knocks=knocks)


def _free(scan: Scan, mesh: SurfaceMesh, trajectory: Trajectory, progress: Progress) -> RigResult:
    """Every view placed by itself; the covariance is that of a typical view."""
    assert scan.thermal is not None
    views, joint = place_views(scan, mesh, trajectory, progress)
    covariance = np.full((7, 7), np.nan)
    covariance[TWIST, TWIST] = np.median(views.covariance, axis=0)
    messages = []
    if len(views.lost):
        named = ", ".join(str(int(i)) for i in scan.thermal.index[views.lost][:MOST_NAMED])
        more = f" and {len(views.lost) - MOST_NAMED} more" if len(views.lost) > MOST_NAMED else ""
        messages.append(f"thermal frames that could not be placed by the subject's outline: {named}{more}")
    if not joint.converged:
        messages.append("the thermal views' poses did not come to rest")
    return RigResult(
        scan.thermal.camera,
        float("nan"),
        float(np.hypot(joint.outline_px, views.pose_px(scan.thermal.camera.lens, joint.range_m))),
        covariance,
        outline_width_px=joint.width_px,
        changed=True,
        converged=joint.converged,
        views_used=len(views.frame),
        messages=tuple(messages),
        free=views,
    )


def _frames(stream: ThermalStream, trajectory: Trajectory, max_gap_s: float) -> NDArray[np.intp]:
    """Thermal frames chosen evenly among those whose poses are known a little before and after, too."""
    frames = np.flatnonzero(_placed(stream, trajectory, stream.camera.time_offset_s, 2 * PRIOR_TIME_S, max_gap_s))
    return frames[evenly(len(frames), MAX_VIEWS)]


def _placed(
    stream: ThermalStream, trajectory: Trajectory, offset_s: float, around_s: float, max_gap_s: float
) -> NDArray[np.bool_]:
    """(F,) usable thermal frames whose poses are known, and those of times around_s before and after."""
    placed = stream.usable.copy()
    for shift in (-around_s, 0.0, around_s):
        placed &= interpolate_trajectory(trajectory, stream.times_s + offset_s + shift, max_gap_s=max_gap_s)[1]
    return placed


def _settled(
    stream: ThermalStream,
    body_at: BodyAt,
    chosen: OutlineSet,
    knocks: Knocks,
    begin: ThermalCamera,
    max_gap_s: float,
    shown: NDArray[np.intp],
) -> Knocks:
    """Knocks, told to the frame by the outlines of all frames around them; shown : numbers of the views that enter."""
    start = State.of(_refined(chosen.knocked(knocks.of(shown)), begin).camera)
    cut = np.searchsorted(shown, knocks.frame)
    around = zip(shown[cut - AROUND_VIEWS], shown[np.minimum(cut + AROUND_VIEWS, len(shown) - 1)], strict=True)
    frames = np.unique(np.concatenate([np.arange(a, b) for a, b in around]))
    frames = frames[_placed(stream, chosen.trajectory, start.time_offset_s, 0.0, max_gap_s)[frames]]
    if not len(frames):
        return knocks
    around_them, seen = _shown_by(stream, body_at, chosen, frames, start, None)
    return settled(knocks, around_them, start, seen)


def _shown_by(
    stream: ThermalStream,
    body_at: BodyAt,
    chosen: OutlineSet,
    frames: NDArray[np.intp],
    state: State,
    knocks: Knocks | None,
) -> tuple[OutlineSet, NDArray[np.intp]]:
    """The outlines of other frames (N,) than the chosen ones, as a rig predicts them, and which frames show any."""
    taken_s = stream.times_s[frames] + state.time_offset_s
    T_world_depth, _ = interpolate_trajectory(chosen.trajectory, taken_s)
    T_thermal_depth = state.T_thermal_depth if knocks is None else knocks.of(frames) @ state.T_thermal_depth
    views, _ = read_outlines(stream, body_at(taken_s), frames.tolist(), T_world_depth @ invert(T_thermal_depth))
    seen = frames[[v.row for v in views]]
    motion = None if knocks is None else knocks.of(seen)
    return replace(chosen, views=views, times_s=stream.times_s[seen], motion=motion), seen


def _with_times(
    stream: ThermalStream,
    body_at: BodyAt,
    chosen: OutlineSet,
    begin: ThermalCamera,
    max_gap_s: float,
    knocks: Knocks | None,
) -> RigResult | None:
    """The rig again, with the time of each view unknown, and then the times of all frames; None where too few show it.

    body_at : times -> which surface each view sees. chosen : the views that enter, at their stamps, which jitter.
    """
    start = state = State.of(begin)
    times = at_start = frame_times(chosen, start, sure=True)
    solved = None
    for _ in range(TIMES_ROUNDS):
        if times is None:
            return None
        solved = solve(chosen.later(times.dt_s), start, Stamps(times.dt_s, times.scatter_s))
        if solved is None:
            return _unchanged(begin, TOO_FEW)
        state = solved.state
        times = frame_times(chosen, state, sure=True)
    if times is None or at_start is None or solved is None:
        return None
    before = chosen.later(at_start.dt_s).residual_px(start)
    result = _decided(chosen, begin, solved, before, chosen.later(times.dt_s).residual_px(state))
    state = State.of(result.camera)
    frames = np.flatnonzero(_placed(stream, chosen.trajectory, state.time_offset_s, 0.0, max_gap_s))
    outlines, seen = _shown_by(stream, body_at, chosen, frames, state, knocks)
    times = frame_times(outlines, state, sure=True)
    if times is None:
        return None
    dt_s = np.zeros(len(stream))
    dt_s[seen] = times.dt_s
    text = (
        f"time stamps of single thermal frames jitter by {1e3 * times.scatter_s:.0f} ms: the outlines of "
        f"{len(seen)} say when they were taken, and left-out outline comes from {times.before_px:.2f} to "
        f"{times.after_px:.2f} px"
    )
    return replace(result, frame_dt_s=dt_s, jitter_s=times.scatter_s, messages=(*result.messages, text))


def _refined(outlines: OutlineSet, camera: ThermalCamera) -> RigResult:
    """The rig that fits the outlines, or the one given where chance would explain the change as well."""
    start = State.of(camera)
    before = outlines.residual_px(start)
    solved = solve(outlines, start)
    if solved is None:
        return _unchanged(camera, TOO_FEW, before)
    return _decided(outlines, camera, solved, before, outlines.residual_px(solved.state))


def _decided(outlines: OutlineSet, camera: ThermalCamera, solved: Solved, before: float, after: float) -> RigResult:
    """What was solved for, or the camera as it is; before, after : distance between outlines, px."""
    state = solved.state
    change = state.distance(State.of(camera))[RIG]
    cov = solved.covariance[RIG, RIG] + outlines.shared_error()
    supported = float(change @ np.linalg.solve(cov, change)) > SUPPORT_CHI2 and after < before
    found = _described(change)
    result = RigResult(
        replace(camera, T_thermal_depth=state.T_thermal_depth, time_offset_s=state.time_offset_s),
        before,
        after,
        cov,
        outline_width_px=state.width_px,
        changed=True,
        converged=solved.converged,
        views_used=len(outlines.views),
        messages=(found, *_weak(cov)),
        depth_scale=_depth_scale(change, cov, camera.T_thermal_depth[:3, 3]) if solved.converged else 0.0,
    )
    if supported and solved.converged:
        return result
    # a change that chance would explain is no news: the rig is as calibrated
    news = () if solved.converged else (f"the rig is left alone: a change ({found}) did not come to rest",)
    return replace(result, camera=camera, residual_px_after=before, changed=False, messages=news)


def _depth_scale(change: Float, cov: Float, baseline_m: Float) -> float:
    """Depth over truth less 1 that explains a change (7,) of the rig, covariance (7, 7), by itself; 0 where none does.

    Where depth, and poses tracked with it, are too large by a factor, the model's outline is that of the true body seen
    from cameras that stand farther apart by the same factor.
    """
    direction = np.zeros(7)
    direction[TRANSLATION] = baseline_m
    information = np.linalg.inv(cov)
    square = float(direction @ information @ direction)
    if square <= 0:
        return 0.0
    scale = float(direction @ information @ change) / square
    left = change - scale * direction
    explained = scale**2 * square > SCALE_SIGMAS**2 and float(left @ information @ left) < SCALE_LEFT_CHI2
    return scale if explained else 0.0


def _described(change: Float) -> str:
    """The seven numbers of a change for people."""
    angle = np.degrees(np.linalg.norm(change[ROTATION]))
    shift = 1e3 * np.linalg.norm(change[TRANSLATION])
    return f"rig {angle:.2f}° and {shift:.1f} mm, clock {1e3 * change[CLOCK]:+.1f} ms from the scan's own"


def _weak(cov: Float) -> tuple[str, ...]:
    """Names what the data leave to the prior, or cannot tell apart."""
    prior = np.sqrt(np.diag(prior_covariance()))
    sigma = np.sqrt(np.diag(cov))
    held = [n for n, s, p in zip(NAMES, sigma, prior, strict=True) if s > HELD_SHARE * p]
    messages = [f"left to the calibrated rig, for want of evidence: {', '.join(held)}"] if held else []
    correlation = cov[CLOCK, TWIST] / (sigma[CLOCK] * sigma[TWIST])
    worst = int(np.argmax(np.abs(correlation)))
    if abs(correlation[worst]) > ALIKE and sigma[CLOCK] > CLOCK_UNSURE * PRIOR_TIME_S:
        messages.append(f"clock and {NAMES[worst]} are hard to tell apart: the camera was carried evenly")
    return tuple(messages)


def _unchanged(camera: ThermalCamera, why: str, before: float = float("nan")) -> RigResult:
    """The scan's own rig, as uncertain as a calibrated rig that was handled since."""
    message = f"the rig is left alone: {why}"
    return RigResult(camera, before, before, prior_covariance(), float("nan"), False, False, 0, (message,))
