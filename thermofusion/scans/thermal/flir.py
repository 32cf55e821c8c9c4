"""FLIR radiometric JPEG and SEQ: a pure parser of the FFF container, and the temperature by its own parameters.

Container (documented by ExifTool's FLIR tag tables, https://exiftool.org/TagNames/FLIR.html): a JPEG carries it cut
into APP1 segments `FLIR\\0`; a SEQ file is a row of them. A directory lists records; type 1 is the raw image (16-bit,
as is or as PNG with swapped bytes), type 0x20 the camera's parameters. Temperature: FLIR's public measurement model,
each layer of the path (air, window, air) passing its share of what lies behind and adding its own.
"""

from __future__ import annotations

import shlex
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError, counted
from ...files.reading import MAX_FILE_BYTES, decode_image, read_bytes, read_head
from ...physics.band import ZERO_DEGC_K
from ...types import Scan, SignalCurve
from ..native.compose import ThermalFrames

_RAW, _CAMERA = 0x01, 0x20  # types of FFF records: raw image, camera's parameters
_MAGIC = b"FFF\0"
MAX_FRAME_PIXELS = 8_000_000  # the largest thermal cameras have 3 million
MAX_PIXELS = MAX_FILE_BYTES // 2  # of all frames: what the largest file holds unpacked


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
        t = self.air_degC
        water = self.relative_humidity * np.exp(1.5587 + 0.06939 * t - 2.7816e-4 * t**2 + 6.8455e-7 * t**3)
        root = np.sqrt(self.distance_m / 2)
        a = np.exp(-root * (self.alpha1 + self.beta1 * np.sqrt(water)))
        b = np.exp(-root * (self.alpha2 + self.beta2 * np.sqrt(water)))
        return float(self.X * a + (1 - self.X) * b)

    def temperature_degC(self, raw: NDArray) -> NDArray[np.float32]:
        """Object temperature of raw counts, any shape, by the file's own emissivity, reflection, air and window."""
        tau, window = self.air_transmission(), self.window_transmission
        air = self.signal(self.air_degC)
        s = np.asarray(raw, np.float64)
        for share, own in ((tau, air), (window, self.signal(self.window_degC)), (tau, air)):
            s = (s - (1 - share) * own) / share
        s = (s - (1 - self.emissivity) * self.signal(self.reflected_degC)) / self.emissivity
        return self.apparent_degC(s).astype(np.float32)

    def curve(self) -> SignalCurve:
        """The same Planck curve in the form of scan.json: T = B / ln(R/(S-O) + F), with the offset's sign turned."""
        parameters: dict[str, tuple[float, ...]] = {
            "R": (self.R1 / self.R2,),
            "B": (self.B,),
            "F": (self.F,),
            "O": (-self.O,),
        }
        return SignalCurve("counts", "planck", parameters)


@dataclass(frozen=True, eq=False)
class FlirFrame:
    """One frame: raw (H, W) uint16, its parameters, Unix time in seconds (None = not stated)."""

    raw: NDArray[np.uint16]
    parameters: FlirParameters
    time_s: float | None = None


def recognise(path: Path) -> bool:
    """A .seq / .fff file, a JPEG that carries FLIR segments, or a folder of such JPEGs only."""
    if path.is_dir():
        first = next(iter(sorted(path.glob("*.jpg"))), None)
        return first is not None and b"FLIR\0" in read_head(first, 65536)
    head = read_head(path, 65536)
    return head[:4] == _MAGIC or b"FLIR\0" in head


def read(path: Path) -> Scan:
    """Always ScanError: there is no depth here, and a scan needs it. `read_thermal_frames` has the frames."""
    frames = read_thermal_frames(path)
    n, h, w = frames.images.shape
    raise ScanError(
        f"a thermal recording alone ({counted(n, 'frame')} of {w} x {h} px), no depth to put it on",
        place=path,
        hint=f"`thermofusion import RECORDING -o SCAN --thermal {shlex.quote(str(path))} --rig rig.json` joins them",
    )


def read_thermal_frames(path: str | Path) -> ThermalFrames:
    """Frames of a radiometric JPEG, a SEQ file, or a folder of JPEGs in the order of their names.

    Raises ScanError: no radiometric data, a torn container, frames that differ in size or in their Planck curve.
    """
    path = Path(path)
    files = sorted(path.glob("*.jpg")) if path.is_dir() else [path]
    found: list[tuple[str, FlirFrame]] = []
    pixels = 0
    for file in files:
        frames = parse(read_bytes(file, "thermal"), file)
        pixels += sum(f.raw.size for f in frames)
        if pixels > MAX_PIXELS:
            raise ScanError(f"the frames have more than {MAX_PIXELS >> 20} million pixels", place=file)
        found += [(f"{file}, frame {i}" if len(frames) > 1 else str(file), f) for i, f in enumerate(frames)]
    if not found:
        raise ScanError("there are no radiometric JPEG here", place=path)
    first = found[0][1]
    for place, f in found:
        if f.raw.shape != first.raw.shape:
            raise ScanError("the frames differ in size", place=place)
        if f.parameters.curve().parameters != first.parameters.curve().parameters:
            raise ScanError("the frames differ in their Planck curve (another range or camera)", place=place)
    times = np.array([np.nan if f.time_s is None else f.time_s for _, f in found])
    return ThermalFrames(
        images=np.stack([f.raw for _, f in found]),
        times_s=times,
        places=tuple(place for place, _ in found),
        signal=first.parameters.curve(),
        degC=np.stack([f.parameters.temperature_degC(f.raw) for _, f in found]),
        notes=(
            f"the files' own emissivity {first.parameters.emissivity:g}, distance {first.parameters.distance_m:g} m "
            f"and reflected {first.parameters.reflected_degC:.1f} degC are not used: counts stay apparent",
        ),
    )


def parse(data: bytes, place: object = None) -> list[FlirFrame]:
    """All frames of a radiometric JPEG or of a SEQ / FFF file. Raises ScanError."""
    try:
        if data[:2] == b"\xff\xd8":
            data = _from_jpeg(data, place)
        if data[:4] != _MAGIC:
            raise ScanError("there is no FLIR radiometric data in it", place=place)
        return [_frame(block, place) for block in _blocks(data, place)]
    except (struct.error, IndexError):
        raise ScanError("the FLIR data is truncated", place=place, hint="copy the recording again") from None


def _from_jpeg(data: bytes, place: object) -> bytes:
    """The container put together from its APP1 segments: `FLIR\\0`, 1, number, number of the last."""
    parts: dict[int, bytes] = {}
    last = -1
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        length = struct.unpack_from(">H", data, at + 2)[0]
        if length < 2:
            break
        body = data[at + 4 : at + 2 + length]
        if data[at + 1] == 0xE1 and body[:5] == b"FLIR\0" and len(body) >= 8:
            parts[body[6]], last = body[8:], body[7]
        at += 2 + length
    if not parts:
        raise ScanError("there is no FLIR radiometric data in it", place=place)
    if sorted(parts) != list(range(last + 1)):
        raise ScanError(f"only {len(parts)} of {last + 1} FLIR segments are there", place=place)
    return b"".join(parts[i] for i in range(last + 1))


def _blocks(data: bytes, place: object) -> Iterator[bytes]:
    """The FFF containers of a SEQ, one a frame: each ends where its last record ends."""
    at = 0
    while data[at : at + 4] == _MAGIC:
        block = data[at:]
        end = max((o + n for _, o, n in _records(block)), default=0)
        if end <= 0 or end > len(block):
            raise ScanError("the FLIR data is truncated", place=place, hint="copy the recording again")
        yield block[:end]
        at = data.find(_MAGIC, at + end)
        if at < 0:
            return


def _records(block: bytes) -> list[tuple[int, int, int]]:
    """(type, offset, length) of the directory. The header's byte order differs from camera to camera."""
    e = ">" if struct.unpack_from(">I", block, 0x14)[0] < 0x10000 else "<"
    start, count = struct.unpack_from(e + "II", block, 0x18)
    if count > 1024:
        raise struct.error
    rows = []
    for k in range(count):
        kind, _, _, _, offset, length = struct.unpack_from(e + "HHIIII", block, start + 32 * k)
        if kind:
            rows.append((kind, offset, length))
    return rows


def _frame(block: bytes, place: object) -> FlirFrame:
    records = {kind: block[o : o + n] for kind, o, n in _records(block)}
    if _RAW not in records or _CAMERA not in records:
        raise ScanError("the FLIR data has no raw image or no camera parameters", place=place)
    parameters, time_s = _camera(records[_CAMERA], place)
    return FlirFrame(_raw_image(records[_RAW], place), parameters, time_s)


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
        # FLIR stores little-endian samples where PNG has big-endian ones.
        return image.byteswap().astype(np.uint16, copy=False)
    if len(body) < 2 * w * h:
        raise ScanError("the FLIR data is truncated", place=place, hint="copy the recording again")
    return np.frombuffer(body, e + "u2", w * h).reshape(h, w).astype(np.uint16)


def _camera(record: bytes, place: object) -> tuple[FlirParameters, float | None]:
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
