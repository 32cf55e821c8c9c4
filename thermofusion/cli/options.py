"""Options that several verbs share, in bundles: a parameter whose type is a bundle stands for all of its options."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from .console import note

if TYPE_CHECKING:
    from ..recipe import Recipe
    from ..types import Scan

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="section.key=value, over the recipe; repeatable")]


@dataclasses.dataclass(frozen=True)
class Recording:
    """A scan and its format."""

    scan: Annotated[Path, typer.Argument(help="A scan folder, or a foreign recording.")]
    format: Annotated[str | None, typer.Option(help="Format of the recording; recognised by default.")] = None

    def open(self) -> Scan:
        """The recording itself. Raises ScanError, RecipeError."""
        from ..scans import open_scan

        return open_scan(self.scan, format=self.format)


@dataclasses.dataclass(frozen=True)
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

    def load(self) -> Recipe:
        """The recipe, a note for keys that have new names. Raises RecipeError."""
        from ..recipe import load_recipe

        overrides = list(self.set_ or ())
        shorthand = {"surface.max_memory_gib": self.max_memory, "output.frame": self.frame, "output.front": self.front}
        shorthand |= {"output.compare_methods": "true"} if self.method == "all" else {"temperature.method": self.method}
        overrides += [f"{key}={value}" for key, value in shorthand.items() if value is not None]
        return load_recipe(self.recipe, overrides, note=note)


def unfolded(verb: Callable[..., Any]) -> Callable[..., Any]:
    """A verb as typer sees it: each bundle among its parameters replaced by the bundle's own options."""
    hints = get_type_hints(verb, include_extras=True)
    bundles: dict[str, Any] = {name: hint for name, hint in hints.items() if dataclasses.is_dataclass(hint)}
    flat: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(verb).parameters.items():
        if name not in bundles:
            flat.append(parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        own = get_type_hints(bundles[name], include_extras=True)
        for field in dataclasses.fields(bundles[name]):
            default = inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default
            kind = inspect.Parameter.KEYWORD_ONLY
            flat.append(inspect.Parameter(field.name, kind, default=default, annotation=own[field.name]))

    @functools.wraps(verb)
    def call(**given: Any) -> Any:
        for name, bundle in bundles.items():
            given[name] = bundle(**{f.name: given.pop(f.name) for f in dataclasses.fields(bundle)})
        return verb(**given)

    required_first = sorted(flat, key=lambda p: p.default is not inspect.Parameter.empty)
    call.__signature__ = inspect.Signature(required_first)  # type: ignore[attr-defined]
    call.__annotations__ = {p.name: p.annotation for p in flat}
    return call
