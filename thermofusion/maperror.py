"""How far a map is from the truth, told from the map: halves of the views, the point spread, the declared budget.

Two maps from disjoint halves of the views err independently where the halves do. With T_A - T_B = e_A - e_B and inverse
variances w_A, w_B the map of all views has an error of the size of (T_A - T_B)·√(w_A·w_B)/(w_A + w_B): half the
difference for equal halves (half-sample replication, McCarthy 1969). Neighbouring views err alike (normals,
registration), so halves are made of arcs: half as many consecutive views as see a typical spot.

What all views share does not show between halves. Two parts of it can be told otherwise: the point spread, by spreading
the map once more (noise is kept out by multiplying what two halves say of it); and what the budget declares
for air path, ε(0) and reflection. The rest (a wrong shape of the mesh, a wrong sensor curve) stays unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .blending import BlendResult
from .crosscal import CrosscalResult
from .errors import ScanError
from .errorstats import Statistics
from .leftout import Bench
from .types import Bool, Float, SurfaceMesh

WELL_SEEN_DEG = 60.0  # the map's error is stated for surface that two views saw straighter than this
COUNT_CLASSES = (3, 4, 6, 9, 13, 19)  # lower ends of classes of views per vertex, after the first (2)
HALVINGS = 3  # ways to cut the arcs: a weakly determined pattern differs much from one to the next
DECLARED = ("shape", "air", "emissivity0", "reflected")  # parts of the budget that all views share
OF_VIEWS = ("noise", "normals", "registration", "silhouette")  # parts that more views make smaller
SAMPLING_PX2 = 1 / 6  # variance of bilinear sampling as a point spread, mean over sub-pixel positions
REACH = 3.5  # sigmas to which the point spread is followed
NEIGHBOURS = 12  # sampled vertices over which the squared effect of the point spread is averaged
NODES, NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(7)


@dataclass(frozen=True)
class MapError:
    """The map's expected relative error, K, on surface that two views saw under 60°.

    error : statistics; within_95 against the result's stated sigma. random : what halves of the views show alone.
    spread_rms_K : effect of the point spread; declared_rms_K : parts of the budget that all views share.
    arc_views : consecutive views that stay together in a half. coverage : share of that surface which both halves of
    some pair saw; surface that as many views saw represents the rest. sigma_ratio : rms of error over stated sigma.
    """

    error: Statistics
    random: Statistics
    spread_rms_K: float
    declared_rms_K: float
    arc_views: int
    halvings: int
    coverage: float
    sigma_ratio: float


@dataclass(frozen=True, eq=False)
class Halves:
    """One cut of the views: the two masks (N_views,), their calibrations, and (T_A - T_B) as an error (V,) K."""

    masks: tuple[Bool, Bool]
    calibrations: tuple[CrosscalResult | None, CrosscalResult | None]
    error_K: Float


def map_error(bench: Bench, dense: Bench, surface: SurfaceMesh, sigma_K: NDArray, psf_sigma_px: float) -> MapError:
    """The expected relative error of the map of all views.

    Parameters
    ----------
    bench : an even sample of `dense`, all vertices of the surface. sigma_K : (V_dense,) the result's stated sigma.
    psf_sigma_px : point spread of the thermal image.

    Raises ScanError where halves of the views cannot be compared.
    """
    rows = bench.observations.select(bench.counts)
    limit = np.float32(np.cos(np.radians(WELL_SEEN_DEG)))
    well_seen = np.bincount(rows.vertex[rows.cos_angle > limit], minlength=len(bench)) >= 2
    count = np.bincount(rows.vertex, minlength=len(bench))
    if not well_seen.any():
        raise ScanError("no spot was seen by two views under 60°")
    arc = int(np.clip(np.median(count[well_seen]) // 2, 1, len(bench.seen_views) // 2))
    shifts = sorted({round(k * arc / HALVINGS) for k in range(HALVINGS)})
    cuts = [_halves(bench, arc, shift) for shift in shifts]
    vertex = np.concatenate([np.flatnonzero(well_seen & np.isfinite(c.error_K)) for c in cuts])
    if not len(vertex):
        raise ScanError("no spot was seen by both halves of the views")
    random = np.concatenate([_level_removed(c.error_K[well_seen & np.isfinite(c.error_K)]) for c in cuts])
    weight = _representing(count, well_seen, vertex)

    everything = np.ones(bench.n_views, bool)
    parts = bench.blend(everything, bench.calibrate(everything)).uncertainty.parts_K
    declared = np.sqrt(sum((np.nan_to_num(parts[k]) ** 2 for k in DECLARED if k in parts), np.zeros(len(bench))))
    spread = _point_spread(bench, dense, surface, cuts[0], psf_sigma_px)
    shared = np.hypot(declared, spread)[vertex]
    error = (random[:, None] + shared[:, None] * NODES).ravel()  # shared parts are normal, unknown in sign
    weights = (weight[:, None] * NODE_WEIGHTS).ravel()
    sigma = np.repeat(sigma_K[bench.vertices][vertex].astype(np.float64), len(NODES))
    known = np.isfinite(sigma) & (sigma > 0)
    return MapError(
        error=Statistics.of(error, sigma, weights),
        random=Statistics.of(random, None, weight),
        spread_rms_K=_rms(spread[vertex], weight),
        declared_rms_K=_rms(declared[vertex], weight),
        arc_views=arc,
        halvings=len(cuts),
        coverage=len(np.unique(vertex)) / int(well_seen.sum()),
        sigma_ratio=_rms(error[known] / sigma[known], weights[known]),
    )


def _halves(bench: Bench, arc: int, shift: int) -> Halves:
    """Arcs of views by turns in one half and the other."""
    views = bench.seen_views
    in_A, in_B = np.zeros(bench.n_views, bool), np.zeros(bench.n_views, bool)
    turn = ((np.arange(len(views)) + shift) // arc) % 2 == 0
    in_A[views[turn]], in_B[views[~turn]] = True, True
    calibrations = (bench.calibrate(in_A), bench.calibrate(in_B))
    a, b = (bench.blend(m, c) for m, c in zip((in_A, in_B), calibrations, strict=True))
    s_a, s_b = (_own(r) for r in (a, b))
    error = (a.temperature_K - b.temperature_K) * s_a * s_b / (s_a**2 + s_b**2)
    return Halves((in_A, in_B), calibrations, np.asarray(error))


def _own(result: BlendResult) -> Float:
    """(V,) one sigma of what single views add: what the number and weight of a vertex's views make of it."""
    parts = result.uncertainty.parts_K
    return np.sqrt(np.sum([parts[k].astype(np.float64) ** 2 for k in OF_VIEWS if k in parts], axis=0))


def _representing(count: NDArray, well_seen: Bool, vertex: NDArray) -> Float:
    """Weights of `vertex` (N,), so that classes of views per vertex count as on all surface that was well seen."""
    group = np.searchsorted(COUNT_CLASSES, count, side="right")
    wanted = np.bincount(group[well_seen], minlength=len(COUNT_CLASSES) + 1)
    had = np.bincount(group[vertex], minlength=len(COUNT_CLASSES) + 1)
    return np.asarray((wanted / np.maximum(had, 1))[group[vertex]])


def _level_removed(error: Float) -> Float:
    return np.asarray(error - np.median(error)) if len(error) else error


def _rms(values: NDArray, weight: NDArray) -> float:
    return (
        float(np.sqrt(np.average(np.asarray(values, np.float64) ** 2, weights=weight))) if len(values) else float("nan")
    )


# ---------------------------------------------------------------- point spread


def _point_spread(bench: Bench, dense: Bench, surface: SurfaceMesh, cut: Halves, psf_sigma_px: float) -> Float:
    """(V_bench,) K, size of what the point spread G takes off or adds: the root of the local mean of b_A·b_B.

    The map is spread already, so b = (1 - G)∗(2 - G)∗T: the first two terms of undoing it (van Cittert 1931). Both
    halves are spread alike and noisy independently, so that the product's mean has no noise in it.
    """
    sigma_m = _spread_m(bench, psf_sigma_px)
    start, vertex, distance2 = _neighbours(surface, bench.vertices, float(np.nanmedian(sigma_m)))
    owner = np.repeat(np.arange(len(bench)), np.diff(start))
    exponent = -0.5 * distance2 / sigma_m[owner] ** 2
    once, twice = np.exp(exponent), np.exp(0.5 * exponent)  # G and G∗G
    effect = []
    for mask, calibration in zip(cut.masks, cut.calibrations, strict=True):
        T = dense.blend(mask, calibration).temperature_K
        spread = [_weighted_mean(T[vertex], kernel, owner, len(bench)) for kernel in (once, twice)]
        effect.append(2 * T[bench.vertices] - 3 * spread[0] + spread[1])
    product = effect[0] * effect[1]
    both = np.flatnonzero(np.isfinite(product))
    out = np.zeros(len(bench))
    if len(both) < NEIGHBOURS:
        return out
    place = surface.vertices_m[bench.vertices]
    _, near = cKDTree(place[both]).query(place, k=NEIGHBOURS)
    return np.sqrt(np.maximum(product[both][near].mean(1), 0.0)) + out


def _weighted_mean(values: NDArray, weight: NDArray, owner: NDArray, n: int) -> Float:
    """Mean of values by owner, (n,), NaN values left out."""
    w = np.where(np.isfinite(values), weight, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.bincount(owner, w * np.nan_to_num(values), n) / np.bincount(owner, w, n))


def _spread_m(bench: Bench, psf_sigma_px: float) -> Float:
    """(V,) m, sigma of the point spread on the surface: optics and bilinear sampling; 1/cosθ wider along the tilt."""
    rows = bench.observations.select(bench.counts)
    vertex, cos = rows.vertex, rows.cos_angle.astype(np.float64)
    pixel_m2 = rows.footprint_m2 * cos
    area = pixel_m2 * 0.5 * (1 + 1 / cos**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(vertex, area * cos**2, len(bench)) / np.bincount(vertex, cos**2, len(bench))
    sigma = np.sqrt((psf_sigma_px**2 + SAMPLING_PX2) * mean)
    return np.where(np.isfinite(sigma), sigma, np.nanmedian(sigma))


def _neighbours(surface: SurfaceMesh, vertices: NDArray, sigma_m: float) -> tuple[NDArray, NDArray, Float]:
    """Vertices of the surface within reach of some of its vertices: (start, vertex, squared distance), by owner."""
    tree = cKDTree(surface.vertices_m)
    lists = tree.query_ball_point(surface.vertices_m[vertices], REACH * sigma_m, workers=2)
    start = np.insert(np.cumsum([len(n) for n in lists]), 0, 0)
    vertex = np.concatenate([np.asarray(n, np.intp) for n in lists])
    owner = np.repeat(vertices, np.diff(start))
    d = surface.vertices_m[vertex].astype(np.float64) - surface.vertices_m[owner]
    facing = (surface.normals[vertex] * surface.normals[owner]).sum(1) > 0.5  # not the other side of a thin part
    return start, vertex, np.where(facing, (d**2).sum(1), np.inf)
