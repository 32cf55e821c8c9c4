"""The nouns of the method: frozen, validated, independent of files and of Open3D.

Conventions (docs/conventions.md): metres, seconds, pixels; `T_a_b` takes a point from frame b to frame a; camera frames
are x right, y down, z forward; the centre of the first pixel is (0, 0). NaN means unmeasured, never 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import IntFlag
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

if TYPE_CHECKING:
    from pandas import DataFrame
    from pyvista import PolyData

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int = NDArray[np.int32]
Bool = NDArray[np.bool_]
UInt8 = NDArray[np.uint8]
UInt16 = NDArray[np.uint16]

RIGID_TOLERANCE = 1e-4  # deviation of RᵀR from identity: hand-typed extrinsics carry 5-6 digits


def brief(noun: object) -> str:
    """One line for an object that holds arrays: their shapes instead of their numbers."""

    def shown(value: object) -> str:
        if isinstance(value, np.ndarray):
            return f"{value.dtype} {value.shape}"
        if isinstance(value, tuple | list | dict) and len(value) > 3:
            return f"{len(value)} of them"
        text = repr(value)
        return text if len(text) <= 40 and "\n" not in text else f"<{type(value).__name__}>"

    said = ", ".join(f"{f.name}={shown(getattr(noun, f.name))}" for f in fields(noun))  # type: ignore[arg-type]
    return f"{type(noun).__name__}({said if len(said) <= 160 else said[:157] + '...'})"


ORTHONORMAL = 1e-14  # rounding: what is a rotation to this stays as it is, so that it may be stored and read again


def check_rigid(T: object, name: str) -> Float:
    """A rigid transform (4, 4) [m] as float64, rotation re-orthonormalised. Raises ValueError naming `name`."""
    M = np.asarray(T, dtype=np.float64)
    if M.shape != (4, 4):
        raise ValueError(f"{name} must be a 4x4 matrix, got shape {M.shape}")
    if not np.isfinite(M).all():
        raise ValueError(f"{name} has entries that are not finite numbers")
    R = M[:3, :3]
    if np.abs(R).max() > 2 or np.abs(R.T @ R - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError(f"{name} is no rigid transform: its 3x3 part is not a rotation")
    if np.abs(M[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise ValueError(f"{name} must have the last row 0 0 0 1")
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, M[:3, 3]
    if np.abs(R.T @ R - np.eye(3)).max() > ORTHONORMAL:
        U, _, Vt = np.linalg.svd(R)
        out[:3, :3] = U @ Vt
    return out


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV distortion.

    Attributes
    ----------
    width_px, height_px : image size.
    K : (3, 3) intrinsic matrix, pixels, first pixel centre at (0, 0).
    distortion : (5,) `[k1 k2 p1 p2 k3]` or (8,) rational `[k1 k2 p1 p2 k3 k4 k5 k6]`, OpenCV order; zeros = none.

    Raises ValueError if K is not an intrinsic matrix or the distortion has another length.
    """

    width_px: int
    height_px: int
    K: Float
    distortion: Float = field(default_factory=lambda: np.zeros(5))

    def __post_init__(self) -> None:
        K, d = np.asarray(self.K, dtype=np.float64), np.asarray(self.distortion, dtype=np.float64).ravel()
        if not (0 < self.width_px <= 32767 and 0 < self.height_px <= 32767):
            raise ValueError(f"an image of {self.width_px} x {self.height_px} px is not usable")
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise ValueError("K must be a finite 3x3 matrix")
        if K[0, 0] <= 0 or K[1, 1] <= 0 or np.abs(K[2] - [0, 0, 1]).max() > 1e-9 or abs(K[1, 0]) > 1e-9:
            raise ValueError("K is not a camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        if abs(K[0, 1]) > 1e-9:
            raise ValueError("K has a skew term, which no step supports")
        if d.size in (0, 1):
            d = np.zeros(5)
        if d.size == 4:
            d = np.append(d, 0.0)
        if d.size not in (5, 8) or not np.isfinite(d).all():
            raise ValueError("distortion must be [k1 k2 p1 p2 k3] or the 8-term rational form")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion", d)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of an image array."""
        return self.height_px, self.width_px

    @property
    def focal_px(self) -> float:
        """Geometric mean of fx and fy."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    @property
    def is_distorted(self) -> bool:
        return bool(np.any(self.distortion != 0))

    def __repr__(self) -> str:
        lens = "distorted" if self.is_distorted else "pinhole"
        return f"<Camera {self.width_px} x {self.height_px} px, focal length {self.focal_px:.1f} px, {lens}>"


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras that see shape: depth, and colour with its extrinsic (the thermal camera comes with its stream)."""

    depth: Camera
    color: Camera | None = None
    T_color_depth: Float | None = None

    def __post_init__(self) -> None:
        if (self.color is None) != (self.T_color_depth is None):
            raise ValueError("the color camera and T_color_depth must be given together")
        if self.T_color_depth is not None:
            object.__setattr__(self, "T_color_depth", check_rigid(self.T_color_depth, "T_color_depth"))

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class SignalCurve:
    """How a stored thermal pixel becomes a temperature.

    kind : `counts` (through one of the curves), `apparent_degC`, or `radiance` (W m-2 sr-1 in band).
    curve : `polynomial` (T_degC = Σ c_i g^i, Eq. 1), `linear_kelvin`, `planck` (T_K = B / ln(R/(S-O) + F)), `table`,
        or `none`.
    parameters : by curve: `coefficients_degC`; `gain_K`, `offset_K`; `R B F O`; `counts`, `degC`.
    """

    kind: Literal["counts", "apparent_degC", "radiance"] = "apparent_degC"
    curve: Literal["polynomial", "linear_kelvin", "planck", "table", "none"] = "none"
    parameters: dict[str, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class LensScatter:
    """Light that a lens spreads widely (see `physics.scatter`).

    parts : (share of the light, one sigma of the Gaussian that it is spread over [image widths]) each. sigma : one
    sigma of the whole share. stated : the lens was measured by itself. differs : share by which the halo of the scan
    differs from what was stated, 0 = not beyond doubt.
    """

    parts: tuple[tuple[float, float], ...]
    sigma: float
    stated: bool = False
    differs: float = 0.0

    @property
    def share(self) -> float:
        """Of all light."""
        return sum(g for g, _ in self.parts)

    @property
    def unit(self) -> LensScatter:
        """The same shape with all of the light spread; of one part where there is none."""
        total = self.share
        if total:
            return LensScatter(tuple((g / total, w) for g, w in self.parts), 0.0)
        return LensScatter(((1.0, self.parts[0][1]),), 0.0)


@dataclass(frozen=True, eq=False)
class ThermalCamera:
    """The thermal camera: its lens, its signal, where it sits on the rig and what its clock says.

    lens : pinhole and distortion. T_thermal_depth : (4, 4). band_um : wavelengths it sees. netd_K : noise of a pixel,
    one sigma. time_offset_s : added to a thermal frame's own time to get the depth clock's. psf_sigma_px : optical and
    pixel point spread; None = not measured. mount : `free` = not on the depth camera's rig: T_thermal_depth and
    time_offset_s then mean nothing. scatter : light that the lens spreads widely; None = not measured. Raises
    ValueError for a transform that is not rigid.
    """

    lens: Camera
    T_thermal_depth: Float
    signal: SignalCurve = field(default_factory=SignalCurve)
    band_um: tuple[float, float] = (7.5, 13.5)
    netd_K: float = 0.05
    time_offset_s: float = 0.0
    psf_sigma_px: float | None = None
    mount: Literal["rig", "free"] = "rig"
    scatter: LensScatter | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_thermal_depth", check_rigid(self.T_thermal_depth, "T_thermal_depth"))

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Environment:
    """The room. None = the recording does not say."""

    reflected_degC: float | None = None
    air_degC: float | None = None
    relative_humidity_pct: float | None = None


@dataclass(frozen=True, eq=False)
class BlackbodyReference:
    """A source of known temperature that stands in some thermal frames, at a fixed place in the image."""

    degC: float
    uncertainty_K: float
    emissivity: float
    polygon_px: Float  # (N, 2) thermal pixels
    frames: tuple[int, ...]  # `index` of thermal frames
    kind: Literal["blackbody"] = "blackbody"

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class ContactReference:
    """A thermometer's reading at a point of the skin."""

    degC: float
    uncertainty_K: float
    p_world_m: Float  # (3,)
    kind: Literal["contact"] = "contact"

    __repr__ = brief


Reference = BlackbodyReference | ContactReference


@dataclass(frozen=True, eq=False)
class Material:
    """Part of the surface that is not bare skin, as the user states it.

    emissivity : keys of the recipe's `temperature.emissivity`; `skin` = as the recipe has it; None = its temperature
    cannot be read. sigma_emissivity0 : of its ε(0), None = not stated. not_skin : all that is found not to behave as
    skin belongs to it. counts_as_skin : a film as warm as the skin below it: means over skin take it in. polygons_px :
    (thermal frame's `index`, (N, 2) pixels) each. vertices : (M,) of the surface, whose number of_vertices tells
    whether it still is the same; 0 = not told.
    """

    name: str
    emissivity: dict[str, object] | Literal["skin"] | None
    sigma_emissivity0: float | None = None
    not_skin: bool = False
    counts_as_skin: bool = False
    polygons_px: tuple[tuple[int, Float], ...] = ()
    vertices: Int = field(default_factory=lambda: np.zeros(0, np.int32))
    of_vertices: int = 0

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Stream:
    """One camera's images in time order.

    times_s : (N,) float64, strictly increasing, this stream's own clock.
    load : i -> image. Depth: (H, W) float32 metres, NaN = none. Colour: (H, W, 3) uint8 sRGB in R, G, B order.
        Thermal: (H, W) as stored (uint16 counts, float32 °C or radiance): `radiometry` converts.
    places : where each image came from, for messages.
    index : (N,) the recording's own numbers (references name thermal frames by them).
    usable : (N,) False for thermal frames during or just after a shutter correction, and frames a reader rejects.
    """

    times_s: Float
    load: Callable[[int], NDArray]
    places: tuple[str, ...]
    index: NDArray[np.int64]
    usable: Bool

    def __post_init__(self) -> None:
        if not (len(self.times_s) == len(self.places) == len(self.index) == len(self.usable)):
            raise ValueError("times, places, index and usable of a stream differ in length")

    def __len__(self) -> int:
        return len(self.times_s)

    def kept(self, most_bytes: int) -> Self:
        """The same; images stay in memory, read-only, once they were loaded, as many as fit into `most_bytes`."""
        images: dict[int, NDArray] = {}

        def load(i: int) -> NDArray:
            image = images.get(i)
            if image is None:
                image = self.load(i)
                if (len(images) + 1) * image.nbytes <= most_bytes:
                    image.flags.writeable = False
                    images[i] = image
            return image

        return replace(self, load=load)

    def __repr__(self) -> str:
        span_s = float(self.times_s[-1] - self.times_s[0]) if len(self) else 0.0
        return f"<{type(self).__name__} of {len(self)} frames over {span_s:.2f} s, {int(self.usable.sum())} usable>"


@dataclass(frozen=True, eq=False)
class FrameConditions:
    """What was measured beside each frame of a thermal stream: (N,) float64 each, NaN = not stated for that frame.

    The names are those of the columns of frames.csv. fpa_degC : of the sensor itself.
    """

    reflected_degC: Float
    air_degC: Float
    relative_humidity_pct: Float
    fpa_degC: Float
    lens_degC: Float

    @classmethod
    def of(cls, n: int, known: Mapping[str, NDArray]) -> FrameConditions | None:
        """Of n frames, from the columns (n,) that are known; None where nothing is stated."""
        if not any(np.isfinite(column).any() for column in known.values()):
            return None
        return cls(**{f.name: np.asarray(known.get(f.name, np.full(n, np.nan)), np.float64) for f in fields(cls)})

    @property
    def stated(self) -> dict[str, Float]:
        """The columns (N,) that state anything, by name."""
        return {name: column for name, column in vars(self).items() if np.isfinite(column).any()}

    def take(self, rows: NDArray) -> FrameConditions:
        """Of some frames, (M,) positions."""
        return FrameConditions(**{name: column[rows] for name, column in vars(self).items()})

    __repr__ = brief


@dataclass(frozen=True, eq=False, repr=False)
class ThermalStream(Stream):
    """The thermal camera's images, and the camera that took them.

    conditions : of each frame; None where the recording states them at most once for all.
    """

    camera: ThermalCamera
    conditions: FrameConditions | None = None

    @property
    def depth_times_s(self) -> Float:
        """(N,) the frames' times on the depth clock, s."""
        return self.times_s + self.camera.time_offset_s


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of the depth camera.

    times_s : (N,) strictly increasing, depth clock. T_world_depth : (N, 4, 4).
    """

    times_s: Float
    T_world_depth: Float

    def __post_init__(self) -> None:
        t, T = np.asarray(self.times_s, np.float64), np.asarray(self.T_world_depth, np.float64)
        if T.shape != (len(t), 4, 4):
            raise ValueError(f"a trajectory of {len(t)} times needs ({len(t)}, 4, 4) poses, got {T.shape}")
        if not (np.isfinite(t).all() and np.isfinite(T).all()):
            raise ValueError("the trajectory has a pose that is not finite")
        if len(t) > 1 and not (np.diff(t) > 0).all():
            raise ValueError("the trajectory's times run backwards or repeat")
        object.__setattr__(self, "times_s", np.ascontiguousarray(t))  # sums depend on how numbers lie in memory,
        object.__setattr__(self, "T_world_depth", np.ascontiguousarray(T))  # and stored ones lie like this

    def __len__(self) -> int:
        return len(self.times_s)

    def __repr__(self) -> str:
        span_s = float(self.times_s[-1] - self.times_s[0]) if len(self) else 0.0
        walked_m = float(np.linalg.norm(np.diff(self.T_world_depth[:, :3, 3], axis=0), axis=1).sum())
        return f"<Trajectory of {len(self)} poses over {span_s:.2f} s, {walked_m:.2f} m long>"


@dataclass(frozen=True, eq=False)
class Scan:
    """A recording, whatever format it came from: the one input of the method."""

    name: str
    root: Path
    format: str
    rig: Rig
    depth: Stream
    color: Stream | None = None
    thermal: ThermalStream | None = None
    environment: Environment = field(default_factory=Environment)
    references: tuple[Reference, ...] = ()
    materials: tuple[Material, ...] = ()
    trajectory: Trajectory | None = None
    depth_unit_m: float = 0.001
    depth_up: tuple[float, float, float] = (0.0, -1.0, 0.0)  # which way is up for the depth camera as it was held
    recorded_at: str | None = None
    subject: dict[str, object] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # what the reader had to assume, or kept without understanding
    times_assumed: bool = False  # no clock was recorded: frames stand at a nominal rate, and speeds mean nothing

    def __repr__(self) -> str:
        streams = {n: s for n in ("depth", "color", "thermal") if (s := getattr(self, n)) is not None}
        frames = ", ".join(f"{len(stream)} {name}" for name, stream in streams.items())
        return f"<Scan {self.name[:40]!r} ({self.format}): {frames} frames, {len(self.references)} references>"


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """A triangle mesh in the world frame.

    vertices_m : (V, 3) float32. triangles : (F, 3) int32, counter-clockwise from outside. normals : (V, 3) float32,
    unit, outward, smoothed over the recipe's window. color_rgb : (V, 3) uint8 sRGB of the colour camera, or None.
    """

    vertices_m: Float32
    triangles: Int
    normals: Float32
    color_rgb: UInt8 | None = None

    def __len__(self) -> int:
        return len(self.vertices_m)

    def __repr__(self) -> str:
        colored = "" if self.color_rgb is None else ", coloured"
        return f"<SurfaceMesh of {len(self)} vertices, {len(self.triangles)} triangles{colored}>"


@dataclass(frozen=True, eq=False)
class Observations:
    """Every time a thermal view saw a vertex, as columns of equal length N, sorted by (view, vertex).

    vertex : (N,) int32. view : (N,) int32, row of the thermal views used. radiance : (N,) float32, in band, W m-2 sr-1,
    as the camera reports it (apparent). cos_angle : (N,) float32, of the angle between normal and the pixel's own ray.
    range_m : (N,) float32. footprint_m2 : (N,) float32 = range²/(f² cosθ), surface area seen by a pixel.
    u_px, v_px : (N,) float32 image position. edge_px : (N,) float32 distance to the nearest silhouette, capped.
    """

    vertex: Int
    view: Int
    radiance: Float32
    cos_angle: Float32
    range_m: Float32
    footprint_m2: Float32
    u_px: Float32
    v_px: Float32
    edge_px: Float32

    def __len__(self) -> int:
        return len(self.vertex)

    def select(self, mask: NDArray) -> Observations:
        """The rows of a boolean mask (N,) or an index array (M,)."""
        rows = np.flatnonzero(mask) if mask.dtype == bool else mask  # one look through the mask, not one a column
        return Observations(**{k: getattr(self, k).take(rows) for k in self.__dataclass_fields__})

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class ThermalViews:
    """The thermal frames that entered the result, one row a view.

    frame : (N,) position in the thermal stream. times_s : (N,) on the depth clock, offset included.
    T_world_thermal : (N, 4, 4).
    """

    frame: Int
    times_s: Float
    T_world_thermal: Float

    def __len__(self) -> int:
        return len(self.frame)

    __repr__ = brief


@dataclass(frozen=True)
class SkinPoint:
    """What a result says of one place: the vertex nearest to it, m; temperature and sigma, °C and K, NaN unmeasured.

    vertex : its index. off_m : how far it lies from the place that was asked for.
    """

    vertex: int
    p_world_m: tuple[float, float, float]
    off_m: float
    temperature_degC: float
    uncertainty_K: float
    apparent_degC: float
    view_angle_deg: float
    observations: int
    flags: VertexFlag


class VertexFlag(IntFlag):
    """What a reader of a vertex's temperature must know; one bit each, 0 = nothing to say."""

    UNMEASURED = 1  # no thermal view counts here: the temperature is NaN
    SINGLE_VIEW = 2  # one view only: nothing checks it
    OBLIQUE = 4  # the best view is steeper than the recipe's limit
    CAVITY = 8  # the spot sees much of the body itself (armpit, fold)
    HIGH_RESIDUAL = 16  # views disagree by more than their uncertainty explains
    MOVED = 32  # the subject moved between views
    NOT_SKIN = 64  # hair, clothes: the reading does not change with the angle as skin's does


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """What the errors of many vertices have in common: a mean over them does not average it away.

    names : what each of R independent causes is. effect : (V, R) int8, what one sigma of a cause does to a vertex,
    signed, in steps of step_K (R,); 0 where unmeasured. focal_px : of the thermal camera: a pixel's size on the skin.
    normal_window_m : diameter over which the normals' errors are one.
    """

    names: tuple[str, ...]
    effect: NDArray[np.int8]
    step_K: Float32
    focal_px: float
    normal_window_m: float

    @classmethod
    def of(cls, effects_K: dict[str, NDArray], focal_px: float, normal_window_m: float) -> SharedErrors:
        """From the effects (V,) of each cause, K, by name; NaN = unmeasured."""
        columns = np.nan_to_num(np.stack(list(effects_K.values()), axis=1)).astype(np.float32)
        step = np.maximum(np.abs(columns).max(axis=0, initial=0) / np.float32(127), np.float32(1e-9))
        return cls(tuple(effects_K), np.round(columns / step).astype(np.int8), step, focal_px, normal_window_m)


def cause_of(name: str) -> str:
    """The cause that a shared error belongs to: "reflected 3" is one of the errors of "reflected"."""
    return name.split()[0]


@dataclass(frozen=True)
class BudgetInput:
    """One input of an uncertainty budget: value and standard uncertainty u in `unit` (1 = none); kind "A" or "B" of the
    GUM; freedom : its degrees of freedom, inf = many."""

    name: str
    value: float
    u: float
    unit: str
    kind: str
    freedom: float


OutputMode = Literal["absolute", "normal-equivalent", "apparent"]


@dataclass(frozen=True, eq=False)
class ThermalMesh:
    """The result: a surface whose every vertex carries a temperature. All arrays are per vertex, (V,).

    temperature_degC : float32, NaN = unmeasured; in the sense of `mode`. anchored : False = the level is relative
    (no reference settled it). apparent_degC : as a blackbody camera would read it, mean of the views. uncertainty_K
    : one sigma of `temperature_degC`. view_angle_deg, distance_m : best (straightest) view's. observations : int32,
    thermal views that count. flags : uint8, bits of `VertexFlag`; UNMEASURED is set here wherever the temperature
    is NaN. uncertainty_parts : named parts of the budget, K, float32. residual : float32, rms of the views about a
    vertex in sigmas of their own errors (1 = as expected, NaN = one view), or None where that is not known. moved_mm :
    float32, rms of each vertex's motion against the trunk while it was recorded, mm, or None for a subject that stood
    still as far as can be told.
    metadata : frame, units, recipe, version, and `up` and `front` as "x y z" in the world frame (see
    `export.axes`). Raises ValueError on lengths or values that cannot be.
    """

    surface: SurfaceMesh
    temperature_degC: Float32
    mode: OutputMode
    anchored: bool
    apparent_degC: Float32
    uncertainty_K: Float32
    view_angle_deg: Float32
    distance_m: Float32
    observations: Int
    flags: UInt8
    uncertainty_parts: dict[str, Float32] = field(default_factory=dict)
    metadata: dict[str, str | float] = field(default_factory=dict)
    residual: Float32 | None = None
    moved_mm: Float32 | None = None

    def __post_init__(self) -> None:
        if self.mode not in get_args(OutputMode):
            raise ValueError(f"the output mode must be one of {', '.join(get_args(OutputMode))}, got '{self.mode}'")
        columns = {n: getattr(self, n) for n in ("temperature_degC", "apparent_degC", "uncertainty_K")}
        columns |= {n: getattr(self, n) for n in ("view_angle_deg", "distance_m")}
        for name, values in columns.items():
            object.__setattr__(self, name, self._column(values, name, np.float32))
        object.__setattr__(self, "observations", self._column(self.observations, "observations", np.int32))
        flags = self._column(self.flags, "flags", np.uint8) & np.uint8(0xFF & ~VertexFlag.UNMEASURED)
        unmeasured = np.isnan(self.temperature_degC).astype(np.uint8) * np.uint8(VertexFlag.UNMEASURED)
        object.__setattr__(self, "flags", flags | unmeasured)
        parts = {k: self._column(v, f"uncertainty_parts['{k}']", np.float32) for k, v in self.uncertainty_parts.items()}
        object.__setattr__(self, "uncertainty_parts", parts)
        for name in ("residual", "moved_mm"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, self._column(getattr(self, name), name, np.float32))

    def _column(self, values: object, name: str, dtype: DTypeLike) -> NDArray:
        try:
            with np.errstate(invalid="raise", over="raise"):
                column = np.ascontiguousarray(values, dtype=dtype)
        except FloatingPointError:
            raise ValueError(f"{name} has a value that does not fit {np.dtype(dtype).name}") from None
        if column.shape != (len(self.surface),):
            raise ValueError(f"{name} has shape {column.shape}, the surface has {len(self.surface)} vertices")
        if np.isinf(column).any():
            raise ValueError(f"{name} has an infinite value; NaN means unmeasured")
        return column

    def __len__(self) -> int:
        return len(self.surface)

    @property
    def measured(self) -> Bool:
        """(V,) True where there is a temperature."""
        return ~np.isnan(self.temperature_degC)

    def __repr__(self) -> str:
        T = self.temperature_degC[self.measured]
        level = "" if self.mode == "apparent" else ", anchored" if self.anchored else ", relative"
        spread = f"{np.median(T):.2f} °C median" if len(T) else "no temperature"
        return f"<ThermalMesh of {len(self)} vertices, {len(T)} measured: {spread}, {self.mode}{level}>"

    def at(self, point_m: ArrayLike) -> SkinPoint:
        """What is known at the vertex nearest to point_m (3,), in the mesh's world frame, m. Raises ValueError."""
        p = np.asarray(point_m, np.float64)
        if p.shape != (3,) or not np.isfinite(p).all() or not len(self):
            raise ValueError(f"a point on a mesh is three finite coordinates in metres, got {point_m!r}")
        off_m = np.linalg.norm(self.surface.vertices_m - p, axis=1)
        i = int(np.argmin(off_m))
        x, y, z = self.surface.vertices_m[i].tolist()
        return SkinPoint(
            vertex=i,
            p_world_m=(x, y, z),
            off_m=float(off_m[i]),
            temperature_degC=float(self.temperature_degC[i]),
            uncertainty_K=float(self.uncertainty_K[i]),
            apparent_degC=float(self.apparent_degC[i]),
            view_angle_deg=float(self.view_angle_deg[i]),
            observations=int(self.observations[i]),
            flags=VertexFlag(int(self.flags[i])),
        )

    def columns(self) -> dict[str, NDArray]:
        """Name -> one value a vertex, (V,): the columns of docs/formats.md, in the units of their names."""
        names = ("temperature_degC", "apparent_degC", "uncertainty_K", "view_angle_deg", "distance_m")
        columns: dict[str, NDArray] = {n: getattr(self, n) for n in (*names, "observations", "flags")}
        columns |= {n: v for n in ("residual", "moved_mm") if (v := getattr(self, n)) is not None}
        return columns | {f"uncertainty_{part}_K": v for part, v in self.uncertainty_parts.items()}

    def to_dataframe(self) -> DataFrame:
        """A pandas table, one row a vertex: x_m, y_m, z_m and the columns (V,). Raises ImportError without pandas."""
        try:
            from pandas import DataFrame
        except ImportError as e:
            raise ImportError(f"to_dataframe needs pandas ({e}): `pip install pandas`") from None
        place = dict(zip(("x_m", "y_m", "z_m"), self.surface.vertices_m.T, strict=True))
        return DataFrame({**place, **self.columns()})

    def to_pyvista(self) -> PolyData:
        """A PyVista surface, points in m, the columns (V,) as point data. Raises ImportError without pyvista."""
        try:
            from pyvista import PolyData
        except ImportError as e:
            raise ImportError(f"to_pyvista needs PyVista ({e}): `pip install pyvista`") from None
        triangles = self.surface.triangles
        faces = np.column_stack([np.full(len(triangles), 3, np.int64), triangles]).ravel()
        drawn = PolyData(self.surface.vertices_m, faces)
        for name, values in {"Normals": self.surface.normals, **self.columns()}.items():
            drawn.point_data[name] = values
        drawn.set_active_scalars("temperature_degC")
        return drawn

    @classmethod
    def from_temperature(
        cls,
        surface: SurfaceMesh,
        temperature_degC: NDArray,
        *,
        mode: OutputMode = "absolute",
        anchored: bool = True,
        metadata: dict[str, str | float] | None = None,
    ) -> ThermalMesh:
        """A mesh of which only temperature_degC (V,) is known (a truth, a foreign file): everything else NaN or 0."""
        nan = np.full(len(surface), np.nan, np.float32)
        count, flags = np.zeros(len(surface), np.int32), np.zeros(len(surface), np.uint8)
        known = dict(metadata or {})
        return cls(surface, temperature_degC, mode, anchored, nan, nan, nan, nan, count, flags, metadata=known)
