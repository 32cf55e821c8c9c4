"""Small rigid corrections of single thermal views: breathing, sway, and what tracking left.

A person does not stand still to the millimetre, and a fused surface is a mean over the walk. Where the outline of one
view stands beside the model's, a motion of a few millimetres brings them together. Each view's motion is held by a
prior, and the corrections are kept only if they predict outline they have not seen: the body is cut into blocks,
alternate blocks are left out, and the fitted motion must bring *their* outline nearer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.patches import patches
from ..geometry.rigid import invert, se3_exp
from ..motion.body import BodyMotion, Standing
from ..progress import Progress, silent
from ..rig.outlines import OutlineResidual, OutlineView, measure_outline, reach_px, read_outlines, weights_about_median
from ..robust import mad_sigma
from ..types import Bool, Float, SurfaceMesh, ThermalStream, ThermalViews

PRIOR_ROTATION_DEG = 0.15
PRIOR_TRANSLATION_M = 0.004  # breathing and sway of a standing person
REACH_DEG = 0.5
ITERATIONS = 4  # of the robust weights
BLOCK_M = 0.15  # left out whole: neighbouring outline shares the model's local error
MIN_POINTS_OF_FIT = 40
CORRELATED_POINTS = 8.0  # neighbouring points of an outline share the model's error: so many count as one
MIN_GAIN = 0.05  # share by which the left-out residual must fall


@dataclass(frozen=True, eq=False)
class MotionResult:
    """Poses of the thermal views, corrected where that is kept.

    T_world_thermal : (N, 4, 4), the views' own if not `kept`. correction_mm, correction_deg : (N,) size of what was
    fitted (at the subject's distance, and in angle), 0 where a view shows too little.
    residual_px_before, _after : robust RMS distance between outlines in blocks left out of the fit, over all views.
    """

    T_world_thermal: Float
    correction_mm: Float
    correction_deg: Float
    residual_px_before: float
    residual_px_after: float
    views_fitted: int
    kept: bool
    messages: tuple[str, ...] = ()


def view_corrections(
    stream: ThermalStream,
    mesh: SurfaceMesh,
    views: ThermalViews,
    width_px: float = float("nan"),
    body: BodyMotion | None = None,
    *,
    progress: Progress = silent,
) -> MotionResult:
    """A small rigid correction of every thermal view against the model's outline, if it predicts left-out outline.

    Parameters
    ----------
    views : the aligned views. width_px : of the outline, common to all views (`rig`); NaN: its median is used.
    body : how the subject moved.

    Raises ScanError for an image that cannot be read.
    """
    camera = stream.camera.lens
    poses = views.T_world_thermal
    outlines, contrast = read_outlines(
        stream,
        Standing(mesh, body, views.times_s),
        views.frame.tolist(),
        poses,
        lambda _, done, total: progress("mapping", done, total),
    )
    if contrast is None:
        return _none(views, "the outline does not stand out from the background in the thermal images")
    T_thermal_world = invert(views.T_world_thermal)
    reach = reach_px(camera, REACH_DEG)
    seen = [measure_outline(camera, v, T_thermal_world[v.row], reach, contrast) for v in outlines]
    if not np.isfinite(width_px):  # no motion, and not to be explained by one
        width_px = float(np.median(np.concatenate([m.residual_px for m in seen])))
    motion_of = np.zeros((len(views), 6))
    before, after = [], []
    for view, first in zip(outlines, seen, strict=True):
        about, black = _about(view.range_m), _black_blocks(view, first)
        for left in (black, ~black):
            x = _fit(first, about, width_px, ~left)
            if x is not None:
                before.append(first.residual_px[left] - width_px)
                after.append(before[-1] - first.motion[left] @ about @ x)
        x = _fit(first, about, width_px)
        if x is not None:
            T = se3_exp(about @ x) @ T_thermal_world[view.row]
            again = _fit(measure_outline(camera, view, T, reach, contrast), about, width_px, start=x)
            motion_of[view.row] = x if again is None else again
    return _decide(views, outlines, motion_of, _spread(before), _spread(after))


def _black_blocks(view: OutlineView, seen: OutlineResidual) -> Bool:
    """One colour of a 3-D checkerboard over the body, for the outline points that were found."""
    return patches(view.contour.point_m[seen.point], BLOCK_M)[1]


def _fit(
    seen: OutlineResidual, about: Float, width_px: float, use: Bool | None = None, start: Float | None = None
) -> Float | None:
    """Motion (6,) of the subject about itself by the chosen points, held by the prior; None where they are too few.

    start : the motion at which `seen` was measured.
    """
    use = np.ones(len(seen.residual_px), bool) if use is None else use
    start = np.zeros(6) if start is None else start
    if use.sum() < MIN_POINTS_OF_FIT:
        return None
    prior = np.diag([np.radians(PRIOR_ROTATION_DEG) ** -2.0] * 3 + [PRIOR_TRANSLATION_M**-2.0] * 3)
    local = seen.motion[use] @ about
    target = seen.residual_px[use] - width_px + local @ start
    x = start
    for _ in range(ITERATIONS):
        weight, scale = weights_about_median(target - local @ x)
        weight = weight / (scale**2 * CORRELATED_POINTS)
        x = np.asarray(
            np.linalg.solve(local.T @ (weight[:, None] * local) + prior, local.T @ (weight * target)), np.float64
        )
    return x


def _about(range_m: float) -> Float:
    """(6, 6): a twist about a point `range_m` in front of the camera as a twist about the camera."""
    out = np.eye(6)
    # Turning by w about c moves the camera's origin by -w x c = c x w, c = (0, 0, z).
    out[3:, :3] = range_m * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return out


def _spread(parts: list[Float]) -> float:
    """Robust RMS, px; NaN without points."""
    r = np.concatenate(parts) if parts else np.zeros(0)
    return mad_sigma(r)


def _decide(
    views: ThermalViews, outlines: tuple[OutlineView, ...], motion_of: Float, before: float, after: float
) -> MotionResult:
    if not np.isfinite(before):
        return _none(views, "no view shows enough outline")
    size_mm, size_deg = (
        1e3 * np.linalg.norm(motion_of[:, 3:], axis=1),
        np.degrees(np.linalg.norm(motion_of[:, :3], axis=1)),
    )
    kept = after < (1 - MIN_GAIN) * before
    poses = views.T_world_thermal.copy()
    if kept:
        for view in outlines:
            poses[view.row] = poses[view.row] @ invert(se3_exp(_about(view.range_m) @ motion_of[view.row]))
    message = (
        f"motion: corrections of {np.median(size_mm):.1f} mm (largest {size_mm.max():.1f}) change the distance of "
        f"left-out outline from {before:.2f} to {after:.2f} px: {'kept' if kept else 'not kept'}"
    )
    fitted = int((motion_of != 0).any(1).sum())
    return MotionResult(poses, size_mm, size_deg, before, after, fitted, bool(kept), (message,))


def _none(views: ThermalViews, why: str) -> MotionResult:
    zero = np.zeros(len(views))
    return MotionResult(
        views.T_world_thermal, zero, zero, float("nan"), float("nan"), 0, False, (f"motion: not corrected, {why}",)
    )
