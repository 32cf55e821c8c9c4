"""OBJ and STL for other programs, and a closed surface with a temperature at every node, for meshers and FEM.

OBJ carries the palette's colours behind the places (as MeshLab, Blender and CloudCompare read them); STL shape alone.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spsolve

from ..files.whole import write_whole
from ..geometry.mesh import keep_vertices, undirected_edges
from ..types import Bool, Float, Float32, Int, SurfaceMesh, ThermalMesh
from ..version import __version__
from .columns import check_mesh, vertex_normals
from .palettes import apply, color_range
from .vtp import write_vtp

STL_HEADER = 80  # bytes
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write_obj(
    path: str | Path, mesh: ThermalMesh, palette: str = "inferno", range_degC: tuple[float, float] | None = None
) -> Path:
    """Write places in metres with the palette's colours, normals and triangles. Raises ValueError, ResourceError."""
    check_mesh(mesh)
    shown, surface = color_range(mesh.temperature_degC, range_degC), mesh.surface
    rgb = apply(mesh.temperature_degC, palette, *shown) / 255
    head = f"# thermofusion {__version__}: metres, {mesh.mode}, {palette} from {shown[0]:g} to {shown[1]:g} degC\n"
    places = np.concatenate([surface.vertices_m, rgb], axis=1)
    lines = [head, *(f"v {x:.6f} {y:.6f} {z:.6f} {r:.4f} {g:.4f} {b:.4f}\n" for x, y, z, r, g, b in places.tolist())]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in surface.normals.tolist()]
    lines += [f"f {a}//{a} {b}//{b} {c}//{c}\n" for a, b, c in (surface.triangles + 1).tolist()]
    return write_whole(path, ["".join(lines).encode("ascii")])


def write_stl(
    path: str | Path, mesh: ThermalMesh, palette: str = "inferno", range_degC: tuple[float, float] | None = None
) -> Path:
    """Write the shape, binary STL, in metres; palette and range_degC have no place there. Raises as `write_obj`."""
    check_mesh(mesh)
    corners = mesh.surface.vertices_m[mesh.surface.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(len(corners), STL_TRIANGLE)
    facets["normal"] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    facets["corners"] = corners
    head = f"thermofusion {__version__}, metres".encode("ascii").ljust(STL_HEADER)
    return write_whole(path, [head, len(facets).to_bytes(4, "little"), facets])


def write_closed(
    path: str | Path, mesh: ThermalMesh, palette: str = "inferno", range_degC: tuple[float, float] | None = None
) -> Path:
    """Write `closed(mesh)` as VTP. Raises ValueError, ResourceError."""
    check_mesh(mesh)
    return write_vtp(path, closed(mesh), palette, range_degC)


def closed(mesh: ThermalMesh) -> ThermalMesh:
    """The surface without holes, a temperature at every node.

    Each open border gets a fan of triangles round its middle. Unmeasured and new nodes take the mean of their
    neighbours; their uncertainty stays unknown (NaN), by which they can be told.
    """
    surface, pieces = mesh.surface, _fans(mesh.surface)
    middles, fans = ([m for m, _ in pieces], [f for _, f in pieces])
    n, extra = len(surface), len(middles)
    vertices: Float32 = np.concatenate([surface.vertices_m, *[m[None] for m in middles]]).astype(np.float32)
    triangles: Int = np.concatenate([surface.triangles, *fans]).astype(np.int32)
    used = np.zeros(n + extra, bool)
    used[triangles] = True

    def more(values: NDArray, fill: float) -> NDArray:
        return np.concatenate([values, np.full(extra, fill, values.dtype)])[used]

    vertices, triangles = keep_vertices(vertices, triangles, used)
    known = more(mesh.temperature_degC, np.nan)
    whole = SurfaceMesh(vertices, triangles, vertex_normals(vertices, triangles))
    filled = _filled(known.astype(np.float64), triangles).astype(np.float32)
    return replace(
        mesh,
        surface=whole,
        temperature_degC=filled,
        apparent_degC=more(mesh.apparent_degC, np.nan),
        uncertainty_K=np.where(np.isnan(known), np.float32(np.nan), more(mesh.uncertainty_K, np.nan)),
        view_angle_deg=more(mesh.view_angle_deg, np.nan),
        distance_m=more(mesh.distance_m, np.nan),
        observations=more(mesh.observations, 0),
        flags=more(mesh.flags, 0),
        uncertainty_parts={},
        residual=None if mesh.residual is None else more(mesh.residual, np.nan),
        moved_mm=None if mesh.moved_mm is None else more(mesh.moved_mm, np.nan),
    )


def _fans(surface: SurfaceMesh) -> list[tuple[Float32, Int]]:
    """For every open border its middle and the triangles to it, numbered behind the surface's vertices."""
    t = surface.triangles
    sides = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    edges, open_ = undirected_edges(t)
    code = lambda pairs: np.sort(pairs, axis=1).astype(np.int64) @ np.array([len(surface), 1])  # noqa: E731
    border = sides[np.isin(code(sides), code(edges[open_]))]
    following: dict[int, list[int]] = {}
    for a, b in border.tolist():
        following.setdefault(a, []).append(b)
    pieces: list[tuple[Float32, Int]] = []
    while following:
        loop = [next(iter(following))]
        while loop[-1] in following:  # every border edge is walked once, so that walks end where they began
            out = following[loop[-1]]
            step = out.pop()
            if not out:
                del following[loop[-1]]
            loop.append(step)
        middle, number = surface.vertices_m[loop[:-1]].mean(axis=0), len(surface) + len(pieces)
        pieces.append((middle, np.array([(b, a, number) for a, b in pairwise(loop)], np.int32)))
    return pieces


def _filled(values: Float, triangles: Int) -> Float:
    """Values (V,) of any unit with every NaN replaced so that it is the mean of its neighbours; 0 if all are NaN."""
    missing: Bool = np.isnan(values)
    if missing.all() or not missing.any():
        return np.nan_to_num(values)
    pairs, _ = undirected_edges(triangles)
    n = len(values)
    A = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    A = A + A.T
    degree = np.asarray(A.sum(axis=1)).ravel()
    inner = (diags(degree + 1e-9) - A).tocsr()[missing]  # the smallest pull to 0 keeps pieces without values solvable
    out = values.copy()
    mean = float(np.nanmean(values))
    out[missing] = mean + spsolve(inner[:, missing].tocsc(), -inner[:, ~missing] @ (values[~missing] - mean))
    return out
