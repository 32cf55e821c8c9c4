"""What each vertex sees in reflection: the room, direction by direction, or the body itself (armpit, groin).

Skin reflects diffusely at 10 µm, so the radiance L_r that reaches the camera by reflection is a cosine-weighted mean
over the hemisphere above the vertex, L_r = (1 - F) L_room + F L_body, F the share that the body fills. Rays cast on the
fused mesh give F and the places whose radiance comes back. F varies slowly over the skin: rays start at a sample of the
vertices and are interpolated to all.

Open meshes: a ray that meets the *back* of a triangle went through a hole (the cut at the waist, a patch no camera saw)
or started inside the opposite wall of a fold narrower than the offset. The real body is closed there, so it counts as
body; its temperature is not known, so it is taken as the mean of the skin the same vertex sees elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ...geometry.rays import Hits, RayScene, barycentric
from ...geometry.sphere import cell_of, harmonics
from ...types import Bool, Float, Float32, SurfaceMesh
from .harmonics import open_transfer

SAMPLE_SPACING_M = 0.020  # of the vertices rays start from: F changes over centimetres
DIRECTIONS = 96  # per sample: F to about 0.01, which is 3 mK on skin in a room 10 K colder
OFFSET_M = 0.010  # rays start this far above the surface: beyond the mesh's noise (2-4 mm) with room to spare
NEIGHBOURS = 4
NORMAL_SCALE_M = 0.05  # opposite sides of a thin part are 2 x this apart when samples are interpolated


@dataclass(frozen=True, eq=False)
class SurroundingsResult:
    """What the V vertices of a mesh see in reflection; independent of temperatures.

    body_fraction : (V,) float32, F, share of the cosine-weighted hemisphere filled by the body, 0..1.
    hits : (M, V) sparse, cosine-weighted shares of the hemisphere of sample m filled by the skin near vertex v; a row's
        sum is that sample's F less what back faces (holes in the mesh) fill.
    interpolation : (V, M) sparse, rows sum to 1; `interpolation @ hits` is the whole V x V operator, never formed.
    sample_fraction : (M,) float32, F of the samples.
    transfer : (V, 9) float32, how each spherical harmonic of the room lights a vertex: cosine-weighted over the
        hemisphere, where the body leaves it free.
    escaped : (M, D) int16, the cell (`geometry.sphere`) that each ray of a sample escapes into, -1 = it meets the body.
    """

    body_fraction: Float32
    hits: csr_matrix
    interpolation: csr_matrix
    sample_fraction: Float32
    transfer: Float32
    escaped: NDArray[np.int16]

    def reflected_radiance(
        self, room: float, skin: NDArray, *, emissivity: float | NDArray = 1.0, bounces: int = 2
    ) -> NDArray[np.float64]:
        """L_r (V,) float64, the radiance each vertex is lit by, in the unit of the arguments.

        Parameters
        ----------
        room : L_room, in-band radiance of the room at its reflected temperature, W m-2 sr-1.
        skin : (V,) radiance L(T_skin) of a black body at the current skin temperature; NaN = unmeasured: taken as the
            mean of the measured skin that the same vertex sees, else of the whole body.
        emissivity : hemispherical emissivity of skin, scalar or (V,). The skin around sends ε L(T) + (1 - ε) L_r.
        bounces : reflections followed; each further one changes the result by a factor (1 - ε) F less.
        """
        known = np.isfinite(skin)
        if not known.any() or self.hits.nnz == 0:
            fill = float(np.mean(skin[known])) if known.any() else room
            return room + self.body_fraction.astype(np.float64) * (fill - room)
        lit = np.full(len(skin), room, dtype=np.float64)
        emitted = np.where(known, skin, 0.0).astype(np.float64)
        share = self.hits @ known.astype(np.float64)
        body_mean = float(np.mean(emitted[known]))
        for _ in range(max(bounces, 1)):
            sent = emissivity * emitted + (1.0 - emissivity) * np.where(known, lit, 0.0)
            with np.errstate(invalid="ignore", divide="ignore"):
                around = np.where(share > 0, (self.hits @ sent) / share, body_mean)
            lit = room + self.interpolation @ (self.sample_fraction * (around - room))
        return lit

    def from_cells(self, cells: NDArray) -> Float:
        """(V,) cosine-weighted mean of what stands in the room's cells (N_CELLS,), where rays escape to it."""
        padded = np.append(cells, 0.0)  # -1 is the body
        return np.asarray(self.interpolation @ padded[self.escaped].mean(axis=1))


def surroundings(
    mesh: SurfaceMesh,
    *,
    spacing_m: float = SAMPLE_SPACING_M,
    directions: int = DIRECTIONS,
    offset_m: float = OFFSET_M,
) -> SurroundingsResult:
    """Cast cosine-weighted rays from a sample of the mesh's vertices on the mesh itself.

    Parameters
    ----------
    mesh : vertices (V, 3) metres, outward normals.
    spacing_m : distance between samples. directions : rays per sample, stratified over the hemisphere.
    offset_m : height above the surface where rays start; folds narrower than this see only body.

    Deterministic: the same mesh gives the same result. Raises ValueError for a mesh without triangles.
    """
    if len(mesh) == 0 or len(mesh.triangles) == 0:
        raise ValueError("surroundings need a mesh with triangles")
    sample = _sample_vertices(mesh, spacing_m)
    origins = mesh.vertices_m[sample] + np.float32(offset_m) * mesh.normals[sample]
    rays = _hemispheres(mesh.normals[sample], directions)
    hits, front = _cast(mesh, origins, rays)
    fraction = (hits.triangle >= 0).reshape(len(sample), directions).mean(1, dtype=np.float32)
    shares = _hit_shares(mesh, hits, front, len(sample), directions)
    interpolation = _interpolation(mesh, sample)
    body_fraction = np.clip(interpolation @ fraction, 0, 1).astype(np.float32)
    free = hits.triangle < 0
    escaped = np.where(free, cell_of(rays), -1).astype(np.int16).reshape(len(sample), directions)
    seen = (harmonics(rays) * free[:, None]).reshape(len(sample), directions, -1).mean(axis=1)
    # the body takes away little, and that varies slowly: interpolated is what it takes, exact is what would be without
    taken = seen - open_transfer(mesh.normals[sample])
    transfer = (open_transfer(mesh.normals) + interpolation @ taken).astype(np.float32)
    return SurroundingsResult(body_fraction, shares, interpolation, fraction, transfer, escaped)


def _sample_vertices(mesh: SurfaceMesh, spacing_m: float) -> NDArray[np.int64]:
    """One vertex, nearest its middle, of each voxel and coarse normal direction (both sides of a thin part)."""
    cell = np.floor(mesh.vertices_m / spacing_m).astype(np.int64)
    cell -= cell.min(0)
    side = np.abs(mesh.normals).argmax(1)
    side = 2 * side + (np.take_along_axis(mesh.normals, side[:, None], 1)[:, 0] < 0)
    size = cell.max(0) + 1
    key = ((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]) * 6 + side
    from_middle = np.abs(mesh.vertices_m / spacing_m % 1.0 - 0.5).max(1)
    order = np.lexsort((from_middle, key))
    first = np.concatenate([[True], np.diff(key[order]) > 0])
    return np.sort(order[first])


def _hemispheres(normals: Float32, directions: int) -> Float32:
    """(M * D, 3) unit directions, cosine-distributed about each normal.

    Points of Vogel's spiral fill the unit disc evenly; lifted onto the hemisphere they are cosine-weighted (Malley).
    The spiral is turned by a golden angle from sample to sample, so that neighbours do not share one pattern's error.
    """
    golden = np.pi * (3 - np.sqrt(5))
    i, m = np.arange(directions), np.arange(len(normals))
    r = np.sqrt((i + 0.5) / directions)
    angle = golden * i[None, :] + (np.sqrt(2) * np.pi * m)[:, None]
    x, y = (r * np.cos(angle)).astype(np.float32), (r * np.sin(angle)).astype(np.float32)
    z = np.sqrt(1 - r * r).astype(np.float32)
    n = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    # Frisvad / Duff et al. 2017: an orthonormal frame without branches.
    sign = np.where(n[:, 2] < 0, -1.0, 1.0).astype(np.float32)
    a = -1.0 / (sign + n[:, 2])
    b = n[:, 0] * n[:, 1] * a
    t1 = np.stack([1 + sign * n[:, 0] ** 2 * a, sign * b, -sign * n[:, 0]], 1)
    t2 = np.stack([b, sign + n[:, 1] ** 2 * a, -n[:, 1]], 1)
    d = x[..., None] * t1[:, None] + y[..., None] * t2[:, None] + z[None, :, None] * n[:, None]
    return d.reshape(-1, 3)


def _cast(mesh: SurfaceMesh, origins: Float32, rays: Float32) -> tuple[Hits, Bool]:
    """First hits of M x D rays, and whether a hit shows its front."""
    starts = np.repeat(origins, len(rays) // len(origins), axis=0)
    hits = RayScene.of(mesh).hits(np.concatenate([starts, rays], 1, dtype=np.float32))
    return hits, (hits.normal * rays).sum(1) < 0


def _hit_shares(mesh: SurfaceMesh, hits: Hits, front: Bool, samples: int, directions: int) -> csr_matrix:
    """(M, V): each front hit's share 1/D spread over its triangle's corners by barycentric weights."""
    ray = np.flatnonzero((hits.triangle >= 0) & front)
    corners = mesh.triangles[hits.triangle[ray]]
    weight = barycentric(hits.uv[ray]) / np.float32(directions)
    row = np.repeat(ray // directions, 3)
    return csr_matrix((weight.ravel(), (row, corners.ravel())), shape=(samples, len(mesh)), dtype=np.float32)


def _interpolation(mesh: SurfaceMesh, sample: NDArray) -> csr_matrix:
    """(V, M): weights of the nearest samples in position and normal, rows summing to 1."""

    def key(rows: NDArray | slice) -> Float:
        return np.concatenate([mesh.vertices_m[rows], mesh.normals[rows] * np.float32(NORMAL_SCALE_M)], 1)

    k = min(NEIGHBOURS, len(sample))
    distance, index = cKDTree(key(sample)).query(key(slice(None)), k=k, workers=-1)
    distance, index = distance.reshape(len(mesh), k), index.reshape(len(mesh), k)
    weight = 1.0 / (distance**2 + (0.25 * SAMPLE_SPACING_M) ** 2)
    weight /= weight.sum(1, keepdims=True)
    row = np.arange(0, k * len(mesh) + 1, k)
    return csr_matrix((weight.astype(np.float32).ravel(), index.ravel(), row), shape=(len(mesh), len(sample)))
