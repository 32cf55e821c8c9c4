"""CSV tables from outside, row by row: little memory whatever the file holds, the line named in every error."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..errors import ScanError, counted
from .reading import MAX_LINE, text_lines


def table_rows(
    path: Path, kind: str, needed: Sequence[str], hint: str | None = None
) -> Iterator[tuple[int, dict[str, str]]]:
    """(number of its last line, cells by column) of every row; cells are trimmed, absent ones empty.

    kind : what the file is, for messages. needed : columns that must be there, or else `hint` is given. Raises
    ScanError: no such columns, a column twice, a row of more cells than columns or of more than `MAX_LINE` characters,
    and what `text_lines` raises.
    """
    lines = _Lines(path, kind)
    reader = csv.reader(lines, skipinitialspace=True, strict=False)
    try:
        head = [name.strip() for name in next(reader, [])]
        missing = [name for name in needed if name not in head]
        if missing:
            raise ScanError(f"{counted(len(missing), 'column')} missing: {', '.join(missing)}", place=path, hint=hint)
        twice = [name for name, count in Counter(head).items() if name and count > 1]
        if twice:
            raise ScanError(f"the column {twice[0][:40]} stands twice", place=path)
        for cells in reader:
            lines.characters = 0
            if not cells:
                continue
            if len(cells) > len(head):
                text = f"{len(cells)} cells under {len(head)} columns"
                raise ScanError(text, place=f"{path}, line {reader.line_num}")
            row = dict.fromkeys(head, "") if len(cells) < len(head) else {}
            row.update(zip(head, map(str.strip, cells), strict=False))
            yield reader.line_num, row
    except csv.Error as e:
        raise ScanError(f"it cannot be read as CSV ({e})", place=f"{path}, line {reader.line_num}") from None


def inert(cell: str) -> str:
    """A cell's text as no spreadsheet runs it: an apostrophe stands before what would be a formula."""
    return f"'{cell}" if cell[:1] in "=+-@\t\r" and cell else cell


class _Lines:
    """A file's lines, for the CSV reader; a quoted cell may run over many, a row not over too many."""

    def __init__(self, path: Path, kind: str) -> None:
        self._lines, self._path = text_lines(path, kind), path
        self.characters = 0  # since the last row

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = next(self._lines)
        self.characters += len(line)
        if self.characters > MAX_LINE:
            raise ScanError(f"a row has more than {MAX_LINE:,} characters (a quote without its end?)", place=self._path)
        return line
