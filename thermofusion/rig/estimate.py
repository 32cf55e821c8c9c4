"""The rig's unknowns from outlines: robust Gauss-Newton on seven numbers and one nuisance, and how sure they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.patches import patches
from ..geometry.rigid import interpolate_trajectory, invert, se3_exp, se3_log
from ..robust import mad_sigma
from ..types import Camera, Float, ThermalCamera, Trajectory
from .outlines import MIN_POINTS, Contrast, OutlineView, measure_outline, reach_px, weights_about_median

# Where the unknowns stand in a parameter vector.
ROTATION, TRANSLATION, CLOCK, WIDTH = slice(0, 3), slice(3, 6), 6, 7
TWIST, RIG = slice(0, 6), slice(0, 7)
PARAMETERS = 8
NAMES = (*(f"{kind} {axis}" for kind in ("rotation", "translation") for axis in "xyz"), "clock")

REACH_DEG = (1.6, 1.0, 0.7) + (0.5,) * 9  # how far from the prediction an edge is looked for, by iteration
AT_REST = 0.1  # of a sigma: a smaller step ends the iterations
PRIOR_ROTATION_DEG = 0.7  # of a calibrated rig that was handled since
PRIOR_TRANSLATION_M = 0.004
PRIOR_TIME_S = 0.05
PRIOR_WIDTH_PX = 2.0
SYSTEMATIC_PX = 0.1  # errors of the model's outline that all views share (voxels, window): no average removes them
VELOCITY_STEP_S = 0.02
BLOCK_M = 0.06  # neighbouring outline this near shares the model's error


@dataclass(frozen=True, eq=False)
class State:
    """What is estimated: (4, 4) T_thermal_depth, the whole clock offset, s, and the outline's nuisance width, px."""

    T_thermal_depth: Float
    time_offset_s: float
    width_px: float = 0.0

    @classmethod
    def of(cls, camera: ThermalCamera) -> State:
        """The camera's own."""
        return cls(camera.T_thermal_depth, camera.time_offset_s)

    def moved(self, x: Float) -> State:
        """Moved by a parameter vector (8,): rad, m, s, px; the twist from the left."""
        T = se3_exp(x[TWIST]) @ self.T_thermal_depth
        return State(T, self.time_offset_s + x[CLOCK], self.width_px + x[WIDTH])

    def distance(self, start: State) -> Float:
        """The parameter vector (8,) that leads from `start` here: rad, m, s, px."""
        twist = se3_log(self.T_thermal_depth @ invert(start.T_thermal_depth))
        return np.array([*twist, self.time_offset_s - start.time_offset_s, self.width_px - start.width_px])


@dataclass(frozen=True, eq=False)
class Measured:
    """Residuals of all views' outline points, (n,) px, their derivatives (n, 8) by the unknowns, and what points share.

    view : (n,) their views. block : (n,) the cell of the body they lie in. point : (n,) which they are of all contour
    points of all views, one view after the other.
    """

    residual_px: Float
    jacobian: Float
    view: NDArray[np.intp]
    block: NDArray[np.intp]
    point: NDArray[np.intp]

    def part(self, mask: NDArray) -> Measured:
        """The points of a mask (n,)."""
        return Measured(**{k: getattr(self, k)[mask] for k in self.__dataclass_fields__})


@dataclass(frozen=True, eq=False)
class OutlineSet:
    """The outline in a set of thermal views, to be measured for any guess of the rig.

    times_s : (N,) the stream's own. motion : (N, 4, 4) of the thermal camera on the rig since the scan began; None: it
    stayed where it was.
    """

    lens: Camera
    trajectory: Trajectory
    views: tuple[OutlineView, ...]
    times_s: Float
    contrast: Contrast
    motion: Float | None = None

    def measure(self, state: State, reach: float) -> Measured:
        """Distances between model's and image's outline, edges looked for within `reach` px."""
        T_thermal_world, velocity = self._poses(state)
        residual, jacobian, place, point, first = [], [], [], [], 0
        for view, T, twist in zip(self.views, T_thermal_world, velocity, strict=True):
            m = measure_outline(self.lens, view, T, reach, self.contrast)
            residual.append(m.residual_px - state.width_px)
            jacobian.append(np.column_stack([m.motion, m.motion @ twist, np.ones(len(m.motion))]))
            place.append(view.contour.point_m[m.point])
            point.append(first + m.point)
            first += len(view.contour)
        index = np.repeat(np.arange(len(residual)), [len(r) for r in residual])
        block, _ = patches(np.concatenate(place), BLOCK_M)
        return Measured(np.concatenate(residual), np.concatenate(jacobian), index, block, np.concatenate(point))

    def later(self, dt_s: Float) -> OutlineSet:
        """With views taken later than stamped, dt_s (N,)."""
        return replace(self, times_s=self.times_s + dt_s)

    def knocked(self, motion: Float) -> OutlineSet:
        """With the thermal camera moved on the rig, (N, 4, 4) from the left of T_thermal_depth."""
        return replace(self, motion=motion)

    def part(self, views: NDArray[np.intp]) -> OutlineSet:
        """Some of the views, by number."""
        motion = None if self.motion is None else self.motion[views]
        return replace(self, views=tuple(self.views[i] for i in views), times_s=self.times_s[views], motion=motion)

    def twists(self, state: State) -> Float:
        """(N, 6) the world's twist in the thermal frame per second: rad/s, m/s."""
        return self._poses(state)[1]

    def poses(self, state: State) -> Float:
        """(N, 4, 4) T_thermal_world of the views."""
        return self._poses(state)[0]

    def residual_px(self, state: State) -> float:
        """Robust RMS residual over a fixed, wide reach, so that before and after compare; median (width) removed."""
        r = self.measure(state, reach_px(self.lens, REACH_DEG[0])).residual_px
        return mad_sigma(r - np.median(r)) if len(r) else float("nan")

    def shared_error(self) -> Float:
        """Covariance (7, 7), rad, m, s, of what `SYSTEMATIC_PX` does to the rig; the clock lives on differences."""
        z = float(np.median([v.range_m for v in self.views]))
        rotation = SYSTEMATIC_PX / self.lens.focal_px
        return np.diag([rotation**2] * 3 + [(rotation * z) ** 2] * 3 + [0.0])

    def _poses(self, state: State) -> tuple[Float, Float]:
        """T_thermal_world (N, 4, 4) of the views, and the world's twist in the thermal frame per second, (N, 6)."""
        times, h = self.times_s + state.time_offset_s, VELOCITY_STEP_S
        T_world_depth, _ = interpolate_trajectory(self.trajectory, np.concatenate([times, times - h, times + h]))
        T_thermal_world = state.T_thermal_depth @ invert(T_world_depth)
        if self.motion is not None:
            T_thermal_world = np.tile(self.motion, (3, 1, 1)) @ T_thermal_world
        now, before, after = np.split(T_thermal_world, 3)
        return now, se3_log(after @ invert(before)) / (2 * h)


@dataclass(frozen=True, eq=False)
class Stamps:
    """Times of views that jitter by sigma_s about their stamps: dt_s (N,) is what has been added to them already."""

    dt_s: Float
    sigma_s: float

    def free(self, m: Measured, weight: Float) -> tuple[Float, Float]:
        """What each view's own time takes of information (8, 8) and gradient (8,), of points' weights, px-2.

        Schur's complement of one unknown a view, whose prior is N(-dt, sigma²).
        """
        n, lever = len(self.dt_s), m.jacobian[:, CLOCK]
        shared = np.zeros((n, PARAMETERS))
        np.add.at(shared, m.view, (weight * lever)[:, None] * m.jacobian)
        own = np.bincount(m.view, weight * lever**2, n) + self.sigma_s**-2
        pull = np.bincount(m.view, weight * lever * m.residual_px, n) - self.dt_s * self.sigma_s**-2
        return shared.T @ (shared / own[:, None]), shared.T @ (pull / own)


@dataclass(frozen=True, eq=False)
class Solved:
    """The estimate, its covariance (8, 8), and the largest step of the last iteration, in sigmas."""

    state: State
    covariance: Float
    rest: float

    @property
    def converged(self) -> bool:
        """The iterations came to rest."""
        return self.rest < AT_REST


def prior_covariance() -> Float:
    """(7, 7) of a calibrated rig and its clock: rad, m, s."""
    return np.diag([np.radians(PRIOR_ROTATION_DEG) ** 2] * 3 + [PRIOR_TRANSLATION_M**2] * 3 + [PRIOR_TIME_S**2])


def solve(outlines: OutlineSet, start: State, stamps: Stamps | None = None) -> Solved | None:
    """Robust Gauss-Newton with the calibrated rig as prior, the reach of the search shrinking.

    stamps : where each view's time is unknown, too. None where too few points of the outline are found.
    """
    prior = np.diag(1 / np.append(np.diag(prior_covariance()), PRIOR_WIDTH_PX**2))
    state, solved = start, None
    for reach_deg in REACH_DEG:
        m = outlines.measure(state, reach_px(outlines.lens, reach_deg))
        if len(m.residual_px) < MIN_POINTS:
            return None
        weight, scale = weights_about_median(m.residual_px)
        information = m.jacobian.T @ (weight[:, None] * m.jacobian) / scale**2
        gradient = m.jacobian.T @ (weight * m.residual_px) / scale**2
        deflate = _design_effect(m, weight / scale**2, information)
        information, gradient = information / deflate, gradient / deflate
        if stamps is not None:
            taken = stamps.free(m, weight / scale**2 / deflate)
            information, gradient = information - taken[0], gradient - taken[1]
        step = np.linalg.solve(information + prior, gradient - prior @ state.distance(start))
        state = state.moved(np.asarray(step, np.float64))
        cov = np.asarray(np.linalg.inv(information + prior), np.float64)
        rest = float(np.max(np.abs(step) / np.sqrt(np.diag(cov))))
        solved = Solved(state, cov, rest)
        if reach_deg == REACH_DEG[-1] and rest < AT_REST:
            break
    return solved


def _design_effect(m: Measured, weight: Float, information: Float) -> float:
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
