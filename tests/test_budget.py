"""Uncertainty budgets of regions: contributions add up to the sigma that is shown, and what is shared cancels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.result_maker import result, sphere

from thermofusion.regions import Brush, Line, Measured, Measurer, Spot, between_visits
from thermofusion.regions.budget import UncertaintyBudget
from thermofusion.types import BudgetInput, SharedErrors

INPUTS = (
    BudgetInput("noise", 0.0, 0.05, "K", "B", np.inf),
    BudgetInput("emissivity0", 0.975, 0.005, "1", "B", np.inf),
    BudgetInput("reflected", 295.0, 0.5, "K", "A", 9.0),
    BudgetInput("reference", 0.0, 0.03, "K", "B", np.inf),
)
LEFT = Brush(name="left knee", points_m=[(0.1, 0, 0)], normals=[(1, 0, 0)], radius_m=0.03)
RIGHT = Brush(name="right knee", points_m=[(-0.1, 0, 0)], normals=[(-1, 0, 0)], radius_m=0.03)
REGIONS = [LEFT, RIGHT, Spot(name="spot", point_m=(0, 0.1, 0)), Line(name="way", points_m=[(0, 0.1, 0), (0, 0, 0.1)])]


@pytest.fixture(scope="module")
def measurer():
    mesh = replace(result(sphere(60, 90), unmeasured_below_m=-1), anchored=True)
    x = mesh.surface.vertices_m[:, 0] / 0.1
    one = np.ones(len(mesh))
    effects = {
        "reference": 0.03 * one,
        "emissivity0": 0.05 * one,
        "reflected 1": 0.02 * x,  # a room that is warmer on one side
        "reflected 2": 0.01 * one,
        "calibration 1": 0.008 * x**2,
    }
    return Measurer(mesh, SharedErrors.of(effects, 600.0, 0.025), INPUTS)


def test_contributions_add_up_to_the_sigma_that_is_shown(measurer):
    measured = Measured.of(measurer, REGIONS)
    assert len(measured.budgets) == len(measured.readings) + len(measured.differences) == 5
    shown = [r.sigma_absolute_K if np.isfinite(r.sigma_absolute_K) else r.sigma_K for r in measured.readings]
    shown += [d.sigma_K for d in measured.differences]
    for budget, sigma in zip(measured.budgets, shown, strict=True):
        rows = np.array([row.contribution_K for row in budget.rows])
        assert np.sqrt((rows**2).sum()) == pytest.approx(sigma, rel=1e-6)
        assert budget.combined_K == pytest.approx(sigma, rel=1e-6)
        assert budget.expanded_K == pytest.approx(2 * sigma, rel=1e-6)
        assert (np.diff(rows) <= 0).all()
        for row in budget.rows:
            if np.isfinite(row.sensitivity):
                assert row.sensitivity * row.u == pytest.approx(row.contribution_K)


def test_left_less_right_owns_the_room_s_side_and_nothing_of_the_level(measurer):
    (difference,) = Measured.of(measurer, [LEFT, RIGHT]).differences
    rows = {row.name: row for row in difference.budget.rows}
    assert rows["reflected"].contribution_K == pytest.approx(0.04, rel=0.05)  # 0.02 either way, near the poles of x
    assert "reference" not in rows
    assert "emissivity0" not in rows
    assert rows["reflected"].sensitivity == pytest.approx(0.08, rel=0.05)
    # 9 degrees of freedom of the leading input, and many of all others
    share = rows["reflected"].contribution_K / difference.budget.combined_K
    assert difference.budget.freedom == pytest.approx(9 / share**4, rel=1e-6)


def test_between_visits_the_skin_cancels_and_the_level_does_not(measurer):
    reading = measurer.read(LEFT)
    budget = between_visits("left knee, second - first", reading.errors, reading.errors, INPUTS)
    rows = {row.name: row.contribution_K for row in budget.rows}
    assert "emissivity0" not in rows
    assert rows["reference"] == pytest.approx(0.03 * np.sqrt(2), rel=0.01)
    assert isinstance(budget, UncertaintyBudget)


def test_the_table_holds_every_input(measurer):
    measured = Measured.of(measurer, [LEFT])
    lines = measured.budget_csv().splitlines()
    assert lines[0].startswith("quantity,name,value,u,unit,kind,freedom,sensitivity,contribution_K")
    assert any(line.startswith("left knee,reference,0,0.03,K,B") for line in lines)
    assert lines[-1].startswith("left knee,expanded (k = 2)")
    assert measured.document()["budgets"][0]["rows"]
