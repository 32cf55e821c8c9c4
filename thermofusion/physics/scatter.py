"""Light that a lens spreads widely over the image (size of source): y = (1 - g) L + Σ g_k K_k∗L, Gaussians K_k.

Germanium lenses of uncooled cameras spread 1 to 3 % over tens of pixels: small warm parts read too cold, and their
surroundings too warm. To first order in g the spread of the picture itself is taken off: L = y - Σ g_k (K_k∗y - y).
What stands beyond the picture is not known: its border is taken to go on.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import nnls

from ..types import Float32, LensScatter

WIDTHS = (0.02, 0.035, 0.06, 0.1, 0.17)  # one sigma of the Gaussians that an unknown kernel is made of, image widths
COARSE_ACROSS = 80  # pixels of the reduced picture that is blurred: 8 px of 640


def on_widths(scatter: LensScatter) -> NDArray[np.float64]:
    """(K,) shares on `WIDTHS` with the same light and second moment; beyond their ends the nearest takes all."""
    squares = np.square(WIDTHS)
    out = np.zeros(len(WIDTHS))
    for share, width in scatter.parts:
        at = np.interp(width**2, squares, np.arange(len(WIDTHS)))
        low = int(np.floor(at))
        out[low] += share * (1 - (at - low))
        out[min(low + 1, len(WIDTHS) - 1)] += share * (at - low)
    return out


@dataclass(frozen=True, eq=False)
class HaloNormal:
    """Normal equations of some readings of background beside something warm: N (P, P), rhs (P,); the shares of
    `WIDTHS` first, then whatever else is not known."""

    N: NDArray[np.float64]
    rhs: NDArray[np.float64]

    def less(self, other: HaloNormal) -> HaloNormal:
        """Without some of the readings."""
        return HaloNormal(self.N - other.N, self.rhs - other.rhs)

    def shares(self, prior: NDArray, shapes: NDArray) -> NDArray[np.float64]:
        """(S,) g >= 0 of shapes (K, S) on `WIDTHS` that cost least, all else eliminated; prior (P,): inverse
        variances."""
        K = len(WIDTHS)
        N = self.N + np.diag(prior)
        inverse = cho_factor(N[K:, K:])
        S = shapes.T @ (N[:K, :K] - N[:K, K:] @ cho_solve(inverse, N[K:, :K])) @ shapes
        q = shapes.T @ (self.rhs[:K] - N[:K, K:] @ cho_solve(inverse, self.rhs[K:]))
        root = np.linalg.cholesky(S)
        return np.asarray(nnls(root.T, np.linalg.solve(root, q))[0])


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
