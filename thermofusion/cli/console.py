"""How the command line speaks: progress on stderr, results on stdout, one JSON object on request."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn, TextIO

import typer

from ..errors import RecipeError, visible
from ..files.json import to_json
from ..progress import Progress

READER_GONE = 141  # exit code when nobody reads any more, as shells count SIGPIPE


def leave(code: int) -> NoReturn:
    """Exit; a stream that cannot take what is left in it says so by the code, not by a traceback."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the work is done
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError) as e:
            if stream is sys.stdout:
                code = READER_GONE if isinstance(e, BrokenPipeError) else code or 5
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1 if stream is sys.stdout else 2)
    sys.exit(code)


def fail(sentence: str, code: int, as_json: bool) -> NoReturn:
    """Print one sentence (or one JSON object) and exit with the code."""
    if as_json:
        with suppress(OSError):  # the code says it all the same
            say(to_json({"error": sentence, "exit_code": code}))
    note(f"error: {sentence}")
    leave(code)


def say(text: str, stream: TextIO | None = None) -> None:
    """Lines on stdout, or another stream: the one place that writes to a terminal.

    What could steer it, and what its encoding lacks, stands as an escape.
    """
    stream = sys.stdout if stream is None else stream
    if stream is not None:  # closed by whoever started us
        encoding = stream.encoding or "utf-8"
        shown = "\n".join(visible(line) for line in text.split("\n"))
        try:
            print(shown.encode(encoding, "backslashreplace").decode(encoding), file=stream)
        except BrokenPipeError:
            if stream is sys.stdout:
                leave(READER_GONE)
            raise


def emit(value: object, text: str, as_json: bool) -> None:
    """The result: JSON for programs, text for people."""
    say(to_json(value) if as_json else text)


def note(text: str) -> None:
    """A line for people, beside the result: where nobody can take it, the work goes on."""
    if sys.stderr is not None:
        with suppress(OSError):
            say(visible(text), sys.stderr)


def named(out: Path | None) -> Path | None:
    """What was given with -o. Raises RecipeError for an empty name, and for a place in a recording."""
    from ..scans.apart import apart

    if out is None:
        return None
    if not str(out).strip() or out == Path():
        raise RecipeError("-o needs a name, got an empty one", hint="name a new folder")
    return apart(out)


def spared_file(out: Path | None) -> Path | None:
    """A file given with -o: as `named`, and before the work ScanError where a file of another origin stands there."""
    from ..files.whole import spared

    if named(out) is not None and out is not None:
        spared(out)
    return out


def low_high(text: str | None, unit: str) -> tuple[float, float] | None:
    """The two ends of `--range low:high`; None if it was not given. Raises RecipeError."""
    if text is None:
        return None
    try:
        low, high = (float(x) for x in text.split(":"))
    except ValueError:
        raise RecipeError(f"--range needs low:high in {unit}, got '{text}'") from None
    if not low < high:
        raise RecipeError(f"--range needs low < high, got '{text}'")
    return low, high


def help_alone(context: typer.Context) -> None:
    """A group of verbs that is called without one prints its help; that is no error."""
    if context.invoked_subcommand is None:
        say(context.get_help())
        raise typer.Exit


@contextmanager
def progress(quiet: bool = False) -> Iterator[Progress]:
    """A callback (stage, done, total): a live bar on a terminal, one plain line per stage elsewhere."""
    if quiet:
        yield lambda stage, done, total: None
    elif sys.stderr is not None and sys.stderr.isatty():
        with _bars() as bars:
            yield bars
    else:
        yield _Lines()


@contextmanager
def _bars() -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Live

    columns = (
        TextColumn("{task.description:<12}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Live(*columns, console=Console(stderr=True)) as live:
        tasks: dict[str, int] = {}

        def step(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = live.add_task(visible(stage), total=total)
            live.update(tasks[stage], completed=done, total=total)  # type: ignore[arg-type]

        yield step


class _Lines:
    """`stage: done in 1.2 s`, once per stage."""

    def __init__(self) -> None:
        self._start: dict[str, float] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        start = self._start.setdefault(stage, time.monotonic())
        if done >= total and start >= 0:
            note(f"{stage}: {total} done in {time.monotonic() - start:.1f} s")
            self._start[stage] = -1.0
