"""Volumes: of a limb between two planes, and of a swelling above the skin round it."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spsolve

from ..geometry.mesh import enclosed_volume, undirected_edges
from ..types import Float, Int
from .body import Body
from .patch import border_of, cut
from .region import Brush, Lasso, Slab

SURFACE_SIGMA_M = 0.3e-3  # common shrinking or swelling of a fused surface, one sigma (docs/results.md: 0.4 mm p95)
MAX_OPEN = 0.1  # share of a limb's skin that may be missing; its volume is said with that much more doubt


def slab_volume(region: Slab, body: Body) -> tuple[float, float]:
    """(volume, one sigma), m³, between a slab's planes; NaN where too much of the limb's skin is missing.

    Divergence theorem with half the position's part across the axis: the planes themselves contribute nothing, so that
    V = ½ ∮ r·n dA over the skin alone. The sigma is the skin's area times a common error of the surface, and what the
    holes leave open: ∮ n dA across the axis is zero for a closed limb.
    """
    axis = np.array(region.axis)
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    corners, share, centre = cut(body.triangles, border_of(region, body))
    if not len(corners):
        return float("nan"), float("nan")
    a, b, c = (body.vertices_m[corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a) / 2 * share[:, None]  # area along the outward normal
    area = float(np.linalg.norm(normal, axis=1).sum())
    place = np.einsum("nk,nkd->nd", centre, np.stack([a, b, c], axis=1))
    place = place - place.mean(axis=0)
    across = place - (place @ axis)[:, None] * axis
    missing = float(np.linalg.norm(normal.sum(axis=0) - axis * (normal.sum(axis=0) @ axis)))
    if missing > MAX_OPEN * area:
        return float("nan"), float("nan")
    radius = float(np.linalg.norm(across, axis=1).mean())
    volume = float(np.einsum("ij,ij->", across, normal)) / 2
    return volume, float(np.hypot(area * SURFACE_SIGMA_M, missing * radius))


def swelling_volume(region: Brush | Lasso, body: Body) -> tuple[float, float]:
    """(volume, one sigma), m³, between the skin of a region and the membrane that its border spans; outward counts.

    The membrane is the surface whose every point is the mean of its neighbours, the border held.
    """
    border_m = border_of(region, body)
    inside = border_m < 0
    members = np.flatnonzero(inside[body.triangles].any(axis=1) & np.isfinite(border_m[body.triangles]).all(axis=1))
    triangles, free = body.triangles[members], np.flatnonzero(inside)
    if not len(free):
        return float("nan"), float("nan")
    used, numbers = np.unique(triangles, return_inverse=True)
    local: Int = numbers.reshape(-1, 3).astype(np.int32)
    moves = inside[used]
    if moves.all():
        return float("nan"), float("nan")
    skin, edges = _to_the_border(body.vertices_m[used], border_m[used], local)
    A = (edges + edges.T).astype(np.float64)
    n = len(used)
    laplace = (diags(np.asarray(A.sum(axis=1)).ravel()) - A).tocsr()
    flat = skin.copy()
    flat[moves] = spsolve(laplace[moves][:, moves].tocsc(), -laplace[moves][:, ~moves] @ skin[~moves])
    a, b, c = (skin[local[:, k]] for k in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
    both = np.concatenate([local, local[:, ::-1] + n])  # the membrane, turned inside out, closes the skin
    return enclosed_volume(np.concatenate([skin, flat]), both), area * SURFACE_SIGMA_M


def _to_the_border(skin_m: Float, border_m: Float, triangles: Int) -> tuple[Float, csr_matrix]:
    """The vertices (N, 3) with those outside drawn in to where their edges cross the border, and edges low -> high."""
    pairs, _ = undirected_edges(triangles)
    n = len(skin_m)
    edges = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    both = np.concatenate([pairs, pairs[:, ::-1]])
    out, into = both[(border_m[both[:, 0]] >= 0) & (border_m[both[:, 1]] < 0)].T
    s = border_m[out] / (border_m[out] - border_m[into])
    moved = skin_m[out] + s[:, None] * (skin_m[into] - skin_m[out])
    count = np.bincount(out, minlength=n)
    mean = np.stack([np.bincount(out, x, n) for x in moved.T], axis=1) / np.maximum(count, 1)[:, None]
    return np.where((count > 0)[:, None], mean, skin_m), edges
