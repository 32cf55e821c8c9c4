"""Boards to print: SVG and PDF with a scale bar, to be measured after printing."""

from __future__ import annotations

import cv2
import numpy as np

from ...errors import RecipeError
from .board import ARUCO_DICTIONARY, Board
from .drawing import Page

PAPER_MM = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
}
EDGE_MM = 8.0  # printers leave a rim
FOOT_MM = 22.0  # for the scale bar and the text
PIN_MARK_MM = 0.4  # a ring any larger hides the crossing from detectors


def board_svg(board: Board, *, paper: str | None = None) -> str:
    """SVG text of a board. paper: A4 ... A0, default the smallest that holds it."""
    return draw_board(board, paper=paper).svg()


def board_pdf(board: Board, *, paper: str | None = None) -> bytes:
    """PDF bytes of a board."""
    return draw_board(board, paper=paper).pdf()


def paper_of(page: Page) -> str:
    """What a page is printed on: `A4 landscape, 297 x 210 mm`."""
    short, long = sorted((page.width_mm, page.height_mm))
    name = next(n for n, size_mm in PAPER_MM.items() if size_mm == (short, long))
    way = "portrait" if page.height_mm > page.width_mm else "landscape"
    return f"{name} {way}, {page.width_mm:.0f} x {page.height_mm:.0f} mm"


def draw_board(board: Board, *, paper: str | None = None) -> Page:
    """The page with the board, a scale bar and a line on how to print and measure it.

    Raises RecipeError if the board does not fit the paper.
    """
    s = 1e3 * board.spacing_m
    w, h = (1e3 * e for e in board.extent_m)
    margin = {"checkerboard": s, "charuco": s, "pins": 0.6 * s, "mask": s}.get(board.kind, 0.5 * s * board.mark_ratio)
    page = Page(*_paper(w + 2 * margin, h + 2 * margin, paper), title=_caption(board))
    x0, y0 = (page.width_mm - w) / 2, EDGE_MM + (page.height_mm - FOOT_MM - EDGE_MM - h) / 2
    draw = {"checkerboard": _squares, "charuco": _charuco, "pins": _pins, "mask": _holes}.get(board.kind, _dots)
    draw(page, board, x0, y0, s)
    _foot(page, board)
    return page


def _paper(w: float, h: float, paper: str | None) -> tuple[float, float]:
    if paper is not None and paper not in PAPER_MM:
        raise RecipeError(f"there is no paper '{paper}'", hint=f"use one of {', '.join(PAPER_MM)}")
    for name in [paper] if paper else PAPER_MM:
        short, long = PAPER_MM[name]
        for width, height in ((short, long), (long, short)):
            if w <= width - 2 * EDGE_MM and h <= height - 2 * EDGE_MM - FOOT_MM:
                return width, height
    raise RecipeError(
        f"a board of {w:.0f} x {h:.0f} mm does not fit {paper or 'A0'}", hint="take fewer points or a smaller spacing"
    )


def _squares(page: Page, board: Board, x0: float, y0: float, s: float) -> None:
    """Inner corners at the points: one square more each way, the first one black."""
    for j in range(board.rows + 1):
        for i in range(board.columns + 1):
            if (i + j) % 2 == 0:
                page.rectangle(x0 + (i - 1) * s, y0 + (j - 1) * s, s, s)


def _pins(page: Page, board: Board, x0: float, y0: float, s: float) -> None:
    """Squares between the points and a drill mark on every point: a cross and a tiny ring."""
    for j in range(board.rows - 1):
        for i in range(board.columns - 1):
            if (i + j) % 2 == 0:
                page.rectangle(x0 + i * s, y0 + j * s, s, s)
    for x, y, _ in board.points_m * 1e3:
        page.circles.append((x0 + x, y0 + y, PIN_MARK_MM, False))
        for dx, dy in ((3.0, 0.0), (0.0, 3.0)):
            page.lines.append((x0 + x - dx, y0 + y - dy, x0 + x + dx, y0 + y + dy, 0.15))


def _holes(page: Page, board: Board, x0: float, y0: float, s: float) -> None:
    """Square holes to cut out."""
    width = 2 * s * board.mark_ratio
    for j in range(0, board.rows, 2):
        for i in range(0, board.columns, 2):
            page.rectangle(x0 + i * s, y0 + j * s, width, width)


def _dots(page: Page, board: Board, x0: float, y0: float, s: float) -> None:
    for x, y, _ in board.points_m * 1e3:
        page.circles.append((x0 + x, y0 + y, s * board.mark_ratio / 2, True))


def _charuco(page: Page, board: Board, x0: float, y0: float, s: float) -> None:
    """White squares carry markers, numbered row by row, as OpenCV lays them out."""
    dictionary = cv2.aruco.getPredefinedDictionary(ARUCO_DICTIONARY)
    marker, number = s * board.mark_ratio, 0
    for j in range(board.rows + 1):
        for i in range(board.columns + 1):
            x, y = x0 + (i - 1) * s, y0 + (j - 1) * s
            if (i + j) % 2 == 0:
                page.rectangle(x, y, s, s)
                continue
            n = dictionary.markerSize + 2
            bits = cv2.aruco.generateImageMarker(dictionary, number, n) == 0
            cell, at = marker / n, (s - marker) / 2
            for r, c in np.argwhere(bits):
                page.rectangle(x + at + c * cell, y + at + r * cell, cell, cell)
            number += 1


def _foot(page: Page, board: Board) -> None:
    y = page.height_mm - FOOT_MM + 6
    length = 100.0 if page.width_mm > 140 else 50.0
    for k in range(int(length / 10) + 1):
        page.lines.append((EDGE_MM + 10 * k, y - (3 if k % 5 == 0 else 1.5), EDGE_MM + 10 * k, y, 0.25))
    page.lines.append((EDGE_MM, y, EDGE_MM + length, y, 0.25))
    page.texts.append((EDGE_MM + length + 3, y, 3.5, f"{length:.0f} mm: measure after printing (100 %, no fitting)"))
    page.texts.append((EDGE_MM, y + 6, 3.5, f"{_caption(board)}; {paper_of(page)}"))
    page.texts.append((EDGE_MM, y + 11, 3.5, _advice(board)))


def _caption(board: Board) -> str:
    return f"thermofusion {board.kind}, {board.columns} x {board.rows} points, spacing {1e3 * board.spacing_m:g} mm"


def _advice(board: Board) -> str:
    return {
        "pins": "Glue on a flat board; drive a metal pin through every cross; cool or warm the board before recording.",
        "mask": "Cut the black squares out of card and hold it before a warm plate.",
        "lamps": "Drill the dots and set a lamp into each.",
        "charuco": "For the colour camera. Glue on a flat board.",
    }.get(board.kind, "Glue on a flat board; under a hot lamp black and white show in the thermal camera too.")
