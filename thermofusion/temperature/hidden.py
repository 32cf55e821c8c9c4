"""What noise does not know of the calibration's errors: a pattern of the sensor that residuals hide, and what readings
of one stretch of skin have in common.

A pattern is one error in all readings of a cell of the image, whatever their number. A stretch of skin whose normals or
registration are off pulls at the calibration with all its readings at once: there are as many witnesses as stretches.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..geometry.patches import along_curve
from ..types import Float, Observations
from .system import OverlapSystem, Solution

CELL = 80 / 640  # image widths: over which a pattern below what criticism sees is taken to be alike
STRETCHES = 16  # of skin, each alike in area: 20 cm of a torso, 35 cm of a whole body
CURVE_M = 1e-3  # cubes of the curve along which they are cut
KNOWN = 1e-12  # of the largest variance: below, a direction is held


def with_hidden(
    system: OverlapSystem, solution: Solution, rows: Observations, points_m: NDArray, hidden_K: float
) -> Solution:
    """The solution with the covariance that these add to it.

    points_m : (N, 3) m, where each row's vertex is. hidden_K : of a pattern, one number a cell of the image.
    Stretches of skin count, along each direction of the parameters, where they say more than noise and
    pattern together: the sum over stretches of what their residuals do (White's estimator by clusters).
    """
    side = CELL * system.field.width_px
    cell = (rows.v_px // side).astype(np.int64) * 4096 + (rows.u_px // side).astype(np.int64)
    scores = _Scores(system, solution)
    pattern = scores.shifts(np.full(len(rows), hidden_K * system.slope_L), cell)
    covariance = solution.covariance + pattern.T @ pattern
    order = along_curve(points_m[system.order[system.start[:-1]]], CURVE_M)
    stretch = np.empty(len(order), np.int64)
    stretch[order] = np.arange(len(order)) * STRETCHES // len(order)
    residual = system.y - system.predict(solution.p, solution.x)
    shifts = scores.shifts(residual, stretch[system.vertex]) * np.sqrt(STRETCHES / (STRETCHES - 1))
    return replace(solution, covariance=_larger(covariance, shifts))


def _larger(covariance: Float, shifts: Float) -> Float:
    """(P, P) the larger, along each direction, of a covariance (P, P) and of the sum of squares of shifts (C, P)."""
    values, vectors = np.linalg.eigh(covariance)
    known = values > KNOWN * values[-1]
    root, inverse = vectors[:, known] * np.sqrt(values[known]), vectors[:, known] / np.sqrt(values[known])
    white = shifts @ inverse
    larger, along = np.linalg.eigh(white.T @ white)
    root = root @ (along * np.sqrt(np.maximum(larger, 1.0)))
    return np.asarray(root @ root.T)


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
