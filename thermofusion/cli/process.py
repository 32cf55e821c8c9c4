"""Verbs of the main job: run, demo, export."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ..errors import QualityError, RecipeError
from .console import emit, named, note, progress
from .options import Drawing, Filed, Json, Processing, Recording, spelled_out

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what stands in the result folder.")]
STAGES = "tracking, surface, rig, mapping, temperature"  # pipeline.STAGE_NAMES, which --help has no time to load


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.command()(spelled_out(run))
    app.command()(demo)
    app.command()(spelled_out(export))


@dataclass(frozen=True)
class Part:
    """Which stages of a run are computed."""

    from_: Annotated[str | None, typer.Option("--from", help=f"Compute anew from this stage: {STAGES}.")] = None
    until: Annotated[str | None, typer.Option("--until", help=f"Stop after this stage: {STAGES}.")] = None
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be computed, and why.")] = False


def run(
    recording: Recording,
    processing: Processing,
    out: Annotated[Path, typer.Option("-o", "--out", help="Result folder.", callback=named)] = Path("out"),
    *,
    part: Part,
    field: Annotated[
        Path | None, typer.Option("--field", help="An earlier result of the same camera: its field is where to start.")
    ] = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="The scan is still being recorded: show the growing model first.")
    ] = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> int:
    """Fuse a recorded scan into a mesh with temperatures."""
    from .. import pipeline

    renamed: list[str] = []  # told last: before the work, errors speak
    chosen = processing.load(renamed.append)
    ahead = None
    if follow:
        from .live import followed

        ahead = followed(recording.scan, chosen)
    scan = recording.open()
    if field is not None:
        from ..results.earlier import with_field

        chosen = with_field(chosen, scan, field)
    if part.dry_run:
        plans = pipeline.plan(scan, chosen, out, redo_from=part.from_)
        emit(plans, "\n".join(f"{p.name:<12} {'reuse' if p.reuse else 'compute'}  ({p.why})" for p in plans), json)
        return 0
    with progress(json) as step:
        if part.from_ is None and part.until is None:
            result = pipeline.go_on(scan, chosen, ahead, out=out, progress=step, overwrite=overwrite)
        else:
            ways = {"redo_from": part.from_, "until": part.until}
            result = pipeline.fuse(scan, chosen, out=out, progress=step, **ways, overwrite=overwrite)
    emit(result.report, pipeline.summary(result.report, out), json)
    for line in renamed:
        note(line)
    return QualityError.exit_code if result.report["quality"]["failed"] else 0


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Result folder.", callback=named)] = Path("demo-result"),
    overwrite: Overwrite = False,
    json: Json = False,
) -> int:
    """The shipped scan, end to end, then where to look."""
    from .. import pipeline
    from ..files.shipped import data_dir
    from ..recipe import load_recipe
    from ..scans import open_scan

    scan = open_scan(data_dir() / "demo")
    with progress(json) as step:
        result = pipeline.fuse(scan, load_recipe("torso"), out=out, progress=step, overwrite=overwrite)
    emit(result.report, pipeline.summary(result.report, out), json)
    note(f"open the report in a browser, {out / 'mesh.glb'} in Blender, {out / 'mesh.ply'} in MeshLab")
    return QualityError.exit_code if result.report["quality"]["failed"] else 0


def export(
    result: Annotated[Path, typer.Argument(help="A result folder.")],
    drawing: Drawing,
    formats: Annotated[
        str, typer.Option("--format", help="Comma-separated: ply, glb, vtp, csv, obj, stl, vtk-mesh, dicom.")
    ] = "ply,glb,vtp",
    show: Annotated[str, typer.Option(help="absolute, normal-equivalent or apparent.")] = "absolute",
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder; the result's own by default.", callback=named)
    ] = None,
    *,
    filed: Filed,
    json: Json = False,
) -> None:
    """Write a result's mesh and pictures again: other formats, palette, range, size, or output mode; as DICOM."""
    from .. import pipeline
    from ..export import export as write
    from ..export.palettes import beyond_range
    from ..report.pictures import write_views

    palette, limits = drawing.palette, drawing.range_degC
    if filed.deidentify and out is None:
        raise RecipeError("--deidentify needs -o: a folder of its own, apart from the files that tell who it is")
    folder = result if out is None else out
    wanted = [f.strip() for f in formats.split(",")]
    dicom = "dicom" in wanted
    reported = filed.reported(result) if dicom or filed.deidentify else None
    mesh = pipeline.load_mesh(result, show) if reported is None else reported.temperature.shown(show)
    mode = "" if show == "absolute" else f"-{show}"  # other modes never replace the corrected mesh and its pictures
    meshes = [f for f in wanted if f != "dicom"]
    written = write(mesh, folder, meshes, palette=palette, range_degC=limits, name=f"mesh{mode}")
    written += write_views(mesh, folder / f"views{mode}", palette=palette, range_degC=limits, height_px=drawing.size)
    if dicom and reported is not None:
        from ..handover.dicom import write_study

        written += write_study(folder / "dicom", reported)
    if folder.resolve() == result.resolve():
        pipeline.add_files(result, written)
    outside = "" if limits is None else beyond_range(mesh.temperature_degC, *limits)
    if outside:
        note(f"note: {outside}")
    emit({"written": written}, "\n".join(f"wrote {path}" for path in written), json)
