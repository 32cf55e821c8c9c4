"""Recordings of phones with a depth sensor: depth of the phone's own map, poses of its own tracking."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....types import Float


def from_opengl(T: NDArray) -> Float:
    """Poses T_world_camera (N, 4, 4) m of ARKit's camera axes (y up, looking along -z) as poses of ours."""
    out = np.array(T, np.float64)
    out[..., :3, 1:3] *= -1
    return out


def trusted(depth: NDArray, confidence: NDArray | None) -> NDArray:
    """Depth (H, W) without what the phone does not trust; confidence : (H, W), 0 = not at all; None = unknown."""
    if confidence is None or confidence.shape != depth.shape:
        return depth
    return np.where(confidence > 0, depth, depth.dtype.type(0))
