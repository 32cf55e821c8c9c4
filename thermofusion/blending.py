"""Many observations of a vertex into one temperature: weights, methods, fallbacks.

Everything is added up in radiance; one inversion at the end. Method `joint` works on cross-calibrated observations with
inverse-variance weights and a robust loss; the others are what the field does, kept for comparison.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from .crosscal import CrosscalResult
from .emissivity import EmissivityModel, follows_shape
from .overlap import TUKEY
from .radiometry import ZERO_DEGC_K, Band, leaving_radiance, paper_chain
from .recipe import RadiometrySection
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

CHUNK = 1_000_000  # rows worked on at once: bounds memory whatever the scan
L1_STEPS, TUKEY_STEPS = 4, 3
L1_FLOOR = 0.3  # of one sigma: below it the L1 start is quadratic
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
    joint = settings.method == "joint"
    calibration = calibration if joint else None
    model = calibration.emissivity(emissivity) if calibration else emissivity
    usable, oblique, count = _usable(observations, n_vertices, max_angle_deg, last_resort_angle_deg)
    rows = observations if usable.all() else observations.select(usable)
    L_r = np.broadcast_to(np.asarray(L_reflected, np.float64), (n_vertices,))
    best, distance = _best(rows, n_vertices)
    apparent = _mean(rows, rows.radiance, 1 / rows.footprint_m2, n_vertices)

    if settings.method in ("nearest-view", "paper"):
        pick = _pick(rows, n_vertices, rows.range_m if settings.method == "nearest-view" else -rows.cos_angle)
        raw = np.full(n_vertices, np.nan)
        raw[rows.vertex[pick]] = rows.radiance[pick]
        L0 = raw
        if settings.method == "paper":
            L0 = _paper(rows.select(pick), raw, emissivity, band, reflected_K)
        L_s = L0
        system = None
    else:
        system = _System.build(rows, n_vertices, calibration, model, L_r, settings, errors, band)
        x = system.solve(robust=joint)
        L0 = L_r + x
        L_s = L_r + x / (model.normal if system.angle_corrected else 1.0)

    T0, Ts, T_app = band.temperature_K(L0), band.temperature_K(L_s), band.temperature_K(apparent)
    residual, spread = system.scatter(x) if system else (np.full(n_vertices, np.nan, np.float32),) * 2
    uncertainty = Uncertainty.of({"noise": np.where(np.isnan(Ts), np.nan, errors.netd_K)})
    if system:
        uncertainty = vertex_uncertainty(
            _levers(rows, system, x, calibration, model, errors),
            x,
            Ts,
            epsilon0=model.normal if system.angle_corrected else 1.0,
            absolute=settings.output == "absolute" and system.angle_corrected,
            slope_L=calibration.slope_L if calibration else skin_slope(band, rows.radiance),
            slope_reflected=float(band.d_radiance_dT(reflected_K)),
            errors=errors,
            shape_fitted=bool(calibration and calibration.shape_sigma > 0),
            epsilon0_follows=bool(calibration and calibration.shape_sigma > 0 and follows_shape(emissivity)),
            reference_sigma_K=calibration.reference_sigma_K if calibration else np.nan,
            air_K=air_K,
            transmission_per_m=settings.transmission_per_m,
            range_m=distance,
            views_K=None if calibration else spread,
        )
    return BlendResult(settings.output, Ts, T0, T_app, uncertainty, count, oblique, best, distance, residual, spread)


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


def _chunks(n: int) -> Iterator[slice]:
    for start in range(0, n, CHUNK):
        yield slice(start, min(start + CHUNK, n))


def _part(rows: Observations, c: slice) -> Observations:
    """Views, not copies, of some rows."""
    return Observations(**{name: getattr(rows, name)[c] for name in rows.__dataclass_fields__})


def _sums(vertex: Int, values: NDArray, n_vertices: int) -> Float:
    """Sum of row values per vertex, (V,) float64."""
    out = np.zeros(n_vertices)
    for c in _chunks(len(vertex)):
        out += np.bincount(vertex[c], weights=values[c], minlength=n_vertices)
    return out


def _mean(rows: Observations, values: NDArray, weights: NDArray, n_vertices: int) -> Float:
    """Weighted mean per vertex, NaN where no row is."""
    total = _sums(rows.vertex, weights, n_vertices)
    with np.errstate(invalid="ignore", divide="ignore"):
        return _sums(rows.vertex, weights * values.astype(np.float64), n_vertices) / np.where(total > 0, total, np.nan)


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


def _paper(best: Observations, raw: Float, emissivity: EmissivityModel, band: Band, reflected_K: float) -> Float:
    """Method `paper`: Eqs. 24-27 on each vertex's straightest view, in degrees Celsius, as radiance again.

    S is the ratio of measured to corrected temperature where the surface faces the camera: one number a scan.
    """
    degC = band.temperature_K(best.radiance.astype(np.float64)) - ZERO_DEGC_K
    ambient = reflected_K - ZERO_DEGC_K
    epsilon = emissivity(best.cos_angle.astype(np.float64))
    corrected, _ = paper_chain(degC, epsilon, ambient)
    facing = best.cos_angle >= np.cos(np.radians(FACING_DEG))
    if not facing.any():
        facing = best.cos_angle >= best.cos_angle.max()
    S = float(np.median(degC[facing]) / np.median(corrected[facing]))
    _, scaled = paper_chain(degC, epsilon, ambient, S=S)
    out = np.full_like(raw, np.nan)
    out[best.vertex] = band.radiance(scaled + ZERO_DEGC_K)
    return out


# ---------------------------------------------------------------- weighted means


@dataclass(frozen=True, eq=False)
class _System:
    """Rows of y = E·x[vertex] with weights: x is the vertex's normal-equivalent excess over what it reflects."""

    vertex: Int
    y: Float32
    E: Float32
    weight: Float32  # statistical or geometric, before the robust factor
    robust: Float32  # weight in the end; written by `solve`
    n_vertices: int
    angle_corrected: bool
    statistical: bool  # weight is 1/σ² in radiance
    slope_L: float

    @classmethod
    def build(
        cls,
        rows: Observations,
        n_vertices: int,
        calibration: CrosscalResult | None,
        model: EmissivityModel,
        L_r: Float,
        settings: RadiometrySection,
        errors: ErrorModel,
        band: Band,
    ) -> _System:
        method = settings.method
        corrected = method in ("joint", "corrected-cos")
        statistical = method == "joint" and settings.weight == "inverse-variance"
        tables = AngleTables.of(model)
        slope = calibration.slope_L if calibration else skin_slope(band, rows.radiance)
        n = len(rows)
        y, E, weight = (np.empty(n, np.float32) for _ in range(3))
        excess = _mean(rows, rows.radiance, np.ones(n, np.float32), n_vertices) - L_r if statistical else L_r
        for c in _chunks(n):
            part = _part(rows, c)
            L = calibration.corrected(part) if calibration else part.radiance
            y[c] = L - L_r[part.vertex]
            E[c] = tables.relative(part.cos_angle) if corrected else 1.0
            if statistical:
                weight[c] = 1 / observation_variance(part, excess[part.vertex], tables, errors, slope)
            elif method == "mean":
                weight[c] = 1.0
            else:  # resolution: pixels per surface, proportional to cosθ/d²
                weight[c] = 1e-6 / part.footprint_m2
        return cls(rows.vertex, y, E, weight, weight.copy(), n_vertices, corrected, statistical, slope)

    def solve(self, *, robust: bool) -> Float:
        """x (V,); NaN without rows. Robust: weights of an L1 fit, then Tukey's."""
        x = self._estimate(self.weight)
        if not robust or not len(self.vertex):
            return x
        root = self._inverse_sigma()
        for _ in range(L1_STEPS):
            self._reweight(x, root, L1_FLOOR * self._scale(x, root), _l1)
            x = self._estimate(self.robust)
        l1 = self.robust.copy()
        for _ in range(TUKEY_STEPS):
            self._reweight(x, root, TUKEY * self._scale(x, root), _tukey)
            self._keep_measured(l1)
            x = self._estimate(self.robust)
        return x

    def _reweight(self, x: Float, root: Float32, reach: float, factor: Callable[[Float32], Float32]) -> None:
        """Weights times a factor of the standardised residual in units of `reach`."""
        for c in _chunks(len(self.vertex)):
            self.robust[c] = self.weight[c] * factor(np.abs(self._residual(x, c)) * root[c] / np.float32(reach))

    def _inverse_sigma(self) -> Float32:
        """1/σ of rows; for geometric weights relative, the scale makes up for it."""
        if self.statistical:
            return np.sqrt(self.weight)
        return np.sqrt(self.weight / np.float32(np.median(self.weight)))

    def _keep_measured(self, l1: Float32) -> None:
        """Vertices on which all rows contradict each other keep the weights of the L1 fit."""
        left = _sums(self.vertex, self.robust, self.n_vertices)
        lost = left < 0.02 * _sums(self.vertex, self.weight, self.n_vertices)
        if lost.any():
            rows = lost[self.vertex]
            self.robust[rows] = l1[rows]

    def _scale(self, x: Float, root: Float32) -> float:
        """Robust scale of standardised residuals, from an even sample of rows."""
        pick = slice(0, None, max(1, len(self.vertex) // 200_000))
        r = np.abs(self._residual(x, pick)) * root[pick]
        r = r[np.isfinite(r) & (r > 0)]
        return max(float(np.median(r)) / 0.6745, 1e-3) if len(r) else 1.0

    def _residual(self, x: Float, c: slice) -> Float32:
        return np.asarray(self.y[c] - self.E[c] * x[self.vertex[c]].astype(np.float32), np.float32)

    def _estimate(self, weight: Float32) -> Float:
        wE = weight * self.E
        a = self.denominator(weight)
        with np.errstate(invalid="ignore", divide="ignore"):
            return _sums(self.vertex, wE * self.y, self.n_vertices) / np.where(a > 0, a, np.nan)

    def denominator(self, weight: Float32) -> Float:
        """Σ w E² per vertex."""
        return _sums(self.vertex, weight * self.E * self.E, self.n_vertices)

    def scatter(self, x: Float) -> tuple[Float32, Float32]:
        """Per vertex: rms of residuals in sigmas of the rows' own errors, and in K; NaN with one row only."""
        ones = np.ones(len(self.vertex), np.float32)
        n = _sums(self.vertex, ones, self.n_vertices)
        squares = np.concatenate([self._residual(x, c) ** 2 for c in _chunks(len(self.vertex))] or [ones])
        with np.errstate(invalid="ignore", divide="ignore"):
            freedom = np.where(n > 1, n - 1, np.nan)
            sigmas = np.sqrt(_sums(self.vertex, self.weight * squares, self.n_vertices) / freedom)
            weighted = _sums(self.vertex, self.robust * squares, self.n_vertices)
            spread = np.sqrt(weighted / _sums(self.vertex, self.robust, self.n_vertices) * n / freedom)
        return sigmas.astype(np.float32), (spread / self.slope_L).astype(np.float32)


def _l1(t: Float32) -> Float32:
    return np.asarray(1 / np.maximum(t, np.float32(1)), np.float32)


def _tukey(t: Float32) -> Float32:
    return np.asarray(np.clip(1 - t * t, 0, None) ** 2, np.float32)


def _levers(
    rows: Observations,
    system: _System,
    x: Float,
    calibration: CrosscalResult | None,
    model: EmissivityModel,
    errors: ErrorModel,
) -> Levers:
    """Σ over each vertex's rows of h times what an error does to a row, h = wE/ΣwE²."""
    V, R = system.n_vertices, MODES if calibration else 0
    a = system.denominator(system.robust)
    inverse = np.divide(1.0, a, out=np.zeros(V), where=a > 0)
    tables = AngleTables.of(model)
    sums, squares = np.zeros((V, 4 + R)), np.zeros((V, 2))
    effect = calibration.error_modes(MODES) if calibration else None
    for c in _chunks(len(rows)):
        part = _part(rows, c)
        h = (system.robust[c] * system.E[c] * inverse[part.vertex]).astype(np.float32)
        slope = tables.slope(part.cos_angle) if system.angle_corrected else np.zeros(len(h), np.float32)
        columns = [np.ones(len(h), np.float32), 1 - system.E[c], slope, registration_m(part, errors)]
        block = np.stack(columns, axis=1)
        if effect is not None:
            block = np.concatenate([block, effect(part, x[part.vertex])], axis=1)
        n = np.arange(len(h) + 1)
        sums += csc_matrix((h, part.vertex, n), shape=(V, len(h))) @ block
        block = np.stack([np.ones(len(h), np.float32), slope**2], axis=1)
        squares += csc_matrix((h * h, part.vertex, n), shape=(V, len(h))) @ block
    return Levers(squares[:, 0], sums[:, 0], sums[:, 1], sums[:, 2], squares[:, 1], sums[:, 3], sums[:, 4:])
