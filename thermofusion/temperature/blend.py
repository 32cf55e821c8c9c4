"""Many observations of a vertex into one temperature: weights, methods, fallbacks.

Everything is added up in radiance; one inversion at the end. Method `joint` works on cross-calibrated observations with
inverse-variance weights and a robust loss; the others are what the field does, kept for comparison.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ..physics.band import ZERO_DEGC_K, Band
from ..physics.emissivity import EmissivityModel, follows_shape
from ..physics.equation import paper_chain, surface_radiance
from ..recipe import TemperatureSection
from ..robust import median
from ..types import Bool, Float, Float32, Int, Observations, OutputMode
from .crosscal import Calibration
from .mean import Groups, RobustMean, Solved
from .problem import ThermalProblem
from .room.stated import Room
from .uncertainty import (
    AngleTables,
    Budget,
    ErrorModel,
    Levers,
    Uncertainty,
    observation_variance,
    registration_m,
    silhouette_share,
    skin_slope,
    vertex_uncertainty,
)

THREADS = 2
BLOCK = 1_500_000  # rows worked on at once by each thread: bounds memory whatever the scan
CACHED = 150_000  # the same where no block needs a scale of its own: their columns stay in a processor's cache
BLOCK_VIEWS = 5  # following each other: what they err in common is one error
FEWEST_BLOCKS = 10  # of a scan's views: with few of them each stands for itself
DISAGREE = 0.01  # chance below which a vertex's own views disagree by more than their errors explain
PATCH_M = 0.05  # of skin, over which vertices' own scatter is averaged: one vertex has too few views for it
MAX_CELLS = 200  # of the grid along its longest side
OTHER_EPSILON_SIGMA = 0.1  # of the emissivity of what is not skin: cloth and hair reach from 0.75 to 0.98
MODES = 10  # of the calibration's covariance that are followed to each vertex
FACING_DEG = 15.0  # what counts as straight on for the paper's S


@dataclass(frozen=True, eq=False)
class BlendResult:
    """Temperatures of V vertices; NaN = no observation counts.

    absolute_K, normal_equivalent_K, apparent_K : (V,) float64. uncertainty : one sigma of `output`, with its parts.
    count : (V,) int32 observations that count. oblique : (V,) nothing straighter than the limit saw it.
    best_angle_deg : (V,) float32 of the straightest one; distance_m : its range. residual : (V,) float32, rms of the
    views about the vertex in sigmas of their own errors (1 = as expected; NaN for one view). spread_K : the same in K.
    own_K2 : (V,) variance of the vertex's mean as its own rows say, K².
    """

    output: OutputMode
    absolute_K: Float
    normal_equivalent_K: Float
    apparent_K: Float
    uncertainty: Uncertainty
    count: Int
    oblique: Bool
    best_angle_deg: Float32
    distance_m: Float32
    residual: Float32
    spread_K: Float32
    own_K2: Float32

    @property
    def temperature_K(self) -> Float:
        """(V,) in the sense of `output`."""
        return {
            "absolute": self.absolute_K,
            "normal-equivalent": self.normal_equivalent_K,
            "apparent": self.apparent_K,
        }[self.output]


def blend(problem: ThermalProblem, calibration: Calibration | None, *, with_uncertainty: bool = True) -> BlendResult:
    """One temperature per vertex from all observations of it.

    calibration : used by method `joint` only; its shape of ε(θ) replaces the model's. with_uncertainty : False for a
    first round whose temperatures only feed the next: no budget, NaN.
    """
    observations, n_vertices = problem.observations, len(problem)
    task = _Task.of(problem, calibration, with_uncertainty)
    usable, oblique = _usable(problem)

    counting = np.flatnonzero(usable)
    groups, order = Groups.by_vertex(observations.vertex[counting], n_vertices)
    counting = counting[order]

    def block(edges: tuple[int, int]) -> _Block:
        mine, numbers = groups.part(*edges)
        rows = observations.select(counting[numbers])
        local = problem.errors.at(mine.vertex, n_vertices)
        rows = replace(rows, vertex=mine.rows(np.arange(len(mine), dtype=np.int32)))
        return _blend(rows, mine, problem, task, local)

    rounds = max(1, -(-len(counting) // (THREADS * task.rows_at_once)))  # whole rounds: no thread waits for the other
    begin = np.linspace(0, len(counting), THREADS * rounds + 1).astype(int)
    edges = [*np.searchsorted(groups.start, begin[:-1]).tolist(), len(groups)]
    with ThreadPoolExecutor(max_workers=THREADS) as pool:
        return _assembled(list(pool.map(block, pairwise(edges))), oblique, problem, task)


@dataclass(frozen=True, eq=False)
class _Task:
    """What a blend needs besides observations: the same for all blocks of vertices."""

    calibration: Calibration | None
    given: EmissivityModel  # the recipe's
    model: EmissivityModel  # with the fitted shape
    band: Band
    room: Room
    settings: TemperatureSection
    slope_L: float
    paper_S: float
    distance_m: float  # typical
    middle_m: Float32  # (3,) of the body
    body_m: float  # rms distance of vertices from it
    registration_over: float
    gain_pivot_K: float | None
    with_uncertainty: bool

    @classmethod
    def of(cls, problem: ThermalProblem, calibration: Calibration | None, with_uncertainty: bool) -> _Task:
        rows, settings, given = problem.observations, problem.settings, problem.emissivity
        calibration = calibration if settings.method == "joint" else None
        middle_m = np.median(problem.points_m, axis=0)
        return cls(
            calibration=calibration,
            given=given,
            model=calibration.emissivity(given) if calibration else given,
            band=problem.band,
            room=problem.room,
            settings=settings,
            slope_L=calibration.slope_L if calibration else skin_slope(problem.band, rows.radiance),
            paper_S=_paper_scale(rows, given, problem.band, problem.room) if settings.method == "paper" else 1.0,
            distance_m=median(rows.range_m) if len(rows) else 0.0,
            middle_m=middle_m,
            body_m=float(np.sqrt(((problem.points_m - middle_m) ** 2).sum(1).mean())),
            registration_over=problem.errors.registration_over,
            gain_pivot_K=_gain_pivot_K(problem, calibration),
            with_uncertainty=with_uncertainty,
        )

    @property
    def angle_corrected(self) -> bool:
        return self.settings.method in ("joint", "corrected-cos")

    @property
    def epsilon0(self) -> float:
        """1 where nothing is corrected."""
        return self.model.normal if self.angle_corrected else 1.0

    @property
    def rows_at_once(self) -> int:
        """Rows of a block. Without a calibration or sigmas a robust mean takes its scale from its own block."""
        return CACHED if self.calibration and self.settings.weight == "inverse-variance" else BLOCK

    @cached_property
    def tables(self) -> AngleTables:
        return AngleTables.of(self.model)


@dataclass(frozen=True, eq=False)
class _Block:
    """The blend of the vertices of one block that were seen: columns (G,) by name, errors apart."""

    vertex: Int
    columns: dict[str, NDArray]
    parts_K: dict[str, NDArray]
    common_K: dict[str, NDArray]
    modes_K: NDArray


def _blend(rows: Observations, groups: Groups, problem: ThermalProblem, task: _Task, errors: ErrorModel) -> _Block:
    """Blend rows that are grouped by vertex; their vertices are numbered by group."""
    method, band, L_r = task.settings.method, task.band, problem.L_reflected[groups.vertex]
    best = groups.least(-rows.cos_angle)
    resolution = 1 / rows.footprint_m2
    apparent = groups.sums(resolution * rows.radiance) / groups.sums(resolution)
    columns = {
        "count": groups.count,
        "best_angle_deg": np.degrees(np.arccos(np.clip(rows.cos_angle[best], -1, 1))),
        "distance_m": rows.range_m[best],
        "apparent_K": band.temperature_K(apparent),
        "radius_m": np.linalg.norm(problem.points_m[groups.vertex] - task.middle_m, axis=1),
    }
    parts: dict[str, NDArray] = {}
    common: dict[str, NDArray] = {}
    modes = np.zeros((len(groups), 0))
    if method in ("nearest-view", "paper"):
        pick = groups.least(rows.range_m) if method == "nearest-view" else best
        L0 = L_s = _single(rows.select(pick), task)
        parts = {"noise": np.full(len(groups), errors.netd_K)}
    else:
        mean = _robust_mean(rows, groups, L_r, task, errors)
        scale = task.calibration.residual_sigma if task.calibration and mean.statistical else None
        solved = mean.solve(robust=method == "joint", scale=scale)
        x = solved.x
        L0, L_s = surface_radiance(x, 1.0, L_r), surface_radiance(x, task.epsilon0, L_r)
        columns["residual"], spread = mean.scatter(solved)
        columns["spread_K"] = spread / task.slope_L
        if task.with_uncertainty:
            size = int(np.clip(problem.n_views // FEWEST_BLOCKS, 1, BLOCK_VIEWS))
            to_K2 = (task.slope_L * task.epsilon0) ** -2
            columns["own_K2"] = mean.own_variance(solved, rows.view // size) * to_K2
            apart_K2 = mean.own_variance(solved, np.arange(len(rows), dtype=np.int32)) * to_K2
            levers = _levers(rows, mean, solved, task, errors, problem.room_errors(groups.vertex))
            parts, common, modes = _errors_of(levers, x, band.temperature_K(L_s), columns, task, errors)
            if method == "joint":
                parts["views"] = _disagreement(apart_K2, parts, groups.count.astype(np.int32))
            for name, effect in problem.effects.items():
                common[name] = effect[groups.vertex] / (task.slope_L * task.epsilon0)
    columns |= {"absolute_K": band.temperature_K(L_s), "normal_equivalent_K": band.temperature_K(L0)}
    return _Block(groups.vertex, columns, parts, common, modes)


def _errors_of(
    levers: Levers, x: Float, T_K: Float, columns: dict[str, NDArray], task: _Task, errors: ErrorModel
) -> tuple[dict[str, NDArray], dict[str, NDArray], NDArray]:
    calibration = task.calibration
    fitted = calibration is not None and calibration.shape_sigma > 0
    budget = Budget(
        errors=errors,
        epsilon0=task.epsilon0,
        absolute=task.settings.output == "absolute" and task.angle_corrected,
        slope_L=task.slope_L,
        shape_fitted=fitted,
        epsilon0_follows=fitted and follows_shape(task.given),
        level_sigma_K=calibration.level_sigma_K if calibration else np.nan,
        air_K=task.room.air_K,
        transmission_per_m=task.settings.transmission_per_m,
        sigma_normal_deg=errors.sigma_normal_deg if calibration is None else calibration.sigma_normal_deg,
        registration_over=task.registration_over,
        pattern_K=0.0 if calibration is None else calibration.pattern_sigma_K,
        gain_pivot_K=task.gain_pivot_K,
        body_m=task.body_m,
    )
    views_K = None if calibration else columns["spread_K"]
    path_m = columns["distance_m"] - task.distance_m
    return vertex_uncertainty(budget, levers, x, T_K, path_m, columns["radius_m"], views_K)


def _disagreement(apart_K2: Float, parts_K: dict[str, NDArray], count: Int) -> Float:
    """(G,) K, what a vertex's mean errs by as the scatter of its own rows says, beyond what the budget explains.

    apart_K2 : variance of the mean by that scatter, NaN for one row. parts_K : of the budget. count : rows. Only where
    chance would show as much once in a hundred vertices: few rows know their own scatter badly.
    """
    budget_K2 = np.sum([p**2 for p in parts_K.values()], axis=0)
    freedom = np.maximum(count - 1, 1)
    beyond = np.nan_to_num(apart_K2) * freedom > chdtri(freedom, DISAGREE) * budget_K2
    return np.where(beyond, np.sqrt(np.maximum(np.nan_to_num(apart_K2) - budget_K2, 0)), 0.0)


def _assembled(blocks: list[_Block], oblique: Bool, problem: ThermalProblem, task: _Task) -> BlendResult:
    """Blocks put into arrays of all vertices: NaN, and count 0, where none was seen."""
    vertex, n_vertices = np.concatenate([b.vertex for b in blocks]), len(problem)

    def whole(pieces: list[NDArray], dtype: type) -> NDArray:
        found = np.concatenate(pieces)
        out: NDArray = np.full((n_vertices, *found.shape[1:]), 0 if dtype is np.int32 else np.nan, dtype)
        out[vertex] = found
        return out

    def column(name: str, dtype: type = np.float64) -> NDArray:
        nan = [np.full(len(b.vertex), np.nan) for b in blocks]
        return whole([b.columns.get(name, n) for b, n in zip(blocks, nan, strict=True)], dtype)

    parts = {k: whole([b.parts_K[k] for b in blocks], np.float32) for k in blocks[0].parts_K}
    own_K2 = column("own_K2", np.float32)
    if parts and task.settings.method == "joint":
        parts["noise"] = _own_noise(parts["noise"], parts["normals"], own_K2, problem.points_m)
    T_K = column("absolute_K")
    if parts and problem.other is not None:
        unknown = OTHER_EPSILON_SIGMA * np.abs(T_K - problem.room.reflected_K)
        parts["not_skin"] = np.where(problem.other | np.isnan(T_K), unknown, 0).astype(np.float32)
    common = {k: whole([b.common_K[k] for b in blocks], np.float32) for k in blocks[0].common_K}
    modes = whole([b.modes_K for b in blocks], np.float32)
    return BlendResult(
        output=task.settings.output,
        absolute_K=T_K,
        normal_equivalent_K=column("normal_equivalent_K"),
        apparent_K=column("apparent_K"),
        uncertainty=Uncertainty.of(parts or {"noise": np.full(n_vertices, np.nan)}, common, modes),
        count=column("count", np.int32),
        oblique=oblique,
        best_angle_deg=column("best_angle_deg", np.float32),
        distance_m=column("distance_m", np.float32),
        residual=column("residual", np.float32),
        spread_K=column("spread_K", np.float32),
        own_K2=own_K2,
    )


def _gain_pivot_K(problem: ThermalProblem, calibration: Calibration | None) -> float | None:
    """The temperature at which an error of the gain changes nothing: the references', else the usual reading.

    None: no error of the gain is to be budgeted.
    """
    solved = calibration is not None and calibration.gain != 1
    if solved or not problem.errors.sigma_gain:
        return None
    expected = [b.expected for b in problem.blackbodies] or [c.expected for c in problem.contacts]
    if not expected and not np.isfinite(problem.observations.radiance).any():
        return None
    L = np.mean(expected) if expected else np.nanmedian(problem.observations.radiance)
    return float(problem.band.temperature_K(L))


def _own_noise(noise_K: Float32, normals_K: Float32, own_K2: Float32, points_m: Float32) -> Float32:
    """Noise (V,) K at points_m (V, 3), or what rows around say, own_K2 (V,) K², beyond normals_K (V,) K."""
    around_K2 = np.nan_to_num(around(own_K2, points_m, PATCH_M))  # where no row has others to be compared with: 0
    return np.sqrt(np.maximum(noise_K**2, around_K2 - normals_K**2)).astype(np.float32)


def around(values: NDArray, points_m: NDArray, size_m: float) -> Float:
    """Mean of values (V,) about each of points_m (V, 3), over cells of size_m that blend into each other; NaN = none.

    Values are shared out to the eight nodes of a grid around a point, and read from there again.
    """
    low = points_m.min(axis=0, initial=np.inf)
    size_m = max(size_m, float(np.ptp(points_m, axis=0).max(initial=0)) / MAX_CELLS)
    at = (points_m - low) / size_m
    corner = np.floor(at).astype(np.int64)
    share, shape = at - corner, corner.max(axis=0, initial=0) + 2
    known = np.isfinite(values)
    filled, sums, weights = np.where(known, values, 0.0), np.zeros(shape.prod()), np.zeros(shape.prod())
    nodes = []
    for step in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(step, share, 1 - share), axis=1)
        node = np.ravel_multi_index((corner + step).T, shape)
        sums += np.bincount(node, weight * filled, len(sums))
        weights += np.bincount(node, weight * known, len(sums))
        nodes.append((node, weight))
    total = sum(weight * sums[node] for node, weight in nodes)
    seen = sum(weight * weights[node] for node, weight in nodes)
    return np.divide(total, seen, out=np.full(len(values), np.nan), where=seen > 0)


# ---------------------------------------------------------------- which observations count


def _usable(problem: ThermalProblem) -> tuple[Bool, Bool]:
    """(rows that count, vertices that only oblique rows saw)."""
    observations, n_vertices = problem.observations, len(problem)
    max_angle_deg = problem.mapping.max_angle_deg
    last_resort_angle_deg = max(problem.mapping.last_resort_angle_deg, max_angle_deg)
    measured = np.isfinite(observations.radiance)
    good = measured & (observations.cos_angle >= np.float32(np.cos(np.radians(max_angle_deg))))
    well_seen = np.zeros(n_vertices, bool)
    well_seen[observations.vertex[good]] = True
    last = measured & (observations.cos_angle >= np.float32(np.cos(np.radians(last_resort_angle_deg)))) & ~good
    last &= ~well_seen[observations.vertex] & problem.counts
    oblique = np.zeros(n_vertices, bool)
    oblique[observations.vertex[last]] = True
    return good | last, oblique


def _single(rows: Observations, task: _Task) -> Float:
    """Radiance of one row a vertex: raw, or for method `paper` Eqs. 24-27 in degrees Celsius, as radiance again."""
    L = rows.radiance.astype(np.float64)
    if task.settings.method == "nearest-view":
        return L
    degC, ambient = task.band.temperature_K(L) - ZERO_DEGC_K, task.room.reflected_K - ZERO_DEGC_K
    epsilon = task.given(rows.cos_angle.astype(np.float64))
    _, scaled = paper_chain(degC, epsilon, ambient, S=task.paper_S)
    return task.band.radiance(scaled + ZERO_DEGC_K)


def _paper_scale(rows: Observations, emissivity: EmissivityModel, band: Band, room: Room) -> float:
    """The paper's S (Eq. 26): measured over corrected temperature, °C, where the surface faces the camera."""
    facing = np.flatnonzero(rows.cos_angle >= min(np.cos(np.radians(FACING_DEG)), rows.cos_angle.max(initial=0)))
    facing = facing[np.isfinite(rows.radiance[facing])][:: max(1, len(facing) // 100_000)]
    if not len(facing):
        return 1.0
    degC = band.temperature_K(rows.radiance[facing].astype(np.float64)) - ZERO_DEGC_K
    corrected, _ = paper_chain(
        degC, emissivity(rows.cos_angle[facing].astype(np.float64)), room.reflected_K - ZERO_DEGC_K
    )
    return float(np.median(degC) / np.median(corrected))


# ---------------------------------------------------------------- weighted means


def _robust_mean(rows: Observations, groups: Groups, L_r: Float, task: _Task, errors: ErrorModel) -> RobustMean:
    """Rows y = E·x with the method's weights."""
    y = (task.calibration.corrected(rows) if task.calibration else rows.radiance) - groups.rows(L_r)
    E = task.tables.relative(rows.cos_angle) if task.angle_corrected else np.ones(len(rows))
    method = task.settings.method
    statistical = method == "joint" and task.settings.weight == "inverse-variance"
    if statistical:
        excess = groups.rows((groups.sums(y) / groups.count).astype(np.float32))
        weight = np.float32(1) / observation_variance(rows, excess, task.tables, errors, task.slope_L)
    elif method == "mean":
        weight = np.ones(len(rows), np.float32)
    else:  # resolution: pixels per surface, proportional to cosθ/d²
        weight = np.float32(1e-6) / rows.footprint_m2
    weight = np.asarray(weight, np.float32)
    return RobustMean(groups, np.asarray(y), E, weight, statistical)


def _levers(
    rows: Observations, mean: RobustMean, solved: Solved, task: _Task, errors: ErrorModel, room: Float
) -> Levers:
    """Σ over each vertex's rows of h times what an error does to a row, h = wE/ΣwE²; room : (G, R), see `Levers`."""
    groups, one = mean.groups, np.ones(len(rows), np.float32)
    h = (solved.weight * mean.E / groups.rows(mean.denominator(solved.weight))).astype(np.float32)
    slope = task.tables.slope(rows.cos_angle) if task.angle_corrected else 0 * one
    loss, mixed = (1 - mean.E).astype(np.float32), silhouette_share(rows.edge_px, errors)
    block = np.stack([one, loss, slope, registration_m(rows, errors), mixed], axis=1)
    sums = groups.weighted_sums(h, block)
    squares = groups.weighted_sums(h * h, np.stack([one, slope * slope], axis=1))
    modes = np.zeros((len(groups), 0))
    if task.calibration:
        modes = groups.weighted_sums(
            h, task.calibration.error_modes(MODES)(rows, groups.rows(solved.x.astype(np.float32)))
        )
    return Levers(squares[:, 0], sums[:, 0], sums[:, 1], sums[:, 2], squares[:, 1], sums[:, 3], sums[:, 4], modes, room)
