"""Verbs of the rig's calibration: calibrate, board."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from ..errors import RecipeError, counted
from .console import emit, progress, spared_file
from .options import spelled_out

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
PICTURES_IN_REPORT = 12  # all of them lie inside the page


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.command()(calibrate)
    app.command()(board)


@dataclass(frozen=True)
class Besides:
    """What a rig file says beside the cameras and their places."""

    date: Annotated[str | None, typer.Option(help="ISO 8601; by default the day of the newest picture.")] = None
    curve: Annotated[Path | None, typer.Option(help="curve.json of `thermal curve`: what the counts mean.")] = None
    time_offset_s: Annotated[
        float | None, typer.Option("--time-offset-s", min=-3600, max=3600, help="Of `thermal time-offset`.")
    ] = None
    scatter: Annotated[Path | None, typer.Option(help="scatter.json of `thermal scatter`: what the lens spreads.")] = (
        None
    )


@spelled_out
def calibrate(
    folder: Annotated[Path, typer.Argument(help="Pictures of the board and a calibration.json (docs/calibration.md).")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Rig file to write.", callback=spared_file)] = Path(
        "rig.json"
    ),
    picks: Annotated[Path | None, typer.Option(help="Points picked by hand: CSV or picks.mat.")] = None,
    report: Annotated[Path | None, typer.Option(help="Report to write; beside the rig by default.")] = None,
    *,
    besides: Besides,
    json: Json = False,
) -> None:
    """Cameras and rig from pictures of a board: rig.json with covariances, and a report."""
    from ..calibration import calibrate as solve
    from ..calibration import report_html, rig_document, write_rig
    from ..calibration.thermal.blackbody import read_curve
    from ..calibration.thermal.scatter import read_scatter
    from ..files.whole import write_text

    day, radiometry = _day(besides.date), None if besides.curve is None else read_curve(besides.curve)
    with progress(json) as step:
        done = solve(folder, picks=picks, progress=step)
    document = rig_document(
        done.calibration,
        date=day or done.folder.newest.isoformat(),
        curve=None if radiometry is None else radiometry.signal_curve(),
        time_offset_s=besides.time_offset_s,
        scatter=None if besides.scatter is None else read_scatter(besides.scatter),
        advice=done.advice,
    )
    if radiometry is not None:
        document["radiometry"] = {k: getattr(radiometry, k) for k in ("counts_range", "residual_K", "sigma_K")}
    write_rig(out, document)
    views = [(c, v.name) for v in done.calibration.data.views for c in v.points]
    names = [view for view in views if done.has_picture(*view)][:PICTURES_IN_REPORT]
    pictures = {f"{camera} {name}": done.picture(camera, name) for camera, name in names}
    page = report or out.with_suffix(".html")
    write_text(page, report_html(done.calibration, advice=done.advice, pictures=pictures))
    lines = [f"{camera:<8} {counted(n, 'view')} with the board" for camera, n in done.found.items()]
    lines += [f"note     {text}" for text in done.calibration.notes]
    lines += [f"next     {text}" for text in done.advice]
    emit(document, "\n".join([*lines, f"wrote {out} and {page}"]), json)


def _day(text: str | None) -> str | None:
    """An ISO 8601 date or time as it was given, checked."""
    try:
        if text is not None:
            datetime.fromisoformat(text)
        return text
    except ValueError:
        raise RecipeError(f"--date needs ISO 8601, like 2026-05-04, got '{text}'") from None


def board(
    out: Annotated[Path, typer.Option("-o", "--out", help="File to write: .svg or .pdf.", callback=spared_file)] = Path(
        "board.pdf"
    ),
    kind: Annotated[
        str, typer.Option(help="checkerboard, pins, mask, circles, asymmetric-circles, charuco, lamps.")
    ] = "checkerboard",
    columns: Annotated[int, typer.Option(help="Points along x (a checkerboard: inner corners).")] = 9,
    rows: Annotated[int, typer.Option(help="Points along y.")] = 6,
    spacing_mm: Annotated[float, typer.Option("--spacing-mm", help="Distance of neighbouring points.")] = 30.0,
    json: Json = False,
) -> None:
    """A board to print at 100 %, with a scale bar to check the printer."""
    from ..calibration import Board
    from ..calibration.board.print import draw_board, paper_of
    from ..files.whole import replacing

    target = Board(kind, columns, rows, spacing_mm / 1e3)  # type: ignore[arg-type]
    if out.suffix not in (".svg", ".pdf"):
        raise RecipeError(f"a board is written as .svg or .pdf, not '{out.suffix}'", place=out)
    page = draw_board(target)
    data, paper = page.pdf() if out.suffix == ".pdf" else page.svg().encode(), paper_of(page)
    with replacing(out) as temporary:
        temporary.write_bytes(data)
    text = f"wrote {out} for {paper}; print it at 100 %, not fitted to the page, and measure the scale bar"
    emit({"board": out, "kind": kind, "paper": paper}, text, json)
