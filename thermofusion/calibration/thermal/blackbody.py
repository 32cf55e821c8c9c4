"""A session before a blackbody: the table of readings, and the files that a curve and a pixel field are kept in."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from ...errors import ScanError
from ...files.npz import read_npz
from ...files.reading import inside, read_json
from ...files.strict import Border, validated
from ...files.table import table_rows
from ...files.whole import replacing, write_text
from ...scans.native.schema import Constant, SignalDoc
from ...types import Bool, Float, SignalCurve
from ...version import __version__
from .qualify import Shown
from .radiometric import PixelField, RadiometricCurve, check_monotone
from .source import ThermalSource

CURVE_SCHEMA = "thermofusion-curve/1"
BOX = ("left_px", "top_px", "width_px", "height_px")
COLUMNS = "the columns must be counts,degC or file,degC"
Opener = Callable[[Path], ThermalSource]


@dataclass(frozen=True)
class Box:
    """A part of a picture, px."""

    left_px: int
    top_px: int
    width_px: int
    height_px: int

    def cut(self, image: Float, place: object = None) -> Float:
        """That part of a picture (H, W), px. Raises ScanError if it is not inside."""
        h, w = image.shape
        right, bottom = self.left_px + self.width_px, self.top_px + self.height_px
        if not (0 <= self.left_px < right <= w and 0 <= self.top_px < bottom <= h):
            raise ScanError(f"the box reaches beyond the picture of {w} x {h} px", place=place)
        return image[self.top_px : bottom, self.left_px : right]


@dataclass(frozen=True)
class Reading:
    """One temperature of the source: counts, or the recording that shows it (and where, if not everywhere)."""

    degC: float
    counts: float | None
    file: Path | None
    box: Box | None
    place: str


def read_readings(path: Path) -> list[Reading]:
    """Rows `counts,degC`, or `file,degC` with paths beside the table and, if the source does not fill the picture,
    `left_px,top_px,width_px,height_px`. Raises ScanError naming the line."""
    rows = list(table_rows(path, "readings", ["degC"], COLUMNS))
    if not rows:
        raise ScanError("there are no readings", place=path)
    columns = set(rows[0][1])
    if not columns & {"counts", "file"}:
        raise ScanError("no column says where the readings were taken", place=path, hint=COLUMNS)
    if 0 < len(columns & set(BOX)) < 4:
        raise ScanError(f"a box needs {', '.join(BOX)}", place=path)
    return [_reading(row, path, f"{path}, line {n}") for n, row in rows]


def _reading(row: dict[str, str], path: Path, place: str) -> Reading:
    name = (row.get("file") or "").strip()
    try:
        degC = float(row["degC"])
        counts = None if name else float(row["counts"])
        box = Box(*(int(row[k]) for k in BOX)) if name and all(row.get(k) for k in BOX) else None
    except (KeyError, TypeError, ValueError):
        raise ScanError("degC, counts and the box must be numbers, or a file be named", place=place) from None
    if not (np.isfinite(degC) and (counts is None or np.isfinite(counts))):
        raise ScanError("degC and counts must be finite", place=place)
    return Reading(degC, counts, inside(path.parent, name, place=place) if name else None, box, place)


def reading_counts(readings: list[Reading], opener: Opener) -> Float:
    """(N,) counts: as written, or the median over the source of the mean of its frames."""
    return np.array([r.counts if r.counts is not None else _median_counts(r, opener) for r in readings])


def _median_counts(reading: Reading, opener: Opener) -> float:
    assert reading.file is not None
    mean = opener(reading.file).mean_counts()
    part = mean if reading.box is None else reading.box.cut(mean, reading.place)
    return float(np.median(part))


def shown_sources(
    readings: list[Reading], path: Path, opener: Opener, curve: RadiometricCurve | None
) -> list[list[Shown]]:
    """Recordings of sources, each a list of those in it, in the table's order. Raises ScanError naming the line."""
    groups: dict[Path, list[Shown]] = {}
    for r in readings:
        if r.file is None:
            raise ScanError("a qualification needs recordings: rows file,degC", place=r.place)
        source = opener(r.file)
        name = f"{r.file.name}, {r.degC:g} °C"
        groups.setdefault(r.file, []).append(
            Shown(name, r.degC, _frames(source, r, curve), source.times_s, _after_shutter(source))
        )
    return list(groups.values())


def _frames(source: ThermalSource, reading: Reading, curve: RadiometricCurve | None) -> Iterator[Float]:
    for i in range(len(source)):
        image = source.degC(i, curve)
        yield image if reading.box is None else reading.box.cut(image, reading.place)


def _after_shutter(source: ThermalSource) -> Bool:
    """(N,) frames before which the recording marks the shutter."""
    if source.scan is None or source.scan.thermal is None:
        return np.zeros(len(source), bool)
    kept = np.flatnonzero(source.scan.thermal.usable)
    return np.concatenate([[False], np.diff(kept) > 1])


# ---------------------------------------------------------------- files


class _CurveDoc(Border):
    schema_: Literal["thermofusion-curve/1"]
    signal: SignalDoc
    counts_range: tuple[Constant, Constant]
    residual_K: float = Field(ge=0, le=1000)
    sigma_K: float = Field(ge=0, le=1000)


def signal_document(signal: SignalCurve) -> dict[str, Any]:
    """`signal` of a scan.json for a camera that stores counts."""
    parameters = {k: list(v) if len(v) > 1 else v[0] for k, v in signal.parameters.items()}
    return {"kind": signal.kind, "curve": {"type": signal.curve, **parameters}}


def curve_document(curve: RadiometricCurve, readings: int) -> dict[str, Any]:
    """curve.json: `signal` as scan.json takes it, where it holds, and how well."""
    return {
        "schema": CURVE_SCHEMA,
        "signal": signal_document(curve.signal_curve()),
        "counts_range": list(curve.counts_range),
        "degC_range": sorted(curve.to_degC(np.array(curve.counts_range)).tolist()),
        "residual_K": curve.residual_K,
        "sigma_K": curve.sigma_K,
        "readings": readings,
    }


def write_curve(path: Path, document: dict[str, Any]) -> None:
    """Write curve.json whole or not at all."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def read_curve(path: Path) -> RadiometricCurve:
    """Read curve.json. Raises ScanError naming the key, or where the curve turns."""
    raw = read_json(path)
    if not isinstance(raw, dict) or raw.get("schema") != CURVE_SCHEMA:
        raise ScanError(
            "this is no curve file",
            place=path,
            hint="`thermofusion thermal curve READINGS.csv` writes one",
        )
    doc = validated(_CurveDoc, {"schema_": raw["schema"], **raw}, path)
    c = doc.signal.curve
    if c is None or c.type not in ("polynomial", "planck"):
        raise ScanError("key 'signal.curve': expected a polynomial or planck curve", place=path)
    values = c.coefficients_degC if c.type == "polynomial" else [getattr(c, k) for k in "RBFO"]
    if not values or any(v is None for v in values):
        raise ScanError(f"key 'signal.curve': a number of the {c.type} curve is missing", place=path)
    lo, hi = doc.counts_range
    if not lo < hi:
        raise ScanError("key 'counts_range': expected low < high", place=path)
    parameters = tuple(float(v) for v in values if v is not None)
    with np.errstate(all="ignore"):  # a curve that has no value somewhere is refused for it
        check_monotone(c.type, parameters, (lo, hi))
    return RadiometricCurve(c.type, parameters, (lo, hi), doc.residual_K, doc.sigma_K)


def write_field(path: Path, field: PixelField) -> None:
    """Write a pixel field as .npz (`z`: (P, H, W) float32), whole or not at all."""
    with replacing(path) as temporary, temporary.open("wb") as f:
        np.savez_compressed(f, thermofusion=np.array(__version__), z=field.z)


def read_field(path: Path) -> PixelField:
    """Read a pixel field. Raises ScanError if the file is none."""
    (z,) = read_npz(path, "pixel field", ["z"], hint="`thermofusion thermal field READINGS.csv` writes one")
    if z.ndim != 3 or z.dtype.kind != "f" or not np.isfinite(z).all():
        raise ScanError("a pixel field holds finite `z` of three axes: power, row, column", place=path)
    return PixelField(z.astype(np.float32))
