"""Recordings of phones with a depth sensor: depth of the phone's own map, poses of its own tracking."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....files.reading import read_image
from ....types import Camera, Float, Float32
from ..images import DepthLayout


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


def trusted_image(file: Path, confidences: Path, camera: Camera, layout: DepthLayout) -> Float32:
    """A depth image (H, W) m, NaN = none, less what the image of the same name in `confidences` does not trust."""
    raw = read_image(file, shape=camera.shape, kind="depth")
    sure = confidences / file.name
    confidence = read_image(sure, kind="confidence") if sure.is_file() else None
    return layout.metres(trusted(raw, confidence), file)
