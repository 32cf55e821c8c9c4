"""What a report or a file may show of a person who must not be known by it.

Colour goes. The face's shape goes: what lies within a head's height of the top stands on a grid of centimetres; the
temperatures of the forehead and of the inner eye corners, which that would blur, are kept as numbers first. Names,
dates, times of day, serial numbers, places of files and free text go.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from ..export.axes import axes_of
from ..export.columns import vertex_normals
from ..files.json import plain
from ..regions import Brush, Measured, Measurer
from ..temperature.solve import Temperature
from ..types import Bool, Float, SharedErrors, SurfaceMesh, ThermalMesh
from .html import Reported
from .metadata import ITEMS

HEAD_M = 0.27  # from the crown to below the chin of a tall person
GRID_M = 0.02  # of what is left of the head's shape: no eye, nose or mouth survives it
# Above the tip of the nose and beside the middle, of an adult (Farkas 1994, means): only where a number is looked for.
EYES_M, EYE_APART_M, FOREHEAD_M = 0.045, 0.016, 0.085
WITHOUT_HEAD = ("limb", "turntable-object", "phantom-cylinder")  # recipes whose subject has none
KEPT = ("version", "frame", "up", "front", "uncertainty", "room")  # of a mesh's metadata
NAME, FILE = "de-identified", "report-deidentified.html"


def deidentified(reported: Reported) -> Reported:
    """A report without what tells who it is; what the face read stands in its `face`.

    Regions stay as they were drawn, under numbers for names. Thermal images as seen go: they show the face.
    """
    recipe = reported.recipe.model_copy(update={"name": NAME, "description": ""})
    temperature, face = without_face(reported.temperature, str(reported.report.get("recipe", "")))
    report = _without_identity(reported.report) | {"face": face, "deidentified": True}
    regions = [r.model_copy(update={"name": f"{r.kind} {k}"}) for k, r in enumerate(reported.regions, 1)]
    changes = [replace(c, first=r.name, second=r.name) for c, r in zip(reported.changes, regions, strict=False)]
    return Reported(temperature, report, recipe, None, regions, changes=changes)


def without_face(temperature: Temperature, recipe: str) -> tuple[Temperature, list[dict[str, Any]]]:
    """A result without colour, names and the face's shape, and what the face read before; recipe : its name."""
    face: list[dict[str, Any]] = []
    mesh, shared = temperature.mesh, temperature.shared
    bare = replace(mesh.surface, color_rgb=None)
    known = {k: v for k, v in mesh.metadata.items() if k in KEPT or k.startswith("level_sigma_K")}
    materials = {f"material {k}": m | {"reason": ""} for k, m in enumerate(temperature.materials.values(), 1)}
    changed = replace(temperature, mesh=replace(mesh, surface=bare, metadata=known), messages=(), materials=materials)
    if recipe not in WITHOUT_HEAD:
        face = face_numbers(mesh, shared)
        changed = _coarsened(changed)
    return changed, face


def face_numbers(mesh: ThermalMesh, shared: SharedErrors | None) -> list[dict[str, Any]]:
    """What forehead and inner eye corners read, found by where the nose stands out; empty where no face is measured."""
    measurer = Measurer(mesh, shared)
    v = measurer.body.vertices_m
    head = np.flatnonzero(v[:, 1] > v[:, 1].max() - HEAD_M)
    middle = float(np.median(v[head, 0]))
    lane = head[np.abs(v[head, 0] - middle) < 0.03]
    if not len(lane):
        return []
    nose = v[lane[v[lane, 2].argmax()]]
    places = {"forehead": ((0.0, FOREHEAD_M), 0.02)}
    places |= {f"{side} inner eye corner": ((sign * EYE_APART_M, EYES_M), 0.008)
               for side, sign in (("left", 1), ("right", -1))}  # fmt: skip
    regions = []
    for name, ((x, y), radius) in places.items():
        near = np.hypot(v[head, 0] - nose[0] - x, v[head, 1] - nose[1] - y)
        facing = head[(near < radius) & (v[head, 2] > nose[2] - 0.08)]
        if len(facing):
            k = facing[v[facing, 2].argmax()]
            regions.append(Brush(name=name, points_m=[tuple(v[k])], normals=[(0, 0, 1)], radius_m=radius))
    readings = [r.row() for r in Measured.of(measurer, regions).readings]
    keys = ("name", "value_degC", "sigma_K", "max_degC")
    return [{k: plain(row[k]) for k in keys} for row in readings if np.isfinite(row["value_degC"])]


def _coarsened(temperature: Temperature) -> Temperature:
    """The head's vertices moved to the middle of their cell of a coarse grid; triangles and numbers stay."""
    mesh = temperature.mesh
    surface = mesh.surface
    up = surface.vertices_m.astype(np.float64) @ axes_of(mesh.metadata).T
    top = float(up[:, 1].max())
    head = np.flatnonzero(up[:, 1] > top - HEAD_M)
    cells = np.floor(surface.vertices_m[head] / GRID_M).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    count = np.bincount(cell.ravel())
    middle: Float = np.stack([np.bincount(cell.ravel(), x) / count for x in surface.vertices_m[head].T], axis=1)
    moved = surface.vertices_m.copy()
    moved[head] = middle[cell.ravel()]
    ids = np.arange(len(moved))
    ids[head] = head[np.unique(cell.ravel(), return_index=True)[1][cell.ravel()]]
    tri = ids[surface.triangles]
    tri = tri[(tri[:, 0] != tri[:, 1]) & (tri[:, 1] != tri[:, 2]) & (tri[:, 2] != tri[:, 0])].astype(np.int32)
    keep = np.zeros(len(moved), bool)
    keep[tri] = True
    new = np.cumsum(keep) - 1
    vertices, triangles = moved[keep], new[tri].astype(np.int32)
    return _cut(temperature, keep, SurfaceMesh(vertices, triangles, vertex_normals(vertices, triangles)))


def _cut(temperature: Temperature, keep: Bool, surface: SurfaceMesh) -> Temperature:
    """The temperatures of the vertices that are kept (V,), on their new surface."""
    mesh, shared = temperature.mesh, temperature.shared
    return replace(
        temperature,
        **_columns(temperature, keep),
        mesh=replace(mesh, surface=surface, **_columns(mesh, keep)),
        shared=None if shared is None else replace(shared, effect=shared.effect[keep]),
    )


def _columns(noun: Temperature | ThermalMesh, keep: Bool) -> dict[str, Any]:
    """The fields of a noun that hold a number a vertex, alone or by name: what they hold of the kept ones."""
    found: dict[str, Any] = {}
    for field in fields(noun):
        value = getattr(noun, field.name)
        if isinstance(value, np.ndarray) and value.shape[:1] == keep.shape:
            found[field.name] = value[keep]
        elif isinstance(value, dict) and any(isinstance(v, np.ndarray) for v in value.values()):
            found[field.name] = {k: v[keep] if np.shape(v)[:1] == keep.shape else v for k, v in value.items()}
    return found


def _without_identity(report: Mapping[str, Any]) -> dict[str, Any]:
    """result.json without names, times and free text."""
    personal = {item.key for item in ITEMS if item.personal}
    kept = {k: v for k, v in report.items() if k not in ("messages", "diagnosis", "scan")}
    kept["scan"] = {"name": NAME, "recorded_at": None, "frames": report.get("scan", {}).get("frames", {})}
    kept["messages"], kept["diagnosis"] = [], []
    asked = {item.key for item in ITEMS} - personal
    kept["recipe"] = NAME
    kept["metadata"] = [
        {**row, "value": row["value"] if row["key"] in asked and row["source"] == "measured" else None}
        for row in report.get("metadata", [])
        if row.get("key") in asked
    ]
    return kept
