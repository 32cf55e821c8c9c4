"""The native scan folder: scan.json + frames.csv + images (docs/scan-format.md). pydantic stands at this border."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.spatial.transform import Rotation

from ..errors import ScanError
from ..types import (
    BlackbodyReference,
    Camera,
    ContactReference,
    Environment,
    Reference,
    Rig,
    Scan,
    SignalCurve,
    Stream,
    ThermalSensor,
    Trajectory,
)
from .files import depth_from_raw, inside, read_image

SCHEMA = "thermofusion-scan/1"
STREAMS = ("depth", "color", "thermal")


class _Border(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class _Curve(_Border):
    type: Literal["polynomial", "linear_kelvin", "planck", "table"]
    coefficients_degC: list[float] | None = None
    gain_K: float | None = None
    offset_K: float | None = None
    R: float | None = None
    B: float | None = None
    F: float | None = None
    O: float | None = None  # noqa: E741 - the Planck curve's own letter
    counts: list[float] | None = None
    degC: list[float] | None = None


class _Signal(_Border):
    kind: Literal["counts", "apparent_degC", "radiance"]
    curve: _Curve | None = None


class _Camera(_Border):
    width_px: int = Field(gt=0, le=32767)
    height_px: int = Field(gt=0, le=32767)
    K: list[list[float]]
    distortion: list[float] = []


class _DepthCamera(_Camera):
    depth_unit_m: float = Field(0.001, gt=1e-6, le=0.1)


class _ThermalCamera(_Camera):
    signal: _Signal
    band_um: tuple[float, float] = (7.5, 13.5)
    netd_K: float = Field(0.05, gt=0)
    time_offset_s: float = 0.0
    psf_sigma_px: float | None = Field(None, gt=0)


class _Cameras(_Border):
    depth: _DepthCamera
    color: _Camera | None = None
    thermal: _ThermalCamera | None = None


class _Extrinsics(_Border):
    T_color_depth: list[list[float]] | None = None
    T_thermal_depth: list[list[float]] | None = None


class _Environment(_Border):
    reflected_degC: float | None = Field(None, gt=-100, lt=200)
    air_degC: float | None = Field(None, gt=-100, lt=200)
    relative_humidity_pct: float | None = Field(None, ge=0, le=100)


class _Blackbody(_Border):
    kind: Literal["blackbody"]
    degC: float
    uncertainty_K: float = Field(ge=0)
    emissivity: float = Field(1.0, gt=0, le=1)
    thermal_polygon_px: list[tuple[float, float]] = Field(min_length=3)
    frames: list[int]


class _Contact(_Border):
    kind: Literal["contact"]
    degC: float
    uncertainty_K: float = Field(ge=0)
    p_world_m: tuple[float, float, float]


class _ScanJson(_Border):
    schema_: Literal["thermofusion-scan/1"] = Field(alias="schema")
    name: str = "scan"
    recorded_at: str | None = None
    cameras: _Cameras
    extrinsics: _Extrinsics = _Extrinsics()
    environment: _Environment = _Environment()
    references: list[Annotated[_Blackbody | _Contact, Field(discriminator="kind")]] = []
    subject: dict[str, Any] = {}


def is_native(root: Path) -> bool:
    """True if the folder holds a scan.json."""
    return (root / "scan.json").is_file()


def read_native(root: Path) -> Scan:
    """Open a native scan folder. Images are decoded when asked for; everything else is checked here.

    Raises ScanError with the file, the key and what was expected.
    """
    path = root / "scan.json"
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ScanError("there is no scan.json here", place=root, hint="give a scan folder") from None
    except (OSError, UnicodeDecodeError) as e:
        raise ScanError(f"it cannot be read ({e})", place=path) from None
    try:
        doc = _ScanJson.model_validate(json.loads(text))
    except json.JSONDecodeError as e:
        raise ScanError(f"not valid JSON: {e.msg} at line {e.lineno}", place=path) from None
    except ValidationError as e:
        fault = e.errors()[0]
        key = ".".join(str(p) for p in fault["loc"])
        raise ScanError(f"key '{key}': {fault['msg'][0].lower()}{fault['msg'][1:]}", place=path) from None

    cameras = {name: _camera(getattr(doc.cameras, name), f"cameras.{name}", path) for name in STREAMS}
    extrinsics = {k: getattr(doc.extrinsics, k) for k in ("T_color_depth", "T_thermal_depth")}
    for name in ("color", "thermal"):
        if cameras[name] is None:
            extrinsics[f"T_{name}_depth"] = None
        elif extrinsics[f"T_{name}_depth"] is None:
            raise ScanError(f"key 'extrinsics.T_{name}_depth' is needed for the {name} camera", place=path)
    try:
        arrays = {k: None if v is None else np.array(v, np.float64) for k, v in extrinsics.items()}
        depth_camera = cameras["depth"]
        assert depth_camera is not None  # the schema requires it
        rig = Rig(
            depth_camera, cameras["thermal"], arrays["T_thermal_depth"], cameras["color"], arrays["T_color_depth"]
        )
    except ValueError as e:
        raise ScanError(f"key 'extrinsics': {e}", place=path) from None

    unit_m = doc.cameras.depth.depth_unit_m
    streams = _read_frames(root, cameras, unit_m)
    if "depth" not in streams:
        raise ScanError("no depth frames are listed", place=root / "frames.csv")
    sensor = None if doc.cameras.thermal is None else _sensor(doc.cameras.thermal, path)
    unknown = _unknown_keys(doc)
    notes = (f"scan.json keys not used here: {', '.join(unknown)}",) if unknown else ()
    trajectory_file = root / "trajectory.txt"
    return Scan(
        name=doc.name,
        root=root,
        format="native",
        rig=rig,
        depth=streams["depth"],
        color=streams.get("color"),
        thermal=streams.get("thermal"),
        sensor=sensor,
        environment=Environment(**{k: getattr(doc.environment, k) for k in Environment.__dataclass_fields__}),
        references=tuple(_reference(r) for r in doc.references),
        trajectory=read_tum_trajectory(trajectory_file) if trajectory_file.is_file() else None,
        depth_unit_m=unit_m,
        recorded_at=doc.recorded_at,
        subject=doc.subject,
        notes=notes,
    )


def read_tum_trajectory(path: Path) -> Trajectory:
    """Rows `time_s tx ty tz qx qy qz qw`, the pose T_world_depth; `#` starts a comment."""
    rows = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as e:
        raise ScanError(f"the trajectory cannot be read ({e})", place=path) from None
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(w) for w in words]
        except ValueError:
            row = []
        if len(row) != 8 or not all(math.isfinite(x) for x in row):
            raise ScanError(
                "expected eight finite numbers `time_s tx ty tz qx qy qz qw`", place=f"{path}, line {number}"
            )
        if abs(math.hypot(*row[4:]) - 1) > 0.02:
            raise ScanError("the quaternion's length is not 1", place=f"{path}, line {number}")
        rows.append(row)
    if not rows:
        raise ScanError("the trajectory has no poses", place=path, hint="delete the file to have poses estimated")
    a = np.array(rows)
    T = np.tile(np.eye(4), (len(a), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(a[:, 4:]).as_matrix()
    T[:, :3, 3] = a[:, 1:4]
    try:
        return Trajectory(a[:, 0], T)
    except ValueError as e:
        raise ScanError(str(e), place=path) from None


def _camera(doc: _Camera | None, key: str, path: Path) -> Camera | None:
    if doc is None:
        return None
    try:
        return Camera(doc.width_px, doc.height_px, np.array(doc.K, np.float64), np.array(doc.distortion, np.float64))
    except ValueError as e:
        raise ScanError(f"key '{key}': {e}", place=path) from None


def _sensor(doc: _ThermalCamera, path: Path) -> ThermalSensor:
    lo, hi = doc.band_um
    if not 1 <= lo < hi <= 30:
        raise ScanError(
            f"key 'cameras.thermal.band_um': expected two rising wavelengths in 1-30 um, got {lo}, {hi}", place=path
        )
    parameters: dict[str, tuple[float, ...]] = {}
    kind: Any = "none"
    if doc.signal.kind == "counts":
        if doc.signal.curve is None:
            raise ScanError("key 'cameras.thermal.signal.curve' is needed for counts", place=path)
        kind = doc.signal.curve.type
        needed = {
            "polynomial": ("coefficients_degC",),
            "linear_kelvin": ("gain_K", "offset_K"),
            "planck": ("R", "B", "F", "O"),
            "table": ("counts", "degC"),
        }
        for name in needed[kind]:
            value = getattr(doc.signal.curve, name)
            if value is None:
                raise ScanError(f"key 'cameras.thermal.signal.curve.{name}' is needed for a {kind} curve", place=path)
            parameters[name] = tuple(value) if isinstance(value, list) else (float(value),)
    return ThermalSensor(
        SignalCurve(doc.signal.kind, kind, parameters), doc.band_um, doc.netd_K, doc.time_offset_s, doc.psf_sigma_px
    )


def _reference(doc: _Blackbody | _Contact) -> Reference:
    if isinstance(doc, _Blackbody):
        return BlackbodyReference(
            doc.degC, doc.uncertainty_K, doc.emissivity, np.array(doc.thermal_polygon_px, np.float64), tuple(doc.frames)
        )
    return ContactReference(doc.degC, doc.uncertainty_K, np.array(doc.p_world_m, np.float64))


def _unknown_keys(doc: BaseModel, prefix: str = "") -> list[str]:
    keys = [prefix + k for k in (doc.model_extra or {}) if k not in ("model", "serial")]
    for name in type(doc).model_fields:
        value = getattr(doc, name)
        if isinstance(value, BaseModel):
            keys += _unknown_keys(value, f"{prefix}{name}.")
    return keys


def _read_frames(root: Path, cameras: dict[str, Camera | None], unit_m: float) -> dict[str, Stream]:
    path = root / "frames.csv"
    try:
        with path.open(newline="", encoding="utf-8") as f:
            reader = csv.DictReader(f)
            missing = {"stream", "index", "time_s", "path"} - set(reader.fieldnames or ())
            if missing:
                raise ScanError(f"column(s) {', '.join(sorted(missing))} are missing", place=path)
            table = list(reader)
    except FileNotFoundError:
        raise ScanError("there is no frames.csv here", place=root) from None
    except (UnicodeDecodeError, csv.Error) as e:
        raise ScanError(f"it cannot be read as CSV ({e})", place=path) from None

    columns: dict[str, list[tuple[float, int, Path, bool]]] = {}
    for number, row in enumerate(table, 2):
        stream = (row["stream"] or "").strip()
        if stream not in STREAMS:
            raise ScanError(f"stream '{stream}' is none of {', '.join(STREAMS)}", place=f"{path}, line {number}")
        try:
            index, time_s = int(row["index"]), float(row["time_s"])
        except (TypeError, ValueError):
            raise ScanError("index and time_s must be numbers", place=f"{path}, line {number}") from None
        if not math.isfinite(time_s):
            raise ScanError("time_s is not finite", place=f"{path}, line {number}")
        name = (row["path"] or "").strip()
        if not name:
            raise ScanError("the path is empty", place=f"{path}, line {number}")
        file = inside(root, name, place=f"{path}, line {number}")
        shutter = (row.get("shutter") or "").strip().lower() not in ("", "0", "false", "no")
        columns.setdefault(stream, []).append((time_s, index, file, not shutter))

    streams = {}
    for stream, rows in columns.items():
        camera = cameras[stream]
        if camera is None:
            continue
        times = np.array([r[0] for r in rows])
        if len(times) > 1 and not (np.diff(times) > 0).all():
            i = int(np.flatnonzero(~(np.diff(times) > 0))[0]) + 1
            raise ScanError(f"the times of the {stream} stream run backwards at frame {rows[i][1]}", place=path)
        files = tuple(r[2] for r in rows)
        absent = next((f for f in files if not f.is_file()), None)
        if absent is not None:
            raise ScanError(
                f"the {stream} file is named in frames.csv but absent", place=absent, hint="copy the recording again"
            )
        streams[stream] = Stream(
            times_s=times,
            load=_loader(stream, files, camera, unit_m),
            places=tuple(str(f) for f in files),
            index=np.array([r[1] for r in rows], np.int64),
            usable=np.array([r[3] for r in rows]),
        )
    return streams


def _loader(stream: str, files: tuple[Path, ...], camera: Camera, unit_m: float) -> Any:
    def load_depth(i: int) -> NDArray:
        return depth_from_raw(read_image(files[i], shape=camera.shape, kind="depth"), unit_m, place=files[i])

    def load_color(i: int) -> NDArray:
        image = read_image(files[i], shape=camera.shape, kind="colour")
        if image.dtype != np.uint8:
            raise ScanError(f"colour is {image.dtype}, expected 8-bit", place=files[i])
        if image.ndim == 2:
            return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
        return cv2.cvtColor(image, cv2.COLOR_BGRA2RGB if image.shape[2] == 4 else cv2.COLOR_BGR2RGB)

    def load_thermal(i: int) -> NDArray:
        image = read_image(files[i], shape=camera.shape, kind="thermal")
        if image.ndim != 2 or image.dtype not in (np.uint16, np.float32):
            raise ScanError(
                f"thermal is {image.dtype} with {image.ndim} axes, expected 16-bit counts or float32, one channel",
                place=files[i],
            )
        return image

    return {"depth": load_depth, "color": load_color, "thermal": load_thermal}[stream]
