"""The result folder: what a run hands out, and the files that it becomes (docs/formats.md)."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import RecipeError, ScanError
from ..files.json import to_json
from ..files.whole import write_text
from ..recipe import Recipe
from ..report.summary import Steps
from ..types import ThermalMesh, Trajectory
from .artifacts import load_artifact, save_artifact

if TYPE_CHECKING:
    from ..report.casts import Cast


@dataclass(frozen=True, eq=False)
class Result(Steps):
    """What `fuse` returns: what the steps found, and the report on it."""

    report: dict[str, Any] = field(default_factory=dict)

    @property
    def trajectory(self) -> Trajectory:
        """Poses of the depth camera."""
        return self.tracking.trajectory

    @property
    def mesh(self) -> ThermalMesh:
        """The surface with its temperatures. Raises RecipeError if the run was stopped before there were any."""
        if self.temperature is None:
            raise RecipeError("the run was stopped before the temperature stage", hint="run without --until")
        return self.temperature.mesh


def write_result(result: Result, recipe: Recipe, folder: Path, casts: Future[list[Cast]] | None = None) -> None:
    """The result folder's files (docs/formats.md), each whole or not at all; `result.json` comes last.

    casts : the pictures' rays, if they were cast meanwhile.
    """
    from ..export import export, write_trajectory
    from ..report.pictures import write_views

    write_text(folder / "recipe.resolved.toml", recipe.to_toml())
    write_trajectory(folder / "trajectory.txt", result.trajectory)
    if result.temperature is not None:
        mesh, output = result.mesh, recipe.output
        export(mesh, folder, tuple(output.formats), palette=output.palette, range_degC=output.range_degC)
        save_artifact(folder / "result.npz", result.temperature)
        if output.views:
            cast = None if casts is None else casts.result()
            write_views(mesh, folder / "views", palette=output.palette, range_degC=output.range_degC, casts=cast)
    write_text(folder / "result.json", to_json(result.report))


def load_mesh(folder: Path, show: str = "absolute") -> ThermalMesh:
    """The mesh of a finished result, in one of the three output modes. Raises ScanError."""
    from ..temperature.solve import Temperature

    path = folder / "result.npz"
    if not path.is_file():
        raise ScanError("no finished result is here", place=folder, hint="run `thermofusion run` first")
    temperature = load_artifact(path)
    if not isinstance(temperature, Temperature):
        raise ScanError("it holds no temperatures", place=path, hint="run `thermofusion run` again")
    return temperature.shown(show)
