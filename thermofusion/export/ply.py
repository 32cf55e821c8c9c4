"""PLY, binary little-endian: for CloudCompare (`scalar_*`), MeshLab (`quality`), Blender, Open3D, Python.

The description stands in comment lines, `comment thermofusion <key> <JSON>`; a long value goes on in further lines of
the same key (MeshLab's reader refuses header lines of about 500 characters). Colours: sRGB bytes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..files.reading import read_array, read_whole
from ..files.whole import write_whole
from ..types import ThermalMesh, UInt8
from .columns import KNOWN, PLY_PART, check_mesh, columns_of, describe, result_from, surface_from
from .palettes import apply, color_range

XYZ, NORMAL, RGB = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
QUALITY = "quality"  # = scalar_temperature, for MeshLab
FACE = np.dtype([("n", "u1"), ("v", "<i4", 3)])
COMMENT_CHARACTERS = 200  # of a value in one header line: MeshLab refuses lines of about 500
_NUMBERS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_NUMBERS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_NUMBERS |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}


def write_ply(
    path: str | Path,
    mesh: ThermalMesh,
    palette: str = "inferno",
    range_degC: tuple[float, float] | None = None,
    color: Literal["palette", "skin"] = "palette",
) -> Path:
    """Write `mesh`; vertices and triangles keep their order, every number its float32 bits.

    range_degC : of the palette; None = `palettes.color_range`. color : `skin` puts the colour camera's picture into
    red, green, blue instead of the palette. Raises ValueError for a broken mesh or absent skin colour, ResourceError.
    """
    check_mesh(mesh)
    shown = color_range(mesh.temperature_degC, range_degC)
    rgb = _skin(mesh) if color == "skin" else apply(mesh.temperature_degC, palette, *shown)
    columns: dict[str, NDArray] = dict(zip(XYZ, mesh.surface.vertices_m.T, strict=True))
    columns |= dict(zip(NORMAL, mesh.surface.normals.T, strict=True))
    columns |= dict(zip(RGB, rgb.T, strict=True))
    columns |= {c.ply: getattr(mesh, c.field) for c in columns_of(mesh)}
    columns[QUALITY] = mesh.temperature_degC
    columns |= {PLY_PART + name: values for name, values in mesh.uncertainty_parts.items()}

    vertices = np.empty(len(mesh), [(name, "u1" if name in RGB else "<f4") for name in columns])
    for name, values in columns.items():
        vertices[name] = values
    faces = np.empty(len(mesh.surface.triangles), FACE)
    faces["n"], faces["v"] = 3, mesh.surface.triangles
    return write_whole(path, (_header(vertices, faces, describe(mesh, palette, shown, color)), vertices, faces))


def read_ply(path: str | Path) -> ThermalMesh:
    """The mesh of a file of ours, or of any little-endian PLY with triangles: what is absent is NaN, 0 or computed.

    Raises ScanError: not such a file, truncated, inconsistent.
    """
    data = read_whole(path)
    header = _parse(data, path)
    vertices = read_array(data, np.dtype(header.vertex), header.vertices, header.size, path)
    faces = read_array(data, FACE, header.faces, header.size + vertices.nbytes, path)
    if not (faces["n"] == 3).all():
        raise ScanError("the mesh has faces that are no triangles", place=path, hint="triangulate it first")
    names = vertices.dtype.names or ()
    normals = _stack(vertices, NORMAL) if set(NORMAL) <= set(names) else None
    skin = set(RGB) <= set(names) and header.description.get("color", "skin") == "skin"
    color = _stack(vertices, RGB) if skin else None
    surface = surface_from(_stack(vertices, XYZ), faces["v"], normals, color, path)
    columns = {c.field: vertices[c.ply] for c in KNOWN if c.ply in names}
    parts = {n.removeprefix(PLY_PART): vertices[n] for n in names if n.startswith(PLY_PART)}
    return result_from(surface, columns, parts, header.description, path)


def _skin(mesh: ThermalMesh) -> UInt8:
    if mesh.surface.color_rgb is None:
        raise ValueError("the surface has no skin colour: the scan has no colour camera, or fusion.color is off")
    return mesh.surface.color_rgb


def _stack(vertices: NDArray, names: tuple[str, ...]) -> NDArray:
    return np.stack([vertices[n] for n in names], axis=1)


def _header(vertices: NDArray, faces: NDArray, description: dict[str, Any]) -> bytes:
    there = vertices.dtype.names or ()
    units = {c.ply: c.unit for c in KNOWN if c.ply in there} | {"x y z": "m", QUALITY: "degC"}
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [line for key, value in (description | {"units": units}).items() for line in _comment(key, value)]
    lines.append(f"element vertex {len(vertices)}")
    lines += [f"property {'uchar' if name in RGB else 'float'} {name}" for name in there]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode("ascii")


def _comment(key: str, value: object) -> Iterator[str]:
    text = json.dumps(value, allow_nan=False)  # ASCII, one line
    for start in range(0, len(text), COMMENT_CHARACTERS):
        yield f"comment thermofusion {key} {text[start : start + COMMENT_CHARACTERS]}"


@dataclass
class _Header:
    size: int
    vertices: int = -1
    faces: int = -1
    vertex: list[tuple[str, str]] = field(default_factory=list)
    description: dict[str, Any] = field(default_factory=dict)


def _is_count(word: str) -> bool:
    return word.isascii() and word.isdecimal() and len(word) < 20


def _parse(data: bytes, place: str | Path) -> _Header:
    """The header. Raises ScanError for what `read_ply` cannot read."""
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise ScanError("the file is no PLY", place=place)
    end = data.find(b"\nend_header")  # at the start of a line: a name in a comment may say it, too
    size = data.find(b"\n", end + 1) + 1
    if end < 0 or size == 0:
        raise ScanError("the PLY header has no end", place=place)
    header, comments = _Header(size), dict[str, str]()
    element, formats, lists = "", list[str](), list[str]()
    for line in data[:end].decode("latin-1").replace("\r", "").split("\n"):
        match line.split():
            case ["format", *rest]:
                formats.append(" ".join(rest))
            case ["comment", "thermofusion", key, *_]:
                comments[key] = comments.get(key, "") + line.split(" ", 3)[-1]
            case ["element", "vertex", count] if _is_count(count) and not element:
                element, header.vertices = "vertex", int(count)
            case ["element", "face", count] if _is_count(count) and element == "vertex":
                element, header.faces = "face", int(count)
            case ["property", kind, name] if element == "vertex" and kind in _NUMBERS:
                header.vertex.append((name, "<" + _NUMBERS[kind]))
            case ["property", *words] if element == "face":
                lists.append(" ".join(words))
            case ["element" | "property", *_]:
                raise ScanError(f"the PLY header has a line that is not understood: '{line[:80]}'", place=place)
    if formats != ["binary_little_endian 1.0"]:
        raise ScanError(f"the PLY is {' '.join(formats) or 'of no format'}, expected binary_little_endian", place=place)
    names = [name for name, _ in header.vertex]
    if not set(XYZ) <= set(names) or len(set(names)) < len(names):
        raise ScanError("the PLY's vertices have no x, y and z, or a property twice", place=place)
    if lists not in [[f"list {n} {i} {v}"] for n in ("uchar", "uint8") for i in ("int", "uint", "int32", "uint32")
                     for v in ("vertex_indices", "vertex_index")]:  # fmt: skip
        raise ScanError("the PLY's faces are no list of vertex indices", place=place)
    try:
        header.description = {key: json.loads(text) for key, text in comments.items()}
    except (ValueError, RecursionError):
        raise ScanError("the PLY's thermofusion comments are damaged", place=place) from None
    return header
