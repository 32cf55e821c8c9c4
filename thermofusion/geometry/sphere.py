"""Directions: the sphere in cells of some 10°, and spherical harmonics of order 0 to 2 on it.

The harmonics are scaled so that each has a mean square of 1 over the sphere: the first is 1, and a coefficient has the
unit of what is described. The irradiance of a convex diffuse surface lies in these nine numbers to 99 % (Ramamoorthi
and Hanrahan, SIGGRAPH 2001).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import Float, Int

ORDERS = (0, 1, 1, 1, 2, 2, 2, 2, 2)
COUNT = len(ORDERS)
DIPOLE = 3**-0.5  # coefficient of order 1 of a room that is 1 warmer on one side, 1 colder on the other
CELL_DEG = 10.0
_RINGS = round(180 / CELL_DEG)
_LATITUDES = np.radians(-90 + CELL_DEG * (np.arange(_RINGS) + 0.5))
_AROUND = np.maximum(np.rint(360 / CELL_DEG * np.cos(_LATITUDES)), 3).astype(np.int64)
_FIRST = np.insert(np.cumsum(_AROUND), 0, 0)
N_CELLS = int(_FIRST[-1])


def cell_of(direction: NDArray) -> Int:
    """Number 0 ... N_CELLS - 1 of the cell that each unit direction (N, 3) lies in; poles are those of z."""
    latitude = np.degrees(np.arcsin(np.clip(direction[..., 2], -1, 1)))
    ring = np.clip(((latitude + 90) / CELL_DEG).astype(np.int64), 0, _RINGS - 1)
    turn = np.arctan2(direction[..., 1], direction[..., 0]) / (2 * np.pi) % 1.0
    around = np.minimum((turn * _AROUND[ring]).astype(np.int64), _AROUND[ring] - 1)
    return (_FIRST[ring] + around).astype(np.int32)


def cell_directions() -> Float:
    """(N_CELLS, 3) unit, the middles of the cells."""
    ring = np.repeat(np.arange(_RINGS), _AROUND)
    angle = 2 * np.pi * (np.arange(N_CELLS) - _FIRST[ring] + 0.5) / _AROUND[ring]
    flat = np.cos(_LATITUDES[ring])
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), np.sin(_LATITUDES[ring])], axis=1)


def cell_solid_angles() -> Float:
    """(N_CELLS,) sr; they add up to 4π."""
    edges = np.radians(-90 + CELL_DEG * np.arange(_RINGS + 1))
    ring = 2 * np.pi * np.diff(np.sin(edges)) / _AROUND
    return np.repeat(ring, _AROUND)


def harmonics(direction: NDArray) -> NDArray:
    """(..., 9) of unit directions (..., 3), in their float type."""
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    a, b = direction.dtype.type(3**0.5), direction.dtype.type(15**0.5)
    c = direction.dtype.type(0.5 * 5**0.5)
    columns = [np.ones_like(x), a * x, a * y, a * z, b * x * y, b * y * z, b * x * z]
    return np.stack([*columns, b / 2 * (x * x - y * y), c * (3 * z * z - 1)], axis=-1)
