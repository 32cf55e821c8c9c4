"""Recordings of `thermofusion record`: recording.mcap, whole or broken off at any byte; raw payloads, converted here.

A channel of pictures says in its metadata what they are; beside it a channel of the same name with `/info` says of
each frame its number, what was lost before it, the device's ticks, shutter and checksum. Every whole frame before a
tear is read.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError, counted
from ...files.mcap import Channel, Entry, McapIndex, read_mcap_head, scan_mcap
from ...files.reading import COPY_AGAIN, MAX_PIXELS, open_regular, read_head
from ...files.ros import FRAME_INFO, IMAGE, VECTOR, FrameInfo, Picture, read_frame_info, read_picture, read_vector
from ...files.strict import validated
from ...geometry.rigid import pose
from ...types import Camera, Environment, Float, FrameConditions, Reference, Scan, Stream
from ..clock import ClockFit, fit_clock
from ..common import Kind, as_thermal, make_camera, make_rig, make_stream
from ..native.compose import with_rig
from ..stated import NOTHING, Stated
from .fakenect import NO_DEPTH_RAW, KinectDepth

FILE, LIBRARY, ABOUT = "recording.mcap", "thermofusion", "thermofusion"
LAST_CHECKED = 8  # frames at the end of a torn file whose checksums must be right, or they go
MAX_MESSAGE = 64 * 2**20  # bytes of a message that is read
MAX_BACK = 0.01  # share of frames whose device clock may repeat or run backwards
MAX_WHERE = 4  # gaps that a note names
# What is believed of a file, as scan.json has it.
UNITS_M, BASELINE_M, BAND_UM = (1e-6, 0.1), (-10.0, 10.0), (1.0, 30.0)
KINECT_BOUNDS = {"emitter_cm": (1.0, 30.0), "reference_cm": (10.0, 1000.0), "pixel_cm": (0.01, 1.0)}
KINECT_BOUNDS["const_shift"] = (1.0, 2047.0)
STILL_G = (0.9, 1.1)  # an accelerometer that reads so is at rest


@dataclass(frozen=True, eq=False)
class _Recorded:
    """A stream as it lies in the file: what its channel says, where its pictures are, what was said of each."""

    channel: Channel
    about: Mapping[str, object]
    frames: list[Entry]
    infos: list[FrameInfo]

    @property
    def kind(self) -> str:
        return self.channel.metadata.get("kind", "")


def recognise(path: Path) -> bool:
    """A folder with our recording.mcap, or such a file under any name."""
    file = path / FILE if path.is_dir() else path
    if file.suffix.lower() != ".mcap" or not file.is_file():
        return False
    return (read_mcap_head(read_head(file, 4096)) or "").startswith(LIBRARY)


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """A recording as a scan; what was lost, and where, stands in its notes. Raises ScanError."""
    return _scan_of(scan_mcap(path / FILE if path.is_dir() else path), path, stated, {})


class Growing:
    """A recording that is still being written. `scan` holds what it has; `complete` : it has its end."""

    def __init__(self, path: Path) -> None:
        self._path, self._file = path, path / FILE if path.is_dir() else path
        self._index: McapIndex | None = None
        self._infos: dict[int, FrameInfo] = {}
        self.scan: Scan | None = None
        self.complete = False

    def look(self) -> bool:
        """Take up what is new; whether something is. Raises ScanError."""
        if not self._file.is_file():
            return False
        before = 0 if self._index is None else len(self._index.messages)
        self._index = scan_mcap(self._file, self._index)
        self.complete = self._index.complete
        if len(self._index.messages) == before:
            return False
        beside = self._file.parent / "rig.json"
        stated = NOTHING.with_rig(beside) if beside.is_file() else NOTHING
        with suppress(ScanError):  # no depth frame yet
            scan = _scan_of(self._index, self._path, stated, self._infos)
            self.scan = scan if stated.rig_path is None else with_rig(scan, stated.rig_path)
        return True


def _scan_of(index: McapIndex, path: Path, stated: Stated, infos: dict[int, FrameInfo]) -> Scan:
    """infos : what was said of frames, by its place in the file; read once."""
    file = index.path
    said = index.metadata.get(LIBRARY, {})
    start_ns = _number(said.get("start_ns"), min((e.log_ns for e in index.messages), default=0))
    streams = {c: _stream_of(index, c, infos) for c, channel in index.channels.items() if channel.schema == IMAGE}
    whole = {c: _without_torn(index, s) for c, s in streams.items()}
    kinds = {kind: [s for s in whole.values() if s.kind == kind and s.frames] for kind in ("depth", "color", "thermal")}
    if not kinds["depth"]:
        raise ScanError("no whole depth frame is in the recording", place=file)
    clocks, said_of_clocks = _clocks([s for own in kinds.values() for s in own], start_ns)
    depth = kinds["depth"][0]
    camera = stated.camera("depth") or _camera(depth, file)
    unit_m = stated.unit_m(_within(depth.about.get("depth_unit_m"), UNITS_M, 0.001))
    scan = Scan(
        name=path.resolve().name if path.is_dir() else path.resolve().stem,
        root=path,
        format="recording",
        rig=make_rig(camera, place=file),
        depth=_stream(file, depth, clocks, camera, _depth_decoder(depth, unit_m)),
        depth_unit_m=unit_m,
        environment=_environment(said.get("environment", "{}")),
        recorded_at=_date(start_ns),
        notes=(
            *_losses(index, streams, whole, start_ns, said),
            *said_of_clocks,
            *_assumed(depth),
            *_gravity(index, file),
        ),
    )
    if kinds["color"]:
        scan = _with_color(scan, file, kinds["color"][0], clocks, stated)
    if kinds["thermal"]:
        scan = _with_thermal(scan, file, kinds["thermal"][0], clocks, stated)
    return replace(scan, references=_references(said.get("references", "[]"), scan, file))


def _environment(text: str) -> Environment:
    try:
        given = json.loads(text).items()
    except (ValueError, AttributeError, RecursionError):
        return Environment()
    bounds = dict.fromkeys(Environment.__dataclass_fields__, (-80.0, 150.0))  # as scan.json has them
    bounds["relative_humidity_pct"] = (0.0, 100.0)
    known = {k: _within(v, bounds[k], np.nan) for k, v in given if k in bounds}
    return Environment(**{k: v for k, v in known.items() if v == v})


def _date(unix_ns: int) -> str | None:
    try:
        return datetime.fromtimestamp(unix_ns / 1e9, UTC).isoformat(timespec="seconds")
    except (OverflowError, ValueError, OSError):
        return None


def _within(value: object, bounds: tuple[float, float], default: float) -> float:
    """A number of a file, if it is one within the bounds."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return default
    return number if bounds[0] <= number <= bounds[1] else default


def _references(text: str, scan: Scan, file: Path) -> tuple[Reference, ...]:
    """The blackbodies that were stated on recording; `frames` are numbers of thermal frames. Raises ScanError."""
    from ..native.schema import BlackbodyDoc, reference_of

    try:
        rows = json.loads(text)
    except (ValueError, RecursionError):
        rows = []
    if scan.thermal is None or not isinstance(rows, list):
        return ()
    docs = [validated(BlackbodyDoc, row, file) for row in rows]
    return tuple(reference_of(d, f"references.{i}", scan.thermal.camera.lens, file) for i, d in enumerate(docs))


# ---------------------------------------------------------------- streams


def _stream_of(index: McapIndex, channel: int, known: dict[int, FrameInfo]) -> _Recorded:
    """A channel's pictures with what was said of each; a picture of which nothing was said is none."""
    own = index.channels[channel]
    beside = {c for c, x in index.channels.items() if x.schema == FRAME_INFO and x.topic == f"{own.topic}/info"}
    infos = {}
    for e in index.messages:
        if e.channel in beside:
            try:
                if e.offset not in known:
                    known[e.offset] = read_frame_info(_bytes(index.path, e, 4096))
                infos[e.sequence] = known[e.offset]
            except ValueError:
                index.damaged.append(e.offset)
    try:
        about = json.loads(own.metadata.get(ABOUT, "{}"))
    except (ValueError, RecursionError):
        about = {}
    found = {e.sequence: e for e in index.messages if e.channel == channel and e.sequence in infos}
    frames = [found[k] for k in sorted(found)]
    return _Recorded(own, about if isinstance(about, dict) else {}, frames, [infos[e.sequence] for e in frames])


def _without_torn(index: McapIndex, stream: _Recorded) -> _Recorded:
    """Without frames at a torn file's end whose pixels the disk had no time to write."""
    if index.complete:
        return stream
    keep = len(stream.frames)
    for k in range(len(stream.frames) - 1, max(len(stream.frames) - 1 - LAST_CHECKED, -1), -1):
        try:
            _picture(index.path, stream.frames[k], stream.infos[k])
        except ScanError:
            keep = k
    return replace(stream, frames=stream.frames[:keep], infos=stream.infos[:keep])


def _bytes(path: Path, entry: Entry, limit: int = MAX_MESSAGE) -> bytes:
    if entry.length > limit:
        raise ScanError(f"a message claims {entry.length:,} bytes", place=path, hint=COPY_AGAIN)
    with open_regular(path, "recording", limit_bytes=None) as f:
        f.seek(entry.offset)
        return f.read(entry.length)


def _picture(path: Path, entry: Entry, info: FrameInfo) -> Picture:
    place = f"{path}, frame {entry.sequence}"
    try:
        picture = read_picture(_bytes(path, entry))
    except ValueError as e:
        raise ScanError(f"the frame is damaged ({e})", place=place, hint=COPY_AGAIN) from None
    if zlib.crc32(picture.pixels) != info.crc32:
        raise ScanError("the frame is damaged (checksum)", place=place, hint=COPY_AGAIN)
    if not 0 < picture.width_px * picture.height_px <= MAX_PIXELS:
        raise ScanError(f"a frame of {picture.width_px} x {picture.height_px} px", place=place)
    return picture


def _pixels(picture: Picture, place: object) -> NDArray:
    """(H, W) or (H, W, 3) as sent."""
    kinds = {"mono16": ("<u2", 1), "16UC1": ("<u2", 1), "mono8": ("u1", 1), "bayer_grbg8": ("u1", 1), "rgb8": ("u1", 3)}
    kinds["32FC1"] = ("<f4", 1)
    if picture.encoding not in kinds:
        raise ScanError(f"pixels in the encoding '{picture.encoding[:40]}'", place=place)
    dtype, channels = kinds[picture.encoding]
    if picture.step != picture.width_px * channels * np.dtype(dtype).itemsize:
        raise ScanError("the rows of a frame have another length than its pixels", place=place)
    shape = (picture.height_px, picture.width_px) + ((3,) if channels == 3 else ())
    return np.frombuffer(picture.pixels, dtype).reshape(shape)


def _stream(
    file: Path, stream: _Recorded, clocks: Mapping[str, Float], camera: Camera, decode: Callable[[NDArray], NDArray]
) -> Stream:
    kind: Kind = stream.kind  # type: ignore[assignment]
    said = stream.channel.metadata
    size = _number(said.get("height_px"), 0), _number(said.get("width_px"), 0)
    if camera.shape != size:
        said_px = f"{camera.width_px} x {camera.height_px} px, but its images have {size[1]} x {size[0]}"
        raise ScanError(f"the {kind} camera has {said_px}", place=file, hint="is the rig.json that of these cameras?")
    times = clocks[stream.channel.topic]
    rows = np.flatnonzero(times > np.concatenate([[-np.inf], np.maximum.accumulate(times)[:-1]]))

    def load(i: int) -> NDArray:
        entry = stream.frames[rows[i]]
        place = f"{file}, {stream.channel.topic} {entry.sequence}"
        pixels = _pixels(_picture(file, entry, stream.infos[rows[i]]), place)
        if pixels.shape[:2] != size:
            raise ScanError(
                f"the {kind} is {pixels.shape[1]} x {pixels.shape[0]} px, expected {size[::-1]}", place=place
            )
        return decode(pixels)

    return make_stream(
        times[rows],
        load,
        [f"{file}, {stream.channel.topic} {stream.frames[r].sequence}" for r in rows],
        place=file,
        kind=kind,
        index=[stream.frames[r].sequence for r in rows],
        usable=[not stream.infos[r].shutter for r in rows],
    )


def _depth_decoder(stream: _Recorded, unit_m: float) -> Callable[[NDArray], NDArray[np.float32]]:
    if "kinect_depth" in stream.about or stream.channel.topic == "kinect/disparity":
        table = _kinect(stream).table_mm().astype(np.float32) * np.float32(unit_m)
        table[table == 0] = np.nan
        return lambda raw: table[np.minimum(raw, NO_DEPTH_RAW)]

    def metres(raw: NDArray) -> NDArray[np.float32]:
        depth = raw.astype(np.float32) * np.float32(unit_m)
        depth[raw == 0] = np.nan
        return depth

    return metres


def _kinect(stream: _Recorded) -> KinectDepth:
    said = stream.about.get("kinect_depth")
    if not isinstance(said, dict):
        return KinectDepth()
    typical = vars(KinectDepth())
    return KinectDepth(**{k: _within(said.get(k), KINECT_BOUNDS[k], v) for k, v in typical.items()})


def _color(raw: NDArray) -> NDArray[np.uint8]:
    """(H, W, 3) R, G, B."""
    return raw if raw.ndim == 3 else np.asarray(cv2.cvtColor(raw, cv2.COLOR_BayerGRBG2RGB), np.uint8)


@dataclass(frozen=True, eq=False)
class RawStream:
    """A stream as it was recorded, for replay. times_s, ticks, spoiled : (N,). load : i -> the frame's own bytes."""

    topic: str
    kind: str
    width_px: int
    height_px: int
    encoding: str
    about: Mapping[str, object]
    tick_hz: float
    times_s: Float
    ticks: NDArray[np.uint64]
    spoiled: NDArray[np.bool_]
    load: Callable[[int], bytes]


def raw_streams(path: Path) -> list[RawStream]:
    """The pictures of a recording, unconverted. Raises ScanError."""
    file = path / FILE if path.is_dir() else path
    index = scan_mcap(file)
    found = []
    for c, channel in index.channels.items():
        stream = _without_torn(index, _stream_of(index, c, {})) if channel.schema == IMAGE else None
        if stream is None or not stream.frames:
            continue
        first = _picture(file, stream.frames[0], stream.infos[0])

        def load(i: int, stream: _Recorded = stream) -> bytes:
            return bytes(_picture(file, stream.frames[i], stream.infos[i]).pixels)

        infos = stream.infos
        columns = (np.array([i.stamp_ns * 1e-9 for i in infos]), np.array([i.ticks for i in infos], np.uint64))
        spoiled = np.array([i.shutter for i in infos], bool)
        size = (first.width_px, first.height_px, first.encoding)
        rate = float(_number(channel.metadata.get("tick_hz"), 0))
        found.append(RawStream(channel.topic, stream.kind, *size, stream.about, rate, *columns, spoiled, load))
    return found


# ---------------------------------------------------------------- clocks and cameras


def _clocks(streams: list[_Recorded], start_ns: int) -> tuple[dict[str, Float], list[str]]:
    """Topic -> times (N,) s since the start, by each device's clock where it has one; what is to be said of them."""
    times: dict[str, Float] = {}
    notes = []
    for device in dict.fromkeys(s.channel.metadata.get("device", "") for s in streams):
        own = [s for s in streams if s.channel.metadata.get("device", "") == device]
        arrivals = [np.array([(i.stamp_ns - start_ns) * 1e-9 for i in s.infos]) for s in own]
        fit = _fitted(own, arrivals)
        if fit is None:
            times |= {s.channel.topic: a for s, a in zip(own, arrivals, strict=True)}
            continue
        times |= {s.channel.topic: t for s, t in zip(own, fit[1], strict=True)}
        late_ms = fit[0].delay_s * 1e3
        text = f"clock of {device}: drift {fit[0].drift * 1e6:+.0f} ppm, frames arrived {late_ms:.1f} ms later"
        jumps = f"; its counter began anew {counted(fit[0].jumps, 'time')}" if fit[0].jumps else ""
        notes.append(f"{text} than the quickest (median){jumps}")
    return times, notes


def _fitted(streams: list[_Recorded], arrivals: list[Float]) -> tuple[ClockFit, list[Float]] | None:
    """The one clock of a device's streams, and their times by it; None where it has none that can be believed."""
    said = [s.channel.metadata for s in streams]
    rates = {_number(m.get("tick_hz"), 0) for m in said}
    if len(rates) != 1 or min(rates) <= 0:
        return None
    host = np.concatenate(arrivals)
    wrap = max(_number(said[0].get("tick_wrap"), 2**32), 2)
    ticks = np.concatenate([np.array([float(i.ticks) for i in s.infos]) for s in streams])
    order = np.argsort(host, kind="stable")
    fit = fit_clock(host[order], ticks[order], float(rates.pop()), wrap)
    on_host = np.empty(len(order))
    on_host[order] = fit.times_s
    times = np.split(on_host, np.cumsum([len(a) for a in arrivals])[:-1])
    back = sum(int((np.diff(t) <= 0).sum()) for t in times)
    return (fit, times) if fit.used and back <= MAX_BACK * len(host) else None


def _number(text: str | None, default: int) -> int:
    try:
        return int(float(text or ""))
    except (ValueError, OverflowError):
        return default


def _camera(stream: _Recorded, file: Path) -> Camera:
    said, place = stream.channel.metadata, f"{file}, {stream.channel.topic}"
    try:
        K = np.array(stream.about["K"], np.float64)
        distortion = np.array(stream.about.get("distortion", []), np.float64)
    except (KeyError, ValueError, TypeError):
        raise ScanError("the recording has no camera matrix", place=place, hint="put a rig.json beside it") from None
    return make_camera(_number(said.get("width_px"), 0), _number(said.get("height_px"), 0), K, distortion, place=place)


def _with_color(scan: Scan, file: Path, color: _Recorded, clocks: Mapping[str, Float], stated: Stated) -> Scan:
    camera = stated.camera("color") or _camera(color, file)
    shift = color.about.get("T_color_depth_m")
    place = shift if isinstance(shift, list) and len(shift) == 3 else [0.0, 0.0, 0.0]
    T_color_depth = pose(np.eye(3), np.array([_within(x, BASELINE_M, 0.0) for x in place]))
    rig = make_rig(scan.rig.depth, camera, T_color_depth, place=file)
    return replace(
        scan, rig=rig, color=_stream(file, color, clocks, camera, _color), notes=(*scan.notes, *_assumed(color))
    )


def _with_thermal(scan: Scan, file: Path, thermal: _Recorded, clocks: Mapping[str, Float], stated: Stated) -> Scan:
    """The scan with thermal, where a rig.json says where its camera sits, and the device or it what its counts are."""
    rig, signal = stated.rig, thermal.about.get("signal")
    group = None if rig is None else rig.cameras.thermal
    told = signal is not None or (group is not None and group.signal is not None)
    if rig is None or group is None or rig.extrinsics.T_thermal_depth is None or not told:
        what = f"thermal ({thermal.channel.topic}) is left out: a rig.json beside it with cameras.thermal"
        more = " and its signal (this camera tells only relative values)" if thermal.about.get("relative") else ""
        text = f"{what}{more} and extrinsics.T_thermal_depth brings it in"
        return replace(scan, notes=(*scan.notes, text))
    from ..native.schema import SignalDoc, signal_of, thermal_camera_of

    band = thermal.about.get("band_um")
    own = thermal_camera_of(group, rig.extrinsics, stated.rig_path or file)
    if signal is not None and group.signal is None:
        own = replace(own, signal=signal_of(validated(SignalDoc, signal, file), file))
    if isinstance(band, list) and len(band) == 2 and "band_um" not in group.model_fields_set:
        low, high = (_within(x, BAND_UM, np.nan) for x in band)
        own = replace(own, band_um=(low, high)) if low + 0.1 < high else own
    stream = _stream(file, thermal, clocks, own.lens, np.array)
    return replace(scan, thermal=as_thermal(stream, own, _sensor_of(thermal, stream)))


def _sensor_of(recorded: _Recorded, stream: Stream) -> FrameConditions | None:
    """The sensor's temperature with each frame of a stream, where the camera told it."""
    from ..native.schema import plausible

    degC = {entry.sequence: info.fpa_degC for entry, info in zip(recorded.frames, recorded.infos, strict=True)}
    column = np.array([degC[int(number)] for number in stream.index])
    return FrameConditions.of(len(column), {"fpa_degC": plausible("fpa_degC", column)})


# ---------------------------------------------------------------- what is said


def _assumed(stream: _Recorded) -> list[str]:
    notes = []
    if stream.kind == "depth" and stream.channel.topic == "kinect/disparity" and "kinect_depth" not in stream.about:
        notes.append("depth in mm by typical constants of a Kinect v1 (the device did not tell its own)")
    if stream.about.get("K_nominal"):
        notes.append(f"nominal {stream.kind} camera assumed: a rig.json replaces it")
    return notes


def _losses(
    index: McapIndex, streams: Mapping[int, _Recorded], whole: Mapping[int, _Recorded], start_ns: int, said: Mapping
) -> list[str]:
    """What is not in the recording, exactly: frames that never came or were dropped, and what a tear took."""
    notes = []
    for stream in whole.values():
        numbers = [i.number for i in stream.infos]
        gaps = [(b - a - 1, i) for a, b, i in zip(numbers, numbers[1:], stream.infos[1:], strict=False) if b - a > 1]
        if numbers and numbers[0] > 0:
            gaps.insert(0, (numbers[0], stream.infos[0]))
        if gaps:
            where = ", ".join(f"{n} before {(i.stamp_ns - start_ns) * 1e-9:.2f} s" for n, i in gaps[:MAX_WHERE])
            more = f" and at {len(gaps) - MAX_WHERE} more places" if len(gaps) > MAX_WHERE else ""
            notes.append(f"{counted(sum(n for n, _ in gaps), 'frame')} of {stream.channel.topic} lost: {where}{more}")
    if index.complete:
        return notes
    end_s = (max((e.log_ns for e in index.messages), default=start_ns) - start_ns) * 1e-9
    text = f"the recording breaks off after {end_s:.2f} s, at byte {index.torn_at:,}, without its end"
    flush_s = _within(said.get("flush_s"), (0.0, 60.0), 0.5)
    notes.append(f"{text} (crash, kill or power cut): what was in memory, {flush_s:g} s at most, is lost")
    if index.cut is not None and index.cut[0] in index.channels:
        topic, number = index.channels[index.cut[0]].topic, index.cut[2]
        notes.append(f"frame {number} of {topic} was cut in two ({counted(index.left_over, 'byte')} of it are there)")
    for c, stream in streams.items():
        torn = len(stream.frames) - len(whole[c].frames)
        if torn:
            notes.append(f"{counted(torn, 'frame')} of {stream.channel.topic} at the end had not reached the disk")
    return notes


def _gravity(index: McapIndex, file: Path) -> list[str]:
    """Which way was down, from the readings near 1 g (the others were in motion)."""
    own = {c for c, x in index.channels.items() if x.schema == VECTOR}
    found = []
    for e in [e for e in index.messages if e.channel in own][:1000]:
        try:
            found.append(read_vector(_bytes(file, e, 4096)))
        except ValueError:
            continue
    still = [v for v in found if STILL_G[0] < np.linalg.norm(v) < STILL_G[1]]
    if not still:
        return []
    x, y, z = np.mean(still, axis=0)
    return [f"accelerometer, mean of {len(still)} readings at rest: ({x:.3f}, {y:.3f}, {z:.3f}) g in the device's axes"]
