"""Tables of temperatures as programs export them: CSV, TSV, with a header that names the unit or none."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from ...errors import ScanError
from ...files.reading import read_bytes
from ...types import Float
from .frames import ThermalFrames, ThermalSaid, one_frame
from .pictures import as_said

SUFFIXES = (".csv", ".tsv", ".txt", ".asc")
MIN_CELLS = 4  # numbers in a row of an image
_UNITS = {"C": (1.0, 0.0), "F": (5 / 9, -160 / 9), "K": (1.0, -273.15)}
_QUOTED = re.compile(r'"[^"]*"')
_DECIMAL_COMMA = re.compile(r"[+-]?\d+(,\d+)?")
_NO_NUMBER = ("nan", "nan(ind)", "n/a", "null", "none", "--", "")  # as programs write a pixel without a temperature
_DEGREE = re.compile(
    r"(?:°|º|deg\.?\s*|degrees?\s+)\s?([CFK])(?![a-z])|\b(Celsius|Fahrenheit|Kelvin)\b|[\[(]([CFK])[\])]", re.IGNORECASE
)


def recognise(path: Path) -> bool:
    """A text file by its name."""
    return path.suffix.lower() in SUFFIXES


def read(path: Path, said: ThermalSaid) -> ThermalFrames:
    """One frame of a table. Its header's unit is obeyed; decimal commas, counters of rows and columns are understood.

    Raises ScanError: no table of numbers, rows of different length, a unit that somebody must say.
    """
    lines = _text(path).splitlines()
    first = next((i for i, line in enumerate(lines) if _is_row(line)), None)
    if first is None:
        hint = "export a table of temperatures in degC: a line for each row of the picture, a number for each pixel"
        raise ScanError("there is no table of temperatures in it", place=path, hint=hint)
    rows = _rows(lines, first, path)
    table = _without_labels(np.array(rows, np.float64))
    unit = _unit("\n".join(lines[:first]) + "\n" + re.split(r"[\d]", lines[first])[0])
    if unit is not None and said.linear is None:
        gain, offset = _UNITS[unit]
        note = () if unit == "C" else (f"the table says °{unit}" if unit == "F" else "the table says kelvin",)
        with np.errstate(invalid="ignore", over="ignore"):
            degC = (table * gain + offset).astype(np.float32)
        return one_frame(degC, path, notes=note)
    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are no temperatures
        images, signal = as_said(table[None], said, path)
    return one_frame(images[0], path, signal)


def _rows(lines: list[str], first: int, path: Path) -> list[list[float]]:
    """The numbers of the table that begins at line `first`. Raises ScanError: ragged rows, another table after it."""
    cut = _separator(lines[first])
    width = len(_cells(lines[first], cut))
    while first and len(_cells(lines[first - 1], cut)) == width and _has_holes(lines[first - 1], cut):
        first -= 1
    rows: list[list[float]] = []
    last = len(lines)
    for number, line in enumerate(lines[first:], first + 1):
        row = _numbers(line, cut)
        if not _is_row(line) and not (len(row) == width and _has_holes(line, cut)):
            last = number
            break
        if len(row) != width:
            raise ScanError(f"expected {width} numbers, got {len(row)}", place=f"{path}, line {number}")
        rows.append(row)
    for number, line in enumerate(lines[last:], last + 1):
        if _is_row(line) and len(_cells(line, cut)) == width:
            text = f"the table ends at line {last}, and another begins"
            hint = "write one picture a file, without lines between its rows"
            raise ScanError(text, place=f"{path}, line {number}", hint=hint)
    return rows


def _has_holes(line: str, cut: str) -> bool:
    """A row of an image whose missing pixels are written in words or left blank, and that has numbers too."""
    cells = _cells(line, cut)[1:]
    return any(_value(c) is not None for c in cells) and all(
        _value(c) is not None or c.lower().strip("+-") in _NO_NUMBER for c in cells
    )


def _text(path: Path) -> str:
    data = read_bytes(path, "thermal")
    for encoding in ("utf-8-sig", "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8", "cp1252"):
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    return data.decode("latin-1")


def _separator(line: str) -> str:
    """What stands between numbers: a tab, a semicolon, else a comma, else blanks (then a comma is a decimal one)."""
    bare = _QUOTED.sub("0", line)  # a comma in quotes parts nothing
    for mark in ("\t", ";"):
        if bare.count(mark) >= MIN_CELLS - 1:
            return mark
    words = bare.split()
    if len(words) >= MIN_CELLS and all(_DECIMAL_COMMA.fullmatch(word) for word in words):
        return " "
    return "," if bare.count(",") >= MIN_CELLS - 1 else " "


def _cells(line: str, cut: str) -> list[str]:
    if cut == " ":
        cells = line.split()
    elif '"' in line:
        cells = [c.strip() for c in next(csv.reader([line], delimiter=cut), [])]
    else:
        cells = [c.strip() for c in line.split(cut)]
    while cells and not cells[-1]:
        cells.pop()
    return [c.replace(",", ".") for c in cells]  # what is left of commas is decimal


def _value(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _is_row(line: str) -> bool:
    """A row of an image: numbers but for the first cell, which may be a label."""
    cells = _cells(line, _separator(line))
    return len(cells) >= MIN_CELLS and all(_value(c) is not None for c in cells[1:])


def _numbers(line: str, cut: str) -> list[float]:
    """A row's numbers, NaN where a cell is none."""
    return [np.nan if (v := _value(c)) is None else v for c in _cells(line, cut)]


def _without_labels(table: Float) -> Float:
    """The table without a first row or column that only count, and without a first column of words."""
    if np.isnan(table[:, 0]).all():
        table = table[:, 1:]
    if len(table) and np.isnan(table[0, 0]) and _counts(table[0, 1:]):
        return table[1:, 1:]
    if _counts(table[0]):
        table = table[1:]
    if len(table) and _counts(table[:, 0]):
        table = table[:, 1:]
    return table


def _counts(x: Float) -> bool:
    return len(x) > 2 and bool((np.diff(x) == 1).all()) and x[0] in (0, 1)


def _unit(head: str) -> str | None:
    """The unit that the lines above the table name; None where they name none."""
    found = {next(g for g in m.groups() if g)[0].upper() for m in _DEGREE.finditer(head)}
    return found.pop() if len(found) == 1 else None
