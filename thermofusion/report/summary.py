"""`result.json`: what was done, with which numbers, and how sure it is; and a few lines of it for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..diagnosis import Diagnosis, diagnose, of_knocks, of_poses
from ..errors import counted
from ..export.palettes import beyond_range
from ..geometry.rigid import invert, rotation_angle_deg
from ..recipe import Recipe
from ..types import LensScatter, Scan, VertexFlag
from ..version import __version__
from .metadata import radiometric_numbers, stated

if TYPE_CHECKING:
    from ..mapping.observe import Mapped
    from ..motion.body import BodyMotion
    from ..rig.align import RigResult
    from ..rig.free.place import FreeViews
    from ..rig.knock import Knocks
    from ..surface.surface import SurfaceResult
    from ..temperature.solve import Temperature
    from ..tracking.track import TrackingResult

PAGE = "report.html"  # in a result's folder
PERCENTILES = (1, 5, 50, 95, 99)
MOST_RANGES = 4  # stretches of too much motion that are named
MOST_MOVED = 3  # parts that the summary names
WORST = 3  # diagnoses that the summary prints
FAULT_OVER_SIGMA = 3.0  # of the gate's median sigma: a fault beyond it makes the result doubtful


@dataclass(frozen=True, eq=False)
class Steps:
    """What the steps of a run found; None: not needed, or not reached."""

    tracking: TrackingResult
    surface: SurfaceResult | None = None
    rig: RigResult | None = None
    mapped: Mapped | None = None
    temperature: Temperature | None = None


def result_report(scan: Scan, recipe: Recipe, steps: Steps, reused: Sequence[str]) -> dict[str, Any]:
    """The content of `result.json`; groups of stages that did not run are absent."""
    report: dict[str, Any] = {
        "thermofusion": __version__,
        "scan": _scan(scan),
        "recipe": recipe.name,
        "tracking": _tracking(steps.tracking),
    }
    messages = [*scan.notes, *steps.tracking.messages]
    if steps.surface is not None:
        report["surface"] = _surface(steps.surface)
        report["motion"] = _motion(steps.surface.motion)
        messages += steps.surface.messages
    if steps.rig is not None:
        report["rig"] = _rig(scan, steps.rig)
        messages += steps.rig.messages
    if steps.mapped is not None:
        report["mapping"] = _mapping(steps.mapped)
        messages += () if steps.mapped.motion is None else steps.mapped.motion.messages
    if steps.temperature is not None:
        report["temperature"] = _temperature(steps.temperature)
        messages += steps.temperature.messages
    if steps.temperature is not None and recipe.output.range_degC is not None:
        out = beyond_range(steps.temperature.mesh.temperature_degC, *recipe.output.range_degC)
        messages += [f"{out}: `thermofusion export RESULT` draws them again in colours that fit"] if out else []
    if scan.thermal is not None:
        inputs = () if steps.temperature is None else steps.temperature.inputs
        report["radiometry"] = radiometric_numbers(scan, recipe.temperature, inputs)
        report["band_um"] = scan.thermal.camera.band_um
    report["metadata"] = stated(scan, _answered(recipe, steps))
    diagnosis = _diagnosis(scan, steps)
    if diagnosis is not None:
        report["diagnosis"] = [vars(d) for d in diagnosis]
    report["quality"] = _quality(recipe, scan, steps)
    report["quality"]["failed"] += _too_large(recipe, diagnosis or ())
    report["messages"] = messages
    report["stages_reused"] = list(reused)
    return report


def _answered(recipe: Recipe, steps: Steps) -> dict[str, str]:
    """What the result itself says of how it was recorded."""
    emissivity = recipe.temperature.emissivity
    known = {"recording.emissivity": f"{emissivity.model}, corrected with the viewing angle"}
    if steps.temperature is not None and steps.temperature.mesh.measured.any():
        mesh = steps.temperature.mesh
        near, far = np.nanpercentile(mesh.distance_m, (5, 95))
        known["recording.distance"] = f"{near:.2f} to {far:.2f} m from the skin"
        known["recording.angle"] = f"best view of each spot: median {np.nanmedian(mesh.view_angle_deg):.0f}°"
    return known


def summary(report: Mapping[str, Any], out: Path | None) -> str:
    """A few lines for the terminal, in words that need no manual."""
    r = report
    lines = [f"camera path  {_path(r['tracking'])}"]
    if "surface" in r:
        lines.append(f"surface      {r['surface']['vertices']:,} vertices, {r['surface']['voxel_mm']:.1f} mm apart")
    if r.get("motion", {}).get("moved"):
        lines.append(f"motion       {_motion_line(r['motion'])}")
    if "rig" in r:
        lines.append(f"rig          {_rig_line(r['rig'])}")
    if "mapping" in r:
        left = ", ".join(f"{n} ({why})" for why, n in r["mapping"]["left_out"].items() if n)
        lines.append(
            f"thermal      {counted(r['mapping']['used'], 'frame')} used{f'; left out: {left}' if left else ''}"
        )
    if "temperature" in r:
        lines += _temperature_lines(r["temperature"])
    lines += [f"diagnosis    {Diagnosis(**d).line()}" for d in r.get("diagnosis", [])[:WORST]]
    lines += [f"note         {m}" for m in r["messages"]]
    lines += [f"BELOW GATE   {m}" for m in r["quality"]["failed"]]
    if out is not None:
        lines.append(f"written to   {out}")
        if (out / PAGE).is_file():
            lines.append(f"look at      {out / PAGE}")
    return "\n".join(lines)


def _path(t: Mapping[str, Any]) -> str:
    found = "as recorded" if t["source"] == "recorded" else "estimated from the depth frames"
    if t["tracked"] == t["frames"]:
        return f"{found}: {counted(t['frames'], 'frame')}"
    return f"{found}: {t['tracked']} of {counted(t['frames'], 'frame')}; the others are left out"


def _rig_line(a: Mapping[str, Any]) -> str:
    fit = a["residual_px_after"]
    if a.get("mount") == "free":
        size = f"{a['sigma_translation_mm']:.1f} mm, {a['sigma_rotation_deg']:.2f}°"
        return f"thermal camera by itself: {counted(a['views_used'], 'view')} placed to {size} (one sigma, median)"
    fits = "" if fit is None or not np.isfinite(fit) else f"; outlines fit to {fit:.2f} px"
    if knocks := a.get("knocks"):
        frames = ", ".join(str(k["index"]) for k in knocks)
        return f"the thermal camera was knocked: a rig of its own from thermal frame {frames} on{fits}"
    if not a["changed"]:
        return f"the thermal camera stays where the recording says{fits}"
    return f"thermal camera turned by {a['rotation_deg']:.2f}°, clock {a['time_offset_s'] * 1e3:+.0f} ms{fits}"


def _temperature_lines(t: Mapping[str, Any]) -> list[str]:
    """What is known of the skin's temperature, and what is not; nothing where nothing was measured."""
    low, middle, high = (t["percentiles_degC"][p] for p in ("1", "50", "99"))
    if middle is None:
        return []
    covered = f"{t['coverage']:.0%} of the surface measured"
    sigma = t["median_sigma_K"]
    between = "" if sigma is None or not np.isfinite(sigma) else f", sigma {sigma:.3f} K between places"
    head = f"median {middle:.2f} °C, 98 % within {low:.2f} to {high:.2f} °C{between}; {covered}"
    if t["mode"] == "apparent":
        return [f"apparent     {head}", "level        the camera's own: nothing is corrected"]
    name = "skin        " if t["mode"] == "absolute" else "straight on "
    if not t["anchored"]:
        known = "unknown: no reference set it. Differences on the body hold, °C as such do not"
        return [f"{name} {head}", f"level        {known}"]
    total = float(np.hypot.reduce([s for s in t["level_sigma_K"].values() if s is not None and np.isfinite(s)]))
    return [f"{name} {head}", f"level        set by a reference, to ±{total:.2f} K"]


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


def _motion(m: BodyMotion | None) -> dict[str, Any]:
    """How the subject moved while it was recorded."""
    if m is None:
        return {"moved": False, "parts": []}
    return {
        "moved": True,
        "parts": [vars(p) for p in m.parts],
        "median_mm": float(np.median(m.moved_mm)),
        "p95_mm": float(np.percentile(m.moved_mm, 95)),
        "unsettled_fraction": float(m.unsettled.mean()),
        "left_out_before": m.left_out_before,
        "left_out_after": m.left_out_after,
        "nodes": len(m.field.node_m),
        "knots": len(m.field.knot_s),
        "too_much_s": m.too_much,
    }


def _motion_line(m: Mapping[str, Any]) -> str:
    """The parts that moved most, in words; of a subject that is not seen whole, how much its surface moved."""
    if len(m["parts"]) < MOST_MOVED:
        return (
            f"the subject moved against its trunk and was brought to rest: half of it by {m['median_mm']:.1f} mm, "
            f"a twentieth by more than {m['p95_mm']:.1f} mm (rms)"
        )
    most = sorted(m["parts"], key=lambda p: -p["rms_mm"])[:MOST_MOVED]
    parts = ", ".join(f"{p['name']} {p['rms_mm']:.0f} mm" for p in most)
    return f"the subject moved against its trunk and was brought to rest: {parts} (rms)"


def _rig(scan: Scan, a: RigResult) -> dict[str, Any]:
    if a.free is not None:
        return _free(scan, a, a.free)
    T = a.camera.T_thermal_depth
    start = T if scan.thermal is None else scan.thermal.camera.T_thermal_depth
    return {
        "changed": a.changed,
        "converged": a.converged,
        "T_thermal_depth": T,
        "rotation_deg": float(rotation_angle_deg(T @ invert(start))),
        "time_offset_s": a.camera.time_offset_s,
        "residual_px_before": a.residual_px_before,
        "residual_px_after": a.residual_px_after,
        "sigma_rotation_deg": a.sigma_rotation_deg,
        "sigma_translation_mm": a.sigma_translation_mm,
        "sigma_time_s": a.sigma_time_s,
        "jitter_s": a.jitter_s,
        "knocks": None if a.knocks is None else _knocks(scan, a.knocks),
        "readout_s": None if a.readout is None else a.readout.readout_s,
        "views_used": a.views_used,
    }


def _knocks(scan: Scan, k: Knocks) -> list[dict[str, Any]]:
    """Each new stand of the thermal camera: its first frame, and what stands left of T_thermal_depth there."""
    index = np.zeros(0, np.int64) if scan.thermal is None else scan.thermal.index
    return [{"index": int(index[f]), "motion": T} for f, T in zip(k.frame, k.motion, strict=True)]


def _free(scan: Scan, a: RigResult, free: FreeViews) -> dict[str, Any]:
    """A camera that is not on the rig: every view's sigma in place of one rig's."""
    index = np.zeros(0, np.int64) if scan.thermal is None else scan.thermal.index
    return {
        "mount": "free",
        "changed": a.changed,
        "converged": a.converged,
        "residual_px_after": a.residual_px_after,
        "outline_width_px": a.outline_width_px,
        "sigma_rotation_deg": float(np.median(free.sigma_rotation_deg)),
        "sigma_translation_mm": float(np.median(free.sigma_translation_mm)),
        "views_used": a.views_used,
        "views": [
            {"index": int(i), "sigma_rotation_deg": float(r), "sigma_translation_mm": float(t)}
            for i, r, t in zip(index[free.frame], free.sigma_rotation_deg, free.sigma_translation_mm, strict=True)
        ],
        "not_placed": index[free.lost].tolist(),
    }


def _mapping(m: Mapped) -> dict[str, Any]:
    out = {
        "used": len(m.views),
        "left_out": m.left_out,
        "observations": len(m.observations),
        "blackbody_readings": len(m.blackbodies),
        "scatter": None if m.scatter is None else _scatter(m.scatter),
    }
    if m.motion is None:
        return out
    motion = {k: getattr(m.motion, k) for k in ("kept", "residual_px_before", "residual_px_after", "correction_mm")}
    return {**out, "motion": motion}


def _scatter(s: LensScatter) -> dict[str, Any]:
    return {"share": s.share, "sigma": s.sigma, "stated": s.stated, "differs": s.differs}


def _temperature(t: Temperature) -> dict[str, Any]:
    mesh = t.mesh
    T, ok = mesh.temperature_degC, mesh.measured & ((mesh.flags & VertexFlag.NOT_SKIN) == 0)
    flags = {
        flag.name.lower(): float(((mesh.flags & flag) != 0).mean()) for flag in VertexFlag if flag.name is not None
    }
    return {
        "mode": mesh.mode,
        "anchored": mesh.anchored,
        "coverage": float(mesh.measured.mean()),
        "percentiles_degC": {str(p): float(np.percentile(T[ok], p)) if ok.any() else None for p in PERCENTILES},
        "median_sigma_K": float(np.nanmedian(mesh.uncertainty_K)) if np.isfinite(mesh.uncertainty_K).any() else None,
        "level_sigma_K": t.level_sigma_K,
        "flags": flags,
        "crosscal": t.crosscal,
        "inputs": [vars(i) for i in t.inputs],
        "materials": t.materials,
        "room": {} if t.room is None else t.room.told(),
        "criticism": {} if t.calibration is None else t.calibration.criticism,
    }


def _diagnosis(scan: Scan, steps: Steps) -> tuple[Diagnosis, ...] | None:
    """What the data say against the model, poses first; None where no temperature was solved for and poses fit."""
    poses = of_poses(steps.tracking.faults)
    if steps.rig is not None and scan.thermal is not None:
        poses = (*poses, *of_knocks(steps.rig.knocks, scan.thermal.index))
    if steps.mapped is None or steps.temperature is None or scan.thermal is None:
        return poses or None
    lens = scan.thermal.camera.lens
    return (*poses, *diagnose(steps.mapped, steps.temperature, (lens.width_px, lens.height_px)))


def _too_large(recipe: Recipe, diagnosis: Sequence[Diagnosis]) -> list[str]:
    """Faults whose size is beyond what the recipe's median sigma can be believed with."""
    limit = FAULT_OVER_SIGMA * recipe.quality.max_median_sigma_K
    return [f"{d.what}: {d.size_K:.2f} K, more than {limit:.2f} K" for d in diagnosis if (d.size_K or 0.0) > limit]


def _moved_too_much(ranges: Sequence[tuple[float, float]]) -> list[str]:
    """One sentence for all stretches in which the subject's motion could not be followed."""
    if not ranges:
        return []
    when = ", ".join(f"between {start:.0f} s and {stop:.0f} s" for start, stop in ranges[:MOST_RANGES])
    more = f" and {len(ranges) - MOST_RANGES} times more" if len(ranges) > MOST_RANGES else ""
    return [f"the subject moved too much {when}{more}: what it looked like at rest is not known well"]


def _quality(recipe: Recipe, scan: Scan, steps: Steps) -> dict[str, Any]:
    """The recipe's gate: each figure, its bound, and what failed."""
    gate, asked_mm, failed = recipe.quality, recipe.surface.voxel_mm, []
    temperature, tracked = steps.temperature, float(steps.tracking.tracked.mean())
    voxel_mm = 0.0 if steps.surface is None else 1e3 * steps.surface.voxel_m
    if voxel_mm > max(gate.max_voxel_mm, 0.0 if asked_mm == "auto" else 1.01 * asked_mm):
        bound = f"max_memory_gib = {recipe.surface.max_memory_gib:g}"
        failed.append(f"voxels grew to {voxel_mm:.0f} mm to keep {bound}, the recipe allows {gate.max_voxel_mm:g} mm")
    if tracked < gate.min_tracked_fraction:
        failed.append(f"{tracked:.0%} of the depth frames are tracked, the recipe asks {gate.min_tracked_fraction:.0%}")
    figures: dict[str, Any] = {"tracked_fraction": tracked}
    if steps.surface is not None and steps.surface.motion is not None:
        failed += _moved_too_much(steps.surface.motion.too_much)
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
