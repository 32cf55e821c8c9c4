"""How far a map is from the truth, told from the map: halves of the views, the point spread, the declared budget.

Two maps from disjoint halves of the views err independently where the halves do. With T_A - T_B = e_A - e_B and inverse
variances w_A, w_B the map of all views has an error of the size of (T_A - T_B)·√(w_A·w_B)/(w_A + w_B): half the
difference for equal halves (half-sample replication, McCarthy 1969). Neighbouring views err alike (normals,
registration), so halves are made of arcs: half as many consecutive views as see a typical spot. The calibration is
halved by itself, views in short turns and skin in patches, because arcs would tear the chain of overlapping views.

What all views share does not show between halves. Two parts of it can be told otherwise: the point spread, by spreading
the map once more (noise is kept out by multiplying what two halves say of it); and what the budget declares for air
path, ε(0) and reflection. The rest (a wrong shape of the mesh, a wrong sensor curve) stays unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import ScanError
from ..robust import Statistics, weighted_quantile
from ..temperature.blend import BlendResult
from ..temperature.crosscal import Calibration
from ..types import Bool, Float, SurfaceMesh
from .leftout import Bench

MIN_DONORS = 20  # vertices that may represent a class
COUNT_CLASSES = (3, 4, 6, 9, 13, 19)  # lower ends of classes of views per vertex, after the first (2)
HALVINGS = 3  # ways to cut the arcs: a weakly determined pattern differs much from one to the next
DECLARED = ("shape", "silhouette", "air", "emissivity0", "reflected")  # parts of the budget that all views share
OF_VIEWS = ("noise", "normals", "registration", "silhouette")  # parts that more views make smaller
PATCH_M = 0.15  # skin this far apart errs independently: many windows of normals
PATTERN_PATCH_M = 0.06  # where the sensor has a pattern: each half of the skin must cross all of its places
SAMPLING_PX2 = 1 / 6  # variance of bilinear sampling as a point spread, mean over sub-pixel positions
TAIL = 0.01  # share of the errors whose weight in the mean square is told
REACH = 2.5  # sigmas to which the point spread is followed
NEIGHBOURS = 4  # sampled vertices over which the squared effect of the point spread is averaged
NODES, NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(7)


@dataclass(frozen=True)
class MapError:
    """The map's expected relative error, K, on surface that two views saw under 60°.

    error : statistics; within_95 against the result's stated sigma. random : what halves of the views show alone.
    spread_rms_K : effect of the point spread; declared_rms_K : parts of the budget that all views share.
    arc_views : consecutive views that stay together in a half. coverage : share of that surface which both halves of
    some cut saw; surface that as many views saw represents the rest. sigma_ratio : rms of error over stated sigma.
    tail_share : of the mean square, that the largest hundredth of the errors carries.
    """

    error: Statistics
    random: Statistics
    spread_rms_K: float
    declared_rms_K: float
    arc_views: int
    halvings: int
    coverage: float
    sigma_ratio: float
    tail_share: float = float("nan")


@dataclass(frozen=True, eq=False)
class Halves:
    """One cut of the views into arcs: two masks (N_views,), and (T_A - T_B) as an error of the whole map, (V,) K."""

    masks: tuple[Bool, Bool]
    error_K: Float


def map_error(
    bench: Bench,
    dense: Bench,
    surface: SurfaceMesh,
    sigma_K: NDArray,
    psf_sigma_px: float,
    shared: Sequence[str] = DECLARED,
) -> MapError:
    """The expected relative error of the map of all views.

    Parameters
    ----------
    bench : an even sample of `dense`, all vertices of the surface. sigma_K : (V_dense,) the result's stated sigma.
    psf_sigma_px : point spread of the thermal image. shared : parts of the budget that all views have in common.

    Raises ScanError where halves of the views cannot be compared.
    """
    count = np.bincount(bench.problem.observations.vertex[bench.problem.counts], minlength=len(bench))
    other = bench.problem.other
    wanted = np.flatnonzero(bench.well_seen & (count > 0) & (True if other is None else ~other))
    if not len(wanted):
        raise ScanError("no spot was seen by two views under 60°")
    arc = int(np.clip(np.median(count[wanted]) // 2, 1, len(bench.problem.seen_views) // 2))
    everything = np.ones(bench.problem.n_views, bool)
    calibration = bench.calibrate(everything)
    whole = bench.blend(everything, calibration)
    cuts, random, covered = [], [], np.zeros(len(wanted), bool)
    for k, shift in enumerate(sorted({round(k * arc / HALVINGS) for k in range(HALVINGS)})):
        cuts.append(_halves(bench, calibration, arc, shift))
        error = cuts[k].error_K
        if calibration is not None:
            error = error + _calibration_error(bench, calibration, surface.vertices_m[bench.problem.vertices], k)
        covered |= np.isfinite(error[wanted])
        random.append(_completed(error[wanted], _own(whole)[wanted], count[wanted]))

    declared = _declared(bench, calibration, whole, shared)[wanted]
    spread = _point_spread(bench, dense, surface, calibration, cuts[0].masks, psf_sigma_px)[wanted]
    # shared parts are taken as normal, of unknown sign
    error = (np.concatenate(random)[:, None] + np.tile(np.hypot(declared, spread), len(cuts))[:, None] * NODES).ravel()
    weight = np.tile(NODE_WEIGHTS, len(wanted) * len(cuts))
    sigma = np.repeat(np.tile(sigma_K[bench.problem.vertices][wanted].astype(np.float64), len(cuts)), len(NODES))
    known = np.isfinite(sigma) & (sigma > 0)
    return MapError(
        error=Statistics.of(error, sigma, weight),
        random=Statistics.of(np.concatenate(random)),
        spread_rms_K=float(np.sqrt(np.mean(spread**2))),
        declared_rms_K=float(np.sqrt(np.mean(declared**2))),
        arc_views=arc,
        halvings=len(cuts),
        coverage=float(covered.mean()),
        sigma_ratio=float(np.sqrt(np.average((error[known] / sigma[known]) ** 2, weights=weight[known]))),
        tail_share=_tail_share(error, weight),
    )


def _tail_share(error: Float, weight: Float) -> float:
    """Share of the mean square of errors (N,) of weights (N,) that the largest `TAIL` of them carries."""
    square, tail = weight * error**2, np.abs(error) > weighted_quantile(np.abs(error), weight, 1 - TAIL)
    return float(square[tail].sum() / max(square.sum(), 1e-30))


def _declared(
    bench: Bench, calibration: Calibration | None, whole: BlendResult, shared: Sequence[str] = DECLARED
) -> Float:
    """(V,) K, what the budget holds of errors that all views share.

    The fitted shape of ε(θ) is one of them as far as its uncertainty is no matter of noise (normals bend it).
    """
    parts = whole.uncertainty.parts_K
    squares = sum((np.nan_to_num(parts[k].astype(np.float64)) ** 2 for k in shared if k in parts), np.zeros(len(bench)))
    if calibration is not None:
        bend = np.sqrt(
            max(
                calibration.shape_sigma**2
                - float(calibration.covariance[calibration.layout.shape, calibration.layout.shape]),
                0.0,
            )
        )
        bent = bench.blend(np.ones(bench.problem.n_views, bool), replace(calibration, shape=calibration.shape + bend))
        change = bent.temperature_K - whole.temperature_K
        squares += np.nan_to_num(change - np.nanmedian(change)) ** 2
    return np.sqrt(squares)


def _completed(error: Float, own: Float, count: NDArray) -> Float:
    """Errors (N,) about their level; where one half saw nothing, drawn in turn from vertices that as many views saw.

    Drawn in units of `own`, what single views add to a vertex by the budget: a spot that one view saw has no halves.
    """
    out, group = error - np.nanmedian(error), np.searchsorted(COUNT_CLASSES, count, side="right")
    if not np.isfinite(error).any():
        raise ScanError("no spot was seen by both halves of the views")
    for g in np.unique(group):
        mine, donors = group == g, np.flatnonzero((group == g) & np.isfinite(error))
        donors = donors if len(donors) >= MIN_DONORS else np.flatnonzero(np.isfinite(error))
        lost = np.flatnonzero(mine & ~np.isfinite(error))
        out[lost] = np.resize(out[donors] / own[donors], len(lost)) * own[lost]
    return out


def _halves(bench: Bench, calibration: Calibration | None, arc: int, shift: int) -> Halves:
    """Arcs of views by turns in one half and the other, under one calibration."""
    masks = _by_turns(bench, arc, shift)
    a, b = (bench.blend(mask, calibration) for mask in masks)
    s_a, s_b = _own(a), _own(b)
    return Halves(masks, np.asarray((a.temperature_K - b.temperature_K) * s_a * s_b / (s_a**2 + s_b**2)))


def _by_turns(bench: Bench, length: int, shift: int) -> tuple[Bool, Bool]:
    """Masks (N_views,) of groups of consecutive views by turns."""
    views = bench.problem.seen_views
    in_A, in_B = np.zeros(bench.problem.n_views, bool), np.zeros(bench.problem.n_views, bool)
    turn = ((np.arange(len(views)) + shift) // length) % 2 == 0
    in_A[views[turn]], in_B[views[~turn]] = True, True
    return in_A, in_B


def _calibration_error(bench: Bench, calibration: Calibration, place_m: NDArray, k: int) -> Float:
    """(V,) K, what a calibration from other views and other skin would change, halved.

    Views alternate singly, in pairs or in threes: longer arcs would cut the chain of overlaps that the whole scan has.
    Skin alternates in cubes: errors of normals are common to all views of a patch. Where a half has too few views to be
    calibrated by itself, one view is left out instead (the jackknife, Quenouille 1956), another in each cut.
    """
    try:
        return _by_halves(bench, calibration, place_m, k)
    except ScanError:
        views = bench.problem.seen_views
        mask = np.ones(bench.problem.n_views, bool)
        mask[views[k % len(views)]] = False
        own = bench.blend(mask, bench.calibrate(mask, like=calibration))
        change = own.temperature_K - bench.blend(mask, calibration).temperature_K
        return np.asarray(np.sqrt(len(views) - 1) * change)


def _by_halves(bench: Bench, calibration: Calibration, place_m: NDArray, k: int) -> Float:
    """(V,) K, half the difference of two calibrations from half of the views and of the skin each."""
    side_m = PATCH_M if calibration.sensor is None else PATTERN_PATCH_M
    cube = np.floor(place_m / side_m + 0.5 * k).astype(int).sum(1) % 2 == 0
    change = []
    for mask, skin in zip(_by_turns(bench, k + 1, 0), (cube, ~cube), strict=True):
        own = bench.blend(mask, bench.calibrate(mask, skin, calibration))
        change.append(own.temperature_K - bench.blend(mask, calibration).temperature_K)
    return np.asarray(0.5 * (change[0] - change[1]))


def _own(result: BlendResult) -> Float:
    """(V,) one sigma of what single views add: what the number and weight of a vertex's views make of it."""
    parts = result.uncertainty.parts_K
    return np.sqrt(np.sum([parts[k].astype(np.float64) ** 2 for k in OF_VIEWS if k in parts], axis=0))


# ---------------------------------------------------------------- point spread


def _point_spread(
    bench: Bench,
    dense: Bench,
    surface: SurfaceMesh,
    calibration: Calibration | None,
    masks: tuple[Bool, Bool],
    psf_sigma_px: float,
) -> Float:
    """(V_bench,) K, size of what the point spread G takes off or adds: the root of the local mean of b_A·b_B.

    b = T - G∗T: what spreading the map, spread already, once more takes off (the first term of undoing it). Both halves
    are spread alike and noisy independently, so that the product's mean has no noise in it.
    """
    sigma_m = _spread_m(bench, psf_sigma_px)
    start, vertex, distance2 = _neighbours(surface, bench.problem.vertices, float(np.nanmedian(sigma_m)))
    owner = np.repeat(np.arange(len(bench)), np.diff(start))
    kernel = np.exp(-0.5 * distance2 / sigma_m[owner] ** 2)
    effect = []
    for mask in masks:
        T = dense.blend(mask, calibration).temperature_K
        effect.append(T[bench.problem.vertices] - _weighted_mean(T[vertex], kernel, owner, len(bench)))
    product = effect[0] * effect[1]
    both = np.flatnonzero(np.isfinite(product))
    out = np.zeros(len(bench))
    if len(both) < NEIGHBOURS:
        return out
    place = surface.vertices_m[bench.problem.vertices]
    _, near = cKDTree(place[both]).query(place, k=NEIGHBOURS)
    return np.sqrt(np.maximum(product[both][near].mean(1), 0.0)) + out


def _weighted_mean(values: NDArray, weight: NDArray, owner: NDArray, n: int) -> Float:
    """Mean of values by owner, (n,), NaN values left out."""
    w = np.where(np.isfinite(values), weight, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.bincount(owner, w * np.nan_to_num(values), n) / np.bincount(owner, w, n))


def _spread_m(bench: Bench, psf_sigma_px: float) -> Float:
    """(V,) m, sigma of the point spread on the surface: optics and bilinear sampling; 1/cosθ wider along the tilt."""
    rows = bench.problem.observations.select(bench.problem.counts)
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
