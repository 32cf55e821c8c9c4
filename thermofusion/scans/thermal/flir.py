"""FLIR radiometric JPEG, FFF, SEQ, CSQ and AFF: parsers of the FFF container, and the temperature by its parameters.

Container (documented by ExifTool's FLIR tag tables, https://exiftool.org/TagNames/FLIR.html): a JPEG carries it cut
into APP1 segments `FLIR\\0`; a SEQ or CSQ file is a row of them; AFF is its older name. A directory lists records; type
1 is the raw image (16-bit: as is, as PNG of either byte order, or as JPEG-LS), type 0x20 the camera's parameters.
Temperature: FLIR's public measurement model, each layer of the path (air, window, air) passing its share of what lies
behind and adding its own.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import COPY_AGAIN, decode_image, open_regular, read_bytes, read_head
from ...physics.air import AirModel
from ...physics.band import ZERO_DEGC_K
from ...types import Environment, Float32, FrameConditions, SignalCurve
from .frames import ThermalFrames, joined

_RAW, _CAMERA = 0x01, 0x20  # types of FFF records: raw image, camera's parameters
_MAGICS = (b"FFF\0", b"AFF\0")
_HEADER_BYTES = 0x40
SLACK_BYTES = 64  # a last record may claim a little more than there is: cameras write so
HEAD_BYTES = 2**20  # of a JPEG that are looked at: Exif and previews may come before the segments
MAX_FRAME_PIXELS = 8_000_000  # the largest thermal cameras have 3 million
MAX_RECORDS = 1024  # of a directory: more is damage
# Cores without a temperature calibration (Vue Pro, Tau): counts about the middle of 14 bits under a default curve.
UNCALIBRATED_COUNTS, UNCALIBRATED_COLDEST_DEGC = (6000, 11000), 60.0
WAY_RADIOMETRIC = "set the camera to radiometric JPEG, or export float TIFF or CSV in degC with FLIR's own program"


@dataclass(frozen=True)
class FlirParameters:
    """What the camera knew: Planck curve, object, path. Temperatures in °C, distance in metres, shares in 0-1."""

    R1: float
    R2: float
    B: float
    F: float
    O: float  # noqa: E741 - the curve's own letter
    emissivity: float = 0.95
    distance_m: float = 1.0
    reflected_degC: float = 20.0
    air_degC: float = 20.0
    window_degC: float = 20.0
    window_transmission: float = 1.0
    relative_humidity: float = 0.5
    alpha1: float = 0.006569
    alpha2: float = 0.01262
    beta1: float = -0.002276
    beta2: float = -0.00667
    X: float = 1.9

    def signal(self, degC: float | NDArray) -> NDArray:
        """Raw signal (counts) of a blackbody at a temperature, any shape: R1 / (R2 (exp(B/T) - F)) - O."""
        T = np.asarray(degC, np.float64) + ZERO_DEGC_K
        return self.R1 / (self.R2 * (np.exp(self.B / T) - self.F)) - self.O

    def apparent_degC(self, signal: NDArray) -> NDArray:
        """Inverse of `signal`: counts of any shape to °C; NaN where there is no such temperature."""
        with np.errstate(divide="ignore", invalid="ignore"):
            T = self.B / np.log(self.R1 / (self.R2 * (np.asarray(signal, np.float64) + self.O)) + self.F)
            return np.where(np.isfinite(T) & (T > 0), T - ZERO_DEGC_K, np.nan)

    def air_transmission(self) -> float:
        """Of half the path (FLIR's model splits it at the window), from distance and water in the air."""
        model = AirModel((self.alpha1, self.alpha2), (self.beta1, self.beta2), self.X)
        return float(model.transmission(self.distance_m / 2, self.air_degC, self.relative_humidity))

    def temperature_degC(self, raw: NDArray) -> NDArray[np.float32]:
        """Object temperature of raw counts, any shape, by the file's own emissivity, reflection, air and window."""
        s = np.asarray(raw, np.float64)
        for share, own in self._path():
            s = (s - (1 - share) * own) / share
        s = (s - (1 - self.emissivity) * self.signal(self.reflected_degC)) / self.emissivity
        return self.apparent_degC(s).astype(np.float32)

    def curve(self) -> SignalCurve:
        """The Planck curve in the form of scan.json, T = B / ln(R/(S-O) + F); with what a window adds taken off.

        Without a window the temperature is the one of the stored counts. With one (transmission below 1) the counts are
        wrong as skin by kelvins: window and air, which the model splits at it, are taken off. Both steps are linear in
        the counts, so the curve takes them in: R and O change.
        """
        a, b = 1.0, 0.0  # counts before the optics = a * counts + b
        if self.has_window:
            for share, own in self._path():
                a, b = a / share, (b - (1 - share) * float(own)) / share
        parameters: dict[str, tuple[float, ...]] = {
            "R": (self.R1 / self.R2 / a,),
            "B": (self.B,),
            "F": (self.F,),
            "O": (-(self.O + b) / a,),
        }
        return SignalCurve("counts", "planck", parameters)

    @property
    def has_window(self) -> bool:
        """Whether an infrared window stands before the lens."""
        return self.window_transmission < 1

    def _path(self) -> tuple[tuple[float, NDArray], ...]:
        """The layers from the lens on: the share that each lets through, and its own signal."""
        tau, air = self.air_transmission(), self.signal(self.air_degC)
        return (tau, air), (self.window_transmission, self.signal(self.window_degC)), (tau, air)


@dataclass(frozen=True, eq=False)
class FlirFrame:
    """One frame: raw (H, W) uint16, its parameters, Unix time in seconds (None = not stated)."""

    raw: NDArray[np.uint16]
    parameters: FlirParameters
    time_s: float | None = None


def recognise(path: Path) -> bool:
    """A file that begins as FFF or AFF, or a JPEG that carries FLIR segments."""
    head = read_head(path, HEAD_BYTES)
    return head[:4] in _MAGICS or (head[:2] == b"\xff\xd8" and _has_segments(head))


def read(path: Path) -> ThermalFrames:
    """Frames of a radiometric JPEG, or of a SEQ, CSQ, FFF or AFF file of any size: those are read frame by frame.

    Raises ScanError: no radiometric data, a torn container without a single whole frame, or a camera that does not
    measure temperatures.
    """
    if read_head(path, 2) == b"\xff\xd8":
        block = _from_jpeg(read_bytes(path, "thermal"), path)
        return _frames(path, [(0, len(block))], _part_of(block))
    blocks, whole = _scan_blocks(path)

    def part(offset: int, size: int) -> bytes:
        with open_regular(path, limit_bytes=None) as f:
            f.seek(offset)
            return f.read(size)

    return _frames(path, blocks, part, () if whole else ("the last frame is torn and left out",))


def _frames(
    path: Path, blocks: list[tuple[int, int]], part: Callable[[int, int], bytes], notes: tuple[str, ...] = ()
) -> ThermalFrames:
    """Frames of the containers at (offset, size); those of another curve than their neighbours stay with their own."""
    heads = [_head(part, offset, size, path) for offset, size in blocks]
    places = [f"{path}, frame {i}" if len(blocks) > 1 else str(path) for i in range(len(blocks))]
    first = heads[0][0]
    groups: list[list[int]] = []
    for i, (p, _) in enumerate(heads):
        if groups and p.curve().parameters == heads[groups[-1][0]][0].curve().parameters:
            groups[-1].append(i)
        else:
            groups.append([i])
    shape = _frame(part(*blocks[0]), places[0]).raw.shape

    def of(group: list[int]) -> ThermalFrames:
        def load(k: int) -> NDArray[np.uint16]:
            raw = _frame(part(*blocks[group[k]]), places[group[k]]).raw
            if raw.shape != shape:
                raise ScanError("the frames differ in size", place=places[group[k]])
            return raw

        def object_degC(k: int) -> Float32:
            return heads[group[k]][0].temperature_degC(load(k))

        times = np.array([np.nan if heads[i][1] is None else heads[i][1] for i in group], np.float64)
        own = tuple(places[i] for i in group)
        curve, told = heads[group[0]][0].curve(), _told([heads[i][0] for i in group])
        return ThermalFrames((shape[0], shape[1]), load, times, own, curve, object_degC, _room(first), notes, told)

    found = joined([of(g) for g in groups])
    _check_calibrated(found, first)
    return _noted(found, first)


def _room(p: FlirParameters) -> Environment:
    return Environment(round(p.reflected_degC, 2), round(p.air_degC, 2), round(100 * p.relative_humidity, 1))


def _told(frames: list[FlirParameters]) -> FrameConditions | None:
    """What the camera was told of the room with each frame."""
    rooms = [_room(p) for p in frames]
    columns = {name: np.array([getattr(room, name) for room in rooms]) for name in vars(rooms[0])}
    return FrameConditions.of(len(frames), columns)


def _noted(found: ThermalFrames, p: FlirParameters) -> ThermalFrames:
    text = (
        f"the files' own emissivity {p.emissivity:g} and distance {p.distance_m:g} m are not used: counts stay apparent"
    )
    if p.has_window:
        text = (
            f"the file's infrared window (transmission {p.window_transmission:g}, {p.window_degC:.1f} degC) and the air"
        )
        text += " before it are taken off the counts; emissivity and reflection are not"
    return replace(found, notes=(*found.notes, text))


def _check_calibrated(found: ThermalFrames, p: FlirParameters) -> None:
    """ScanError for counts of a camera that measures no temperatures, under a curve that means nothing."""
    raw, degC = found.load(0), found.apparent_degC(0)
    low, high = UNCALIBRATED_COUNTS
    middle = low <= np.median(raw) <= high and raw.max() < 2**14
    if middle and np.nanpercentile(degC, 1) > UNCALIBRATED_COLDEST_DEGC:
        raise ScanError(
            f"the camera does not measure temperatures: its counts lie about the middle of 14 bits, its curve makes "
            f"{np.nanmedian(degC):.0f} degC of them",
            place=found.places[0],
            hint="take a radiometric camera, or one whose curve `thermofusion thermal curve READINGS.csv` has measured",
        )


def parse(data: bytes, place: object = None) -> list[FlirFrame]:
    """All frames of a radiometric JPEG or of a SEQ / FFF file in memory. Raises ScanError."""
    if data[:2] == b"\xff\xd8":
        data = _from_jpeg(data, place)
    if data[:4] not in _MAGICS:
        raise ScanError("there is no FLIR radiometric data in it", place=place, hint=WAY_RADIOMETRIC)
    found: list[FlirFrame] = []
    at = 0
    while 0 <= at < len(data):
        block = data[at:]
        end = _block_end(block[:_HEADER_BYTES], _part_of(block))
        if end is None or end > len(block) + SLACK_BYTES:
            if not found:
                raise ScanError("the FLIR data is truncated", place=place, hint=COPY_AGAIN)
            break
        found.append(_frame(block[:end], place))
        at = min((k for m in _MAGICS if (k := data.find(m, at + end - SLACK_BYTES)) >= 0), default=-1)
    return found


def _part_of(block: bytes) -> Callable[[int, int], bytes]:
    return lambda offset, size: block[offset : offset + size]


def _scan_blocks(path: Path) -> tuple[list[tuple[int, int]], bool]:
    """(offset, size) of the containers of a file, found by their headers alone, and whether the last one is whole."""
    size = path.stat().st_size
    blocks: list[tuple[int, int]] = []
    with open_regular(path, limit_bytes=None) as f:

        def part(offset: int, n: int) -> bytes:
            f.seek(at + offset)
            return f.read(n)

        at = 0
        while at < size:
            end = _block_end(part(0, _HEADER_BYTES), part)
            if end is None or at + end > size + SLACK_BYTES:
                if blocks:
                    return blocks, False
                raise ScanError("the FLIR data is truncated", place=path, hint=COPY_AGAIN)
            blocks.append((at, end))
            following = _next_magic(f, at + max(end - SLACK_BYTES, 1), size)
            if following is None:
                break
            at = following
    return blocks, True


def _next_magic(f: BinaryIO, at: int, size: int) -> int | None:
    """Where the next container begins, from byte `at` on; read in pieces."""
    step, keep = 2**13, 3
    while at < size:
        f.seek(at)
        piece = f.read(step + keep)
        found = [k for m in _MAGICS if (k := piece.find(m)) >= 0]
        if found:
            return at + min(found)
        at += step
    return None


def _block_end(header: bytes, part: Callable[[int, int], bytes]) -> int | None:
    """Where the container's last record ends, from its header and directory; None if it is none."""
    if header[:4] not in _MAGICS:
        return None
    try:
        return max((o + n for _, o, n in _records(header, part)), default=None)
    except struct.error:
        return None


def _head(
    part: Callable[[int, int], bytes], offset: int, size: int, place: object
) -> tuple[FlirParameters, float | None]:
    """A container's parameters and time, without its image."""
    rows = _directory(lambda o, n: part(offset + o, n), place)
    if _RAW not in rows:
        raise ScanError("the FLIR data has no raw image: no temperature is stored", place=place, hint=WAY_RADIOMETRIC)
    return _camera(part(offset + rows[_CAMERA][0], rows[_CAMERA][1]), place)


def _directory(part: Callable[[int, int], bytes], place: object) -> dict[int, tuple[int, int]]:
    try:
        rows = {kind: (o, n) for kind, o, n in _records(part(0, _HEADER_BYTES), part)}
    except struct.error:
        raise ScanError("the FLIR data is truncated", place=place, hint=COPY_AGAIN) from None
    if _CAMERA not in rows:
        raise ScanError("the FLIR data has no camera parameters", place=place, hint=WAY_RADIOMETRIC)
    return rows


def _has_segments(data: bytes) -> bool:
    """Whether a JPEG, or its beginning, has an APP1 segment of FLIR's; segments of any length may come before."""
    return any(body[:5] == b"FLIR\0" for marker, body in jpeg_segments(data) if marker == 0xE1)


def jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(marker, body) of a JPEG's segments before its picture (ITU T.81, B.1.1)."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        length = struct.unpack_from(">H", data, at + 2)[0]
        if length < 2:
            return
        yield data[at + 1], data[at + 4 : at + 2 + length]
        at += 2 + length


def _from_jpeg(data: bytes, place: object) -> bytes:
    """The container put together from its APP1 segments: `FLIR\\0`, 1, number, number of the last."""
    parts: dict[int, bytes] = {}
    last = -1
    for marker, body in jpeg_segments(data):
        if marker == 0xE1 and body[:5] == b"FLIR\0" and len(body) >= 8:
            parts[body[6]], last = body[8:], body[7]
    if not parts:
        raise ScanError("there is no FLIR radiometric data in it", place=place, hint=WAY_RADIOMETRIC)
    if sorted(parts) != list(range(last + 1)):
        raise ScanError(f"only {len(parts)} of {last + 1} FLIR segments are there", place=place)
    block = b"".join(parts[i] for i in range(last + 1))
    if block[:4] not in _MAGICS:
        raise ScanError("there is no FLIR radiometric data in it", place=place, hint=WAY_RADIOMETRIC)
    return block


def _records(header: bytes, part: Callable[[int, int], bytes]) -> list[tuple[int, int, int]]:
    """(type, offset, length) of the directory. The header's byte order differs from camera to camera."""
    e = ">" if struct.unpack_from(">I", header, 0x14)[0] < 0x10000 else "<"
    start, count = struct.unpack_from(e + "II", header, 0x18)
    if count > MAX_RECORDS:
        raise struct.error
    directory = part(start, 32 * count)
    rows = []
    for k in range(count):
        kind, _, _, _, offset, length = struct.unpack_from(e + "HHIIII", directory, 32 * k)
        if kind:
            rows.append((kind, offset, length))
    return rows


def _frame(block: bytes, place: object) -> FlirFrame:
    rows = _directory(_part_of(block), place)
    if _RAW not in rows:
        raise ScanError("the FLIR data has no raw image: no temperature is stored", place=place, hint=WAY_RADIOMETRIC)
    records = {kind: block[o : o + n] for kind, (o, n) in rows.items()}
    try:
        parameters, time_s = _camera(records[_CAMERA], place)
        return FlirFrame(_raw_image(records[_RAW], place), parameters, time_s)
    except struct.error:
        raise ScanError("the FLIR data is truncated", place=place, hint=COPY_AGAIN) from None


def _order(record: bytes) -> str:
    """Byte order of a record: its first word is 2."""
    return "<" if struct.unpack_from("<H", record)[0] == 2 else ">"


def _raw_image(record: bytes, place: object) -> NDArray[np.uint16]:
    e = _order(record)
    w, h = struct.unpack_from(e + "HH", record, 2)
    if not 0 < w * h <= MAX_FRAME_PIXELS:
        raise ScanError(f"the thermal image claims {w} x {h} px", place=place)
    body = record[0x20:]
    if body[:4] == b"\x89PNG":
        image = decode_image(body, shape=(h, w), kind="thermal", place=place)
        if image.dtype != np.uint16 or image.ndim != 2:
            raise ScanError("the thermal PNG inside is no 16-bit grey", place=place)
        # Most cameras store little-endian samples where PNG has big-endian ones; some do not: the smoother is right.
        swapped = image.byteswap()
        return np.asarray(swapped if _roughness(swapped) <= _roughness(image) else image, np.uint16)
    if body[:3] == b"\xff\xd8\xff":
        return _jpeg_ls(body, (h, w), place)
    if len(body) < 2 * w * h:
        raise ScanError("the FLIR data is truncated", place=place, hint=COPY_AGAIN)
    return np.frombuffer(body, e + "u2", w * h).reshape(h, w).astype(np.uint16)


def _roughness(image: NDArray) -> float:
    """Mean step between neighbours of an image (H, W), counts: a wrong byte order turns small steps into large ones."""
    x = image.astype(np.float32)
    return float(np.abs(np.diff(x, axis=0)).mean() + np.abs(np.diff(x, axis=1)).mean())


def _jpeg_ls(body: bytes, shape: tuple[int, int], place: object) -> NDArray[np.uint16]:
    """The 16-bit JPEG-LS image (H, W) of a CSQ frame."""
    try:
        import imagecodecs
    except ImportError:
        hint = "pip install 'thermofusion[flir]', or export SEQ, float TIFF or CSV with FLIR's own program"
        raise ScanError(
            "the frames are JPEG-LS (CSQ), and `imagecodecs` is not installed", place=place, hint=hint
        ) from None
    try:
        image = np.asarray(imagecodecs.jpegls_decode(body))
    except Exception as e:  # the library's own errors, whatever the bytes
        raise ScanError(f"the JPEG-LS image inside cannot be decoded ({type(e).__name__})", place=place) from None
    if image.shape != shape or image.dtype != np.uint16:
        raise ScanError("the JPEG-LS image inside is not of the header's size", place=place)
    return image


def _camera(record: bytes, place: object) -> tuple[FlirParameters, float | None]:
    if len(record) < 0x310:
        raise ScanError("the FLIR data is truncated", place=place, hint=COPY_AGAIN)
    e = _order(record)

    def f(at: int) -> float:
        return float(struct.unpack_from(e + "f", record, at)[0])

    humidity = f(0x3C)
    p = FlirParameters(
        R1=f(0x58),
        R2=f(0x30C),
        B=f(0x5C),
        F=f(0x60),
        O=float(struct.unpack_from(e + "i", record, 0x308)[0]),
        emissivity=f(0x20),
        distance_m=f(0x24),
        reflected_degC=f(0x28) - ZERO_DEGC_K,
        air_degC=f(0x2C) - ZERO_DEGC_K,
        window_degC=f(0x30) - ZERO_DEGC_K,
        window_transmission=f(0x34),
        relative_humidity=humidity / 100 if humidity > 2 else humidity,
        alpha1=f(0x70),
        alpha2=f(0x74),
        beta1=f(0x78),
        beta2=f(0x7C),
        X=f(0x80),
    )
    plausible = (
        np.isfinite(list(vars(p).values())).all()
        and p.R1 > 0 < p.R2
        and 0 < p.B < 1e5
        and 0 < p.emissivity <= 1
        and 0 < p.window_transmission <= 1
        and 0 <= p.distance_m < 1e5
        and 0 <= p.relative_humidity <= 1
        and all(-100 < t < 3000 for t in (p.reflected_degC, p.air_degC, p.window_degC))
    )
    with np.errstate(all="ignore"):  # a damaged number overflows, and is refused for it
        plausible = plausible and 0 < p.air_transmission() <= 1.001 and np.isfinite(p.signal(p.air_degC))
    if not plausible:
        raise ScanError("the FLIR camera parameters are not plausible (damaged?)", place=place)
    return p, _time(record, e)


def _time(record: bytes, e: str) -> float | None:
    """Date and time of the frame: Unix seconds, milliseconds in the low 16 bits."""
    if len(record) < 0x38C:
        return None
    seconds, milliseconds = struct.unpack_from(e + "II", record, 0x384)
    return seconds + (milliseconds & 0xFFFF) / 1000 if seconds else None
