"""The paper, reproduced: every figure it shows from data or phantoms, the paper's number beside ours.

`reproduce` is the whole of it; `thermofusion paper` calls it. Steps that need recordings which are not at hand are
skipped with the reason. docs/paper.md says what each figure shows and where the paper contradicts itself.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from ..errors import RecipeError
from ..progress import Progress, silent
from .report import FigureReport, Number, PaperReport


@dataclass(frozen=True)
class Step:
    """Figures that are made together.

    figures : the names that select it, besides its own. needs : what must be in the data folder. make :
    "module:function" of this room, taking `Prepared` and returning the figures; loaded when it is run.
    """

    name: str
    figures: tuple[str, ...]
    needs: tuple[str, ...]
    make: str


_FACE = ("fig11", "fig12", "fig13", "fig14", "fig15", "fig16")
_STEPS = (  # in the order of the paper
    Step("emissivity", ("table1", "fig7"), (), "emissivity_figures:figure7"),
    Step("phantom", ("fig8",), ("jhu/phantom",), "phantom_figures:figure8"),
    Step("phantom-corrected", ("fig9",), ("jhu/phantom",), "phantom_figures:figure9"),
    Step("cylinder", ("fig9",), (), "scan_figures:cylinder_scan"),
    Step("face", _FACE, ("jhu/face", "jhu/radiometry"), "face_figures:face"),
    Step("head", _FACE, (), "face_figures:head"),
    Step("sideview-head", ("fig16",), (), "scan_figures:side_view_head"),
    Step("sideview-torso", ("fig16",), ("torso-dev",), "scan_figures:side_view_torso"),
    Step("methods", (), (), "method_figures:methods_on_phantoms"),
    Step("methods-torso", ("methods",), ("torso-dev",), "method_figures:methods_on_torso"),
)


def steps() -> tuple[Step, ...]:
    """All steps, in the order of the paper."""
    return _STEPS


def reproduce(
    data: Path | None, out: Path, only: Sequence[str] | None = None, progress: Progress = silent
) -> PaperReport:
    """Make the paper's figures into `out`: SVG and CSV of each, `paper.json`, `paper.html`.

    data : folder with the recordings (`jhu/`, `tables/`, `torso-dev/`); None = what needs none. only : names of
    figures (fig7 … fig16) or steps (see `steps`). progress : called with (step, done, total). Phantom scans and results
    go to `out/work`, which may be deleted.
    Raises RecipeError for an unknown name, ScanError, ResourceError.
    """
    from .prepared import Prepared  # the pipeline and the renderer, not needed to list the steps

    chosen = _chosen(only)
    out.mkdir(parents=True, exist_ok=True)
    prepared = Prepared(data, out / "work")
    made: list[FigureReport] = []
    skipped, seconds = {}, {}
    for step in chosen:
        missing = [n for n in step.needs if data is None or not (data / n).exists()]
        if missing:
            where = "no --data folder was given" if data is None else f"{data} has no {', '.join(missing)}"
            skipped[step.name] = f"it needs {', '.join(step.needs)} ({where})"
            continue
        progress(step.name, 0, 1)
        start = time.monotonic()
        module, function = step.make.split(":")
        figures = getattr(import_module(f".{module}", __name__), function)(prepared)
        made += [figure.write(out) for figure in figures]
        seconds[figures[0].name] = time.monotonic() - start
        progress(step.name, 1, 1)
    report = PaperReport(tuple(made), skipped, seconds)
    report.write(out)
    return report


def _chosen(only: Sequence[str] | None) -> tuple[Step, ...]:
    if not only:
        return _STEPS
    known = {name for step in _STEPS for name in (step.name, *step.figures)}
    for name in only:
        if name not in known:
            raise RecipeError(
                f"there is no figure '{name}'", place="--only", hint=f"choose from {', '.join(sorted(known))}"
            )
    return tuple(step for step in _STEPS if {step.name, *step.figures} & set(only))


__all__ = ["FigureReport", "Number", "PaperReport", "Step", "reproduce", "steps"]
