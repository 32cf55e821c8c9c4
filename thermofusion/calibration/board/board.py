"""Calibration boards: a plane with numbered points whose places are known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from ...errors import ScanError
from ...types import Float

BoardKind = Literal["checkerboard", "pins", "mask", "circles", "asymmetric-circles", "charuco", "lamps"]
MAX_POINTS = 10_000  # more is a slip of the keyboard, and would fill the memory
ARUCO_DICTIONARY = cv2.aruco.DICT_5X5_1000  # of `charuco` boards: markers for 2000 squares


@dataclass(frozen=True)
class Board:
    """A flat target. Board frame: x along a row, y down the columns, z away from the viewer; point 0 at the origin.

    Attributes
    ----------
    kind : `checkerboard` (inner corners), `pins` (a metal pin on every corner of the squares), `mask` (square holes
        before a heated plate; the points are the holes' corners, so both counts are even), `circles`,
        `asymmetric-circles`, `charuco`, `lamps`.
    columns, rows : points along x and along y. Asymmetric circles: as OpenCV counts them, `columns` points in each
        of `rows` rows, every second row shifted by half a step.
    spacing_m : distance of neighbouring points (asymmetric circles: of neighbouring rows, half the step in a row).
    mark_ratio : size of the mark over the spacing (circle diameter, marker width); of a mask: hole width over pitch,
        the pitch being two spacings.

    Raises ScanError for a board that is no grid.
    """

    kind: BoardKind = "checkerboard"
    columns: int = 9
    rows: int = 6
    spacing_m: float = 0.03
    mark_ratio: float = 0.5

    def __post_init__(self) -> None:
        if self.kind not in get_args(BoardKind):
            raise ScanError(
                f"there is no board kind '{self.kind}'", hint=f"use one of {', '.join(get_args(BoardKind))}"
            )
        if self.columns < 2 or self.rows < 2 or self.columns * self.rows > MAX_POINTS:
            raise ScanError(f"a board of {self.columns} x {self.rows} points is not usable", hint="count inner corners")
        if self.kind == "mask" and (self.columns % 2 or self.rows % 2):
            raise ScanError("a mask of square holes has an even number of corners each way", hint="two per hole")
        if not 1e-4 < self.spacing_m < 10:
            raise ScanError(f"a spacing of {self.spacing_m} m is not usable", hint="give it in metres")
        if not 0.05 <= self.mark_ratio <= 0.95:
            raise ScanError(f"a mark of {self.mark_ratio} spacings is not usable", hint="give 0.05 to 0.95")

    def __len__(self) -> int:
        return self.columns * self.rows

    @property
    def points_m(self) -> Float:
        """(N, 3) points in the board frame, m, row by row, z = 0."""
        v, u = np.divmod(np.arange(len(self)), self.columns)
        if self.kind == "mask":
            x, y = (2 * (k // 2 + (k % 2) * self.mark_ratio) * self.spacing_m for k in (u, v))
            return np.stack([x, y, np.zeros(len(self))], axis=1)
        x = (2 * u + v % 2) if self.kind == "asymmetric-circles" else u
        return np.stack([x * self.spacing_m, v * self.spacing_m, np.zeros(len(self))], axis=1)

    @property
    def extent_m(self) -> tuple[float, float]:
        """Width and height spanned by the points, m."""
        p = self.points_m
        return float(p[:, 0].max()), float(p[:, 1].max())

    def outline_m(self, margin: float = 0.0) -> Float:
        """(4, 3) corners of the rectangle round the points, m, grown by `margin` spacings on every side."""
        (w, h), m = self.extent_m, margin * self.spacing_m
        return np.array([[-m, -m, 0], [w + m, -m, 0], [w + m, h + m, 0], [-m, h + m, 0]])
