"""What was seen: board points in pictures and depth samples on the board, by view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...types import Float
from .board import Board

CAMERAS = ("color", "thermal", "depth")  # in this order the first that sees boards is the hub
MIN_POINTS = 6  # below this a pose from one picture is not determined with any redundancy


@dataclass(frozen=True, eq=False)
class BoardPoints:
    """Board points in one picture: `index` (N,) into `board.points_m`, `px` (N, 2), first pixel centre (0, 0).

    Points whose pixels are not finite are left out. Raises ValueError if the lengths differ.
    """

    index: NDArray[np.int64]
    px: Float

    def __post_init__(self) -> None:
        index, px = np.asarray(self.index, np.int64), np.asarray(self.px, np.float64).reshape(-1, 2)
        if len(index) != len(px):
            raise ValueError(f"{len(index)} board points with {len(px)} pixels")
        seen = np.isfinite(px).all(axis=1)
        object.__setattr__(self, "index", index[seen])
        object.__setattr__(self, "px", px[seen])

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True, eq=False)
class DepthSamples:
    """Depth on the board: pixel (N,), (N,) and value (N,), metres along z or raw disparity; sigma (N,) of the value."""

    u_px: Float
    v_px: Float
    value: Float
    sigma: Float

    def __len__(self) -> int:
        return len(self.value)


@dataclass(frozen=True, eq=False)
class BoardView:
    """One stand of the board: `points` by camera (`color`, `thermal`, `depth` for an infrared picture), depth on its
    plane, and the board's corners where the depth image's dropouts put them (their shift in common)."""

    name: str
    points: Mapping[str, BoardPoints] = field(default_factory=dict)
    depth: DepthSamples | None = None
    depth_marks: BoardPoints | None = None

    def with_points(self, camera: str, points: BoardPoints | None) -> BoardView:
        """A copy with other points of one camera (None: without)."""
        kept = {k: v for k, v in self.points.items() if k != camera}
        return replace(self, points=kept if points is None else {**kept, camera: points})


@dataclass(frozen=True, eq=False)
class CalibrationSet:
    """All views of one board with one rig, in the order of recording.

    image_size : (width, height) by camera, px.
    """

    board: Board
    image_size: Mapping[str, tuple[int, int]]
    views: tuple[BoardView, ...]

    def named(self, names: set[str]) -> CalibrationSet:
        """Only the views of these names."""
        return replace(self, views=tuple(v for v in self.views if v.name in names))

    def seen_by(self, camera: str) -> list[BoardView]:
        """Views in which a camera saw enough of the board."""
        return [v for v in self.views if camera in v.points and len(v.points[camera]) >= MIN_POINTS]

    @property
    def cameras(self) -> list[str]:
        """Cameras with pictures of the board, colour first."""
        return [c for c in CAMERAS if self.seen_by(c)]
