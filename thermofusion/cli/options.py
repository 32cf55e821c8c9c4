"""Options that several verbs share, in bundles: a parameter whose type is a bundle stands for all of its options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from .console import low_high, note

if TYPE_CHECKING:
    from ..recipe import Recipe
    from ..report.html import Reported
    from ..types import Scan

T = TypeVar("T")
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="section.key=value, over the recipe; repeatable")]


@dataclass(frozen=True)
class Recording:
    """A scan and its format."""

    scan: Annotated[Path, typer.Argument(help="A scan folder, or a foreign recording.")]
    format: Annotated[str | None, typer.Option(help="Format of the recording; recognised by default.")] = None

    def open(self) -> Scan:
        """The recording itself. Raises ScanError, RecipeError."""
        from ..scans import open_scan

        return open_scan(self.scan, format=self.format)


@dataclass(frozen=True)
class Processing:
    """A recipe and what goes over it."""

    recipe: Annotated[str, typer.Option("-r", "--recipe", help="A shipped name or a TOML file.")] = "torso"
    set_: Overrides = None
    method: Annotated[
        str | None, typer.Option(help="joint, corrected-cos, cos-resolution, mean, nearest-view, paper; or `all`.")
    ] = None
    max_memory: Annotated[float | None, typer.Option("--max-memory", help="Bound on the voxel grid, GiB.")] = None
    frame: Annotated[str | None, typer.Option(help="Frame of the result: upright or world.")] = None
    front: Annotated[
        str | None, typer.Option(help="Side of the person in the first depth frame: auto, front, back, left, right.")
    ] = None

    def load(self, note: Callable[[str], None] = note) -> Recipe:
        """The recipe, a note for keys that have new names. Raises RecipeError."""
        from ..recipe import load_recipe

        overrides = list(self.set_ or ())
        shorthand = {"surface.max_memory_gib": self.max_memory, "output.frame": self.frame, "output.front": self.front}
        shorthand |= {"output.compare_methods": "true"} if self.method == "all" else {"temperature.method": self.method}
        overrides += [f"{key}={value}" for key, value in shorthand.items() if value is not None]
        return load_recipe(self.recipe, overrides, note=note)


@dataclass(frozen=True)
class Drawing:
    """How a result is coloured and how large its pictures are."""

    palette: Annotated[str, typer.Option(help="inferno, iron, grey, cividis, rainbow.")] = "inferno"
    range_: Annotated[str | None, typer.Option("--range", help="Colour range in °C, low:high.")] = None
    size: Annotated[int, typer.Option("--size", min=300, max=6000, help="Height of the pictures, px.")] = 900

    @property
    def range_degC(self) -> tuple[float, float] | None:
        """The two ends of the range. Raises RecipeError."""
        return low_high(self.range_, "°C")


@dataclass(frozen=True)
class Filed:
    """What of a result is filed: regions with it, and whom it may show."""

    regions: Annotated[Path | None, typer.Option("--regions", help="Regions JSON, for report and DICOM.")] = None
    deidentify: Annotated[
        bool, typer.Option("--deidentify", help="Without colour, face, names, dates and free text.")
    ] = False

    def reported(self, result: Path, before: Path | None = None) -> Reported:
        """The result of a folder as it may be filed; before : of an earlier visit. Raises ScanError, RecipeError."""
        from ..errors import RecipeError
        from ..regions import read_regions
        from ..report.deidentify import deidentified
        from ..results.folder import report_of

        if before is not None and self.regions is None:
            raise RecipeError("--before compares regions", hint="give --regions FILE, as the report saves it")
        reported = report_of(result, [] if self.regions is None else read_regions(self.regions), before)
        return deidentified(reported) if self.deidentify else reported


def spelled_out(verb: Callable[..., T]) -> Callable[..., T]:
    """A verb for typer: a parameter that is a dataclass becomes its fields, an option each."""
    own = signature(verb, eval_str=True).parameters
    kinds: dict[str, Any] = {n: p.annotation for n, p in own.items() if is_dataclass(p.annotation)}
    bundles = {n: signature(kind, eval_str=True).parameters for n, kind in kinds.items()}

    def flat(**given: Any) -> T:
        packed = {n: kinds[n](**{k: given.pop(k) for k in fields}) for n, fields in bundles.items()}
        return verb(**given, **packed)

    spelled = [p for n in own for p in (bundles[n].values() if n in bundles else [own[n]])]
    flat.__signature__ = Signature([p.replace(kind=Parameter.KEYWORD_ONLY) for p in spelled])  # type: ignore[attr-defined]
    flat.__name__, flat.__doc__ = verb.__name__, verb.__doc__
    return flat
