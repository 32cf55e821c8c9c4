"""A finished result's problem solved again in parts: maps without some views, and what the others should have read."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError, counted
from ..mapping.observe import Mapped
from ..physics.band import ZERO_DEGC_K
from ..physics.emissivity import EmissivityModel
from ..physics.equation import apparent_radiance, with_gain
from ..progress import Progress
from ..recipe import Recipe
from ..robust import weighted_quantile
from ..surface.surface import SurfaceResult
from ..temperature.blend import BlendResult, blend
from ..temperature.crosscal import Calibration, Overlap, calibrate
from ..temperature.problem import ThermalProblem
from ..temperature.solve import Temperature
from ..temperature.uncertainty import BILINEAR_VARIANCE, AngleTables, observation_variance, skin_slope
from ..types import Bool, Float, Float32, Int, Observations, Scan, VertexFlag

WELL_SEEN_DEG = 60.0  # a map's error is stated for surface that two views saw straighter than this
WELL_SEEN_COS = np.float32(np.cos(np.radians(WELL_SEEN_DEG)))
ANGLE_CORRECTED = ("joint", "corrected-cos")


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Left-out readings: measured minus predicted residual_K and its predicted sigma_K, at angle_deg, in view; (N,)."""

    residual_K: Float
    sigma_K: Float
    angle_deg: Float32
    view: Int

    @classmethod
    def joined(cls, parts: list[LeftOut]) -> LeftOut:
        """Several parts, one after the other."""
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in cls.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Bench:
    """The problem of a finished result, to be solved again in parts.

    well_seen : (V,) two views had the vertex in sight under 60°, near outlines or not.
    """

    problem: ThermalProblem
    well_seen: Bool

    @classmethod
    def of(cls, scan: Scan, surface: SurfaceResult, mapped: Mapped, temperature: Temperature, recipe: Recipe) -> Bench:
        """All vertices of a finished result. Raises ScanError where there are too few views to leave any out."""
        rows = mapped.observations
        views = len(np.unique(rows.view))
        if views < 3:
            raise ScanError(
                f"only {counted(views, 'thermal view')} of the surface: too few to leave any out", place=scan.root
            )
        mesh = surface.mesh
        sections = recipe.mapping, recipe.temperature
        problem = ThermalProblem.of(scan, mesh, surface.normal_window_m, mapped, *sections)
        if temperature.room is not None:
            problem = problem.in_room(temperature.room, mapped.views)
        skin_K = temperature.absolute_degC.astype(np.float64) + ZERO_DEGC_K
        well_seen = np.bincount(rows.vertex[rows.cos_angle > WELL_SEEN_COS], minlength=len(mesh)) >= 2
        other = (temperature.mesh.flags & VertexFlag.NOT_SKIN) > 0
        return cls(problem.informed(mesh, skin_K).without(other), well_seen)

    def sample(self, size: int) -> Bench:
        """An even sample of some `size` of the vertices that were seen."""
        problem = self.problem.sample(size)
        return Bench(problem, self.well_seen[np.searchsorted(self.problem.vertices, problem.vertices)])

    def __len__(self) -> int:
        return len(self.problem)

    def calibrate(
        self, views: Bool, vertices: Bool | None = None, like: Calibration | None = None
    ) -> Calibration | None:
        """Cross-calibration of the views of a mask (N_views,), from the vertices of a mask (V,) alone if given.

        like : whose terms of the sensor's pattern are taken; None: those that these views ask for. None for methods
        without. Raises ScanError.
        """
        if self.problem.settings.method != "joint":
            return None
        problem = self.problem.part(views, vertices)
        return calibrate(problem) if like is None else Overlap.of(problem).like(like.sensor)

    def blend(self, views: Bool, calibration: Calibration | None) -> BlendResult:
        """The map from the views of a mask (N_views,)."""
        return blend(self.problem.part(views), calibration)

    # ------------------------------------------------------------ prediction

    def predictions(self, folds: int, progress: Progress) -> LeftOut:
        """All views, each predicted from the folds it is not in. Folds are interleaved."""
        views, parts = self.problem.seen_views, []
        folds = min(folds, len(views))
        for fold in range(folds):
            progress("left out", fold, folds)
            parts.append(self.left_out(np.isin(np.arange(self.problem.n_views), views[fold::folds])))
        progress("left out", folds, folds)
        return LeftOut.joined(parts)

    def left_out(self, views: Bool) -> LeftOut:
        """Solve without the views of a mask (N_views,), then predict their readings, each view with one offset."""
        calibration = self.calibrate(~views)
        result = self.blend(~views, calibration)
        given, observations = self.problem.emissivity, self.problem.observations
        model = calibration.emissivity(given) if calibration else given
        known = np.isfinite(result.absolute_K)[observations.vertex] & np.isfinite(observations.radiance)
        rows = observations.select(known & views[observations.view])
        slope_L = calibration.slope_L if calibration else skin_slope(self.problem.band, rows.radiance)
        sigma = self._sigma(rows, result, model, slope_L)
        residual = rows.radiance - self._reading(rows, result, model, calibration)
        for view in np.flatnonzero(views):
            mine = rows.view == view
            if mine.any():
                residual[mine] -= weighted_quantile(residual[mine], 1 / sigma[mine] ** 2, 0.5)
        angle_deg = np.degrees(np.arccos(np.clip(rows.cos_angle, -1, 1)))
        return LeftOut(residual / slope_L, sigma / slope_L, angle_deg, rows.view)

    def _reading(
        self, rows: Observations, result: BlendResult, model: EmissivityModel, calibration: Calibration | None
    ) -> Float:
        """The measurement equation: what leaves the surface towards the camera, and what the camera makes of it."""
        L0, L_r = self._straight_on(result)[rows.vertex], self.problem.L_reflected[rows.vertex]
        corrected = self.problem.settings.method in ANGLE_CORRECTED
        E: NDArray | float = AngleTables.of(model).relative(rows.cos_angle) if corrected else 1.0
        L = apparent_radiance(L0, E, L_r)
        if calibration is None:
            return L
        field = calibration.field(rows.u_px, rows.v_px)
        return np.asarray(with_gain(L, calibration.gain, calibration.pivot_radiance) + field)

    def _sigma(self, rows: Observations, result: BlendResult, model: EmissivityModel, slope_L: float) -> Float:
        """One sigma of map and reading together, radiance: the vertex's about the common level, and the reading's."""
        problem = self.problem
        absolute = result.output == "absolute"
        own = result.uncertainty.total_K.astype(np.float64) * (model.normal if absolute else 1.0)
        excess = self._straight_on(result) - problem.L_reflected
        errors = replace(problem.errors, netd_K=problem.errors.netd_K * float(np.sqrt(BILINEAR_VARIANCE)))
        reading = observation_variance(rows, excess[rows.vertex], AngleTables.of(model), errors, slope_L)
        return np.sqrt(reading + (slope_L * np.nan_to_num(own)[rows.vertex]) ** 2)

    def _straight_on(self, result: BlendResult) -> Float:
        """(V,) normal-equivalent radiance."""
        return self.problem.band.radiance(result.normal_equivalent_K)
