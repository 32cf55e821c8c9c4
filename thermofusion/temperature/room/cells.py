"""Directions in cells of some 10°: the grain in which a room is looked at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...types import Float, Int

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
