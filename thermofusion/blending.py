"""Many observations of a vertex into one temperature: weights, methods, fallbacks.

Everything is added up in radiance; one inversion at the end. Method `joint` works on cross-calibrated observations with
inverse-variance weights and a robust loss; the others are what the field does, kept for comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from .crosscal import CrosscalResult
from .emissivity import EmissivityModel, follows_shape
from .radiometry import ZERO_DEGC_K, Band, leaving_radiance, paper_chain
from .recipe import RadiometrySection
from .robustmean import RobustMean, chunks, vertex_sums
from .types import Bool, Float, Float32, Int, Observations, OutputMode
from .uncertainty import (
    AngleTables,
    ErrorModel,
    Levers,
    Uncertainty,
    observation_variance,
    registration_m,
    skin_slope,
    vertex_uncertainty,
)

BLOCK = 12_000_000  # rows held in copies at once: larger scans are blended by blocks of vertices
MODES = 10  # of the calibration's covariance that are followed to each vertex
FACING_DEG = 15.0  # what counts as straight on for the paper's S


@dataclass(frozen=True, eq=False)
class BlendResult:
    """Temperatures of V vertices; NaN = no observation counts.

    absolute_K, normal_equivalent_K, apparent_K : (V,) float64. uncertainty : one sigma of `output`, with its parts.
    count : (V,) int32 observations that count. oblique : (V,) nothing straighter than the limit saw it.
    best_angle_deg : (V,) float32 of the straightest one; distance_m : its range. residual : (V,) float32, rms of the
    views about the vertex in sigmas of their own errors (1 = as expected; NaN for one view). spread_K : the same in K.
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

    @classmethod
    def joined(cls, blocks: Sequence[BlendResult]) -> BlendResult:
        """Blocks of vertices, one after the other."""
        names = [f for f in cls.__dataclass_fields__ if f not in ("output", "uncertainty")]
        arrays = {name: np.concatenate([getattr(b, name) for b in blocks]) for name in names}
        uncertainty = Uncertainty.joined([b.uncertainty for b in blocks])
        return cls(output=blocks[0].output, uncertainty=uncertainty, **arrays)

    @property
    def temperature_K(self) -> Float:
        """(V,) in the sense of `output`."""
        return {
            "absolute": self.absolute_K,
            "normal-equivalent": self.normal_equivalent_K,
            "apparent": self.apparent_K,
        }[self.output]


def remove_air_path(observations: Observations, transmission_per_m: float, L_air: float) -> Observations:
    """Observations with the air between surface and camera removed: L = (L' - (1-τ) L_air)/τ, τ = τ₁^range."""
    if transmission_per_m == 1.0:
        return observations
    tau = np.float32(transmission_per_m) ** observations.range_m
    columns = {k: getattr(observations, k) for k in observations.__dataclass_fields__}
    columns["radiance"] = leaving_radiance(observations.radiance, transmission=tau, L_air=L_air).astype(np.float32)
    return Observations(**columns)


def blend(
    observations: Observations,
    n_vertices: int,
    calibration: CrosscalResult | None,
    emissivity: EmissivityModel,
    band: Band,
    *,
    L_reflected: float | NDArray,
    reflected_K: float,
    air_K: float | None = None,
    settings: RadiometrySection | None = None,
    errors: ErrorModel | None = None,
    max_angle_deg: float = 65.0,
    last_resort_angle_deg: float = 75.0,
) -> BlendResult:
    """One temperature per vertex from all observations of it.

    Parameters
    ----------
    observations : sorted by (view, vertex); radiance as the camera reports it, freed of the air path.
    calibration : used by method `joint` only; its shape of ε(θ) replaces the model's.
    emissivity : the recipe's model. L_reflected : radiance reflected by vertices, scalar or (V,).
    reflected_K : temperature of the room's reflection (the paper's T_a). air_K : of the air, for the budget.
    """
    settings, errors = settings or RadiometrySection(), errors or ErrorModel()
    calibration = calibration if settings.method == "joint" else None
    task = _Task(
        calibration=calibration,
        given=emissivity,
        model=calibration.emissivity(emissivity) if calibration else emissivity,
        band=band,
        reflected_K=reflected_K,
        air_K=air_K,
        settings=settings,
        slope_L=calibration.slope_L if calibration else skin_slope(band, observations.radiance),
        paper_S=_paper_scale(observations, emissivity, band, reflected_K) if settings.method == "paper" else 1.0,
        angles_deg=(max_angle_deg, max(last_resort_angle_deg, max_angle_deg)),
    )
    L_r = np.broadcast_to(np.asarray(L_reflected, np.float64), (n_vertices,))
    gradient = np.broadcast_to(np.asarray(errors.gradient_K_per_m, np.float32), (n_vertices,))
    blocks = max(1, -(-len(observations) // BLOCK))
    edges = np.linspace(0, n_vertices, blocks + 1).astype(int)
    results = []
    for lo, hi in pairwise(edges):
        rows = observations
        if blocks > 1:
            rows = observations.select(np.flatnonzero((rows.vertex >= lo) & (rows.vertex < hi)))
            rows = replace(rows, vertex=rows.vertex - np.int32(lo))
        results.append(_blend(rows, L_r[lo:hi], task, replace(errors, gradient_K_per_m=gradient[lo:hi])))
    return results[0] if blocks == 1 else BlendResult.joined(results)


@dataclass(frozen=True, eq=False)
class _Task:
    """What a blend needs besides observations: the same for all blocks of vertices."""

    calibration: CrosscalResult | None
    given: EmissivityModel  # the recipe's
    model: EmissivityModel  # with the fitted shape
    band: Band
    reflected_K: float
    air_K: float | None
    settings: RadiometrySection
    slope_L: float
    paper_S: float
    angles_deg: tuple[float, float]


def _blend(rows: Observations, L_r: Float, task: _Task, errors: ErrorModel) -> BlendResult:
    """`blend` of one block of vertices, numbered from 0."""
    V, method, band = len(L_r), task.settings.method, task.band
    usable, oblique, count = _usable(rows, V, *task.angles_deg)
    rows = rows if usable.all() else rows.select(usable)
    best, distance = _best(rows, V)
    apparent = _mean(rows, rows.radiance, 1 / rows.footprint_m2, V)
    if method in ("nearest-view", "paper"):
        pick = _pick(rows, V, rows.range_m if method == "nearest-view" else -rows.cos_angle)
        L0 = L_s = _single(rows.select(pick), V, task)
        residual = spread = np.full(V, np.nan, np.float32)
        uncertainty = Uncertainty.of({"noise": np.where(np.isnan(L_s), np.nan, errors.netd_K)})
    else:
        system = _robust_mean(rows, L_r, task, errors)
        scale = task.calibration.residual_sigma if task.calibration and system.statistical else None
        x = system.solve(robust=method == "joint", scale=scale)
        L0, L_s = L_r + x, L_r + x / system.epsilon0
        residual, spread = system.scatter(x)
        uncertainty = _uncertainty(rows, system, x, band.temperature_K(L_s), distance, spread, task, errors)
    T0, T_s, T_app = (band.temperature_K(L) for L in (L0, L_s, apparent))
    return BlendResult(
        task.settings.output, T_s, T0, T_app, uncertainty, count, oblique, best, distance, residual, spread
    )


def _uncertainty(
    rows: Observations,
    system: RobustMean,
    x: Float,
    T_K: Float,
    distance_m: Float32,
    spread_K: Float32,
    task: _Task,
    errors: ErrorModel,
) -> Uncertainty:
    calibration = task.calibration
    fitted = calibration is not None and calibration.shape_sigma > 0
    return vertex_uncertainty(
        _levers(rows, system, x, task, errors),
        x,
        T_K,
        epsilon0=system.epsilon0,
        absolute=task.settings.output == "absolute" and system.angle_corrected,
        slope_L=task.slope_L,
        slope_reflected=float(task.band.d_radiance_dT(task.reflected_K)),
        errors=errors,
        shape_fitted=fitted,
        epsilon0_follows=fitted and follows_shape(task.given),
        reference_sigma_K=calibration.reference_sigma_K if calibration else np.nan,
        air_K=task.air_K,
        transmission_per_m=task.settings.transmission_per_m,
        range_m=distance_m,
        views_K=None if calibration else spread_K,
    )


# ---------------------------------------------------------------- which observations count


def _usable(
    observations: Observations, n_vertices: int, max_angle_deg: float, last_resort_angle_deg: float
) -> tuple[Bool, Bool, Int]:
    """(rows that count, vertices that only oblique rows saw, rows per vertex)."""
    cos = np.where(np.isfinite(observations.radiance), observations.cos_angle, -1.0)
    good = cos >= np.float32(np.cos(np.radians(max_angle_deg)))
    last = cos >= np.float32(np.cos(np.radians(max(last_resort_angle_deg, max_angle_deg))))
    well_seen = np.zeros(n_vertices, bool)
    well_seen[observations.vertex[good]] = True
    usable = good | (last & ~well_seen[observations.vertex])
    count = np.bincount(observations.vertex[usable], minlength=n_vertices).astype(np.int32)
    return usable, (count > 0) & ~well_seen, count


def _part(rows: Observations, c: slice) -> Observations:
    """Views, not copies, of some rows."""
    return Observations(**{name: getattr(rows, name)[c] for name in rows.__dataclass_fields__})


def _mean(rows: Observations, values: NDArray, weights: NDArray, n_vertices: int) -> Float:
    """Weighted mean per vertex, NaN where no row is."""
    total = vertex_sums(rows.vertex, weights, n_vertices)
    with np.errstate(invalid="ignore", divide="ignore"):
        weighted = vertex_sums(rows.vertex, weights * values.astype(np.float64), n_vertices)
        return weighted / np.where(total > 0, total, np.nan)


def _best(rows: Observations, n_vertices: int) -> tuple[Float32, Float32]:
    """Angle [deg] and range [m] of the straightest row of each vertex."""
    pick = _pick(rows, n_vertices, -rows.cos_angle)
    angle, distance = np.full(n_vertices, np.nan, np.float32), np.full(n_vertices, np.nan, np.float32)
    angle[rows.vertex[pick]] = np.degrees(np.arccos(np.clip(rows.cos_angle[pick], -1, 1)))
    distance[rows.vertex[pick]] = rows.range_m[pick]
    return angle, distance


def _pick(rows: Observations, n_vertices: int, cost: NDArray) -> NDArray[np.intp]:
    """Row of least cost of each vertex that has one; the first row among equals."""
    least = np.full(n_vertices, np.inf, cost.dtype)
    np.minimum.at(least, rows.vertex, cost)
    candidate = np.flatnonzero(cost == least[rows.vertex])
    first = np.full(n_vertices, -1, np.intp)
    first[rows.vertex[candidate][::-1]] = candidate[::-1]
    return first[first >= 0]


def _single(rows: Observations, n_vertices: int, task: _Task) -> Float:
    """Radiance from one row a vertex: raw, or for method `paper` Eqs. 24-27 in degrees Celsius, as radiance again."""
    L = rows.radiance.astype(np.float64)
    if task.settings.method == "paper":
        degC, ambient = task.band.temperature_K(L) - ZERO_DEGC_K, task.reflected_K - ZERO_DEGC_K
        epsilon = task.given(rows.cos_angle.astype(np.float64))
        _, scaled = paper_chain(degC, epsilon, ambient, S=task.paper_S)
        L = task.band.radiance(scaled + ZERO_DEGC_K)
    out = np.full(n_vertices, np.nan)
    out[rows.vertex] = L
    return out


def _paper_scale(rows: Observations, emissivity: EmissivityModel, band: Band, reflected_K: float) -> float:
    """The paper's S (Eq. 26): measured over corrected temperature, °C, where the surface faces the camera."""
    facing = np.flatnonzero(rows.cos_angle >= min(np.cos(np.radians(FACING_DEG)), rows.cos_angle.max(initial=0)))
    facing = facing[np.isfinite(rows.radiance[facing])][:: max(1, len(facing) // 100_000)]
    if not len(facing):
        return 1.0
    degC = band.temperature_K(rows.radiance[facing].astype(np.float64)) - ZERO_DEGC_K
    corrected, _ = paper_chain(degC, emissivity(rows.cos_angle[facing].astype(np.float64)), reflected_K - ZERO_DEGC_K)
    return float(np.median(degC) / np.median(corrected))


# ---------------------------------------------------------------- weighted means


def _robust_mean(
    rows: Observations,
    L_r: Float,
    task: _Task,
    errors: ErrorModel,
) -> RobustMean:
    """Rows y = E·x with the method's weights."""
    method, calibration = task.settings.method, task.calibration
    corrected = method in ("joint", "corrected-cos")
    statistical = method == "joint" and task.settings.weight == "inverse-variance"
    tables = AngleTables.of(task.model)
    n, n_vertices = len(rows), len(L_r)
    y, E, weight = np.empty(n), np.empty(n), np.ones(n, np.float32)
    for c in chunks(n):
        part = _part(rows, c)
        y[c] = (calibration.corrected(part) if calibration else part.radiance) - L_r[part.vertex]
        E[c] = tables.relative(part.cos_angle) if corrected else 1.0
    excess = _mean(rows, y, weight, n_vertices) if statistical else L_r
    for c in chunks(n if method != "mean" else 0):
        part = _part(rows, c)
        if statistical:
            weight[c] = 1 / observation_variance(part, excess[part.vertex], tables, errors, task.slope_L)
        else:  # resolution: pixels per surface, proportional to cosθ/d²
            weight[c] = 1e-6 / part.footprint_m2
    epsilon0 = task.model.normal if corrected else 1.0
    return RobustMean(
        rows.vertex, y, E, weight, weight.copy(), n_vertices, corrected, statistical, epsilon0, task.slope_L
    )


def _levers(rows: Observations, system: RobustMean, x: Float, task: _Task, errors: ErrorModel) -> Levers:
    """Σ over each vertex's rows of h times what an error does to a row, h = wE/ΣwE²."""
    V, R = system.n_vertices, MODES if task.calibration else 0
    a = system.denominator(system.robust)
    inverse = np.divide(1.0, a, out=np.zeros(V), where=a > 0)
    tables = AngleTables.of(task.model)
    sums, squares = np.zeros((V, 4 + R)), np.zeros((V, 2))
    effect = task.calibration.error_modes(MODES) if task.calibration else None
    for c in chunks(len(rows)):
        part = _part(rows, c)
        h = (system.robust[c] * system.E[c] * inverse[part.vertex]).astype(np.float32)
        slope = tables.slope(part.cos_angle) if system.angle_corrected else np.zeros(len(h), np.float32)
        columns = [
            np.ones(len(h), np.float32),
            (1 - system.E[c]).astype(np.float32),
            slope,
            registration_m(part, errors),
        ]
        block = np.stack(columns, axis=1)
        if effect is not None:
            block = np.concatenate([block, effect(part, x[part.vertex])], axis=1)
        n = np.arange(len(h) + 1)
        sums += csc_matrix((h, part.vertex, n), shape=(V, len(h))) @ block
        block = np.stack([np.ones(len(h), np.float32), slope**2], axis=1)
        squares += csc_matrix((h * h, part.vertex, n), shape=(V, len(h))) @ block
    return Levers(squares[:, 0], sums[:, 0], sums[:, 1], sums[:, 2], squares[:, 1], sums[:, 3], sums[:, 4:])
