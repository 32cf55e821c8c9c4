"""The results page, docs/results.md, built from the JSON beside it: `python docs/build_results.py [DOCS]`.

Two kinds of JSON in docs/results/: `paper.json` as `thermofusion paper` writes it, and tables that anybody may add:
{"title", "about", "command", "columns": [...], "rows": [[...], ...], "notes": [...], "order": 10}.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from thermofusion.errors import RecipeError
from thermofusion.files.whole import write_text

METHODS = "methods-"  # names of figures that make one table
HEAD = """# Results

Built by `python docs/build_results.py` from the files in `docs/results/`; do not edit by hand. What the figures
show is told in [paper.md](paper.md).
"""


def build(docs: Path) -> Path:
    """Write DOCS/results.md from DOCS/results/*.json. Raises RecipeError naming a file of neither kind."""
    parts: list[tuple[float, str, str]] = []
    for path in sorted((docs / "results").glob("*.json")):
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            text = _paper(document, docs) if "figures" in document else _table(document)
        except (ValueError, KeyError, TypeError) as e:
            raise RecipeError(f"not a stored result ({e!r})", place=path) from None
        parts.append((float(document.get("order", 50)), path.name, text))
    page = docs / "results.md"
    write_text(page, HEAD + "".join(text for _, _, text in sorted(parts)))
    return page


def _table(document: dict[str, Any]) -> str:
    lines = [f"\n## {document['title']}\n"]
    if document.get("about"):
        lines.append(document["about"] + "\n")
    lines += _rows(document["columns"], document["rows"])
    lines += [f"\n{note}" for note in document.get("notes", ())]
    if document.get("command"):
        lines.append(f"\nAgain: `{document['command']}`")
    return "\n".join(lines) + "\n"


def _paper(document: dict[str, Any], docs: Path) -> str:
    lines = [*_methods(document), "\n## The paper's figures", ""]
    missed = document["failed"]
    lines.append("All bars are met." if not missed else "Bars missed: " + "; ".join(missed) + ".")
    for figure in document["figures"]:
        if figure["name"].startswith(METHODS):
            continue
        lines.append(f"\n### {figure['name']}: {figure['title']}\n")
        lines += [f"![{figure['title']}](results/{f})\n" for f in figure["files"] if (docs / "results" / f).is_file()]
        rows = [
            [n["what"], n["paper"] or "", f"{n['ours']:.4g} {n['unit']}".strip(), _verdict(n)]
            for n in figure["numbers"]
        ]
        if rows:
            lines += _rows(["quantity", "paper", "ours", "bar"], rows)
        lines += [f"\n{note}" for note in figure["notes"]]
        lines.append(f"\nAgain: `thermofusion paper --only {_step(figure['name'])}`")
    lines += [f"\nNot made: {name} ({why})" for name, why in document["skipped"].items()]
    return "\n".join(lines) + "\n"


def _methods(document: dict[str, Any]) -> list[str]:
    """Methods x scans, from the figures named methods-…: "SCAN, METHOD: …"."""
    figures = [f for f in document["figures"] if f["name"].startswith(METHODS)]
    if not figures:
        return []
    cells = {tuple(n["what"].split(":")[0].split(", ")): float(n["ours"]) for f in figures for n in f["numbers"]}
    scans, methods = (list(dict.fromkeys(key[i] for key in cells)) for i in (0, 1))
    rows = [[m, *(cells.get((scan, m)) for scan in scans)] for m in methods]
    notes = list(dict.fromkeys(note for f in figures for note in f["notes"]))
    head = ["\n## Methods x scans: rms error, K\n", *_rows(["method", *scans], rows)]
    return [*head, *(f"\n{note}" for note in notes), "\nAgain: `thermofusion paper --data DIR --only methods`"]


def _step(name: str) -> str:
    """What --only takes to make a figure again."""
    return name.split("-")[0]


def _verdict(number: dict[str, Any]) -> str:
    if number["bar"] is None:
        return ""
    return f"{number['bar']} {'✓' if number['met'] else '**missed**'}"


def _rows(columns: list[str], rows: list[list[Any]]) -> list[str]:
    def line(cells: list[Any]) -> str:
        return "| " + " | ".join(_cell(c).replace("|", "\\|") for c in cells) + " |"

    return [line(columns), "|" + "---|" * len(columns), *(line(row) for row in rows)]


def _cell(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    build(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent)
