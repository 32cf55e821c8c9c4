"""Sums of one step of the overlap: what vertices' own unknowns take, and what views and shared terms have in common."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...compiled import compiled
from ...types import Float, Int


class Rows(NamedTuple):
    """Rows of the overlap: their view's group, y, E, D (N,), shared columns (N, S), and their order by vertex: those
    of vertex v are order[start[v]]..order[start[v + 1] - 1]. See `system.OverlapSystem`."""

    group: Int
    y: Float
    E: Float
    D: Float
    columns: Float
    order: Int
    start: Int


@compiled
def overlap_sums(
    rows: Rows, weight: Float, x: Float, shape: float, bend: int, n_groups: int
) -> Any:  # pragma: no cover
    """(a, c, B, N, rhs): per vertex Σ wE² (V,), Σ wEy (V,), Σ wE·(group, columns) (V, M + S); and Σ w of groups with
    groups and columns in N (M + S, M + S), Σ w·(group, columns)·y (M + S,).

    E is with the shape s; its column `bend` is filled with D·x on the way, and y given back what s took; -1 = none.
    The columns' own squares are left to BLAS.
    """
    S, M, V = rows.columns.shape[1], n_groups, rows.start.shape[0] - 1
    a, c, B = np.zeros(V), np.zeros(V), np.zeros((V, M + S))
    N, rhs = np.zeros((M + S, M + S)), np.zeros(M + S)
    for v in range(V):
        mine = B[v]
        for k in range(rows.start[v], rows.start[v + 1]):
            n = rows.order[k]
            line, g, w = rows.columns[n], rows.group[n], weight[n]
            E, y = rows.E[n] + shape * rows.D[n], rows.y[n]
            if bend >= 0:
                line[bend] = rows.D[n] * x[v]
                y += shape * line[bend]
            wE, wy = w * E, w * y
            a[v] += wE * E
            c[v] += wE * y
            mine[g] += wE
            N[g, g] += w
            rhs[g] += wy
            theirs = N[g]
            for j in range(S):
                mine[M + j] += wE * line[j]
                theirs[M + j] += w * line[j]
                rhs[M + j] += wy * line[j]
    for g in range(M):
        for j in range(S):
            N[M + j, g] = N[g, M + j]
    return a, c, B, N, rhs
