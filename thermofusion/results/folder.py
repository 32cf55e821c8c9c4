"""The result folder: what a run hands out, and the files that it becomes (docs/formats.md)."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import RecipeError, ScanError
from ..files.json import to_json
from ..files.reading import read_json
from ..files.whole import changing_over, write_text
from ..recipe import Recipe
from ..report.casts import DOUBTS
from ..report.casts import VIEWS as FACES
from ..report.summary import Steps, result_report
from ..types import Scan, ThermalMesh, Trajectory
from ..version import __version__
from .artifacts import load_artifact, save_artifact
from .claim import CHANGING, REPORT, VIEWS, listed
from .frame import WORLD, Frame, frame_of

if TYPE_CHECKING:
    from ..report.casts import Cast


@dataclass(frozen=True, eq=False)
class Result(Steps):
    """What `fuse` returns: what the steps found, in the tracking's world, and the report on it.

    world_mesh : the surface with its temperatures, in that world. frame : the result's own.
    """

    report: dict[str, Any] = field(default_factory=dict)
    frame: Frame | None = None
    world_mesh: ThermalMesh | None = None

    @classmethod
    def of(cls, scan: Scan, recipe: Recipe, steps: Steps, reused: Sequence[str], run: str) -> Result:
        """With report and frame. run : the id that every file of the result carries."""
        report = result_report(scan, recipe, steps, reused) | {"run": run}
        if steps.surface is None or steps.temperature is None:
            return cls(**vars(steps), report=report)
        frame = frame_of(scan, steps, recipe.output)
        report["frame"] = {"name": frame.name, "T_result_world": frame.T_result_world, "front_from": frame.front_from}
        mesh = steps.temperature.mesh
        facts = {"version": __version__, "recipe": recipe.name, "frame": WORLD, **frame.axes}
        facts |= {"scan": scan.name, "run": run}
        facts |= {} if scan.recorded_at is None else {"recorded_at": scan.recorded_at}
        mesh = replace(mesh, metadata={**facts, **mesh.metadata})
        return cls(**vars(steps), report=report, frame=frame, world_mesh=mesh)

    def __repr__(self) -> str:
        reached = "no surface" if self.surface is None else f"{len(self.surface.mesh)} vertices"
        reached = reached if self.temperature is None else repr(self.temperature.mesh)
        return f"<Result of scan {str(self.report.get('scan', {}).get('name', ''))[:40]!r}: {reached}>"

    @property
    def trajectory(self) -> Trajectory:
        """Poses of the depth camera, in the result's frame."""
        trajectory = self.tracking.trajectory
        return trajectory if self.frame is None else self.frame.trajectory(trajectory)

    @property
    def mesh(self) -> ThermalMesh:
        """The surface with its temperatures, upright. Raises RecipeError if the run stopped before there were any."""
        mesh = self.mesh_in_world
        assert self.frame is not None
        return self.frame.mesh(mesh)

    @property
    def mesh_in_world(self) -> ThermalMesh:
        """The same in the tracking's world, in which poses and views are. Raises RecipeError."""
        if self.world_mesh is None:
            raise RecipeError("the run was stopped before the temperature stage", hint="run without --until")
        return self.world_mesh


def names_of(recipe: Recipe) -> list[str]:
    """The files that a finished run writes, but for its stages."""
    names = ["recipe.resolved.toml", "trajectory.txt", "result.npz", REPORT]
    names += [f"mesh.{f}" for f in recipe.output.formats]
    return [*names, *(f"{VIEWS}/{v}.png" for v in (*FACES, "overview", *DOUBTS) if recipe.output.views)]


def write_result(
    result: Result, recipe: Recipe, folder: Path, left: Sequence[str] = (), casts: Future[list[Cast]] | None = None
) -> None:
    """The result folder's files (docs/formats.md), changed over together: `result.json` goes first and comes last.

    left : files of an earlier result; those that this one does not write are removed. casts : the pictures' rays, if
    they were cast meanwhile.
    """
    from ..export import export, write_trajectory
    from ..report.pictures import write_views

    run = f"scan {result.report['scan']['name']!r}, run {result.report['run']}"
    output = recipe.output
    with changing_over(folder, REPORT) as new:
        write_text(new / "recipe.resolved.toml", f"# {run}\n{recipe.to_toml()}")
        write_trajectory(new / "trajectory.txt", result.trajectory, note=run)
        if result.temperature is not None:
            mesh = result.mesh
            export(mesh, new, tuple(output.formats), palette=output.palette, range_degC=output.range_degC)
            save_artifact(new / "result.npz", replace(result.temperature, mesh=mesh))
            if output.views:
                cast = None if casts is None else casts.result()
                range_degC = output.range_degC
                write_views(
                    result.mesh_in_world, new / VIEWS, palette=output.palette, range_degC=range_degC, casts=cast
                )
        files = sorted(p.relative_to(new).as_posix() for p in new.rglob("*") if p.is_file())
        write_text(new / REPORT, to_json({**result.report, "files": [*files, REPORT]}))
        write_text(folder / CHANGING, to_json(sorted({*left, *files, REPORT})))
    for name in {*left, CHANGING} - {*files, REPORT}:
        (folder / name).unlink(missing_ok=True)


def add_files(folder: Path, paths: Sequence[Path]) -> None:
    """Count files written later (an export, a validation) to a finished result, so that they go when it goes."""
    try:
        report = read_json(folder / REPORT)
        names = [p.resolve().relative_to(folder.resolve()).as_posix() for p in paths]
    except (ScanError, ValueError):
        return
    report["files"] = sorted({*report.get("files", listed(folder)), *names})
    write_text(folder / REPORT, to_json(report))


def load_mesh(folder: Path, show: str = "absolute") -> ThermalMesh:
    """The mesh of a finished result, in one of the three output modes. Raises ScanError."""
    from ..temperature.solve import Temperature

    path = folder / "result.npz"
    if not path.is_file():
        there = (folder / "stages").is_dir()
        cause = "the run did not reach the temperature stage" if there else "no finished result is here"
        command = f"`thermofusion run SCAN -o {shlex.quote(str(folder))}`"
        raise ScanError(cause, place=folder, hint=f"{command} {'goes on from there' if there else 'writes one'}")
    temperature = load_artifact(path)
    if not isinstance(temperature, Temperature):
        raise ScanError(
            "it holds no temperatures", place=path, hint="`thermofusion run SCAN -o RESULT` writes it again"
        )
    return temperature.shown(show)
