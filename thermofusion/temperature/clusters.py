"""Errors that readings have in common: the solution's covariance from scores of clusters instead of single readings.

A million readings whose errors are alike by view, by place in the image, or by both are no million witnesses. The
spread of the clusters' score vectors says how many they are (sandwich estimate: Liang & Zeger 1986; several ways of
clustering: Cameron, Gelbach & Miller 2011).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..types import Float, Observations
from .system import OverlapSystem, Solution

CELL = 40 / 640  # image widths: a cell of the image
BLOCK_VIEWS = 5  # views in a row: what drifts between shutters is one error over them
PATTERN_CELL = 80 / 640  # image widths: over which a pattern below what criticism sees is taken to be alike
MAX_INFLATION = 100.0  # of a variance


def with_clusters(
    system: OverlapSystem, solution: Solution, rows: Observations, width_px: int, alike_K: float
) -> Solution:
    """The solution with the covariance that its residuals leave possible.

    Each parameter's variance becomes the largest over three ways of clustering residuals; correlations stay. On top
    comes what a pattern of alike_K, one number a cell of the image, would do to the parameters: criticism of the
    residuals does not see, or does not explain, a smaller one.
    """
    cell, coarse = _cells(rows, CELL * width_px), _cells(rows, PATTERN_CELL * width_px)
    single = np.diag(solution.covariance)
    ratio = np.ones(len(single))
    scores = _Scores(system, solution)
    for cluster in (rows.view.astype(np.int64), cell, cell * 4096 + rows.view // BLOCK_VIEWS):
        shifts = scores.shifts(scores.residual, cluster)
        variance = (shifts**2).sum(0) * len(shifts) / max(len(shifts) - 1, 1)
        ratio = np.maximum(ratio, np.divide(variance, single, out=np.ones_like(single), where=single > 0))
    root = np.sqrt(np.minimum(ratio, MAX_INFLATION))
    pattern = scores.shifts(np.full(len(rows), alike_K * system.slope_L), coarse)
    return replace(solution, covariance=solution.covariance * np.outer(root, root) + pattern.T @ pattern)


def _cells(rows: Observations, side_px: float) -> NDArray[np.int64]:
    """(N,) number of the cell of the image that each row lies in."""
    return np.asarray((rows.v_px // side_px).astype(np.int64) * 4096 + (rows.u_px // side_px).astype(np.int64))


class _Scores:
    """How errors of rows move the parameters, vertices' own unknowns eliminated; residual : (N,) W m-2 sr-1."""

    def __init__(self, system: OverlapSystem, solution: Solution) -> None:
        at, w, p = system.layout, solution.weight, solution.p
        self._system, self._inverse = system, solution.covariance / solution.scale**2
        E = system.E + p[at.shape] * system.D
        self.residual = system.y - system.predict(p, solution.x)
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
