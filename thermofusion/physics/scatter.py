"""Light that a lens spreads widely over the image (size of source): y = (1 - g) L + Σ g_k K_k∗L, Gaussians K_k.

Germanium lenses of uncooled cameras spread 1 to 3 % over tens of pixels: small warm parts read too cold, and their
surroundings too warm. To first order in g the spread of the picture itself is taken off: L = y - Σ g_k (K_k∗y - y).
What stands beyond the picture is not known: its border is taken to go on.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Float32, LensScatter

COARSE_ACROSS = 80  # pixels of the reduced picture that is blurred: 8 px of 640


def reduced(radiance: Float32) -> Float32:
    """A picture (H, W) in means over blocks, about `COARSE_ACROSS` wide; NaN = its median."""
    size = max(1, round(radiance.shape[1] / COARSE_ACROSS))
    known = np.isfinite(radiance)
    if not known.all():
        middle = np.nanmedian(radiance) if known.any() else 0.0
        radiance = np.where(known, radiance, np.float32(middle))
    shape = max(radiance.shape[1] // size, 1), max(radiance.shape[0] // size, 1)
    return np.asarray(cv2.resize(radiance, shape, interpolation=cv2.INTER_AREA), np.float32)


def blurred(image: Float32, sigma_px: float) -> Float32:
    """An image (H, W) under a Gaussian of one sigma sigma_px; beyond its border the border goes on."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), np.float32)


def halo(coarse: Float32, scatter: LensScatter) -> Float32:
    """Σ g_k K_k∗y of a reduced picture (h, w), W m-2 sr-1."""
    out = np.zeros_like(coarse)
    for share, width in scatter.parts:
        out += np.float32(share) * blurred(coarse, width * coarse.shape[1])
    return out


def spread(radiance: Float32, scatter: LensScatter) -> Float32:
    """Σ g_k (K_k∗y - y), (H, W) W m-2 sr-1: what the lens added to a picture, and took away; NaN where it is NaN."""
    coarse = halo(reduced(radiance), scatter)
    fine = cv2.resize(coarse, radiance.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine - np.float32(scatter.share) * radiance, np.float32)


def without_scatter(radiance: NDArray, scatter: LensScatter | None) -> Float32:
    """A picture (H, W) W m-2 sr-1 as it would be if the lens spread nothing."""
    if scatter is None or not scatter.share:
        return np.asarray(radiance, np.float32)
    return np.asarray(radiance - spread(radiance, scatter), np.float32)
