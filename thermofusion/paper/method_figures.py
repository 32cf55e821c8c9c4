"""Every method on every scan whose truth is known: the table of the results page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..pipeline import Result
from ..recipe import Recipe
from ..temperature.solve import METHODS, solve
from ..types import Scan, ThermalMesh
from .prepared import Case, Prepared
from .report import Figure, Number


def methods_on_phantoms(prepared: Prepared) -> list[Figure]:
    """The cylinder and the head."""
    return [_figure("methods-phantoms", (prepared.cylinder, prepared.head))]


def methods_on_torso(prepared: Prepared) -> list[Figure]:
    """The scan that lies with the recordings."""
    return [_figure(f"methods-{prepared.torso.name}", (prepared.torso,))]


def _figure(stem: str, cases: Sequence[Case]) -> Figure:
    rows: dict[str, list[Any]] = {k: [] for k in ("scan", "method", "vertices", "level_K", "rms_K", "p95_K")}
    numbers = []
    for case in cases:
        for method in METHODS:
            e = case.truth.error(_by_method(case.scan, case.recipe, case.result, method), case.result.trajectory)
            for key, value in zip(rows, (case.name, method, e.vertices, e.level_K, e.rms_K, e.p95_K), strict=True):
                rows[key].append(value)
            numbers.append(Number(f"{case.name}, {method}: rms error, level removed", e.rms_K, "K"))
    note = "Against the phantom's truth, vertices seen by at least two views at less than 60°; the median is removed."
    return Figure(stem, "Every method against the truth", tables={"": rows}, numbers=numbers, notes=[note])


def _by_method(scan: Scan, recipe: Recipe, result: Result, method: str) -> ThermalMesh:
    """The same surface and observations, blended by another method; in the result's frame, as its trajectory is."""
    assert result.surface is not None
    assert result.frame is not None
    assert result.mapped is not None
    if method == recipe.temperature.method:
        return result.mesh
    other = recipe.temperature.model_copy(update={"method": method})
    surface = result.surface
    window_m = surface.normal_window_m
    found = solve(
        scan, surface.mesh, result.mapped, normal_window_m=window_m, mapping=recipe.mapping, temperature=other
    )
    return result.frame.mesh(found.mesh)
