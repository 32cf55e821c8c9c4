"""The surface on which regions are found: upright, with what is asked of it prepared when it is first asked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from ..export.axes import axes_of
from ..export.columns import vertex_normals
from ..geometry.rays import RayScene, rays_from
from ..types import Bool, Float, Int, ThermalMesh

SKIN_OFFSET_M = 2e-3  # rays toward the eye start this far above the skin: the skin does not hide itself
STEP_M = 2e-3  # a line over the surface is as fine as the mesh, not finer
RELAXATIONS = 30  # of each refinement of a line; then its length stands to 0.1 %


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh in its upright frame (x to the person's left, y up, z front).

    vertices_m : (V, 3) float64. triangles : (F, 3).
    """

    vertices_m: Float
    triangles: Int

    @classmethod
    def of(cls, mesh: ThermalMesh) -> Body:
        """Turned by the mesh's own `up` and `front`."""
        surface = mesh.surface
        return cls(surface.vertices_m.astype(np.float64) @ axes_of(mesh.metadata).T, surface.triangles)

    @cached_property
    def normals(self) -> Float:
        """(V, 3) unit, of the triangles round each vertex."""
        return vertex_normals(self.vertices_m.astype(np.float32), self.triangles).astype(np.float64)

    @cached_property
    def rays(self) -> RayScene:
        """For visibility and nearest points."""
        return RayScene(self.vertices_m, self.triangles)

    @cached_property
    def tree(self) -> cKDTree:
        """Of the vertices."""
        return cKDTree(self.vertices_m)

    def hidden(self, vertices: NDArray, toward: NDArray) -> Bool:
        """(N,) mask: skin stands between vertices (N,) indices and an eye far away in direction toward (3,)."""
        origin = self.vertices_m[vertices] + SKIN_OFFSET_M * self.normals[vertices]
        rays = rays_from(origin, np.broadcast_to(toward, origin.shape))
        return self.rays.occluded(rays, near=0.0, far=np.inf)

    def nearest(self, points_m: NDArray) -> tuple[Float, Int, Float]:
        """Nearest surface points (N, 3) m to points_m (N, 3), their triangles' corners (N, 3), weights (N, 3)."""
        found = self.rays.closest(np.asarray(points_m, np.float64))
        corners = self.triangles[found.triangle]
        weights = found.weights.astype(np.float64)
        return (weights[:, :, None] * self.vertices_m[corners]).sum(1), corners, weights

    def together(self, inside: Bool, seeds: NDArray) -> Bool:
        """(V,) mask: what of the mask inside (V,) hangs together, over edges within it, with vertices seeds (N,)."""
        members = np.flatnonzero(inside)
        number = np.full(len(inside), -1)
        number[members] = np.arange(len(members))
        tri = number[self.triangles]
        pairs = np.concatenate([tri[:, [0, 1]], tri[:, [1, 2]], tri[:, [2, 0]]])
        pairs = pairs[(pairs >= 0).all(axis=1)]
        n = len(members)
        graph = csr_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
        piece = connected_components(graph, directed=False)[1]
        wanted = piece[number[seeds[inside[seeds]]]]
        out = np.zeros(len(inside), bool)
        out[members[np.isin(piece, wanted)]] = True
        return out

    @cached_property
    def _steps(self) -> csr_matrix:
        """Lengths [m] of edges, and of the ways across each edge from one triangle's far corner to the other's."""
        v, t = self.vertices_m, self.triangles
        sides = np.concatenate([t[:, [0, 1, 2]], t[:, [1, 2, 0]], t[:, [2, 0, 1]]]).astype(np.int64)  # a, b, far corner
        code = np.sort(sides[:, :2], axis=1) @ np.array([len(v), 1])
        order = np.argsort(code, kind="stable")
        twice = np.flatnonzero(code[order][1:] == code[order][:-1])
        i, j = order[twice], order[twice + 1]
        a, b, c, d = v[sides[i, 0]], v[sides[i, 1]], v[sides[i, 2]], v[sides[j, 2]]
        across = _unfolded(a, b, c, d)
        rows = np.concatenate([sides[:, 0], sides[i, 2]])
        columns = np.concatenate([sides[:, 1], sides[j, 2]])
        length = np.concatenate([np.linalg.norm(v[sides[:, 0]] - v[sides[:, 1]], axis=1), across])
        good = np.isfinite(length) & (length > 0)
        keys, first = np.unique(rows[good] * len(v) + columns[good], return_index=True)
        size = (len(v), len(v))
        return csr_matrix((length[good][first], (keys // len(v), keys % len(v))), shape=size)

    def path(self, start_m: NDArray, end_m: NDArray) -> Float | None:
        """The shortest line (N, 3) m over the surface between start_m (3,) and end_m (3,); None: no skin joins them.

        Shortest way along edges and across them (Dijkstra), then drawn taut: each point moves to the surface's point
        nearest to the middle of its neighbours, coarse first, until the ends' steps are `STEP_M`.
        """
        (start, end), corners, weights = self.nearest(np.stack([start_m, end_m]))
        a, b = (int(corners[k, weights[k].argmax()]) for k in (0, 1))
        if a == b:
            return np.stack([start, end])
        way, before = dijkstra(self._steps, directed=False, indices=a, return_predecessors=True)
        if not np.isfinite(way[b]):
            return None
        chain = [b]
        while chain[-1] != a:
            chain.append(int(before[chain[-1]]))
        line = _resampled(np.vstack([start, self.vertices_m[chain[::-1]][1:-1], end]), 9)
        while True:
            for _ in range(RELAXATIONS):
                line[1:-1] = self.nearest((line[:-2] + line[2:]) / 2)[0]
            if along(line)[-1] <= STEP_M * (len(line) - 1):
                return line
            finer = np.repeat(line, 2, axis=0)[:-1]
            finer[1::2] = self.nearest((line[:-1] + line[1:]) / 2)[0]
            line = finer


def along(line_m: Float) -> Float:
    """(N,) m from the start of a polyline line_m (N, 3), along it."""
    return np.insert(np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1)), 0, 0.0)


def _resampled(line_m: Float, count: int) -> Float:
    """(count, 3) points at even steps along a polyline (N, 3)."""
    s = along(line_m)
    return np.stack([np.interp(np.linspace(0, s[-1], count), s, x) for x in line_m.T], axis=1)


def _unfolded(a: Float, b: Float, c: Float, d: Float) -> Float:
    """(N,) m straight from c to d over the edge ab (N, 3) of two triangles laid flat; inf where it misses the edge."""
    along = b - a
    width = np.linalg.norm(along, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        u = along / width[:, None]
        xc, xd = ((c - a) * u).sum(1), ((d - a) * u).sum(1)
        yc = np.linalg.norm(c - a - xc[:, None] * u, axis=1)
        yd = np.linalg.norm(d - a - xd[:, None] * u, axis=1)
        crossing = (xc * yd + xd * yc) / (yc + yd)
        straight = np.hypot(xc - xd, yc + yd)
        return np.where((crossing >= 0) & (crossing <= width), straight, np.inf)
