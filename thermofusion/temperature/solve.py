"""Steps 3 and 4 together: what the thermal views saw of the surface, and the temperature that explains it.

`see` maps the views onto the surface; `measure` lets them calibrate each other, follows the radiation between the
body's own parts, and blends every vertex. The physics is in `radiometry`, `emissivity`, `crosscal`, `surroundings`
and `blending`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RecipeError, ScanError
from ..mapping.motion import MotionResult, view_corrections
from ..mapping.observe import SurfaceRays, clear_of_silhouettes, observe
from ..mapping.references import BlackbodyReading, ContactReading, read_blackbody
from ..mapping.views import thermal_views
from ..physics.band import ZERO_DEGC_K, Band
from ..physics.emissivity import EmissivityModel, model_from_recipe
from ..physics.signal import SignalConverter
from ..recipe import RadiometrySection, Recipe
from ..types import (
    BlackbodyReference,
    Environment,
    Float32,
    Observations,
    OutputMode,
    Scan,
    SurfaceMesh,
    ThermalCamera,
    ThermalMesh,
    ThermalViews,
    Trajectory,
    VertexFlag,
)
from ..version import __version__
from .blend import BlendResult, blend, remove_air_path
from .crosscal import CrosscalResult, cross_calibrate
from .surroundings import surroundings
from .uncertainty import ErrorModel

if TYPE_CHECKING:
    from ..rig.align import AlignmentResult

METHODS = ("nearest-view", "mean", "cos-resolution", "paper", "corrected-cos", "joint")
DEFAULT_ROOM_DEGC = 23.0  # taken, and said, where neither scan nor recipe knows the reflected temperature
DEFAULT_SIGMA_NORMAL_DEG = 2.0  # of normals over a 25 mm window of a Kinect's surface
CAVITY_FRACTION = 0.2  # of the hemisphere: beyond it reflection between body parts exceeds 0.1 K
HIGH_RESIDUAL = 3.0  # views disagree by more than this many of their own sigmas: hair, clothes, motion
UNCERTAINTY_MEANS = "one sigma about the level common to all vertices; _absolute, where the level is known: with it"
CONTACT_RADIUS_M, CONTACT_FAR_M = 0.006, 0.03


@dataclass(frozen=True, eq=False)
class Seen:
    """What the thermal views saw: observations of vertices, and readings of blackbodies.

    left_out : thermal frames that did not enter, by reason. motion : corrections of single views, if asked for.
    """

    views: ThermalViews
    left_out: dict[str, int]
    observations: Observations
    blackbodies: tuple[BlackbodyReading, ...]
    motion: MotionResult | None = None


def see(
    scan: Scan,
    surface: SurfaceMesh,
    trajectory: Trajectory,
    alignment: AlignmentResult,
    recipe: Recipe,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Seen:
    """Project all thermal views onto the surface, with the aligned rig and clock."""
    assert scan.thermal is not None
    stream = scan.thermal
    camera = replace(stream.camera, T_thermal_depth=alignment.T_thermal_depth, time_offset_s=alignment.time_offset_s)
    views, left_out = thermal_views(scan, trajectory, recipe.input.max_pose_gap_ms / 1e3, camera)
    motion = None
    if recipe.crosscal.motion:
        motion = view_corrections(stream, surface, views, alignment)
        views = replace(views, T_world_thermal=motion.T_world_thermal)
    converter = SignalConverter(stream.camera)
    observations = observe(stream, SurfaceRays(surface), views, converter.radiance, recipe.mapping, progress=progress)
    return Seen(views, left_out, observations, _read_blackbodies(scan, views, converter, recipe), motion)


@dataclass(frozen=True, eq=False)
class Temperature:
    """The temperature of every vertex, how it was found, and what the other methods would have said.

    mesh : in the recipe's output mode. absolute_degC, normal_equivalent_degC, apparent_degC : (V,) float32.
    body_fraction : (V,) F, or None. level_sigma_K : one sigma of the level common to all vertices, by part; a single
    vertex's absolute interval is √(uncertainty² + Σ level²). crosscal, methods : for the report.
    """

    mesh: ThermalMesh
    absolute_degC: Float32
    normal_equivalent_degC: Float32
    apparent_degC: Float32
    body_fraction: Float32 | None = None
    calibration: CrosscalResult | None = None
    level_sigma_K: dict[str, float] = field(default_factory=dict)
    crosscal: dict[str, Any] = field(default_factory=dict)
    methods: dict[str, Any] = field(default_factory=dict)
    messages: tuple[str, ...] = ()

    def shown(self, mode: OutputMode) -> ThermalMesh:
        """The mesh in another output mode. The uncertainty is the run's own mode's; for others it is unknown (NaN)."""
        if mode == self.mesh.mode:
            return self.mesh
        values = {
            "absolute": self.absolute_degC,
            "normal-equivalent": self.normal_equivalent_degC,
            "apparent": self.apparent_degC,
        }
        if mode not in values:
            raise RecipeError(f"there is no output mode '{mode}'", hint=f"choose from {', '.join(values)}")
        unknown = np.full(len(self.mesh), np.nan, np.float32)
        return replace(self.mesh, temperature_degC=values[mode], mode=mode, uncertainty_K=unknown, uncertainty_parts={})


@dataclass(frozen=True)
class Room:
    """Temperatures of what surrounds the subject, K, and whether they were measured."""

    reflected_K: float
    air_K: float
    assumed: tuple[str, ...]


def room_of(environment: Environment, recipe: Recipe) -> Room:
    """Recipe over scan over the default; what had to be assumed is said."""
    assumed = []
    reflected = recipe.radiometry.reflected_degC
    reflected = environment.reflected_degC if reflected is None else reflected
    air = recipe.radiometry.air_degC
    air = environment.air_degC if air is None else air
    if reflected is None:
        reflected = DEFAULT_ROOM_DEGC if air is None else air
        assumed.append(
            f"the reflected temperature is not known: {reflected:.1f} °C assumed (an error of 1 K costs 20 mK straight "
            "on, 63 mK at 60°); measure it with crumpled foil"
        )
    return Room(reflected + ZERO_DEGC_K, (reflected if air is None else air) + ZERO_DEGC_K, tuple(assumed))


def measure(
    scan: Scan,
    surface: SurfaceMesh,
    seen: Seen,
    recipe: Recipe,
    *,
    axes: Mapping[str, str] | None = None,
    compare: bool = False,
) -> Temperature:
    """The temperature of every vertex that was seen.

    1. Surroundings: what each vertex reflects, first with the body at one temperature.
    2. Cross-calibration of the views (method `joint`). 3. Blending. 4. Reflection again with the temperatures found,
    and a last blending with the errors' dependence on the temperature's own gradient.

    axes : which way is up and where the front is, for the mesh's metadata (`export.view_axes`).
    """
    assert scan.thermal is not None
    camera = scan.thermal.camera
    band, room = Band(*camera.band_um), room_of(scan.environment, recipe)
    model = model_from_recipe(recipe.emissivity, band)
    L_room = float(band.radiance(room.reflected_K))
    observations = remove_air_path(
        seen.observations, recipe.radiometry.transmission_per_m, float(band.radiance(room.air_K))
    )
    clear, counts = clear_of_silhouettes(observations, len(surface), recipe.mapping.silhouette_px)
    witnesses = observations.select(clear)
    observations = observations.select(counts)
    around = surroundings(surface) if recipe.crosscal.surroundings else None

    def reflected(skin: NDArray) -> float | NDArray:
        if around is None:
            return L_room
        return around.reflected_radiance(L_room, skin, emissivity=model.hemispherical)

    L_reflected = reflected(np.full(len(surface), np.median(observations.radiance), np.float32))
    errors = error_model(camera, recipe)
    calibration, notes = _calibrate(scan, surface, seen, witnesses, recipe, model, band, L_reflected, errors)

    def blended(settings: RadiometrySection, *, with_uncertainty: bool = True) -> BlendResult:
        return blend(
            observations,
            len(surface),
            calibration,
            model,
            band,
            L_reflected=L_reflected,
            reflected_K=room.reflected_K,
            air_K=room.air_K,
            settings=settings,
            errors=errors,
            max_angle_deg=recipe.mapping.max_angle_deg,
            last_resort_angle_deg=recipe.mapping.last_resort_angle_deg,
            with_uncertainty=with_uncertainty,
        )

    result = blended(recipe.radiometry, with_uncertainty=False)
    L_reflected = reflected(band.radiance(result.absolute_K))
    errors = replace(errors, gradient_K_per_m=surface_gradient(surface, result.absolute_K))
    result = blended(recipe.radiometry)

    methods = {}
    if compare:
        others = {m: blended(recipe.radiometry.model_copy(update={"method": m})) for m in METHODS}
        methods = {m: _difference(r, result) for m, r in others.items()}
    body_fraction = None if around is None else around.body_fraction
    return Temperature(
        mesh=_mesh(scan, surface, result, calibration, body_fraction, recipe, axes),
        absolute_degC=_degC(result.absolute_K),
        normal_equivalent_degC=_degC(result.normal_equivalent_K),
        apparent_degC=_degC(result.apparent_K),
        body_fraction=body_fraction,
        calibration=calibration,
        level_sigma_K=result.uncertainty.level_parts_K,
        crosscal={} if calibration is None else _crosscal_report(calibration, seen),
        methods=methods,
        messages=(*room.assumed, *notes),
    )


def unmeasured(scan: Scan, surface: SurfaceMesh, recipe: Recipe, axes: Mapping[str, str] | None = None) -> Temperature:
    """The result of a scan without thermal frames: a surface, and no temperatures."""
    nan = np.full(len(surface), np.nan, np.float32)
    metadata = _metadata(recipe, axes)
    mesh = ThermalMesh.from_temperature(surface, nan, mode=recipe.radiometry.output, anchored=False, metadata=metadata)
    note = "the scan has no thermal stream: the mesh carries no temperatures"
    return Temperature(mesh, nan, nan, nan, messages=(note,))


def surface_gradient(surface: SurfaceMesh, values: NDArray) -> Float32:
    """Magnitude of the gradient of values (V,) along the surface, per metre; 0 where unmeasured.

    Root mean square over a vertex's edges of the directional derivative, times √2 (an edge's direction is random).
    """
    F = surface.triangles
    a, b = np.concatenate([F[:, 0], F[:, 1], F[:, 2]]), np.concatenate([F[:, 1], F[:, 2], F[:, 0]])
    length2 = ((surface.vertices_m[a] - surface.vertices_m[b]) ** 2).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope2 = (values[a] - values[b]) ** 2 / length2
    good = np.isfinite(slope2)
    n = len(surface)
    total = np.bincount(a[good], slope2[good], n) + np.bincount(b[good], slope2[good], n)
    count = np.bincount(a[good], minlength=n) + np.bincount(b[good], minlength=n)
    return np.sqrt(2 * total / np.maximum(count, 1)).astype(np.float32)


# ---------------------------------------------------------------- parts


def _read_blackbodies(
    scan: Scan, views: ThermalViews, converter: SignalConverter, recipe: Recipe
) -> tuple[BlackbodyReading, ...]:
    """Every blackbody in every view that it was recorded in."""
    assert scan.thermal is not None
    L_room = float(converter.band.radiance(room_of(scan.environment, recipe).reflected_K))
    readings = []
    for reference in scan.references:
        if not isinstance(reference, BlackbodyReference):
            continue
        for view in np.flatnonzero(np.isin(scan.thermal.index[views.frame], reference.frames)):
            frame = int(views.frame[view])
            reading = read_blackbody(
                converter.radiance(scan.thermal.load(frame), scan.thermal.places[frame]),
                reference.polygon_px,
                view=int(view),
                T_K=reference.degC + ZERO_DEGC_K,
                sigma_K=reference.uncertainty_K,
                emissivity=reference.emissivity,
                L_reflected=L_room,
                band=converter.band,
                netd_K=scan.thermal.camera.netd_K,
            )
            if reading is not None:
                readings.append(reading)
    return tuple(readings)


def _contacts(scan: Scan, surface: SurfaceMesh, band: Band) -> list[ContactReading]:
    """Contact thermometers at the vertices around their spots."""
    readings = []
    for reference in scan.references:
        if isinstance(reference, BlackbodyReference):
            continue
        d = np.linalg.norm(surface.vertices_m - reference.p_world_m.astype(np.float32), axis=1)
        if d.min() > CONTACT_FAR_M:
            raise ScanError(
                f"a contact thermometer at {reference.p_world_m.tolist()} m is {d.min() * 100:.0f} cm off the surface",
                place=scan.root,
                hint="p_world_m is a point in the trajectory's world frame",
            )
        T_K = reference.degC + ZERO_DEGC_K
        vertices = np.flatnonzero(d <= max(CONTACT_RADIUS_M, d.min())).astype(np.int32)
        sigma = float(band.d_radiance_dT(T_K)) * reference.uncertainty_K
        readings.append(ContactReading(vertices, float(band.radiance(T_K)), sigma))
    return readings


def error_model(sensor: ThermalCamera, recipe: Recipe) -> ErrorModel:
    """One-sigma errors of an observation's parts, from the sensor and the recipe."""
    r = recipe.radiometry
    return ErrorModel(
        netd_K=sensor.netd_K,
        psf_sigma_px=ErrorModel.psf_sigma_px if sensor.psf_sigma_px is None else sensor.psf_sigma_px,
        sigma_normal_deg=DEFAULT_SIGMA_NORMAL_DEG if r.sigma_normal_deg is None else r.sigma_normal_deg,
        sigma_shape=r.sigma_shape,
        sigma_registration_px=r.sigma_registration_px,
        sigma_reflected_K=r.sigma_reflected_K,
    )


def _calibrate(
    scan: Scan,
    surface: SurfaceMesh,
    seen: Seen,
    observations: Observations,
    recipe: Recipe,
    model: EmissivityModel,
    band: Band,
    L_reflected: float | NDArray,
    errors: ErrorModel,
) -> tuple[CrosscalResult | None, tuple[str, ...]]:
    """The cross-calibration, or None and why not."""
    if recipe.radiometry.method != "joint":
        return None, ()
    if len(seen.views) < 2:
        return None, ("one thermal view cannot be cross-calibrated: the camera's offset stays in the result",)
    assert scan.thermal is not None
    camera = scan.thermal.camera.lens
    calibration = cross_calibrate(
        observations,
        len(surface),
        len(seen.views),
        model,
        band,
        image_size=(camera.width_px, camera.height_px),
        L_reflected=L_reflected,
        errors=errors,
        settings=recipe.crosscal,
        max_angle_deg=recipe.mapping.max_angle_deg,
        blackbodies=seen.blackbodies,
        contacts=_contacts(scan, surface, band),
        vertices_per_patch=vertices_per_patch(surface, recipe.fusion.normal_window_mm / 1e3),
    )
    return calibration, calibration.messages


def vertices_per_patch(surface: SurfaceMesh, window_m: float) -> float:
    """Vertices in a disc of the normals' window: they share their normal, and with it their error."""
    a, b, c = (surface.vertices_m[surface.triangles[:, k]] for k in range(3))
    area_m2 = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return float(np.pi * (window_m / 2) ** 2 * len(surface) / area_m2)


def _mesh(
    scan: Scan,
    surface: SurfaceMesh,
    result: BlendResult,
    calibration: CrosscalResult | None,
    body_fraction: Float32 | None,
    recipe: Recipe,
    axes: Mapping[str, str] | None,
) -> ThermalMesh:
    flags = np.zeros(len(surface), np.uint8)
    flags[result.count == 1] |= np.uint8(VertexFlag.SINGLE_VIEW)
    flags[result.oblique] |= np.uint8(VertexFlag.OBLIQUE)
    flags[np.nan_to_num(result.residual) > HIGH_RESIDUAL] |= np.uint8(VertexFlag.HIGH_RESIDUAL)
    if body_fraction is not None:
        flags[body_fraction > CAVITY_FRACTION] |= np.uint8(VertexFlag.CAVITY)
    anchored = calibration is not None and calibration.anchored
    parts = dict(result.uncertainty.parts_K)
    if anchored:
        parts["absolute"] = result.uncertainty.absolute_K
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
        metadata=_metadata(recipe, axes)
        | {"scan": scan.name, "uncertainty": UNCERTAINTY_MEANS}
        | {f"level_sigma_K_{k}": v for k, v in result.uncertainty.level_parts_K.items() if np.isfinite(v)},
    )


def _metadata(recipe: Recipe, axes: Mapping[str, str] | None) -> dict[str, str | float]:
    return {"version": __version__, "recipe": recipe.name, "frame": "world, metres, right-handed", **(axes or {})}


def _crosscal_report(c: CrosscalResult, seen: Seen) -> dict[str, Any]:
    return {
        "anchored": c.anchored,
        "level_sigma_K": c.level_sigma_K,
        "offsets_K": c.offsets_K,
        "view_frames": seen.views.frame,
        "view_rms_K": c.view_rms_K,
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


def _difference(other: BlendResult, reference: BlendResult) -> dict[str, float]:
    """How another method's temperatures differ from the chosen one's, level removed."""
    d = other.temperature_K - reference.temperature_K
    d = d[np.isfinite(d)]
    level = float(np.median(d))
    return {
        "level_K": level,
        "rms_K": float(np.sqrt(((d - level) ** 2).mean())),
        "p95_K": float(np.percentile(np.abs(d - level), 95)),
    }


def _degC(T_K: NDArray) -> Float32:
    return np.asarray(T_K - ZERO_DEGC_K, np.float32)
