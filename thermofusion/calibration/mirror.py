"""Mirrored pictures: a board seen in one has the wrong handedness, which no camera can make up for."""

from __future__ import annotations

import numpy as np

from ..errors import ScanError
from .views import BoardPoints, CalibrationSet


def handedness(points: BoardPoints, board_m: np.ndarray) -> float:
    """Sign of the area the board's axes span in the picture: +1 seen from the front, -1 mirrored (or from behind)."""
    X = board_m[points.index][:, :2]
    A = np.linalg.lstsq(np.column_stack([X - X.mean(0), np.ones(len(X))]), points.px, rcond=None)[0]
    return float(np.sign(np.linalg.det(A[:2])))


def mirrored_cameras(data: CalibrationSet) -> dict[str, list[str]]:
    """Camera -> views whose points run round the wrong way."""
    board = data.board.points_m
    return {c: [v.name for v in data.seen_by(c) if handedness(v.points[c], board) < 0] for c in data.cameras}


def refuse_mirrored(data: CalibrationSet) -> None:
    """Raises ScanError if pictures are mirrored: all of a camera, or a few views numbered from the wrong corner."""
    for camera, views in mirrored_cameras(data).items():
        seen = len(data.seen_by(camera))
        if views and len(views) > 0.8 * seen:
            raise ScanError(
                f"the {camera} pictures are mirrored: the board's points run the wrong way round in {len(views)} of "
                f"{seen} views",
                hint=f"switch the driver's mirroring off, or calibrate with mirrored={{'{camera}'}}",
            )
        if views:
            raise ScanError(
                f"the {camera} points of {len(views)} views run the wrong way round ({', '.join(views[:5])})",
                hint="number them row by row from the same corner in every view, as seen from the front",
            )


def unmirror(points: BoardPoints, width_px: int) -> BoardPoints:
    """Points of a picture flipped left to right."""
    px = points.px.copy()
    px[:, 0] = width_px - 1 - px[:, 0]
    return BoardPoints(points.index, px)
