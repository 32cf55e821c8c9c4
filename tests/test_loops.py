"""Compiled loops over observations, against the same sums in whole arrays."""

from __future__ import annotations

import numpy as np

from thermofusion.robust import TUKEY, huber_weight, tukey_weight
from thermofusion.temperature.loops.overlap import Rows, overlap_sums
from thermofusion.temperature.mean import L1_FLOOR, L1_STEPS, TUKEY_STEPS, Groups, RobustMean

rng = np.random.default_rng(11)


def test_the_sums_of_one_step_are_those_of_dense_matrices():
    V, M, S, N, s, bend = 7, 4, 3, 60, 0.3, 1
    vertex, group = rng.integers(0, V, N), rng.integers(0, M, N).astype(np.int32)
    y, E, D, w, x = (
        rng.normal(size=N),
        rng.uniform(0.8, 1, N),
        rng.normal(size=N),
        rng.uniform(0, 2, N),
        rng.normal(size=V),
    )
    order = np.argsort(vertex, kind="stable").astype(np.int32)
    start = np.insert(np.cumsum(np.bincount(vertex, minlength=V)), 0, 0).astype(np.int32)
    columns = rng.normal(size=(N, S))
    a, c, B, normal, rhs = overlap_sums(Rows(group, y, E, D, columns, order, start), w, x, s, bend, M)

    np.testing.assert_allclose(columns[:, bend], D * x[vertex])  # filled on the way
    of_vertex, all_columns = np.eye(V)[vertex], np.hstack([np.eye(M)[group], columns])
    E, y = E + s * D, y + s * D * x[vertex]
    np.testing.assert_allclose(a, of_vertex.T @ (w * E * E))
    np.testing.assert_allclose(c, of_vertex.T @ (w * E * y), atol=1e-12)
    np.testing.assert_allclose(B, of_vertex.T @ (w[:, None] * E[:, None] * all_columns), atol=1e-12)
    whole = all_columns.T @ (w[:, None] * all_columns)
    whole[M:, M:] = 0  # left to BLAS
    np.testing.assert_allclose(normal, whole, atol=1e-12)
    np.testing.assert_allclose(rhs, all_columns.T @ (w * y), atol=1e-12)


def test_the_robust_mean_at_a_known_scale_is_that_of_whole_arrays():
    count = rng.integers(1, 9, 300)
    groups = Groups(np.arange(300, dtype=np.int32), np.insert(np.cumsum(count), 0, 0)[:-1], count)
    n, scale = int(count.sum()), 1.3
    weight, E = rng.uniform(0.5, 2, n).astype(np.float32), rng.uniform(0.7, 1, n)
    y = E * np.repeat(rng.normal(20, 3, 300), count) + rng.standard_t(2, n)
    mean = RobustMean(groups, y, E, weight, statistical=True)

    x, root = mean._estimate(weight), np.sqrt(weight)
    for _ in range(L1_STEPS):
        l1 = mean._weights(x, root, L1_FLOOR * scale, huber_weight)
        x = mean._estimate(l1)
    wanted = l1
    for _ in range(TUKEY_STEPS):
        wanted = mean._measured_kept(mean._weights(x, root, TUKEY * scale, tukey_weight), l1)
        x = mean._estimate(wanted)
    wanted = mean._balanced(wanted)
    solved = mean.solve(robust=True, scale=scale)
    np.testing.assert_allclose(solved.weight, wanted, rtol=2e-4, atol=1e-6)
    np.testing.assert_allclose(solved.x, mean._estimate(wanted), rtol=1e-6)
