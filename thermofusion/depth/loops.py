"""The inner loops over depth images, compiled: range and flying pixels, cells of pixels, what is kept of an image."""

from __future__ import annotations

import numpy as np

from ..compiled import compiled
from ..types import Bool, Float32, UInt16

MOST_STEPS = 65535  # of a unit of length that a kept image can hold; 0 stands for none


@compiled
def near_enough(
    depth: Float32, nearest: float, farthest: float, step_at_1m: float, least: int
) -> tuple[Float32, int, int, int, int]:  # pragma: no cover
    """depth (H, W) m between nearest and farthest m of pixels that have `least` of their 8 neighbours at their own
    depth, to within step_at_1m times depth²; else NaN. And first and last row and column + 1 of what is in range."""
    h, w = depth.shape
    out, near = np.empty((h, w), np.float32), np.zeros((h, w), np.uint8)
    close, nan = np.empty(w, np.uint8), np.float32(np.nan)
    low, high, step = np.float32(nearest), np.float32(farthest), np.float32(step_at_1m)
    top, bottom, left_end, right_end = h, 0, w, 0
    for v in range(h):
        for u in range(w):
            d = depth[v, u]
            out[v, u] = d if (d >= low) & (d <= high) else nan
        row = out[v]
        first, last = 0, w
        while first < w and row[first] != row[first]:
            first += 1
        while last > first and row[last - 1] != row[last - 1]:
            last -= 1
        if first < w:
            top, bottom = min(top, v), v + 1
            left_end, right_end = min(left_end, first), max(right_end, last)
    for v in range(h):
        for n in range(4):  # half of the neighbours; each pair counts for both its pixels
            dv, du = (0, 1) if n == 0 else (1, n - 2)
            if v + dv >= h:
                continue
            left, right = max(0, -du), w - max(0, du)
            here, there, mine, its = out[v], out[v + dv], near[v], near[v + dv]
            for u in range(left, right):
                close[u] = abs(here[u] - there[u + du]) < here[u] * here[u] * step  # NaN compares False
            for u in range(left, right):
                mine[u] += close[u]
            for u in range(left, right):
                its[u + du] += close[u]
    for v in range(h):
        for u in range(w):
            out[v, u] = out[v, u] if near[v, u] >= least else nan
    return out, top, bottom, left_end, right_end


@compiled
def cell_means(depth: Float32, edge: int, least: float) -> Float32:  # pragma: no cover
    """Mean inverse depth, m-1, of cells of `edge` pixels squared, those at the right and bottom rim perhaps cut off;
    of depth (H, W) m, NaN = none; NaN where no more than the share `least` of a whole cell holds depth."""
    h, w = depth.shape
    rows, columns = -(-h // edge), -(-w // edge)
    out = np.empty((rows, columns), np.float32)
    total, count = np.empty(columns, np.float32), np.empty(columns, np.int32)
    for r in range(rows):
        total[:], count[:] = 0, 0
        for v in range(r * edge, min(r * edge + edge, h)):
            for u in range(w):
                if depth[v, u] == depth[v, u]:
                    total[u // edge] += np.float32(1) / depth[v, u]
                    count[u // edge] += 1
        for c in range(columns):
            enough = count[c] > least * edge * edge
            out[r, c] = total[c] / np.float32(count[c]) if enough else np.float32(np.nan)
    return out


@compiled
def blot_out(depth: Float32, cell: Bool, edge: int) -> None:  # pragma: no cover
    """Depth (H, W) becomes NaN where a cell of `edge` pixels squared is True."""
    for v in range(depth.shape[0]):
        for c in range(cell.shape[1]):
            if cell[v // edge, c]:
                depth[v, c * edge : (c + 1) * edge] = np.nan


@compiled
def coarser(depth: Float32, edge: int, spread: float) -> Float32:  # pragma: no cover
    """Mean depth of cells of `edge` pixels squared of depth (H, W) m, NaN = none; NaN where less than half of a cell is
    valid, or its depths differ by more than the share `spread`."""
    h, w = depth.shape[0] // edge, depth.shape[1] // edge
    out, some = np.empty((h, w), np.float32), np.float32(spread)
    for r in range(h):
        for c in range(w):
            total, count, low, high = np.float32(0), 0, np.float32(np.inf), np.float32(-np.inf)
            for v in range(r * edge, r * edge + edge):
                for u in range(c * edge, c * edge + edge):
                    d = depth[v, u]
                    if d == d:
                        total, count, low, high = total + d, count + 1, min(low, d), max(high, d)
            good = 2 * count >= edge * edge and high - low < some * low
            out[r, c] = total / np.float32(count) if good else np.float32(np.nan)
    return out


@compiled
def in_steps(depth: Float32, unit_m: float, out: UInt16) -> bool:  # pragma: no cover
    """Depth (H, W) m as numbers of unit_m, 0 for NaN, written to `out` (H, W); False if that loses anything."""
    unit = np.float32(unit_m)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            d = depth[v, u]
            n = np.rint(d / unit) if d == d else np.float32(0)
            if d == d and not (0 < n <= MOST_STEPS and np.float32(n) * unit == d):
                return False
            out[v, u] = np.uint16(n)
    return True


@compiled
def from_steps(steps: UInt16, unit_m: float, out: Float32) -> None:  # pragma: no cover
    """The inverse of `in_steps`: out (H, W) m, NaN = none."""
    unit, nan = np.float32(unit_m), np.float32(np.nan)
    for v in range(steps.shape[0]):
        for u in range(steps.shape[1]):
            n = steps[v, u]
            out[v, u] = np.float32(n) * unit if n > 0 else nan
