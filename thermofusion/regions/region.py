"""Regions of interest as they were drawn, and their file (docs/report.md).

A region is stored as marks on the skin (points with normals, a radius), in the result's upright frame: x to the
person's left, y up, z to the front. Another mesh or visit can take it. No vertex numbers, no statistics.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from ..errors import ScanError
from ..files.json import to_json
from ..files.reading import read_json
from ..files.strict import Border, validated
from ..files.whole import write_text
from ..version import __version__

SCHEMA: Literal["thermofusion-regions/1"] = "thermofusion-regions/1"
MAX_REGIONS, MAX_POINTS = 2000, 20_000  # of a file, of a region: far above what a hand draws

Point = tuple[
    Annotated[float, Field(ge=-1000, le=1000)],
    Annotated[float, Field(ge=-1000, le=1000)],
    Annotated[float, Field(ge=-1000, le=1000)],
]
Points = Annotated[list[Point], Field(min_length=1, max_length=MAX_POINTS)]


class _Drawn(Border):
    """What all regions have: a name, a person's own text."""

    name: str = Field("", max_length=200)


class Spot(_Drawn):
    """One point of the skin."""

    kind: Literal["spot"] = "spot"
    point_m: Point


class Brush(_Drawn):
    """A stroke, or a disc: skin within a radius of its points that faces as they do and hangs together with one."""

    kind: Literal["brush"] = "brush"
    points_m: Points
    normals: Points
    radius_m: float = Field(gt=0, le=1)


class Lasso(_Drawn):
    """The skin that the eye sees inside a drawn outline, looking against `toward_viewer` (parallel rays)."""

    kind: Literal["lasso"] = "lasso"
    outline_m: Annotated[list[Point], Field(min_length=3, max_length=MAX_POINTS)]
    toward_viewer: Point


class Line(_Drawn):
    """A line over the surface through points, the shortest way from each to the next."""

    kind: Literal["line"] = "line"
    points_m: Annotated[list[Point], Field(min_length=2, max_length=200)]


class Slab(_Drawn):
    """What lies between two parallel planes round a limb: `axis` from the first plane's point to the second's."""

    kind: Literal["slab"] = "slab"
    point_m: Point
    axis: Point
    length_m: float = Field(gt=0, le=3)


Region = Spot | Brush | Lasso | Line | Slab


class RegionsFile(Border):
    """A regions file."""

    schema_: Literal["thermofusion-regions/1"] = Field(SCHEMA, alias="schema")
    frame: Literal["upright"] = "upright"
    software: str = f"thermofusion {__version__}"
    scan: str = ""
    regions: list[Annotated[Region, Field(discriminator="kind")]] = Field(default_factory=list, max_length=MAX_REGIONS)


def read_regions(path: Path | str) -> list[Region]:
    """The regions of a file. Raises ScanError: not such a file, damaged, or another version."""
    tree = read_json(Path(path))
    if not isinstance(tree, dict) or tree.get("schema") != SCHEMA:
        raise ScanError(f"it is no regions file of schema '{SCHEMA}'", place=path, hint="save it from the report again")
    regions = validated(RegionsFile, tree, path).regions
    for number, region in enumerate(regions, 1):
        if isinstance(region, Brush) and len(region.normals) != len(region.points_m):
            raise ScanError(f"region {number} has another number of normals than points", place=path)
    return regions


def write_regions(path: Path | str, regions: Iterable[Region], scan: str = "") -> Path:
    """Write regions, so that `read_regions` gives them again. Raises ResourceError."""
    document = RegionsFile(schema=SCHEMA, scan=scan, regions=list(regions))
    return write_text(path, to_json(document.model_dump(by_alias=True)) + "\n")


def opposite(name: str) -> tuple[str, str] | None:
    """(side, what) of a region's name that begins or ends with left or right: "left knee" is ("left", "knee")."""
    words = name.replace(",", " ").replace("_", " ").split()
    for side in ("left", "right"):
        if len(words) > 1 and side in (words[0].lower(), words[-1].lower()):
            rest = words[1:] if words[0].lower() == side else words[:-1]
            return side, " ".join(rest).lower()
    return None
