"""Space cut into cubes: what lies in one of them is taken to share its errors, and what follows another is near it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import Bool


def patches(points_m: NDArray, size_m: float) -> tuple[NDArray[np.intp], Bool]:
    """Number of the cubic patch that each of points_m (N, 3) m lies in, and its colour in a checkerboard, (N,) each."""
    cell = np.floor(points_m / size_m).astype(np.int64)
    black = cell.sum(axis=1) % 2 == 0
    cell -= cell.min(axis=0, initial=0)
    return np.unique(cell @ np.array([1 << 40, 1 << 20, 1]), return_inverse=True)[1], black


def along_curve(points_m: NDArray, size_m: float) -> NDArray[np.intp]:
    """Order (N,) of points_m (N, 3) m along a Z-order curve through cubes of size_m (Morton, 1966).

    Every k-th point of it covers all places alike, whatever order the points stand in. Sides up to 2^21 cubes.
    """
    cell = np.floor((points_m - points_m.min(axis=0, initial=np.inf)) / size_m).astype(np.uint64)
    for shift, mask in _SPREAD:
        cell = (cell | cell << np.uint64(shift)) & np.uint64(mask)
    return np.argsort(cell @ np.array([1, 2, 4], np.uint64), kind="stable")


_SPREAD = (  # halves, quarters ... of 21 bits moved apart until two zeros stand between any two of them
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
