"""Light that a phantom's lens spreads widely over the picture, from what stands beyond the picture too.

y = L + Σ g (K∗L - L) with unit kernels K. The scene is rendered once more, coarse, over three times the picture's
width and height, and convolved there.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.signal import fftconvolve

from ..types import Camera, Float, Float32
from .scene import ScatterConfig

BLOCK_PX = 4  # pixels of a coarse sample
BEYOND = 1.0  # widths and heights that are rendered on each side of the picture


def wide_camera(camera: Camera) -> Camera:
    """A coarse camera without distortion that sees the picture and what is beyond it."""
    h, w = camera.shape
    left, top = (round(BEYOND * n / BLOCK_PX) for n in (w, h))
    K = camera.K.copy()
    K[:2] /= BLOCK_PX
    K[0, 2] = (camera.K[0, 2] + 0.5) / BLOCK_PX - 0.5 + left
    K[1, 2] = (camera.K[1, 2] + 0.5) / BLOCK_PX - 0.5 + top
    return Camera(w // BLOCK_PX + 2 * left, h // BLOCK_PX + 2 * top, K, np.zeros(5))


def kernel(config: ScatterConfig, image_width_px: int, reach: int) -> Float:
    """(2·reach + 1, 2·reach + 1) of sum 1 in coarse samples. ValueError for a shape that is not known."""
    width = config.width * image_width_px / BLOCK_PX
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    r = np.hypot(x, y) / width
    if config.kernel == "gaussian":
        k = np.exp(-0.5 * r**2)
    elif config.kernel == "exponential":
        k = np.exp(-r)
    elif config.kernel == "tail":
        k = (1 + r**2) ** -1.5
    elif config.kernel == "disc":
        k = (r < 1).astype(float)
    else:
        raise ValueError(config.kernel)
    return k / k.sum()


def scattered(image: Float32, wide: Float32, parts: tuple[ScatterConfig, ...], image_shape: tuple[int, int]) -> Float32:
    """A picture (S·H, S·W) as the lens spreads it; wide (h, w): as `wide_camera` sees it; image_shape (H, W)."""
    h, w = image_shape
    left, top = (round(BEYOND * n / BLOCK_PX) for n in (w, h))
    coarse = wide.astype(np.float64)
    inner = cv2.resize(image, (w // BLOCK_PX, h // BLOCK_PX), interpolation=cv2.INTER_AREA)
    coarse[top : top + h // BLOCK_PX, left : left + w // BLOCK_PX] = inner
    middle = float(np.median(coarse))
    halo = np.zeros_like(coarse)
    for part in parts:
        halo += part.share * (
            fftconvolve(coarse - middle, kernel(part, w, max(coarse.shape) // 2), mode="same") + middle
        )
    cut = halo[top : top + h // BLOCK_PX, left : left + w // BLOCK_PX].astype(np.float32)
    fine = cv2.resize(cut, image.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(image * np.float32(1 - sum(p.share for p in parts)) + fine, np.float32)
