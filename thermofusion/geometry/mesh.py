"""Triangle meshes as plain arrays: order, edges, areas, pieces, holes, smoothing, normals. NumPy and SciPy alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components

from ..types import Bool, Float, Float32, Int

TAUBIN_SHRINK, TAUBIN_INFLATE = 0.5, -0.53  # low pass without shrinkage (Taubin 1995)
MOST_BLURS = 24  # steps of a blur over neighbours: a finer mesh than that resolves what no camera does


def canonical(vertices: Float32, triangles: NDArray) -> tuple[Float32, Int]:
    """The same surface in an order that depends on its shape alone.

    Marching cubes on a hash map deliver vertices in any order. Here vertices (V, 3) m are sorted by z, y, x, and equal
    ones merged; triangles (F, 3) lose degenerate ones, start at their lowest vertex, and are sorted.
    """
    vertices = vertices + np.float32(0)  # -0.0 becomes 0.0: equal numbers get equal bits
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    first = np.ones(len(order), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(1)
    new = np.empty(len(order), np.int32)
    new[order] = np.cumsum(first) - 1
    tri = new[triangles]
    tri = tri[(tri[:, 0] != tri[:, 1]) & (tri[:, 1] != tri[:, 2]) & (tri[:, 2] != tri[:, 0])]
    return ordered[first], in_order(tri)


def in_order(triangles: Int) -> Int:
    """(F, 3) vertex indices: triangles that start at their lowest vertex, sorted."""
    lead = triangles.argmin(1)[:, None]
    tri = np.take_along_axis(triangles, (lead + np.arange(3)) % 3, axis=1)
    return tri[np.lexsort((tri[:, 2], tri[:, 1], tri[:, 0]))]


def triangle_normals(vertices: Float32, triangles: Int) -> Float32:
    """(F, 3) cross product of each triangle: outward, its length twice the area [m²].

    vertices : (V, 3) m. triangles : (F, 3).
    """
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def vertex_sums(values: NDArray, triangles: Int, count: int) -> Float:
    """Sum over the triangles (F, 3) at each vertex of values (F,) or (F, C), any unit: (count,) or (count, C)."""
    columns = values.reshape(len(triangles), -1)
    corners = triangles.ravel()
    out: Float = np.stack([np.bincount(corners, np.repeat(c, 3).astype(np.float64), count) for c in columns.T], axis=1)
    return out[:, 0] if values.ndim == 1 else out


def vertex_areas(vertices: Float32, triangles: Int) -> Float:
    """(V,) m²: a third of the area of the triangles (F, 3) at each of the vertices (V, 3) m."""
    return vertex_sums(np.linalg.norm(triangle_normals(vertices, triangles), axis=1) / 6, triangles, len(vertices))


def enclosed_volume(vertices: NDArray, triangles: NDArray) -> float:
    """Volume, m³, inside a closed surface of vertices (V, 3) m and outward triangles (F, 3): Σ a·(b x c)/6."""
    centred = vertices.astype(np.float64) - vertices.mean(axis=0, dtype=np.float64)
    a, b, c = (centred[triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def components(triangles: Int, count: int) -> Int:
    """(V,) number of the connected piece each vertex belongs to."""
    along = (triangles[:, :2].ravel(), triangles[:, 1:].ravel())  # two sides of a triangle connect its three corners
    graph = csr_matrix((np.ones(len(along[0]), np.int8), along), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int32)


def undirected_edges(triangles: Int) -> tuple[Int, Bool]:
    """Undirected edges (E, 2) of triangles (F, 3), vertex indices, and a mask (E,): on an open border.

    An edge of one triangle only is an open border's.
    """
    pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    code = pairs[:, 0].astype(np.int64) << 32 | pairs[:, 1].astype(np.int64)
    unique, count = np.unique(code, return_counts=True)
    return np.stack([unique >> 32, unique & 0xFFFFFFFF], axis=1).astype(np.int32), count == 1


def keep_vertices(vertices: Float32, triangles: Int, keep: Bool) -> tuple[Float32, Int]:
    """The triangles whose three vertices are all kept, and the vertices these use; order is preserved.

    vertices : (V, 3) m. triangles : (F, 3). keep : (V,) mask.
    """
    tri = triangles[keep[triangles].all(1)]
    used = np.zeros(len(vertices), bool)
    used[tri] = True
    new = np.cumsum(used, dtype=np.int32) - 1
    return vertices[used], new[tri]


def close_pinholes(vertices: Float32, triangles: Int, max_round_m: float) -> Int:
    """The triangles in `canonical` order, with fans over holes whose border is no longer than `max_round_m`.

    A pinhole is a voxel that too few frames filled. It is no edge of the subject, but would be taken for one wherever
    silhouettes and open borders are kept clear of. No vertex is added, no edge gets a third triangle: holes that touch
    in a vertex, or whose fans would need an edge that is there already, stay open.
    vertices : (V, 3) m. triangles : (F, 3).
    """
    n = len(vertices)
    ends = (triangles.ravel(), triangles[:, [1, 2, 0]].ravel())
    along = csr_matrix((np.ones(len(ends[0]), np.int8), ends), shape=(n, n))
    once = (along - along.T).tocoo()  # edges that no other triangle runs back along
    a, b = once.row[once.data > 0], once.col[once.data > 0]
    lone = (np.bincount(a, minlength=n)[a] == 1) & (np.bincount(b, minlength=n)[b] == 1)
    follower = dict(zip(a[lone].tolist(), b[lone].tolist(), strict=True))
    fans: list[tuple[int, int, int]] = []
    drawn: set[tuple[int, int]] = set()
    while follower:
        start, following = follower.popitem()
        loop = [start]
        while following != start and following in follower:
            loop.append(following)
            following = follower.pop(following)
        border = vertices[loop]
        length = float(np.linalg.norm(border - np.roll(border, -1, axis=0), axis=1).sum())
        if following == start and len(loop) >= 3 and length <= max_round_m:
            loop = loop[(k := int(np.argmin(loop))) :] + loop[:k]  # whatever the border's start
            turned = (loop[k:] + loop[:k] for k in range(len(loop)))
            spread = next((fan for fan in turned if not _crosses(fan, along, drawn)), None)
            if spread is not None:
                drawn |= {(spread[0], corner) for corner in spread[2:-1]}
                fans += [(spread[0], spread[i + 1], spread[i]) for i in range(1, len(spread) - 1)]
    if not fans:
        return triangles
    return in_order(np.concatenate([triangles, np.array(fans, np.int32)]))


def _crosses(loop: list[int], along: csr_matrix, drawn: set[tuple[int, int]]) -> bool:
    """Whether a fan from the loop's first vertex would draw an edge that is there, or `drawn`, already."""
    ends = ((loop[0], corner) for corner in loop[2:-1])
    return any(along[a, b] or along[b, a] or (a, b) in drawn or (b, a) in drawn for a, b in ends)


def smooth_positions(vertices: Float32, triangles: Int, iterations: int) -> Float32:
    """Taubin smoothing: `iterations` pairs of a shrinking and an inflating step.

    vertices and the result : (V, 3) m. triangles : (F, 3).
    """
    if iterations == 0:
        return vertices
    mean = _average(triangles, len(vertices), self_weight=0.0)
    out = vertices
    for _ in range(iterations):
        for factor in (TAUBIN_SHRINK, TAUBIN_INFLATE):
            out = out + np.float32(factor) * (mean @ out - out)
    return out.astype(np.float32)


def mesh_normals(vertices: Float32, triangles: Int, *, steps: int = 2) -> Float32:
    """Unit outward normals (V, 3): area-weighted triangle normals, averaged over the neighbours `steps` times.

    They never mix a finger with its neighbour, but an irregular mesh makes them less exact than a plane fit.
    vertices : (V, 3) m. triangles : (F, 3).
    """
    n = vertex_sums(triangle_normals(vertices, triangles), triangles, len(vertices)).astype(np.float32)
    mean = _average(triangles, len(vertices), self_weight=1.0)
    for _ in range(steps):
        n = mean @ n
    return unit(n)


def unit(n: Float32) -> Float32:
    """Rows of (N, 3) at length 1; NaN where the length is 0."""
    length = np.sqrt(np.einsum("ij,ij->i", n, n))[:, None]
    return np.divide(n, length, out=np.full_like(n, np.nan), where=length > 0)


def _average(triangles: Int, count: int, self_weight: float) -> csr_matrix:
    """Sparse (V, V) float32 matrix that takes the mean over each vertex's neighbours and, with a weight, itself.

    Going round its triangles names every neighbour of a vertex once (on an open border, all but one).
    """
    ones = np.ones(3 * len(triangles), np.float32)
    A = csr_matrix((ones, (triangles.ravel(), triangles[:, [1, 2, 0]].ravel())), shape=(count, count))
    A = A + diags(np.full(count, np.float32(self_weight)), format="csr", dtype=np.float32)
    total = np.asarray(A.sum(1), np.float32).ravel()
    return (diags(1 / np.maximum(total, np.float32(1e-12)), dtype=np.float32) @ A).tocsr()


def fine_structure(vertices: Float32, triangles: Int, values: NDArray, width_m: float) -> Float32:
    """What a blur takes of values (V,) on a surface of vertices (V, 3) m, for each m² of its variance; 0: unmeasured.

    width_m : about one sigma of the blur. Neighbours' means, as often as makes that width, are taken once against noise
    (fine structure is known no better than that) and once more: the difference is half
    the Laplacian.
    """
    mean, at = _average(triangles, len(vertices), self_weight=1.0), vertices.astype(np.float64)
    variance = (mean @ at**2 - (mean @ at) ** 2).sum(1) / 2  # of one step, along either direction of the surface
    steps = int(np.clip(round(width_m**2 / max(float(np.median(variance)), 1e-12)), 1, MOST_BLURS))

    def blurred(x: NDArray) -> NDArray:
        for _ in range(steps):
            x = mean @ x
        return x

    known = np.isfinite(values)
    columns = np.stack([np.where(known, values, 0), known], axis=1).astype(np.float32)
    once = blurred(columns)
    twice = blurred(once)
    with np.errstate(invalid="ignore", divide="ignore"):
        taken = np.abs(once[:, 0] / once[:, 1] - twice[:, 0] / twice[:, 1]) / (steps * (mean @ variance))
    return np.where(known, taken, 0).astype(np.float32)


def edge_gradient(vertices: Float32, triangles: Int, values: NDArray) -> Float32:
    """Magnitude of the gradient of values (V,) along a surface of vertices (V, 3) m, per metre; 0 where unmeasured.

    Squared differences along a vertex's edges over their squared lengths, sum over sum, times 2 (an edge's direction is
    random). Values are averaged with their neighbours' first: noise of single vertices is no gradient, least of all
    along the slivers that marching cubes leave.
    """
    a = np.concatenate([triangles[:, 0], triangles[:, 1], triangles[:, 2]])
    b = np.concatenate([triangles[:, 1], triangles[:, 2], triangles[:, 0]])
    n, known = len(vertices), np.isfinite(values)

    def around(of_a: NDArray, of_b: NDArray) -> Float:
        """Per vertex the sum over its edges of what each end gets."""
        return np.asarray(np.bincount(a, of_a, n) + np.bincount(b, of_b, n), np.float64)

    filled, one = np.where(known, values, 0.0), known.astype(np.float64)
    mean = (2 * filled + around(filled[b], filled[a])) / np.maximum(2 * one + around(one[b], one[a]), 1)
    both = known[a] & known[b]
    square = np.where(both, (mean[a] - mean[b]) ** 2, 0.0)
    length2 = np.where(both, ((vertices[a] - vertices[b]) ** 2).sum(1), 0.0)
    total, reach = around(square, square), around(length2, length2)
    return np.sqrt(2 * total / np.where(reach > 0, reach, np.inf)).astype(np.float32)
