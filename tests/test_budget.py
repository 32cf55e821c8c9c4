"""Uncertainty budgets of regions: contributions add up to the sigma that is shown, and what is shared cancels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.result_maker import result, sphere

from thermofusion.errors import RecipeError
from thermofusion.regions import Brush, Line, Measured, Measurer, Spot, between_visits
from thermofusion.regions.budget import UncertaintyBudget
from thermofusion.temperature.uncertainty import Uncertainty
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


@pytest.fixture(scope="module")
def budgeted():
    """A mesh whose parts are those of its shared errors, as a run writes them: sigma about the level, and in full."""
    mesh = replace(result(sphere(30, 40), unmeasured_below_m=-1), anchored=True)
    x, y, _ = (mesh.surface.vertices_m / 0.1).T
    effects = {
        "reference": 0.03 + 0 * x,
        "emissivity0": 0.05 + 0.004 * y,
        "reflected 1": 0.02 * x,
        "reflected 2": 0.01 * y,
    }
    effects |= {"calibration 1": 0.008 * x**2, "calibration 2": 0.003 * y}
    named = {name: effect for name, effect in effects.items() if not name.startswith("calibration")}
    modes = np.stack([effects["calibration 1"], effects["calibration 2"]], axis=1)
    parts = {"noise": 0.012 + 0.002 * x, "silhouette": 0.001 + 0 * x, "calibration": np.linalg.norm(modes, axis=1)}
    u = Uncertainty.of(parts, named, modes)
    mesh = replace(mesh, uncertainty_K=u.total_K, uncertainty_parts=u.parts_K | {"absolute": u.absolute_K})
    return Measurer(mesh, SharedErrors.of(effects, 600.0, 0.025), INPUTS)


def test_a_vertex_s_budget_adds_up_to_the_sigma_of_the_mesh(budgeted):
    mesh = budgeted.mesh
    readings = [budgeted.vertex(number) for number in range(0, len(mesh), 97)]
    at = np.arange(0, len(mesh), 97)
    np.testing.assert_allclose([r.sigma_K for r in readings], mesh.uncertainty_K[at], rtol=1e-5)
    np.testing.assert_allclose(
        [r.sigma_absolute_K for r in readings], mesh.uncertainty_parts["absolute"][at], rtol=0.01
    )
    budget = budgeted.budget(readings[3])
    assert budget.combined_K == pytest.approx(readings[3].sigma_absolute_K, rel=1e-6)
    assert {row.name for row in budget.rows} >= {"noise", "silhouette", "reference", "emissivity0", "reflected"}
    with pytest.raises(RecipeError, match="no vertex"):
        budgeted.vertex(len(mesh))


def test_a_change_since_an_earlier_visit_owns_both_visits_levels(budgeted):
    warmer = replace(budgeted.mesh, temperature_degC=budgeted.mesh.temperature_degC + np.float32(0.4))
    now, then = Measurer(warmer, budgeted.shared, INPUTS), budgeted
    measured = Measured.of(now, [LEFT], vertices=[5]).since(Measured.of(then, [LEFT]), INPUTS)
    (change,) = measured.changes
    assert change.delta_K == pytest.approx(0.4, abs=1e-5)
    assert [b.quantity for b in measured.budgets] == ["left knee", "vertex 5", "left knee, change"]
    rows = {row.name: row.contribution_K for row in change.budget.rows}
    one = {row.name: row.contribution_K for row in measured.budgets[0].rows}
    assert "emissivity0" not in rows  # the same skin
    for name in set(rows):
        assert rows[name] == pytest.approx(np.sqrt(2) * one[name], rel=1e-6)
    assert change.sigma_K == pytest.approx(np.sqrt(sum(v**2 for v in rows.values())))
    assert any(line.startswith('"left knee - left knee, before",change_K,0.4') for line in measured.csv().splitlines())
    assert measured.document()["changes"][0]["delta_K"] == change.delta_K
    relative = Measurer(replace(warmer, anchored=False), budgeted.shared, INPUTS)
    (unsure,) = Measured.of(relative, [LEFT]).since(Measured.of(then, [LEFT]), INPUTS).changes
    assert np.isnan(unsure.sigma_K)
    assert unsure.budget is None


def test_the_table_holds_every_input(measurer):
    measured = Measured.of(measurer, [LEFT])
    lines = measured.budget_csv().splitlines()
    assert lines[0].startswith("quantity,name,value,u,unit,kind,freedom,sensitivity,contribution_K")
    assert any(line.startswith("left knee,reference,0,0.03,K,B") for line in lines)
    assert lines[-1].startswith("left knee,expanded (k = 2)")
    assert measured.document()["budgets"][0]["rows"]
