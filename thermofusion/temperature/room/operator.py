"""Who holds the camera is warm, stands where the camera is, and is reflected by the skin in front of it.

A body of area A at the camera's place, at distance r, fills A cosθ/(π r²) of the hemisphere that a spot reflects:

    excess = (1 - ε(θ)) · A cosθ/(π r²) · (L(29 °C) - L_room)

It moves with the camera and falls with cosθ, much as an error of the shape of ε(θ) does: from the scan alone it cannot
be told. Off by default; what it may do stands in sigma.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...physics.band import ZERO_DEGC_K, Band
from ...physics.emissivity import AngleTable, EmissivityModel
from ...types import Bool, Float32, Observations

CLOTHES_DEGC = 29.0  # of a clothed person's outside
LEAST_RANGE_M = 0.3  # nearer a camera is held before the body, not the body before the skin


def operator_excess(rows: Observations, emissivity: EmissivityModel, band: Band, room_K: float) -> Float32:
    """(N,) what a square metre of operator adds to each reading, W m-2 sr-1 m-2."""
    warmer = float(band.radiance(CLOTHES_DEGC + ZERO_DEGC_K) - band.radiance(room_K))
    reflected = np.float32(warmer / np.pi) * (1 - AngleTable.of(emissivity)(rows.cos_angle))
    return np.asarray(reflected * rows.cos_angle / np.maximum(rows.range_m, np.float32(LEAST_RANGE_M)) ** 2)


def without_operator(rows: Observations, excess: NDArray, area_m2: float) -> Observations:
    """Observations (N,) without what an operator of area_m2 adds to them; excess : (N,) of a square metre."""
    if not area_m2:
        return rows
    return replace(rows, radiance=np.asarray(rows.radiance - np.float32(area_m2) * excess, np.float32))


def operator_effect(rows: Observations, excess: NDArray, used: Bool, n_vertices: int) -> Float32:
    """(V,) the mean of an excess (N,), W m-2 sr-1 m-2, over a vertex's used rows, a mask (N,); 0 where it has none."""
    count = np.bincount(rows.vertex[used], minlength=n_vertices)
    total = np.bincount(rows.vertex[used], excess[used], n_vertices)
    return np.asarray(total / np.maximum(count, 1), np.float32)
