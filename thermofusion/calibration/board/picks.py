"""Board points picked by hand: CSV, and the `picks.mat` of Herrera's toolbox as the paper's authors used it."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.io
from numpy.typing import NDArray

from ...errors import ScanError
from .board import Board
from .views import CAMERAS, BoardPoints, BoardView

INTERPOLATED_PX = 0.05  # px; no picture places a point this exactly on a grid again and again


def read_picks_csv(path: Path, board: Board) -> list[BoardView]:
    """Rows `view,camera,point,u_px,v_px`: point counts row by row from 0; camera is color, thermal or depth.

    Raises ScanError naming the line.
    """
    table: dict[str, dict[str, list[tuple[int, float, float]]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as f:
            reader = csv.DictReader(f)
            missing = {"view", "camera", "point", "u_px", "v_px"} - set(reader.fieldnames or ())
            if missing:
                raise ScanError(f"column(s) {', '.join(sorted(missing))} are missing", place=path)
            for number, row in enumerate(reader, 2):
                place = f"{path}, line {number}"
                try:
                    point, u, v = int(row["point"]), float(row["u_px"]), float(row["v_px"])
                except (TypeError, ValueError):
                    raise ScanError("point, u_px and v_px must be numbers", place=place) from None
                if row["camera"] not in CAMERAS:
                    raise ScanError(f"camera '{row['camera']}' is none of {', '.join(CAMERAS)}", place=place)
                if not 0 <= point < len(board):
                    raise ScanError(
                        f"point {point} does not exist on a board of {board.columns} x {board.rows}",
                        place=place,
                        hint="check --columns and --rows",
                    )
                table.setdefault(row["view"], {}).setdefault(row["camera"], []).append((point, u, v))
    except FileNotFoundError:
        raise ScanError("there is no such picks file", place=path) from None
    except (UnicodeDecodeError, csv.Error) as e:
        raise ScanError(f"it cannot be read as CSV ({e})", place=path) from None
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
        m = scipy.io.loadmat(path)
        grid = np.asarray(_cells(_cells(m["rgb_grid_x"])[0])[0], np.float64)
        picks = [_cells(c) for c in _cells(m["rgb_grid_p"])]
        names = [_text(c) for c in _cells(_cells(m["rfiles"])[0])]
        sizes = [np.ravel(c) for c in _cells(m["rsize"])]
    except FileNotFoundError:
        raise ScanError("there is no such picks file", place=path) from None
    except (KeyError, IndexError, ValueError, NotImplementedError, TypeError) as e:
        raise ScanError(f"not a picks file of the toolbox ({e})", place=path, hint="export the picks as CSV") from None
    columns = len(np.unique(np.round(grid[0] / _step(grid[0]))))
    rows = len(np.unique(np.round(grid[1] / _step(grid[1]))))
    if columns * rows != grid.shape[1]:
        raise ScanError(f"{grid.shape[1]} points are no grid of {columns} x {rows}", place=path)
    board = Board("pins", columns, rows, spacing_m)
    order = np.round(grid[1] / _step(grid[1])).astype(int) * columns + np.round(grid[0] / _step(grid[0])).astype(int)
    views = []
    for k, name in enumerate(names):
        points = {}
        for camera, cells in zip(CAMERAS, picks, strict=False):
            if k < len(cells) and np.size(cells[k]):
                points[camera] = BoardPoints(order, np.asarray(cells[k], np.float64).T)
        views.append(BoardView(Path(name).stem, points))
    image_size = {c: (int(s[1]), int(s[0])) for c, s in zip(CAMERAS, sizes, strict=False)}
    return board, image_size, views


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
