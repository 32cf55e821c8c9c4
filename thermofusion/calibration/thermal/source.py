"""Thermal pictures wherever they lie: a scan, a FLIR recording, a folder of pictures, one picture; as temperatures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import read_bytes, read_image
from ...physics.band import ZERO_DEGC_K
from ...physics.signal import MAX_UNUSABLE, counts_to_kelvin
from ...scans import FORMATS, open_scan
from ...scans.thermal import read_thermal
from ...scans.thermal import recognise as is_radiometric
from ...types import Float, Scan, SignalCurve
from .radiometric import RadiometricCurve

THERMAL_SUFFIXES = (".png", ".tiff", ".tif", ".pgm", ".raw")


@dataclass(frozen=True)
class RawLayout:
    """How a .raw file of 16-bit counts is laid out: it does not say so itself."""

    width_px: int
    height_px: int
    big_endian: bool = False
    header_bytes: int = 0

    def read(self, path: Path) -> NDArray[np.uint16]:
        """(H, W) counts. Raises ScanError if the file is too short."""
        data = read_bytes(path, "thermal")[self.header_bytes :]
        n = self.width_px * self.height_px
        if len(data) < 2 * n:
            raise ScanError(
                f"{len(data)} bytes are too few for {self.width_px} x {self.height_px} px of 16 bit", place=path
            )
        counts = np.frombuffer(data, ">u2" if self.big_endian else "<u2", n)
        return counts.reshape(self.height_px, self.width_px).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class ThermalSource:
    """Thermal frames in time order, shutter frames left out.

    times_s : (N,), NaN = not stated. load : i -> (H, W) as stored. signal : the recording's own curve, None = not
    known. scan : the recording, if it is one.
    """

    places: tuple[str, ...]
    times_s: Float
    load: Callable[[int], NDArray]
    signal: SignalCurve | None = None
    scan: Scan | None = None

    def __len__(self) -> int:
        return len(self.places)

    def counts(self, i: int) -> NDArray:
        """(H, W) stored counts. Raises ScanError if the frame is no 16-bit picture."""
        image = self.load(i)
        if image.ndim != 2 or image.dtype.kind not in "iu" or image.dtype.itemsize < 2:
            raise ScanError(
                f"the picture is {image.dtype} with {image.ndim} axes, expected 16-bit grey counts",
                place=self.places[i],
                hint="export the camera's radiometric pictures, not the coloured ones",
            )
        return image

    def degC(self, i: int, curve: RadiometricCurve | None = None) -> Float:
        """(H, W) apparent temperature by `curve`, or else by the recording's own; NaN off the curve.

        Raises ScanError: counts without a curve, or more than 1 % of the pixels outside it.
        """
        image = self.load(i)
        if image.ndim == 2 and image.dtype.kind == "f" and (self.signal is None or self.signal.kind == "apparent_degC"):
            return image.astype(np.float64)
        counts, place = self.counts(i), self.places[i]
        if curve is not None:
            lo, hi = curve.counts_range
            inside = (counts >= lo) & (counts <= hi)
            out = np.full(counts.shape, np.nan)
            out[inside] = curve.to_degC(counts[inside])
            span = f" ({lo:.0f} to {hi:.0f} counts)"
        elif self.signal is not None and self.signal.kind == "counts":
            out, span = counts_to_kelvin(self.signal, counts.astype(np.float64)) - ZERO_DEGC_K, ""
        else:
            raise ScanError("counts need a radiometric curve", place=place, hint="give --curve curve.json")
        lost = float(np.mean(np.isnan(out)))
        if lost > MAX_UNUSABLE:
            raise ScanError(f"{lost:.0%} of the pixels lie off the radiometric curve{span}", place=place)
        return out

    def mean_degC(self, curve: RadiometricCurve | None = None) -> Float:
        """(H, W) mean of all frames, degC."""
        return _mean(lambda i: self.degC(i, curve), len(self))

    def mean_counts(self) -> Float:
        """(H, W) mean of all frames, counts."""
        return _mean(lambda i: self.counts(i).astype(np.float64), len(self))

    def mean_shown(self, curve: RadiometricCurve | None = None) -> tuple[Float, str]:
        """Mean (H, W) of all frames and its unit: degC where a curve is known, else counts."""
        if curve is None and self.signal is None and self.load(0).dtype.kind in "iu":
            return self.mean_counts(), "counts"
        return self.mean_degC(curve), "degC"


def _mean(frame: Callable[[int], Float], n: int) -> Float:
    total = frame(0)
    for i in range(1, n):
        total = total + frame(i)
    return total / n


def open_thermal(path: Path, *, raw: RawLayout | None = None, rate_hz: float | None = None) -> ThermalSource:
    """Thermal frames of a recording, a folder of pictures (in the order of their names), or a picture.

    raw : layout of .raw files. rate_hz : replaces times that are not stated. Raises ScanError.
    """
    if not path.exists():
        raise ScanError("there is no such picture or recording", place=path)
    source = _open(path, raw)
    if rate_hz is not None and not np.isfinite(source.times_s).all():
        return replace(source, times_s=np.arange(len(source)) / rate_hz)
    return source


def _open(path: Path, raw: RawLayout | None) -> ThermalSource:
    if is_radiometric(path):
        frames = read_thermal(path)
        return ThermalSource(frames.places, frames.times_s, frames.load, frames.signal)
    if any(f.recognise(path) for f in FORMATS):
        scan = open_scan(path)
        if scan.thermal is None:
            raise ScanError("the recording has no thermal frames", place=path)
        stream, kept = scan.thermal, np.flatnonzero(scan.thermal.usable).tolist()
        if not kept:
            raise ScanError("every thermal frame of the recording is marked as a shutter frame", place=path)
        places = tuple(stream.places[k] for k in kept)
        return ThermalSource(places, stream.times_s[kept], lambda i: stream.load(kept[i]), stream.camera.signal, scan)
    files = sorted(p for p in path.iterdir() if p.suffix.lower() in THERMAL_SUFFIXES) if path.is_dir() else [path]
    if not files:
        raise ScanError("there are no thermal pictures here", place=path, hint="expected PNG, TIFF, PGM or .raw")
    shape = _picture(files[0], raw, None).shape[:2]
    return ThermalSource(tuple(map(str, files)), np.full(len(files), np.nan), lambda i: _picture(files[i], raw, shape))


def _picture(path: Path, raw: RawLayout | None, shape: tuple[int, int] | None) -> NDArray:
    if path.suffix.lower() != ".raw":
        return read_image(path, shape=shape, kind="thermal picture")
    if raw is None:
        raise ScanError("a .raw picture needs its size", place=path, hint="give --raw WIDTHxHEIGHT")
    return raw.read(path)
