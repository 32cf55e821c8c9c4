"""Is this recording usable, and how good is it? Findings for people, faults as exceptions, overlay pictures as arrays.

`verify` is quick and stops a run before it has cost anything; `check_scan` looks at more and never stops.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..geometry.camera import project
from ..geometry.rigid import rotation_angle_deg, transform_points
from ..physics.band import ZERO_DEGC_K
from ..physics.signal import SignalConverter
from ..robust import evenly
from ..types import BlackbodyReference, Camera, Float, Scan, Stream, ThermalStream, UInt8
from .overlay import OVERLAY_FRAMES, edge_overlays, looks_mirrored
from .pairing import nearest_in_time
from .thermal.units import looks_like

DEPTH_RANGE_M = (0.15, 9.0)  # a room's median depth lies inside, whatever the camera; outside, the unit is wrong
CONSTANT_FROM, CONSTANT_SHARE = 100, 0.99  # measured pixels, and the share of equal ones, that no camera makes
BODY_RANGE_M = (0.3, 4.5)  # where a body scan's median depth is expected
APPARENT_RANGE_DEGC = (-10.0, 80.0)  # the median of a frame with a body, or a phantom, in a room lies inside
MAX_REFERENCE_ERROR_K = 30.0  # of a camera on a blackbody: its level drifts by a few K, its emissivity costs a few more
MAX_BASELINE_M, MAX_ANGLE_DEG = 0.5, 45.0  # between cameras on one rig
MAX_OVERLAY_SHIFT_PX = 4.0  # a picture that fits better elsewhere by more is worth a warning
MIN_LEVELS, MAX_LEVELS = 100, 260  # of such a picture: a stretched scale is used
FILLED_SHARE = 0.001  # of the pixels at each end of the scale: what automatic gain clips
MOVED_SHARE = 0.5  # of the levels that the next picture has, too
MIN_OVERLAY_CONTRAST = 1.25  # below, the best shift says nothing

Severity = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One thing found. severity : `error` makes a scan unusable."""

    severity: Severity
    subject: str
    text: str


@dataclass(frozen=True)
class StreamFigures:
    """A stream in numbers. jitter_ms : 95th percentile of |step - median step|. longest_gap_s : largest step."""

    frames: int
    usable: int
    width_px: int
    height_px: int
    duration_s: float
    rate_hz: float | None
    jitter_ms: float | None
    longest_gap_s: float | None


@dataclass(frozen=True)
class CheckReport:
    """What `check_scan` found.

    missing : metadata that the recording does not state and that would make the result better.
    depth_coverage : share of pixels with depth, mean of the sampled frames. median_depth_m : of all sampled pixels.
    thermal_degC : 1st, 50th and 99th percentile of the sampled thermal frames, apparent.
    seen_by_thermal : share of the depth points that project into the thermal image.
    overlay_shift_px : by camera, (du, dv) that would bring depth edges best onto the image's edges, where it says
        anything.
    """

    name: str
    format: str
    findings: tuple[Finding, ...]
    streams: dict[str, StreamFigures]
    missing: tuple[str, ...]
    unusable: bool
    depth_coverage: float | None = None
    median_depth_m: float | None = None
    thermal_degC: tuple[float, float, float] | None = None
    seen_by_thermal: float | None = None
    overlay_shift_px: dict[str, tuple[float, float]] = field(default_factory=dict)

    def text(self) -> str:
        """The report in lines for people."""
        lines = [f"{self.name} ({self.format})"]
        for name, s in self.streams.items():
            rate = "" if s.rate_hz is None else f", {s.rate_hz:.2f} Hz, jitter {s.jitter_ms:.1f} ms"
            skipped = "" if s.usable == s.frames else f", {s.frames - s.usable} marked unusable"
            size = f"{s.width_px} x {s.height_px}"
            lines.append(f"  {name:<8} {s.frames} frames {size}, {s.duration_s:.2f} s{rate}{skipped}")
        sign = {"ok": "ok     ", "warning": "warning", "error": "ERROR  "}
        lines += [f"{sign[f.severity]}  {f.subject}: {f.text}" for f in self.findings]
        if self.missing:
            lines.append(f"not stated: {'; '.join(self.missing)}")
        return "\n".join(lines)


# ---------------------------------------------------------------- before a run


def verify(scan: Scan, sample: int = 3) -> None:
    """Find faults before work starts: `sample` frames of each stream are decoded, times and cameras compared.

    Raises ScanError with one sentence: a frame that cannot be decoded, a depth unit that looks wrong, no depth at all
    ("empty mask"), thermal values off their curve, streams without common time, cameras without a common view.
    """
    for fault in _faults(scan, sample):
        raise fault


def _faults(scan: Scan, sample: int) -> Iterator[ScanError]:
    """All faults that make a scan unusable, most basic first."""
    for step in (_time_faults, _depth_faults, _color_faults, _thermal_faults, _reference_faults):
        try:
            step(scan, sample)
        except ScanError as fault:
            yield fault


def _sample(stream: Stream, sample: int, *, usable_only: bool = True) -> list[int]:
    """Positions of `sample` frames from first to last."""
    rows = np.flatnonzero(stream.usable) if usable_only and stream.usable.any() else np.arange(len(stream))
    picks = evenly(len(rows), max(sample, 1))
    return rows[np.unique(picks)].tolist()


def _time_faults(scan: Scan, sample: int) -> None:
    t, thermal = scan.depth.times_s, scan.thermal
    slack = 1.0 if len(t) < 2 else 0.5 * float(np.median(np.diff(t))) + 1e-3
    others = {
        "colour": None if scan.color is None else scan.color.times_s,
        "thermal": None if thermal is None or thermal.camera.mount == "free" else thermal.depth_times_s,
        "trajectory": None if scan.trajectory is None else scan.trajectory.times_s,
    }
    for name, u in others.items():
        if u is not None and (u[0] > t[-1] + slack or u[-1] < t[0] - slack):
            raise ScanError(
                f"depth ({t[0]:.3f} to {t[-1]:.3f} s) and {name} ({u[0]:.3f} to {u[-1]:.3f} s) have no time in common",
                place=scan.root,
                hint="all streams must be on one clock",
            )


def _depth_faults(scan: Scan, sample: int) -> None:
    picks = _sample(scan.depth, sample)
    frames = [scan.depth.load(i) for i in picks]
    measured = np.concatenate([d[np.isfinite(d)] for d in frames])
    if measured.size == 0:
        raise ScanError(
            f"the depth mask is empty: none of {len(picks)} sampled frames has a single measurement",
            place=scan.depth.places[picks[0]],
        )
    for i, frame in zip(picks, frames, strict=True):
        if _is_constant(frame):
            value = float(np.nanmedian(frame))
            raise ScanError(
                f"the depth image is constant: nearly every pixel says {value:.4g} m",
                place=scan.depth.places[i],
                hint="record with the sensor uncovered, and raw depth instead of a test picture",
            )
    median = float(np.median(measured))
    if not DEPTH_RANGE_M[0] <= median <= DEPTH_RANGE_M[1]:
        raise ScanError(
            f"the depth unit looks wrong: with {scan.depth_unit_m:g} m a step the median depth is {median:.3g} m",
            place=scan.root,
            hint="set cameras.depth.depth_unit_m (0.001 for millimetres)",
        )
    if scan.thermal is not None and scan.thermal.camera.mount == "rig":
        camera = scan.thermal.camera
        seen = [_share_seen(d, scan.rig.depth, camera.lens, camera.T_thermal_depth) for d in frames]
        if max(seen) == 0:
            raise ScanError(
                "no depth point of the sampled frames projects into the thermal image: the cameras share no view",
                place=scan.root,
                hint="check extrinsics.T_thermal_depth and cameras.thermal.K",
            )


def _is_constant(image: NDArray) -> bool:
    """Whether nearly all that an image (H, W) measures is one value, which no camera's noise allows."""
    values = image[np.isfinite(image)]
    same = np.count_nonzero(values == np.median(values)) if len(values) else 0
    return bool(len(values) >= CONSTANT_FROM and same > CONSTANT_SHARE * len(values))


def _share_seen(depth: NDArray, camera: Camera, other: Camera, T_other_depth: Float, step: int = 8) -> float:
    """Share of the depth points (every `step`th pixel) that project into another camera's image."""
    v, u = np.mgrid[0 : depth.shape[0] : step, 0 : depth.shape[1] : step]
    z = depth[::step, ::step].astype(np.float64)
    K = camera.K
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=-1)
    points = points[np.isfinite(z)]
    if len(points) == 0:
        return 0.0
    uv, _ = project(other, transform_points(T_other_depth, points))
    with np.errstate(invalid="ignore"):
        inside = (uv >= 0).all(1) & (uv[:, 0] <= other.width_px - 1) & (uv[:, 1] <= other.height_px - 1)
    return float(inside.mean())


def _color_faults(scan: Scan, sample: int) -> None:
    if scan.color is not None:
        for i in _sample(scan.color, sample):
            scan.color.load(i)


def _thermal_faults(scan: Scan, sample: int) -> None:
    if scan.thermal is None:
        return
    if not scan.thermal.usable.any():
        raise ScanError("every thermal frame is marked as taken during a shutter correction", place=scan.root)
    convert = SignalConverter(scan.thermal.camera)
    picks, constant = _sample(scan.thermal, sample), 0
    if _automatic_gain([scan.thermal.load(i) for i in picks]):
        raise ScanError(
            "the thermal pictures were made for the eye: 256 grey levels that are stretched anew in every frame "
            "(automatic gain), so that no level stands for a temperature",
            place=scan.thermal.places[picks[0]],
            hint="record 14- or 16-bit radiometric counts, with automatic gain control off",
        )
    for i in picks:
        degC = _apparent_degC(scan.thermal, convert, i)
        constant += _is_constant(degC)
        if not np.isfinite(degC).any():
            raise ScanError("the thermal frame has no measurement at all", place=scan.thermal.places[i])
        unit = looks_like(degC if scan.thermal.camera.signal.kind == "counts" else scan.thermal.load(i))
        if unit is not None and scan.thermal.camera.signal.kind != "radiance":
            raise ScanError(
                f"the thermal values look like {unit[0]}, not degrees Celsius",
                place=scan.thermal.places[i],
                hint=f"check cameras.thermal.signal, or import the images again with {unit[1]}",
            )
        median = float(np.nanmedian(degC))
        if not APPARENT_RANGE_DEGC[0] <= median <= APPARENT_RANGE_DEGC[1]:
            raise ScanError(
                f"the thermal signal looks wrong: its median is {median:.0f} degC",
                place=scan.thermal.places[i],
                hint="check cameras.thermal.signal, and the byte order of the images",
            )
    if constant == len(picks):
        raise ScanError(
            f"the thermal image is constant: nearly every pixel says {median:.1f} degC",
            place=scan.thermal.places[picks[0]],
            hint="record with the shutter open and the lens uncovered",
        )


def _reference_faults(scan: Scan, sample: int) -> None:
    """A blackbody that the camera sees far from its stated temperature would shift the whole result there."""
    if scan.thermal is None:
        return
    convert = SignalConverter(scan.thermal.camera)
    for number, reference in enumerate(r for r in scan.references if isinstance(r, BlackbodyReference)):
        rows = np.flatnonzero(np.isin(scan.thermal.index, reference.frames) & scan.thermal.usable)
        if len(rows) == 0:
            raise ScanError(
                f"the blackbody reference {number} names no thermal frame that is there and usable",
                place=scan.root,
                hint="its `frames` are the thermal stream's `index`",
            )
        i = int(rows[len(rows) // 2])
        radiance = convert.radiance(scan.thermal.load(i), scan.thermal.places[i])
        inside = np.zeros(radiance.shape, np.uint8)
        cv2.fillPoly(inside, [np.rint(reference.polygon_px).astype(np.int32)], 1)
        measured = radiance[(inside > 0) & np.isfinite(radiance)]
        seen = float(np.median(convert.band.temperature_K(measured))) - ZERO_DEGC_K if len(measured) else np.nan
        if not abs(seen - reference.degC) <= MAX_REFERENCE_ERROR_K:
            raise ScanError(
                f"the blackbody of {reference.degC:g} degC is seen at {seen:.0f} degC",
                place=scan.thermal.places[i],
                hint="check references: degC, thermal_polygon_px and frames",
            )


def _automatic_gain(images: list[NDArray]) -> bool:
    """Whether pictures (H, W), counts or K, have no more than 256 levels and are stretched anew in every frame.

    Either both ends of the scale are filled in each of them, or the levels themselves move from frame to frame. A
    camera with eight bits and a scale that stands still does neither.
    """
    found = [np.unique(image[np.isfinite(image)], return_counts=True) for image in images]
    if len(found) < 2 or not all(MIN_LEVELS <= len(levels) <= MAX_LEVELS for levels, _ in found):
        return False
    filled = all(min(n[0], n[-1]) >= FILLED_SHARE * n.sum() for _, n in found)
    moved = [np.isin(a, b).mean() < MOVED_SHARE for (a, _), (b, _) in pairwise(found)]
    return filled or all(moved)


def _apparent_degC(stream: ThermalStream, convert: SignalConverter, i: int) -> Float:
    """Apparent temperature of every 4th pixel of a thermal frame."""
    radiance = convert.radiance(stream.load(i), stream.places[i])
    return convert.band.temperature_K(radiance[::4, ::4]) - ZERO_DEGC_K


# ---------------------------------------------------------------- the whole check


def check_scan(scan: Scan, sample: int = 9) -> CheckReport:
    """Look at a recording: rates, gaps, synchronisation, units, extrinsics, coverage, overlays, missing metadata.

    Never raises for a faulty scan: what `verify` would raise is a finding of severity `error`.
    """
    faults = list(_faults(scan, sample))
    findings = [Finding("error", f.place or "scan", f"{f.cause}{f'; {f.hint}' if f.hint else ''}") for f in faults]
    streams = {
        name: _figures(stream, camera)
        for name, stream, camera in (
            ("depth", scan.depth, scan.rig.depth),
            ("color", scan.color, scan.rig.color),
            ("thermal", scan.thermal, None if scan.thermal is None else scan.thermal.camera.lens),
        )
        if stream is not None and camera is not None
    }
    findings += _rate_findings(streams)
    findings += _sync_findings(scan)
    findings += _extrinsic_findings(scan)
    if scan.thermal is None:
        findings.append(Finding("warning", "thermal", "there is no thermal stream: geometry only"))
    findings += [Finding("warning", "reader", note) for note in scan.notes]
    figures: dict = {}
    if not faults:
        figures = _measure(scan, sample)
        findings += _figure_findings(figures)
        if looks_mirrored(scan):
            text = "depth is mirrored, left to right: its edges fit the other cameras' pictures only turned round"
            findings.append(Finding("warning", "mirror", f"{text}; import the recording with --mirrored"))
    if not any(f.severity == "error" for f in findings):
        findings.insert(0, Finding("ok", "scan", "every sampled frame decodes; units and times are plausible"))
    return CheckReport(
        name=scan.name,
        format=scan.format,
        findings=tuple(findings),
        streams=streams,
        missing=missing_metadata(scan),
        unusable=bool(faults),
        **figures,
    )


def overlays(scan: Scan, count: int = OVERLAY_FRAMES) -> dict[str, UInt8]:
    """Pictures (H, W, 3) uint8 by name: depth edges drawn over thermal and colour images of a few frames.

    Where the green lines leave the subject's outline, the rig is wrong (or the clock: then the sides of a moving view
    differ). Raises ScanError if a frame cannot be decoded.
    """
    return {o.name: o.picture for o in edge_overlays(scan, count)}


def missing_metadata(scan: Scan) -> tuple[str, ...]:
    """What the recording does not state and a quantitative result should."""
    e, told = scan.environment, () if scan.thermal is None else _told(scan.thermal)
    thermal, camera = scan.thermal is not None, None if scan.thermal is None else scan.thermal.camera
    entries = (
        (
            thermal and e.reflected_degC is None and "reflected_degC" not in told,
            "environment.reflected_degC (temperature of the surroundings)",
        ),
        (thermal and e.air_degC is None and "air_degC" not in told, "environment.air_degC"),
        (
            thermal and e.relative_humidity_pct is None and "relative_humidity_pct" not in told,
            "environment.relative_humidity_pct",
        ),
        (thermal and not scan.references, "references (without one the level is relative, not absolute)"),
        (camera is not None and camera.psf_sigma_px is None, "cameras.thermal.psf_sigma_px"),
        (scan.recorded_at is None, "recorded_at"),
        ("posture" not in scan.subject, "subject.posture"),
        ("acclimatisation_min" not in scan.subject, "subject.acclimatisation_min"),
    )
    return tuple(text for absent, text in entries if absent)


def _told(stream: ThermalStream) -> tuple[str, ...]:
    """What is stated of the frames, one by one."""
    return () if stream.conditions is None else tuple(stream.conditions.stated)


def _figures(stream: Stream, camera: Camera) -> StreamFigures:
    t = stream.times_s
    base = (len(stream), int(stream.usable.sum()), camera.width_px, camera.height_px, float(t[-1] - t[0]))
    if len(t) < 3:
        return StreamFigures(*base, None, None, None)
    step = np.diff(t)
    median = float(np.median(step))
    jitter = float(np.percentile(np.abs(step - median), 95)) * 1e3
    return StreamFigures(*base, 1 / median, jitter, float(step.max()))


def _rate_findings(streams: dict[str, StreamFigures]) -> list[Finding]:
    found = []
    for name, s in streams.items():
        if s.rate_hz is not None and s.longest_gap_s is not None and s.longest_gap_s * s.rate_hz > 3.5:
            lost = round(s.longest_gap_s * s.rate_hz) - 1
            found.append(Finding("warning", name, f"a gap of {s.longest_gap_s:.3f} s, about {lost} frames lost"))
    return found


def _sync_findings(scan: Scan) -> list[Finding]:
    found = []
    if scan.color is not None:
        slow, fast = sorted((scan.color.times_s, scan.depth.times_s), key=len)
        _, dt = nearest_in_time(slow, fast)
        away = np.median(np.abs(dt))
        severity: Severity = "ok" if away < 0.04 else "warning"
        text = f"nearest frame {away * 1e3:.1f} ms away (median), {np.abs(dt).max() * 1e3:.1f} ms at most"
        found.append(Finding(severity, "sync colour", text))
    if scan.thermal is not None and scan.thermal.camera.mount == "rig":
        t, offset = scan.thermal.depth_times_s, scan.thermal.camera.time_offset_s
        outside = int(((t < scan.depth.times_s[0] - 0.1) | (t > scan.depth.times_s[-1] + 0.1)).sum())
        if outside:
            found.append(Finding("warning", "sync thermal", f"{outside} of {len(t)} frames lie outside depth's time"))
        _, dt = nearest_in_time(t, scan.depth.times_s)
        away = np.median(np.abs(dt)) * 1e3
        text = f"nearest depth frame {away:.1f} ms away (median); clock offset {offset * 1e3:+.1f} ms"
        found.append(Finding("ok", "sync thermal", text))
    return found


def _extrinsic_findings(scan: Scan) -> list[Finding]:
    found = []
    camera = None if scan.thermal is None else scan.thermal.camera
    extrinsics = {"thermal": camera.T_thermal_depth} if camera is not None and camera.mount == "rig" else {}
    if camera is not None and camera.mount == "free":
        found.append(Finding("ok", "thermal mount", "free: every view is placed by the subject's outline"))
    if scan.rig.T_color_depth is not None:
        extrinsics["color"] = scan.rig.T_color_depth
    for name, T in extrinsics.items():
        baseline, angle = float(np.linalg.norm(T[:3, 3])), float(rotation_angle_deg(T))
        text = f"{baseline * 1e3:.0f} mm and {angle:.1f} deg from depth"
        odd = baseline > MAX_BASELINE_M or angle > MAX_ANGLE_DEG
        if name == "thermal" and np.abs(T - np.eye(4)).max() < 1e-9:
            odd, text = True, "T_thermal_depth is the identity: was it calibrated?"
        found.append(Finding("warning" if odd else "ok", f"extrinsic {name}", text))
    return found


def _measure(scan: Scan, sample: int) -> dict:
    """The report's figures from sampled frames."""
    picks = _sample(scan.depth, sample)
    depth = [scan.depth.load(i) for i in picks]
    measured = np.concatenate([d[np.isfinite(d)] for d in depth])
    out: dict = {
        "depth_coverage": float(np.mean([np.isfinite(d).mean() for d in depth])),
        "median_depth_m": float(np.median(measured)),
    }
    if scan.thermal is not None:
        camera, convert = scan.thermal.camera, SignalConverter(scan.thermal.camera)
        degC = np.stack([_apparent_degC(scan.thermal, convert, i) for i in _sample(scan.thermal, sample)])
        out["thermal_degC"] = tuple(float(x) for x in np.nanpercentile(degC, [1, 50, 99]))
        if camera.mount == "rig":
            seen = [_share_seen(d, scan.rig.depth, camera.lens, camera.T_thermal_depth) for d in depth]
            out["seen_by_thermal"] = float(np.mean(seen))
    shifts: dict[str, list[tuple[float, float]]] = {}
    for o in edge_overlays(scan, OVERLAY_FRAMES):
        if o.contrast >= MIN_OVERLAY_CONTRAST:
            shifts.setdefault(o.camera, []).append(o.shift_px)
    medians = {name: np.median(np.array(s), axis=0) for name, s in shifts.items()}
    out["overlay_shift_px"] = {name: (float(m[0]), float(m[1])) for name, m in medians.items()}
    return out


def _figure_findings(figures: dict) -> list[Finding]:
    found = []
    median, coverage = figures["median_depth_m"], figures["depth_coverage"]
    odd = not BODY_RANGE_M[0] <= median <= BODY_RANGE_M[1]
    text = f"median {median:.2f} m, {coverage:.0%} of the pixels measured"
    found.append(Finding("warning" if odd or coverage < 0.05 else "ok", "depth", text))
    if "thermal_degC" in figures:
        lo, mid, hi = figures["thermal_degC"]
        text = f"{lo:.1f} to {hi:.1f} degC apparent (median {mid:.1f})"
        found.append(Finding("ok" if hi < 60 and lo > 0 else "warning", "thermal", text))
    if "seen_by_thermal" in figures:
        seen = figures["seen_by_thermal"]
        text = f"{seen:.0%} of the depth points lie in the thermal view"
        found.append(Finding("ok" if seen > 0.2 else "warning", "view", text))
    for name, (du, dv) in figures["overlay_shift_px"].items():
        odd = np.hypot(du, dv) > MAX_OVERLAY_SHIFT_PX
        text = f"depth edges fit the {name} image best when shifted by ({du:+.0f}, {dv:+.0f}) px"
        found.append(Finding("warning" if odd else "ok", f"overlay {name}", text))
    return found
