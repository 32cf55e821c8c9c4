"""What a pattern of the sensor that residuals hide does to the calibration.

It is one error in all readings of a cell of the image, whatever their number: noise does not know this part of the
covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..types import Float, Observations
from .system import OverlapSystem, Solution

CELL = 80 / 640  # image widths: over which a pattern below what criticism sees is taken to be alike


def with_pattern(
    system: OverlapSystem, solution: Solution, rows: Observations, width_px: int, hidden_K: float
) -> Solution:
    """The solution with the covariance that a pattern of hidden_K, one number a cell of the image, adds to it."""
    side = CELL * width_px
    cell = (rows.v_px // side).astype(np.int64) * 4096 + (rows.u_px // side).astype(np.int64)
    shifts = _Scores(system, solution).shifts(np.full(len(rows), hidden_K * system.slope_L), cell)
    return replace(solution, covariance=solution.covariance + shifts.T @ shifts)


class _Scores:
    """How errors of rows move the parameters, vertices' own unknowns eliminated."""

    def __init__(self, system: OverlapSystem, solution: Solution) -> None:
        at, w, p = system.layout, solution.weight, solution.p
        self._system, self._inverse = system, solution.covariance / solution.scale**2
        E = system.E + p[at.shape] * system.D
        bend = system.D * solution.x[system.vertex] * system.use_shape
        self._shared = np.column_stack([system.patterns, bend, system.gain_column])
        by_vertex = csr_matrix((w * E, (system.vertex, np.arange(len(w)))), shape=(system.n_vertices, len(w)))
        to_group = csr_matrix((w * E, (system.vertex, system.group)), shape=(system.n_vertices, at.n_offsets))
        total = by_vertex @ E
        B = [to_group.toarray(), by_vertex @ self._shared]
        if system.sensor_columns is not None:
            B.append((by_vertex @ system.sensor_columns).toarray())
        self._share = np.hstack(B) / np.where(total > 0, total, np.inf)[:, None]
        self._E, self._weight = E, w

    def shifts(self, error: Float, cluster: NDArray[np.int64]) -> Float:
        """(C, P) what errors (N,) of the rows of each cluster (N,) do to the parameters together."""
        system, at = self._system, self._system.layout
        cluster = np.unique(cluster, return_inverse=True)[1]
        n, score, rows = int(cluster.max(initial=0)) + 1, self._weight * error, np.arange(len(cluster))
        by_cluster = csr_matrix((score, (cluster, rows)), shape=(n, len(cluster)))
        parts = [csr_matrix((score, (cluster, system.group)), shape=(n, at.n_offsets)).toarray()]
        parts.append(by_cluster @ self._shared)
        if system.sensor_columns is not None:
            parts.append((by_cluster @ system.sensor_columns).toarray())
        through = csr_matrix((score * self._E, (cluster, system.vertex)), shape=(n, system.n_vertices))
        summed = (np.hstack(parts) - through @ self._share) / system.correlated
        return np.asarray(summed @ self._inverse)
