"""GLB (glTF 2.0 binary) for web viewers, Blender, three.js; the report carries one.

Mesh `skin`: the triangles whose three corners are measured, with float32 attributes and `COLOR_0` in *linear* light.
Mesh `unmeasured`: the rest, grey, without attributes, for NaN is illegal in glTF. Both index one array of vertices,
ordered [skin only | both | unmeasured]: each mesh's share is one contiguous stretch and nothing is stored twice.

Positions stay in the world frame. glTF is y up, +z front: the root node's rotation turns the world that way.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import ScanError
from ..files.reading import read_array, read_whole
from ..files.whole import write_whole
from ..types import Bool, ThermalMesh
from ..version import __version__
from .axes import axes_of
from .columns import KNOWN, check_mesh, columns_of, describe, result_from, surface_from, unit_normals
from .palettes import apply, color_range, srgb_to_linear, unmeasured_rgb

FLOAT, UINT16, UINT32 = 5126, 5123, 5125  # glTF's componentType
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963  # glTF's bufferView.target
SKIN, UNMEASURED = "skin", "unmeasured"
_SHAPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_DTYPES = {FLOAT: "<f4", UINT16: "<u2", UINT32: "<u4"}


class _Builder:
    """glTF's buffer, views and accessors, growing together."""

    def __init__(self) -> None:
        self.chunks: list[bytes | NDArray] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, values: NDArray, target: int, stride: int | None = None) -> int:
        """Store an array (4-byte multiples); the number of its bufferView."""
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": values.nbytes, "target": target}
        self.views.append(view | ({"byteStride": stride} if stride else {}))
        self.chunks.append(values)
        self.size += values.nbytes
        return len(self.views) - 1

    def accessor(self, view: int, values: NDArray, *, start: int = 0, bounds: bool = True) -> int:
        """An accessor of `values`, which lie `start` bytes into the view."""
        kind = {"f": FLOAT, "u": UINT32 if values.itemsize == 4 else UINT16}[values.dtype.kind]
        width = values.shape[1] if values.ndim == 2 else 1
        shape = next(name for name, n in _SHAPES.items() if n == width)
        accessor = {"bufferView": view, "componentType": kind, "count": len(values), "type": shape}
        if start:
            accessor["byteOffset"] = start
        if kind == UINT16:
            accessor["normalized"] = True
        if bounds:
            accessor["min"] = np.atleast_1d(values.min(axis=0)).tolist()
            accessor["max"] = np.atleast_1d(values.max(axis=0)).tolist()
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_glb(
    path: str | Path, mesh: ThermalMesh, palette: str = "inferno", range_degC: tuple[float, float] | None = None
) -> Path:
    """Write `mesh` with an unlit, double-sided palette colour.

    A column that some measured vertex lacks is left out (named in `extras.thermofusion.omitted`), as are unmeasured
    vertices of no triangle and the budget's parts. Raises ValueError for a broken mesh or one without triangles,
    ResourceError.
    """
    check_mesh(mesh)
    if not len(mesh.surface.triangles):
        raise ValueError("glTF cannot carry a mesh without triangles")
    shown = color_range(mesh.temperature_degC, range_degC)
    build = _Builder()
    meshes, omitted = _meshes(build, mesh, palette, shown)
    description = describe(mesh, palette, shown) | {
        "units": {c.glb: c.unit for c in columns_of(mesh)},
        "omitted": omitted,
    }
    rotation = Rotation.from_matrix(axes_of(mesh.metadata)).as_quat(canonical=True).tolist()
    children = [{"name": m["name"], "mesh": i} for i, m in enumerate(meshes)]
    root = {"name": "thermofusion", "rotation": rotation, "children": list(range(1, len(meshes) + 1))}
    gltf = {
        "asset": {"version": "2.0", "generator": f"thermofusion {__version__}"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "extras": {"thermofusion": description},
        "scene": 0,
        "scenes": [{"name": "thermofusion", "nodes": [0]}],
        "nodes": [root, *children],
        "meshes": meshes,
        "materials": [_material(m["name"], palette) for m in meshes],
        "accessors": build.accessors,
        "bufferViews": build.views,
        "buffers": [{"byteLength": build.size}],
    }
    text = json.dumps(gltf, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + build.size
    head = b"glTF" + _u32(2, total, len(text)) + b"JSON"
    return write_whole(path, [head, text, _u32(build.size), b"BIN\0", *build.chunks])


def _meshes(
    build: _Builder, mesh: ThermalMesh, palette: str, shown: tuple[float, float]
) -> tuple[list[dict[str, Any]], list[str]]:
    """The one or two meshes and the names of columns left out."""
    surface, measured = mesh.surface, mesh.measured
    is_skin: Bool = np.all(measured[surface.triangles], axis=1)
    order, skin_count, rest_start = _order(surface.triangles, is_skin, measured)
    place = np.empty(len(mesh), np.uint32)
    place[order] = np.arange(len(mesh), dtype=np.uint32)
    triangles = place[surface.triangles]
    kept = len(mesh) if not is_skin.all() else skin_count  # no grey mesh, no unmeasured vertices
    positions = np.ascontiguousarray(surface.vertices_m[order[:kept]])
    normals = unit_normals(surface.normals[order[:kept]])
    shared = build.view(positions, ARRAY_BUFFER, 12), build.view(normals, ARRAY_BUFFER, 12)

    def primitive(lo: int, hi: int, faces: NDArray, extra: dict[str, int]) -> dict[str, Any]:
        indices = np.ascontiguousarray(faces - np.uint32(lo)).ravel()
        attributes = {
            "POSITION": build.accessor(shared[0], positions[lo:hi], start=12 * lo),
            "NORMAL": build.accessor(shared[1], normals[lo:hi], start=12 * lo, bounds=False),
        }
        at = build.accessor(build.view(indices, ELEMENT_ARRAY_BUFFER), indices)
        return {"attributes": attributes | extra, "indices": at, "mode": 4}

    meshes: list[dict[str, Any]] = []
    omitted: list[str] = []
    if is_skin.any():
        extra, omitted = _attributes(build, mesh, order[:skin_count], palette, shown)
        meshes.append({"name": SKIN, "primitives": [primitive(0, skin_count, triangles[is_skin], extra)]})
    if not is_skin.all():
        meshes.append({"name": UNMEASURED, "primitives": [primitive(rest_start, kept, triangles[~is_skin], {})]})
    for number, m in enumerate(meshes):
        m["primitives"][0]["material"] = number
    return meshes, omitted


def _order(triangles: NDArray, is_skin: Bool, measured: Bool) -> tuple[NDArray, int, int]:
    """Vertex order [skin only | both | unmeasured]; how many have a temperature; where the grey mesh begins."""
    in_rest = np.zeros(len(measured), bool)
    in_rest[triangles[~is_skin].ravel()] = True
    group = np.where(measured, in_rest.astype(np.int8), np.int8(2))
    return np.argsort(group, kind="stable"), int(measured.sum()), int((group == 0).sum())


def _attributes(
    build: _Builder, mesh: ThermalMesh, vertices: NDArray, palette: str, shown: tuple[float, float]
) -> tuple[dict[str, int], list[str]]:
    """COLOR_0 and the scalar attributes of the skin; names of columns that are not complete."""
    srgb = apply(mesh.temperature_degC[vertices], palette, *shown)
    linear = np.full((len(vertices), 4), 65535, np.uint16)
    linear[:, :3] = np.round(srgb_to_linear(np.arange(256, dtype=np.uint8)) * 65535).astype(np.uint16)[srgb]
    attributes = {"COLOR_0": build.accessor(build.view(linear, ARRAY_BUFFER), linear)}
    omitted = []
    for column in columns_of(mesh):
        values = getattr(mesh, column.field)[vertices].astype(np.float32)
        if np.isnan(values).any():
            omitted.append(column.glb)
        else:
            attributes[column.glb] = build.accessor(build.view(values, ARRAY_BUFFER), values)
    return attributes, omitted


def _material(name: str, palette: str) -> dict[str, Any]:
    """Unlit: light must not change what reads as a temperature. Base colours are linear too."""
    grey = srgb_to_linear(np.array(unmeasured_rgb(palette), np.uint8)).tolist() if name == UNMEASURED else [1.0] * 3
    pbr = {"baseColorFactor": [*grey, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    unlit: dict[str, Any] = {"KHR_materials_unlit": {}}
    return {"name": name, "doubleSided": True, "pbrMetallicRoughness": pbr, "extensions": unlit}


def _u32(*numbers: int) -> bytes:
    return np.array(numbers, "<u4").tobytes()


def read_glb(path: str | Path) -> ThermalMesh:
    """The mesh of a file of ours, in the world frame; vertices in the file's order (see the module), no parts.

    Raises ScanError: not such a file, truncated, inconsistent.
    """
    data = read_whole(path)
    try:
        gltf, binary = _chunks(data, path)
        description = gltf["extras"]["thermofusion"]
        primitives = {m["name"]: m["primitives"][0] for m in gltf["meshes"]}
        accessors = gltf["accessors"]
        stretches = []  # (first vertex, positions, normals, triangles) of each mesh
        for primitive in primitives.values():
            at = primitive["attributes"]["POSITION"]
            p, n = (_read(gltf, binary, primitive["attributes"][name], path) for name in ("POSITION", "NORMAL"))
            faces = _read(gltf, binary, primitive["indices"], path).astype(np.int64)
            stretches.append((int(accessors[at].get("byteOffset", 0)) // 12, p, n, faces.reshape(-1, 3)))
        attributes = primitives[SKIN]["attributes"] if SKIN in primitives else {}
        found = {c.field: _read(gltf, binary, attributes[c.glb], path) for c in KNOWN if c.glb in attributes}
        count = max(first + len(p) for first, p, _, _ in stretches)
        if not 0 < count <= len(data) // 12:
            raise ValueError("vertices")
        positions, normals = np.full((2, count, 3), np.nan, np.float32)
        for first, p, n, _ in stretches:
            positions[first : first + len(p)], normals[first : first + len(p)] = p, n
        triangles = np.concatenate([faces + first for first, _, _, faces in stretches])
        columns = {}
        for name, values in found.items():
            columns[name] = np.full(count, 0 if name in ("observations", "flags") else np.nan, np.float32)
            columns[name][: len(values)] = values
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
        raise ScanError("the GLB is none that thermofusion wrote, or is damaged", place=path) from None
    return result_from(surface_from(positions, triangles, normals, None, path), columns, {}, description, path)


def _chunks(data: bytes, place: object) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk."""
    if data[:4] != b"glTF" or len(data) < 28:
        raise ScanError("the file is no GLB", place=place)
    version, total, size = read_array(data, "<u4", 3, 4, place).tolist()
    at = 20 + size
    if version != 2 or total != len(data) or at + 8 > total:
        raise ScanError("the GLB is truncated, or of another version", place=place)
    length = int(read_array(data, "<u4", 1, at, place)[0])
    if data[16:20] != b"JSON" or data[at + 4 : at + 8] != b"BIN\0" or at + 8 + length > total:
        raise ScanError("the GLB's chunks are not JSON and BIN", place=place)
    return json.loads(data[20:at]), data[at + 8 : at + 8 + length]


def _read(gltf: dict[str, Any], binary: bytes, number: int, place: object) -> NDArray:
    """An accessor's array, (N,) or (N, width). Raises what a damaged description raises."""
    accessor = gltf["accessors"][number]
    view = gltf["bufferViews"][accessor["bufferView"]]
    dtype, width, count = np.dtype(_DTYPES[accessor["componentType"]]), _SHAPES[accessor["type"]], accessor["count"]
    if view.get("byteStride", dtype.itemsize * width) != dtype.itemsize * width:
        raise ValueError("interleaved")
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    values = read_array(binary, dtype, count * width, start, place)
    return values.reshape(count, width) if width > 1 else values
