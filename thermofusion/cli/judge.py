"""Verbs that judge results: validate, compare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .console import emit, named, note, progress
from .options import Json, Processing, Recording, spelled_out


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.command()(spelled_out(validate))
    app.command()(compare)


def validate(
    recording: Recording,
    processing: Processing,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Result folder: what it holds is reused, the rest written.", callback=named),
    ] = None,
    folds: Annotated[int, typer.Option(min=2, help="Parts the views are cut into, each left out once.")] = 5,
    motion: Annotated[bool, typer.Option(help="Also try small corrections of single views.")] = True,
    json: Json = False,
) -> None:
    """Leave views out and predict them: error in K by viewing angle, and the map's own expected error."""
    from ..judge.validate import validate as judge

    scan, recipe = recording.open(), processing.load()
    with progress(json) as step:
        report = judge(scan, recipe, out=out, folds=folds, motion=motion, progress=step)
    emit(report.document(), report.text(), json)


def compare(
    first: Annotated[Path, typer.Argument(help="A result folder, or a mesh (.ply, .glb, .vtp).")],
    second: Annotated[
        Path,
        typer.Argument(help="The same; or a truth (.npz, or a simulated scan); or contact readings (.csv, .json)."),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for report, plot and difference map.", callback=named)
    ] = None,
    mirror: Annotated[bool, typer.Option("--mirror", help="Mirror the second, left for right, first.")] = False,
    registered: Annotated[bool, typer.Option("--register/--no-register", help="Lay one surface on the other.")] = True,
    max_distance_mm: Annotated[float, typer.Option(min=0.1, help="Between partners on the two surfaces.")] = 10.0,
    json: Json = False,
) -> None:
    """A result against another one, its mirror image, a truth, or contact readings: bias and limits of agreement."""
    from ..judge.compare import compare as judge
    from ..judge.compare import write_comparison

    found = judge(first, second, mirror=mirror, moved=registered, max_distance_m=max_distance_mm / 1e3)
    written = [] if out is None else write_comparison(found, out)
    emit(found.report(), found.text(), json)
    for path in written:
        note(f"wrote {path}")
