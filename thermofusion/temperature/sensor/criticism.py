"""What the residuals of a solution say against its own model: are they alike where they should have nothing in common?

A vertex's own mean takes part of every error along, so that sizes found here are too small by 2-3 times for what
changes little on a vertex's path through the image: they say that something is there, and where.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ...geometry.patches import patches
from ...types import Bool, Float, Observations
from ..system import OverlapSystem, Solution

FLIPS = 48  # sign patterns that a statistic's spread by chance is taken from
PATCH_M = 0.03  # a patch of skin: its errors (normals, registration) are one cluster
CLIP_SIGMAS = 6.0  # residuals count up to here
SEED = 20_260_501  # of the sign patterns: a run repeats itself
BLOCK_VIEWS = 5  # views over which a pattern that drifts is looked for


@dataclass(frozen=True, eq=False)
class Residuals:
    """Left-out residuals of readings: K (N,), what the vertex's other readings say less this one, with their weight.

    weight : (N,) K-2. patch : (N,) number of the patch of skin. half : (N,) patches by turns, so that two halves of
    the skin share neither normals nor registration. rows : the observations.
    """

    residual_K: Float
    weight: Float
    patch: NDArray[np.intp]
    half: Bool
    rows: Observations


@dataclass(frozen=True)
class Alike:
    """By how much residuals of the same cell agree between two halves of the skin: size_K, signed; z against chance."""

    size_K: float
    z: float


def left_out(system: OverlapSystem, solution: Solution, rows: Observations, points_m: NDArray) -> Residuals:
    """Left-out residuals d = r/(1 - h), h a reading's share in its own vertex: no solving again.

    points_m : (N, 3) m, the rows' vertices.
    """
    at, w = system.layout, solution.weight
    E = system.E + solution.p[at.shape] * system.D
    total = np.bincount(system.vertex, w * E * E, system.n_vertices)[system.vertex]
    h = np.divide(w * E * E, total, out=np.ones_like(w), where=total > 0)
    good = h < 0.9  # a reading that is its vertex's only one tells nothing
    residual = (system.y - system.predict(solution.p, solution.x)) / np.where(good, 1 - h, 1.0)
    limit = CLIP_SIGMAS * solution.scale * np.sqrt(system.sigma2)
    weight = np.where(good, (1 - h) ** 2 / system.sigma2, 0.0) * system.slope_L**2
    patch, half = patches(points_m, PATCH_M)
    residual = np.clip(residual, -limit, limit) / system.slope_L
    # what a whole view has in common is its offset's
    total = np.bincount(system.group, weight, system.n_groups)
    mean = np.bincount(system.group, weight * residual, system.n_groups) / np.maximum(total, 1e-300)
    return Residuals(residual - mean[system.group], weight, patch, half, rows)


def split_product(r: Residuals, cell: NDArray) -> Alike:
    """S² = Σ W m_A m_B / ΣW over cells (N,), m the halves' weighted means: zero in the mean where nothing is shared.

    The spread by chance comes from flipping the sign of all residuals of a patch together.
    """
    cell = np.unique(cell, return_inverse=True)[1]
    n_cells, n_patches = int(cell.max(initial=0)) + 1, int(r.patch.max(initial=0)) + 1
    sign = np.random.default_rng(SEED).choice([-1.0, 1.0], size=(n_patches, FLIPS))
    sign = np.column_stack([np.ones(n_patches), sign])
    means, weights = [], []
    for mine in (r.half, ~r.half):
        w = r.weight[mine]
        shape = (n_cells, n_patches)
        sums = csr_matrix((w * r.residual_K[mine], (cell[mine], r.patch[mine])), shape=shape) @ sign
        total = np.bincount(cell[mine], w, n_cells)
        means.append(sums / np.maximum(total, 1e-300)[:, None])
        weights.append(total)
    W = np.divide(weights[0] * weights[1], weights[0] + weights[1], out=np.zeros(n_cells), where=weights[0] > 0)
    if not W.sum() > 0:
        return Alike(0.0, 0.0)
    squares = W @ (means[0] * means[1]) / W.sum()
    chance = squares[1:]
    z = (squares[0] - chance.mean()) / max(chance.std(), 1e-300)
    return Alike(float(np.sign(squares[0]) * np.sqrt(abs(squares[0]))), float(z))


def statistics(r: Residuals, width_px: int, size_px: tuple[float, float] = (27.0, 80.0)) -> dict[str, Alike]:
    """Agreement of residuals by place in the image, by column, by row, and by place in blocks of views.

    width_px : of the image; size_px : of fine and coarse cells in an image 640 px wide.
    """
    u, v = r.rows.u_px, r.rows.v_px
    fine, coarse = (s * width_px / 640 for s in size_px)

    def place(side: float) -> NDArray:
        return (v // side).astype(np.int64) * 4096 + (u // side).astype(np.int64)

    return {
        "place": split_product(r, place(fine)),
        "column": split_product(r, np.rint(u).astype(np.int64)),
        "row": split_product(r, np.rint(v).astype(np.int64)),
        "place and time": split_product(r, place(coarse) * 4096 + r.rows.view // BLOCK_VIEWS),
    }
