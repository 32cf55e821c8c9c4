"""The order of files by their names: names are numbers or times, and are sorted as such."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..types import Float
from .common import frame_times

_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_STAMPED = re.compile(r"^(\d+)-(\d{9,18})$")  # Redwood's and SUN3D's NNNNNNN-TTTTTTTTTTTT: frame number, microseconds
# Digits before the point of a Unix time in s, ms, us, ns (of the years 2001 to 2286), and how many make a second.
_STAMP_DIGITS = {10: 1.0, 13: 1e3, 16: 1e6, 19: 1e9}
_JUNK = ("thumbs.db", "desktop.ini")


@dataclass(frozen=True, eq=False)
class Named:
    """Files (N,) in their order, their numbers, and their times_s (N,) where the names are times; else None."""

    files: tuple[Path, ...]
    index: tuple[int, ...]
    times_s: Float | None

    @property
    def stamps(self) -> Float:
        """Times (N,) in s by the names; by number at an assumed rate where the names are no times."""
        return frame_times(self.index) if self.times_s is None else self.times_s


def real_files(files: Iterable[Path]) -> list[Path]:
    """Without what operating systems leave lying about: `._name`, `.DS_Store`, `Thumbs.db`."""
    return [f for f in files if not f.name.startswith(".") and f.name.lower() not in _JUNK and f.is_file()]


def images_in(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """The folder's files of these suffixes, whatever their case; none if it is no folder."""
    return real_files(f for f in folder.iterdir() if f.suffix.lower() in suffixes) if folder.is_dir() else []


def in_order(files: Iterable[Path]) -> Named:
    """Files by the numbers in their names; a name that ends in a Unix time, or in seconds with decimals, is a time."""
    files = list(files)
    stamps = [_STAMPED.match(f.stem) for f in files]
    if files and all(stamps):
        rows = sorted((int(s[1]), int(s[2]), f) for s, f in zip(stamps, files, strict=True) if s)
        return Named(tuple(r[2] for r in rows), tuple(r[0] for r in rows), np.array([r[1] for r in rows]) * 1e-6)
    numbers = {f: _NUMBER.findall(f.stem) for f in files}
    ordered = sorted(files, key=lambda f: (_NUMBER.sub("0", f.stem), [_exact(w) for w in numbers[f]], f.name))
    if not all(numbers.values()) or len({len(n) for n in numbers.values()}) > 1:
        return Named(tuple(ordered), tuple(range(len(files))), None)
    last = [numbers[f][-1] for f in ordered]
    times = _times(last)
    if times is not None:
        return Named(tuple(ordered), tuple(range(len(files))), times)
    index = tuple(int(w.split(".")[0][-18:]) for w in last)
    rising = all(a < b for a, b in pairwise(index))
    return Named(tuple(ordered), index if rising else tuple(range(len(files))), None)


def _times(words: list[str]) -> Float | None:
    """The words as seconds, if they are times: all with decimals, or all of the length of a Unix time."""
    digits = {len(w.split(".")[0]) for w in words}
    per_s = _STAMP_DIGITS.get(min(digits, default=0)) if len(digits) == 1 else None
    if any(w.startswith("0") and len(w.split(".")[0]) > 1 for w in words):
        return None  # padded: a counter
    if per_s is None:
        per_s = 1.0 if words and all("." in w for w in words) else None
    elif per_s == 1.0 and not all("." in w for w in words):
        return None  # whole seconds are no times of frames
    if per_s is None:
        return None
    whole_s = min(int(w.split(".")[0]) for w in words) // int(per_s)  # nanoseconds exceed a float's digits
    times = np.array([(_exact(w) - whole_s * int(per_s)) / per_s for w in words], np.float64) + whole_s
    return times if (np.diff(times) > 0).all() else None


def _exact(word: str) -> int | float:
    return float(word) if "." in word else int(word[-4000:])
