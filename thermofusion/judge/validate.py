"""How good is a result without truth: leave views out and predict them, and tell the map's own error from its halves.

Two questions, two answers. *Does the model explain what the camera read?* Views are left out in interleaved folds; the
rest is calibrated and blended; each left-out reading is predicted through the forward model of `crosscal` (the point
spread is in both: the map is made of readings spread alike). The view's own offset cannot be known from other views: it
is estimated as one robust number. What is left is mostly pixel noise, which the map does not have. *How far is the map
from the truth?* See `maperror` and docs/validation.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import RecipeError, ScanError
from ..files.json import plain, to_json
from ..files.whole import write_text
from ..progress import Progress, silent
from ..recipe import Recipe
from ..robust import Statistics, mad_sigma
from ..temperature.uncertainty import BILINEAR_VARIANCE
from ..types import Scan
from ..version import __version__
from .leftout import WELL_SEEN_DEG, Bench, LeftOut
from .limits import gain_limit, limits
from .maperror import DECLARED, MapError, map_error

if TYPE_CHECKING:
    from ..pipeline import Result

ANGLE_BINS_DEG = ((0, 20), (20, 40), (40, 60), (60, 90))
SAMPLE = 16_000  # vertices: statistics settle to a few percent of themselves
MOTION_GAIN = 0.005  # share by which the left-out residual must fall before corrections of views are preferred


@dataclass(frozen=True)
class MotionVerdict:
    """Whether rigid corrections of single views predict left-out views better: RMSE with and without them."""

    rms_without_K: float
    rms_with_K: float
    median_mm: float
    preferred: bool

    def text(self) -> str:
        """For people."""
        return (
            f"corrections of single views ({self.median_mm:.1f} mm) change the left-out RMSE from "
            f"{self.rms_without_K:.4f} to {self.rms_with_K:.4f} K: {'' if self.preferred else 'not '}preferred"
        )


@dataclass(frozen=True)
class ValidationReport:
    """What `validate` found. by_angle : left-out readings by viewing angle, keys like "0-20". noise_K : of one sampled
    reading; beyond_noise_K : robust RMS of left-out residuals under 60° less that noise.
    map_error, motion : None where they cannot be had; messages say why. gain_limit : share by which the camera's gain
    may be off before the map's expected MAE is a fifth too small.
    """

    scan: str
    recipe: str
    method: str
    folds: int
    views: int
    vertices: int
    overall: Statistics
    by_angle: dict[str, Statistics]
    noise_K: float
    beyond_noise_K: float
    map_error: MapError | None
    motion: MotionVerdict | None = None
    messages: tuple[str, ...] = ()
    gain_limit: float = float("nan")

    def document(self) -> dict[str, Any]:
        """The content of `validation.json`."""
        return {"software": f"thermofusion {__version__}", **plain(self)}

    def text(self) -> str:
        """For people."""
        lines = [
            f"left out     {self.views} views in {self.folds} folds, {self.vertices:,} vertices, method {self.method}; "
            "measured minus predicted, K:",
            "             angle         n     bias     MAE    RMSE     p95   within 95 %",
        ]
        rows = {**{f"{k}°": s for k, s in self.by_angle.items()}, "all": self.overall}
        lines += [
            f"             {k:<7}{s.n:>8,} {s.bias_K:>+8.4f} {s.mae_K:>7.4f} {s.rmse_K:>7.4f} {s.p95_K:>7.4f}"
            f"   {s.within_95:>6.1%}"
            for k, s in rows.items()
            if s.n
        ]
        lines.append(f"             pixel noise {self.noise_K:.4f} K; beyond it {self.beyond_noise_K:.4f} K under 60°")
        lines += [] if self.map_error is None else _map_lines(self.map_error)
        if np.isfinite(self.gain_limit):
            lines.append(
                f"             a gain off by more than {self.gain_limit:.1%} makes it larger by a fifth, unseen"
            )
        lines += [] if self.motion is None else [f"motion       {self.motion.text()}"]
        return "\n".join([*lines, *(f"note         {m}" for m in self.messages)])


def _map_lines(m: MapError) -> list[str]:
    e = m.error
    return [
        f"the map      expected relative error: MAE {e.mae_K:.4f} K, RMSE {e.rmse_K:.4f} K, p95 {e.p95_K:.4f} K,",
        f"             where two views saw the surface under 60°; {e.within_95:.1%} inside the stated 95 % interval",
        f"             (rms of error over sigma {m.sigma_ratio:.2f}). Of it, RMSE: "
        f"{m.random.rmse_K:.4f} K between halves",
        f"             of the views ({m.halvings} cuts, arcs of {m.arc_views}, {m.coverage:.0%} seen by both); "
        f"{m.spread_rms_K:.4f} K",
        f"             point spread; {m.declared_rms_K:.4f} K air, ε and reflection, as declared",
    ]


def validate(
    scan: Scan,
    recipe: Recipe,
    *,
    out: Path | str | None = None,
    folds: int = 5,
    motion: bool = True,
    progress: Progress = silent,
) -> ValidationReport:
    """Run (or reuse what `out` holds), then leave views out.

    Parameters
    ----------
    out : result folder, as of `pipeline.fuse`; `validation.json` is written there. folds : parts of the views.
    motion : also try rigid corrections of single views and say whether they predict better.

    Raises ScanError where there are too few thermal views, and what `fuse` raises.
    """
    from ..pipeline import fuse

    if folds < 2:
        raise RecipeError(f"views are left out in at least 2 folds, got {folds}")
    if scan.thermal is None:
        raise ScanError("the scan has no thermal stream: there are no views to leave out", place=scan.root)
    step = progress
    report = validate_result(
        scan, recipe, fuse(scan, recipe, out=out, progress=step), folds=folds, motion=motion, progress=step
    )
    if out is not None:
        write_text(Path(out) / "validation.json", to_json(report.document()))
    return report


def validate_result(
    scan: Scan,
    recipe: Recipe,
    result: Result,
    *,
    folds: int = 5,
    motion: bool = True,
    sample: int = SAMPLE,
    progress: Progress = silent,
) -> ValidationReport:
    """`validate` of a result that was run to its end."""
    assert result.surface is not None
    assert result.mapped is not None
    assert result.temperature is not None
    assert scan.thermal is not None
    mesh, step = result.temperature.mesh, progress
    dense = Bench.of(scan, result.surface, result.mapped, result.temperature, recipe)
    bench = dense.sample(sample)
    left = bench.predictions(folds, step)
    notes: list[str] = []
    psf_px = bench.problem.errors.psf_sigma_px
    if scan.thermal.camera.psf_sigma_px is None:
        notes.append(f"the thermal camera's point spread is not known: {psf_px} px assumed")
    error = None
    step("half maps", 0, 1)
    try:
        shared = (*DECLARED, *(("scale",) if result.mapped.depth_scale else ()))
        error = map_error(bench, dense, mesh.surface, mesh.uncertainty_K, psf_px, shared)
        notes += limits(result.report.get("diagnosis", ()), error)
    except ScanError as fault:
        notes.append(f"the map's own error cannot be told from halves of the views: {fault.cause}")
    step("half maps", 1, 1)
    report = _report(scan, bench, left, folds, error, tuple(notes), recipe.name)
    solved = result.temperature.calibration
    if error is not None and solved is not None and solved.gain == 1:
        report = replace(report, gain_limit=gain_limit(error, mesh.temperature_degC))
    return _with_motion(scan, result, report, recipe, folds, step) if motion else report


def _report(
    scan: Scan,
    bench: Bench,
    left: LeftOut,
    folds: int,
    error: MapError | None,
    notes: tuple[str, ...],
    recipe: str,
) -> ValidationReport:
    bins = {
        f"{lo}-{hi}" if hi < 90 else f"{lo}+": (left.angle_deg >= lo) & (left.angle_deg < hi)
        for lo, hi in ANGLE_BINS_DEG
    }
    noise_K = bench.problem.errors.netd_K * float(np.sqrt(BILINEAR_VARIANCE))
    robust = mad_sigma(left.residual_K[left.angle_deg < WELL_SEEN_DEG])
    return ValidationReport(
        scan=scan.name,
        recipe=recipe,
        method=bench.problem.settings.method,
        folds=min(folds, len(bench.problem.seen_views)),
        views=len(np.unique(left.view)),
        vertices=len(bench),
        overall=Statistics.of(left.residual_K, left.sigma_K),
        by_angle={k: Statistics.of(left.residual_K[m], left.sigma_K[m]) for k, m in bins.items()},
        noise_K=noise_K,
        beyond_noise_K=float(np.sqrt(max(robust**2 - noise_K**2, 0.0))),
        map_error=error,
        messages=notes,
    )


def _with_motion(
    scan: Scan, result: Result, report: ValidationReport, recipe: Recipe, folds: int, progress: Progress
) -> ValidationReport:
    """Left-out residual with every view's pose corrected by its outline, against `report`'s without."""
    from ..mapping.corrections import view_corrections
    from ..mapping.observe import SurfaceRays, observe_views
    from ..physics.signal import SignalConverter

    assert result.surface is not None
    assert result.rig is not None
    assert result.mapped is not None
    assert result.temperature is not None
    assert scan.thermal is not None
    surface, mapped, camera = result.surface.mesh, result.mapped, result.rig.camera
    motion = view_corrections(
        scan.thermal, surface, mapped.views, result.rig.outline_width_px, result.surface.motion, progress=progress
    )
    report = replace(report, messages=(*report.messages, *motion.messages))
    if not motion.kept:
        return report
    views = replace(mapped.views, T_world_thermal=motion.T_world_thermal)
    converter = SignalConverter(camera, scatter=mapped.scatter)
    rays = SurfaceRays(surface, result.surface.motion)
    rows = observe_views(scan.thermal, rays, views, converter, recipe.mapping)
    moved = replace(mapped, views=views, observations=rows)
    bench = Bench.of(scan, result.surface, moved, result.temperature, recipe)
    left = bench.sample(report.vertices).predictions(folds, progress)
    before, after = report.overall.rmse_K, Statistics.of(left.residual_K).rmse_K
    preferred = after < (1 - MOTION_GAIN) * before
    return replace(report, motion=MotionVerdict(before, after, float(np.median(motion.correction_mm)), preferred))
