"""The whole way from a recording to a mesh with temperatures, in the paper's four steps.

1. *Surface*: track the depth camera, fuse its frames (Kinect + ReconstructMe in the paper; pose graph + TSDF here).
2. *Rig*: where the thermal camera sits and when its clock ticks (the system calibration, refined on the scan itself).
3. *Mapping*: project every thermal view onto the surface, keep what it saw (Eqs. 5-12).
4. *Temperature*: let views calibrate each other, correct ε(θ) and reflection at every vertex, blend (Eqs. 13-28).
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import RecipeError
from .progress import Progress, silent
from .recipe import RENAMED_STAGES, Recipe
from .report.summary import Steps, result_report, summary
from .results.folder import Result, load_mesh, write_result
from .results.stages import Computes, Stage, StagePlan, Stages, fingerprint
from .scans.check import verify
from .types import Scan, SurfaceMesh
from .version import __version__

if TYPE_CHECKING:
    from .report.casts import Cast
    from .surface.surface import SurfaceResult
    from .tracking.track import TrackingResult

# A stage is handed exactly the recipe sections that its key holds. It also depends on all stages before it.
STAGES = (
    Stage("tracking", ("input", "subject", "tracking")),
    Stage("surface", ("input", "subject", "surface")),
    Stage("rig", ("input", "rig")),
    Stage("mapping", ("input", "mapping")),
    Stage("temperature", ("mapping", "temperature")),
)
STAGE_NAMES = tuple(stage.name for stage in STAGES)


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
    redo_from, until : names of stages. compare_methods : also compute every other method, for the report.

    Raises ScanError (unusable input), RecipeError, ResourceError. What was computed before an error stays in `out`.
    """
    from .mapping.observe import observe
    from .rig.align import align
    from .surface.surface import fuse_surface
    from .temperature.solve import solve, unmeasured
    from .tracking.track import locate

    verify(scan)
    folder = None if out is None else Path(out)
    first_anew, last = _position(redo_from, len(STAGES)), _position(until, len(STAGES) - 1)
    stages = _stages(scan, recipe, folder)
    stages.tidy()

    def step(number: int, compute: Computes) -> Any:
        if number > last:
            return None
        name = STAGES[number].name
        progress(name, 0, 1)
        value = stages.run(STAGES[number], compute, progress, anew=number >= first_anew)
        progress(name, 1, 1)
        return value

    # 1. Surface
    tracking = step(0, partial(locate, scan))
    surface = step(1, partial(fuse_surface, scan, tracking))
    rig = mapped = temperature = casts = None
    if surface is not None:
        facts = {"recipe": recipe.name, **_axes(scan, tracking, surface)}
        if scan.thermal is None:
            temperature = unmeasured(surface.mesh, recipe.temperature, facts)
        else:
            # 2. Rig
            rig = step(2, partial(align, scan, surface.mesh, tracking.trajectory))
            # 3. Mapping
            mapped = step(3, partial(observe, scan, surface.mesh, tracking.trajectory, rig))
            # 4. Temperature, while the pictures' rays are cast on the other core
            if folder is not None and until is None and recipe.output.views:
                casts = _casting(surface.mesh, facts)
            temperature = step(4, partial(solve, scan, surface, mapped, metadata=facts, compare=compare_methods))

    steps = Steps(tracking, surface, rig, mapped, temperature)
    result = Result(**vars(steps), report=result_report(scan, recipe, steps, stages.reused))
    if folder is not None:
        write_result(result, recipe, folder, casts)
    return result


def plan(scan: Scan, recipe: Recipe, out: Path, *, redo_from: str | None = None) -> list[StagePlan]:
    """What `fuse` would compute or reuse, and why; nothing is computed."""
    stages, first = _stages(scan, recipe, out), _position(redo_from, len(STAGES))
    return [stages.plan(stage, anew=number >= first) for number, stage in enumerate(STAGES)]


def _position(name: str | None, default: int) -> int:
    """Where a stage stands, by its name or an old one. Raises RecipeError for an unknown one."""
    if name is None:
        return default
    name = RENAMED_STAGES.get(name, name)
    if name not in STAGE_NAMES:
        raise RecipeError(f"there is no stage '{name}'", hint=f"stages are {', '.join(STAGE_NAMES)}")
    return STAGE_NAMES.index(name)


def _casting(surface: SurfaceMesh, facts: dict[str, str]) -> Future[list[Cast]]:
    from .export import axes_of
    from .report.pictures import cast_surface

    pool = ThreadPoolExecutor(max_workers=1)
    casts = pool.submit(cast_surface, surface, axes_of(facts))
    pool.shutdown(wait=False)
    return casts


def _axes(scan: Scan, tracking: TrackingResult, surface: SurfaceResult) -> dict[str, str]:
    from .export import view_axes

    floor = surface.floor_plane if surface.floor_plane is not None else tracking.floor_plane
    centre_m = surface.mesh.vertices_m.mean(0)
    normal = None if floor is None else floor[:3]
    return view_axes(tracking.trajectory.T_world_depth, centre_m, normal, scan.depth_up)


def _stages(scan: Scan, recipe: Recipe, folder: Path | None) -> Stages:
    return Stages(folder, {"thermofusion": __version__, "scan": fingerprint(scan)}, recipe)


__all__ = ["STAGES", "STAGE_NAMES", "Result", "fuse", "load_mesh", "plan", "summary", "write_result"]
