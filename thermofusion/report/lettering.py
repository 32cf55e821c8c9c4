"""Letters, ticks and the colour bar of the pictures, on RGB arrays, in place.

One font comes with the package (DejaVu Sans: Latin, Greek, Cyrillic, Arabic, Hebrew and more). A letter that it does
not have, Chinese say, becomes a box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ..export.palettes import Beyond, percent, table
from ..types import UInt8

INK, QUIET, ALERT = (34, 34, 38), (96, 96, 102), (176, 58, 0)  # sRGB of letters; of what stands back; of a warning
FONT = Path(__file__).parent / "fonts" / "DejaVuSans.ttf"
CAPITAL = 1493 / 2048  # height of a capital over the font's size
LEFT_TO_RIGHT = "\N{LEFT-TO-RIGHT MARK}"  # behind a name in Arabic or Hebrew: what follows stays where it is
LONGEST = 400  # letters of a line; what is longer ends in dots


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


@lru_cache(maxsize=32)
def _font(size_px: float) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(FONT), size_px / CAPITAL)


def _letters(text: str, size_px: float) -> NDArray[np.float32]:
    """Coverage 0..1 of the text, with a margin of `size_px` on every side."""
    text = text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
    text = "".join(c if c.isprintable() or c == LEFT_TO_RIGHT else "\N{REPLACEMENT CHARACTER}" for c in text)
    font, pad = _font(size_px), round(size_px)
    w, h = math.ceil(font.getlength(text)) + 2 * pad, math.ceil(size_px) + 2 * pad
    canvas = Image.new("L", (w, h))
    ImageDraw.Draw(canvas).text((pad, h - pad), text, fill=255, font=font, anchor="ls")
    return np.asarray(canvas, np.float32) / np.float32(255)


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
    image: UInt8, box: tuple[int, int, int, int], scale: Scale, size_px: float, beyond: Beyond | None = None
) -> None:
    """A vertical bar in `box` = (x, y, width, height), low at the bottom, ticks and the unit at its right.

    beyond : what lies outside the range. A point at that end tells that it is shown in the last colour, and beside it
    stands how much that is and how far it reaches.
    """
    (x, y, w, h), lo, hi = box, scale.lo, scale.hi
    rows = np.round(np.linspace(255, 0, h)).astype(np.uint8)
    image[y : y + h, x : x + w] = table(scale.palette)[rows][:, None]
    line, right, tip_px = max(round(size_px / 12), 1), x + w + size_px * 0.9, round(w * 0.7)
    cv2.rectangle(image, (x - 1, y - 1), (x + w, y + h), INK, line, cv2.LINE_AA)
    top = y
    for above in (False, True):
        share, reach = (0.0, 0.0) if beyond is None else beyond.above if above else beyond.below
        if share == 0:
            continue
        end, sign = (y - 1, -1) if above else (y + h, 1)
        tip = np.array([[x - 1, end], [x + w, end], [x + (w - 1) // 2, end + sign * tip_px]], np.int32)
        cv2.fillPoly(image, [tip], table(scale.palette)[255 if above else 0].tolist(), cv2.LINE_AA)
        cv2.polylines(image, [tip], True, INK, line, cv2.LINE_AA)
        said = f"{percent(share)} {'above' if above else 'below'},", f"{'up' if above else 'down'} to {reach:.4g}"
        base = end + sign * round(size_px * 1.1) + (round(-1.5 * size_px) if above else round(1.5 * size_px))
        for number, text in enumerate(said):
            write(image, text, right, base + number * size_px * 1.45, size_px * 0.85, QUIET)
        top = min(top, round(base - size_px * 0.9)) if above else top
    marks = ticks(lo, hi)
    for value in marks:
        row = round(y + (hi - value) / (hi - lo) * (h - 1))
        cv2.line(image, (x + w, row), (x + w + round(size_px * 0.5), row), INK, line)
        write(image, tick_label(value, marks), right, row + size_px / 2, size_px)
    write(image, scale.unit, x, top - size_px * 1.4, size_px)
