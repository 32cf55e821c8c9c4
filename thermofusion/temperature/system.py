"""The least squares system of overlapping views: columns of observations in, offsets, field and shape out.

The unknowns of vertices are eliminated analytically, so that what is solved has the size views + field + shape. See
`crosscal` for the model and docs/radiometry.md for its derivation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve
from scipy.sparse import csr_matrix

from ..physics.equation import excess_reading
from ..robust import HUBER, MAD_PER_SIGMA, TUKEY, huber_weight, median, tukey_weight
from ..types import Bool, Float, Int
from .layout import Layout
from .loops.overlap import Rows, overlap_sums
from .mean import Groups
from .references import ExpectedReading
from .sensor.earlier import FieldPrior
from .sensor.field import ImageField

HUBER_STEPS, TUKEY_STEPS = 4, 40
SQUARE_ROWS = 2048  # that are multiplied at once
COARSE_VERTICES = 5000  # enough for a first estimate
CONVERGED_K = 1e-4  # a hundredth of what any result is good to
SENSOR_CONVERGED_K = 2e-3  # of a single pixel's or column's part: a vertex's mean knows a tenth of it
OFFSET_PRIOR_K = 5.0  # spread of offsets about their mean: only matters for views that overlap with none
FIELD_UNKNOWN_K, FIELD_MEMORY = 0.3, 0.25  # one sigma of the field's change over this share of the image width
SHAPE_PRIOR = 2.0
SHAPE_BOUNDS = (-2.0, 5.0)
GAIN_PRIOR = 0.1
READING_HALF_PX = 8.0  # of a source in the image: single columns of the sensor average out over it
READING_FLOOR_K = 0.01  # what a field of low order leaves at a reference's place


class Columns(Protocol):
    """Further linear terms of what is read: a sensor's pattern, say."""

    def columns(self, u_px: NDArray, v_px: NDArray, view: NDArray) -> csr_matrix:
        """(N, Q) derivatives, W m-2 sr-1, of what is read at pixels u_px, v_px (N,) of each view (N,)."""
        ...

    def precision(self) -> Float:
        """(Q, Q) prior inverse covariance of the coefficients, K-2."""
        ...


@dataclass(frozen=True, eq=False)
class Solution:
    """Parameters p = [offsets (M), field (K), s, γ] with what is known about them."""

    p: Float
    x: Float  # (V,) normal-equivalent excess of vertices
    covariance: Float  # at a given level
    normal: Float  # reduced normal matrix, priors included
    weight: Float  # of observations, robust factor included
    scale: float  # of standardised residuals; 1 = as predicted
    level_gain: Float  # dp / d(level)
    level_variance: float
    iterations: int
    converged: bool


@dataclass(frozen=True, eq=False)
class Level:
    """The hard constraint row·p = target that sets the common level, and the variance of the target."""

    row: Float
    target: float
    variance: float


@dataclass(frozen=True)
class KnownField:
    """The place at which the field is read for a reference: its own, or the nearest at which skin was seen.

    A polynomial says nothing beyond its data: there the field is held, less certain with the distance `away` [image
    widths]."""

    u_px: float
    v_px: float
    away: float = 0.0

    @property
    def sigma_K(self) -> float:
        return FIELD_UNKNOWN_K * min(self.away / FIELD_MEMORY, 1.0)


@dataclass(frozen=True, eq=False)
class ContactRow:
    """Vertices around a contact thermometer: their mean x should be `expected`."""

    vertices: Int
    expected: float
    sigma: float


@dataclass(frozen=True, eq=False)
class OverlapSystem:
    """Rows y = (E + s·D)·x[vertex] + b[group] + φ + γ·(L_r - pivot), with variances; vertices numbered without gaps.

    x holds the camera's gain 1 + γ. patterns : (N, K) of the field. gain_column : (N,) L_r - pivot, what (1+γ)x leaves
    of γ; zero where no gain is solved for.
    group : (N,) the offset's index. keep : (K_all, K) combinations of the field's patterns that are solved for.
    order, start : rows by vertex. reading_places : where the field is taken for each reading. correlated : how many
    vertices err alike (neighbours share their normal, and all share rig and shape): the data's information is divided
    by it where it meets other knowledge.
    """

    vertex: Int
    group: Int
    y: Float
    E: Float
    D: Float
    sigma2: Float
    patterns: Float
    gain_column: Float
    order: Int
    start: Int
    n_groups: int
    field: ImageField
    field_prior: FieldPrior
    keep: Float
    use_shape: bool
    use_gain: bool
    slope_L: float
    pivot: float
    readings: tuple[ExpectedReading, ...]
    reading_groups: tuple[int, ...]
    contacts: tuple[ContactRow, ...]
    reading_places: tuple[KnownField, ...] = ()
    correlated: float = 1.0
    sensor: Columns | None = None
    sensor_columns: csr_matrix | None = None  # (N, Q) of it

    @property
    def layout(self) -> Layout:
        """Where the parameters stand."""
        return Layout(
            self.n_groups, self.keep.shape[1], 0 if self.sensor_columns is None else self.sensor_columns.shape[1]
        )

    @property
    def n_vertices(self) -> int:
        return len(self.start) - 1

    @property
    def anchored(self) -> bool:
        return bool(self.readings or self.contacts)

    def without(self, keep: Float, *, use_shape: bool) -> OverlapSystem:
        """The system with fewer combinations of field patterns, keep (K_all, K), or without the shape."""
        patterns = np.ascontiguousarray(self.patterns @ (self.keep.T @ keep))
        return replace(self, keep=keep, patterns=patterns, use_shape=use_shape)

    def with_sensor(self, sensor: Columns, u_px: NDArray, v_px: NDArray) -> OverlapSystem:
        """The system with a sensor's pattern, at the rows' pixels u_px, v_px (N,)."""
        return replace(self, sensor=sensor, sensor_columns=sensor.columns(u_px, v_px, self.group))

    def part(self, rows: Bool) -> OverlapSystem:
        """The system of some of its rows (N,) mask; vertices keep their numbers."""
        vertex = self.vertex[rows]
        start = np.insert(np.cumsum(np.bincount(vertex, minlength=self.n_vertices)), 0, 0).astype(np.int32)
        columns = {k: getattr(self, k)[rows] for k in ("group", "y", "E", "D", "sigma2", "patterns", "gain_column")}
        sensor = None if self.sensor_columns is None else self.sensor_columns[np.flatnonzero(rows)]
        order = np.argsort(vertex, kind="stable").astype(np.int32)
        return replace(self, vertex=vertex, order=order, start=start, sensor_columns=sensor, **columns)

    def sample(self, solution: Solution, size: int) -> tuple[OverlapSystem, Solution, NDArray[np.intp]]:
        """Some `size` of the vertices evenly, and those under contact thermometers, with their solution; and which rows
        these are, (N',)."""
        chosen = self._even(size)
        rows = np.flatnonzero(chosen[self.vertex])
        return self._of(chosen), replace(solution, x=solution.x[chosen], weight=solution.weight[rows]), rows

    def _even(self, size: int) -> Bool:
        """(V,) mask of some `size` vertices, and those under contact thermometers."""
        chosen = np.arange(self.n_vertices) % max(1, -(-self.n_vertices // size)) == 0
        for contact in self.contacts:
            chosen[contact.vertices] = True
        return chosen

    def _of(self, chosen: Bool) -> OverlapSystem:
        """The system of chosen vertices (V,), numbered anew."""
        number = np.cumsum(chosen) - 1
        part = self.part(chosen[self.vertex])
        count = np.bincount(number[part.vertex], minlength=int(chosen.sum()))
        return replace(
            part,
            vertex=number[part.vertex].astype(np.int32),
            start=np.insert(np.cumsum(count), 0, 0).astype(np.int32),
            contacts=tuple(replace(c, vertices=number[c.vertices].astype(np.int32)) for c in self.contacts),
            correlated=max(1.0, self.correlated * float(chosen.mean())),
        )

    # ---------------------------------------------------------------- iteration

    def solve(self, start: Solution | None = None, steps: int = TUKEY_STEPS) -> Solution:
        """Iteratively reweighted least squares: Huber to a first estimate, weighted medians per vertex, then Tukey.
        Of many vertices some find the first estimate alone.

        start : of the same rows without the sensor's pattern; Tukey's weights go on from there, for some `steps`.
        """
        at = self.layout
        p = np.zeros(at.size)
        columns = np.column_stack([self.patterns, np.zeros(len(self.y)), self.gain_column])
        if start is None and self.n_vertices > 2 * COARSE_VERTICES:
            p, n = self._of(self._even(COARSE_VERTICES)).solve().p, HUBER_STEPS
            x = self._medians(p)
        elif start is None:
            x, n = np.bincount(self.vertex, self.y) / np.diff(self.start), 0
        else:
            p[: len(start.p)], x, n = start.p, start.x, HUBER_STEPS
        weight, scale = self._robust(p, x, huber=n < HUBER_STEPS)
        converged = False
        while not converged and n < HUBER_STEPS + steps:
            n += 1
            before = p
            p, x, covariance, normal, gain, variance = self._step(p, x, weight, columns, spread=self.sensor is None)
            change = np.abs(p - before)
            change[at.linear] /= self.slope_L
            change[at.sensor] /= self.slope_L
            limit = CONVERGED_K if self.sensor is None else SENSOR_CONVERGED_K
            converged = n > HUBER_STEPS + 1 and bool(change.max() < limit)
            if n == HUBER_STEPS:
                x = self._medians(p)
            if not converged:
                weight, scale = self._robust(p, x, huber=n < HUBER_STEPS)
        if self.sensor is not None:
            p, x, covariance, normal, gain, variance = self._step(p, x, weight, columns)
        return Solution(p, x, covariance * scale**2, normal, weight, scale, gain, variance, n, converged)

    def step(self, p: Float, x: Float, weight: Float) -> tuple[Float, Float]:
        """p (P,), x (V,) after one linear step with weights (N,) as they are."""
        columns = np.column_stack([self.patterns, np.zeros(len(self.y)), self.gain_column])
        return self._step(p, x, weight, columns, spread=False)[:2]

    def predict(self, p: Float, x: Float | float) -> Float:
        """The measurement equation for y, (N,) W m-2 sr-1, of parameters p (P,) and excesses x (V,), or one for all."""
        at = self.layout
        at_rows = x[self.vertex] if isinstance(x, np.ndarray) else x
        out = excess_reading(at_rows, self.E + p[at.shape] * self.D, p[self.group])
        if at.n_patterns:
            out += self.patterns @ p[at.field]
        if self.use_gain:
            out += p[at.gain] * self.gain_column
        if self.sensor_columns is not None:
            out += self.sensor_columns @ p[at.sensor]
        return out

    def _robust(self, p: Float, x: Float, *, huber: bool) -> tuple[Float, float]:
        """Weights 1/σ² times the robust factor, and the scale of standardised residuals."""
        r = np.abs(self.y - self.predict(p, x)) / np.sqrt(self.sigma2)
        freedom = max(len(r) - len(x), len(r) // 4, 1)
        scale = max(median(r) / MAD_PER_SIGMA * np.sqrt(len(r) / freedom), 1e-3)
        t = r / (scale * (HUBER if huber else TUKEY))
        factor = huber_weight(t) if huber else tukey_weight(t)
        return factor / self.sigma2, scale

    def _medians(self, p: Float) -> Float:
        """Weighted median of x per vertex, all else given."""
        E = self.E + p[self.layout.shape] * self.D
        value = (self.y - self.predict(p, 0.0)) / E
        by_value = np.argsort(value)
        order = by_value[Groups.by_vertex(self.vertex[by_value], self.n_vertices)[1]]
        w = np.cumsum((E / self.sigma2)[order])
        total = w[self.start[1:] - 1]
        begin = np.insert(total[:-1], 0, 0.0)
        half = np.searchsorted(w, 0.5 * (begin + total))
        return np.asarray(value[order][np.minimum(half, self.start[1:] - 1)])

    def _step(
        self, p: Float, x: Float, w: Float, G: Float, *, spread: bool = True
    ) -> tuple[Float, Float, Float, Float, Float, float]:
        """One Gauss-Newton step with x eliminated: p, x, covariance, normal matrix, dp/d(level), level variance.

        spread : covariance and dp/d(level) are wanted; without them a large system is solved six times faster.
        G : (N, K + 2) derivatives by field, shape and gain; the shape's column is filled here.
        """
        at = self.layout
        rows = Rows(self.group, self.y, self.E, self.D, G, self.order, self.start)
        bend = at.n_patterns if self.use_shape else -1
        a, c, B, N, rhs = overlap_sums(rows, w, x, float(p[at.shape]), bend, at.n_offsets)
        N[at.shared, at.shared] = _square(G, w)
        a[a <= 0] = np.inf
        if self.sensor_columns is not None:
            B, N, rhs = self._with_columns(p[at.shape], x, w, G, (B, N, rhs))

        level = self._level(a, c, B)
        N -= _square(B, 1 / a)
        rhs -= B.T @ (c / a)
        N /= self.correlated
        rhs /= self.correlated
        self._add_priors(N, rhs)
        p, covariance, level_gain = constrained_minimum(N, rhs, level.row, level.target, spread=spread)
        p[at.shape] = np.clip(p[at.shape], *SHAPE_BOUNDS)
        return p, (c - B @ p) / a, covariance, N, level_gain, level.variance

    def _with_columns(
        self, s: float, x: Float, w: Float, G: Float, sums: tuple[Float, Float, Float]
    ) -> tuple[Float, Float, Float]:
        """B, N and the right side with the sensor's columns; s : the shape."""
        assert self.sensor_columns is not None
        at, X, before = self.layout, self.sensor_columns, slice(0, self.layout.sensor.start)
        B, N, rhs = np.empty((self.n_vertices, at.size)), np.zeros((at.size, at.size)), np.empty(at.size)
        B[:, before], N[before, before], rhs[before] = sums
        y = self.y + s * G[:, at.n_patterns] if self.use_shape else self.y
        wE, wX = w * (self.E + s * self.D), X.multiply(w[:, None]).tocsr()
        by_vertex = csr_matrix((wE[self.order], self.order, self.start), shape=(self.n_vertices, len(w)))
        by_group = csr_matrix((w, self.group, np.arange(len(w) + 1)), shape=(len(w), at.n_offsets)).T
        B[:, at.sensor] = (by_vertex @ X).toarray()
        N[at.offsets, at.sensor] = (by_group @ X).toarray()
        N[at.shared, at.sensor] = (wX.T @ G).T
        N[at.sensor, before] = N[before, at.sensor].T
        N[at.sensor, at.sensor] = (X.T @ wX).toarray()
        rhs[at.sensor] = wX.T @ y
        return B, N, rhs

    def _add_priors(self, N: Float, rhs: Float) -> None:
        """Weak knowledge that only matters where the overlap has none, never about the common level."""
        at = self.layout
        M = at.n_offsets
        N[at.offsets, at.offsets] += (OFFSET_PRIOR_K * self.slope_L) ** -2 * (np.eye(M) - 1 / M)
        known = self.field_prior.precision[:, None] * self.keep
        N[at.field, at.field] += self.keep.T @ known
        rhs[at.field] += self.field_prior.mean @ known
        N[at.shape, at.shape] += SHAPE_PRIOR**-2
        N[at.gain, at.gain] += GAIN_PRIOR**-2
        if self.sensor is not None:
            N[at.sensor, at.sensor] += self.sensor.precision() / self.slope_L**2
        if self.readings:
            level = self._mean_reading()
            for reading, row, weight in self.reading_rows():
                tilt, target = row - level.row, reading.measured - reading.expected - level.target
                N += weight * np.outer(tilt, tilt)
                rhs += weight * target * tilt

    # ---------------------------------------------------------------- the level

    def reading_rows(self) -> list[tuple[ExpectedReading, Float, float]]:
        """Each reading with its derivative by the parameters and its weight."""
        at, out = self.layout, []
        for reading, group, place in zip(self.readings, self.reading_groups, self.places(), strict=True):
            row = np.zeros(at.size)
            row[group] = 1.0
            if np.isfinite(place.away):
                patterns = self.field.patterns(np.array([place.u_px]), np.array([place.v_px]))
                row[at.field] = (patterns @ self.keep)[0]
            row[at.gain] = reading.expected - self.pivot if self.use_gain else 0.0
            if self.sensor is not None:
                dv, du = np.mgrid[-READING_HALF_PX:READING_HALF_PX:5j, -READING_HALF_PX:READING_HALF_PX:5j]
                u, v = reading.u_px + du.ravel(), reading.v_px + dv.ravel()
                row[at.sensor] = self.sensor.columns(u, v, np.full(du.size, reading.view)).mean(axis=0)
            out.append((reading, row, 1 / (reading.sigma_measured**2 + (READING_FLOOR_K * self.slope_L) ** 2)))
        return out

    def places(self) -> tuple[KnownField, ...]:
        """Where the field is read for each reading."""
        return self.reading_places or tuple(KnownField(r.u_px, r.v_px) for r in self.readings)

    def _mean_reading(self) -> Level:
        rows = self.reading_rows()
        w = np.array([weight for _, _, weight in rows])
        variance = 1 / w.sum() + max(r.sigma_expected for r in self.readings) ** 2
        w /= w.sum()
        if self.keep.shape[1]:
            variance += (self.slope_L * sum(wi * p.sigma_K for wi, p in zip(w, self.places(), strict=True))) ** 2
        row = np.sum([wi * row for wi, (_, row, _) in zip(w, rows, strict=True)], axis=0)
        target = np.sum([wi * (r.measured - r.expected) for wi, r in zip(w, self.readings, strict=True)])
        return Level(row, float(target), float(variance))

    def _level(self, a: Float, c: Float, B: Float) -> Level:
        """Blackbodies set the level; else contact thermometers; else the offsets' mean is zero."""
        if self.readings:
            return self._mean_reading()
        if self.contacts:
            w = np.array([1 / max(k.sigma, 1e-9) ** 2 for k in self.contacts])
            rows = [np.mean(B[k.vertices] / a[k.vertices, None], axis=0) for k in self.contacts]
            targets = np.array([np.mean(c[k.vertices] / a[k.vertices]) - k.expected for k in self.contacts])
            share = w / w.sum()
            return Level(share @ np.array(rows), float(share @ targets), float(1 / w.sum()))
        M, P = self.layout.n_offsets, self.layout.size
        return Level(np.concatenate([np.full(M, 1 / M), np.zeros(P - M)]), 0.0, 0.0)


def _square(columns: Float, weight: Float) -> Float:
    """Σ weight · row rowᵀ, (P, P), over rows of columns (N, P), weight (N,) ≥ 0; block by block, in the cache."""
    total, root = np.zeros((columns.shape[1], columns.shape[1])), np.sqrt(weight)
    for begin in range(0, len(columns), SQUARE_ROWS):
        part = columns[begin : begin + SQUARE_ROWS] * root[begin : begin + SQUARE_ROWS, None]
        total += part.T @ part  # a product with its own transpose costs half
    return total


def constrained_minimum(
    N: Float, rhs: Float, row: Float, target: float, *, spread: bool = True
) -> tuple[Float, Float, Float]:
    """min ½pᵀNp - rhsᵀp under row·p = target: (p, covariance within the constraint's plane, dp/dtarget).

    spread : False leaves the last two empty.

    Parameters differ by orders of magnitude: the system is scaled to a unit diagonal first.
    """
    d = 1 / np.sqrt(np.maximum(np.diag(N), 1e-30))
    P, r = len(d), row * d
    norm = np.linalg.norm(r)
    kkt = np.zeros((P + 1, P + 1))
    kkt[:P, :P] = N * np.outer(d, d)
    kkt[:P, P] = kkt[P, :P] = r / norm
    if not spread:
        right = np.append(rhs * d, target / norm)
        return d * solve(kkt, right, assume_a="sym", check_finite=False)[:P], np.zeros((0, 0)), np.zeros(0)
    inverse = np.linalg.inv(kkt)
    p = d * (inverse[:P, :P] @ (rhs * d) + inverse[:P, P] * (target / norm))
    return p, inverse[:P, :P] * np.outer(d, d), d * inverse[:P, P] / norm


def condition_number(N: Float) -> float:
    """Condition of a normal matrix of offsets on what overlap can see: the common level left out."""
    if len(N) < 2:
        return 1.0
    centred = np.eye(len(N)) - 1 / len(N)
    values = np.linalg.eigvalsh(centred @ N @ centred)[1:]
    return float(values[-1] / max(values[0], 1e-300))
