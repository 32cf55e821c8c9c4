"""A batch: scans that are not finished go to workers, one each; whatever happens, table and page are left behind."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ..errors import INTERRUPTED, QualityError, RecipeError, ScanError
from ..recipe import Recipe
from .cluster import in_cluster
from .job import BELOW, DONE, FAILED, Job, Row, Work, fuse_one, remembered
from .pool import in_processes
from .scans import Source
from .store import is_address
from .table import write_summary

SOME_FAILED = 6  # exit code
FLOOR_GiB = 1.0  # of a worker beside its voxel grid: libraries, images, observations of a scan of 180 + 60 frames
SUMMARY_EVERY_S = 15.0  # the page is written again so often meanwhile


@dataclass(frozen=True)
class Crew:
    """Who works: processes, the threads of each, and the scheduler that has them ("" = processes of this machine)."""

    workers: int
    threads: int
    scheduler: str = ""

    @classmethod
    def on_this_machine(cls, recipe: Recipe, workers: int | None = None, scheduler: str = "") -> Crew:
        """As many workers as cores, or fewer where memory is short, unless told; cores are shared out as threads."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        if workers is None:
            fitting = _memory_GiB() / memory_per_worker_GiB(recipe)
            workers = max(1, min(cores, int(fitting)))
        return cls(workers, max(1, cores // workers), scheduler)


def memory_per_worker_GiB(recipe: Recipe) -> float:
    """What a worker may need: the recipe's bound on the voxel grid, and the rest of the program."""
    return FLOOR_GiB + recipe.surface.max_memory_gib


def _memory_GiB() -> float:
    """Of this machine; large where the system does not say."""
    with suppress(AttributeError, ValueError, OSError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return 1e3


# Told of each row as it comes: the row, how many are done, how many there are, seconds left or None.
Tell = Callable[[Row, int, int, float | None], None]


def _silent(row: Row, done: int, total: int, left_s: float | None) -> None:
    """Nobody listens."""


def run_batch(
    sources: Sequence[Source], recipe: Recipe, out: str, crew: Crew, *, work: Work = fuse_one, tell: Tell = _silent
) -> list[Row]:
    """Fuse all scans into folders of `out` (a path or an fsspec address); a row each, in the order of `sources`.

    Finished scans whose files, recipe and code are unchanged are left alone; failed ones are tried again. `out` holds
    batch.html, batch.csv and batch.json at every time, also after Ctrl-C. Raises ResourceError where no worker can be
    had, or `out` cannot be written.
    """
    jobs = [Job(s, recipe.model_dump(mode="json", exclude_none=True), out, crew.threads) for s in sources]
    rows = {job.source.name: Row.of(job.source) for job in jobs}
    rows |= {job.source.name: row for job in jobs if (row := remembered(job)) is not None}
    left = [job for job in jobs if rows[job.source.name].status not in DONE]
    write = partial(write_summary, out, recipe, crew.threads)
    write(list(rows.values()))
    begun = written = time.monotonic()
    try:
        with closing(_worked(work, left, crew)) as results:
            for count, (job, row) in enumerate(results, 1):
                rows[job.source.name] = row
                rate_s = (time.monotonic() - begun) / count
                tell(row, len(jobs) - len(left) + count, len(jobs), rate_s * (len(left) - count))
                if time.monotonic() - written > SUMMARY_EVERY_S:
                    write(list(rows.values()))
                    written = time.monotonic()
    finally:
        write(list(rows.values()))
    return list(rows.values())


def _worked(work: Work, jobs: Sequence[Job], crew: Crew) -> Generator[tuple[Job, Row], None, None]:
    if crew.scheduler:
        return in_cluster(work, jobs, crew.scheduler, workers=crew.workers, threads=crew.threads)
    return in_processes(work, jobs, workers=crew.workers, threads=crew.threads)


def exit_code(rows: Sequence[Row]) -> int:
    """Of the command: 6 if a scan failed, 4 if one is below the gate, 130 if some were not reached, else 0."""
    statuses = {row.status for row in rows}
    if FAILED in statuses:
        return SOME_FAILED
    if not statuses <= set(DONE):
        return INTERRUPTED
    return QualityError.exit_code if BELOW in statuses else 0


def place_for(out: str, scans: str) -> str:
    """The batch's folder, checked. Raises RecipeError where it is the scans' own, ScanError for a single result."""
    if out.rstrip("/") == scans.rstrip("/") or (
        not is_address(out) and not is_address(scans) and Path(out).resolve() == Path(scans).resolve()
    ):
        raise RecipeError("results and scans would lie in one folder", place=out, hint="name another one with -o")
    if not is_address(out) and (Path(out) / "result.json").is_file():
        raise ScanError("the folder holds the result of a single run", place=out, hint="name another one with -o")
    return out
