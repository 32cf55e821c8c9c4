"""What the skin itself says of the room's two sides.

A room that is warmer on one side lights the skin that is turned there more. Straight on hardly any of it is
reflected, obliquely much: two views of one spot at different angles differ by (1 - E(θ))·t·a, t the spot's transfer
coefficients of order 1. It needs no background, and is independent of it; normals and the shape of ε(θ) leave it an
error of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ...geometry.sphere import DIPOLE, ORDERS
from ...types import Float
from ..crosscal import Overlap

SIDES = np.array(ORDERS) == 1
WIDE_K = 10.0  # one sigma of a dipole before the skin is asked
MODEL_K, MODEL_SHARE = 0.5, 0.15  # one sigma of a dipole, of what normals and ε(θ) make of it, and of its own size
FOLDS = 6  # blocks of views that are left out in turn
SAMPLE = 2500  # vertices that are asked: neighbours err alike
STEPS = 20  # of reweighting


@dataclass(frozen=True, eq=False)
class _Sides:
    """Three more columns of the overlap: the coefficients of order 1."""

    columns_at: csr_matrix
    sigma: float

    def precision(self) -> Float:
        """(3, 3) prior inverse covariance, K-2."""
        return np.eye(3) / self.sigma**2

    def columns(self, u_px: NDArray, v_px: NDArray, view: NDArray) -> csr_matrix:
        """Nothing of it is read by references, (N, 3)."""
        return csr_matrix((len(u_px), 3))


def sides_of(overlap: Overlap) -> tuple[Float, Float]:
    """What is missing of the coefficients of order 1, (3,) W m-2 sr-1, in the light that the overlap was solved with,
    and its covariance (3, 3): from views left out in blocks, and of the model."""
    problem = overlap.problem
    system, start, chosen = overlap.system.sample(overlap.solution, SAMPLE)
    rows = overlap.rows.select(chosen)
    assert problem.transfer is not None
    lost = (1 - system.E)[:, None] * problem.transfer[rows.vertex][:, SIDES]
    sides = _Sides(csr_matrix(lost), WIDE_K * DIPOLE)
    asked = replace(system, sensor=sides, sensor_columns=sides.columns_at, readings=(), contacts=())
    solution = asked.solve(start, STEPS)
    at = asked.layout.sensor
    views = np.unique(system.group)
    block = np.searchsorted(views, system.group) * FOLDS // len(views)
    parts = []
    for fold in range(FOLDS):
        kept = block != fold
        parts.append(asked.part(kept).step(solution.p, solution.x, solution.weight[kept])[0][at])
    off = np.array(parts) - np.mean(parts, axis=0)
    jackknife = (FOLDS - 1) / FOLDS * off.T @ off
    own = solution.covariance[at, at]
    model = (MODEL_K * DIPOLE * system.slope_L) ** 2 + (MODEL_SHARE * np.linalg.norm(solution.p[at])) ** 2
    return solution.p[at], jackknife + own + model * np.eye(3)
