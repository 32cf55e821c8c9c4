"""What an operator does to the result once the views were calibrated with the operator in their readings.

Warmth that moves with the camera falls with cosθ, as an error of the shape of ε(θ) does: shape, offsets and field take
part of it, and hand on what they took to places that were seen otherwise. The solution is linear in the readings as
long as the weights stay: one step with the operator's excess added says how it answers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...physics.emissivity import AngleTable, reshaped, shape_direction
from ...types import Float, Float32, Observations
from ..blend import BlendResult
from ..crosscal import Overlap
from ..uncertainty import AngleTables
from .operator import operator_excess

SHAPE_STEP = 0.01  # of s, for the slope of ε(0) that follows it


def operator_answered(overlap: Overlap, blended: BlendResult) -> Float32:
    """(V,) what one sigma of an operator adds to the excess x of each vertex, W m-2 sr-1; 0 where nothing straight saw.

    blended : a first map, for x. Where ε(0) follows the fitted shape its change is in it.
    """
    problem, system, solution = overlap.problem, overlap.system, overlap.solution
    sigma_m2, at = problem.settings.sigma_operator_m2, system.layout

    def excess(rows: Observations) -> Float32:
        return np.float32(sigma_m2) * operator_excess(rows, problem.emissivity, problem.band, problem.room.reflected_K)

    given = solution.p[: at.size], solution.x, solution.weight
    changed = replace(system, y=system.y + excess(overlap.rows)).step(*given)[0] - system.step(*given)[0]

    limit = np.float32(np.cos(np.radians(problem.mapping.max_angle_deg)))
    rows = problem.observations.select(problem.observations.cos_angle >= limit)
    x = np.nan_to_num(problem.band.radiance(blended.normal_equivalent_K) - problem.L_reflected)
    direction = AngleTable.of(shape_direction(AngleTable.knots()))(rows.cos_angle)
    field = replace(system.field, coefficients=system.keep @ changed[at.field])
    view = rows.view if problem.settings.crosscal.offsets else np.zeros(len(rows), np.int32)
    taken = changed[at.offsets][view] + field(rows.u_px, rows.v_px) + changed[at.shape] * direction * x[rows.vertex]
    E = AngleTables.of(problem.emissivity).relative(rows.cos_angle)
    square = np.bincount(rows.vertex, E * E, len(problem))
    left = np.bincount(rows.vertex, E * (excess(rows) - taken), len(problem)) / np.maximum(square, 1e-12)
    if problem.settings.output == "absolute":
        left -= x * changed[at.shape] * _epsilon0_slope(overlap)
    return np.where(square > 0, left, 0).astype(np.float32)


def _epsilon0_slope(overlap: Overlap) -> Float:
    """d ln ε(0)/ds of the model."""
    s = float(overlap.solution.p[overlap.system.layout.shape])
    low, high = (reshaped(overlap.problem.emissivity, s + d).normal for d in (-SHAPE_STEP, SHAPE_STEP))
    return np.asarray(np.log(high / low) / (2 * SHAPE_STEP))
