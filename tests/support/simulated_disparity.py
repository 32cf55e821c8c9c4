"""A Kinect that reports raw disparity: 11 bits, whole counts, bent as Herrera's model says, blind at depth's edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from support.simulated_rig import SimulatedRig, plane_depth

from thermofusion.calibration.fit.depth_model import DisparityDepth
from thermofusion.types import Float

NONE = 2047  # what a Kinect v1 reports where it sees nothing
SHADOW_PX = 9  # left of an edge the camera sees what the projector does not light


def true_parameters(model: DisparityDepth, seed: int, *, bending: float = 1.0) -> Float:
    """c0, c1, decay and field of one camera out of many; bending : one sigma of the field's control values, counts."""
    rng = np.random.default_rng(seed)
    lens = [rng.normal(model.c0, 0.05), rng.normal(model.c1, 3e-5), rng.normal(model.decay, 3e-4)]
    return np.concatenate([lens, rng.normal(0, bending, len(model.names) - 3)])


def disparity_image(
    rig: SimulatedRig, T_depth_board: Float, model: DisparityDepth, theta: Float, seed: int, *, noise: float = 0.4
) -> NDArray[np.uint16]:
    """(H, W) disparity of the board before a wall; noise : counts, before rounding to whole ones."""
    z = plane_depth(rig, T_depth_board, 0.0, seed).astype(np.float64)
    v, u = np.mgrid[0 : z.shape[0], 0 : z.shape[1]]
    d = model.to_disparity(theta, z.ravel(), u.ravel(), v.ravel()).reshape(z.shape)
    d = np.round(d + np.random.default_rng(seed).normal(0, noise, z.shape))
    nearer = np.zeros(z.shape, bool)
    for k in range(1, SHADOW_PX):
        nearer[:, :-k] |= z[:, k:] < z[:, :-k] - 0.3
    return np.where(nearer | (d < 0) | (d >= NONE), NONE, d).astype(np.uint16)
