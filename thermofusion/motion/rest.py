"""Did anything move at all? Asked of a rigid fusion, before anything is solved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import Float, Int, SurfaceMesh
from .field import BoundPoints, MotionField
from .graph import Binding, cells
from .rows import CORRELATED, CoarseFrames, Sums, gather

BLOCK_M = 0.15  # pieces of the body, here by place alone
REACH_M, KERNEL_M = 0.03, 0.01
PRIOR_M = 0.005  # of a piece's shift
SEEN_SIGMA_M = 1e-3  # a piece whose shift is known no better does not count
MAX_LOOKS = 300  # frames that are looked at


def unrest(frames: CoarseFrames, mesh: SurfaceMesh, pick: Int, knots: Float, noise_m_at_1m: float) -> float:
    """How much better, in chi-squared, the frames are explained if every piece may shift from knot to knot.

    Mean over the pieces and knots that are seen; about 0.2 for a subject at rest. What all frames say in common (shape)
    and what a knot's frames say of the whole body (the camera) is taken out first. pick : (P,) vertices to look at.
    """
    points = BoundPoints(mesh.vertices_m[pick], mesh.normals[pick], _unbound(len(pick)))
    field = MotionField.at_rest(np.zeros((1, 3)), knots)
    every = max(1, round(len(frames) / MAX_LOOKS))
    sums, _ = gather(frames, range(0, len(frames), every), points, field, REACH_M, noise_m_at_1m, KERNEL_M)
    block = np.unique(cells(points.at_m, BLOCK_M), return_inverse=True)[1]
    return _explained(sums, points, block)


def _unbound(count: int) -> Binding:
    """Points that hang on one node alone."""
    weight = np.array([[1, 0, 0, 0]], np.float32)
    return Binding(np.zeros((1, 4), np.int32), weight, np.zeros(count, np.int32))


def _explained(sums: Sums, points: BoundPoints, block: NDArray) -> float:
    n, x = points.normal.astype(np.float64), points.at_m.astype(np.float64)
    J = np.concatenate([np.cross(x - x.mean(0), n), n], axis=1)
    nn = n[:, :, None] * n[:, None, :]
    gain, seen = 0.0, 0
    count = int(block.max()) + 1
    for weight, pull in zip(sums.own, sums.pull, strict=True):
        pull = pull - weight * sums.residual
        H = J.T @ (weight[:, None] * J)
        H[np.diag_indices(6)] += 1e-6 * np.trace(H) + 1e-9
        pull = pull - weight * (J @ np.linalg.solve(H, J.T @ pull))
        g = np.stack([np.bincount(block, pull * n[:, k], count) for k in range(3)], axis=1) / CORRELATED
        h = np.stack([np.bincount(block, weight * q, count) for q in nn.reshape(-1, 9).T], axis=1) / CORRELATED
        h = h.reshape(-1, 3, 3)
        known = np.trace(h, axis1=1, axis2=2) > SEEN_SIGMA_M**-2
        shift = np.linalg.solve(h[known] + np.eye(3) / PRIOR_M**2, g[known, :, None])[:, :, 0]
        gain, seen = gain + float((g[known] * shift).sum()), seen + int(known.sum())
    return gain / max(seen, 1)
