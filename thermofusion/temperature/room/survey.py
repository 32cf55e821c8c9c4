"""The room as the walk saw it: radiance from each direction, from the background of all thermal views.

A block of background in the direction ω, read by view i at pixel (u, v), says

    L' = Y(ω)·a + c_cell + b_i + φ(u, v) + noise,

Y the nine spherical harmonics of order 0 to 2, c what a cell of 10° differs from them (a window, a radiator, a
picture on the wall), b_i and φ the camera's offset and field, known from the overlap of views up to a little. All of it
is linear with priors, solved at once; thousands of pixels of one cell are one witness. A cell far from the others keeps
what was read and does not bend the harmonics; directions that no view showed keep their continuation and their sigma.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_matrix

from ...geometry.sphere import COUNT, N_CELLS, cell_of, harmonics
from ...mapping.background import Background
from ...robust import MAD_PER_SIGMA, TUKEY, tukey_weight
from ...types import Float
from ..crosscal import Calibration
from .map import RoomMap, RoomPrior, unseen_covariance

LEAST_ROWS = 2000  # blocks of background, below which no room is looked at
LEAST_VIEWS = 4
LEAST_CELL_BLOCKS = 4  # of a view in one cell
TEXTURE_K = 0.3  # one sigma of a cell about the harmonics, to begin with
LEAST_TEXTURE_K = 0.05
OFFSET_SIGMA_K = 0.1  # of a view's offset as the overlap found it, while the room is taken to be even
FIELD_SIGMA_K = 0.05  # of each pattern of the field, likewise
FIELD_ORDER = 2  # of the corrections to the field
READING_K = 0.05  # least sigma of a view's mean over a cell: parallax, what stands on a wall
CAUCHY = 2.0  # textures beyond which a cell counts as something of its own
LEVEL_K = 0.02  # of the offsets' mean, beside the level's own sigma
UNSTATED_K = 100.0  # one sigma of the mean over all directions, before what is stated of it is heard
ROUNDS = 4


@dataclass(frozen=True, eq=False)
class _Rows:
    """Means over one view's blocks in one cell, R of them. weight : how many blocks; y : camera's known part off."""

    view: NDArray[np.intp]
    cell: NDArray[np.intp]
    y: Float
    design: Float  # (R, 9 + K): harmonics, then field patterns
    count: Float


def survey(background: Background, calibration: Calibration, prior: RoomPrior, netd_K: float) -> RoomMap:
    """The room from its background; the prior alone where too little of it was seen.

    calibration : of the views, solved with an even room.
    """
    if len(background) < LEAST_ROWS or len(np.unique(background.view)) < LEAST_VIEWS:
        return RoomMap.unseen(prior)
    rows = _rows(background, calibration)
    solved = _solve(rows, calibration, prior, netd_K)
    sigma = np.sqrt(solved.covariance[0, 0]) / prior.slope_L
    difference = float(solved.coefficients[0] - prior.L) / prior.slope_L
    solved = replace(solved, difference_K=difference, difference_sigma_K=float(np.hypot(sigma, prior.sigma_K)))
    return solved if solved.contradicts else solved.with_stated(prior)


def _rows(background: Background, calibration: Calibration) -> _Rows:
    cell = cell_of(background.direction)
    key, row = np.unique(background.view.astype(np.int64) * N_CELLS + cell, return_inverse=True)
    count = np.bincount(row).astype(float)
    u, v = background.u_px, background.v_px
    patterns = calibration.field.patterns(u, v)
    y = background.radiance - patterns @ calibration.field.coefficients
    if calibration.sensor is not None:
        y = y - calibration.sensor(u, v, background.view)
    low = calibration.field.orders <= FIELD_ORDER
    columns = np.column_stack([harmonics(background.direction.astype(np.float64)), patterns[:, low]])
    mean = np.stack([np.bincount(row, c) / count for c in columns.T], axis=1)
    keep = count >= LEAST_CELL_BLOCKS
    view, of_cell = np.divmod(key, N_CELLS)
    y = np.bincount(row, y) / count - calibration.offset_radiance[view]
    return _Rows(view[keep], of_cell[keep], y[keep], mean[keep], count[keep])


def _solve(rows: _Rows, calibration: Calibration, prior: RoomPrior, netd_K: float) -> RoomMap:
    """Least squares with priors, but for the stated temperature: p = [a, φ, common offset, offsets by view, cells]."""
    slope, n = prior.slope_L, rows.design.shape[1]
    views, view = np.unique(rows.view, return_inverse=True)
    cells, cell = np.unique(rows.cell, return_inverse=True)
    M, C, R = len(views), len(cells), len(rows.y)
    index = np.column_stack([np.tile(np.arange(n + 1), (R, 1)), n + 1 + view, n + 1 + M + cell])
    value = np.column_stack([rows.design, np.ones((R, 3))])
    A = csr_matrix((value.ravel(), index.ravel(), np.arange(0, R * (n + 3) + 1, n + 3)), shape=(R, n + 1 + M + C))
    level_K = calibration.level_sigma_K if calibration.anchored else 0.0
    known = np.concatenate([np.sqrt(prior.variances) / slope, np.full(n - COUNT, FIELD_SIGMA_K)])
    known = np.concatenate([known, [np.hypot(level_K, LEVEL_K)], np.full(M, OFFSET_SIGMA_K), np.full(C, TEXTURE_K)])
    known[0] = UNSTATED_K
    known *= slope
    y = rows.y - prior.L
    sigma = np.hypot(READING_K, netd_K / np.sqrt(LEAST_CELL_BLOCKS)) * slope
    robust, texture, own = np.ones(R), TEXTURE_K * slope, np.ones(C)
    for _ in range(ROUNDS):
        known[-C:] = texture / np.sqrt(own)
        w = robust / sigma**2
        N = (A.T @ A.multiply(w[:, None]).tocsr()).toarray() + np.diag(known**-2)
        factor = cho_factor(N)
        p = cho_solve(factor, A.T @ (w * y))
        r, c = y - A @ p, p[-C:]
        sigma = max(float(np.median(np.abs(r))) / MAD_PER_SIGMA, READING_K * slope / 4)
        robust = tukey_weight(np.abs(r) / (TUKEY * sigma))
        texture = max(float(np.median(np.abs(c))) / MAD_PER_SIGMA, LEAST_TEXTURE_K * slope)
        own = 1 / (1 + (c / (CAUCHY * texture)) ** 2)
    p[0] += prior.L
    seen, beyond = np.zeros(N_CELLS, bool), np.zeros(N_CELLS)
    seen[cells], beyond[cells] = True, c
    covariance = cho_solve(factor, np.eye(len(p), COUNT))[:COUNT] + unseen_covariance(seen, slope)
    return RoomMap(p[:COUNT], covariance, beyond, seen, slope)
