"""Streams meet in time: the nearest colour frame for a depth frame, the pose at a thermal frame's own time. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Float, Int, Scan


@dataclass(frozen=True, eq=False)
class ColorPairs:
    """Which colour frame belongs to which depth frame.

    color_index : (N_depth,) int32, position in the colour stream; -1 = none near enough in time.
    offset_s : (N_depth,) colour time minus depth time; NaN where there is none.
    unpaired_depth, unpaired_color : how many frames of either stream found no partner.
    """

    color_index: Int
    offset_s: Float
    unpaired_depth: int
    unpaired_color: int


def nearest_in_time(times_s: NDArray, to_s: NDArray) -> tuple[NDArray[np.int64], Float]:
    """For each of `times_s` (N,) the position of the nearest in the rising `to_s` (M > 0,), and to_s - times_s.

    At equal distance the earlier one wins.
    """
    right = np.clip(np.searchsorted(to_s, times_s), 0, len(to_s) - 1)
    left = np.maximum(right - 1, 0)
    i = np.where(np.abs(to_s[left] - times_s) <= np.abs(to_s[right] - times_s), left, right)
    return i, to_s[i] - times_s


def pair_color(scan: Scan, tolerance_ms: float) -> ColorPairs:
    """The nearest usable colour frame of every depth frame, none if farther in time than the tolerance.

    A slower colour camera may serve two depth frames; that is what the tolerance bounds.
    """
    n = len(scan.depth)
    index, offset = np.full(n, -1, np.int32), np.full(n, np.nan)
    if scan.color is None or not scan.color.usable.any():
        return ColorPairs(index, offset, n, 0 if scan.color is None else len(scan.color))
    usable = np.flatnonzero(scan.color.usable)
    nearest, dt = nearest_in_time(scan.depth.times_s, scan.color.times_s[usable])
    near = np.abs(dt) <= tolerance_ms / 1e3 + 1e-9
    index[near], offset[near] = usable[nearest[near]], dt[near]
    used = len(np.unique(index[near]))
    return ColorPairs(index, offset, int(n - near.sum()), len(scan.color) - used)
