"""The verb for many scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import RecipeError, counted
from .console import emit, named, note
from .options import Json, Processing, spelled_out

if TYPE_CHECKING:
    from ..batch.job import Row

MINUTE_S = 60.0


def register(app: typer.Typer) -> None:
    """Add this module's verb."""
    app.command()(spelled_out(batch))


def batch(
    scans: Annotated[str, typer.Argument(metavar="DIR", help="Folder with scans below it, or an fsspec address.")],
    processing: Processing,
    out: Annotated[str, typer.Option("-o", "--out", help="Folder or address for the results and the summary.")],
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Scans at a time on this machine; as many as cores by default.")
    ] = None,
    scheduler: Annotated[
        str, typer.Option(help="A Dask scheduler, tcp://HOST:8786; `local` makes one. Default: plain processes.")
    ] = "",
    json: Json = False,
) -> int:
    """Fuse all scans below a folder; finished ones are left alone, one bad scan never stops the rest."""
    from ..batch.batch import Crew, exit_code, memory_per_worker_GiB, place_for, run_batch
    from ..batch.scans import find_scans
    from ..batch.store import is_address

    recipe = processing.load()
    if not out.strip():
        raise RecipeError("-o needs a name, got an empty one", hint="name a new folder")
    if not is_address(out):
        named(Path(out))
    place_for(out, scans)
    sources = find_scans(scans, out)
    crew = Crew.on_this_machine(recipe, workers, scheduler)
    who = counted(crew.workers, "worker") if scheduler in ("", "local") else f"the workers of {scheduler}"
    bound = (
        f"up to {memory_per_worker_GiB(recipe):.1f} GiB each ({recipe.surface.max_memory_gib:g} of it the voxel grid)"
    )
    note(f"{counted(len(sources), 'scan')}; {who}, {counted(crew.threads, 'thread')} each, {bound}")
    try:
        rows = run_batch(sources, recipe, out, crew, tell=_told)
    except KeyboardInterrupt:
        note(f"{out}/batch.html shows what is finished")
        raise
    text = "\n".join([*_failures(rows), _sum(rows), f"look at      {out}/batch.html"])
    emit({"scans": rows, "exit_code": exit_code(rows)}, text, json)
    return exit_code(rows)


def _told(row: Row, done: int, total: int, left_s: float | None) -> None:
    """A line for each scan as it is done."""
    what = row.status if row.status != "failed" else f"failed ({row.exit_code}): {row.reason}"
    again = f", attempt {row.attempts}" if row.attempts > 1 else ""
    left = (
        "" if not left_s else f"; about {left_s / MINUTE_S:.0f} min left" if left_s > MINUTE_S else "; under a minute"
    )
    note(f"{done}/{total} {row.name}: {what}, {row.wall_s:.1f} s{again}{left}")


def _failures(rows: list[Row]) -> list[str]:
    """What failed and why, with the exit code of a single run."""
    bad = [row for row in rows if row.status != "good"]
    width = max((len(row.name) for row in bad), default=0)
    return [f"{row.name:<{width}}  {row.status:<10}  {row.exit_code or '-'}  {row.reason}" for row in bad]


def _sum(rows: list[Row]) -> str:
    good = sum(row.status == "good" for row in rows)
    reused = sum(row.reused for row in rows)
    return f"{good} of {counted(len(rows), 'scan')} good; {reused} were finished already"
