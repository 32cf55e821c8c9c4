"""Triangle meshes in which every edge has at most two triangles, and those round a vertex are one fan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import Bool, Float32, Int
from .mesh import in_order, triangle_normals

Index = NDArray[np.intp]


def manifold(vertices: Float32, triangles: Int) -> tuple[Float32, Int]:
    """The same surface, two-manifold with borders; order as of `mesh.canonical`, but that copies follow each other.

    Of an edge with more than two triangles the largest one of each direction stays; the others go. A vertex at which
    several fans of triangles touch becomes one for each fan, all at its place. vertices : (V, 3) m. triangles : (F, 3).
    """
    order, first, size = _edges(triangles)
    while (size > 2).any():
        triangles = triangles[~_superfluous(vertices, triangles, order, first, size)]
        order, first, size = _edges(triangles)
    if not len(triangles):
        return vertices[:0], triangles
    fan = _fans(triangles, order, first, size)
    corner_vertex = triangles.ravel()
    heads = np.flatnonzero(fan == np.arange(len(fan)))  # one corner stands for its fan
    heads = heads[np.argsort(corner_vertex[heads], kind="stable")]
    if len(heads) == len(vertices):
        return vertices, triangles
    number = np.empty(len(fan), np.int32)
    number[heads] = np.arange(len(heads), dtype=np.int32)
    return vertices[corner_vertex[heads]], in_order(number[fan].reshape(-1, 3))


def _edges(triangles: Int) -> tuple[Index, Index, Index]:
    """Sides (3 F,) ordered by the edge they lie on, and each edge's first place in that order and number of sides.

    Side 3 f + k runs from corner k of triangle f (of (F, 3)) to the next one.
    """
    start, stop = triangles.ravel().astype(np.int64), triangles[:, [1, 2, 0]].ravel().astype(np.int64)
    code = np.minimum(start, stop) << 32 | np.maximum(start, stop)
    order = np.argsort(code, kind="stable")
    ordered = code[order]
    new = np.ones(len(ordered), bool)
    new[1:] = ordered[1:] != ordered[:-1]
    first = np.flatnonzero(new)
    return order, first, np.diff(first, append=len(ordered))


def _superfluous(vertices: Float32, triangles: Int, order: Index, first: Index, size: Index) -> Bool:
    """(F,) triangles that go from edges with more than two; a triangle that went counts at its other edges."""
    gone = np.zeros(len(triangles), bool)
    area = np.linalg.norm(triangle_normals(vertices, triangles), axis=1)
    for at in np.flatnonzero(size > 2):
        sides = order[first[at] : first[at] + size[at]]
        sides = sides[~gone[sides // 3]]
        if len(sides) <= 2:
            continue
        sides = sides[np.argsort(-area[sides // 3], kind="stable")]
        ahead = triangles.ravel()[sides] == triangles.ravel()[sides[0]]
        kept = [sides[0], *sides[~ahead][:1]]
        gone[np.setdiff1d(sides, kept) // 3] = True
    return gone


def _fans(triangles: Int, order: Index, first: Index, size: Index) -> Int:
    """(3 F,) for each corner a corner that is the same for all of its fan, and for no other one."""
    pair = first[size == 2]
    other = np.full(3 * len(triangles), -1, np.int32)  # the same edge's side in the triangle beyond
    other[order[pair]], other[order[pair + 1]] = order[pair + 1], order[pair]
    corner = np.arange(3 * len(triangles), dtype=np.int32)
    before = other.reshape(-1, 3)[:, [2, 0, 1]].ravel()  # beyond the side that arrives at the corner
    turns = (before >= 0) & (triangles.ravel()[before] == triangles.ravel())  # else the triangles face unlike ways
    after = np.where(turns, before, corner)
    last, lowest = after.copy(), corner
    for _ in range(int(np.bincount(triangles.ravel()).max()).bit_length()):  # doubling reaches round every fan
        lowest = np.minimum(lowest, lowest[last])
        last = last[last]
    return np.where(after[last] == last, last, lowest)  # an open fan's last corner; a closed one's lowest
