"""Views that were passed over: near an outline, or something may stand before it. Do they contradict the map?"""

from __future__ import annotations

import numpy as np

from ..types import Bool, Float32, Int, Observations
from .blend import BlendResult, around
from .crosscal import Calibration
from .problem import ThermalProblem
from .uncertainty import AngleTables

NEIGHBOURS_M = 0.01  # about a spot: what one view alone saw is as doubtful as what is seen right beside it
MOST = 0.5  # share of the spots around at which views contradict each other


def doubtful_with_neighbours(apart: Bool, count: Int, points_m: Float32) -> Bool:
    """(V,) True where one view alone saw a vertex amid others at which views are apart (V,). count : (V,) views."""
    if not apart.any():
        return np.zeros(len(apart), bool)
    return (count == 1) & (np.nan_to_num(around(np.where(count > 1, apart, np.nan), points_m, NEIGHBOURS_M)) > MOST)


def contradicted(
    problem: ThermalProblem, rows: Observations, calibration: Calibration, result: BlendResult, limit_K: float
) -> Bool:
    """(V,) True where a view that was passed over reads more than limit_K off what the map says it should.

    rows : all observations of the mapping; those that the map is made of are left alone here.
    """
    mapping = problem.mapping
    mine = (rows.edge_px < np.float32(mapping.silhouette_px)) & np.isfinite(rows.radiance)
    mine &= rows.cos_angle >= np.float32(np.cos(np.radians(mapping.max_angle_deg)))
    rows = rows.select(mine)
    E = AngleTables.of(calibration.emissivity(problem.emissivity)).relative(rows.cos_angle)
    L_r = problem.L_reflected[rows.vertex]
    x = problem.band.radiance(result.normal_equivalent_K)[rows.vertex] - L_r
    off_K = np.abs(calibration.corrected(rows) - L_r - E * x) / calibration.slope_L
    out = np.zeros(len(problem), bool)
    out[rows.vertex[np.nan_to_num(off_K) > limit_K]] = True
    return out
