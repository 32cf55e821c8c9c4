"""The schema of scan.json and rig.json, and its translation into the package's types: pydantic at the border."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field, field_validator, model_validator

from ...errors import ScanError
from ...files.npz import read_npz
from ...files.reading import inside, read_json
from ...files.strict import Border, validated
from ...recipe import EmissivitySection
from ...types import (
    BlackbodyReference,
    Camera,
    ContactReference,
    Float,
    LensScatter,
    Material,
    Reference,
    Rig,
    SignalCurve,
    ThermalCamera,
)
from ..common import Kind, make_camera, make_rig

SCHEMA = "thermofusion-scan/1"
STREAMS: tuple[Kind, ...] = ("depth", "color", "thermal")
MAX_BASELINE_M = 10.0  # between cameras of one rig: more is in other units than metres
MIN_BAND_UM = 0.1  # width of a thermal camera's band
MIN_POLYGON_PX2 = 1.0  # area of a reference in the thermal image
MAX_VERTICES = 50_000_000  # of a surface: far above what a scan gives
UP_LENGTH = (0.1, 100.0)  # of the `up` vector: a unit vector, or an accelerometer's m/s²

Constant = Annotated[float, Field(ge=-1e12, le=1e12)]  # of a radiometric curve: Planck's R reaches 1e9
Celsius = Annotated[float, Field(ge=-273.15, le=5000)]
Metres = Annotated[float, Field(ge=-1000, le=1000)]
Pixels = Annotated[float, Field(ge=-0.5, le=32767)]
FrameIndex = Annotated[int, Field(ge=0, lt=2**31)]


class CurveDoc(Border):
    """`signal.curve`: counts to temperature."""

    type: Literal["polynomial", "linear_kelvin", "planck", "table"]
    coefficients_degC: list[Constant] | None = Field(None, max_length=16)
    gain_K: Constant | None = None
    offset_K: Constant | None = None
    R: Constant | None = None
    B: float | None = Field(None, ge=1, le=1e6)  # K: 14388 over the wavelength in µm
    F: Constant | None = None
    O: Constant | None = None  # noqa: E741 - the Planck curve's own letter
    counts: list[Constant] | None = Field(None, max_length=65536)
    degC: list[Celsius] | None = Field(None, max_length=65536)


class SignalDoc(Border):
    """`signal`: what a stored thermal pixel is."""

    kind: Literal["counts", "apparent_degC", "radiance"]
    curve: CurveDoc | None = None


class CameraDoc(Border):
    """A camera."""

    width_px: int = Field(gt=0, le=32767)
    height_px: int = Field(gt=0, le=32767)
    K: list[list[float]]
    distortion: list[float] = Field(default_factory=list)
    model: str | None = None
    serial: str | None = None


class DepthCameraDoc(CameraDoc):
    """The depth camera."""

    depth_unit_m: float = Field(0.001, gt=1e-6, le=0.1)
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)

    @field_validator("up")
    @classmethod
    def _is_a_direction(cls, up: tuple[float, float, float]) -> tuple[float, float, float]:
        if not UP_LENGTH[0] <= math.hypot(*up) <= UP_LENGTH[1]:
            raise ValueError(f"expected a direction: three numbers, together {UP_LENGTH[0]} to {UP_LENGTH[1]:g} long")
        return up


class ScatterPartDoc(Border):
    """A share of the light, and one sigma of the Gaussian that it is spread over, in image widths."""

    share: float = Field(ge=0, le=0.2)
    width: float = Field(ge=0.005, le=1)


class ScatterDoc(Border):
    """`scatter`: light that the lens spreads widely, as `thermal scatter` measures it; sigma of the whole share."""

    parts: list[ScatterPartDoc] = Field(min_length=1, max_length=10)
    sigma: float = Field(ge=0, le=0.2)

    def lens_scatter(self) -> LensScatter:
        """As the package's type."""
        return LensScatter(tuple((p.share, p.width) for p in self.parts), self.sigma, stated=True)


class ThermalCameraDoc(CameraDoc):
    """The thermal camera."""

    signal: SignalDoc
    band_um: tuple[float, float] = (7.5, 13.5)
    netd_K: float = Field(0.05, ge=0.0001, le=5)
    time_offset_s: float = Field(0.0, ge=-1e11, le=1e11)  # s: clocks may begin anywhere
    psf_sigma_px: float | None = Field(None, ge=0.01, le=20)
    mount: Literal["rig", "free"] = "rig"  # free: held by itself, or on a stand; it has no extrinsic
    scatter: ScatterDoc | None = None


class CamerasDoc(Border):
    """`cameras` of a scan."""

    depth: DepthCameraDoc
    color: CameraDoc | None = None
    thermal: ThermalCameraDoc | None = None


class ExtrinsicsDoc(Border):
    """`extrinsics`: where the cameras sit."""

    T_color_depth: list[list[float]] | None = None
    T_thermal_depth: list[list[float]] | None = None


# What frames.csv may state of each thermal frame, with its bounds; the first three are `environment`'s, too.
CONDITIONS: dict[str, tuple[float, float]] = {
    "reflected_degC": (-80.0, 150.0),
    "air_degC": (-60.0, 80.0),
    "relative_humidity_pct": (0.0, 100.0),
    "fpa_degC": (-80.0, 200.0),
    "lens_degC": (-80.0, 200.0),
}


def plausible(name: str, column: Float) -> Float:
    """What files state of each frame, (N,) under one of `CONDITIONS`; NaN where it is out of bounds."""
    low, high = CONDITIONS[name]
    return np.where((column >= low) & (column <= high), column, np.nan)


def _bounded(name: str) -> Any:
    low, high = CONDITIONS[name]
    return Field(None, ge=low, le=high)


class EnvironmentDoc(Border):
    """`environment`: the room."""

    reflected_degC: float | None = _bounded("reflected_degC")
    air_degC: float | None = _bounded("air_degC")
    relative_humidity_pct: float | None = _bounded("relative_humidity_pct")


class BlackbodyDoc(Border):
    """A source of known temperature in some thermal frames."""

    kind: Literal["blackbody"]
    degC: float = Field(ge=-50, le=150)
    uncertainty_K: float = Field(ge=0, le=10)
    emissivity: float = Field(1.0, ge=0.5, le=1)
    thermal_polygon_px: list[tuple[Pixels, Pixels]] = Field(min_length=3, max_length=1000)
    frames: list[FrameIndex] = Field(min_length=1, max_length=1_000_000)

    @field_validator("thermal_polygon_px")
    @classmethod
    def _has_an_area(cls, polygon: list[tuple[float, float]]) -> list[tuple[float, float]]:
        u, v = np.array(polygon).T
        if abs(u @ np.roll(v, -1) - v @ np.roll(u, -1)) / 2 < MIN_POLYGON_PX2:
            raise ValueError("the polygon encloses less than a pixel")
        return polygon


class ContactDoc(Border):
    """A thermometer on the skin."""

    kind: Literal["contact"]
    degC: float = Field(ge=-50, le=150)
    uncertainty_K: float = Field(ge=0, le=10)
    p_world_m: tuple[Metres, Metres, Metres]


class OutlineDoc(Border):
    """An outline in one thermal picture."""

    frame: FrameIndex
    thermal_polygon_px: list[tuple[Pixels, Pixels]] = Field(min_length=3, max_length=1000)


class MaterialDoc(Border):
    """`materials`: a part of the surface that is not bare skin; without `emissivity` it gets no temperature."""

    name: str = Field(min_length=1, max_length=60)
    emissivity: EmissivitySection | Literal["skin"] | None = None
    sigma_emissivity0: float | None = Field(None, ge=0.001, le=0.5)
    not_skin: bool = False
    counts_as_skin: bool = False
    polygons: list[OutlineDoc] = Field(default_factory=list, max_length=1000)
    vertices: list[FrameIndex] = Field(default_factory=list, max_length=MAX_VERTICES)
    of_vertices: int = Field(0, ge=0, le=MAX_VERTICES)
    labels: str | None = None
    label: int = Field(1, ge=0, lt=2**31)

    @model_validator(mode="after")
    def _is_somewhere(self) -> MaterialDoc:
        if not (self.polygons or self.vertices or self.labels or self.not_skin):
            raise ValueError("where it is must be said: polygons, vertices, labels or not_skin")
        return self


class ScanDoc(Border):
    """scan.json."""

    schema_: Literal["thermofusion-scan/1"] = Field(alias="schema")
    name: str = Field("scan", max_length=200)
    recorded_at: str | None = Field(None, max_length=100)
    cameras: CamerasDoc
    extrinsics: ExtrinsicsDoc = ExtrinsicsDoc()
    environment: EnvironmentDoc = EnvironmentDoc()
    references: list[Annotated[BlackbodyDoc | ContactDoc, Field(discriminator="kind")]] = Field(
        default_factory=list, max_length=1000
    )
    materials: list[MaterialDoc] = Field(default_factory=list, max_length=100)
    subject: dict[str, Any] = Field(default_factory=dict)
    notes: list[str] = Field(default_factory=list)
    times_assumed: bool = False


class RigThermalDoc(ThermalCameraDoc):
    """The thermal camera of a rig.json: boards alone tell no curve."""

    signal: SignalDoc | None = None  # type: ignore[assignment]


class RigCamerasDoc(Border):
    """`cameras` of a rig.json, each optional."""

    depth: DepthCameraDoc | None = None
    color: CameraDoc | None = None
    thermal: RigThermalDoc | None = None


class RigExtrinsicsDoc(ExtrinsicsDoc):
    """`extrinsics` of a rig.json; a rig calibrated without a depth camera hangs on the colour camera."""

    T_thermal_color: list[list[float]] | None = None


class DepthCorrectionDoc(Border):
    """What calibration found of the depth camera's own error (`calibration.fit.depth_model`)."""

    model: Literal["metric", "disparity"]
    parameters: dict[str, Annotated[float, Field(ge=-10_000, le=10_000)]]


class RigDoc(Border):
    """rig.json: the `cameras` and `extrinsics` groups of a scan.json, each camera optional; the depth's correction.

    covariances : (6, 6) by extrinsic and (9, 9) by camera, as `calibrate` found them.
    """

    cameras: RigCamerasDoc
    extrinsics: RigExtrinsicsDoc = RigExtrinsicsDoc()
    covariances: dict[str, list[list[float]]] = Field(default_factory=dict, max_length=10)
    depth_correction: DepthCorrectionDoc | None = None


def camera_of(doc: CameraDoc, key: str, path: Path) -> Camera:
    """A camera group as `Camera`."""
    place = f"{path}: key '{key}'"
    try:
        K, distortion = np.array(doc.K, np.float64), np.array(doc.distortion, np.float64)
    except ValueError:
        raise ScanError("K must be a 3x3 matrix", place=place) from None
    return make_camera(doc.width_px, doc.height_px, K, distortion, place=place)


def rig_of(cameras: CamerasDoc, extrinsics: ExtrinsicsDoc, path: Path) -> Rig:
    """Depth and colour of the `cameras` and `extrinsics` groups as `Rig`."""
    depth = camera_of(cameras.depth, "cameras.depth", path)
    if cameras.color is None:
        return make_rig(depth, place=path)
    color, T_color_depth = camera_of(cameras.color, "cameras.color", path), _extrinsic(extrinsics, "color", path)
    return make_rig(depth, color, T_color_depth, place=f"{path}: key 'extrinsics'")


def _extrinsic(extrinsics: ExtrinsicsDoc, name: str, path: Path) -> np.ndarray:
    key = f"T_{name}_depth"
    rows = getattr(extrinsics, key)
    if rows is None:
        hint = 'a camera that is not on the rig: set cameras.thermal.mount to "free"' if name == "thermal" else None
        raise ScanError(f"key 'extrinsics.{key}' is needed for the {name} camera", place=path, hint=hint)
    return matrix_of(rows, f"extrinsics.{key}", path)


def matrix_of(rows: list[list[float]], key: str, path: Path) -> np.ndarray:
    """A transform (4, 4), rotation and translation [m], of a JSON list. Raises ScanError that names the key."""
    if [len(r) for r in rows] != [4] * 4:
        raise ScanError(f"key '{key}': expected a 4x4 matrix", place=path)
    T = np.array(rows, np.float64)
    if np.abs(T[:3, 3]).max() > MAX_BASELINE_M:
        raise ScanError(f"key '{key}': cameras more than {MAX_BASELINE_M:g} m apart, expected metres", place=path)
    return T


_NEEDED = {
    "polynomial": ("coefficients_degC",),
    "linear_kelvin": ("gain_K", "offset_K"),
    "planck": ("R", "B", "F", "O"),
    "table": ("counts", "degC"),
}


def thermal_camera_of(doc: ThermalCameraDoc, extrinsics: ExtrinsicsDoc, path: Path) -> ThermalCamera:
    """The thermal camera's group with its extrinsic as `ThermalCamera`; without a signal (a rig.json) the default."""
    lo, hi = doc.band_um
    if not (lo >= 1 and lo + MIN_BAND_UM <= hi <= 30):
        text = f"expected two wavelengths in 1-30 um that rise by at least {MIN_BAND_UM} um, got {lo}, {hi}"
        raise ScanError(f"key 'cameras.thermal.band_um': {text}", place=path)
    lens = camera_of(doc, "cameras.thermal", path)
    T = np.eye(4) if doc.mount == "free" else _extrinsic(extrinsics, "thermal", path)
    signal = SignalCurve() if doc.signal is None else signal_of(doc.signal, path)
    try:
        own = signal, doc.band_um, doc.netd_K, doc.time_offset_s, doc.psf_sigma_px, doc.mount
        return ThermalCamera(lens, T, *own, None if doc.scatter is None else doc.scatter.lens_scatter())
    except ValueError as e:
        raise ScanError(str(e), place=f"{path}: key 'extrinsics'") from None


def signal_of(doc: SignalDoc, path: Path) -> SignalCurve:
    """A signal group as a curve. Raises ScanError."""
    if doc.kind != "counts":
        return SignalCurve(doc.kind)
    if doc.curve is None:
        raise ScanError("key 'cameras.thermal.signal.curve' is needed for counts", place=path)
    return SignalCurve("counts", doc.curve.type, _curve_parameters(doc.curve, path))


def curve_of_file(path: Path) -> SignalCurve:
    """A curve of counts from a JSON file: the `curve` group, or a `signal` group, of scan.json. Raises ScanError."""
    tree = read_json(path)
    if isinstance(tree, dict) and "kind" in tree:
        return signal_of(validated(SignalDoc, tree, path), path)
    doc = validated(CurveDoc, tree, path)
    return SignalCurve("counts", doc.type, _curve_parameters(doc, path))


def _curve_parameters(doc: CurveDoc, path: Path) -> dict[str, tuple[float, ...]]:
    """The curve's numbers, checked to be a curve that can be inverted."""
    key = "cameras.thermal.signal.curve"
    p: dict[str, tuple[float, ...]] = {}
    for name in _NEEDED[doc.type]:
        value = getattr(doc, name)
        if value is None:
            raise ScanError(f"key '{key}.{name}' is needed for a {doc.type} curve", place=path)
        p[name] = tuple(value) if isinstance(value, list) else (float(value),)
    if doc.type == "polynomial" and not any(p["coefficients_degC"][1:]):
        raise ScanError(f"key '{key}.coefficients_degC': the temperature must depend on the counts", place=path)
    if doc.type == "linear_kelvin" and p["gain_K"][0] == 0:
        raise ScanError(f"key '{key}.gain_K' must not be 0", place=path)
    if doc.type == "planck" and not (p["R"][0] > 0 and p["B"][0] > 0):
        raise ScanError(f"key '{key}': R and B of a planck curve must be positive", place=path)
    if doc.type == "table":
        counts, degC = np.array(p["counts"]), np.array(p["degC"])
        if len(counts) != len(degC) or len(counts) < 2:
            raise ScanError(f"key '{key}': counts and degC must be two equally long lists, at least 2 each", place=path)
        steps = np.diff(degC)
        if not (np.diff(counts) > 0).all() or not ((steps > 0).all() or (steps < 0).all()):
            raise ScanError(f"key '{key}': counts must rise strictly and degC must be monotone", place=path)
    return p


def reference_of(doc: BlackbodyDoc | ContactDoc, key: str, thermal: Camera | None, path: Path) -> Reference:
    """A reference group; key : its own, for messages. A polygon must lie in the image of the thermal camera's lens."""
    if isinstance(doc, BlackbodyDoc):
        polygon = np.array(doc.thermal_polygon_px, np.float64)
        if thermal is not None and (polygon > [thermal.width_px - 0.5, thermal.height_px - 0.5]).any():
            size = f"{thermal.width_px} x {thermal.height_px} px"
            raise ScanError(f"key '{key}.thermal_polygon_px': beyond the thermal image of {size}", place=path)
        return BlackbodyReference(doc.degC, doc.uncertainty_K, doc.emissivity, polygon, tuple(doc.frames))
    return ContactReference(doc.degC, doc.uncertainty_K, np.array(doc.p_world_m, np.float64))


def material_of(doc: MaterialDoc, key: str, thermal: Camera | None, path: Path) -> Material:
    """A material group; key : its own, for messages. Labels are read from their file beside scan.json."""
    polygons = []
    for i, p in enumerate(doc.polygons):
        corners = np.array(p.thermal_polygon_px, np.float64)
        if thermal is None or (corners > [thermal.width_px - 0.5, thermal.height_px - 0.5]).any():
            size = "" if thermal is None else f" of {thermal.width_px} x {thermal.height_px} px"
            raise ScanError(f"key '{key}.polygons.{i}.thermal_polygon_px': beyond the thermal image{size}", place=path)
        polygons.append((p.frame, corners))
    section = doc.emissivity
    emissivity = section.model_dump(exclude_unset=True) if isinstance(section, EmissivitySection) else section
    vertices, of_vertices = np.unique(np.array(doc.vertices, np.int64)), doc.of_vertices
    if doc.labels is not None:
        file = inside(path.parent, doc.labels, place=f"{path}: key '{key}.labels'")
        (labels,) = read_npz(file, "label file", ["labels"], hint="an .npz with `labels`, a whole number a vertex")
        if labels.ndim != 1 or labels.dtype.kind not in "biu":
            raise ScanError("`labels` must be one whole number a vertex", place=file)
        if of_vertices not in (0, len(labels)):
            raise ScanError(f"key '{key}.of_vertices': {of_vertices}, but there are {len(labels)} labels", place=path)
        vertices, of_vertices = np.union1d(vertices, np.flatnonzero(labels == doc.label)), len(labels)
    if of_vertices and vertices.max(initial=0) >= of_vertices:
        raise ScanError(f"key '{key}.vertices': {vertices.max()} is none of {of_vertices} vertices", place=path)
    where = tuple(polygons), vertices.astype(np.int32), of_vertices
    return Material(doc.name, emissivity, doc.sigma_emissivity0, doc.not_skin, doc.counts_as_skin, *where)


def unknown_keys(doc: BaseModel, prefix: str = "") -> list[str]:
    """Keys that the schema does not know, dotted."""
    keys = [prefix + k for k in (doc.model_extra or {})]
    for name in type(doc).model_fields:
        value = getattr(doc, name)
        if isinstance(value, BaseModel):
            keys += unknown_keys(value, f"{prefix}{name}.")
    return keys
