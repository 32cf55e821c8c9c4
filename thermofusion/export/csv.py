"""CSV, one row per vertex, for spreadsheets and statistics: no triangles; an empty cell is unmeasured.

Numbers are rounded far below what they are worth: positions to 1 µm, temperatures to 0.1 mK. `output_mode`, `level`,
`scan` and `run` stand in every row, so that rows of several results can be put together without mixing them up.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..files.reading import read_whole
from ..files.whole import write_whole
from ..types import ThermalMesh
from .columns import TABLE_PART, check_mesh, columns_of

POSITION, NORMAL, WORDS = ("x_m", "y_m", "z_m"), ("nx", "ny", "nz"), ("output_mode", "level", "scan", "run")


def write_csv(path: str | Path, mesh: ThermalMesh) -> Path:
    """Write the vertices of `mesh`. Raises ValueError for a broken mesh, ResourceError."""
    check_mesh(mesh)
    columns = {name: (values, "%.6f") for name, values in zip(POSITION, mesh.surface.vertices_m.T, strict=True)}
    columns |= {name: (values, "%.4f") for name, values in zip(NORMAL, mesh.surface.normals.T, strict=True)}
    for c in columns_of(mesh):
        values = getattr(mesh, c.field)
        columns[c.field] = values, "%d" if values.dtype.kind in "iu" else "%.4f"
    columns |= {TABLE_PART.format(name): (values, "%.4f") for name, values in mesh.uncertainty_parts.items()}
    cells = [_cells(values, form) for values, form in columns.values()]
    named = [re.sub(r'[",\s]+', " ", str(mesh.metadata.get(key, ""))) for key in ("scan", "run")]
    tail = ",".join([mesh.mode, "anchored" if mesh.anchored else "relative", *named]) + "\n"
    rows = (f"{','.join(row)},{tail}" for row in zip(*cells, strict=True))
    return write_whole(path, [",".join([*columns, *WORDS]).encode() + b"\n", "".join(rows).encode()])


def read_csv(path: str | Path) -> dict[str, NDArray]:
    """The columns (V,) by name, float64 in the unit of the name (NaN = empty cell) or text. Raises ScanError."""
    try:
        lines = read_whole(path).decode("utf-8").splitlines()
    except UnicodeDecodeError:
        raise ScanError("the file is no text", place=path) from None
    names = lines[0].split(",") if lines else []
    if not set(POSITION) <= set(names):
        raise ScanError("the CSV's first line does not name x_m, y_m and z_m", place=path)
    rows = [line.split(",") for line in lines[1:]]
    wrong = next((number for number, row in enumerate(rows, 2) if len(row) != len(names)), None)
    if wrong is not None:
        raise ScanError(
            f"the row has another number of cells than the {len(names)} names", place=f"{path}, line {wrong}"
        )
    table = {}
    for name, cells in zip(names, zip(*rows, strict=True) if rows else [()] * len(names), strict=True):
        try:
            numbers = np.array([float(cell) if cell else np.nan for cell in cells])
            table[name] = np.array(cells, np.str_) if name in WORDS else numbers
        except ValueError:
            if name not in WORDS:
                raise ScanError(f"the column {name} has a cell that is no number", place=path) from None
            table[name] = np.array(cells, np.str_)
    return table


def _cells(values: NDArray, form: str) -> list[str]:
    """Texts of one column; NaN becomes an empty cell."""
    texts = [form % value for value in values.tolist()]
    if values.dtype.kind == "f":
        for i in np.flatnonzero(np.isnan(values)).tolist():
            texts[i] = ""
    return texts
