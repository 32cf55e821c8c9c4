"""The paper, reproduced: every figure it shows from data or phantoms, the paper's number beside ours.

`reproduce` is the whole of it; `thermofusion paper` calls it. Steps that need recordings which are not at hand are
skipped with the reason. docs/paper.md says what each figure shows and where the paper contradicts itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import RecipeError, ScanError
from ..progress import Progress
from .report import FigureReport, Number, PaperReport


@dataclass(frozen=True)
class Step:
    """Figures that are made together.

    figures : the names that select it, besides its own. needs : what must be in the data folder. make : (out, data) ->
    reports; data is None where nothing is needed and nothing was given.
    """

    name: str
    figures: tuple[str, ...]
    needs: tuple[str, ...]
    make: Callable[[Path, Path | None], Sequence[FigureReport]]


def reproduce(
    data: Path | None, out: Path, only: Sequence[str] | None = None, progress: Progress | None = None
) -> PaperReport:
    """Make the paper's figures into `out`: SVG and CSV of each, `paper.json`, `paper.html`.

    data : folder with the recordings (`jhu/`, `tables/`, `torso-dev/`); None = what needs none. only : names of
    figures (fig7 … fig16) or steps (see `steps`). progress : called with (step, done, total).
    Raises RecipeError for an unknown name, ScanError, ResourceError.
    """
    chosen = _chosen(only)
    out.mkdir(parents=True, exist_ok=True)
    made: list[FigureReport] = []
    skipped, seconds = {}, {}
    for step in chosen:
        missing = [n for n in step.needs if data is None or not (data / n).exists()]
        if missing:
            where = "no --data folder was given" if data is None else f"{data} has no {', '.join(missing)}"
            skipped[step.name] = f"it needs {', '.join(step.needs)} ({where})"
            continue
        if progress:
            progress(step.name, 0, 1)
        start = time.monotonic()
        reports = step.make(out, data)
        made += reports
        seconds[reports[0].name] = time.monotonic() - start
        if progress:
            progress(step.name, 1, 1)
    report = PaperReport(tuple(made), skipped, seconds)
    report.write(out)
    return report


def steps() -> tuple[Step, ...]:
    """All steps, in the order of the paper."""
    return (
        Step("emissivity", ("table1", "fig7"), (), _emissivity),
        Step("phantom", ("fig8",), ("jhu/phantom",), _phantom8),
        Step("phantom-corrected", ("fig9",), ("jhu/phantom",), _phantom9),
        Step("cylinder", ("fig9",), (), _cylinder),
        Step("face", _FACE, ("jhu/face", "jhu/radiometry"), _face),
        Step("head", _FACE, (), _head),
        Step("sideview-head", ("fig16",), (), _side_head),
        Step("sideview-torso", ("fig16",), ("torso-dev",), _side_torso),
        Step("methods", (), (), _methods),
        Step("methods-torso", ("methods",), ("torso-dev",), _methods_torso),
    )


_FACE = ("fig11", "fig12", "fig13", "fig14", "fig15", "fig16")


def _chosen(only: Sequence[str] | None) -> tuple[Step, ...]:
    every = steps()
    if not only:
        return every
    known = {name for step in every for name in (step.name, *step.figures)}
    for name in only:
        if name not in known:
            raise RecipeError(
                f"there is no figure '{name}'", place="--only", hint=f"choose from {', '.join(sorted(known))}"
            )
    return tuple(step for step in every if {step.name, *step.figures} & set(only))


# Open3D and the renderer are loaded by the steps that need them.


def _emissivity(out: Path, data: Path | None) -> list[FigureReport]:
    from .emissivity_figures import figure7

    return [figure7(out, data)]


def _phantom8(out: Path, data: Path | None) -> list[FigureReport]:
    from .phantom_figures import figure8

    return [figure8(out, _given(data))]


def _phantom9(out: Path, data: Path | None) -> list[FigureReport]:
    from .phantom_figures import figure9

    return [figure9(out, _given(data))]


def _cylinder(out: Path, data: Path | None) -> list[FigureReport]:
    from .scan_figures import cylinder_scan

    return [cylinder_scan(out, out / WORK)]


def _face(out: Path, data: Path | None) -> list[FigureReport]:
    from .face_figures import face_figures

    return face_figures(out, _given(data))


def _head(out: Path, data: Path | None) -> list[FigureReport]:
    from .face_figures import head_figures

    return head_figures(out, out / WORK)


def _side_head(out: Path, data: Path | None) -> list[FigureReport]:
    from .scan_figures import side_view_head

    return [side_view_head(out, out / WORK)]


def _side_torso(out: Path, data: Path | None) -> list[FigureReport]:
    from .scan_figures import side_view_scan

    return [side_view_scan(out, out / WORK, _given(data) / "torso-dev")]


def _methods(out: Path, data: Path | None) -> list[FigureReport]:
    from .method_figures import methods_on_phantoms

    return [methods_on_phantoms(out, out / WORK)]


def _methods_torso(out: Path, data: Path | None) -> list[FigureReport]:
    from .method_figures import methods_on_scan

    return [methods_on_scan(out, out / WORK, _given(data) / "torso-dev")]


WORK = "work"  # sub-folder of `out` for phantom scans and results; may be deleted


def _given(data: Path | None) -> Path:
    if data is None:
        raise ScanError("the recordings are not here", hint="give their folder with --data")
    return data


__all__ = ["FigureReport", "Number", "PaperReport", "Step", "reproduce", "steps"]
