"""`thermofusion`: verbs over the library. The only place that prints, and the only place that exits.

Results go to stdout (`--json` for one object), progress to stderr. Slow libraries are imported inside the
verbs, so that `--help` answers at once.
"""

from __future__ import annotations

import errno
import os
import sys

# Our matrices are many and small, and stages bring their own threads: BLAS threads would only wait for each other
# (twice the CPU time on two cores), and sums would depend on their number, whatever a user's environment says. Must be
# set before NumPy is loaded.
os.environ |= {f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM")}

import typer

from ..errors import INTERRUPTED, INTERRUPTED_SENTENCE, ThermofusionError, exit_of
from ..version import __version__
from . import batch, calibrate, inspect, judge, paper, process, record, recordings, report, thermal
from .console import READER_GONE, fail, help_alone, leave

app = typer.Typer(
    name="thermofusion",
    help="3D models whose every point carries its true skin temperature, from a depth camera and a thermal camera.",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for group in (process, batch, report, inspect, record, recordings, judge, calibrate, thermal, paper):
    group.register(app)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: bool = typer.Option(False, "--version", help="Print the version and exit.", is_eager=True),
) -> None:
    if version:
        print(f"thermofusion {__version__}")
        raise typer.Exit
    help_alone(context)


def main(argv: list[str] | None = None) -> None:
    """Entry point: every error of ours becomes one sentence on stderr and its own exit code."""
    arguments = sys.argv[1:] if argv is None else argv
    as_json = "--json" in arguments
    try:
        code = app(args=arguments, standalone_mode=False)
    except SystemExit as e:
        leave(READER_GONE if e.code == 1 else int(e.code or 0))  # 1 is the library's own, for a pipe that nobody reads
    except (KeyboardInterrupt, typer.Abort):
        fail(INTERRUPTED_SENTENCE, INTERRUPTED, as_json)
    except (ThermofusionError, MemoryError, OSError) as e:
        if isinstance(e, OSError) and e.errno == errno.EPIPE:
            leave(READER_GONE)
        code, sentence = exit_of(e)
        fail(sentence, code, as_json)
    except Exception as e:
        if hasattr(e, "format_message"):  # a usage error of the command line itself
            fail(f"{e.format_message()} (see --help)", 2, as_json)
        raise
    if code == INTERRUPTED:  # typer's own word for Ctrl-C
        fail(INTERRUPTED_SENTENCE, INTERRUPTED, as_json)
    leave(code if isinstance(code, int) else 0)


__all__ = ["app", "main"]
