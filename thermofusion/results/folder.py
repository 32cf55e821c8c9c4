"""The result folder: what a run hands out, and the files that it becomes (docs/formats.md)."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from hashlib import sha256
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import RecipeError, ScanError
from ..files.json import to_json
from ..files.reading import read_image, read_json, read_whole
from ..files.whole import changing_over, write_text
from ..mapping.observe import Mapped
from ..motion.body import parted
from ..recipe import Recipe, load_recipe
from ..regions import Difference, Measured, Measurer, Region
from ..report.casts import DOUBTS
from ..report.casts import VIEWS as FACES
from ..report.html import Reported, report_html, write_report
from ..report.summary import PAGE, Steps, result_report
from ..types import Scan, ThermalMesh, Trajectory
from ..version import __version__
from .artifacts import load_artifact, save_artifact
from .claim import CHANGING, REPORT, VIEWS, listed
from .frame import WORLD, Frame, frame_of
from .stages import WORK

if TYPE_CHECKING:
    from ..report.casts import Cast
    from ..temperature.solve import Temperature

RESULT = "result.npz"  # the temperature stage's artifact, in the result's frame


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
        mesh = replace(mesh, metadata={**facts, **mesh.metadata, **facts})  # a reused mesh tells of an earlier run
        return cls(**vars(steps), report=report, frame=frame, world_mesh=mesh)

    def __repr__(self) -> str:
        reached = "no surface" if self.surface is None else f"{len(self.surface.mesh)} vertices"
        reached = reached if self.temperature is None else repr(self.temperature.mesh)
        return f"<Result of scan {str(self.report.get('scan', {}).get('name', ''))[:40]!r}: {reached}>"

    @property
    def trajectory(self) -> Trajectory:
        """Poses of the depth camera, in the result's frame."""
        trajectory = self.tracking.trajectory
        if self.surface is not None:
            trajectory = parted(self.surface.path(trajectory))[0]
        return trajectory if self.frame is None else self.frame.trajectory(trajectory)

    def measure(self, *regions: Region) -> Measured:
        """What regions of interest read, left against right (docs/report.md). Raises RecipeError as `mesh`."""
        found = self.temperature
        known = () if found is None else (found.shared, found.inputs)
        return Measured.of(Measurer(self.mesh, *known), regions)

    def _repr_html_(self) -> str:
        """The report, small, for notebooks."""
        if self.temperature is None:
            return "<p>The run was stopped before the temperature stage.</p>"
        shown = replace(self.temperature, mesh=self.mesh)
        page = escape(report_html(Reported(shown, self.report, Recipe(), self.mapped)))
        return f'<iframe srcdoc="{page}" width="100%" height="640" sandbox="allow-scripts allow-downloads"></iframe>'

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
    names = ["recipe.resolved.toml", "trajectory.txt", RESULT, REPORT]
    names += [f"mesh.{f}" for f in recipe.output.formats] + [PAGE] * recipe.output.report
    return [*names, *(f"{VIEWS}/{v}.png" for v in (*FACES, "overview", *DOUBTS) if recipe.output.views)]


def write_result(
    result: Result,
    recipe: Recipe,
    folder: Path,
    left: Sequence[str] = (),
    casts: Future[list[Cast]] | None = None,
    last: tuple[str, dict[str, Any]] | None = None,
) -> None:
    """The result folder's files (docs/formats.md), changed over together: `result.json` goes first and comes last.

    left : files of an earlier result; those that this one does not write are removed. casts : the pictures' rays, if
    they were cast meanwhile. last : the last stage's file and note; `result.npz` takes its place.
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
            shown = replace(result.temperature, mesh=mesh)
            save_artifact(new / RESULT, shown, None if last is None else last[1])
            if output.views:
                cast = None if casts is None else casts.result()
                range_degC = output.range_degC
                write_views(
                    result.mesh_in_world, new / VIEWS, palette=output.palette, range_degC=range_degC, casts=cast
                )
            if output.report:
                reported = Reported(shown, result.report, recipe, result.mapped, hashes=hashes_of(new))
                overview = new / VIEWS / "overview.png"
                write_report(new / PAGE, reported, read_image(overview)[..., ::-1] if overview.is_file() else None)
        files = sorted(p.relative_to(new).as_posix() for p in new.rglob("*") if p.is_file())
        write_text(new / REPORT, to_json({**result.report, "files": [*files, REPORT]}))
        write_text(folder / CHANGING, to_json(sorted({*left, *files, REPORT})), whatever=True)
    superseded = [] if last is None or result.temperature is None else [last[0]]
    for name in {*left, *superseded, CHANGING} - {*files, REPORT}:
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


def report_of(folder: Path, regions: Sequence[Region] = (), before: Path | None = None) -> Reported:
    """What a result's report is made of; before : result of an earlier visit. Raises ScanError, RecipeError."""
    temperature, stored = load_temperature(folder), folder / WORK / "mapping.npz"
    report = read_json(folder / REPORT)
    recipe = load_recipe(folder / "recipe.resolved.toml")
    mapped = load_artifact(stored) if stored.is_file() else None
    known = isinstance(mapped, Mapped) and mapped.observations.vertex.max(initial=-1) < len(temperature.mesh)
    changes: tuple[Difference, ...] = ()
    if before is not None:
        then = measured_of(load_temperature(before), regions)
        changes = measured_of(temperature, regions).since(then, temperature.inputs).changes
    return Reported(temperature, report, recipe, mapped if known else None, regions, hashes_of(folder), changes)


def measured_of(temperature: Temperature, regions: Sequence[Region]) -> Measured:
    """What regions of a result read."""
    return Measured.of(Measurer(temperature.mesh, temperature.shared, temperature.inputs), regions)


def hashes_of(folder: Path) -> dict[str, str]:
    """SHA-256 of the files that hold a result, by name."""
    names = (*(f"mesh.{suffix}" for suffix in ("ply", "glb", "vtp", "csv")), RESULT, "recipe.resolved.toml")
    return {n: sha256(read_whole(folder / n)).hexdigest() for n in names if (folder / n).is_file()}


def load_mesh(folder: Path, show: str = "absolute") -> ThermalMesh:
    """The mesh of a finished result, in one of the three output modes. Raises ScanError."""
    return load_temperature(folder).shown(show)


def load_temperature(folder: Path) -> Temperature:
    """The temperatures of a finished result. Raises ScanError."""
    from ..temperature.solve import Temperature

    path = folder / RESULT
    if not path.is_file():
        if (folder / WORK).is_dir():
            hint = f"`thermofusion run SCAN -o {shlex.quote(str(folder))}` goes on from there"
            raise ScanError("the run did not reach the temperature stage", place=folder, hint=hint)
        hint = "`thermofusion run SCAN -o RESULT` writes one"  # elsewhere: this may be a recording
        raise ScanError("no finished result is here", place=folder, hint=hint)
    temperature = load_artifact(path)
    if not isinstance(temperature, Temperature):
        raise ScanError(
            "it holds no temperatures", place=path, hint="`thermofusion run SCAN -o RESULT` writes it again"
        )
    return temperature
