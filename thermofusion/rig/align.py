"""The thermal camera's place on the rig and its clock, refined per scan from the subject's own outline.

Unknowns: six numbers of T_thermal_depth, the thermal clock's offset, and one nuisance, the width by which the image's
outline lies outside the model's (fused surfaces shrink or swell a little, emissivity falls towards the limb). The
measurements are distances between the model's outline and the image's edge along its normal; robust Gauss-Newton, with
the calibrated rig as start and prior.

A camera carried round the subject at constant speed moves along a constant twist ξ, and a clock wrong by dt is then
exactly a rig wrong by exp(-ξ dt): only unsteadiness and the prior tell the two apart. The covariance says how well.
It is widened for what the points of one view have in common (its pose error), and those of one place of the body (the
model's error there).

The skin's own pattern, compared between views, was tried as further evidence and is not used: on smooth skin it says
twenty times less than the outline, and emissivity's fall with angle looks like a shift. Whether views agree after the
alignment is seen where they are calibrated against each other (`crosscal`) and where views are left out (`validate`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..geometry.rigid import interpolate_trajectory, invert, se3_exp, se3_log
from ..progress import Progress
from ..recipe import Recipe
from ..robust import mad_sigma
from ..types import Camera, Float, Scan, Stream, SurfaceMesh, Trajectory
from .outlines import (
    MIN_POINTS,
    Contrast,
    OutlineView,
    measure_outline,
    reach_px,
    read_outlines,
    search_shift,
    weights_about_median,
)

MAX_VIEWS = 30
REACH_DEG = (1.6, 1.0, 0.7) + (0.5,) * 9  # how far from the prediction an edge is looked for, by iteration
AT_REST = 0.1  # of a sigma: a smaller step ends the iterations
PRIOR_ROTATION_DEG = 0.7  # of a calibrated rig that was handled since
PRIOR_TRANSLATION_M = 0.004
PRIOR_TIME_S = 0.05
PRIOR_WIDTH_PX = 2.0
SYSTEMATIC_PX = 0.1  # errors of the model's outline that all views share (voxels, window): no average removes them
VELOCITY_STEP_S = 0.02
HELD_SHARE = 0.7  # a sigma this near to its prior's is the prior's
BLOCK_M = 0.06  # neighbouring outline this near shares the model's error
MIN_VIEWS = 6
SUPPORT_CHI2 = 24.3  # 99.9 % of chi-square with 7 degrees of freedom: below it the data do not ask for a change
PARAMETERS = 8


@dataclass(frozen=True, eq=False)
class AlignmentResult:
    """The thermal camera's place and clock, and how sure they are.

    T_thermal_depth : (4, 4). time_offset_s : added to a thermal frame's own time (replaces the sensor's).
    residual_px_before, _after : robust RMS distance between the model's outline and the image's, NaN if not measured.
    covariance : (7, 7) of rotation vector [rad], translation [m] (left perturbation of T_thermal_depth) and time [s].
    outline_width_px : by how much the image's outline lies outside the model's (nuisance, not applied).
    changed : False = rig and clock are the scan's own. converged : the refinement came to rest.
    """

    T_thermal_depth: Float
    time_offset_s: float
    residual_px_before: float
    residual_px_after: float
    covariance: Float
    sigma_rotation_deg: float
    sigma_translation_mm: float
    sigma_time_s: float
    outline_width_px: float
    changed: bool
    converged: bool
    views_used: int
    points_used: int
    messages: tuple[str, ...] = ()


def align_thermal(
    scan: Scan, mesh: SurfaceMesh, trajectory: Trajectory, recipe: Recipe, *, progress: Progress | None = None
) -> AlignmentResult:
    """Refine T_thermal_depth and the thermal time offset of a scan; leave them where the data do not support a change.

    Parameters
    ----------
    mesh : the fused surface, world frame. trajectory : T_world_depth on the depth clock.
    progress : called with ("align", views read, views in all).

    Raises ScanError if the scan has no thermal stream, or an image cannot be read.
    """
    stream = scan.thermal
    if stream is None:
        raise ScanError("the scan has no thermal stream", place=scan.root, hint="there is nothing to align")
    camera, start = stream.camera.lens, _State(stream.camera.T_thermal_depth, stream.camera.time_offset_s)
    if not recipe.crosscal.align:
        return _unchanged(start, "alignment is switched off by the recipe")
    frames = _frames(stream, trajectory, start, recipe.input.max_pose_gap_ms / 1e3)
    T_world_depth, _ = interpolate_trajectory(trajectory, stream.times_s[frames] + start.time_offset_s)
    report = None if progress is None else partial(progress, "align")
    T_world_thermal = T_world_depth @ invert(start.T_thermal_depth)
    outlines, contrast = read_outlines(stream, mesh, frames.tolist(), T_world_thermal, report)
    if len(outlines) < MIN_VIEWS:
        return _unchanged(start, f"fewer than {MIN_VIEWS} thermal views show an outline that could be used")
    begin = start
    if contrast is None:  # nothing where it should be: perhaps the rig is off by degrees
        shift = search_shift(camera, outlines, invert(T_world_thermal))
        if shift is not None:
            rotation = shift[::-1] / camera.focal_px * [-1, 1]
            begin = start.moved(np.concatenate([rotation, np.zeros(6)]))
            T_world_thermal = T_world_depth @ invert(begin.T_thermal_depth)
            outlines, contrast = read_outlines(stream, mesh, frames.tolist(), T_world_thermal, report)
    if contrast is None or len(outlines) < MIN_VIEWS:
        return _unchanged(start, "the outline does not stand out from the background in the thermal images")
    times_s = stream.times_s[frames[[v.row for v in outlines]]]
    result = _refine(_Views(camera, trajectory, outlines, times_s, contrast), begin)
    if begin is start:
        return result
    if not result.converged:
        return _unchanged(start, "the outline was found far from where the rig says, but did not come to rest there")
    found = _State(result.T_thermal_depth, result.time_offset_s)
    text = f"{_described(found.distance(start)[:7])}: calibrate it again"
    return replace(result, changed=True, messages=(text, *result.messages[1:]))


# ---------------------------------------------------------------- the measurements


@dataclass(frozen=True, eq=False)
class _State:
    """What is estimated. time_offset_s is the whole offset; width_px the nuisance."""

    T_thermal_depth: Float
    time_offset_s: float
    width_px: float = 0.0

    def moved(self, x: Float) -> _State:
        return _State(se3_exp(x[:6]) @ self.T_thermal_depth, self.time_offset_s + x[6], self.width_px + x[7])

    def distance(self, start: _State) -> Float:
        """The eight numbers that lead from `start` here."""
        twist = se3_log(self.T_thermal_depth @ invert(start.T_thermal_depth))
        return np.array([*twist, self.time_offset_s - start.time_offset_s, self.width_px - start.width_px])


@dataclass(frozen=True, eq=False)
class _Measured:
    """Residuals [px] of all views' contour points, their derivatives by the eight parameters, and what points share.

    view : (n,) their views. block : (n,) the cell of the body they lie in.
    """

    residual_px: Float
    jacobian: Float
    view: NDArray[np.intp]
    block: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Views:
    camera: Camera
    trajectory: Trajectory
    views: tuple[OutlineView, ...]
    times_s: Float  # of the views, the thermal stream's own
    contrast: Contrast

    def measure(self, state: _State, reach: float) -> _Measured:
        T_thermal_world, velocity = self._poses(state)
        residual, jacobian, cell = [], [], []
        for view, T, twist in zip(self.views, T_thermal_world, velocity, strict=True):
            m = measure_outline(self.camera, view, T, reach, self.contrast)
            residual.append(m.residual_px - state.width_px)
            jacobian.append(np.column_stack([m.motion, m.motion @ twist, np.ones(len(m.motion))]))
            cell.append(np.floor(view.contour.point_m[m.point] / BLOCK_M).astype(np.int64))
        index = np.repeat(np.arange(len(residual)), [len(r) for r in residual])
        block = np.unique(np.concatenate(cell) @ [1_000_003, 1_009, 1], return_inverse=True)[1]
        return _Measured(np.concatenate(residual), np.concatenate(jacobian), index, block)

    def _poses(self, state: _State) -> tuple[Float, Float]:
        """T_thermal_world (N, 4, 4) of the views, and the world's twist in the thermal frame per second, (N, 6)."""
        times, h = self.times_s + state.time_offset_s, VELOCITY_STEP_S
        T_world_depth, _ = interpolate_trajectory(self.trajectory, np.concatenate([times, times - h, times + h]))
        now, before, after = np.split(state.T_thermal_depth @ invert(T_world_depth), 3)
        return now, se3_log(after @ invert(before)) / (2 * h)


def _frames(stream: Stream, trajectory: Trajectory, start: _State, max_gap_s: float) -> NDArray[np.intp]:
    """Thermal frames chosen evenly among those whose poses are known a little before and after, too."""
    placed = stream.usable.copy()
    for shift in (-2 * PRIOR_TIME_S, 0.0, 2 * PRIOR_TIME_S):
        times = stream.times_s + start.time_offset_s + shift
        placed &= interpolate_trajectory(trajectory, times, max_gap_s=max_gap_s)[1]
    frames = np.flatnonzero(placed)
    if len(frames) > MAX_VIEWS:
        frames = frames[np.round(np.linspace(0, len(frames) - 1, MAX_VIEWS)).astype(int)]
    return frames


# ---------------------------------------------------------------- the estimate


@dataclass(frozen=True, eq=False)
class _Solved:
    state: _State
    covariance: Float  # (8, 8)
    scale_px: float
    points: int
    rest: float  # largest step of the last iteration, in sigmas


def _refine(views: _Views, start: _State) -> AlignmentResult:
    before = _summary_px(views, start)
    solved = _solve(views, start)
    if solved is None:
        return _unchanged(start, "too few points of the outline were found in the thermal images", before)
    after = _summary_px(views, solved.state)
    change = solved.state.distance(start)[:7]
    cov = solved.covariance[:7, :7] + _shared_error(views)
    chi2 = float(change @ np.linalg.solve(cov, change))
    supported = chi2 > SUPPORT_CHI2 and after < before
    converged = solved.rest < AT_REST
    found = _described(change)
    result = AlignmentResult(
        solved.state.T_thermal_depth,
        solved.state.time_offset_s,
        before,
        after,
        cov,
        sigma_rotation_deg=float(np.degrees(np.sqrt(np.linalg.eigvalsh(cov[:3, :3])[-1]))),
        sigma_translation_mm=float(1e3 * np.sqrt(np.linalg.eigvalsh(cov[3:6, 3:6])[-1])),
        sigma_time_s=float(np.sqrt(cov[6, 6])),
        outline_width_px=solved.state.width_px,
        changed=True,
        converged=converged,
        views_used=len(views.views),
        points_used=solved.points,
        messages=(found, *_weak(cov)),
    )
    if supported and converged:
        return result
    why = "did not come to rest" if not converged else "is within what chance would give"
    return replace(
        result,
        T_thermal_depth=start.T_thermal_depth,
        time_offset_s=start.time_offset_s,
        residual_px_after=before,
        changed=False,
        messages=(f"the rig is left alone: a change ({found}) {why}",),
    )


def _described(change: Float) -> str:
    """The seven numbers of a change for people."""
    angle, shift = np.degrees(np.linalg.norm(change[:3])), 1e3 * np.linalg.norm(change[3:6])
    return f"rig {angle:.2f}° and {shift:.1f} mm, clock {1e3 * change[6]:+.1f} ms from the scan's own"


def _solve(views: _Views, start: _State) -> _Solved | None:
    """Robust Gauss-Newton with the calibrated rig as prior, the reach of the search shrinking."""
    prior = np.diag(1 / np.append(np.diag(_prior_covariance()), PRIOR_WIDTH_PX**2))
    state, solved = start, None
    for reach_deg in REACH_DEG:
        m = views.measure(state, reach_px(views.camera, reach_deg))
        if len(m.residual_px) < MIN_POINTS:
            return None
        weight, scale = weights_about_median(m.residual_px)
        information = m.jacobian.T @ (weight[:, None] * m.jacobian) / scale**2
        gradient = m.jacobian.T @ (weight * m.residual_px) / scale**2
        deflate = _design_effect(m, weight / scale**2, information)
        information, gradient = information / deflate, gradient / deflate
        step = np.linalg.solve(information + prior, gradient - prior @ state.distance(start))
        state = state.moved(np.asarray(step, np.float64))
        cov = np.asarray(np.linalg.inv(information + prior), np.float64)
        rest = float(np.max(np.abs(step) / np.sqrt(np.diag(cov))))
        solved = _Solved(state, cov, scale, int((weight > 0).sum()), rest)
        if reach_deg == REACH_DEG[-1] and rest < AT_REST:
            break
    return solved


def _design_effect(m: _Measured, weight: Float, information: Float) -> float:
    """How many times fewer independent measurements there are than points (>= 1).

    The points of one view share its pose error, those of one place of the body share the model's error there. The
    spread of the views' and of the places' score vectors, over what independent points would give, measures both
    (two-way clusters: Cameron, Gelbach & Miller 2011; averaged over the parameters).
    """
    root = np.sqrt(weight)[:, None]
    fit = np.linalg.lstsq(root * m.jacobian, root[:, 0] * m.residual_px, rcond=None)[0]
    point = m.jacobian * (weight * (m.residual_px - m.jacobian @ fit))[:, None]

    def effect(group: NDArray[np.intp]) -> float:
        score = np.zeros((group.max() + 1, PARAMETERS))
        np.add.at(score, group, point)
        n = len(score)
        spread = score.T @ score * n / max(n - PARAMETERS, 1)
        return float(np.trace(np.linalg.lstsq(information, spread, rcond=None)[0])) / PARAMETERS

    return max(1.0, effect(m.view) + effect(m.block) - 1.0)


def _summary_px(views: _Views, state: _State) -> float:
    """Robust RMS residual over a fixed, wide reach, so that before and after compare; median (width) removed."""
    r = views.measure(state, reach_px(views.camera, REACH_DEG[0])).residual_px
    return mad_sigma(r - np.median(r)) if len(r) else float("nan")


def _shared_error(views: _Views) -> Float:
    """Covariance (7, 7) of what `SYSTEMATIC_PX` does to the rig; the clock lives on differences between views."""
    z = float(np.median([v.range_m for v in views.views]))
    rotation = SYSTEMATIC_PX / views.camera.focal_px
    return np.diag([rotation**2] * 3 + [(rotation * z) ** 2] * 3 + [0.0])


def _weak(cov: Float) -> tuple[str, ...]:
    """Names what the data leave to the prior, or cannot tell apart."""
    name = [f"{kind} {axis}" for kind in ("rotation", "translation") for axis in "xyz"] + ["clock"]
    prior = np.sqrt(np.diag(_prior_covariance()))
    sigma = np.sqrt(np.diag(cov))
    held = [n for n, s, p in zip(name, sigma, prior, strict=True) if s > HELD_SHARE * p]
    messages = [f"left to the calibrated rig, for want of evidence: {', '.join(held)}"] if held else []
    correlation = cov[6, :6] / (sigma[6] * sigma[:6])
    worst = int(np.argmax(np.abs(correlation)))
    if abs(correlation[worst]) > 0.9 and sigma[6] > 0.1 * PRIOR_TIME_S:
        messages.append(f"clock and {name[worst]} are hard to tell apart: the camera was carried evenly")
    return tuple(messages)


def _prior_covariance() -> Float:
    """(7, 7) of a calibrated rig and its clock."""
    return np.diag([np.radians(PRIOR_ROTATION_DEG) ** 2] * 3 + [PRIOR_TRANSLATION_M**2] * 3 + [PRIOR_TIME_S**2])


def _unchanged(start: _State, why: str, before: float = float("nan")) -> AlignmentResult:
    return AlignmentResult(
        start.T_thermal_depth,
        start.time_offset_s,
        before,
        before,
        _prior_covariance(),
        PRIOR_ROTATION_DEG,
        1e3 * PRIOR_TRANSLATION_M,
        PRIOR_TIME_S,
        outline_width_px=float("nan"),
        changed=False,
        converged=False,
        views_used=0,
        points_used=0,
        messages=(f"the rig is left alone: {why}",),
    )
