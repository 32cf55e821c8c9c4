"""VTP (VTK XML PolyData, appended raw binary) for ParaView and VTK, whose PLY readers take no scalars."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..files.reading import read_array, read_whole
from ..files.whole import write_whole
from ..types import ThermalMesh
from .columns import COLUMNS, KNOWN, TABLE_PART, check_mesh, columns_of, describe, result_from, surface_from
from .palettes import color_range

NORMALS, SKIN, DESCRIPTION = "Normals", "color_rgb", "thermofusion"
_VTK = {"Float32": "<f4", "Float64": "<f8", "Int32": "<i4", "Int64": "<i8", "UInt8": "u1"}
_HEAD = '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">'
_MARK = b'<AppendedData encoding="raw">'


class _Appended:
    """Arrays for the appended section: each an UInt64 of its bytes, then the bytes."""

    def __init__(self) -> None:
        self.chunks: list[bytes | NDArray] = []
        self.size = 0

    def add(self, name: str, values: NDArray) -> str:
        """Append `values`; the DataArray element that points at them."""
        kind = {"f": "Float32", "i": "Int32", "u": "UInt8"}[values.dtype.kind]
        shape = f'NumberOfComponents="{values.shape[1]}" ' if values.ndim == 2 else ""
        element = f'<DataArray type="{kind}" Name="{name}" {shape}format="appended" offset="{self.size}"/>\n'
        self.chunks += [values.nbytes.to_bytes(8, "little"), values]
        self.size += 8 + values.nbytes
        return element


def write_vtp(
    path: str | Path, mesh: ThermalMesh, palette: str = "inferno", range_degC: tuple[float, float] | None = None
) -> Path:
    """Write `mesh`, lossless. VTP holds values, no palette: its name and range only stand in the description.

    Raises ValueError for a broken mesh, ResourceError.
    """
    check_mesh(mesh)
    surface, appended = mesh.surface, _Appended()
    data = {NORMALS: surface.normals} | {c.field: getattr(mesh, c.field) for c in columns_of(mesh)}
    data |= {TABLE_PART.format(name): values for name, values in mesh.uncertainty_parts.items()}
    data |= {} if surface.color_rgb is None else {SKIN: surface.color_rgb}
    description = describe(mesh, palette, color_range(mesh.temperature_degC, range_degC))
    text = " ".join(str(byte) for byte in json.dumps(description, allow_nan=False).encode() + b"\0")
    told = f"scan {mesh.metadata.get('scan', '')}, run {mesh.metadata.get('run', '')}".replace("--", "- -")
    told = "".join(c if c.isprintable() else "?" for c in told)  # a comment for people and grep; XML forbids some
    faces = len(surface.triangles)
    ends = np.arange(1, faces + 1, dtype=np.int32) * 3
    xml = f"""<?xml version="1.0"?>
<!-- {told} -->
{_HEAD}
<PolyData>
<FieldData><Array type="String" Name="{DESCRIPTION}" NumberOfTuples="1" format="ascii">{text}</Array></FieldData>
<Piece NumberOfPoints="{len(mesh)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" NumberOfPolys="{faces}">
<PointData Scalars="{COLUMNS[0].field}" Normals="{NORMALS}">
{"".join(appended.add(name, values) for name, values in data.items())}</PointData>
<Points>
{appended.add("Points", surface.vertices_m)}</Points>
<Polys>
{appended.add("connectivity", surface.triangles.ravel())}{appended.add("offsets", ends)}</Polys>
</Piece>
</PolyData>
"""
    return write_whole(path, [xml.encode(), _MARK, b"_", *appended.chunks, b"</AppendedData>\n</VTKFile>\n"])


def read_vtp(path: str | Path) -> ThermalMesh:
    """The mesh of a file of ours. Raises ScanError: not such a file, truncated, inconsistent."""
    data = read_whole(path)
    mark = data.find(_MARK)
    start = data.find(b"_", mark + len(_MARK)) + 1
    if mark < 0 or start == 0 or _HEAD.encode() not in data[:mark]:
        raise ScanError("the file is no VTP with appended raw data", place=path)
    if re.search(rb"<!(?!--)", data[:mark]):
        raise ScanError("the VTP's XML has declarations, which are not read", place=path)
    try:
        root = ET.fromstring(data[:mark] + b"</VTKFile>")
        pieces = root.findall("PolyData/Piece")
        (piece,) = pieces
        counts = {name: int(piece.get(f"NumberOf{name}", "0")) for name in ("Points", "Polys", "Strips", "Lines")}
        points = _arrays(piece, "Points", data, start, counts["Points"], path)
        polys = _arrays(piece, "Polys", data, start, counts["Polys"], path)
        columns = _arrays(piece, "PointData", data, start, counts["Points"], path)
        description = _description(root)
    except (ET.ParseError, ValueError, KeyError, RecursionError) as e:
        raise ScanError(f"the VTP is damaged ({e})", place=path) from None
    triangles = polys.get("connectivity", np.zeros(0, np.int32))
    if counts["Strips"] or counts["Lines"] or len(triangles) != 3 * counts["Polys"]:
        raise ScanError("the mesh has cells that are no triangles", place=path)
    if len(points) != 1 or next(iter(points.values())).shape != (counts["Points"], 3):
        raise ScanError("the VTP has no points", place=path)
    normals, skin = (columns.pop(name, None) for name in (NORMALS, SKIN))
    surface = surface_from(next(iter(points.values())), triangles.reshape(-1, 3), normals, skin, path)
    head, tail = TABLE_PART.split("{}")
    known = {c.field for c in KNOWN}
    parts = {n[len(head) : -len(tail)]: v for n, v in columns.items() if n not in known and n.startswith(head)}
    return result_from(surface, {n: v for n, v in columns.items() if n in known}, parts, description, path)


def _arrays(piece: ET.Element, section: str, data: bytes, start: int, count: int, place: object) -> dict[str, NDArray]:
    """The appended arrays of a section by name; (N,) or (N, 3). Raises ValueError, KeyError, ScanError."""
    arrays = {}
    for element in piece.findall(f"{section}/DataArray"):
        name, dtype = element.get("Name", ""), np.dtype(_VTK[element.get("type", "")])
        at, width = start + int(element.attrib["offset"]), int(element.get("NumberOfComponents", "1"))
        if at < start or width < 1:
            raise ValueError(f"array {name}")
        nbytes = int(read_array(data, "<u8", 1, at, place)[0])
        if nbytes % (dtype.itemsize * width) or (section != "Polys" and nbytes != count * width * dtype.itemsize):
            raise ScanError(f"the VTP's array {name} has another length than the header says", place=place)
        values = read_array(data, dtype, nbytes // dtype.itemsize, at + 8, place)
        arrays[name] = values.reshape(-1, width) if width > 1 else values
    return arrays


def _description(root: ET.Element) -> dict[str, Any]:
    for element in root.findall("PolyData/FieldData/Array"):
        if element.get("Name") == DESCRIPTION:
            description = json.loads(bytes(int(word) for word in (element.text or "").split()).rstrip(b"\0"))
            if isinstance(description, dict):
                return description
    return {}
