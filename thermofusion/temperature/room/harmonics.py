"""Spherical harmonics of order 0 to 2: what a diffuse surface can tell of the room that lights it.

The irradiance of a convex diffuse surface lies in these nine numbers to 99 % (Ramamoorthi and Hanrahan, SIGGRAPH 2001).
Scaled so that each has a mean square of 1 over the sphere: the first is 1, and a coefficient has the room's unit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...types import Float

ORDERS = (0, 1, 1, 1, 2, 2, 2, 2, 2)
COUNT = len(ORDERS)
DIPOLE = 3**-0.5  # coefficient of order 1 of a room that is 1 warmer on one side, 1 colder on the other
# What is left of each order in the cosine-weighted mean over a free hemisphere: 1, 2/3, 1/4.
LAMBERT = np.array([(1.0, 2 / 3, 1 / 4)[order] for order in ORDERS])


def harmonics(direction: NDArray) -> NDArray:
    """(..., 9) of unit directions (..., 3), in their float type."""
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    a, b = direction.dtype.type(3**0.5), direction.dtype.type(15**0.5)
    c = direction.dtype.type(0.5 * 5**0.5)
    columns = [np.ones_like(x), a * x, a * y, a * z, b * x * y, b * y * z, b * x * z]
    return np.stack([*columns, b / 2 * (x * x - y * y), c * (3 * z * z - 1)], axis=-1)


def open_transfer(normals: NDArray) -> Float:
    """(V, 9) of unit normals (V, 3): the cosine-weighted mean of each harmonic over the whole hemisphere above."""
    return np.asarray(harmonics(normals.astype(np.float64)) * LAMBERT)
