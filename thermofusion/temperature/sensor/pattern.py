"""What single pixels, columns and small places of the sensor add to a picture: fixed, or growing since each shutter.

The field of `field.py` is smooth and stands still. Real sensors leave more: columns and rows whose electronics differ,
spots of dust and of the shutter's own warmth, and a pattern that drifts from each shutter correction to the next. Each
is a linear term with a prior of one amplitude; `refine` says whether left-out views ask for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix, hstack

from ...types import Float

FIXED_SPACING = (80 / 640, 27 / 640)  # image widths between the knots of fixed patterns: blotches, and dust
DRIFT_SPACING = 85 / 640  # image widths between the knots of a drift: wider ones lose a tenth of it
DRIFT_LENGTH = 0.2  # image widths over which a drift is alike
BORDER_GROWTH = 1.5  # a drift's amplitude at the picture's corner over that in its middle, less one third of it
BEND = 0.5  # amplitude of the bend √τ - τ over that of the straight rise τ
JITTER = 1e-4  # of the variance, on a kernel's diagonal: keeps it invertible


@dataclass(frozen=True, eq=False)
class Hats:
    """Bilinear hat functions on a grid of knots over an image, `spacing` image widths apart."""

    width_px: int
    height_px: int
    spacing: float

    @property
    def shape(self) -> tuple[int, int]:
        """Knots down and across."""
        step = self.spacing * self.width_px
        return int(np.ceil(self.height_px / step)) + 1, int(np.ceil(self.width_px / step)) + 1

    @property
    def knots(self) -> Float:
        """(K, 2) u, v of the knots in image widths about the middle."""
        down, across = self.shape
        v, u = np.mgrid[0:down, 0:across].reshape(2, -1) * self.spacing
        return np.column_stack([u - 0.5, v - 0.5 * self.height_px / self.width_px])

    def columns(self, u_px: NDArray, v_px: NDArray) -> csr_matrix:
        """(N, K) the hats at pixels u_px, v_px (N,), dimensionless."""
        down, across = self.shape
        step = self.spacing * self.width_px
        u, v = np.clip(u_px / step, 0, across - 1.001), np.clip(v_px / step, 0, down - 1.001)
        i, j = v.astype(np.int64), u.astype(np.int64)
        fv, fu = v - i, u - j
        first = i * across + j
        index = np.stack([first, first + 1, first + across, first + across + 1], axis=1)
        value = np.stack([(1 - fv) * (1 - fu), (1 - fv) * fu, fv * (1 - fu), fv * fu], axis=1)
        return _rows(index, value, down * across)


def _rows(index: NDArray, value: NDArray, n: int) -> csr_matrix:
    """Sparse (N, n) with `value` (N, k) at columns `index` (N, k)."""
    N, k = index.shape
    return csr_matrix((value.ravel(), index.ravel(), np.arange(0, N * k + 1, k)), shape=(N, n))


def _lines(at_px: NDArray, n: int) -> csr_matrix:
    """(N, n) shares of the two lines of pixels that a bilinear sample at at_px (N,) px is made of."""
    at = np.clip(at_px, 0, n - 1.001)
    first = at.astype(np.int64)
    share = at - first
    return _rows(np.stack([first, first + 1], axis=1), np.stack([1 - share, share], axis=1), n)


@dataclass(frozen=True, eq=False)
class Pattern:
    """Terms that a sensor adds beyond its smooth field, as columns of a linear system.

    drift_K, place_K, column_K, row_K : prior rms of each; 0 = absent. The last three stand still.
    stretch : (M,) number of each view's stretch between shutters. since : (M,) 0 ... 1, time since the shutter over
    the longest stretch; or -1 ... 1, by how much the sensor has warmed since. coefficients : (Q,) W m-2 sr-1,
    drift first.
    """

    width_px: int
    height_px: int
    drift_K: float
    place_K: float
    column_K: float
    row_K: float
    stretch: NDArray[np.intp]
    since: Float
    coefficients: Float

    @property
    def is_bare(self) -> bool:
        """Nothing is added."""
        return not (self.drift_K or self.place_K or self.column_K or self.row_K)

    def grown(self, changes: dict[str, Any]) -> Pattern:
        """With parts of other amplitudes, K, by field name, or another `since`."""
        return Pattern(**{**vars(self), **changes})

    @property
    def _drift_hats(self) -> Hats:
        return Hats(self.width_px, self.height_px, DRIFT_SPACING)

    @property
    def _fixed_hats(self) -> list[Hats]:
        return [Hats(self.width_px, self.height_px, spacing) for spacing in FIXED_SPACING]

    def columns(self, u_px: NDArray, v_px: NDArray, view: NDArray) -> csr_matrix:
        """(N, Q) derivatives of what is read at pixels u_px, v_px (N,) of views (N,) by the coefficients."""
        parts = []
        if self.drift_K:
            hats, tau, stretch = self._drift_hats.columns(u_px, v_px), self.since[view], self.stretch[view]
            K, n = hats.shape[1], int(self.stretch.max()) + 1
            for rise in (tau, np.sign(tau) * np.sqrt(np.abs(tau)) - tau):
                index = hats.indices.reshape(-1, 4) + K * stretch[:, None]
                parts.append(_rows(index, hats.data.reshape(-1, 4) * rise[:, None], K * n))
        if self.place_K:
            parts += [hats.columns(u_px, v_px) for hats in self._fixed_hats]
        if self.column_K:
            parts.append(_lines(u_px, self.width_px))
        if self.row_K:
            parts.append(_lines(v_px, self.height_px))
        return csr_matrix(hstack(parts))

    def precision(self) -> Float:
        """(Q, Q) prior inverse covariance of the coefficients, K-2."""
        blocks: list[Float] = []
        if self.drift_K:
            one = np.linalg.inv(_smooth_covariance(self._drift_hats.knots)) / self.drift_K**2
            n = int(self.stretch.max()) + 1
            blocks += [np.asarray(one)] * n + [np.asarray(one / BEND**2)] * n
        n_hats = sum(int(np.prod(h.shape)) for h in self._fixed_hats)
        for size_K, n in ((self.place_K, n_hats), (self.column_K, self.width_px), (self.row_K, self.height_px)):
            if size_K:
                blocks.append(np.eye(n) / size_K**2)
        return np.asarray(block_diag(*blocks))

    def __call__(self, u_px: NDArray, v_px: NDArray, view: NDArray) -> Float:
        """What is added at pixels u_px, v_px (N,) of views (N,), W m-2 sr-1."""
        return np.asarray(self.columns(u_px, v_px, view) @ self.coefficients)


def _smooth_covariance(knots: Float) -> Float:
    """Of a smooth pattern at knots (K, 2) [image widths], growing towards the border; 1 in the mean over them."""
    distance2 = ((knots[:, None] - knots[None]) ** 2).sum(-1)
    radius2 = (knots**2).sum(1)
    size = 1 / 3 + BORDER_GROWTH * radius2 / radius2.max()
    size /= np.sqrt((size**2).mean())
    kernel = np.exp(-0.5 * distance2 / DRIFT_LENGTH**2) + JITTER * np.eye(len(knots))
    return np.asarray(kernel * np.outer(size, size))
