"""The robust mean of each vertex's rows, where the scale of their residuals is known beforehand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compiled import compiled
from ...types import Float, Float32


class Steps(NamedTuple):
    """How often, and with what reach in sigmas: steps of the L1 fit and its floor, steps of Tukey's; least : share of
    a vertex's weight that must survive Tukey's."""

    l1: int
    floor: float
    tukey: int
    reach: float
    least: float


@compiled
def robust_weights(
    start: NDArray, count: NDArray, y: Float, E: Float, weight: Float32, root: Float32, steps: Steps
) -> Float32:  # pragma: no cover
    """Weights (N,) of rows y = E·x in groups start (G,), count (G,); see `mean.RobustMean.solve`.

    root : (N,) of a residual's factor to sigmas.
    """
    out = np.empty_like(weight)
    one, floor, reach = np.float32(1), np.float32(steps.floor), np.float32(steps.reach)
    most = np.int64(0)
    for g in range(count.shape[0]):
        most = max(most, count[g])
    l1 = np.empty(most, np.float32)
    for g in range(start.shape[0]):
        first, last = start[g], start[g] + count[g]
        for k in range(first, last):
            out[k] = weight[k]
        for step in range(steps.l1 + steps.tukey):
            up, down = 0.0, 0.0
            for k in range(first, last):
                wE = out[k] * E[k]
                up += wE * y[k]
                down += wE * E[k]
            x = up / down
            if step < steps.l1:
                for k in range(first, last):
                    t = abs(np.float32(y[k] - E[k] * x)) * root[k] / floor
                    out[k] = weight[k] * (one / max(t, one))
                    l1[k - first] = out[k]
                continue
            left, whole = 0.0, 0.0
            for k in range(first, last):
                t = abs(np.float32(y[k] - E[k] * x)) * root[k] / reach
                inside = max(one - t * t, np.float32(0))
                out[k] = weight[k] * (inside * inside)
                left += out[k]
                whole += weight[k]
            if left < steps.least * whole:
                for k in range(first, last):
                    out[k] = l1[k - first]
    return out
