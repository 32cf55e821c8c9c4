"""The program: Ctrl-C is in hand before anything slow is imported, and ends in one sentence wherever it strikes."""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import signal
import sys
import threading
from contextlib import suppress
from typing import Any, NoReturn

from .errors import INTERRUPTED, INTERRUPTED_SENTENCE

# M_MMAP_THRESHOLD, M_TRIM_THRESHOLD, M_TOP_PAD in bytes, M_ARENA_MAX of GNU's mallopt (malloc.h)
KEEP_MEMORY = {-3: 32 << 20, -1: 1 << 30, -2: 64 << 20, -8: 1}

GARBAGE = 100_000, 20, 20  # objects made until cycles are looked for: half a second of a run goes into Python's own 700


def main() -> None:
    """Entry point of `thermofusion` and `python -m thermofusion`."""
    asked: list[int] = []

    def stop(number: int, frame: Any) -> None:
        asked.append(number)
        raise KeyboardInterrupt

    def unraisable(told: Any) -> None:  # an interrupt inside a destructor or a thread would be swallowed
        if asked:
            _end()
        sys.__unraisablehook__(told)

    signal.signal(signal.SIGINT, stop)
    sys.unraisablehook = unraisable
    _keep_memory()
    gc.set_threshold(*GARBAGE)
    try:
        from .cli import main as run

        run()
    except SystemExit as e:
        _leave(e)
    except BaseException:  # half-imported libraries turn an interrupt into errors of their own
        if asked:
            _end()
        raise


def _keep_memory() -> None:
    """Memory that is freed stays, for what comes next, in one pool for all threads.

    Arrays of a few MB come and go by the thousand; given back to the system each time, their pages are cleared again
    for the next: a twentieth of the CPU time of a run, and a quarter more memory.
    """
    with suppress(AttributeError, OSError, TypeError):  # another C library than GNU's
        for option, value in KEEP_MEMORY.items():
            ctypes.CDLL(None).mallopt(option, value)


def _leave(how: SystemExit) -> NoReturn:
    """Exit as Python does, but the libraries are not taken apart first: the system takes back memory faster."""
    if not isinstance(how.code, int):
        raise how
    with suppress(AttributeError):  # both stand for what Python does at its end; neither is promised
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                if stream is not None:
                    stream.flush()
        os._exit(how.code & 0xFF)
    raise how


def _end() -> None:
    """One sentence, past whatever hangs: threads, buffers, bars."""
    words = f"error: {INTERRUPTED_SENTENCE}\n".encode()
    for stream, text in ((1, b'{"error": "interrupted", "exit_code": 130}\n'), (2, words)):
        try:
            if stream == 2 or "--json" in sys.argv:
                os.write(stream, (b"\x1b[?25h" if os.isatty(stream) else b"") + text)  # a live bar hides the cursor
        except OSError:
            pass
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
