"""`result.json`: what was done, with which numbers, and how sure it is; and a few lines of it for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..geometry.rigid import invert, rotation_angle_deg
from ..recipe import Recipe
from ..types import Scan, VertexFlag
from ..version import __version__

if TYPE_CHECKING:
    from ..pipeline import Result
    from ..rig.align import AlignmentResult
    from ..surface.surface import SurfaceResult
    from ..temperature.solve import Seen, Temperature
    from ..tracking.track import TrackingResult

PERCENTILES = (1, 5, 50, 95, 99)


def result_report(
    scan: Scan,
    recipe: Recipe,
    tracking: TrackingResult,
    surface: SurfaceResult | None,
    alignment: AlignmentResult | None,
    seen: Seen | None,
    temperature: Temperature | None,
    reused: Sequence[str],
) -> dict[str, Any]:
    """The content of `result.json`; groups of stages that did not run are absent."""
    report: dict[str, Any] = {
        "thermofusion": __version__,
        "scan": _scan(scan),
        "recipe": recipe.name,
        "tracking": _tracking(tracking),
    }
    messages = [*scan.notes, *tracking.messages]
    if surface is not None:
        report["surface"] = _surface(surface)
        messages += surface.messages
    if alignment is not None:
        report["alignment"] = _alignment(scan, alignment)
        messages += alignment.messages
    if seen is not None:
        report["views"] = {
            "used": len(seen.views),
            "left_out": seen.left_out,
            "observations": len(seen.observations),
            "blackbody_readings": len(seen.blackbodies),
        }
        if seen.motion is not None:
            m = seen.motion
            kept = {
                "kept": m.kept,
                "residual_px_before": m.residual_px_before,
                "residual_px_after": m.residual_px_after,
            }
            report["views"]["motion"] = {**kept, "correction_mm": m.correction_mm}
            messages += m.messages
    if temperature is not None:
        report["temperature"] = _temperature(temperature)
        messages += temperature.messages
    report["quality"] = _quality(recipe, scan, tracking, temperature)
    report["messages"] = messages
    report["stages_reused"] = list(reused)
    return report


def summary(result: Result, out: Path | None) -> str:
    """A few lines for the terminal."""
    r = result.report
    lines = []
    t = r["tracking"]
    lines.append(
        f"tracking     {t['tracked']} of {t['frames']} depth frames ({t['source']}), {len(t['lost'])} lost ranges"
    )
    if "surface" in r:
        s = r["surface"]
        lines.append(
            f"surface      {s['vertices']:,} vertices, voxel {s['voxel_mm']:.1f} mm, grid {s['memory_gib']:.2f} GiB"
        )
    if "alignment" in r:
        a = r["alignment"]
        if a["changed"]:
            change = f"rig turned {a['rotation_deg']:.2f}°, clock {a['time_offset_s'] * 1e3:+.0f} ms"
        else:
            change = "rig left as it was"
        lines.append(f"alignment    {change}; outline residual {_number(a['residual_px_after'])} px")
    if "views" in r:
        v = r["views"]
        lines.append(f"mapping      {v['used']} thermal views, {v['observations']:,} observations")
    if "temperature" in r:
        t = r["temperature"]
        level = "anchored" if t["anchored"] else "RELATIVE: no reference set the level"
        lines.append(
            f"temperature  {t['mode']}, {level}; median {_number(t['percentiles_degC']['50'])} °C, "
            f"median sigma {_number(t['median_sigma_K'], 3)} K, {t['coverage']:.1%} of the surface"
        )
    lines += [f"note         {m}" for m in r["messages"]]
    lines += [f"BELOW GATE   {m}" for m in r["quality"]["failed"]]
    if out is not None:
        lines.append(f"written to   {out}")
    return "\n".join(lines)


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _scan(scan: Scan) -> dict[str, Any]:
    streams = {n: len(s) for n in ("depth", "color", "thermal") if (s := getattr(scan, n)) is not None}
    return {"name": scan.name, "format": scan.format, "recorded_at": scan.recorded_at, "frames": streams}


def _tracking(t: TrackingResult) -> dict[str, Any]:
    return {
        "source": t.source,
        "frames": len(t.tracked),
        "tracked": int(t.tracked.sum()),
        "lost": [vars(x) if hasattr(x, "__dict__") else x for x in t.lost],
        "loop_closures": t.loop_closures,
        "converged": t.converged,
        "median_residual_mm": float(np.nanmedian(t.residual_mm)) if np.isfinite(t.residual_mm).any() else None,
    }


def _surface(s: SurfaceResult) -> dict[str, Any]:
    extent = np.ptp(s.mesh.vertices_m, axis=0)
    return {
        "vertices": len(s.mesh),
        "triangles": len(s.mesh.triangles),
        "voxel_mm": s.voxel_m * 1e3,
        "depth_noise_mm_at_1m": s.noise_m_at_1m * 1e3,
        "memory_gib": s.memory_gib,
        "frames_used": s.frames_used,
        "extent_m": extent,
        "floor_plane": s.floor_plane,
        "removed": s.removed,
    }


def _alignment(scan: Scan, a: AlignmentResult) -> dict[str, Any]:
    start = None if scan.thermal is None else scan.thermal.camera.T_thermal_depth
    return {
        "changed": a.changed,
        "converged": a.converged,
        "T_thermal_depth": a.T_thermal_depth,
        "rotation_deg": 0.0 if start is None else float(rotation_angle_deg(a.T_thermal_depth @ invert(start))),
        "time_offset_s": a.time_offset_s,
        "residual_px_before": a.residual_px_before,
        "residual_px_after": a.residual_px_after,
        "sigma_rotation_deg": a.sigma_rotation_deg,
        "sigma_translation_mm": a.sigma_translation_mm,
        "sigma_time_s": a.sigma_time_s,
        "views_used": a.views_used,
    }


def _temperature(t: Temperature) -> dict[str, Any]:
    mesh = t.mesh
    T, ok = mesh.temperature_degC, mesh.measured
    flags = {
        flag.name.lower(): float(((mesh.flags & flag) != 0).mean()) for flag in VertexFlag if flag.name is not None
    }
    return {
        "mode": mesh.mode,
        "anchored": mesh.anchored,
        "coverage": float(ok.mean()),
        "percentiles_degC": {str(p): float(np.percentile(T[ok], p)) if ok.any() else None for p in PERCENTILES},
        "median_sigma_K": float(np.nanmedian(mesh.uncertainty_K)) if np.isfinite(mesh.uncertainty_K).any() else None,
        "level_sigma_K": t.level_sigma_K,
        "flags": flags,
        "crosscal": t.crosscal,
        "methods": t.methods,
    }


def _quality(recipe: Recipe, scan: Scan, tracking: TrackingResult, temperature: Temperature | None) -> dict[str, Any]:
    """The recipe's gate: each figure, its bound, and what failed."""
    gate, failed = recipe.quality, []
    tracked = float(tracking.tracked.mean())
    if tracked < gate.min_tracked_fraction:
        failed.append(f"{tracked:.0%} of the depth frames are tracked, the recipe asks {gate.min_tracked_fraction:.0%}")
    figures: dict[str, Any] = {"tracked_fraction": tracked}
    if temperature is not None and scan.thermal is not None:
        mesh = temperature.mesh
        coverage = float(mesh.measured.mean())
        sigma = float(np.nanmedian(mesh.uncertainty_K)) if np.isfinite(mesh.uncertainty_K).any() else float("nan")
        figures |= {"coverage": coverage, "median_sigma_K": sigma}
        if coverage < gate.min_coverage:
            failed.append(f"{coverage:.0%} of the surface has a temperature, the recipe asks {gate.min_coverage:.0%}")
        if not sigma <= gate.max_median_sigma_K:
            failed.append(f"the median sigma is {sigma:.2f} K, the recipe allows {gate.max_median_sigma_K:.2f} K")
    return {**figures, "failed": failed}
