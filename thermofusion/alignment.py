"""The thermal camera's place on the rig and its clock, refined per scan from the subject's own outline.

Unknowns: six numbers of T_thermal_depth, the thermal clock's offset, and one nuisance, the width by which the image's
outline lies outside the model's (fused surfaces shrink or swell a little, emissivity falls towards the limb). The
measurements are distances between the model's outline and the image's edge along its normal; robust Gauss-Newton, with
the calibrated rig as start and prior.

A camera carried round the subject at constant speed moves along a constant twist ξ, and a clock wrong by dt is then
exactly a rig wrong by exp(-ξ dt): only unsteadiness and the prior tell the two apart. The covariance says how well.
It is widened for what the points of one view have in common (its pose error, the model's local error).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .errors import ScanError
from .geometry import interpolate_trajectory, invert, se3_exp, se3_log
from .radiometry import SignalConverter
from .recipe import Recipe
from .silhouettes import Contour, OutlineCaster, find_edges, project_contour, smooth_image
from .types import Camera, Float, Float32, Scan, SurfaceMesh, Trajectory

MAX_VIEWS = 30
MAX_POINTS = 400  # contour points used in a view
REACH_DEG = (1.6, 1.0, 0.7) + (0.5,) * 9  # how far from the prediction an edge is looked for, by iteration
AT_REST = 0.1  # of a sigma: a smaller step ends the iterations
MIN_REACH_PX = 3.0
PRIOR_ROTATION_DEG = 0.7  # of a calibrated rig that was handled since
PRIOR_TRANSLATION_M = 0.004
PRIOR_TIME_S = 0.05
PRIOR_WIDTH_PX = 2.0
SYSTEMATIC_PX = 0.1  # errors of the model's outline that all views share (voxels, window): no average removes them
VELOCITY_STEP_S = 0.02
MIN_STEP_NETD = 8.0  # an outline whose step is smaller than this many NETD shows nothing
MIN_STEP_SHARE = 0.4  # of the usual step: weaker ones are other things (hair, clothes, a warm background)
TUKEY = 4.685
HELD_SHARE = 0.7  # a sigma this near to its prior's is the prior's
MIN_SCALE_PX = 0.15
MIN_VIEWS = 6
MIN_POINTS = 200
SUPPORT_CHI2 = 24.3  # 99.9 % of chi-square with 7 degrees of freedom: below it the data do not ask for a change
PARAMETERS = 8

Progress = Callable[[str, int, int], None]


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
    start = _calibrated(scan)
    if not recipe.crosscal.align:
        return _unchanged(start, "alignment is switched off by the recipe")
    views = _prepare(scan, mesh, trajectory, start, recipe.input.max_pose_gap_ms / 1e3, progress)
    if views is None:
        return _unchanged(start, f"fewer than {MIN_VIEWS} thermal views show an outline that could be used")
    contrast = views.contrast()
    if contrast is None:
        return _unchanged(start, "the outline does not stand out from the background in the thermal images")
    return _refine(views, start, contrast)


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
class _View:
    time_s: float  # the thermal frame's own
    smooth: Float32
    contour: Contour
    range_m: float  # median


@dataclass(frozen=True, eq=False)
class _Measured:
    """Residuals [px] of all views' contour points, their derivatives by the eight parameters, and their views."""

    residual_px: Float
    jacobian: Float
    view: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Contrast:
    """sign : body minus background. step : usual height of the outline's step, in-band radiance."""

    sign: float
    step: float


@dataclass(frozen=True, eq=False)
class _Views:
    camera: Camera
    trajectory: Trajectory
    views: tuple[_View, ...]
    start: _State
    noise: float  # NETD in in-band radiance

    def contrast(self) -> _Contrast | None:
        """How the outline shows in the images; None if it does not."""
        reach = _reach_px(self.camera, REACH_DEG[0])
        T_thermal_world, _ = self._poses(self.start)
        outlines = [
            project_contour(self.camera, T, v.contour) for T, v in zip(T_thermal_world, self.views, strict=True)
        ]
        step = [find_edges(v.smooth, o, reach, 0.0).step for o, v in zip(outlines, self.views, strict=True)]
        found = np.concatenate(step)
        found = found[np.isfinite(found)]
        if len(found) < MIN_POINTS or abs(np.median(found)) < MIN_STEP_NETD * self.noise:
            return None
        return _Contrast(float(np.sign(np.median(found))), float(abs(np.median(found))))

    def measure(self, state: _State, reach_px: float, contrast: _Contrast) -> _Measured:
        T_thermal_world, velocity = self._poses(state)
        residual, jacobian = [], []
        for i, view in enumerate(self.views):
            outline = project_contour(self.camera, T_thermal_world[i], view.contour)
            edges = find_edges(view.smooth, outline, reach_px, contrast.sign)
            step = contrast.sign * edges.step / contrast.step
            with np.errstate(invalid="ignore"):
                good = np.isfinite(edges.offset_px) & (step > MIN_STEP_SHARE) & (step < 1 / MIN_STEP_SHARE)
            along = outline.px_per_m[good]
            motion = np.concatenate([np.cross(outline.point_m[good], along), along], axis=1)  # along · (ω x p + v)
            residual.append(edges.offset_px[good] - state.width_px)
            jacobian.append(np.column_stack([motion, motion @ velocity[i], np.ones(len(motion))]))
        index = np.repeat(np.arange(len(residual)), [len(r) for r in residual])
        return _Measured(np.concatenate(residual), np.concatenate(jacobian), index)

    def _poses(self, state: _State) -> tuple[Float, Float]:
        """T_thermal_world (N, 4, 4) of the views, and the world's twist in the thermal frame per second, (N, 6)."""
        times = np.array([v.time_s for v in self.views]) + state.time_offset_s
        h = VELOCITY_STEP_S
        T_world_depth, _ = interpolate_trajectory(self.trajectory, np.concatenate([times, times - h, times + h]))
        now, before, after = np.split(state.T_thermal_depth @ invert(T_world_depth), 3)
        return now, se3_log(after @ invert(before)) / (2 * h)


def _reach_px(camera: Camera, reach_deg: float) -> float:
    return max(MIN_REACH_PX, float(np.radians(reach_deg)) * camera.focal_px)


def _calibrated(scan: Scan) -> _State:
    if scan.thermal is None or scan.rig.thermal is None or scan.rig.T_thermal_depth is None or scan.sensor is None:
        raise ScanError("the scan has no thermal stream", place=scan.root, hint="there is nothing to align")
    return _State(scan.rig.T_thermal_depth, scan.sensor.time_offset_s)


def _prepare(
    scan: Scan,
    mesh: SurfaceMesh,
    trajectory: Trajectory,
    start: _State,
    max_gap_s: float,
    progress: Progress | None,
) -> _Views | None:
    """Smoothed images and outlines of evenly chosen views whose poses are known a little before and after, too."""
    stream, camera, sensor = scan.thermal, scan.rig.thermal, scan.sensor
    if stream is None or camera is None or sensor is None:
        return None
    times = stream.times_s + start.time_offset_s
    placed = stream.usable.copy()
    for shift in (-2 * PRIOR_TIME_S, 0.0, 2 * PRIOR_TIME_S):
        placed &= interpolate_trajectory(trajectory, times + shift, max_gap_s=max_gap_s)[1]
    frames = np.flatnonzero(placed)
    if len(frames) > MAX_VIEWS:
        frames = frames[np.round(np.linspace(0, len(frames) - 1, MAX_VIEWS)).astype(int)]
    T_world_depth, _ = interpolate_trajectory(trajectory, times[frames])
    converter, caster = SignalConverter(sensor), OutlineCaster(mesh, camera)
    views: list[_View] = []
    level: list[float] = []
    for i, frame in enumerate(frames):
        contour = caster.contour(T_world_depth[i] @ invert(start.T_thermal_depth))
        if len(contour) >= MIN_POINTS // MIN_VIEWS:
            every = -(-len(contour) // MAX_POINTS)
            radiance = converter.radiance(stream.load(int(frame)), stream.places[frame])
            level.append(float(np.nanmedian(radiance)))
            thinned = Contour(contour.point_m[::every], contour.normal[::every])
            range_m = float(np.median(np.linalg.norm(thinned.point_m - T_world_depth[i, :3, 3], axis=1)))
            views.append(_View(float(stream.times_s[frame]), smooth_image(radiance), thinned, range_m))
        if progress:
            progress("align", i + 1, len(frames))
    if len(views) < MIN_VIEWS:
        return None
    band = converter.band
    noise = sensor.netd_K * float(band.d_radiance_dT(band.temperature_K(np.median(level))))
    return _Views(camera, trajectory, tuple(views), start, noise)


# ---------------------------------------------------------------- the estimate


@dataclass(frozen=True, eq=False)
class _Solved:
    state: _State
    covariance: Float  # (8, 8)
    scale_px: float
    points: int
    rest: float  # largest step of the last iteration, in sigmas


def _refine(views: _Views, start: _State, contrast: _Contrast) -> AlignmentResult:
    before = _summary_px(views, start, contrast)
    solved = _solve(views, start, contrast)
    if solved is None:
        return _unchanged(start, "too few points of the outline were found in the thermal images", before)
    after = _summary_px(views, solved.state, contrast)
    change = solved.state.distance(start)[:7]
    cov = solved.covariance[:7, :7] + _shared_error(views)
    chi2 = float(change @ np.linalg.solve(cov, change))
    supported = chi2 > SUPPORT_CHI2 and after < before
    converged = solved.rest < AT_REST
    angle, shift = np.degrees(np.linalg.norm(change[:3])), 1e3 * np.linalg.norm(change[3:6])
    found = f"rig {angle:.2f}° and {shift:.1f} mm, clock {1e3 * change[6]:+.1f} ms from the scan's own"
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


def _solve(views: _Views, start: _State, contrast: _Contrast) -> _Solved | None:
    """Robust Gauss-Newton with the calibrated rig as prior, the reach of the search shrinking."""
    prior = np.diag(1 / np.append(np.diag(_prior_covariance()), PRIOR_WIDTH_PX**2))
    state, solved = start, None
    for reach_deg in REACH_DEG:
        m = views.measure(state, _reach_px(views.camera, reach_deg), contrast)
        if len(m.residual_px) < MIN_POINTS:
            return None
        weight, scale = _tukey(m.residual_px)
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


def _tukey(residual: Float) -> tuple[Float, float]:
    """Tukey's biweights about the median (a common offset is the estimate's business), and the robust scale."""
    scale = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), MIN_SCALE_PX)
    u = (residual - np.median(residual)) / (TUKEY * scale)
    return np.where(np.abs(u) < 1, (1 - u * u) ** 2, 0.0), scale


def _design_effect(m: _Measured, weight: Float, information: Float) -> float:
    """How many times fewer independent measurements there are than points (>= 1).

    The points of one view share its pose error and the model's local error. The spread of the views' score vectors,
    over what independent points would give (Liang & Zeger 1986, averaged over the parameters), measures it.
    """
    fitted = (
        m.residual_px
        - m.jacobian
        @ np.linalg.lstsq(np.sqrt(weight)[:, None] * m.jacobian, np.sqrt(weight) * m.residual_px, rcond=None)[0]
    )
    score = np.zeros((m.view.max() + 1, PARAMETERS))
    np.add.at(score, m.view, m.jacobian * (weight * fitted)[:, None])
    n = len(score)
    spread = score.T @ score * n / max(n - PARAMETERS, 1)
    return max(1.0, float(np.trace(np.linalg.lstsq(information, spread, rcond=None)[0])) / PARAMETERS)


def _summary_px(views: _Views, state: _State, contrast: _Contrast) -> float:
    """Robust RMS residual over a fixed, wide reach, so that before and after compare; median (width) removed."""
    r = views.measure(state, _reach_px(views.camera, REACH_DEG[0]), contrast).residual_px
    return float(1.4826 * np.median(np.abs(r - np.median(r)))) if len(r) else float("nan")


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
