"""Letters, ticks and the colour bar of the pictures, drawn with OpenCV's own fonts on RGB arrays, in place.

OpenCV's Hershey fonts know ASCII only: the degree sign is drawn as a small circle, any other letter becomes `?`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..export.palettes import table
from ..types import UInt8

INK, QUIET = (34, 34, 38), (110, 110, 116)  # sRGB of letters and lines, and of what stands back
FONT = cv2.FONT_HERSHEY_SIMPLEX
_FINE = 4  # letters are drawn this much larger, then averaged down: smooth at any size
_STROKES = cv2.__version__.startswith("4")  # OpenCV 4 draws letters with a pen; from 5 on they are outlines


@dataclass(frozen=True)
class Scale:
    """How values become colours, and what the bar says. Below and above the range, values take the end's colour."""

    palette: str
    lo: float
    hi: float
    unit: str
    title: str
    subtitle: str = ""
    shading: float = 0.0  # 0: off; 1: surface seen edge-on is black


def write(
    image: UInt8,
    text: str,
    x: float,
    y: float,
    size_px: float,
    rgb: tuple[int, int, int] = INK,
    align: Literal["left", "center", "right"] = "left",
) -> None:
    """Write `text` with capitals `size_px` high; (x, y) is the left, middle or right end of the base line."""
    mask = _letters(text, size_px)
    h, w = mask.shape
    pad = round(size_px)
    x0 = round(x - {"left": pad, "center": w / 2, "right": w - pad}[align])
    y0 = round(y) - (h - pad)
    left, top = max(-x0, 0), max(-y0, 0)  # letters beyond the picture are cut off
    region = image[max(y0, 0) : max(y0 + h, 0), max(x0, 0) : max(x0 + w, 0)]
    alpha = mask[top : top + region.shape[0], left : left + region.shape[1], None]
    region[:] = np.round(region * (1 - alpha) + np.array(rgb) * alpha).astype(np.uint8)


def text_width(text: str, size_px: float) -> int:
    """Width of the written text, px."""
    return _letters(text, size_px).shape[1] - 2 * round(size_px)


@cache
def _capital() -> float:
    """Height of a capital at scale 1, px; getTextSize gives a line's height in OpenCV 5."""
    canvas = np.zeros((400, 400), np.uint8)
    cv2.putText(canvas, "H", (20, 300), FONT, 8.0, 255, 1, cv2.LINE_AA)
    return float(np.count_nonzero(canvas.max(axis=1) > 127)) / 8


def _letters(text: str, size_px: float) -> NDArray[np.float32]:
    """Coverage 0..1 of the text, with a margin of `size_px` on every side."""
    big = size_px * _FINE
    scale, pad, pen = big / _capital(), round(size_px) * _FINE, max(round(big / 8.5), 1)
    thick = pen if _STROKES else 1
    degree, gap = round(big * 0.17), round(big * 0.1)
    runs = [run.encode("ascii", "replace").decode() for run in text.split("°")]
    widths = [cv2.getTextSize(run, FONT, scale, thick)[0][0] if run else 0 for run in runs]
    total = sum(widths) + (len(runs) - 1) * (2 * degree + 2 * gap)
    h = math.ceil((big + 2 * pad) / _FINE) * _FINE
    w = math.ceil((total + 2 * pad) / _FINE) * _FINE
    canvas = np.zeros((h, w), np.uint8)
    x, base = pad, h - pad
    for number, (run, width) in enumerate(zip(runs, widths, strict=True)):
        if number:
            cv2.circle(
                canvas, (x + gap + degree, base - round(big) + degree), degree, 255, pen * 3 // 4 + 1, cv2.LINE_AA
            )
            x += 2 * degree + 2 * gap
        cv2.putText(canvas, run, (x, base), FONT, scale, 255, thick, cv2.LINE_AA)
        x += width
    coverage = cv2.resize(canvas, (w // _FINE, h // _FINE), interpolation=cv2.INTER_AREA)
    return coverage.astype(np.float32) / np.float32(255)


def ticks(lo: float, hi: float, wanted: int = 6) -> list[float]:
    """Round numbers from lo to hi, in steps of 1, 2 or 5 times a power of ten: about `wanted` of them."""
    rough = (hi - lo) / wanted
    power = 10.0 ** math.floor(math.log10(rough))
    step = min((power * s for s in (1, 2, 5, 10)), key=lambda s: abs(math.log(s / rough)))
    return [i * step + 0.0 for i in range(math.ceil(lo / step - 1e-6), math.floor(hi / step + 1e-6) + 1)]


def tick_label(value: float, marks: list[float]) -> str:
    """A tick's number with as many decimals as the step needs."""
    step = marks[1] - marks[0] if len(marks) > 1 else 1.0
    return f"{value:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"


def color_bar(
    image: UInt8,
    box: tuple[int, int, int, int],
    scale: Scale,
    size_px: float,
    *,
    below: bool = False,
    above: bool = False,
) -> None:
    """A vertical bar in `box` = (x, y, width, height), low at the bottom, ticks and the unit at its right.

    below, above : a point at that end tells that values beyond the range are shown in its last colour.
    """
    (x, y, w, h), lo, hi = box, scale.lo, scale.hi
    rows = np.round(np.linspace(255, 0, h)).astype(np.uint8)
    image[y : y + h, x : x + w] = table(scale.palette)[rows][:, None]
    line = max(round(size_px / 12), 1)
    cv2.rectangle(image, (x - 1, y - 1), (x + w, y + h), INK, line, cv2.LINE_AA)
    for at_end, end, sign, index in ((above, y - 1, -1, 255), (below, y + h, 1, 0)):
        if at_end:
            tip = np.array([[x - 1, end], [x + w, end], [x + (w - 1) // 2, end + sign * round(w * 0.7)]], np.int32)
            cv2.fillPoly(image, [tip], table(scale.palette)[index].tolist(), cv2.LINE_AA)
            cv2.polylines(image, [tip], True, INK, line, cv2.LINE_AA)
    marks = ticks(lo, hi)
    for value in marks:
        row = round(y + (hi - value) / (hi - lo) * (h - 1))
        cv2.line(image, (x + w, row), (x + w + round(size_px * 0.5), row), INK, line)
        write(image, tick_label(value, marks), x + w + size_px * 0.9, row + size_px / 2, size_px)
    write(image, scale.unit, x, y - size_px * 0.9 - (round(w * 0.7) if above else 0), size_px)
