"""Space cut into cubes: what lies in one of them is taken to share its errors."""

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
