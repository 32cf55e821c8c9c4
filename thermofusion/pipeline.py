"""The whole way from a recording to a mesh with temperatures, in the paper's four steps.

1. *Surface*: track the depth camera, fuse its frames (Kinect + ReconstructMe in the paper; pose graph + TSDF here).
2. *Rig*: where the thermal camera sits and when its clock ticks (the system calibration, refined on the scan itself).
3. *Mapping*: project every thermal view onto the surface, keep what it saw (Eqs. 5-12).
4. *Temperature*: let views calibrate each other, correct ε(θ) and reflection at every vertex, blend (Eqs. 13-28).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import __version__
from .check import verify
from .errors import RecipeError, ScanError
from .recipe import Recipe
from .report.summary import result_report, summary
from .rundir import StagePlan, Stages, fingerprint, load_artifact, save_artifact, to_json, write_text
from .types import Scan, SurfaceMesh, ThermalMesh, Trajectory

if TYPE_CHECKING:
    from .alignment import AlignmentResult
    from .fusion import FusionResult
    from .raycasts import Cast
    from .thermometry import Seen, Temperature
    from .tracking import TrackingResult

Progress = Callable[[str, int, int], None]

# Stage -> the recipe sections it reads. A stage also depends on all stages before it.
SECTIONS: dict[str, tuple[str, ...]] = {
    "track": ("input", "subject", "tracking"),
    "surface": ("input", "subject", "fusion"),
    "align": ("mapping", "crosscal"),
    "observe": ("mapping",),
    "temperature": ("mapping", "emissivity", "radiometry", "crosscal"),
}
STAGES = tuple(SECTIONS)


@dataclass(frozen=True, eq=False)
class Result:
    """What `fuse` returns: the mesh, and how it came about. Stages that were not needed or not reached are None."""

    report: dict[str, Any]
    trajectory: Trajectory
    tracking: TrackingResult | None = None
    surface: FusionResult | None = None
    alignment: AlignmentResult | None = None
    seen: Seen | None = None
    temperature: Temperature | None = None

    @property
    def mesh(self) -> ThermalMesh:
        """The surface with its temperatures. Raises RecipeError if the run was stopped before there were any."""
        if self.temperature is None:
            raise RecipeError("the run was stopped before the temperature stage", hint="run without --until")
        return self.temperature.mesh


def fuse(
    scan: Scan,
    recipe: Recipe,
    *,
    out: Path | str | None = None,
    progress: Progress | None = None,
    redo_from: str | None = None,
    until: str | None = None,
    compare_methods: bool = False,
) -> Result:
    """Fuse a scan into a mesh whose every vertex carries a temperature and its uncertainty.

    Parameters
    ----------
    out : result folder; stages stored there are reused where their inputs are unchanged. None: nothing is written.
    progress : called with (stage, done, total).
    redo_from, until : names of `STAGES`. compare_methods : also compute every other method, for the report.

    Raises ScanError (unusable input), RecipeError, ResourceError. What was computed before an error stays in `out`.
    """
    from .alignment import align_thermal
    from .thermometry import measure, see, unmeasured

    verify(scan)
    folder = None if out is None else Path(out)
    stages = _stages(scan, folder, redo_from)
    step = progress or _silent
    last = STAGES.index(until) if until else len(STAGES) - 1

    def run(name: str, compute: Callable[[Progress], Any]) -> Any:
        if STAGES.index(name) > last:
            return None
        step(name, 0, 1)
        value = stages.run(name, _inputs(name, recipe), lambda: compute(step))
        step(name, 1, 1)
        return value

    # 1. Surface
    tracking = run("track", lambda p: locate(scan, recipe, p))
    trajectory = tracking.trajectory
    surface = run("surface", lambda p: fuse_subject(scan, tracking, recipe, p))
    alignment = seen = temperature = casts = None
    if surface is not None and scan.thermal is None:
        temperature = unmeasured(scan, surface.mesh, recipe, _axes(scan, tracking, surface))
    elif surface is not None:
        # 2. Rig
        alignment = run("align", lambda p: align_thermal(scan, surface.mesh, trajectory, recipe))
        # 3. Mapping
        seen = run("observe", lambda p: see(scan, surface.mesh, trajectory, alignment, recipe))
        # 4. Temperature, while the pictures' rays are cast on the other core
        axes = _axes(scan, tracking, surface)
        if folder is not None and until is None and recipe.output.views:
            casts = _casting(surface.mesh, axes)
        temperature = run(
            "temperature", lambda p: measure(scan, surface.mesh, seen, recipe, axes=axes, compare=compare_methods)
        )

    report = result_report(scan, recipe, tracking, surface, alignment, seen, temperature, stages.reused)
    result = Result(report, trajectory, tracking, surface, alignment, seen, temperature)
    if folder is not None:
        write_result(result, recipe, folder, casts)
    return result


def locate(scan: Scan, recipe: Recipe, progress: Progress) -> TrackingResult:
    """Where the depth camera was: the recorded trajectory as it is, or tracked (see `tracking`)."""
    from .tracking import recorded, track

    source = recipe.tracking.source
    if source == "recorded" and scan.trajectory is None:
        raise ScanError("no trajectory was recorded", place=scan.root, hint="set tracking.source to auto or estimate")
    if scan.trajectory is not None and source != "estimate" and not recipe.tracking.refine:
        return recorded(scan)
    if source == "estimate":
        scan = replace(scan, trajectory=None)
    return track(scan, recipe, progress=progress)


def fuse_subject(scan: Scan, tracking: TrackingResult, recipe: Recipe, progress: Progress) -> FusionResult:
    """The subject's surface (see `fusion`). Before a standing camera the room is masked out as in tracking."""
    from .fusion import fuse_surface
    from .segmentation import SubjectFrames

    frames = SubjectFrames(scan, recipe) if recipe.subject.motion == "subject" else None
    return fuse_surface(
        scan, tracking.trajectory, recipe, progress=progress, floor_plane=tracking.floor_plane, frames=frames
    )


def plan(scan: Scan, recipe: Recipe, out: Path, *, redo_from: str | None = None) -> list[StagePlan]:
    """What `fuse` would compute or reuse, and why; nothing is computed."""
    stages = _stages(scan, out, redo_from)
    return [stages.plan(name, _inputs(name, recipe)) for name in STAGES]


def write_result(result: Result, recipe: Recipe, folder: Path, casts: Future[list[Cast]] | None = None) -> None:
    """The result folder's files (docs/formats.md), each whole or not at all; `result.json` comes last.

    casts : the pictures' rays, if they were cast meanwhile.
    """
    from .export import export, write_trajectory
    from .pictures import write_views

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
    """The mesh of a finished result, in one of the three output modes."""
    path = folder / "result.npz"
    try:
        temperature = load_artifact(path)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as e:
        raise ScanError(f"no finished result is here ({e})", place=path, hint="run `thermofusion run` first") from None
    return temperature.shown(show)


def _casting(surface: SurfaceMesh, axes: dict[str, str]) -> Future[list[Cast]]:
    from .export import axes_of
    from .pictures import cast_surface

    pool = ThreadPoolExecutor(max_workers=1)
    casts = pool.submit(cast_surface, surface, axes_of(axes))
    pool.shutdown(wait=False)
    return casts


def _axes(scan: Scan, tracking: TrackingResult, surface: FusionResult) -> dict[str, str]:
    from .export import view_axes

    floor = surface.floor_plane if surface.floor_plane is not None else tracking.floor_plane
    centre_m = surface.mesh.vertices_m.mean(0)
    normal = None if floor is None else floor[:3]
    return view_axes(tracking.trajectory.T_world_depth, centre_m, normal, scan.depth_up)


def _stages(scan: Scan, folder: Path | None, redo_from: str | None) -> Stages:
    base = {"thermofusion": __version__, "scan": fingerprint(scan)}
    return Stages(folder, base, redo_from=redo_from, order=STAGES)


def _inputs(name: str, recipe: Recipe) -> dict[str, Any]:
    return {section: getattr(recipe, section) for section in SECTIONS[name]}


def _silent(stage: str, done: int, total: int) -> None:
    """No progress wanted."""


__all__ = ["STAGES", "Result", "fuse", "load_mesh", "plan", "summary", "write_result"]
