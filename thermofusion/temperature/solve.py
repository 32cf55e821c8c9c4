"""Step 4: the temperature that explains what the thermal views saw of the surface.

Views calibrate each other (`crosscal`), the radiation between the body's own parts is followed (`surroundings`), every
vertex is blended (`blend`), twice: the second time with what the first map tells.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RecipeError
from ..mapping.observe import Mapped
from ..physics.band import ZERO_DEGC_K
from ..progress import Progress, silent
from ..recipe import MappingSection, TemperatureSection
from ..types import (
    Bool,
    BudgetInput,
    Float32,
    OutputMode,
    Scan,
    SharedErrors,
    SurfaceMesh,
    ThermalMesh,
    VertexFlag,
    brief,
)
from .blend import BlendResult, blend
from .crosscal import Calibration, Overlap
from .inputs import inputs_of
from .materials import Covers
from .passed_over import contradicted, doubtful_with_neighbours
from .problem import ThermalProblem
from .room.answer import operator_answered
from .room.map import RoomMap
from .room.stated import Room
from .room.survey import survey
from .room.witness import sides_of
from .sensor.shown import table
from .skin import not_skin

Sections = tuple[MappingSection, TemperatureSection]
METHODS = ("nearest-view", "mean", "cos-resolution", "paper", "corrected-cos", "joint")
CAVITY_FRACTION = 0.2  # of the hemisphere: beyond it reflection between body parts exceeds 0.1 K
CAVITY_K = 0.05  # that reflection adds at least: things as warm as the room add nothing
HIGH_RESIDUAL = 3.0  # views disagree by more than this many of their own sigmas: hair, clothes, motion
AGREE_K, APART_K = 0.2, 0.6  # rms of views of a vertex: below, nobody minds; beyond the other, nothing excuses
PASSED_OVER_K = 0.85  # two views so far apart have an rms of `APART_K`
ANGLE_ROWS, ANGLE_STEP_DEG, ANGLE_LEAST = 200_000, 5.0, 200  # of the plot over the angle: rows, bins, rows of a bin
UNCERTAINTY_MEANS = "one sigma about the level common to all vertices; _absolute, where the level is known: with it"


@dataclass(frozen=True, eq=False)
class Temperature:
    """The temperature of every vertex, how it was found, and what the other methods would have said.

    mesh : in the recipe's output mode. absolute_degC, normal_equivalent_degC, apparent_degC : (V,) float32.
    body_fraction : (V,) F, or None. level_sigma_K : one sigma of the level common to all vertices, by part; a single
    vertex's absolute interval is √(uncertainty² + Σ level²). crosscal : for the report; methods : of old results.
    shared : what errors of vertices have in common; None where nothing tells (version 0.1.0 wrote the result, say).
    room : its radiance by direction, as it was used. inputs : what the temperatures depend on, for budgets. materials :
    by name, what was read of the parts that are not bare skin.
    """

    mesh: ThermalMesh
    absolute_degC: Float32
    normal_equivalent_degC: Float32
    apparent_degC: Float32
    body_fraction: Float32 | None = None
    calibration: Calibration | None = None
    level_sigma_K: dict[str, float] = field(default_factory=dict)
    crosscal: dict[str, Any] = field(default_factory=dict)
    methods: dict[str, Any] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    shared: SharedErrors | None = None
    room: RoomMap | None = None
    inputs: tuple[BudgetInput, ...] = ()
    materials: dict[str, dict[str, Any]] = field(default_factory=dict)

    __repr__ = brief

    def shown(self, mode: str) -> ThermalMesh:
        """The mesh in another output mode. The uncertainty is the run's own mode's; for others it is unknown (NaN)."""
        if mode == self.mesh.mode:
            return self.mesh
        values: dict[OutputMode, Float32] = {
            "absolute": self.absolute_degC,
            "normal-equivalent": self.normal_equivalent_degC,
            "apparent": self.apparent_degC,
        }
        chosen = next((m for m in values if m == mode), None)
        if chosen is None:
            raise RecipeError(f"there is no output mode '{mode}'", hint=f"choose from {', '.join(values)}")
        unknown = np.full(len(self.mesh), np.nan, np.float32)
        return replace(
            self.mesh,
            temperature_degC=values[chosen],
            mode=chosen,
            uncertainty_K=unknown,
            uncertainty_parts={},
            residual=None,
        )


def solve(
    scan: Scan,
    mesh: SurfaceMesh,
    mapped: Mapped,
    *,
    normal_window_m: float,
    mapping: MappingSection,
    temperature: TemperatureSection,
    progress: Progress = silent,
) -> Temperature:
    """The temperature of every vertex that was seen.

    normal_window_m : over which the mesh's normals were averaged. Raises ScanError, RecipeError.
    """
    problem = ThermalProblem.of(scan, mesh, normal_window_m, mapped, mapping, temperature)
    covers = Covers.of(scan, mapped, problem)
    problem = covers.apart_from(problem)
    progress("temperature", 1, 4)
    problem, calibration, notes, other, first = calibrated(problem, mapped)
    problem = problem.without(other) if other.any() else problem
    covers = covers.with_found(other)
    problem = covers.sent(problem)
    progress("temperature", 2, 4)
    problem = problem.informed(mesh, covers.read(first, problem, calibration, with_uncertainty=False).absolute_K)
    progress("temperature", 3, 4)
    result = covers.read(blend(problem, calibration), problem, calibration)
    other = covers.flagged(other)
    progress("temperature", 4, 4)
    body_fraction = None if problem.around is None else problem.around.body_fraction
    shown = _mesh(mesh, result, calibration, _cavity(problem), problem.room, other)
    if mapped.unsettled.any():  # else it is empty: the subject stood still
        shown = _flagged(shown, mapped.unsettled, VertexFlag.MOVED)
    if calibration is not None:
        against = contradicted(problem, mapped.observations, calibration, result, PASSED_OVER_K)
        against |= (shown.flags & VertexFlag.HIGH_RESIDUAL) > 0
        against |= doubtful_with_neighbours(against, result.count, problem.points_m)
        shown = _flagged(shown, against, VertexFlag.HIGH_RESIDUAL)
    return Temperature(
        mesh=shown,
        absolute_degC=_degC(result.absolute_K),
        normal_equivalent_degC=_degC(result.normal_equivalent_K),
        apparent_degC=_degC(result.apparent_K),
        body_fraction=body_fraction,
        calibration=calibration,
        level_sigma_K=result.uncertainty.level_parts_K,
        crosscal={} if calibration is None else _crosscal_report(calibration, mapped, problem, result),
        messages=(*problem.room.assumed, *notes, *covers.said),
        shared=_shared(result, problem.lens.focal_px, normal_window_m),
        room=problem.room_map,
        inputs=(*inputs_of(problem, calibration), *covers.inputs),
        materials=covers.told(result),
    )


def _shared(result: BlendResult, focal_px: float, normal_window_m: float) -> SharedErrors | None:
    common, modes = result.uncertainty.common_K, result.uncertainty.modes_K
    if not common:
        return None
    effects = dict(common) | {f"calibration {i}": column for i, column in enumerate(modes.T, 1)}
    return SharedErrors.of(effects, focal_px, normal_window_m)


def calibrated(
    problem: ThermalProblem, mapped: Mapped
) -> tuple[ThermalProblem, Calibration | None, tuple[str, ...], Bool, BlendResult]:
    """The problem in the room as it was seen; the cross-calibration and its messages, or None and why there is none;
    a mask (V,) of vertices that are not skin; a first map, without uncertainty.

    What is not skin takes no part in the calibration.
    """
    if problem.settings.method != "joint" or problem.n_views < 2:
        alone = "one thermal view cannot be cross-calibrated: the camera's offset stays in the result"
        first = blend(problem, None, with_uncertainty=False)
        notes = (alone,) if problem.settings.method == "joint" else ()
        return problem, None, notes, np.zeros(len(problem), bool), first
    overlap = Overlap.of(problem)
    plain = overlap.plain()
    if mapped.background is not None:
        background = mapped.background
        background = background if problem.changing is None else problem.changing.of_common_room(background)
        room = survey(background, plain, problem.room_prior, problem.errors.netd_K)
        problem = problem.in_room(room.with_sides(*sides_of(overlap)), mapped.views)
        overlap = overlap.lit_again(problem)
        plain = overlap.plain()
    first = blend(problem, plain, with_uncertainty=False)
    other, doubted = not_skin(problem, plain, first)
    if other.any():
        problem = problem.without(other)
        overlap = Overlap.of(problem)
    calibration = overlap.refined()
    if other.any() or calibration.sensor is not None:  # else the plain one says the same
        first = blend(problem, calibration, with_uncertainty=False)
    if problem.settings.sigma_operator_m2:
        problem = replace(problem, effects={**problem.effects, "operator": operator_answered(overlap, first)})
    doubts: tuple[str, ...] = ()
    if doubted:
        text = f"{doubted:.0%} of the surface do not behave as skin: none is flagged, the model of ε(θ) may be wrong"
        doubts = (text,)
    return problem, calibration, (*calibration.messages, *doubts), other, first


def unmeasured(surface: SurfaceMesh, temperature: TemperatureSection) -> Temperature:
    """The result of a scan without thermal frames: a surface, and no temperatures."""
    nan = np.full(len(surface), np.nan, np.float32)
    mesh = ThermalMesh.from_temperature(surface, nan, mode=temperature.output, anchored=False)
    note = "the scan has no thermal stream: the mesh carries no temperatures"
    return Temperature(mesh, nan, nan, nan, messages=(note,))


# ---------------------------------------------------------------- parts


def _cavity(problem: ThermalProblem) -> Bool:
    """(V,) True where much of what is reflected is the body's own, and unlike the room by enough to be read."""
    if problem.around is None:
        return np.zeros(len(problem), bool)
    L_room = float(problem.band.radiance(problem.room.reflected_K))
    slope = float(problem.band.d_radiance_dT(problem.room.reflected_K))
    added_K = (1 - problem.emissivity.hemispherical) * np.abs(problem.L_reflected - L_room) / slope
    return np.asarray((problem.around.body_fraction > CAVITY_FRACTION) & (added_K > CAVITY_K))


def _mesh(
    surface: SurfaceMesh,
    result: BlendResult,
    calibration: Calibration | None,
    cavity: Bool,
    room: Room,
    other: Bool,
) -> ThermalMesh:
    flags = np.zeros(len(surface), np.uint8)
    flags[other] |= np.uint8(VertexFlag.NOT_SKIN)
    flags[result.count == 1] |= np.uint8(VertexFlag.SINGLE_VIEW)
    flags[result.oblique] |= np.uint8(VertexFlag.OBLIQUE)
    spread_K = np.nan_to_num(result.spread_K)
    apart = (np.nan_to_num(result.residual) > HIGH_RESIDUAL) & (spread_K > AGREE_K) | (spread_K > APART_K)
    flags[apart] |= np.uint8(VertexFlag.HIGH_RESIDUAL)
    flags[cavity] |= np.uint8(VertexFlag.CAVITY)
    anchored = calibration is not None and calibration.anchored
    parts = dict(result.uncertainty.parts_K)
    if anchored:
        parts["absolute"] = result.uncertainty.absolute_K
    level = {f"level_sigma_K_{k}": v for k, v in result.uncertainty.level_parts_K.items() if np.isfinite(v)}
    return ThermalMesh(
        surface=surface,
        temperature_degC=_degC(result.temperature_K),
        mode=result.output,
        anchored=anchored,
        apparent_degC=_degC(result.apparent_K),
        uncertainty_K=result.uncertainty.total_K,
        view_angle_deg=result.best_angle_deg,
        distance_m=result.distance_m,
        observations=result.count,
        flags=flags,
        uncertainty_parts=parts,
        metadata={"uncertainty": UNCERTAINTY_MEANS, "room": room.text(), **level},
        residual=result.residual,
    )


def _flagged(mesh: ThermalMesh, where: Bool, flag: VertexFlag) -> ThermalMesh:
    """With a flag more on some of its vertices (V,)."""
    return replace(mesh, flags=mesh.flags | np.where(where, flag, 0).astype(np.uint8))


def _crosscal_report(c: Calibration, mapped: Mapped, problem: ThermalProblem, result: BlendResult) -> dict[str, Any]:
    return {
        "by_angle": _by_angle(c, problem, result),
        "anchored": c.anchored,
        "level_sigma_K": c.level_sigma_K,
        "offsets_K": c.offsets_K,
        "view_frames": mapped.views.frame,
        "view_rms_K": c.view_rms_K,
        "field": table(c.field, c.sensor, c.slope_L),
        "field_change": c.field_change,
        "field_rms_K": float(np.sqrt((c.field.coefficients**2).sum()) / c.slope_L),
        "shape": c.shape,
        "shape_sigma": c.shape_sigma,
        "gain": c.gain,
        "held": c.held,
        "condition": c.condition,
        "residual_sigma": c.residual_sigma,
        "outlier_fraction": c.outlier_fraction,
        "iterations": c.iterations,
        "converged": c.converged,
    }


def _by_angle(c: Calibration, problem: ThermalProblem, result: BlendResult) -> dict[str, Any]:
    """What views read at each viewing angle less the vertex's normal-equivalent temperature, K: medians of 5°."""
    step = max(1, len(problem.observations) // ANGLE_ROWS)
    rows = problem.observations.select(np.arange(0, len(problem.observations), step))
    L_r = problem.L_reflected[rows.vertex]
    straight = problem.band.radiance(result.normal_equivalent_K[rows.vertex])
    E = c.emissivity(problem.emissivity).relative(rows.cos_angle.astype(np.float64))
    after = (L_r + (c.corrected(rows) - L_r) / E - straight) / c.slope_L
    before = (rows.radiance - straight) / c.slope_L
    angle = np.degrees(np.arccos(np.clip(rows.cos_angle, -1, 1)))
    bins = np.digitize(angle, np.arange(0, 90, ANGLE_STEP_DEG))
    known = np.isfinite(before) & np.isfinite(after)
    kept = [k for k in np.unique(bins) if (known & (bins == k)).sum() >= ANGLE_LEAST]
    return {
        "angle_deg": [float((k - 0.5) * ANGLE_STEP_DEG) for k in kept],
        "before_K": [float(np.median(before[known & (bins == k)])) for k in kept],
        "after_K": [float(np.median(after[known & (bins == k)])) for k in kept],
    }


def compare_methods(
    scan: Scan, surface: SurfaceMesh, normal_window_m: float, mapped: Mapped, found: Temperature, recipe: Sections
) -> dict[str, dict[str, float]]:
    """How every method's temperatures differ from those found, level removed, K.

    recipe : the sections (mapping, temperature) that the temperatures were found with.
    """
    problem = ThermalProblem.of(scan, surface, normal_window_m, mapped, *recipe)
    problem = problem if found.room is None else problem.in_room(found.room, mapped.views)
    problem = problem.informed(surface, found.absolute_degC.astype(np.float64) + ZERO_DEGC_K)
    out = {}
    for method in METHODS:
        other = replace(problem, settings=problem.settings.model_copy(update={"method": method}))
        d = blend(other, found.calibration).temperature_K - ZERO_DEGC_K - found.mesh.temperature_degC
        d = d[np.isfinite(d)]
        level = float(np.median(d))
        left = d - level
        rms, p95 = float(np.sqrt((left**2).mean())), float(np.percentile(np.abs(left), 95))
        out[method] = {"level_K": level, "rms_K": rms, "p95_K": p95}
    return out


def _degC(T_K: NDArray) -> Float32:
    return np.asarray(T_K - ZERO_DEGC_K, np.float32)
