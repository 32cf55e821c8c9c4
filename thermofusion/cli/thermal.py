"""The verbs `thermal …`: the thermal camera by itself. What counts mean, how even, quiet, sharp and late it is."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import RecipeError, ScanError, counted, placed
from ..progress import Progress
from .console import emit, help_alone, low_high, note, progress, spared_file
from .options import spelled_out

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..calibration.thermal.blackbody import Box
    from ..calibration.thermal.radiometric import RadiometricCurve
    from ..calibration.thermal.source import RawLayout, ThermalSource

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Readings = Annotated[Path, typer.Argument(help="CSV: counts,degC, or file,degC[,left_px,top_px,width_px,height_px].")]
Source = Annotated[Path, typer.Argument(help="A scan, a FLIR recording, a folder of pictures, or a picture.")]
Curve = Annotated[Path | None, typer.Option(help="curve.json; by default the recording's own curve.")]
Raw = Annotated[
    str | None, typer.Option("--raw", metavar="WxH[,big][,skip=BYTES]", help="Layout of .raw files of 16-bit counts.")
]

FIELD_MARGIN = 0.1  # of the curve's range: vignetting and noise about a source at its end
STILL_SHARE = 0.02  # of a picture may move in a still recording

verbs = typer.Typer(
    help="The thermal camera by itself: curve, field, flatten, noise, edge, scatter, qualify, time-offset.",
    invoke_without_command=True,
    callback=help_alone,
)


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.add_typer(verbs, name="thermal")


@dataclass(frozen=True)
class CurveModel:
    """Which curve, over which counts."""

    model: Annotated[str, typer.Option(help="polynomial (the paper's Eq. 1) or planck.")] = "polynomial"
    degree: Annotated[int, typer.Option(min=1, max=6, help="Of the polynomial.")] = 4
    free_F: Annotated[bool, typer.Option("--free-f", help="Planck: fit F too; takes a wide temperature range.")] = False
    range_: Annotated[
        str | None, typer.Option("--range", help="Counts the curve is for, low:high; all readings by default.")
    ] = None

    def fit(self, counts: NDArray, degC: NDArray, limits: tuple[float, float] | None) -> RadiometricCurve:
        """To blackbody readings, counts (N,) and degC (N,). Raises ScanError."""
        from ..calibration.thermal.radiometric import fit_planck, fit_polynomial

        if self.model == "planck":
            return fit_planck(counts, degC, fix_F=not self.free_F, counts_range=limits)
        return fit_polynomial(counts, degC, degree=self.degree, counts_range=limits)


@verbs.command()
@spelled_out
def curve(
    readings: Readings,
    out: Annotated[Path, typer.Option("-o", "--out", help="Curve file to write.", callback=spared_file)] = Path(
        "curve.json"
    ),
    *,
    chosen: CurveModel,
    raw: Raw = None,
    json: Json = False,
) -> None:
    """Counts to °C from blackbody readings; refused where the curve would turn."""
    import numpy as np

    from ..calibration.thermal.blackbody import curve_document, read_readings, reading_counts, write_curve

    if chosen.model not in ("polynomial", "planck"):
        raise RecipeError(f"there is no model '{chosen.model}'", hint="choose polynomial or planck")
    limits = low_high(chosen.range_, "counts")
    table = read_readings(readings)
    counts, degC = reading_counts(table, _opener(raw)), np.array([r.degC for r in table])
    try:
        fitted = chosen.fit(counts, degC, limits)
    except ScanError as e:
        raise ScanError(e.cause, place=readings, hint=e.hint) from None
    document = curve_document(fitted, len(table))
    write_curve(out, document)
    (lo, hi), (cold, warm) = document["counts_range"], document["degC_range"]
    text = (
        f"{chosen.model} from {counted(len(table), 'reading')}, "
        f"for {lo:.0f} to {hi:.0f} counts ({cold:.2f} to {warm:.2f} °C)\n"
        f"residual {fitted.residual_K * 1e3:.2f} mK rms; the curve itself is good to {fitted.sigma_K * 1e3:.2f} mK\n"
        f"wrote {out}"
    )
    emit(document, text, json)


@verbs.command()
def field(
    readings: Readings,
    out: Annotated[Path, typer.Option("-o", "--out", help="Field file to write.", callback=spared_file)] = Path(
        "field.npz"
    ),
    curve: Curve = None,
    degree: Annotated[int, typer.Option(min=0, max=4, help="Power of temperature each pixel's error follows.")] = 1,
    raw: Raw = None,
    json: Json = False,
) -> None:
    """Vignetting and offsets of every pixel, from pictures that a uniform source fills."""
    import numpy as np

    from ..calibration.thermal.blackbody import read_readings, write_field
    from ..calibration.thermal.radiometric import fit_field

    table, opener, chosen = read_readings(readings), _opener(raw), _curve(curve)
    chosen = chosen and chosen.widened(FIELD_MARGIN)
    if any(r.file is None or r.box is not None for r in table):
        raise ScanError("a field needs pictures that the source fills: rows file,degC without a box", place=readings)
    frames = [opener(r.file).mean_degC(chosen) for r in table if r.file is not None]
    if len({f.shape for f in frames}) > 1:
        raise ScanError("the pictures differ in size", place=readings)
    degC = np.array([r.degC for r in table])
    found = fit_field(np.stack(frames), degC, degree=degree)
    write_field(out, found)
    before, after = (float(np.mean([np.nanstd(f) for f in fs])) for fs in (frames, map(found.correct, frames)))
    h, w = frames[0].shape
    value = {"field": out, "width_px": w, "height_px": h, "degree": degree, "uneven_K": before, "left_K": after}
    text = f"{w} x {h} px: the source looks uneven by {before * 1e3:.1f} mK (one sigma), {after * 1e3:.1f} mK are left"
    emit(value, f"{text}\nwrote {out}", json)


@verbs.command()
def flatten(
    source: Source,
    out: Annotated[Path, typer.Option("-o", "--out", help="Scan folder, or folder of float32 TIFF in °C, to write.")],
    field: Annotated[Path | None, typer.Option(help="Field file; without it, only counts become °C.")] = None,
    curve: Curve = None,
    raw: Raw = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")] = False,
    json: Json = False,
) -> None:
    """Pictures, or a whole scan, as apparent °C with the pixel field taken off."""
    import numpy as np

    from ..calibration.thermal.blackbody import read_field
    from ..calibration.thermal.flatten import flat, flatten_scan, write_flat

    pixel_field, chosen, frames = None if field is None else read_field(field), _curve(curve), _opener(raw)(source)
    before, after = (float(np.nanstd(flat(frames, 0, f, chosen))) for f in (None, pixel_field))
    if frames.scan is not None:
        flatten_scan(frames, out, pixel_field, chosen, overwrite=overwrite)
    else:
        write_flat(frames, out, pixel_field, chosen, overwrite=overwrite)
    value = {"written": out, "frames": len(frames), "before_K": before, "after_K": after}
    text = f"{counted(len(frames), 'frame')}; the first spreads over {before:.3f} K, now over {after:.3f} K (one sigma)"
    emit(value, f"{text}\nwrote {out}", json)


@verbs.command()
def noise(
    source: Source,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Allan-type plot to write: .svg.", callback=spared_file)
    ] = None,
    curve: Curve = None,
    rate: Annotated[float | None, typer.Option(min=1e-3, help="Frames a second, where they state no times.")] = None,
    raw: Raw = None,
    json: Json = False,
) -> None:
    """NETD and drift from a recording of a scene that does not move."""
    from ..calibration.thermal.noise import still_noise
    from ..calibration.thermal.noise_plot import allan_svg
    from ..files.whole import write_text

    if out is not None and out.suffix != ".svg":
        raise RecipeError(f"the plot is written as .svg, not '{out.suffix}'", place=out)
    frames, chosen = _opener(raw, rate)(source), _curve(curve)
    with placed(source), progress(json) as step:
        found = still_noise(_read(frames, chosen, step), frames.times_s)
    if out is not None:
        write_text(out, allan_svg(found))
    text = (
        f"NETD      {found.netd_K * 1e3:.1f} mK (netd_K in scan.json)\n"
        f"drift     {found.drift_K_per_min:+.3f} K/min of the image mean\n"
        f"averaging a pixel helps up to {found.best_tau_s:.3g} s; {found.frames} frames in {found.duration_s:.1f} s"
    )
    emit(found, text if out is None else f"{text}\nwrote {out}", json)
    if found.moving_share > STILL_SHARE:
        note(f"{found.moving_share:.0%} of the picture changes by far more than noise does: was the scene still?")


@verbs.command()
def edge(
    source: Source,
    box: Annotated[
        str | None,
        typer.Option(metavar="LEFT,TOP,WIDTH,HEIGHT", help="Part of the picture with one straight edge, px."),
    ] = None,
    curve: Curve = None,
    raw: Raw = None,
    json: Json = False,
) -> None:
    """Point spread from a straight, slightly slanted hot edge (the mean of all frames)."""
    from ..calibration.thermal.noise import edge_spread
    from ..calibration.thermal.scatter import measure_scatter
    from ..physics.band import Band
    from ..types import ThermalCamera

    part = None if box is None else _box(box)
    image, unit = _opener(raw)(source).mean_shown(_curve(curve))
    with placed(source):
        found = edge_spread(image if part is None else part.cut(image))
    wide = None
    if unit == "degC":
        with suppress(ScanError):  # the rest of the picture need not be an even wall
            wide = measure_scatter([image], Band(*ThermalCamera.band_um)).scatter
    text = (
        f"point spread {found.sigma_px:.3f} ± {found.sigma_sigma_px:.3f} px, one sigma (psf_sigma_px in scan.json)\n"
        f"edge {found.contrast:.1f} {'K' if unit == 'degC' else unit} high, slanted by {found.angle_deg:+.1f}°"
    )
    if wide is not None:
        text += f"\nspread wider: {100 * wide.share:.2f} ± {100 * wide.sigma:.2f} % of the light (see thermal scatter)"
    spread = {f"scatter_{name}": None if wide is None else getattr(wide, name) for name in ("share", "sigma")}
    emit({**vars(found), "contrast_unit": unit, **spread}, text, json)


@verbs.command()
def scatter(
    sources: Annotated[
        list[Path],
        typer.Argument(help="Recordings or pictures of something hot before an even wall, one for each place of it."),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Scatter file to write.", callback=spared_file)] = Path(
        "scatter.json"
    ),
    rig: Annotated[Path | None, typer.Option(help="rig.json of this camera: the kernel is written there, too.")] = None,
    curve: Curve = None,
    raw: Raw = None,
    json: Json = False,
) -> None:
    """How much light the lens spreads over tens of pixels (the mean of all frames of each source)."""
    from ..calibration.rig_file import add_scatter
    from ..calibration.thermal.scatter import measure_scatter, scatter_document
    from ..files.json import to_json
    from ..files.whole import write_text
    from ..physics.band import Band
    from ..types import ThermalCamera

    opened, chosen = [_opener(raw)(s) for s in sources], _curve(curve)
    cameras = [s.scan.thermal.camera for s in opened if s.scan is not None and s.scan.thermal is not None]
    with placed(sources[0]):
        pictures = [s.mean_degC(chosen) for s in opened]
        found = measure_scatter(pictures, Band(*(cameras[0] if cameras else ThermalCamera).band_um))
    document = scatter_document(found)
    if rig is not None:
        add_scatter(rig, found.scatter)
    write_text(out, to_json(document) + "\n")
    g, wrote = found.scatter, f"{out} and {rig}" if rig is not None else str(out)
    kernel = ", ".join(f"{100 * share:.2f} % over {width:.1%}" for share, width in g.parts)
    beyond = ", ".join(f"{100 * share:.2f} % beyond {r} px" for r, share in found.beyond.items())
    text = (
        f"scatter  {100 * g.share:.2f} ± {100 * g.sigma:.2f} % of the light, one sigma (scatter in scan.json)\n"
        f"kernel   {kernel} of the image's width: {beyond}\n"
        f"from     {counted(found.pictures, 'picture')}, {found.contrast_K:.1f} K above the room\n"
        f"assumed  beyond the picture it is as at its border, or as the room: ± {100 * found.unseen:.2f} % of the sigma"
    )
    emit(document, f"{text}\nwrote {wrote}", json)


@verbs.command()
def qualify(
    readings: Readings,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Figures to write: .json, and a page beside it.", callback=spared_file)
    ] = Path("qualify.json"),
    sigma: Annotated[float, typer.Option("--sigma-K", min=0, max=10, help="Of the sources, one sigma.")] = 0.03,
    curve: Curve = None,
    rate: Annotated[float | None, typer.Option(min=1e-3, help="Frames a second, where they state no times.")] = None,
    raw: Raw = None,
    json: Json = False,
) -> None:
    """Accuracy, stability, drift, uniformity, repeatability, NETD, resolvable difference; no claim of conformity."""
    from ..calibration.thermal.blackbody import read_readings, shown_sources
    from ..calibration.thermal.qualify import qualify as figures
    from ..calibration.thermal.qualify_page import CLAIM, qualify_page
    from ..files.json import to_json
    from ..files.whole import write_text

    if out.suffix != ".json":
        raise RecipeError(f"figures are written as .json, not '{out.suffix}'", place=out)
    groups = shown_sources(read_readings(readings), readings, _opener(raw, rate), _curve(curve))
    with placed(readings):
        found = figures(groups, sigma)
    document = {"schema": "thermofusion-qualify/1", "claim": CLAIM, **vars(found)}
    write_text(out, to_json(document) + "\n")
    write_text(out.with_suffix(".html"), qualify_page(found))
    areas = ", ".join(f"{1e3 * v:.0f} mK ({side} x {side} px)" for side, v in found.resolvable_K.items())
    text = (
        f"accuracy       {found.accuracy_K:+.3f} K at most; the sources' own sigma {found.accuracy_sigma_K:.3f} K\n"
        f"drift          {found.drift_K_per_min:+.3f} K/min; stability about it {1e3 * found.stability_K:.1f} mK\n"
        f"uniformity     {1e3 * found.uniformity_K:.1f} mK; NETD {1e3 * found.netd_K:.1f} mK\n"
        f"repeatability  {1e3 * found.repeatability_K:.1f} mK, {found.repeatability_freedom} degrees of freedom\n"
        f"resolvable     {areas}\n{CLAIM}"
    )
    emit(document, f"{text}\nwrote {out} and {out.with_suffix('.html')}", json)


@verbs.command("time-offset")
def time_offset(
    scan: Annotated[Path, typer.Argument(help="Something warm, nearest to the cameras, waved for ten seconds.")],
    format: Annotated[str | None, typer.Option(help="Format of the recording; recognised by default.")] = None,
    max_s: Annotated[float, typer.Option("--max-s", min=0.05, max=10, help="Largest offset looked for.")] = 0.5,
    json: Json = False,
) -> None:
    """How late the thermal clock is: time_offset_s, from something warm that moves before both cameras."""
    from ..calibration.thermal.timeoffset import scan_time_offset
    from ..scans import open_scan

    recording = open_scan(scan, format=format)
    with placed(scan), progress(json) as step:
        found = scan_time_offset(recording, max_offset_s=max_s, progress=step)
    own = 0.0 if recording.thermal is None else recording.thermal.camera.time_offset_s
    value = {"time_offset_s": found.offset_s, "sigma_s": found.sigma_s, "residual_px": found.residual_px}
    value |= {"thermal_frames": found.frames, "scan_time_offset_s": own}
    text = (
        f"time_offset_s {found.offset_s:+.4f} ± {found.sigma_s:.4f} s (one sigma), from {found.frames} thermal frames; "
        f"residual {found.residual_px:.2f} px\nthe recording itself says {own:+.4f} s"
    )
    emit(value, text, json)


# ---------------------------------------------------------------- what the options say


def _opener(raw: str | None, rate_hz: float | None = None) -> Callable[[Path], ThermalSource]:
    from ..calibration.thermal.source import open_thermal

    layout = None if raw is None else _layout(raw)
    return lambda path: open_thermal(path, raw=layout, rate_hz=rate_hz)


def _curve(path: Path | None) -> RadiometricCurve | None:
    from ..calibration.thermal.blackbody import read_curve

    return None if path is None else read_curve(path)


def _layout(text: str) -> RawLayout:
    from ..calibration.thermal.source import RawLayout

    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})(,big)?(?:,skip=(\d{1,9}))?", text)
    if found is None:
        raise RecipeError(f"--raw needs WxH[,big][,skip=BYTES], got '{text}'", hint="for example 640x480,big,skip=240")
    width, height, big, skip = found.groups()
    return RawLayout(int(width), int(height), big is not None, int(skip or 0))


def _box(text: str) -> Box:
    from ..calibration.thermal.blackbody import Box

    if re.fullmatch(r"\d{1,5}(,\d{1,5}){3}", text) is None:
        raise RecipeError(f"--box needs LEFT,TOP,WIDTH,HEIGHT in pixels, got '{text}'")
    return Box(*map(int, text.split(",")))


def _read(frames: ThermalSource, curve: RadiometricCurve | None, step: Progress) -> Iterator[NDArray]:
    for i in range(len(frames)):
        yield frames.degC(i, curve)
        step("frames", i + 1, len(frames))
