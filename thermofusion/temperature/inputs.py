"""What a temperature depends on, input by input: value, standard uncertainty, how it is known. For the budget."""

from __future__ import annotations

import numpy as np

from ..types import BudgetInput
from .crosscal import Calibration
from .problem import ThermalProblem
from .uncertainty import AIR_LOSS_PER_M, LINKED_EPSILON0_SIGMA, PATH_M

MANY = float("inf")  # degrees of freedom of what is stated, or known from very many readings


def inputs_of(problem: ThermalProblem, calibration: Calibration | None) -> tuple[BudgetInput, ...]:
    """Every named input of the budget. Kind A: from the scan's own scatter; B: stated, or known from elsewhere."""
    e, settings, views = problem.errors, problem.settings, float(max(problem.n_views - 1, 1))
    model = problem.emissivity if calibration is None else calibration.emissivity(problem.emissivity)
    fitted = calibration is not None and calibration.shape_sigma > 0
    sigma_epsilon0 = min(e.sigma_emissivity0, LINKED_EPSILON0_SIGMA) if fitted else e.sigma_emissivity0
    air_loss = AIR_LOSS_PER_M if settings.transmission_per_m == 1 else (1 - settings.transmission_per_m) / 3
    rows = [
        BudgetInput("noise", 0.0, e.netd_K, "K", "B", MANY),
        BudgetInput("emissivity0", float(model.normal), sigma_epsilon0, "1", "B", MANY),
        BudgetInput("gain", 1.0, e.sigma_gain, "1", "B", MANY),
        BudgetInput("operator", settings.operator_m2, settings.sigma_operator_m2, "m2", "B", MANY),
        BudgetInput("path", 0.0, air_loss * PATH_M, "1", "B", MANY),
    ]
    if calibration is not None:
        normal = calibration.sigma_normal_deg
        rows.append(BudgetInput("normals", 0.0, normal, "deg", "B" if settings.sigma_normal_deg else "A", MANY))
        typical = float(np.sqrt(np.mean(np.diag(calibration.covariance)[: problem.n_views]))) / calibration.slope_L
        rows.append(BudgetInput("calibration", float(np.mean(calibration.offsets_K)), typical, "K", "A", views))
        if calibration.anchored:
            n = max(len(problem.blackbodies), len(problem.contacts))
            freedom = float(n - 1) if n > 1 else MANY
            rows.append(BudgetInput("reference", 0.0, calibration.level_sigma_K, "K", "B", freedom))
    if problem.room_map is not None:
        room = problem.room_map
        u = float(np.sqrt(room.covariance[0, 0])) / room.slope_L
        rows.append(BudgetInput("reflected", problem.room.reflected_K, u, "K", "A" if room.measured else "B", MANY))
    if problem.scatter is not None:
        rows.append(BudgetInput("scatter", problem.scatter.share, problem.scatter.sigma, "1", "A", MANY))
    return tuple(rows)
