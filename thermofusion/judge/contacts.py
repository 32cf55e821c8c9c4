"""Readings of contact thermometers from a CSV or JSON file: where on the skin, how warm, how sure."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..errors import ScanError
from ..types import Float

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

    p_world_m: tuple[float, float, float]
    degC: float = Field(gt=-100, lt=1000)
    uncertainty_K: float = Field(ge=0)
    name: str | None = None
    kind: str = "contact"


def read_contacts(path: Path) -> tuple[SkinReading, ...]:
    """The readings of a file. Raises ScanError naming the row that cannot be used."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as e:
        raise ScanError(f"the contact readings cannot be read ({e})", place=path) from None
    rows = _json_rows(text, path) if path.suffix.lower() == ".json" else _csv_rows(text, path)
    if not rows:
        raise ScanError("there is no contact reading in the file", place=path, hint=HINT)
    readings = []
    for number, row in enumerate(rows, 1):
        try:
            r = _Row.model_validate(row)
        except ValidationError as e:
            fault = e.errors()[0]
            where = ".".join(str(p) for p in fault["loc"])
            raise ScanError(f"reading {number}: {where}: {fault['msg'].lower()}", place=path, hint=HINT) from None
        name = r.name or f"spot {number}"
        readings.append(SkinReading(name, np.array(r.p_world_m), r.degC, r.uncertainty_K))
    return tuple(readings)


def _json_rows(text: str, path: Path) -> list[Any]:
    try:
        tree = json.loads(text)
    except json.JSONDecodeError as e:
        raise ScanError(f"not a JSON file ({e})", place=path, hint=HINT) from None
    if not isinstance(tree, list):
        raise ScanError("contact readings must be a list", place=path, hint=HINT)
    return tree


def _csv_rows(text: str, path: Path) -> list[Any]:
    table = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    head = [h.strip() for h in table.fieldnames or ()]
    missing = [c for c in COLUMNS if c not in head]
    if missing:
        raise ScanError(f"the column {missing[0]} is missing", place=path, hint=HINT)
    rows = []
    for raw in table:
        cells = {(k or "").strip(): (v or "").strip() for k, v in raw.items() if isinstance(v, str)}
        point = [cells.get(k, "") for k in ("x_m", "y_m", "z_m")]
        row = {"p_world_m": point, "degC": cells.get("degC"), "uncertainty_K": cells.get("uncertainty_K")}
        rows.append(row | {"name": cells.get("name") or None})
    return rows
