"""The whole way from a recording to a mesh with temperatures, in the paper's four steps.

1. *Surface*: track the depth camera, fuse its frames (Kinect + ReconstructMe in the paper; pose graph + TSDF here).
2. *Rig*: where the thermal camera sits and when its clock ticks (the system calibration, refined on the scan itself).
3. *Mapping*: project every thermal view onto the surface, keep what it saw (Eqs. 5-12).
4. *Temperature*: let views calibrate each other, correct ε(θ) and reflection at every vertex, blend (Eqs. 13-28).
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from .errors import RecipeError, ScanError
from .files.reading import read_json
from .progress import Progress, silent
from .recipe import RENAMED_STAGES, Recipe
from .report.summary import Steps, summary
from .results.claim import REPORT, claimed, complete
from .results.folder import RESULT, Result, add_files, load_mesh, names_of, write_result
from .results.frame import frame_of
from .results.stages import Computes, Stage, StagePlan, Stages, fingerprint, run_id, said_to
from .scans.check import verify
from .types import Scan
from .version import __version__

if TYPE_CHECKING:
    from .report.casts import Cast
    from .tracking.ahead import Ahead

# A stage is handed exactly the recipe sections that its key holds. It also depends on all stages before it.
STAGES = (
    Stage("tracking", ("input", "subject", "tracking"), edition=4),
    Stage("surface", ("input", "subject", "surface"), edition=8),
    Stage("rig", ("input", "rig"), edition=6),
    Stage("mapping", ("input", "mapping"), edition=12),
    Stage("temperature", ("mapping", "temperature"), edition=19, handed_out=RESULT),
)
STAGE_NAMES = tuple(stage.name for stage in STAGES)
KEPT_THERMAL_BYTES = 64 << 20  # of images that are not decoded twice


def fuse(
    scan: Scan,
    recipe: Recipe,
    *,
    out: Path | str | None = None,
    progress: Progress = silent,
    redo_from: str | None = None,
    until: str | None = None,
    overwrite: bool = False,
) -> Result:
    """Fuse a scan into a mesh whose every vertex carries a temperature and its uncertainty.

    Parameters
    ----------
    out : result folder; stages stored there are reused where their inputs are unchanged. None: nothing is written.
    progress : called with (stage, done, total). redo_from, until : names of stages. overwrite : replace another scan's
    result, or a file of another origin, in `out`.

    Raises ScanError (unusable input), RecipeError, ResourceError. What was computed before an error stays in `out`.
    """
    return _written(_Run(scan, recipe, None if out is None else Path(out), progress, redo_from, until), overwrite)


def go_on(
    scan: Scan,
    recipe: Recipe,
    ahead: Ahead | None,
    *,
    out: Path,
    progress: Progress = silent,
    overwrite: bool = False,
) -> Result:
    """`fuse` a recording that was followed. ahead : what was done of it meanwhile (`live.follow`); used up."""
    run = _Run(scan, recipe, out, progress)
    run.ahead = ahead
    return _written(run, overwrite)


def _written(run: _Run, overwrite: bool) -> Result:
    """The result of a run, in its folder if it has one.

    BLAS has one thread meanwhile, whoever calls: more only wait for each other (see `cli`), and sums would depend on
    their number.
    """
    import scipy.linalg  # noqa: F401 - its BLAS is another one than NumPy's, and can be held once it is loaded

    scan, recipe = run.scan, run.recipe
    verify(scan)
    with threadpool_limits(1, user_api="blas"):
        if run.folder is None:
            return run.result()
        with claimed(run.folder, scan, names_of(recipe), overwrite=overwrite) as left:
            result = run.result()
            finished = None if result.mapped is None else (STAGES[-1].file, run.stages.note)
            write_result(result, recipe, run.folder, left, run.casts, finished)
            return result


def ready() -> None:
    """Load what the stages need and load only when they are called: there is time while a recording is followed."""
    from .geometry import _open3d  # noqa: F401
    from .mapping.observe import observe  # noqa: F401
    from .report.pictures import cast_surface  # noqa: F401
    from .rig.align import align  # noqa: F401
    from .surface.surface import fuse_surface  # noqa: F401
    from .temperature.solve import solve  # noqa: F401
    from .tracking.track import locate  # noqa: F401


def plan(scan: Scan, recipe: Recipe, out: Path, *, redo_from: str | None = None) -> list[StagePlan]:
    """What `fuse` would compute or reuse, and why; nothing is computed."""
    run = _Run(scan, recipe, out, redo_from=redo_from)
    return [run.stages.plan(stage, anew=number >= run.first_anew) for number, stage in enumerate(STAGES)]


def finished(scan: Scan, recipe: Recipe, out: Path) -> dict[str, Any] | None:
    """The report of a result that is what `fuse` would write; None where a file is missing or an input changed."""
    try:
        report = read_json(out / REPORT)
    except ScanError:
        return None
    run = _Run(scan, recipe, out)
    last = STAGE_NAMES.index("surface" if scan.thermal is None else STAGE_NAMES[-1])
    reusable = [run.stages.plan(stage).reuse for stage in STAGES[: last + 1]][-1]
    known = isinstance(report, dict) and report.get("run") == run_id(run.stages.key, _said(recipe))
    return report if known and reusable and complete(out) else None


def _said(recipe: Recipe) -> dict[str, Any]:
    return recipe.output.model_dump(mode="json")


class _Run:
    """One way from a recording to a result."""

    def __init__(
        self,
        scan: Scan,
        recipe: Recipe,
        folder: Path | None,
        progress: Progress = silent,
        redo_from: str | None = None,
        until: str | None = None,
    ) -> None:
        self.recipe, self.folder, self.progress = recipe, folder, progress
        # five rooms look at the same images
        self.scan = scan if scan.thermal is None else replace(scan, thermal=scan.thermal.kept(KEPT_THERMAL_BYTES))
        self.ahead: Ahead | None = None
        self.first_anew, self.last = _position(redo_from, len(STAGES)), _position(until, len(STAGES) - 1)
        self.stages = Stages(folder, {"thermofusion": __version__, "scan": fingerprint(scan)}, recipe, said_to(scan))
        self.casts: Future[list[Cast]] | None = None

    def result(self) -> Result:
        """All steps, each reused or computed."""
        self.stages.tidy()
        steps, output = self.steps(), self.recipe.output
        run = run_id(self.stages.key, _said(self.recipe))
        result = Result.of(self.scan, self.recipe, steps, self.stages.reused, run)
        if output.compare_methods and steps.surface and steps.mapped and steps.temperature:
            from .temperature.solve import compare_methods

            mesh, window_m = steps.surface.mesh, steps.surface.normal_window_m
            sections = self.recipe.mapping, self.recipe.temperature
            methods = compare_methods(self.scan, mesh, window_m, steps.mapped, steps.temperature, sections)
            result.report["temperature"]["methods"] = methods
        return result

    def steps(self) -> Steps:
        """The method: the paper's four steps."""
        from .depth.filter import KEPT_BYTES, DepthFrames
        from .mapping.observe import observe
        from .rig.align import align
        from .surface.surface import fuse_surface
        from .temperature.solve import solve, unmeasured
        from .tracking.track import locate

        scan, step = self.scan, self.step
        # 1. Surface
        ahead, self.ahead = self.ahead, None
        depth = None if ahead is None else ahead.depth_frames(scan, self.recipe.input)
        depth = DepthFrames(scan, self.recipe.input, keep_bytes=KEPT_BYTES) if depth is None else depth
        tracking = step("tracking", partial(locate, scan, depth=depth, ahead=ahead))
        surface = step("surface", partial(fuse_surface, scan, tracking, depth=depth))
        del depth, ahead  # with the images that they kept
        if surface is None:
            return Steps(tracking)
        mesh, path, window_m = surface.mesh, surface.path(tracking.trajectory), surface.normal_window_m
        if scan.thermal is None:
            return Steps(tracking, surface, temperature=unmeasured(mesh, self.recipe.temperature))
        # 2. Rig
        rig = step("rig", partial(align, scan, mesh, path))
        # 3. Mapping
        mapped = step("mapping", partial(observe, scan, mesh, path, rig))
        # 4. Temperature, while the pictures' rays are cast on the other core
        self.cast(Steps(tracking, surface))
        temperature = step("temperature", partial(solve, scan, mesh, mapped, normal_window_m=window_m))
        if temperature is not None:  # a finished result's stands in the result's frame
            moved_mm = None if surface.motion is None else surface.motion.moved_mm
            temperature = replace(temperature, mesh=replace(temperature.mesh, surface=mesh, moved_mm=moved_mm))
        return Steps(tracking, surface, rig, mapped, temperature)

    def step(self, name: str, compute: Computes) -> Any:
        """A stage's result, stored or computed; None behind the last one asked for."""
        number = STAGE_NAMES.index(name)
        if number > self.last:
            return None
        self.progress(name, 0, 1)
        value = self.stages.run(STAGES[number], compute, self.progress, anew=number >= self.first_anew)
        self.progress(name, 1, 1)
        return value

    def cast(self, steps: Steps) -> None:
        """Begin with the pictures, if there will be some."""
        from .export import axes_of
        from .report.pictures import cast_surface

        if self.folder is None or self.last < len(STAGES) - 1 or not self.recipe.output.views:
            return
        assert steps.surface is not None
        axes = axes_of(frame_of(self.scan, steps, self.recipe.output).axes)
        pool = ThreadPoolExecutor(max_workers=1)
        self.casts = pool.submit(cast_surface, steps.surface.mesh, axes)
        pool.shutdown(wait=False)


def _position(name: str | None, default: int) -> int:
    """Where a stage stands, by its name or an old one. Raises RecipeError for an unknown one."""
    if name is None:
        return default
    name = RENAMED_STAGES.get(name, name)
    if name not in STAGE_NAMES:
        raise RecipeError(f"there is no stage '{name}'", hint=f"stages are {', '.join(STAGE_NAMES)}")
    return STAGE_NAMES.index(name)


__all__ = [
    "STAGES",
    "STAGE_NAMES",
    "Result",
    "add_files",
    "finished",
    "fuse",
    "load_mesh",
    "plan",
    "summary",
    "write_result",
]
