"""What every format carries: one table of per-vertex columns, and one description of the result.

A new column is added here; each writer and reader, and the test of docs/formats.md, go by this table.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..types import Float32, Int, OutputMode, SurfaceMesh, ThermalMesh, UInt8
from ..version import __version__

SCHEMA = "thermofusion-mesh/1"


@dataclass(frozen=True)
class Column:
    """A per-vertex quantity: `field` of ThermalMesh (also its name in VTP and CSV), and its name in PLY and GLB."""

    field: str
    ply: str
    glb: str
    unit: str
    meaning: str


COLUMNS = (
    Column("temperature_degC", "scalar_temperature", "_TEMPERATURE", "degC", "temperature in the output mode"),
    Column("apparent_degC", "scalar_temperature_apparent", "_TEMPERATURE_APPARENT", "degC", "as a blackbody"),
    Column("uncertainty_K", "scalar_uncertainty", "_UNCERTAINTY", "K", "one sigma"),
    Column("view_angle_deg", "scalar_view_angle", "_VIEW_ANGLE", "deg", "of the straightest view"),
    Column("distance_m", "scalar_distance", "_DISTANCE", "m", "of the straightest view"),
    Column("observations", "scalar_observations", "_OBSERVATIONS", "1", "thermal views that count"),
    Column("flags", "scalar_flags", "_FLAGS", "1", "bits of VertexFlag"),
)
# Of a subject that moved; absent from files of one that stood still.
MOVED = Column("moved_mm", "scalar_moved", "_MOVED", "mm", "rms of the motion against the trunk")
KNOWN = (*COLUMNS, MOVED)  # what readers look for
PLY_PART = "scalar_uncertainty_"  # + name of a part of the budget
TABLE_PART = "uncertainty_{}_K"  # in VTP and CSV


def columns_of(mesh: ThermalMesh) -> tuple[Column, ...]:
    """The columns that a mesh has."""
    return COLUMNS if mesh.moved_mm is None else KNOWN


def describe(
    mesh: ThermalMesh, palette: str, range_degC: tuple[float, float], color: str = "palette"
) -> dict[str, Any]:
    """What a file says of itself, JSON-ready; `result_from` reads it back."""
    return {
        "schema": SCHEMA,
        "software": f"thermofusion {__version__}",
        "frame": str(mesh.metadata.get("frame", "world")),
        "length_unit": "m",
        "output_mode": mesh.mode,
        "level": "anchored" if mesh.anchored else "relative",
        "palette": palette,
        "range_degC": list(range_degC),
        "color": color,
        "metadata": {k: v if isinstance(v, str) else float(v) for k, v in mesh.metadata.items()},
    }


def result_from(
    surface: SurfaceMesh,
    columns: Mapping[str, NDArray],
    parts: Mapping[str, NDArray],
    description: Mapping[str, Any],
    place: object,
) -> ThermalMesh:
    """A ThermalMesh from what a reader found; absent columns become NaN, or 0 for counts and flags.

    columns : field -> (V,) in its unit. parts : part of the budget -> (V,) K. Raises ScanError naming the place.
    """
    mode = description.get("output_mode", "absolute")
    metadata = description.get("metadata", {})
    if mode not in get_args(OutputMode) or description.get("level", "anchored") not in ("anchored", "relative"):
        raise ScanError("the file's description names no known output mode and level", place=place)
    if not isinstance(metadata, dict) or not all(isinstance(v, str | float | int) for v in metadata.values()):
        raise ScanError("the file's metadata is not a table of texts and numbers", place=place)

    def column(name: str) -> NDArray:
        counts = name in ("observations", "flags")
        values = columns.get(name, np.full(len(surface), 0 if counts else np.nan))
        if counts:
            values = np.nan_to_num(values)
            if ((values < 0) | (values > (255 if name == "flags" else 2**31 - 129))).any():
                raise ScanError(f"the {name} are no counts", place=place)
        return values

    try:
        return ThermalMesh(
            surface=surface,
            mode=mode,
            anchored=description.get("level", "anchored") == "anchored",
            uncertainty_parts=dict(parts),
            metadata=metadata,
            moved_mm=columns.get(MOVED.field),
            **{c.field: column(c.field) for c in COLUMNS},
        )
    except ValueError as e:
        raise ScanError(str(e), place=place) from None


def surface_from(
    vertices_m: NDArray, triangles: NDArray, normals: NDArray | None, color_rgb: NDArray | None, place: object
) -> SurfaceMesh:
    """A checked SurfaceMesh from a file's arrays; absent normals are computed.

    vertices_m : (V, 3). triangles : (F, 3). normals : (V, 3) unit. color_rgb : (V, 3) sRGB. Raises ScanError.
    """
    if not np.isfinite(vertices_m).all():
        raise ScanError("a vertex position is not a finite number", place=place)
    if len(triangles) and not (0 <= int(triangles.min()) <= int(triangles.max()) < len(vertices_m)):
        raise ScanError(f"a triangle names a vertex outside 0..{len(vertices_m) - 1}", place=place)
    v: Float32 = np.ascontiguousarray(vertices_m, np.float32)
    t: Int = np.ascontiguousarray(triangles, np.int32)
    n: Float32 = vertex_normals(v, t) if normals is None else np.ascontiguousarray(normals, np.float32)
    c: UInt8 | None = None if color_rgb is None else np.ascontiguousarray(color_rgb, np.uint8)
    return SurfaceMesh(v, t, n, c)


def check_mesh(mesh: ThermalMesh) -> None:
    """Raises ValueError for a mesh that no file should carry: writers call it first."""
    surface = mesh.surface
    v, t = surface.vertices_m, surface.triangles
    if v.shape != (len(v), 3) or surface.normals.shape != v.shape or t.shape != (len(t), 3):
        raise ValueError("a surface needs (V, 3) vertices and normals and (F, 3) triangles")
    if not np.isfinite(v).all():
        raise ValueError("a vertex position is not a finite number")
    if len(t) and not (0 <= int(t.min()) <= int(t.max()) < len(v)):
        raise ValueError(f"a triangle names a vertex outside 0..{len(v) - 1}")
    if not all(re.fullmatch("[a-z0-9_]+", name) for name in mesh.uncertainty_parts):
        raise ValueError("parts of the uncertainty are named in small letters, digits and underscores")


def vertex_normals(vertices_m: Float32, triangles: Int) -> Float32:
    """Area-weighted unit normals (V, 3) of vertices_m (V, 3) m and triangles (F, 3); (0, 0, 1) where there is none."""
    a, b, c = (vertices_m[triangles[:, i]].astype(np.float64) for i in range(3))
    face = np.cross(b - a, c - a)
    sums = [np.bincount(triangles.ravel(), np.repeat(face[:, k], 3), len(vertices_m)) for k in range(3)]
    return unit_normals(np.stack(sums, axis=1))


def unit_normals(normals: NDArray) -> Float32:
    """Normals (N, 3) of unit length (glTF demands it); a zero or NaN normal becomes (0, 0, 1)."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    ok = np.isfinite(length) & (length > 1e-12)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(ok, normals / length, [0.0, 0.0, 1.0]).astype(np.float32)
