"""How good is a result without truth: leave views out, predict them, and let halves of the views check each other.

Two questions, two answers.

*Does the model explain what the camera read?* Views are left out in interleaved folds; the rest is calibrated and
blended; each left-out reading is predicted through the forward model of `crosscal` (the point spread is in both: the
map is made of readings blurred alike). The view's own offset cannot be known from other views: it is estimated as one
robust number. What is left is mostly pixel noise, which the map does not have.

*How far is the map from the truth?* Two maps from disjoint halves of the views err independently where the halves do.
With T_A - T_B = e_A - e_B and inverse variances w_A, w_B, the map of all views has an error of the size of
(T_A - T_B)·√(w_A·w_B)/(w_A + w_B): half the difference for equal halves (McCarthy 1969, pseudo-replication by half
samples). Neighbouring views err alike (normals, registration), so halves are made of arcs: half as many consecutive
views as see a typical spot. What *all* views share (point spread, a wrong shape of the mesh, what is reflected) does
not show; see docs/validation.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .blending import BlendResult, blend, remove_air_path
from .crosscal import CrosscalResult, cross_calibrate
from .emissivity import EmissivityModel, model_from_recipe
from .errors import RecipeError, ScanError
from .radiometry import ZERO_DEGC_K, Band
from .recipe import Recipe
from .references import BlackbodyReading
from .rundir import to_json, write_text
from .surroundings import surroundings
from .thermometry import Seen, Temperature, room_of, surface_gradient
from .thermometry import _errors as error_model
from .types import Bool, Camera, Float, Float32, Observations, Scan, SurfaceMesh
from .uncertainty import BILINEAR_VARIANCE, AngleTables, ErrorModel, observation_variance, skin_slope

if TYPE_CHECKING:
    from .pipeline import Progress, Result

ANGLE_BINS_DEG = ((0, 20), (20, 40), (40, 60), (60, 90))
SAMPLE = 24_000  # vertices: offsets and statistics settle to a few percent of themselves
WELL_SEEN_DEG = 60.0  # the map's error is stated for surface that two views saw straighter than this
COUNT_CLASSES = (3, 4, 6, 9, 13, 19)  # lower ends of classes of views per vertex, after the first (2)
ANGLE_CORRECTED = ("joint", "corrected-cos")
MOTION_GAIN = 0.005  # share by which the left-out residual must fall before corrections of views are preferred


@dataclass(frozen=True)
class Statistics:
    """Errors of n predictions, K. within_95 : share inside ±1.96 of the predicted sigma (NaN without a sigma)."""

    n: int
    bias_K: float
    mae_K: float
    rmse_K: float
    p95_K: float
    within_95: float

    @classmethod
    def of(cls, error_K: NDArray, sigma_K: NDArray | None = None, weight: NDArray | None = None) -> Statistics:
        """Of errors (N,), counted with weights (N,)."""
        if not len(error_K):
            return cls(0, *[float("nan")] * 5)
        e, w = np.asarray(error_K, np.float64), np.ones(len(error_K)) if weight is None else weight
        w = w / w.sum()
        inside = float("nan") if sigma_K is None else float(w @ (np.abs(e) <= 1.96 * sigma_K))
        p95 = weighted_quantile(np.abs(e), w, 0.95)
        return cls(len(e), float(w @ e), float(w @ np.abs(e)), float(np.sqrt(w @ e**2)), p95, inside)


@dataclass(frozen=True)
class MapError:
    """The map's own relative error, expected from halves of the views; K. Nothing of pixel noise beyond the map's own.

    error : of surface that two views saw under 60°. within_95 there: of the result's own stated sigma. arc_views :
    consecutive views that stay together in a half. coverage : share of that surface which some pair of halves both saw;
    the rest is represented by surface that as many views saw. sigma_ratio : rms of error over stated sigma, 1 = honest.
    """

    error: Statistics
    arc_views: int
    halvings: int
    coverage: float
    sigma_ratio: float


@dataclass(frozen=True)
class MotionVerdict:
    """Whether rigid corrections of single views predict left-out views better. rms_K : left-out residual."""

    rms_without_K: float
    rms_with_K: float
    median_mm: float
    preferred: bool
    message: str


@dataclass(frozen=True)
class ValidationReport:
    """What `validate` found. by_angle : left-out readings by viewing angle, keys like "0-20". noise_K : of one sampled
    reading; beyond_noise_K : rms of left-out residuals under 60° less that noise, robust against outliers.
    map_error, motion : None where they cannot be had; messages say why.
    """

    scan: str
    recipe: str
    method: str
    folds: int
    views: int
    vertices: int
    overall: Statistics
    by_angle: dict[str, Statistics]
    noise_K: float
    beyond_noise_K: float
    map_error: MapError | None
    motion: MotionVerdict | None = None
    messages: tuple[str, ...] = ()

    def text(self) -> str:
        """For people."""
        lines = [
            f"left out     {self.views} views in {self.folds} folds, {self.vertices:,} vertices, method {self.method}; "
            "measured minus predicted, K:",
            "             angle         n     bias     MAE    RMSE     p95   within 95 %",
        ]
        rows = {**{f"{k}°": s for k, s in self.by_angle.items()}, "all": self.overall}
        lines += [
            f"             {k:<7}{s.n:>8,} {s.bias_K:>+8.4f} {s.mae_K:>7.4f} {s.rmse_K:>7.4f} {s.p95_K:>7.4f}"
            f"   {s.within_95:>6.1%}"
            for k, s in rows.items()
            if s.n
        ]
        lines.append(
            f"             of it {self.noise_K:.4f} K is pixel noise; beyond noise {self.beyond_noise_K:.4f} K"
        )
        if self.map_error is not None:
            lines += _map_lines(self.map_error)
        if self.motion is not None:
            lines.append(f"motion       {self.motion.message}")
        return "\n".join([*lines, *(f"note         {m}" for m in self.messages)])


def _map_lines(m: MapError) -> list[str]:
    e = m.error
    return [
        f"the map      expected relative error: MAE {e.mae_K:.4f} K, RMSE {e.rmse_K:.4f} K, p95 {e.p95_K:.4f} K",
        "             where two views saw the surface under 60°;"
        f" from {m.halvings} pairs of half maps, arcs of {m.arc_views} views, {m.coverage:.0%} seen by both;",
        f"             {e.within_95:.1%} inside the stated 95 % interval (rms error / sigma {m.sigma_ratio:.2f})",
        "             what all views share does not show: point spread, shape of the mesh, what is reflected, the level",
    ]


# ---------------------------------------------------------------- entry


def validate(
    scan: Scan,
    recipe: Recipe,
    *,
    out: Path | str | None = None,
    folds: int = 5,
    motion: bool = True,
    progress: Progress | None = None,
) -> ValidationReport:
    """Run (or reuse what `out` holds), then leave views out.

    Parameters
    ----------
    out : result folder, as of `pipeline.fuse`; `validation.json` is written there. folds : parts of the views.
    motion : also try rigid corrections of single views and say whether they predict better.

    Raises ScanError where there are too few thermal views, and what `fuse` raises.
    """
    from .pipeline import fuse

    if folds < 2:
        raise RecipeError(f"--folds must be at least 2, got {folds}")
    if scan.thermal is None:
        raise ScanError("the scan has no thermal stream: there are no views to leave out", place=scan.root)
    result = fuse(scan, recipe, out=out, progress=progress)
    step = progress or (lambda stage, done, total: None)
    report = validate_result(scan, recipe, result, folds=folds, motion=motion, progress=step)
    if out is not None:
        write_text(Path(out) / "validation.json", to_json(report))
    return report


def validate_result(
    scan: Scan, recipe: Recipe, result: Result, *, folds: int, motion: bool, progress: Progress
) -> ValidationReport:
    """`validate` of a result that was run to its end."""
    assert result.surface is not None
    assert result.seen is not None
    assert result.temperature is not None
    bench = Bench.of(scan, result.surface.mesh, result.seen, result.temperature, recipe)
    report = bench.report(folds, progress)
    if motion:
        verdict, notes = _motion(scan, recipe, result, report, folds, progress)
        report = replace(report, motion=verdict, messages=(*report.messages, *notes))
    return report


# ---------------------------------------------------------------- parts of the views


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Left-out readings: measured minus predicted residual_K and its predicted sigma_K, at angle_deg, in view; (N,)."""

    residual_K: Float
    sigma_K: Float
    angle_deg: Float32
    view: NDArray[np.int32]

    @classmethod
    def joined(cls, parts: list[LeftOut]) -> LeftOut:
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in cls.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Bench:
    """A sample of a result's vertices, numbered without gaps, on which parts of the views are solved again.

    observations : freed of the air path. L_reflected (V,), errors : of the full result. sigma_K : (V,) as it stated.
    """

    observations: Observations
    n_views: int
    blackbodies: tuple[BlackbodyReading, ...]
    camera: Camera
    band: Band
    emissivity: EmissivityModel
    L_reflected: Float
    reflected_K: float
    air_K: float
    errors: ErrorModel
    sigma_K: Float32
    recipe: Recipe
    scan_name: str

    @classmethod
    def of(
        cls,
        scan: Scan,
        surface: SurfaceMesh,
        seen: Seen,
        temperature: Temperature,
        recipe: Recipe,
        sample: int = SAMPLE,
    ) -> Bench:
        """From a finished result."""
        assert scan.sensor is not None
        assert scan.rig.thermal is not None
        band, room = Band(*scan.sensor.band_um), room_of(scan.environment, recipe)
        model = model_from_recipe(recipe.emissivity, band)
        skin_K = temperature.absolute_degC.astype(np.float64) + ZERO_DEGC_K
        L_reflected = np.full(len(surface), band.radiance(room.reflected_K))
        if recipe.crosscal.surroundings:
            L_reflected = surroundings(surface).reflected_radiance(
                float(L_reflected[0]), band.radiance(skin_K), emissivity=model.hemispherical
            )
        measured = np.flatnonzero(temperature.mesh.measured)
        chosen = measured[:: max(1, -(-len(measured) // sample))]
        number = np.full(len(surface), -1, np.int32)
        number[chosen] = np.arange(len(chosen), dtype=np.int32)
        rows = seen.observations.select(number[seen.observations.vertex] >= 0)
        rows = replace(rows, vertex=number[rows.vertex])
        gradient = surface_gradient(surface, skin_K)[chosen]
        return cls(
            remove_air_path(rows, recipe.radiometry.transmission_per_m, float(band.radiance(room.air_K))),
            len(seen.views),
            seen.blackbodies,
            scan.rig.thermal,
            band,
            model,
            L_reflected[chosen],
            room.reflected_K,
            room.air_K,
            replace(error_model(scan.sensor, recipe), gradient_K_per_m=gradient),
            temperature.mesh.uncertainty_K[chosen],
            recipe,
            scan.name,
        )

    def __len__(self) -> int:
        return len(self.L_reflected)

    def solve(self, views: Bool) -> tuple[CrosscalResult | None, BlendResult]:
        """Calibration and map from the views of a mask (N_views,)."""
        rows = self.observations.select(views[self.observations.view])
        calibration = None
        if self.recipe.radiometry.method == "joint" and views.sum() > 1:
            calibration = cross_calibrate(
                rows,
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
            )
        result = blend(
            rows,
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
        return calibration, result

    def left_out(self, views: Bool) -> LeftOut:
        """Solve without the views of a mask, then predict what they read."""
        calibration, result = self.solve(~views)
        known = views[self.observations.view] & np.isfinite(result.absolute_K)[self.observations.vertex]
        rows = self.observations.select(known & np.isfinite(self.observations.radiance))
        slope_L = calibration.slope_L if calibration else skin_slope(self.band, rows.radiance)
        model = calibration.emissivity(self.emissivity) if calibration else self.emissivity
        L = self._leaving(rows, result, model)
        if calibration is not None:  # the camera: gain, field; its offset follows below
            L = calibration.gain * L - (calibration.gain - 1) * calibration.pivot_radiance
            L = L + calibration.field(rows.u_px, rows.v_px)
        sigma = self._sigma(rows, result, model, slope_L)
        residual = rows.radiance - L
        for view in np.flatnonzero(views):
            mine = rows.view == view
            if mine.any():
                residual[mine] -= weighted_quantile(residual[mine], 1 / sigma[mine] ** 2, 0.5)
        angle_deg = np.degrees(np.arccos(np.clip(rows.cos_angle, -1, 1)))
        return LeftOut(residual / slope_L, sigma / slope_L, angle_deg, rows.view)

    def _leaving(self, rows: Observations, result: BlendResult, model: EmissivityModel) -> Float:
        """Radiance that leaves the surface towards the camera, as the method understands it."""
        L0, L_r = self.band.radiance(result.normal_equivalent_K[rows.vertex]), self.L_reflected[rows.vertex]
        if self.recipe.radiometry.method not in ANGLE_CORRECTED:
            return np.asarray(L0)
        return np.asarray(L_r + AngleTables.of(model).relative(rows.cos_angle) * (L0 - L_r))

    def _sigma(self, rows: Observations, result: BlendResult, model: EmissivityModel, slope_L: float) -> Float:
        """One sigma of prediction and reading together, radiance: the vertex's and the observation's own."""
        absolute = result.output == "absolute"
        own = result.uncertainty.total_K.astype(np.float64) * (model.normal if absolute else 1.0)
        excess = self.band.radiance(result.normal_equivalent_K) - self.L_reflected
        errors = replace(self.errors, netd_K=self.errors.netd_K * np.sqrt(BILINEAR_VARIANCE))
        reading = observation_variance(rows, excess[rows.vertex], AngleTables.of(model), errors, slope_L)
        return np.sqrt(reading + (slope_L * np.nan_to_num(own)[rows.vertex]) ** 2)

    # ------------------------------------------------------------ answers

    def predictions(self, folds: int, progress: Progress) -> LeftOut:
        """All views, each predicted from the folds it is not in. Folds are interleaved."""
        seen_views = np.unique(self.observations.view)
        if len(seen_views) < 3:
            raise ScanError(
                f"{len(seen_views)} thermal views see the surface", hint="leaving views out needs three or more"
            )
        folds = min(folds, len(seen_views))
        parts = []
        for fold in range(folds):
            progress("validate", fold, folds)
            parts.append(self.left_out(np.isin(np.arange(self.n_views), seen_views[fold::folds])))
        progress("validate", folds, folds)
        return LeftOut.joined(parts)

    def report(self, folds: int, progress: Progress) -> ValidationReport:
        """Predictions of left-out views, and the map's own error."""
        left = self.predictions(folds, progress)
        by_angle = {
            f"{lo}-{hi}" if hi < 90 else f"{lo}+": (left.angle_deg >= lo) & (left.angle_deg < hi)
            for lo, hi in ANGLE_BINS_DEG
        }
        noise_K = self.errors.netd_K * float(np.sqrt(BILINEAR_VARIANCE))
        robust = robust_rms(left.residual_K[left.angle_deg < WELL_SEEN_DEG])
        map_error, notes = self.map_error(progress)
        return ValidationReport(
            scan=self.scan_name,
            recipe=self.recipe.name,
            method=self.recipe.radiometry.method,
            folds=folds,
            views=len(np.unique(left.view)),
            vertices=len(self),
            overall=Statistics.of(left.residual_K, left.sigma_K),
            by_angle={k: Statistics.of(left.residual_K[m], left.sigma_K[m]) for k, m in by_angle.items()},
            noise_K=noise_K,
            beyond_noise_K=float(np.sqrt(max(robust**2 - noise_K**2, 0.0))),
            map_error=map_error,
            messages=notes,
        )

    def map_error(self, progress: Progress) -> tuple[MapError | None, tuple[str, ...]]:
        """The relative error of the map of all views, from maps of halves of them."""
        rows = self.observations
        cos_limits = np.cos(np.radians([WELL_SEEN_DEG, self.recipe.mapping.max_angle_deg])).astype(np.float32)
        well_seen = np.bincount(rows.vertex[rows.cos_angle > cos_limits[0]], minlength=len(self)) >= 2
        count = np.bincount(rows.vertex[rows.cos_angle > cos_limits[1]], minlength=len(self))
        if not well_seen.any():
            return None, ("the map's error cannot be told: no spot was seen by two views under 60°",)
        order = np.unique(rows.view)
        arc = int(np.clip(np.median(count[well_seen]) // 2, 1, len(order) // 2))
        shifts = sorted({0, arc // 2})
        error, vertex = [], []
        for n, shift in enumerate(shifts):
            progress("half maps", n, len(shifts))
            in_A = np.zeros(self.n_views, bool)
            in_A[order[((np.arange(len(order)) + shift) // arc) % 2 == 0]] = True
            in_B = np.isin(np.arange(self.n_views), order) & ~in_A
            try:
                e = _half_difference(self.solve(in_A)[1], self.solve(in_B)[1])
            except ScanError as fault:
                return None, (f"the map's error cannot be told from halves of the views: {fault.cause}",)
            both = np.flatnonzero(well_seen & np.isfinite(e))
            error.append(e[both] - (np.median(e[both]) if len(both) else 0.0))
            vertex.append(both)
        progress("half maps", len(shifts), len(shifts))
        return self._map_error(np.concatenate(error), np.concatenate(vertex), well_seen, count, arc, len(shifts))

    def _map_error(
        self, error: Float, vertex: NDArray, well_seen: Bool, count: NDArray, arc: int, halvings: int
    ) -> tuple[MapError | None, tuple[str, ...]]:
        if not len(error):
            return None, ("the map's error cannot be told: no spot was seen by both halves of the views",)
        # surface that one half alone saw is represented by surface that as many views saw
        group = np.searchsorted(COUNT_CLASSES, count, side="right")
        wanted = np.bincount(group[well_seen], minlength=len(COUNT_CLASSES) + 1)
        had = np.bincount(group[vertex], minlength=len(COUNT_CLASSES) + 1)
        weight = (wanted / np.maximum(had, 1))[group[vertex]]
        sigma = self.sigma_K[vertex].astype(np.float64)
        stated = Statistics.of(error, sigma, weight)
        finite = np.isfinite(sigma) & (sigma > 0)
        ratio = (
            np.sqrt(np.average((error[finite] / sigma[finite]) ** 2, weights=weight[finite]))
            if finite.any()
            else np.nan
        )
        coverage = len(np.unique(vertex)) / int(well_seen.sum())
        return MapError(stated, arc, halvings, coverage, float(ratio)), ()


def _half_difference(a: BlendResult, b: BlendResult) -> Float:
    """(T_A - T_B)·√(w_A w_B)/(w_A + w_B), (V,) K, w = 1/noise²: the size of the whole map's error."""
    s_a, s_b = (r.uncertainty.parts_K["noise"].astype(np.float64) for r in (a, b))
    return np.asarray((a.temperature_K - b.temperature_K) * s_a * s_b / (s_a**2 + s_b**2))


# ---------------------------------------------------------------- motion


def _motion(
    scan: Scan, recipe: Recipe, result: Result, report: ValidationReport, folds: int, progress: Progress
) -> tuple[MotionVerdict | None, tuple[str, ...]]:
    """Left-out residual with every view's pose corrected by its outline, against `report`'s without."""
    from .motion import view_corrections
    from .projection import SurfaceRays, observe
    from .radiometry import SignalConverter

    assert result.surface is not None
    assert result.seen is not None
    assert result.temperature is not None
    assert scan.sensor is not None
    surface, seen = result.surface.mesh, result.seen
    motion = view_corrections(scan, surface, seen.views, result.alignment, progress=progress)
    if not motion.kept:
        return None, motion.messages
    views = replace(seen.views, T_world_thermal=motion.T_world_thermal)
    to_radiance = SignalConverter(scan.sensor).radiance
    moved = replace(
        seen, views=views, observations=observe(scan, SurfaceRays(surface), views, to_radiance, recipe.mapping)
    )
    left = Bench.of(scan, surface, moved, result.temperature, recipe).predictions(folds, progress)
    before, after = report.overall.rmse_K, float(np.sqrt(np.mean(left.residual_K**2)))
    preferred = after < (1 - MOTION_GAIN) * before
    size = float(np.median(motion.correction_mm))
    verdict = "preferred" if preferred else "not preferred"
    change = f"the left-out RMSE from {before:.4f} to {after:.4f} K"
    text = f"corrections of single views ({size:.1f} mm) change {change}: {verdict}"
    return MotionVerdict(before, after, size, preferred, text), motion.messages


# ---------------------------------------------------------------- robust numbers


def weighted_quantile(values: NDArray, weights: NDArray, q: float) -> float:
    """The value below which the share q of the weight lies."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(np.asarray(weights, np.float64)[order])
    return float(values[order[np.searchsorted(total, q * total[-1])]])


def robust_rms(residual: NDArray) -> float:
    """1.4826 times the median absolute value: the RMS of a normal distribution, deaf to outliers."""
    return 1.4826 * float(np.median(np.abs(residual))) if len(residual) else float("nan")
