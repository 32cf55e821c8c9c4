"""Parts of a scan's views solved again: maps without some views, and what the others should have read."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..mapping.observe import clear_of_silhouettes
from ..mapping.references import BlackbodyReading
from ..physics.band import ZERO_DEGC_K, Band
from ..physics.emissivity import EmissivityModel, model_from_recipe
from ..progress import Progress
from ..recipe import Recipe
from ..robust import weighted_quantile
from ..temperature.blend import BlendResult, blend, remove_air_path
from ..temperature.crosscal import CrosscalResult, cross_calibrate
from ..temperature.solve import Seen, Temperature, error_model, room_of, surface_gradient, vertices_per_patch
from ..temperature.surroundings import surroundings
from ..temperature.uncertainty import BILINEAR_VARIANCE, AngleTables, ErrorModel, observation_variance, skin_slope
from ..types import Bool, Camera, Float, Float32, Int, Observations, Scan, SurfaceMesh

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
    """Vertices of a finished result, numbered without gaps, and all that it takes to solve them again.

    vertices : (V,) their numbers in the mesh. observations : of them, freed of the air path, clear of outlines or the
    best there is. well_seen : (V,) two views had it in sight under 60°, near outlines or not. counts : (N,) what the
    finished map is made of: a part of the views must not fall back on worse. L_reflected : (V,), and errors : as the
    finished result has them. per_patch : vertices that share a normal's error.
    """

    vertices: NDArray[np.intp]
    observations: Observations
    well_seen: Bool
    counts: Bool
    n_views: int
    blackbodies: tuple[BlackbodyReading, ...]
    camera: Camera
    band: Band
    emissivity: EmissivityModel
    L_reflected: Float
    reflected_K: float
    air_K: float
    errors: ErrorModel
    per_patch: float
    recipe: Recipe

    @classmethod
    def of(cls, scan: Scan, surface: SurfaceMesh, seen: Seen, temperature: Temperature, recipe: Recipe) -> Bench:
        """All vertices of a finished result. Raises ScanError where there are too few views to leave any out."""
        assert scan.thermal is not None
        camera = scan.thermal.camera
        views = len(np.unique(seen.observations.view))
        if views < 3:
            raise ScanError(f"{views} thermal views see the surface: too few to leave any out", place=scan.root)
        band, room = Band(*camera.band_um), room_of(scan.environment, recipe)
        model = model_from_recipe(recipe.emissivity, band)
        skin_K = temperature.absolute_degC.astype(np.float64) + ZERO_DEGC_K
        L_reflected = np.full(len(surface), band.radiance(room.reflected_K))
        if recipe.crosscal.surroundings:
            L_reflected = surroundings(surface).reflected_radiance(
                float(L_reflected[0]), band.radiance(skin_K), emissivity=model.hemispherical
            )
        errors, mapping = error_model(camera, recipe), recipe.mapping
        L_air = float(band.radiance(room.air_K))
        rows = remove_air_path(seen.observations, recipe.radiometry.transmission_per_m, L_air)
        well_seen = np.bincount(rows.vertex[rows.cos_angle > WELL_SEEN_COS], minlength=len(surface)) >= 2
        rows = rows.select(clear_of_silhouettes(rows, len(surface), mapping.silhouette_px)[1])
        straight = rows.cos_angle >= np.float32(np.cos(np.radians(mapping.max_angle_deg)))
        straight_seen = np.bincount(rows.vertex[straight], minlength=len(surface)) > 0
        return cls(
            np.arange(len(surface)),
            rows,
            well_seen,
            straight | ~straight_seen[rows.vertex],
            len(seen.views),
            seen.blackbodies,
            camera.lens,
            band,
            model,
            L_reflected,
            room.reflected_K,
            room.air_K,
            replace(errors, gradient_K_per_m=surface_gradient(surface, skin_K)),
            vertices_per_patch(surface, recipe.fusion.normal_window_mm / 1e3),
            recipe,
        )

    def sample(self, size: int) -> Bench:
        """An even sample of at most `size` of the vertices that were seen."""
        seen = np.unique(self.observations.vertex)
        chosen = seen[:: max(1, -(-len(seen) // size))]
        number = np.full(len(self), -1, np.int32)
        number[chosen] = np.arange(len(chosen), dtype=np.int32)
        mine = number[self.observations.vertex] >= 0
        rows = self.observations.select(mine)
        return replace(
            self,
            vertices=self.vertices[chosen],
            well_seen=self.well_seen[chosen],
            counts=self.counts[mine],
            observations=replace(rows, vertex=number[rows.vertex]),
            L_reflected=self.L_reflected[chosen],
            errors=replace(self.errors, gradient_K_per_m=np.asarray(self.errors.gradient_K_per_m)[chosen]),
            per_patch=self.per_patch * len(chosen) / len(self),
        )

    def __len__(self) -> int:
        return len(self.L_reflected)

    @property
    def seen_views(self) -> NDArray[np.intp]:
        """Views that see the bench, in order of time."""
        return np.unique(self.observations.view)

    def calibrate(self, views: Bool, vertices: Bool | None = None) -> CrosscalResult | None:
        """Cross-calibration of the views of a mask (N_views,), from the vertices of a mask (V,) alone if given.

        None for methods without. Raises ScanError.
        """
        if self.recipe.radiometry.method != "joint":
            return None
        enters = self.observations.edge_px >= np.float32(self.recipe.mapping.silhouette_px)
        enters &= views[self.observations.view]
        if vertices is not None:
            enters &= vertices[self.observations.vertex]
        return cross_calibrate(
            self.observations.select(enters),
            len(self),
            self.n_views,
            self.emissivity,
            self.band,
            image_size=(self.camera.width_px, self.camera.height_px),
            L_reflected=self.L_reflected,
            errors=self.errors,
            settings=self.recipe.crosscal,
            max_angle_deg=self.recipe.mapping.max_angle_deg,
            blackbodies=[b for b in self.blackbodies if views[b.view]],
            vertices_per_patch=self.per_patch,
        )

    def blend(self, views: Bool, calibration: CrosscalResult | None) -> BlendResult:
        """The map from the views of a mask."""
        return blend(
            self.observations.select(self.counts & views[self.observations.view]),
            len(self),
            calibration,
            self.emissivity,
            self.band,
            L_reflected=self.L_reflected,
            reflected_K=self.reflected_K,
            air_K=self.air_K,
            settings=self.recipe.radiometry,
            errors=self.errors,
            max_angle_deg=self.recipe.mapping.max_angle_deg,
            last_resort_angle_deg=self.recipe.mapping.last_resort_angle_deg,
        )

    # ------------------------------------------------------------ prediction

    def predictions(self, folds: int, progress: Progress) -> LeftOut:
        """All views, each predicted from the folds it is not in. Folds are interleaved."""
        views, parts = self.seen_views, []
        folds = min(folds, len(views))
        for fold in range(folds):
            progress("left out", fold, folds)
            parts.append(self.left_out(np.isin(np.arange(self.n_views), views[fold::folds])))
        progress("left out", folds, folds)
        return LeftOut.joined(parts)

    def left_out(self, views: Bool) -> LeftOut:
        """Solve without the views of a mask, then predict what they read, each with one offset of its own."""
        calibration = self.calibrate(~views)
        result = self.blend(~views, calibration)
        model = calibration.emissivity(self.emissivity) if calibration else self.emissivity
        known = np.isfinite(result.absolute_K)[self.observations.vertex] & np.isfinite(self.observations.radiance)
        rows = self.observations.select(known & views[self.observations.view])
        slope_L = calibration.slope_L if calibration else skin_slope(self.band, rows.radiance)
        sigma = self._sigma(rows, result, model, slope_L)
        residual = rows.radiance - self._reading(rows, result, model, calibration)
        for view in np.flatnonzero(views):
            mine = rows.view == view
            if mine.any():
                residual[mine] -= weighted_quantile(residual[mine], 1 / sigma[mine] ** 2, 0.5)
        angle_deg = np.degrees(np.arccos(np.clip(rows.cos_angle, -1, 1)))
        return LeftOut(residual / slope_L, sigma / slope_L, angle_deg, rows.view)

    def _reading(
        self, rows: Observations, result: BlendResult, model: EmissivityModel, calibration: CrosscalResult | None
    ) -> Float:
        """The forward model: radiance that leaves the surface towards the camera, and what the camera makes of it."""
        L, L_r = self.band.radiance(result.normal_equivalent_K[rows.vertex]), self.L_reflected[rows.vertex]
        if self.recipe.radiometry.method in ANGLE_CORRECTED:
            L = L_r + AngleTables.of(model).relative(rows.cos_angle) * (L - L_r)
        if calibration is None:
            return np.asarray(L)
        L = calibration.gain * L - (calibration.gain - 1) * calibration.pivot_radiance
        return np.asarray(L + calibration.field(rows.u_px, rows.v_px))

    def _sigma(self, rows: Observations, result: BlendResult, model: EmissivityModel, slope_L: float) -> Float:
        """One sigma of map and reading together, radiance: the vertex's about the common level, and the reading's."""
        absolute = result.output == "absolute"
        own = result.uncertainty.total_K.astype(np.float64) * (model.normal if absolute else 1.0)
        excess = self.band.radiance(result.normal_equivalent_K) - self.L_reflected
        errors = replace(self.errors, netd_K=self.errors.netd_K * float(np.sqrt(BILINEAR_VARIANCE)))
        reading = observation_variance(rows, excess[rows.vertex], AngleTables.of(model), errors, slope_L)
        return np.sqrt(reading + (slope_L * np.nan_to_num(own)[rows.vertex]) ** 2)
