"""Verbs of the main job: run, demo, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import QualityError
from .console import emit, low_high, note, progress

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="section.key=value, over the recipe; repeatable")]


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.command()(run)
    app.command()(demo)
    app.command()(export)


def run(
    scan: Annotated[Path, typer.Argument(help="A scan folder, or a foreign recording.")],
    recipe: Annotated[str, typer.Option("-r", "--recipe", help="A shipped name or a TOML file.")] = "torso",
    out: Annotated[Path, typer.Option("-o", "--out", help="Result folder.")] = Path("out"),
    set_: Overrides = None,
    format: Annotated[str | None, typer.Option(help="Format of the recording; recognised by default.")] = None,
    method: Annotated[
        str | None, typer.Option(help="joint, corrected-cos, cos-resolution, mean, nearest-view, paper; or `all`.")
    ] = None,
    from_: Annotated[str | None, typer.Option("--from", help="Compute this stage and all later ones anew.")] = None,
    until: Annotated[str | None, typer.Option("--until", help="Stop after this stage.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be computed, and why.")] = False,
    max_memory: Annotated[float | None, typer.Option("--max-memory", help="Bound on the voxel grid, GiB.")] = None,
    json: Json = False,
) -> int:
    """Fuse a recorded scan into a mesh with temperatures."""
    from .. import pipeline
    from ..recipe import load_recipe
    from ..scans import open_scan

    overrides = list(set_ or ())
    if max_memory is not None:
        overrides.append(f"surface.max_memory_gib={max_memory}")
    if method not in (None, "all"):
        overrides.append(f"temperature.method={method}")
    chosen = load_recipe(recipe, overrides, note=note)
    recording = open_scan(scan, format=format)
    if dry_run:
        plans = pipeline.plan(recording, chosen, out, redo_from=from_)
        emit(plans, "\n".join(f"{p.name:<12} {'reuse' if p.reuse else 'compute'}  ({p.why})" for p in plans), json)
        return 0
    with progress(json) as step:
        result = pipeline.fuse(
            recording, chosen, out=out, progress=step, redo_from=from_, until=until, compare_methods=method == "all"
        )
    emit(result.report, pipeline.summary(result.report, out), json)
    return QualityError.exit_code if result.report["quality"]["failed"] else 0


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Result folder.")] = Path("demo-result"),
    json: Json = False,
) -> int:
    """The shipped scan, end to end, then where to look."""
    from .. import pipeline
    from ..files.shipped import data_dir
    from ..recipe import load_recipe
    from ..scans import open_scan

    scan = open_scan(data_dir() / "demo")
    with progress(json) as step:
        result = pipeline.fuse(scan, load_recipe("torso"), out=out, progress=step)
    emit(result.report, pipeline.summary(result.report, out), json)
    note(f"look at {out / 'views' / 'overview.png'}; open {out / 'mesh.glb'} in Blender, {out / 'mesh.ply'} in MeshLab")
    return QualityError.exit_code if result.report["quality"]["failed"] else 0


def export(
    result: Annotated[Path, typer.Argument(help="A result folder.")],
    formats: Annotated[str, typer.Option("--format", help="Comma-separated: ply, glb, vtp, csv.")] = "ply,glb,vtp",
    palette: Annotated[str, typer.Option(help="inferno, iron, grey, cividis, rainbow.")] = "inferno",
    range_: Annotated[str | None, typer.Option("--range", help="Colour range in °C, low:high.")] = None,
    show: Annotated[str, typer.Option(help="absolute, normal-equivalent or apparent.")] = "absolute",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder; the result's own by default.")] = None,
    json: Json = False,
) -> None:
    """Write a result's mesh again: other formats, palette, range, or output mode."""
    from .. import pipeline
    from ..export import export as write

    limits = low_high(range_, "°C")
    mesh = pipeline.load_mesh(result, show)
    written = write(
        mesh, out or result, tuple(f.strip() for f in formats.split(",")), palette=palette, range_degC=limits
    )
    emit({"written": written}, "\n".join(f"wrote {path}" for path in written), json)
