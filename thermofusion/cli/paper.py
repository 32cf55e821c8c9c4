"""The verb `paper`: the paper's figures, recomputed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import QualityError
from .console import emit, named, note, progress


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.command()(paper)


def paper(
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder with the recordings: jhu/, tables/, torso-dev/.")
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Where the figures go.", callback=named)] = Path(
        "paper-figures"
    ),
    only: Annotated[str | None, typer.Option("--only", help="Comma-separated: table1, fig7 … fig16, or steps.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> int:
    """Recompute the paper's figures, theirs beside ours in numbers."""
    from ..paper import reproduce

    names = [n.strip() for n in only.split(",") if n.strip()] if only else None
    with progress(json) as step:
        report = reproduce(data, out, names, step)
    emit(report.document(), report.text(), json)
    note(f"look at {out / 'paper.html'}")
    return QualityError.exit_code if report.failed else 0
