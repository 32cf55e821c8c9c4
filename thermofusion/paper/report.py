"""What `reproduce` returns: the paper's figure beside ours, as data, JSON and a page to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..files.json import to_json
from ..files.whole import write_text
from ..report.plot import Panel, csv_text, page
from ..report.skeleton import html_page


@dataclass(frozen=True)
class Number:
    """One figure of the paper beside ours.

    paper : what the paper says, in words or None. low, high : the bar that `ours` must lie within; None = no bar.
    """

    what: str
    ours: float
    unit: str = ""
    paper: str | None = None
    low: float | None = None
    high: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether the bar is met; None without a bar."""
        if self.low is None and self.high is None:
            return None
        low, high = self.low if self.low is not None else -np.inf, self.high if self.high is not None else np.inf
        return bool(low <= self.ours <= high)

    @property
    def bar(self) -> str:
        """The bar in words."""
        if self.low is not None and self.high is not None:
            return f"{self.low:g} to {self.high:g}"
        return f"≤ {self.high:g}" if self.high is not None else f"≥ {self.low:g}" if self.low is not None else ""

    def document(self) -> dict[str, object]:
        """For JSON."""
        ours, bar = float(f"{self.ours:.6g}"), self.bar or None
        return {"what": self.what, "unit": self.unit, "paper": self.paper, "ours": ours, "bar": bar, "met": self.met}


@dataclass(frozen=True)
class FigureReport:
    """One figure: its files (relative to the report's folder), numbers, and what a reader must know."""

    name: str
    title: str
    files: tuple[str, ...]
    notes: tuple[str, ...] = ()
    numbers: tuple[Number, ...] = ()


@dataclass(frozen=True)
class PaperReport:
    """All figures that were made, and why others were not."""

    figures: tuple[FigureReport, ...]
    skipped: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def failed(self) -> tuple[str, ...]:
        """Numbers that miss their bar."""
        return tuple(f"{f.name}: {n.what}" for f in self.figures for n in f.numbers if n.met is False)

    def document(self) -> dict[str, object]:
        """For JSON: deterministic, without times."""
        figures = [{**vars(f), "numbers": [n.document() for n in f.numbers]} for f in self.figures]
        return {"figures": figures, "skipped": self.skipped, "failed": self.failed}

    def text(self) -> str:
        """A table for the terminal."""
        lines = []
        for f in self.figures:
            took = f"  ({self.seconds[f.name]:.1f} s)" if f.name in self.seconds else ""
            lines.append(f"{f.name}: {f.title}{took}")
            for n in f.numbers:
                verdict = {True: "ok", False: "MISSED", None: ""}[n.met]
                bar = f"  bar {n.bar}" if n.bar else ""
                paper = f"  paper: {n.paper}" if n.paper else ""
                lines.append(f"  {n.what:<66} {n.ours:>9.4g} {n.unit:<3}{paper}{bar} {verdict}".rstrip())
        lines += [f"{name}: skipped, {why}" for name, why in self.skipped.items()]
        return "\n".join(lines)

    def write(self, folder: Path) -> None:
        """`paper.json` and `paper.html`, whole or not at all."""
        write_text(folder / "paper.html", self.html())
        write_text(folder / "paper.json", to_json(self.document()) + "\n")

    def html(self) -> str:
        """A page that works from disk, offline; the figures lie beside it."""
        body = "".join(_section(f) for f in self.figures)
        if self.skipped:
            items = "".join(f"<li>{escape(k)}: {escape(v)}</li>" for k, v in self.skipped.items())
            body += f"<h2>Not made</h2><ul>{items}</ul>"
        missed = "".join(f"<li>{escape(x)}</li>" for x in self.failed)
        verdict = f"<p>Bars missed:</p><ul>{missed}</ul>" if missed else "<p>All bars are met.</p>"
        return html_page("The paper, reproduced", f"{_HEAD}{verdict}\n{body}\n", style=_STYLE, beside=True)


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure before it is written.

    name : stem of its files. title : in the report. panels : the picture, none = a table only; `columns` of them beside
    each other, each of panel_px (width, height), between heading and caption. tables : what is added to the name of a
    CSV file -> its columns, each (N,).
    """

    name: str
    title: str
    panels: Sequence[Panel] = ()
    tables: Mapping[str, Mapping[str, ArrayLike]] = field(default_factory=dict)
    numbers: Sequence[Number] = ()
    notes: Sequence[str] = ()
    heading: str = ""
    caption: str = ""
    columns: int = 2
    panel_px: tuple[float, float] = (470.0, 360.0)

    def write(self, folder: Path) -> FigureReport:
        """NAME.svg and the tables, each whole or not at all. Raises ResourceError."""
        files = {}
        if self.panels:
            files[f"{self.name}.svg"] = page(
                self.panels, title=self.heading, caption=self.caption, columns=self.columns, panel_px=self.panel_px
            )
        files |= {f"{self.name}{suffix}.csv": csv_text(table) for suffix, table in self.tables.items()}
        for name, text in files.items():
            write_text(folder / name, text)
        return FigureReport(self.name, self.title, tuple(files), tuple(self.notes), tuple(self.numbers))


def _section(f: FigureReport) -> str:
    pictures = "".join(f'<img src="{x}" alt="{escape(f.title)}">' for x in f.files if x.endswith(".svg"))
    rows = "".join(
        f"<tr class='{ {True: 'ok', False: 'missed', None: ''}[n.met] }'><td>{escape(n.what)}</td>"
        f"<td>{escape(n.paper or '')}</td><td class='n'>{n.ours:.4g} {escape(n.unit)}</td><td>{escape(n.bar)}</td></tr>"
        for n in f.numbers
    )
    head = "<tr><th>quantity</th><th>paper</th><th>ours</th><th>bar</th></tr>"
    table = f"<table>{head}{rows}</table>" if rows else ""
    notes = "".join(f"<p>{escape(n)}</p>" for n in f.notes)
    data = ", ".join(f'<a href="{x}">{x}</a>' for x in f.files if not x.endswith(".svg"))
    return f"<h2>{escape(f.name)}: {escape(f.title)}</h2>{pictures}{table}{notes}<p class='data'>{data}</p>"


_STYLE = """img{border:1px solid #e3e3e3;margin:.4rem 0} td,th{text-align:left} h2{margin-top:2.2rem}
td.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap} .data{color:#777;font-size:13px}
tr.ok td:last-child::after{content:" ✓";color:#009e73} tr.missed td{color:#c03000}"""
_HEAD = """<h1>Three-Dimensional Quantitative Thermal Mapping of the Human Body, reproduced</h1>
<p>Figures of the paper by Cheng, Kandala and Herman beside ours. Made by <code>thermofusion paper</code>.</p>
"""
