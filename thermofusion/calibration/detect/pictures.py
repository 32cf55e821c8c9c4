"""Pictures of what was found: every accepted and rejected board point."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...types import Float

GREEN, RED = (0, 200, 0), (230, 40, 40)


def to_grey(image: NDArray) -> NDArray[np.uint8]:
    """Any picture (H, W) or (H, W, 3) to 8-bit grey (H, W), 1st to 99th percentile; NaN black."""
    x = np.asarray(image, np.float32)
    if x.ndim == 3:
        x = x.mean(axis=2)
    lo, hi = np.nanpercentile(x, [1, 99]) if np.isfinite(x).any() else (0.0, 1.0)
    return np.nan_to_num(np.clip((x - lo) * (255 / max(hi - lo, 1e-6)), 0, 255)).astype(np.uint8)


def draw_points(
    image: NDArray, accepted_px: Float, rejected_px: Float | None = None, *, size: int = 6
) -> NDArray[np.uint8]:
    """`image` (H, W) as RGB (H, W, 3): `accepted_px` (N, 2) as green rings, `rejected_px` (M, 2) as red crosses; small
    pictures are doubled."""
    factor = 2 if image.shape[1] <= 800 else 1
    grey = to_grey(image).repeat(factor, axis=0).repeat(factor, axis=1)
    out = np.repeat(grey[..., None], 3, axis=2)

    def at(p: Float) -> tuple[int, int]:
        q = (p + 0.5) * factor - 0.5
        return round(float(q[0])), round(float(q[1]))

    for p in np.asarray(accepted_px).reshape(-1, 2):
        cv2.circle(out, at(p), size, GREEN, 1, cv2.LINE_AA)
    for p in np.asarray(rejected_px if rejected_px is not None else np.zeros((0, 2))).reshape(-1, 2):
        if np.isfinite(p).all():
            cv2.drawMarker(out, at(p), RED, cv2.MARKER_TILTED_CROSS, size, 1, cv2.LINE_AA)
    return out
