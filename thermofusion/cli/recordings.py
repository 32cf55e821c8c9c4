"""Verbs that make scans: import, simulate."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import RecipeError, ScanError
from .console import emit, note, progress
from .options import Json, spelled_out

if TYPE_CHECKING:
    from ..scans.thermal import ThermalFrames, ThermalSaid
    from ..types import Scan, SignalCurve

Force = Annotated[bool, typer.Option("--overwrite", help="Replace an existing scan folder.")]


UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
LARGEST_STEP_M = 0.1  # that scan.json takes


@dataclass(frozen=True)
class DepthOptions:
    """What a person says of the depth recording."""

    format: Annotated[str | None, typer.Option(help="Format of the recording; recognised by default.")] = None
    rig: Annotated[Path | None, typer.Option(help="rig.json with the cameras; with --thermal: its thermal camera.")] = (
        None
    )
    depth_unit: Annotated[
        str | None, typer.Option(help="Of the stored depth: mm, cm, m, or metres a step, 0.001 = mm.")
    ] = None
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of depth images without a header.")] = None
    mirrored: Annotated[bool, typer.Option("--mirrored", help="Depth and colour are as in a mirror.")] = False


@dataclass(frozen=True)
class ThermalOptions:
    """Thermal frames recorded apart, and what a person says of them."""

    thermal: Annotated[Path | None, typer.Option(help="Thermal file, or folder of them, to add.")] = None
    times: Annotated[
        Path | None, typer.Option(help="List of times in s, rows name,time_s: of --thermal's frames, else of depth's.")
    ] = None
    fps: Annotated[float | None, typer.Option(help="Thermal frames a second, where nothing states times.")] = None
    clock_offset: Annotated[
        str | None, typer.Option(help="Seconds added to thermal's times, or auto: found from what moves in both.")
    ] = None
    free: Annotated[
        bool, typer.Option("--free", help="The thermal camera is not on the depth rig: held by itself, or on a stand.")
    ] = False
    gain: Annotated[float | None, typer.Option(help="degC = gain * stored value + offset.")] = None
    offset_degC: Annotated[float | None, typer.Option("--offset-degC", help="See --gain.")] = None
    curve: Annotated[Path | None, typer.Option(help="JSON of a signal's curve (docs/scan-format.md).")] = None
    band: Annotated[str | None, typer.Option(help="LOW-HIGH in um: the camera's wavelengths, 7.5-13.5.")] = None


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.command("import")(spelled_out(import_))
    app.command()(simulate)


def import_(
    recording: Annotated[Path, typer.Argument(help="A foreign recording.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Scan folder to write.")],
    depth: DepthOptions,
    added: ThermalOptions,
    overwrite: Force = False,
    json: Json = False,
) -> None:
    """Write a foreign recording in the native scan form, with thermal frames that were recorded apart."""
    from ..scans import Stated, open_scan
    from ..scans.native.write import write_scan

    if added.thermal is not None and depth.rig is None:
        raise RecipeError(
            "--thermal needs --rig: the thermal camera's lens, and where it sits",
            hint="`thermofusion calibrate PICTURES -o rig.json` writes one",
        )
    if added.thermal is None and _said_of_thermal(added):
        raise RecipeError(f"{_said_of_thermal(added)[0]} is for thermal frames: it needs --thermal")
    stated = Stated(depth_unit_m=_depth_unit(depth.depth_unit), size_px=_size(depth.size), mirrored=depth.mirrored)
    if depth.rig is not None and added.thermal is None:
        stated = stated.with_rig(depth.rig)  # beside thermal it is for the thermal camera alone
    times = added.times if added.thermal is None else None
    scan = open_scan(recording, format=depth.format, stated=stated, times=times)
    if not scan.depth_unit_m <= LARGEST_STEP_M:
        text = f"depth in whole steps of {scan.depth_unit_m:g} m is none"
        raise RecipeError(text, hint="--depth-unit mm, or metres a step: 0.001 = mm, 0.0002 = 5000 a metre")
    if added.thermal is not None and depth.rig is not None:
        scan = _join(scan, added, depth.rig)
    with progress(json) as step:
        write_scan(scan, out, overwrite=overwrite, progress=step)
    streams = {name: len(s) for name in ("depth", "color", "thermal") if (s := getattr(scan, name)) is not None}
    counts = ", ".join(f"{n} {name}" for name, n in streams.items())
    emit(
        {"scan": out, "format": scan.format, "frames": streams, "notes": scan.notes},
        f"wrote {out}: {counts} frames",
        json,
    )
    for text in scan.notes:
        note(text)


def _said_of_thermal(o: ThermalOptions) -> list[str]:
    given: dict[str, object] = {
        "--fps": o.fps,
        "--clock-offset": o.clock_offset,
        "--gain": o.gain,
        "--offset-degC": o.offset_degC,
    }
    given |= {"--curve": o.curve, "--band": o.band}
    return [name for name, value in given.items() if value is not None] + ["--free"] * o.free


def _join(scan: Scan, o: ThermalOptions, rig: Path) -> Scan:
    """The scan with the thermal frames on its clock."""
    from ..scans import with_thermal
    from ..scans.native.compose import thermal_camera
    from ..scans.stated import times_of
    from ..scans.thermal import read_thermal, with_times

    assert o.thermal is not None
    camera = thermal_camera(rig, free=o.free)
    frames = read_thermal(o.thermal, _said(o, camera.signal), camera.lens.shape)
    if o.times is not None:
        frames = with_times(frames, times_of(o.times, frames.places, range(len(frames))))
    elif o.fps is not None and (fps := _positive(o.fps, "--fps")):
        frames = with_times(frames, [i / fps for i in range(len(frames))])
    if o.clock_offset is None:
        return with_thermal(scan, frames, rig, band_um=_band(o.band), free=o.free)
    if camera.mount == "free":
        raise RecipeError("--clock-offset means nothing for a thermal camera that is not on the rig")
    if o.clock_offset != "auto":
        times = frames.times_s + _number("--clock-offset", o.clock_offset)
        return with_thermal(scan, frames, rig, times_s=times, band_um=_band(o.band))
    return _join_by_motion(scan, frames, rig, o)


def _join_by_motion(scan: Scan, frames: ThermalFrames, rig: Path, o: ThermalOptions) -> Scan:
    import numpy as np

    from ..calibration.thermal.clocks import join_clocks
    from ..scans import with_thermal
    from ..scans.native.compose import thermal_camera

    if not np.isfinite(frames.times_s).all():
        hint = "give --fps or --times: the frames' own clock, whatever its zero"
        raise ScanError("the thermal frames state no times", place=frames.places[0], hint=hint)
    found = join_clocks(scan, frames, frames.times_s, thermal_camera(rig))
    text = f"thermal's clock found from the motion: {found.offset_s:+.4f} s, drift {found.drift * 1e6:+.0f} ppm"
    scan = replace(scan, notes=(*scan.notes, f"{text}, good to {found.sigma_s * 1e3:.1f} ms ({found.frames} frames)"))
    times = found.on_depth_clock(frames.times_s)
    inside = (times >= scan.depth.times_s[0] - 1) & (times <= scan.depth.times_s[-1] + 1)
    return with_thermal(scan, frames.part(np.flatnonzero(inside)), rig, times_s=times[inside], band_um=_band(o.band))


def _said(o: ThermalOptions, rigs: SignalCurve) -> ThermalSaid:
    """What the options say of stored values; where they say nothing, the rig's curve of counts."""
    from ..scans.thermal import ThermalSaid

    if o.curve is not None and (o.gain is not None or o.offset_degC is not None):
        raise RecipeError("--curve and --gain or --offset-degC say the same thing: give one")
    if o.curve is None and o.gain is None and o.offset_degC is None and rigs.kind == "counts":
        return ThermalSaid(curve=rigs)
    return ThermalSaid(o.gain, o.offset_degC, None if o.curve is None else _curve(o.curve))


def _curve(path: Path) -> SignalCurve:
    from ..scans.native.schema import curve_of_file

    return curve_of_file(path)


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None or not int(match[1]) or not int(match[2]):
        raise RecipeError(f"--size: expected WIDTHxHEIGHT, got '{text}'")
    return int(match[1]), int(match[2])


def _band(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d+\.?\d*)-(\d+\.?\d*)", text)
    if match is None or not 1 <= float(match[1]) < float(match[2]) <= 30:
        raise RecipeError(f"--band: expected LOW-HIGH, rising wavelengths in 1-30 um, got '{text}'")
    return float(match[1]), float(match[2])


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise RecipeError(f"{name}: expected seconds or auto, got '{text}'")
    return value


def _depth_unit(text: str | None) -> float | None:
    """Metres, of a unit by its name or as a number."""
    if text is None:
        return None
    try:
        value = UNITS_M.get(text.strip().lower()) or float(text.strip().replace(",", "."))
    except ValueError:
        raise RecipeError(f"--depth-unit: expected {', '.join(UNITS_M)} or metres a step, got '{text}'") from None
    return _positive(value, "--depth-unit")


def _positive(value: float, name: str) -> float:
    if not 0 < value < float("inf"):
        raise RecipeError(f"{name}: expected a number above 0, got {value}")
    return value


def simulate(
    scene: Annotated[
        str, typer.Argument(help="A shipped scene (`thermofusion recipe list` names them) or a TOML file.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Scan folder to write.")],
    seed: Annotated[int, typer.Option(help="Of the noise; same seed, same scan.")] = 0,
    overwrite: Force = False,
    json: Json = False,
) -> None:
    """A phantom with known truth, recorded as a scan."""
    from ..phantom import load_scene
    from ..phantom import simulate as record

    with progress(json) as step:
        frames = partial(step, "frames")
        folder = record(load_scene(scene), out, seed=seed, overwrite=overwrite, progress=frames)
    emit({"scan": folder, "seed": seed}, f"wrote {folder}", json)
