"""Readings of contact thermometers from a CSV or JSON file: where on the skin, how warm, how sure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ..errors import ScanError
from ..files.reading import read_json
from ..files.strict import validated
from ..files.table import table_rows
from ..scans.native.schema import Metres
from ..types import Float

MAX_READINGS = 10_000  # each is searched on the whole surface
COLUMNS = ("x_m", "y_m", "z_m", "degC", "uncertainty_K")
HINT = (
    f"a CSV has the columns {', '.join(COLUMNS)} and, if wanted, name; a JSON list has p_world_m, degC, uncertainty_K"
)


@dataclass(frozen=True, eq=False)
class SkinReading:
    """A thermometer's reading at a point p_world_m (3,) of the result's frame. uncertainty_K : one sigma."""

    name: str
    p_world_m: Float
    degC: float
    uncertainty_K: float


class _Row(BaseModel):
    """One reading as it stands in a file."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    p_world_m: tuple[Metres, Metres, Metres]
    degC: float = Field(ge=-50, le=150)
    uncertainty_K: float = Field(ge=0, le=10)
    name: str | None = Field(None, max_length=200)
    kind: str = Field("contact", max_length=200)


def read_contacts(path: Path) -> tuple[SkinReading, ...]:
    """The readings of a file. Raises ScanError naming the row that cannot be used."""
    readings = []
    for number, row in enumerate(_json_rows(path) if path.suffix.lower() == ".json" else _csv_rows(path), 1):
        if number > MAX_READINGS:
            raise ScanError(f"more than {MAX_READINGS} contact readings", place=path)
        r = validated(_Row, row, f"{path}, reading {number}", HINT)
        name = r.name or f"spot {number}"
        readings.append(SkinReading(name, np.array(r.p_world_m), r.degC, r.uncertainty_K))
    if not readings:
        raise ScanError("there is no contact reading in the file", place=path, hint=HINT)
    return tuple(readings)


def _json_rows(path: Path) -> list[Any]:
    tree = read_json(path, "contact readings")
    if not isinstance(tree, list):
        raise ScanError("contact readings must be a list", place=path, hint=HINT)
    return tree


def _csv_rows(path: Path) -> Iterator[dict[str, Any]]:
    for _, cells in table_rows(path, "contact readings", COLUMNS):
        row: dict[str, Any] = {"p_world_m": [cells[k] for k in ("x_m", "y_m", "z_m")]}
        row |= {"degC": cells["degC"], "uncertainty_K": cells["uncertainty_K"]}
        yield row | {"name": cells.get("name") or None}
