"""A curve and a pixel field applied: pictures and whole scans as even apparent temperatures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ...errors import ResourceError, ScanError
from ...files.whole import replacing
from ...scans.native.write import write_scan
from ...types import Float32, SignalCurve
from .radiometric import PixelField, RadiometricCurve
from .source import ThermalSource


def flat(source: ThermalSource, i: int, field: PixelField | None, curve: RadiometricCurve | None) -> Float32:
    """(H, W) float32 apparent degC of a frame, the field taken off. Raises ScanError naming the frame."""
    T = source.degC(i, curve)
    try:
        return (T if field is None else field.correct(T)).astype(np.float32)
    except ScanError as e:
        raise ScanError(e.cause, place=source.places[i], hint=e.hint) from None


def flatten_scan(
    source: ThermalSource, out: Path, field: PixelField | None, curve: RadiometricCurve | None, *, overwrite: bool
) -> Path:
    """The source's scan as a native one whose thermal frames are apparent degC; shutter frames are left out."""
    scan = source.scan
    assert scan is not None
    assert scan.thermal is not None
    kept = np.flatnonzero(scan.thermal.usable)
    thermal = replace(
        scan.thermal,
        times_s=scan.thermal.times_s[kept],
        load=lambda i: flat(source, i, field, curve),
        places=source.places,
        index=scan.thermal.index[kept],
        usable=np.ones(len(kept), bool),
        camera=replace(scan.thermal.camera, signal=SignalCurve("apparent_degC")),
    )
    notes = (*scan.notes, "thermal frames as apparent degC" + ("" if field is None else ", pixel field taken off"))
    return write_scan(replace(scan, thermal=thermal, notes=notes), out, overwrite)


def write_flat(
    source: ThermalSource, out: Path, field: PixelField | None, curve: RadiometricCurve | None, *, overwrite: bool
) -> list[Path]:
    """Every frame as a float32 TIFF of its name in the folder `out`. Raises ScanError where one exists."""
    names = [Path(p).stem for p in source.places]
    if len(set(names)) < len(names):  # frames of one file
        names = [f"{i:06d}" for i in range(len(names))]
    files = [out / f"{name}.tiff" for name in names]
    there = next((f for f in files if f.exists()), None)
    if there is not None and not overwrite:
        raise ScanError("it exists already", place=there, hint="choose another folder, or give --overwrite")
    for i, file in enumerate(files):
        ok, data = cv2.imencode(".tiff", flat(source, i, field, curve))
        if not ok:
            raise ResourceError("the picture cannot be encoded", place=file)
        with replacing(file) as temporary:
            temporary.write_bytes(data.tobytes())
    return files
