"""Every view's six numbers from its outline, one view at a time: candidates are refined, judged, and made a walk of.

A view that was taken from in front and one from behind show nearly the same outline; what tells them apart is
perspective, once each is as good as it can be, and the walk: neighbouring frames were taken from neighbouring places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...geometry.outline import OutlineCaster, project_contour
from ...geometry.rigid import invert, rotation_angle_deg, se3_exp
from ...types import Camera, Float, Float32, SurfaceMesh
from ..outlines import (
    MIN_POINTS_OF_VIEW,
    Contrast,
    OutlineResidual,
    OutlineView,
    measure_outline,
    reach_px,
    weights_about_median,
)
from .limb import limb_shift_px

ROUGH_STEPS = 64  # rays across the image while a pose is rough
ROUGH_DEG = (6.0, 5.0, 4.0, 3.0, 2.0, 1.6)  # how far from the prediction an edge is looked for, by iteration
FINE_DEG = (1.6, 1.2, 0.8, 0.6, 0.5, 0.5)
INSIDE_PX = (3.0, 5.0, 8.0)  # of the outline, where its bend is read from the normals,
ALIKE_M = 0.03  # and neighbouring outline this near bends alike
STEP_ROTATION_DEG = 8.0  # prior of one step, one sigma: what the outline does not say stays
STEP_TRANSLATION_M = 0.15
FAULT_DEG = 0.6  # an outline point this far off counts as not explained,
FAULT_SHARE = 0.02  # or off by this share of the subject's extent in the image,
MIN_FAULT_PX = 1.5  # but no less
MAX_COST = 0.3  # share of unexplained outline above which a view is not placed
JUMP_COST = 0.25  # of a jump between neighbouring views
JUMP = 0.8  # rad, and distances in ranges: a change of place this large, or larger, is a jump
SHARES_RANGE = 1.0  # m: lever with which rotations and shifts are compared


@dataclass(frozen=True, eq=False)
class Images:
    """N thermal images for outlines: (H, W) from `smooth_image` each, and how the subject stands out of the room."""

    smooth: Sequence[Float32]
    contrast: Contrast


@dataclass(frozen=True, eq=False)
class Placed:
    """One view at one pose: T_world_thermal (4, 4); cost, share of the outline that is not explained."""

    T_world_thermal: Float
    cost: float


@dataclass(frozen=True, eq=False)
class OutlineFitter:
    """A mesh and a lens, prepared for placing views by their outlines."""

    mesh: SurfaceMesh
    lens: Camera
    images: Images
    _rough: OutlineCaster = field(init=False, repr=False)
    _fine: OutlineCaster = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_rough", OutlineCaster(self.mesh, self.lens, ROUGH_STEPS))
        object.__setattr__(self, "_fine", OutlineCaster(self.mesh, self.lens))

    def rough(self, row: int, T_world_thermal: Float) -> Placed:
        """From a start T_world_thermal (4, 4) that is degrees off."""
        return self._fit(row, T_world_thermal, ROUGH_DEG, self._rough)

    def fine(self, row: int, T_world_thermal: Float) -> Placed:
        """From a start T_world_thermal (4, 4) that is nearly right."""
        return self._fit(row, T_world_thermal, FINE_DEG, self._fine)

    def view(self, row: int, T_world_thermal: Float) -> OutlineView | None:
        """The view with the outline as seen from T_world_thermal (4, 4); None where too little of it is there."""
        return self._view(row, T_world_thermal, self._fine)

    def limb_px(self, view: OutlineView, T_world_thermal: Float) -> Float:
        """Where each point of a view's outline shows against where it is, (N,) px, seen from T_world_thermal (4, 4)."""
        seen = project_contour(self.lens, invert(T_world_thermal), view.contour)
        shifts = [
            limb_shift_px(self._fine.cosine(T_world_thermal, seen.uv_px - inside * seen.normal_px), inside)
            for inside in INSIDE_PX
        ]
        near = cKDTree(view.contour.point_m).query_ball_point(view.contour.point_m, ALIKE_M)
        shift = np.median(shifts, axis=0)
        return np.array([np.median(shift[n]) for n in near])

    def _view(self, row: int, T: Float, caster: OutlineCaster) -> OutlineView | None:
        contour = caster.contour(T)
        return OutlineView.of(row, self.images.smooth[row], contour, T) if len(contour) >= MIN_POINTS_OF_VIEW else None

    def _fit(self, row: int, T: Float, reaches_deg: tuple[float, ...], caster: OutlineCaster) -> Placed:
        prior = np.diag([np.radians(STEP_ROTATION_DEG) ** -2.0] * 3 + [STEP_TRANSLATION_M**-2.0] * 3)
        for reach_deg in reaches_deg:
            view = self._view(row, T, caster)
            if view is None:
                return Placed(T, 1.0)
            m = measure_outline(self.lens, view, invert(T), reach_px(self.lens, reach_deg), self.images.contrast)
            if len(m.residual_px) < MIN_POINTS_OF_VIEW:
                return Placed(T, 1.0)
            step = _step(m, prior, view.range_m)
            T = T @ invert(se3_exp(step))
        return Placed(T, self.cost(row, T, caster))

    def cost(self, row: int, T: Float, caster: OutlineCaster | None = None) -> float:
        """Share of the outline within the image that is not where T (4, 4), T_world_thermal, predicts it, 0..1."""
        view = self._view(row, T, caster or self._fine)
        if view is None:
            return 1.0
        uv = project_contour(self.lens, invert(T), view.contour).uv_px
        with np.errstate(invalid="ignore"):
            inside = ((uv > 4) & (uv < [self.lens.width_px - 5, self.lens.height_px - 5])).all(axis=1)
        n = int(inside.sum())
        if n < MIN_POINTS_OF_VIEW:
            return 1.0
        extent = 2 * float(np.sqrt(uv[inside].var(axis=0).sum()))
        fault = min(reach_px(self.lens, FAULT_DEG), max(MIN_FAULT_PX, FAULT_SHARE * extent))
        reach = 2 * reach_px(self.lens, FAULT_DEG)
        m = measure_outline(self.lens, view, invert(T), reach, self.images.contrast)
        off = np.ones(len(uv))
        off[m.point] = np.clip((m.residual_px / fault) ** 2, 0, 1)
        return float(off[inside].mean())


def _step(m: OutlineResidual, prior: Float, range_m: float) -> Float:
    """One robust step (6,) of the world in the camera's frame, damped."""
    weight, scale = weights_about_median(m.residual_px)
    J = m.motion @ about(range_m)
    A = J.T @ (weight[:, None] * J) / scale**2
    x = np.linalg.solve(A + prior, J.T @ (weight * m.residual_px) / scale**2)
    return np.asarray(about(range_m) @ x, np.float64)


def about(range_m: float) -> Float:
    """(6, 6): a twist about a point range_m in front of the camera as one about the camera; rad and m."""
    out = np.eye(6)
    out[3:, :3] = range_m * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return out


def walk_through(candidates: Sequence[Sequence[Placed]]) -> list[Placed]:
    """One candidate a view: little unexplained outline, and few jumps between views that follow each other."""
    total = [np.array([c.cost for c in candidates[0]])]
    came: list[NDArray[np.intp]] = []
    for before, now in pairwise(candidates):
        jump = np.array([[_jump(b.T_world_thermal, c.T_world_thermal) for b in before] for c in now])
        reach = total[-1][None] + JUMP_COST * jump
        came.append(reach.argmin(axis=1))
        total.append(reach.min(axis=1) + [c.cost for c in now])
    at = int(total[-1].argmin())
    chosen = [at]
    for back in reversed(came):
        chosen.append(int(back[chosen[-1]]))
    return [c[k] for c, k in zip(candidates, reversed(chosen), strict=True)]


def _jump(T_a: Float, T_b: Float) -> float:
    """How far two views lie apart, 0 together to 1 a jump."""
    angle = np.radians(float(rotation_angle_deg(invert(T_a) @ T_b)))
    shift = float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])) / SHARES_RANGE
    return min(1.0, max(angle, shift) / JUMP)
