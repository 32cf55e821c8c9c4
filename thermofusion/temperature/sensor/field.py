"""A low-order field over a thermal camera's image: vignetting, narcissus, warm housing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...types import Float, Int
from ..loops.field import patterns_at

FIELD_ORDER = 4  # polynomial order
GRID = 64  # points along each side over which patterns are orthonormal


@dataclass(frozen=True, eq=False)
class ImageField:
    """A low-order field φ(u, v) over the image: polynomials orthonormal over it, without a constant.

    coefficients : (K,) W m-2 sr-1, each the rms over the image of its pattern; the mean over the image is zero (a
    constant cannot be told from the views' offsets). exponents : (K+1, 2). mixing : (K+1, K) monomials -> patterns.
    """

    width_px: int
    height_px: int
    exponents: Int
    mixing: Float
    coefficients: Float

    @classmethod
    def zero(cls, width_px: int, height_px: int, order: int = FIELD_ORDER) -> ImageField:
        """The field of an ideal camera."""
        exponents = np.array([(i, n - i) for n in range(order + 1) for i in range(n + 1)], np.int32)
        v, u = (np.mgrid[0:GRID, 0:GRID].reshape(2, -1) + 0.5) / GRID * [[height_px], [width_px]] - 0.5
        grid = _monomials(u, v, width_px, height_px, exponents)
        r = np.linalg.qr(grid, mode="r")
        scale = np.sqrt(len(grid)) * np.sign(np.diag(r))
        mixing = np.linalg.solve(r, np.eye(len(r)))[:, 1:] * scale[1:]
        return cls(width_px, height_px, exponents, mixing, np.zeros(mixing.shape[1]))

    @property
    def orders(self) -> Int:
        """(K,) polynomial order of each pattern."""
        return np.asarray(self.exponents[1:].sum(axis=1), np.int32)

    def patterns(self, u_px: NDArray, v_px: NDArray) -> Float:
        """(N, K) the patterns at pixels u_px, v_px (N,)."""
        u, v = np.asarray(u_px, np.float64), np.asarray(v_px, np.float64)
        x, y = _normalised(u, v, self.width_px, self.height_px)
        highest = int(self.exponents.max(initial=0))
        return np.asarray(patterns_at(x, y, self.exponents, np.ascontiguousarray(self.mixing), highest))

    def __call__(self, u_px: NDArray, v_px: NDArray) -> NDArray:
        """φ at pixels (N,), W m-2 sr-1, in the pixels' float type."""
        x, y = _normalised(u_px, v_px, self.width_px, self.height_px)
        order = int(self.exponents.max(initial=0))
        table = np.zeros((order + 1, order + 1))
        table[self.exponents[:, 0], self.exponents[:, 1]] = self.mixing @ self.coefficients
        out = np.zeros_like(x)
        for i in range(order, -1, -1):  # Horner in x of Horner in y
            inner = np.full_like(y, table[i, order - i])
            for j in range(order - i - 1, -1, -1):
                inner *= y
                inner += y.dtype.type(table[i, j])
            out *= x
            out += inner
        return out


def _normalised(u_px: NDArray, v_px: NDArray, width_px: int, height_px: int) -> tuple[NDArray, NDArray]:
    """Image coordinates about the middle, the half width = 1 on both axes."""
    scale = 2.0 / width_px
    return (u_px - (width_px - 1) / 2) * scale, (v_px - (height_px - 1) / 2) * scale


def _monomials(u_px: NDArray, v_px: NDArray, width_px: int, height_px: int, exponents: Int) -> Float:
    """(N, K+1) products of powers of the normalised coordinates."""
    u, v = np.asarray(u_px, np.float64), np.asarray(v_px, np.float64)
    x, y = _normalised(u, v, width_px, height_px)
    powers_x, powers_y = [np.ones_like(x)], [np.ones_like(y)]
    for _ in range(int(exponents.max(initial=0))):
        powers_x.append(powers_x[-1] * x)
        powers_y.append(powers_y[-1] * y)
    out = np.empty((len(x), len(exponents)))
    for k, (i, j) in enumerate(exponents):
        np.multiply(powers_x[i], powers_y[j], out=out[:, k])
    return out
