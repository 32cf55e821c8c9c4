"""What can go wrong, one small family.

Every error is one sentence with its cause, the place (a file, a key, a frame) and the next step. The command line
catches `ThermofusionError` in one place, prints it, and exits with the class's `exit_code`.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

INTERRUPTED = 130  # exit code after Ctrl-C, as shells count it
INTERRUPTED_SENTENCE = "interrupted; what was computed is kept and the next run continues from there"
LONGEST_CLAUSE = 600  # characters: ours are shorter, what they quote of a file need not be


def visible(text: str) -> str:
    """A user's text (a name, a path, a key of a file) as it may stand in a line: what is not seen stands as `\\u001b`.

    That is what steers a terminal, turns its writing direction, ends a line, or is half a character; blanks of all
    widths stay. The escapes are JSON's, so that a JSON text stays one.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    return re.sub("....", r"\\u\g<0>", character.encode("utf-16-be", "surrogatepass").hex())


def _clause(text: str) -> str:
    shown = visible(text.rstrip("."))
    return shown if len(shown) <= LONGEST_CLAUSE else f"{shown[:LONGEST_CLAUSE]}..."


def counted(n: int, noun: str) -> str:
    """A number and its noun: 1 frame, 2 frames."""
    return f"{n:,} {noun}" if n == 1 else f"{n:,} {noun}s"


class ThermofusionError(Exception):
    """Root of all errors that a user can act on.

    Parameters
    ----------
    cause : what is wrong, as a clause ("depth is 8-bit, expected 16-bit grey").
    place : the file, key or frame range it is about.
    hint : the next step ("record with 16-bit depth").
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, cause: str, *, place: object = None, hint: str | None = None) -> None:
        self.cause = _clause(cause)
        self.place = None if place is None else visible(str(place))
        self.hint = None if hint is None else _clause(hint)
        super().__init__(self.sentence())

    def sentence(self) -> str:
        """The one sentence a user reads: `place: cause; next step`."""
        head = f"{self.place}: " if self.place else ""
        tail = f"; {self.hint}" if self.hint else ""
        return f"{head}{self.cause}{tail}"


class RecipeError(ThermofusionError):
    """A recipe or an option is wrong (usage)."""

    exit_code = 2


class ScanError(ThermofusionError):
    """The input cannot be used: missing, torn, inconsistent, or without overlap."""

    exit_code = 3


class QualityError(ThermofusionError):
    """The result was written and marked, but lies below the recipe's quality gate."""

    exit_code = 4


class ResourceError(ThermofusionError):
    """Memory, disk or a device is not sufficient or not there."""

    exit_code = 5


class BusyError(ResourceError):
    """Another run has the result folder."""


@contextmanager
def placed(place: object) -> Iterator[None]:
    """A ScanError raised inside that names no place names this one."""
    try:
        yield
    except ScanError as e:
        raise ScanError(e.cause, place=e.place or place, hint=e.hint) from None


def told_by(error: BaseException) -> str:
    """What another library's error says, on one line; its kind where it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__


def exit_of(error: BaseException) -> tuple[int, str]:
    """The exit code of the command line for an error, and its one sentence."""
    if isinstance(error, ThermofusionError):
        return error.exit_code, error.sentence()
    if isinstance(error, MemoryError):
        return 5, "out of memory; choose a larger surface.voxel_mm or a smaller --max-memory"
    if isinstance(error, OSError):  # a stream that is full or gone, a folder that was refused
        return 5, f"{error.filename or 'a stream'}: it cannot be used ({error.strerror})"
    return 1, _clause(f"{type(error).__name__}: {error}")
