"""The whole way from a recording to a mesh with temperatures, in the paper's four steps.

1. *Surface*: track the depth camera, fuse its frames (Kinect + ReconstructMe in the paper; pose graph + TSDF here).
2. *Rig*: where the thermal camera sits and when its clock ticks (the system calibration, refined on the scan itself).
3. *Mapping*: project every thermal view onto the surface, keep what it saw (Eqs. 5-12).
4. *Temperature*: let views calibrate each other, correct ε(θ) and reflection at every vertex, blend (Eqs. 13-28).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .progress import Progress, silent
from .recipe import Recipe
from .report.summary import result_report, summary
from .results.folder import Result, load_mesh, write_result
from .results.stages import StagePlan, Stages, fingerprint
from .scans.check import verify
from .types import Scan, SurfaceMesh
from .version import __version__

if TYPE_CHECKING:
    from .report.casts import Cast
    from .surface.surface import SurfaceResult
    from .tracking.track import TrackingResult


# Stage -> the recipe sections it reads. A stage also depends on all stages before it.
SECTIONS: dict[str, tuple[str, ...]] = {
    "track": ("input", "subject", "tracking"),
    "surface": ("input", "subject", "fusion"),
    "align": ("mapping", "crosscal"),
    "observe": ("mapping",),
    "temperature": ("mapping", "emissivity", "radiometry", "crosscal"),
}
STAGES = tuple(SECTIONS)


def fuse(
    scan: Scan,
    recipe: Recipe,
    *,
    out: Path | str | None = None,
    progress: Progress = silent,
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
    from .rig.align import align_thermal
    from .surface.surface import fuse_surface
    from .temperature.solve import measure, see, unmeasured
    from .tracking.track import locate

    verify(scan)
    folder = None if out is None else Path(out)
    stages = _stages(scan, folder, redo_from)
    step = progress
    last = STAGES.index(until) if until else len(STAGES) - 1

    def run(name: str, compute: Callable[[Progress], Any]) -> Any:
        if STAGES.index(name) > last:
            return None
        step(name, 0, 1)
        value = stages.run(name, _inputs(name, recipe), lambda: compute(step))
        step(name, 1, 1)
        return value

    # 1. Surface
    read: dict[str, Any] = {"input": recipe.input, "subject": recipe.subject}
    tracking = run("track", lambda p: locate(scan, **read, tracking=recipe.tracking, progress=p))
    trajectory = tracking.trajectory
    surface = run("surface", lambda p: fuse_surface(scan, tracking, **read, surface=recipe.fusion, progress=p))
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


def plan(scan: Scan, recipe: Recipe, out: Path, *, redo_from: str | None = None) -> list[StagePlan]:
    """What `fuse` would compute or reuse, and why; nothing is computed."""
    stages = _stages(scan, out, redo_from)
    return [stages.plan(name, _inputs(name, recipe)) for name in STAGES]


def _casting(surface: SurfaceMesh, axes: dict[str, str]) -> Future[list[Cast]]:
    from .export import axes_of
    from .report.pictures import cast_surface

    pool = ThreadPoolExecutor(max_workers=1)
    casts = pool.submit(cast_surface, surface, axes_of(axes))
    pool.shutdown(wait=False)
    return casts


def _axes(scan: Scan, tracking: TrackingResult, surface: SurfaceResult) -> dict[str, str]:
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


__all__ = ["STAGES", "Result", "fuse", "load_mesh", "plan", "summary", "write_result"]
