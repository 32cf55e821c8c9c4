"""Nodes on a surface, and what each point of it has to do with them: distances run along the surface.

A hand that hangs beside the hip is near in space and far along the skin, so an arm never drags the flank.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from ..geometry.mesh import undirected_edges
from ..types import Float, Float32, Int

NODES_OF_A_POINT = 4  # the nearest; the fifth's distance is where their weight ends
NEIGHBOURS = 4  # of a node that hold it, at least
COARSE_M = 0.012  # ways along the surface are measured between points this far apart
MAX_NODES = 120  # a body has 60 to 70; a surface with more of everything gets larger pieces, for memory grows with K²
PIECE_OF_A_NODE = 0.2  # a loose piece of less than this share of a node's own area gets none


@dataclass(frozen=True, eq=False)
class Binding:
    """Which nodes carry each of P points. Points in one small cell of the surface are carried alike.

    node : (G, 4) indices, weight : (G, 4) float32, rows sum to 1, of every group of points. group : (P,) of each point.
    """

    node: Int
    weight: Float32
    group: Int

    def __len__(self) -> int:
        return len(self.group)

    def take(self, rows: NDArray) -> Binding:
        """Of the points with indices `rows` (N,) alone."""
        used, group = np.unique(self.group[rows], return_inverse=True)
        return Binding(self.node[used], self.weight[used], group.astype(np.int32))


@dataclass(frozen=True, eq=False)
class NodeGraph:
    """Nodes of a surface. at_m : (K, 3) m. edge : (E, 2) pairs that are neighbours along the surface. binding : of the
    surface's vertices."""

    at_m: Float
    edge: Int
    binding: Binding

    def __len__(self) -> int:
        return len(self.at_m)


@dataclass(frozen=True, eq=False)
class Coarse:
    """A surface thinned for searching. at_m : (C, 3). of_vertex : (V,) the coarse point of each vertex. graph : sparse
    (C, C) lengths of the ways between neighbours, m."""

    at_m: Float32
    of_vertex: Int
    graph: csr_matrix


def thinned(vertices: Float32, triangles: Int, spacing_m: float) -> Coarse:
    """Vertices (V, 3) m gathered in cells of `spacing_m`, as far as triangles (F, 3) join them within the cell.

    Two sheets that pass through one cell (an arm beside the flank) stay two points.
    """
    code = cells(vertices, spacing_m)
    edges, _ = undirected_edges(triangles)
    same = code[edges[:, 0]] == code[edges[:, 1]]
    inner, n = edges[same], len(vertices)
    joined = csr_matrix((np.ones(len(inner), np.int8), (inner[:, 0], inner[:, 1])), shape=(n, n))
    count, of_vertex = connected_components(joined, directed=False)
    size = np.bincount(of_vertex, minlength=count)
    at = np.stack([np.bincount(of_vertex, vertices[:, k], count) / size for k in range(3)], axis=1).astype(np.float32)
    outer = np.sort(of_vertex[edges[~same]], axis=1)
    pair = np.unique(outer[:, 0].astype(np.int64) * count + outer[:, 1])
    a, b = pair // count, pair % count
    length = np.linalg.norm(at[a] - at[b], axis=1) + 1e-6
    graph = csr_matrix((length, (a, b)), shape=(count, count))
    return Coarse(at, of_vertex.astype(np.int32), (graph + graph.T).tocsr())


def cells(points: Float32, edge_m: float) -> NDArray[np.int64]:
    """(N,) number of the cube of a grid in which each of points (N, 3) m lies."""
    cell = np.floor((points - points.min(0)) / np.float32(edge_m)).astype(np.int64)
    return (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]


def build_graph(vertices: Float32, triangles: Int, spacing_m: float) -> NodeGraph:
    """Nodes about `spacing_m` apart along the surface of vertices (V, 3) m and triangles (F, 3)."""
    coarse = thinned(vertices, triangles, COARSE_M)
    chosen, distance = _spread(coarse, spacing_m)
    return NodeGraph(coarse.at_m[chosen].astype(np.float64), _edges(distance[:, chosen]), _bound(coarse, distance))


def bind(vertices: Float32, triangles: Int, node_m: Float) -> Binding:
    """Another surface's vertices (V, 3) m bound to nodes at node_m (K, 3), distances along its triangles (F, 3)."""
    coarse = thinned(vertices, triangles, COARSE_M)
    chosen = cKDTree(coarse.at_m).query(node_m)[1]
    return _bound(coarse, np.asarray(dijkstra(coarse.graph, indices=chosen)))


def _bound(coarse: Coarse, distance: Float) -> Binding:
    """The binding of a surface's vertices, from distances (K, C) of its coarse points.

    What no way leads to from a node (a loose piece) is carried as the point nearest in space that one leads to.
    """
    order = np.argsort(distance, axis=0, kind="stable")[: NODES_OF_A_POINT + 1]
    near = np.take_along_axis(distance, order, axis=0)
    known = np.isfinite(near)
    reach = np.where(known, near, 0).max(0) * np.where(known.all(0), 1.0, 1.5) + 1e-6
    weight = np.where(known, np.clip(1 - near / reach, 0, None) ** 2, 0.0)[:NODES_OF_A_POINT]
    weight[0, weight.sum(0) <= 0] = 1.0
    weight /= weight.sum(0)
    node, weight = order[:NODES_OF_A_POINT].T.astype(np.int32), weight.T.astype(np.float32)
    loose, tied = np.flatnonzero(~known[0]), np.flatnonzero(known[0])
    if len(loose):
        beside = tied[cKDTree(coarse.at_m[tied]).query(coarse.at_m[loose])[1]]
        node[loose], weight[loose] = node[beside], weight[beside]
    return Binding(node, weight, coarse.of_vertex)


def _spread(coarse: Coarse, spacing_m: float) -> tuple[Int, Float]:
    """Farthest points along the surface until none is farther than `spacing_m` from one: (K,) and distances (K, C).

    `MAX_NODES` at most; none on pieces too small to carry one.
    """
    _, piece = connected_components(coarse.graph, directed=False)
    size = np.bincount(piece)
    carries = size >= min(PIECE_OF_A_NODE * np.pi / 4 * (spacing_m / COARSE_M) ** 2, size.max())
    able = carries[piece]
    start = int(np.lexsort((*coarse.at_m.T, able))[-1])
    chosen, rows, nearest = [start], [], np.where(able, np.inf, 0.0)
    while True:
        d = np.asarray(dijkstra(coarse.graph, indices=chosen[-1]))
        rows.append(d)
        nearest = np.minimum(nearest, d)
        far = int(np.argmax(np.where(np.isfinite(nearest), nearest, 1e9)))
        if nearest[far] <= spacing_m or len(chosen) == MAX_NODES:
            return np.array(chosen, np.int32), np.array(rows)
        chosen.append(far)


def _edges(between: Float) -> Int:
    """(E, 2) each node with its nearest few."""
    k = len(between)
    away = between + np.diag(np.full(k, np.inf))
    order = np.argsort(away, axis=1, kind="stable")[:, :NEIGHBOURS]
    a, b = np.repeat(np.arange(k), order.shape[1]), order.ravel()
    good = np.isfinite(away[a, b])
    return np.unique(np.sort(np.stack([a[good], b[good]], axis=1), axis=1), axis=0).astype(np.int32)
