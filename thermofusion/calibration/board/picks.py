"""Board points picked by hand: CSV, and the `picks.mat` of Herrera's toolbox as the paper's authors used it."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import read_bytes
from ...files.table import table_rows
from .board import Board
from .matlab import MAX_UNPACKED_BYTES, read_matlab
from .views import CAMERAS, BoardPoints, BoardView

MAX_PICK_PX = 100_000  # no image is as wide
VARIABLES = ("rgb_grid_x", "rgb_grid_p", "rfiles", "rsize")  # of the toolbox's file
INTERPOLATED_PX = 0.05  # px; no picture places a point this exactly on a grid again and again


def read_picks_csv(path: Path, board: Board) -> list[BoardView]:
    """Rows `view,camera,point,u_px,v_px`: point counts row by row from 0; camera is color, thermal or depth.

    Raises ScanError naming the line.
    """
    table: dict[str, dict[str, list[tuple[int, float, float]]]] = {}
    for number, row in table_rows(path, "picks", ("view", "camera", "point", "u_px", "v_px")):
        place = f"{path}, line {number}"
        try:
            point, u, v = int(row["point"]), float(row["u_px"]), float(row["v_px"])
        except ValueError:
            raise ScanError("point, u_px and v_px must be numbers", place=place) from None
        if row["camera"] not in CAMERAS:
            raise ScanError(f"camera '{row['camera'][:40]}' is none of {', '.join(CAMERAS)}", place=place)
        if not 0 <= point < len(board):
            raise ScanError(
                f"point {row['point'][:40]} does not exist on a board of {board.columns} x {board.rows}",
                place=place,
                hint="check columns and rows of the board in calibration.json",
            )
        if not (abs(u) <= MAX_PICK_PX and abs(v) <= MAX_PICK_PX):
            raise ScanError(f"u_px and v_px must lie within ±{MAX_PICK_PX} px", place=place)
        table.setdefault(row["view"], {}).setdefault(row["camera"], []).append((point, u, v))
    views = []
    for name, cameras in table.items():
        arrays = {c: np.array(rows) for c, rows in cameras.items()}
        for c, a in arrays.items():
            if len(np.unique(a[:, 0])) < len(a):
                raise ScanError(f"view '{name}' has a point of the {c} camera twice", place=path)
        views.append(BoardView(name, {c: BoardPoints(a[:, 0].astype(np.int64), a[:, 1:]) for c, a in arrays.items()}))
    return views


def read_picks_mat(path: Path, spacing_m: float) -> tuple[Board, dict[str, tuple[int, int]], list[BoardView]]:
    """The toolbox's calibration file: `rgb_grid_p{1}` colour, `{2}` thermal, `rgb_grid_x` board points, `rfiles` names.

    Returns the board (a pin grid with `spacing_m`: the file's own square size is only somebody's assumption), image
    sizes by camera, and the views. MATLAB counts from pixel centre 1; the toolbox's own picks are already 0-based
    [px], as its projection code has it. Raises ScanError if a variable is absent or shaped otherwise.
    """
    try:
        data = read_bytes(path, "picks", limit_bytes=MAX_UNPACKED_BYTES)
        return _toolbox_picks(read_matlab(data, VARIABLES), spacing_m)
    except ScanError as e:
        raise ScanError(e.cause, place=path, hint=e.hint) from None
    except (LookupError, ValueError, TypeError, OverflowError, StopIteration, zlib.error) as e:
        why = f"not a picks file of the toolbox ({type(e).__name__})"
        raise ScanError(why, place=path, hint="export the picks as CSV") from None


def _toolbox_picks(m: Mapping[str, Any], spacing_m: float) -> tuple[Board, dict[str, tuple[int, int]], list[BoardView]]:
    grid = np.asarray(_cells(_cells(m["rgb_grid_x"])[0])[0], np.float64)
    picks = [_cells(c) for c in _cells(m["rgb_grid_p"])]
    names = [_text(c) for c in _cells(_cells(m["rfiles"])[0])]
    sizes = [np.ravel(c) for c in _cells(m["rsize"])]
    if not np.all(np.abs(grid) <= MAX_PICK_PX):
        raise ScanError("the board's points are no finite numbers")
    column, row = (np.round(axis / _step(axis)).astype(np.int64) for axis in grid[:2])
    columns, rows = len(np.unique(column)), len(np.unique(row))
    order = row * columns + column
    if columns * rows != len(order) or not np.array_equal(np.sort(order), np.arange(len(order))):
        raise ScanError(f"{grid.shape[1]} points are no grid of {columns} x {rows}")
    views = []
    for k, name in enumerate(names):
        points = {}
        for camera, cells in zip(CAMERAS, picks, strict=False):
            if k < len(cells) and np.size(cells[k]):
                px = np.asarray(cells[k], np.float64).T
                if np.nanmax(np.abs(px), initial=0) > MAX_PICK_PX:
                    raise ScanError(f"view '{name}' has a point beyond ±{MAX_PICK_PX} px")
                points[camera] = BoardPoints(order, px)
        views.append(BoardView(Path(name).stem, points))
    image_size = {c: (int(s[1]), int(s[0])) for c, s in zip(CAMERAS, sizes, strict=False)}
    return Board("pins", columns, rows, spacing_m), image_size, views


def interpolated(points: BoardPoints, board: Board) -> NDArray[np.bool_] | None:
    """(N,) True for points that lie exactly on the perspective grid of the board's four corner points; None if a corner
    is missing.

    Toolboxes let a person click four corners, lay a homography on them and move a point only where the picture says so.
    What was not moved is no observation: it carries the errors of the four clicks and knows nothing of the lens.
    """
    corners = np.array([0, board.columns - 1, len(board) - board.columns, len(board) - 1])
    row = {int(i): k for k, i in enumerate(points.index)}
    if any(int(i) not in row for i in corners):
        return None
    grid = board.points_m[:, :2] / board.spacing_m
    H = cv2.getPerspectiveTransform(
        grid[corners].astype(np.float32), points.px[[row[int(i)] for i in corners]].astype(np.float32)
    )
    expected = cv2.perspectiveTransform(grid[points.index][:, None], H)[:, 0]
    on_grid = np.linalg.norm(expected - points.px, axis=1) < INTERPOLATED_PX
    return np.asarray(on_grid & ~np.isin(points.index, corners), bool)


def _step(x: np.ndarray) -> float:
    d = np.diff(np.unique(np.round(x, 9)))
    return float(d[d > 1e-9].min())


def _cells(value: Any) -> list[Any]:
    """A MATLAB cell array as a list."""
    a = np.asarray(value)
    if a.dtype != object:
        raise TypeError("expected a cell array")
    return list(a.ravel())


def _text(value: Any) -> str:
    while isinstance(value, np.ndarray):
        value = value.ravel()[0]
    return str(value)
