"""Verbs for looking at a result and measuring in it: report, view, measure."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .console import emit, named, note, spared_file
from .options import Filed, Json, spelled_out

Folder = Annotated[Path, typer.Argument(help="A result folder.")]
Before = Annotated[
    Path | None, typer.Option("--before", help="Result of an earlier visit: how each region changed since.")
]


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.command()(spelled_out(report))
    app.command()(view)
    app.command()(measure)


def report(
    result: Folder,
    filed: Filed,
    before: Before = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="File; report.html in the result by default.", callback=spared_file),
    ] = None,
    json: Json = False,
) -> None:
    """Write a result's report: one HTML file to look at, to measure in, and to file."""
    from ..report.deidentify import FILE
    from ..report.html import write_report
    from ..report.summary import PAGE

    path = write_report(out or result / (FILE if filed.deidentify else PAGE), filed.reported(result, before))
    emit({"written": [path], "bytes": path.stat().st_size}, f"wrote {path}", json)


def view(result: Folder, json: Json = False) -> None:
    """Open a result's report in the default browser; it is written first if it is not there."""
    import webbrowser

    from ..report.html import write_report
    from ..report.summary import PAGE

    path = result / PAGE
    if not path.is_file():
        write_report(path, Filed().reported(result))
    opened = webbrowser.open(path.resolve().as_uri())
    emit({"report": path, "opened": opened}, f"{'opened' if opened else 'no browser here: open'} {path}", json)


def measure(
    result: Folder,
    regions: Annotated[Path | None, typer.Option("--regions", help="Regions JSON, as the report saves it.")] = None,
    vertex: Annotated[list[int] | None, typer.Option("--vertex", help="Number of a vertex; may be repeated.")] = None,
    before: Before = None,
    labels: Annotated[
        bool, typer.Option("--labels", help="Also an .npz with each vertex's region, for materials of scan.json.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Stem of the files; regions in the result.", callback=named)
    ] = None,
    json: Json = False,
) -> None:
    """What regions of interest read: mean, its uncertainty, area, left against right, change; as CSV and JSON."""
    from io import BytesIO

    import numpy as np

    from ..errors import RecipeError
    from ..files.json import to_json
    from ..files.whole import write_text, write_whole
    from ..regions import Measured, Measurer, read_regions
    from ..results.folder import load_temperature, measured_of
    from ..version import __version__

    if regions is None and not vertex:
        raise RecipeError("nothing to measure", hint="give --regions FILE, or --vertex NUMBER")
    drawn = [] if regions is None else read_regions(regions)
    now = load_temperature(result)
    measurer = Measurer(now.mesh, now.shared, now.inputs)
    measured = Measured.of(measurer, drawn, vertex or ())
    if before is not None:
        measured = measured.since(measured_of(load_temperature(before), drawn), now.inputs)
    stem = out or result / "regions"
    files = {".csv": measured.csv(), "-budget.csv": measured.budget_csv(), ".json": to_json(measured.document()) + "\n"}
    for suffix, text in files.items():
        write_text(stem.with_name(stem.name + suffix), text)
    if labels:
        data = BytesIO()
        np.savez_compressed(data, thermofusion=np.array(__version__), labels=measurer.labels(drawn))
        write_whole(stem.with_name(stem.name + "-labels.npz"), [data.getvalue()])
    emit(measured.document(), measured.csv().rstrip(), json)
    if not json:
        more = f", {stem}-labels.npz" if labels else ""
        note(f"wrote {stem}.csv, {stem}-budget.csv{more} and {stem}.json")
