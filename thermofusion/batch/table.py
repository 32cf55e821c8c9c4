"""A batch as a table: batch.csv, batch.json, and batch.html that sorts it and leads to every scan's report."""

from __future__ import annotations

import base64
import csv
import io
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from hashlib import sha256
from html import escape
from pathlib import Path
from urllib.parse import quote

from ..errors import counted
from ..files.json import plain, to_json
from ..files.table import inert
from ..recipe import Recipe
from ..version import __version__
from .job import DONE, FAILED, Row
from .store import put

TEMPLATE = Path(__file__).with_name("page.html")
NAME = "batch"
HEAD = ("scan", "status", "exit_code", "reason", "attempts", "wall_s", "peak_GiB")
# Figure -> the page's heading and digits; what is not here stands in CSV and JSON alone.
SHOWN = {
    "median_degC": ("median, °C", 2),
    "median_sigma_K": ("sigma, K", 3),
    "level_sigma_K": ("level ±, K", 2),
    "coverage": ("measured", 3),
    "tracked_fraction": ("tracked", 3),
    "outline_residual_px": ("outlines, px", 2),
    "moved_p95_mm": ("moved p95, mm", 1),
    "diagnoses": ("faults named", 0),
    "vertices": ("vertices", 0),
    "thermal_frames": ("thermal views", 0),
}


def write_summary(out: str, recipe: Recipe, threads: int, rows: Sequence[Row]) -> None:
    """Write the three files into the batch's folder or behind its address. Raises ResourceError."""
    facts = {"thermofusion": __version__, "recipe": recipe.name, "threads_per_worker": threads}
    facts |= {"counts": Counter(row.status for row in rows)}
    files = {
        f"{NAME}.csv": csv_of(rows),
        f"{NAME}.json": to_json({**facts, "scans": [asdict(row) for row in rows]}),
        f"{NAME}.html": page_of(rows, recipe.name),
    }
    for name, text in files.items():
        put(out, name, text.encode("utf-8", "backslashreplace").decode())


def figure_names(rows: Sequence[Row]) -> list[str]:
    """All figures that some row has, in the order of the first that has most."""
    longest = max((row.figures for row in rows), key=len, default={})
    return list(dict.fromkeys([*longest, *(name for row in rows for name in row.figures)]))


def csv_of(rows: Sequence[Row]) -> str:
    """One line a scan; a cell that a spreadsheet would take for a formula begins with an apostrophe."""
    names, text = figure_names(rows), io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([*HEAD, *names])
    for row in rows:
        head = [row.name, row.status, row.exit_code, row.reason, row.attempts, row.wall_s, row.peak_GiB]
        table.writerow([_cell(v) for v in [*head, *(row.figures.get(n) for n in names)]])
    return text.getvalue()


def _cell(value: object) -> object:
    if value is None:
        return ""
    return inert(" ".join(value.split())) if isinstance(value, str) else value


def page_of(rows: Sequence[Row], recipe: str) -> str:
    """The page: one file, without requests; nothing that a person wrote is taken for HTML or a script."""
    counts = Counter(row.status for row in rows)
    said = ", ".join(f"{n} {status}" for status, n in sorted(counts.items()))
    columns = {k: v for k, v in SHOWN.items() if any(k in row.figures for row in rows)}
    head = "".join(
        f'<th scope="col"{" class=text" if kind else ""}><button type="button">{escape(title)}</button></th>'
        for title, kind in [
            ("scan", 1),
            ("status", 1),
            ("why", 1),
            *((t, 0) for t, _ in columns.values()),
            ("time, s", 0),
        ]
    )
    parts = {
        "TITLE": escape(f"{counted(len(rows), 'scan')} with {recipe}: thermofusion batch"),
        "SAID": escape(f"{counted(len(rows), 'scan')} with recipe {recipe}: {said}"),
        "HEAD": head,
        "ROWS": "\n".join(_row(row, columns) for row in rows),
        "FOOT": escape(f"thermofusion {__version__} · research use, not a diagnosis"),
    }
    page = TEMPLATE.read_text(encoding="utf-8")
    for tag in ("script", "style"):
        code = page.partition(f"<{tag}>")[2].partition(f"</{tag}>")[0]
        digest = base64.b64encode(sha256(code.encode()).digest()).decode()
        parts[f"{tag.upper()}-HASH"] = f"'sha256-{digest}'"
    for name, text in parts.items():
        page = page.replace(f"[[{name}]]", text, 1)
    return page


def _row(row: Row, columns: dict[str, tuple[str, int]]) -> str:
    name = f"<bdi>{escape(row.name)}</bdi>"
    if row.status in DONE:
        name = f'<a href="{escape(quote(row.name), quote=True)}/report.html">{name}</a>'
    code = f" ({row.exit_code})" if row.exit_code else ""
    mark = "good" if row.status == DONE[0] else "bad" if row.status == FAILED else "doubt"
    cells = [f'<th scope="row" class=text>{name}</th>', f'<td class="text {mark}">{escape(row.status)}{code}</td>']
    cells.append(f'<td class="text why"><bdi>{escape(row.reason)}</bdi></td>')
    for key, (_, digits) in columns.items():
        value = row.figures.get(key)
        shown = "" if value is None else f"{value:.{digits}f}"
        cells.append(f'<td data-value="{"" if value is None else json.dumps(plain(value))}">{shown}</td>')
    cells.append(f'<td data-value="{row.wall_s}">{row.wall_s:.1f}</td>')
    return f"<tr>{''.join(cells)}</tr>"
