"""Which surface does not behave as skin: hair, clothes. Its reading changes with the angle as skin's does not.

Smooth skin darkens towards grazing angles along one curve for the whole body. Cloth and hair are rough: what is right
for skin over-corrects or under-corrects them, in every view alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..geometry.patches import patches
from ..types import Bool, Float
from .blend import BlendResult
from .crosscal import Calibration
from .problem import ThermalProblem
from .uncertainty import AngleTables, observation_variance

SAMPLE = 8000  # vertices that the slopes are taken from
PATCH_M = 0.05
MIN_VIEWS = 8  # that a patch's slope is taken from
SURE, LIKELY = 8.0, 5.0  # sigmas of a patch by itself, and of one beside such; patches of skin stay within 7.5
REACH_M = 0.09  # to the middles of neighbouring patches
MIN_PATCHES = 4  # fewer side by side may be chance
MAX_SHARE = 0.5  # of the body: beyond it the model of skin is at fault
BORDER_K = 0.5  # a border is drawn by temperature where both sides differ by this much


def not_skin(problem: ThermalProblem, calibration: Calibration, blended: BlendResult) -> tuple[Bool, float]:
    """(V,) True where the surface does not behave as skin. Says nothing where fewer than eight views saw a patch.

    Where that would be more than half of the surface the model of skin is at fault: nothing, and the share it would be.
    """
    patch_of, _ = patches(problem.points_m, PATCH_M)
    n = int(patch_of.max(initial=0)) + 1
    z = _slopes(problem, calibration, blended, patch_of, n)
    sums = [np.bincount(patch_of, problem.points_m[:, k], n) for k in range(3)]
    middle = np.asarray(np.column_stack(sums) / np.bincount(patch_of, minlength=n)[:, None], np.float64)
    near = cKDTree(middle).sparse_distance_matrix(cKDTree(middle), REACH_M, output_type="coo_matrix").tocsr()
    near.data[:] = 1.0
    found = np.nan_to_num(np.abs(z)) > SURE
    found &= near @ found.astype(float) >= MIN_PATCHES - 1
    for _ in range(2):
        beside = near @ found.astype(float) > 0
        found |= beside & (np.nan_to_num(np.abs(z)) > LIKELY)
    # surrounded by it: too few views, but no island of skin
    neighbours = np.maximum(near @ np.ones(n), 1)
    found |= near @ found.astype(float) > 0.6 * neighbours
    share = float(found[patch_of].mean()) if found.any() else 0.0
    if share == 0 or share > MAX_SHARE:
        return np.zeros(len(problem), bool), share
    return _bordered(problem.points_m, blended.normal_equivalent_K, patch_of, found, middle), 0.0


def _slopes(
    problem: ThermalProblem, calibration: Calibration, blended: BlendResult, patch_of: NDArray, n: int
) -> Float:
    """(P,) slope of residuals on 1 - E in each patch, in its own sigmas (sandwich by view); NaN with too few views."""
    rows = problem.observations
    every = max(1, len(problem) // SAMPLE)
    use = problem.clear & (rows.vertex % every == 0) & np.isfinite(rows.radiance)
    use &= rows.cos_angle >= np.float32(np.cos(np.radians(problem.mapping.max_angle_deg)))
    rows = rows.select(use)
    tables = AngleTables.of(calibration.emissivity(problem.emissivity))
    x = (problem.band.radiance(blended.normal_equivalent_K) - problem.L_reflected)[rows.vertex]
    E = tables.relative(rows.cos_angle)
    residual = calibration.corrected(rows) - problem.L_reflected[rows.vertex] - E * x
    w = 1 / observation_variance(rows, x, tables, problem.errors, calibration.slope_L).astype(np.float64)
    w[~np.isfinite(residual)] = 0
    residual = np.nan_to_num(residual)
    lever = (1 - E) * np.abs(np.nan_to_num(x))
    total = np.maximum(np.bincount(rows.vertex, w), 1e-300)
    for column in (lever, residual):  # a vertex's mean takes part of any slope along
        column -= (np.bincount(rows.vertex, w * column) / total)[rows.vertex]
    patch = patch_of[rows.vertex]
    square = np.maximum(np.bincount(patch, w * lever**2, n), 1e-300)
    slope = np.bincount(patch, w * lever * residual, n) / square
    cell, at = np.unique(patch * problem.n_views + rows.view, return_inverse=True)
    score = np.bincount(at, w * lever * (residual - slope[patch] * lever)) ** 2
    views = np.bincount(cell // problem.n_views, minlength=n)
    sigma = np.sqrt(np.bincount(cell // problem.n_views, score, n) * views / np.maximum(views - 1, 1)) / square
    return np.where((views >= MIN_VIEWS) & (sigma > 0), slope / np.maximum(sigma, 1e-300), np.nan)


def _bordered(points_m: NDArray, T_K: Float, patch_of: NDArray, found: Bool, middle: Float) -> Bool:
    """Patches (P,) into vertices (V,): within patches of the border, whichever side's temperature is nearer."""
    inside = found[patch_of]
    measured = np.isfinite(T_K)
    count = np.maximum(np.bincount(patch_of, measured, len(found)), 1)
    T = np.bincount(patch_of, np.where(measured, T_K, 0), len(found)) / count
    trees = [cKDTree(middle[side]) for side in (found, ~found)]
    to_other = np.where(inside, trees[1].query(points_m)[0], trees[0].query(points_m)[0])
    edge = np.flatnonzero(measured & (to_other < REACH_M / 2 + PATCH_M / 2))
    sides = []
    for side, tree in zip((found, ~found), trees, strict=True):
        k = min(4, int(side.sum()))
        _, index = tree.query(points_m[edge], k=k)
        sides.append(np.median(T[side][np.reshape(index, (len(edge), k))], axis=1))
    apart = np.abs(sides[0] - sides[1]) > BORDER_K
    inside[edge[apart]] = (np.abs(T_K[edge] - sides[0]) < np.abs(T_K[edge] - sides[1]))[apart]
    return inside
