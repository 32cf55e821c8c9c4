"""How the room's harmonics light a diffuse surface that nothing shades."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...geometry.sphere import ORDERS, harmonics
from ...types import Float

# What is left of each order in the cosine-weighted mean over a free hemisphere: 1, 2/3, 1/4.
LAMBERT = np.array([(1.0, 2 / 3, 1 / 4)[order] for order in ORDERS])


def open_transfer(normals: NDArray) -> Float:
    """(V, 9) of unit normals (V, 3): the cosine-weighted mean of each harmonic over the whole hemisphere above."""
    return np.asarray(harmonics(normals.astype(np.float64)) * LAMBERT)
