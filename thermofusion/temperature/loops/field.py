"""Patterns of the field over the image at many pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled import compiled
from ...types import Float, Int


@compiled
def patterns_at(x: NDArray, y: NDArray, exponents: Int, mixing: Float, highest: int) -> Float:  # pragma: no cover
    """(N, K) combinations `mixing` (M, K) of the monomials xⁱyʲ, exponents (M, 2) up to `highest`, at x, y (N,)."""
    out = np.zeros((x.shape[0], mixing.shape[1]))
    of_x, of_y = np.ones(highest + 1), np.ones(highest + 1)
    for n in range(x.shape[0]):
        for i in range(highest):
            of_x[i + 1] = of_x[i] * x[n]
            of_y[i + 1] = of_y[i] * y[n]
        row = out[n]
        for m in range(exponents.shape[0]):
            monomial = of_x[exponents[m, 0]] * of_y[exponents[m, 1]]
            for k in range(mixing.shape[1]):
                row[k] += monomial * mixing[m, k]
    return out
