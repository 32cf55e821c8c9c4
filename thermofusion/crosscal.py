"""Overlapping views calibrate each other: one offset per view, one field over the image, one shape of ε(θ).

What one view saw obliquely another saw straight on. With x_v the normal-equivalent radiance of vertex v above what it
reflects, an observation of it by view i at pixel (u, v) is

    L = L_r + (E(θ) + s·D(θ))·x_v + b_i + φ(u, v) + γ·(L - L_pivot) + noise,      E = ε(θ)/ε(0),

so that ε(0) plays no part. All x_v are eliminated, which leaves a small system: views + field + shape, whatever the
size of the mesh. The common level is no matter of overlap: it is imposed as a hard constraint (a blackbody, a contact
thermometer, else Σ b = 0 and the result is relative). See docs/radiometry.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from .emissivity import AngleTable, EmissivityModel, reshaped, shape_direction
from .errors import ScanError
from .imagefield import ImageField
from .radiometry import Band
from .recipe import CrosscalSection
from .references import BlackbodyReading, ContactReading
from .types import Bool, Float, Float32, Int, Observations
from .uncertainty import AngleTables, ErrorModel, covariance_modes, observation_variance, skin_slope

TUKEY = 4.685  # 95 % efficient for normal errors
HUBER = 1.345
OFFSET_PRIOR_K = 5.0  # spread of offsets about their mean: only matters for views that overlap with none
FIELD_PRIOR_K = 0.5  # one sigma of a field pattern (unit rms)
FIELD_HELD_K = 0.15  # a pattern less certain than this is held at zero
SHAPE_PRIOR = 2.0
SHAPE_HELD = 0.5  # a shape less certain than half the way between the skin presets is held
SHAPE_BOUNDS = (-2.0, 5.0)
GAIN_PRIOR = 0.1
GAIN_SPAN_K = 3.0  # references must differ by this much to carry a gain
READING_FLOOR_K = 0.01  # what a field of low order leaves at the reference's place
HUBER_STEPS, TUKEY_STEPS = 4, 30
CONVERGED_K = 2e-5
MIN_SHARED = 20  # vertices that two views must share to count as overlapping


@dataclass(frozen=True, eq=False)
class CrosscalResult:
    """What the overlap of views settled. Radiances in W m-2 sr-1; `slope_L` (dL/dT) turns them into K.

    offset_radiance : (N_views,) b. field : φ(u, v). shape, shape_sigma : s of `Reshaped`. gain : 1 + γ about
    `pivot_radiance`. covariance : (P, P) of [offsets, field coefficients, s, γ], held ones zero. anchored : a reference
    set the level; else level_sigma_K is NaN and the result is relative. condition : of the reduced system on what
    overlap can see. held : parameters asked for that the data cannot carry. view_rms_K : (N_views,) weighted residual.
    outlier_fraction : share of observations with no weight left. messages : what a user should know.
    """

    offset_radiance: Float
    field: ImageField
    shape: float
    shape_sigma: float
    gain: float
    pivot_radiance: float
    covariance: Float
    slope_L: float
    anchored: bool
    reference_sigma_K: float
    level_sigma_K: float
    residual_sigma: float
    view_rms_K: Float
    outlier_fraction: float
    condition: float
    held: tuple[str, ...]
    iterations: int
    converged: bool
    messages: tuple[str, ...]

    @property
    def offsets_K(self) -> Float:
        """(N_views,) offsets as temperatures at skin level."""
        return self.offset_radiance / self.slope_L

    def corrected(self, observations: Observations) -> Float32:
        """Radiance of observations with the camera's offset, field and gain removed, (N,) float32."""
        camera = self.offset_radiance.astype(np.float32)[observations.view]
        if np.any(self.field.coefficients):
            camera += self.field(observations.u_px, observations.v_px).astype(np.float32)
        out = observations.radiance - camera
        if self.gain != 1.0:
            out = (out + np.float32((self.gain - 1) * self.pivot_radiance)) / np.float32(self.gain)
        return np.asarray(out, np.float32)

    def error_modes(self, count: int) -> Callable[[Observations, NDArray], Float32]:
        """How the strongest error modes of this calibration shift observations: (rows, x of rows) -> (N, count)."""
        modes = covariance_modes(self.covariance, count).astype(np.float32)
        M = len(self.offset_radiance)
        direction = AngleTable.of(shape_direction(AngleTable.knots()))
        cells = 32  # the field is smooth: a coarse raster of it does for an error
        v, u = np.mgrid[0:cells, 0:cells]
        du, dv = self.field.width_px / cells, self.field.height_px / cells
        raster = (self.field.patterns((u.ravel() + 0.5) * du, (v.ravel() + 0.5) * dv) @ modes[M:-2]).astype(np.float32)

        def effect(rows: Observations, x: NDArray) -> Float32:
            cell = (rows.v_px / dv).astype(np.int32) * cells + (rows.u_px / du).astype(np.int32)
            out = modes[rows.view] + raster[np.clip(cell, 0, cells * cells - 1)]
            bent = (x * direction(rows.cos_angle)).astype(np.float32)
            return np.asarray(out + bent[:, None] * modes[-2], np.float32)

        return effect

    def emissivity(self, model: EmissivityModel) -> EmissivityModel:
        """The model with the fitted shape (and its ε(0), see `emissivity.reshaped`)."""
        return reshaped(model, self.shape)


def cross_calibrate(
    observations: Observations,
    n_vertices: int,
    n_views: int,
    emissivity: EmissivityModel,
    band: Band,
    *,
    image_size: tuple[int, int],
    L_reflected: float | NDArray,
    errors: ErrorModel | None = None,
    settings: CrosscalSection | None = None,
    max_angle_deg: float = 65.0,
    blackbodies: Sequence[BlackbodyReading] = (),
    contacts: Sequence[ContactReading] = (),
) -> CrosscalResult:
    """Solve for offsets, field, shape and gain from all vertices that two or more views saw.

    Parameters
    ----------
    observations : sorted by (view, vertex); radiance freed of the air path. image_size : (width, height) px.
    L_reflected : radiance that vertices reflect, scalar or (V,). errors : one-sigma parts that weight observations.
    blackbodies : readings; they set the level together. contacts : used for the level where no blackbody is.

    Raises ScanError if no vertex was seen by two views.
    """
    errors, settings = errors or ErrorModel(), settings or CrosscalSection()
    chosen = _choose(observations, n_vertices, settings.max_vertices, max_angle_deg, contacts)
    problem = _Problem.build(
        chosen, n_views, emissivity, band, image_size, L_reflected, errors, settings, blackbodies, contacts
    )
    solution = problem.solve()
    reduced = problem.without_uncarried(solution)
    if reduced is not problem:
        problem, solution = reduced, reduced.solve(solution)
    return problem.result(solution)


def _choose(
    observations: Observations,
    n_vertices: int,
    max_vertices: int,
    max_angle_deg: float,
    contacts: Sequence[ContactReading],
) -> Observations:
    """Observations under the angle limit of an even sample of the vertices that two or more views saw."""
    if not len(observations):
        raise ScanError("no thermal view sees the surface")
    steep = observations.cos_angle >= np.float32(np.cos(np.radians(max_angle_deg)))
    steep &= np.isfinite(observations.radiance)
    count = np.bincount(observations.vertex[steep], minlength=n_vertices)
    shared = np.flatnonzero(count >= 2)
    if not len(shared):
        raise ScanError("no spot of the surface was seen by two thermal views", hint="set crosscal.offsets = false")
    wanted = np.zeros(n_vertices, bool)
    wanted[shared[:: -(-len(shared) // max_vertices)]] = True
    for contact in contacts:
        wanted[contact.vertices] = True
    return observations.select(steep & wanted[observations.vertex])


# ---------------------------------------------------------------- the system


@dataclass(frozen=True, eq=False)
class _Solution:
    p: Float  # offsets, field (reduced), s, γ
    x: Float  # per vertex
    covariance: Float
    normal: Float  # reduced normal matrix with priors
    weight: Float  # of observations, robust part included
    scale: float  # of standardised residuals
    level_gain: Float  # dp / d(level constraint)
    level_variance: float  # of that constraint
    iterations: int
    converged: bool


@dataclass(frozen=True, eq=False)
class _Problem:
    """Columns of the least squares problem, rows = observations. Vertices are numbered 0..V-1 in this module only."""

    vertex: Int
    view: Int
    y: Float  # L - L_r
    E: Float
    D: Float
    sigma2: Float
    patterns: Float  # (N, K)
    radiance: Float
    by_vertex: csr_matrix  # (V, N) sums
    by_view: csr_matrix  # (M, N) sums
    n_views: int
    field: ImageField
    keep: Float  # (K_all, K) combinations of patterns that are solved for
    use_offsets: bool
    use_shape: bool
    use_gain: bool
    slope_L: float
    pivot: float
    readings: tuple[BlackbodyReading, ...]
    contact_rows: tuple[tuple[Int, float, float], ...]  # vertices, x expected, sigma
    held: tuple[str, ...] = ()

    @classmethod
    def build(
        cls,
        obs: Observations,
        n_views: int,
        emissivity: EmissivityModel,
        band: Band,
        image_size: tuple[int, int],
        L_reflected: float | NDArray,
        errors: ErrorModel,
        settings: CrosscalSection,
        blackbodies: Sequence[BlackbodyReading],
        contacts: Sequence[ContactReading],
    ) -> _Problem:
        numbers, vertex = np.unique(obs.vertex, return_inverse=True)
        L_r_vertex = (
            np.broadcast_to(np.asarray(L_reflected, np.float64), (int(numbers[-1]) + 1,))[numbers]
            if np.ndim(L_reflected) == 0
            else np.asarray(L_reflected, np.float64)[numbers]
        )
        L = obs.radiance.astype(np.float64)
        n, rows = len(obs), np.arange(len(obs))
        by_vertex = csr_matrix((np.ones(n), (vertex, rows)), shape=(len(numbers), n))
        by_view = csr_matrix((np.ones(n), (obs.view, rows)), shape=(n_views, n))
        y = L - L_r_vertex[vertex]
        slope_L = skin_slope(band, obs.radiance)
        excess = (by_vertex @ y) / np.maximum(by_vertex @ np.ones(n), 1)
        sigma2 = observation_variance(obs, excess[vertex], AngleTables.of(emissivity), errors, slope_L)
        cos = obs.cos_angle.astype(np.float64)
        field = ImageField.zero(*image_size)
        K = len(field.coefficients) if settings.vignetting else 0
        span = np.ptp([r.expected for r in blackbodies]) / slope_L if blackbodies else 0.0
        pivot = float(np.mean([r.expected for r in blackbodies])) if blackbodies else 0.0
        index = {int(v): i for i, v in enumerate(numbers)}
        eps0 = emissivity.normal
        contact_rows = []
        for c in contacts:
            local = np.array([index[int(v)] for v in c.vertices if int(v) in index], np.int32)
            if len(local):
                expected = eps0 * (c.expected - float(L_r_vertex[local].mean()))
                contact_rows.append((local, expected, eps0 * c.sigma_expected))
        return cls(
            vertex=vertex.astype(np.int32),
            view=obs.view,
            y=y,
            E=np.asarray(emissivity.relative(cos)),
            D=shape_direction(cos),
            sigma2=sigma2.astype(np.float64),
            patterns=field.patterns(obs.u_px, obs.v_px) if K else np.zeros((n, 0)),
            radiance=L,
            by_vertex=by_vertex,
            by_view=by_view,
            n_views=n_views,
            field=field,
            keep=np.eye(len(field.coefficients))[:, :K],
            use_offsets=settings.offsets,
            use_shape=settings.shape,
            use_gain=settings.gain and span >= GAIN_SPAN_K,
            slope_L=slope_L,
            pivot=pivot,
            readings=tuple(blackbodies),
            contact_rows=tuple(contact_rows),
            held=("gain",) if settings.gain and span < GAIN_SPAN_K else (),
        )

    @property
    def _size(self) -> tuple[int, int, int]:
        """Numbers of views, of field patterns, of all parameters."""
        return self.n_views, self.keep.shape[1], self.n_views + self.keep.shape[1] + 2

    @property
    def anchored(self) -> bool:
        return bool(self.readings or self.contact_rows)

    # ---- iteration

    def solve(self, start: _Solution | None = None) -> _Solution:
        """Iteratively reweighted: Huber to a first estimate, weighted medians per vertex, then Tukey to the end."""
        M, K, P = self._size
        p = np.zeros(P)
        x = self._medians(p, 1 / self.sigma2)
        weight = self._robust(p, x, huber=True)[0]
        scale, converged, n, out = 1.0, False, 0, None
        for n in range(1, HUBER_STEPS + TUKEY_STEPS + 1):
            before = p.copy()
            p, x, out = self._step(p, x, weight)
            change = np.abs(p - before)
            change[: M + K] /= self.slope_L
            converged = n > HUBER_STEPS + 1 and bool(change.max(initial=0) < CONVERGED_K)
            if converged:
                break
            if n == HUBER_STEPS:
                x = self._medians(p, 1 / self.sigma2)
            weight, scale = self._robust(p, x, huber=n < HUBER_STEPS)
        assert out is not None
        covariance, normal, level_gain, level_variance = out
        return _Solution(p, x, covariance * scale**2, normal, weight, scale, level_gain, level_variance, n, converged)

    def _predict(self, p: Float, x: Float) -> Float:
        """Model of y at all observations."""
        M, K, _ = self._size
        out = (self.E + p[M + K] * self.D) * x[self.vertex] + p[self.view]
        if K:
            out += self.patterns @ p[M : M + K]
        if self.use_gain:
            out += p[-1] * (self.radiance - self.pivot)
        return out

    def _robust(self, p: Float, x: Float, *, huber: bool) -> tuple[Float, float]:
        """Weights 1/σ² times the robust factor, and the scale of standardised residuals (1 = as predicted)."""
        r = np.abs(self.y - self._predict(p, x)) / np.sqrt(self.sigma2)
        freedom = max(len(r) - len(x), len(r) // 4, 1)
        scale = max(float(np.median(r)) / 0.6745 * np.sqrt(len(r) / freedom), 0.1)
        t = r / (scale * (HUBER if huber else TUKEY))
        factor = 1 / np.maximum(t, 1) if huber else np.clip(1 - t * t, 0, None) ** 2
        return factor / self.sigma2, scale

    def _medians(self, p: Float, weight: Float) -> Float:
        """Weighted median per vertex of x, given all else."""
        M, K, _ = self._size
        E = self.E + p[M + K] * self.D
        value = (self.y - self._predict(p, np.zeros(self.by_vertex.shape[0]))) / E
        order = np.lexsort((value, self.vertex))
        w = np.cumsum((weight * E)[order])
        ends = np.flatnonzero(np.append(np.diff(self.vertex[order]) > 0, True))
        total = w[ends]
        begin = np.insert(total[:-1], 0, 0.0)
        half = np.searchsorted(w, 0.5 * (begin + total))
        return np.asarray(value[order][np.minimum(half, ends)])

    def _step(self, p: Float, x: Float, w: Float) -> tuple[Float, Float, tuple[Float, Float, Float, float]]:
        """One Gauss-Newton step with x eliminated: (p, x, (covariance, normal matrix, level gain and variance))."""
        M, K, P = self._size
        s = p[M + K]
        E = self.E + s * self.D
        G = np.empty((len(w), K + 2))
        G[:, :K] = self.patterns
        G[:, K] = self.D * x[self.vertex] if self.use_shape else 0.0
        G[:, K + 1] = self.radiance - self.pivot if self.use_gain else 0.0
        # s enters as s_old + δ: the target carries what the linearisation at s_old took away
        y = self.y + s * G[:, K]

        wE = w * E
        a = self.by_vertex @ (wE * E)
        a = np.where(a > 0, a, np.inf)
        c = self.by_vertex @ (wE * y)
        B = np.zeros((len(a), P))
        if self.use_offsets:
            B[self.vertex, self.view] = wE
        B[:, M:] = self.by_vertex @ (wE[:, None] * G)
        wG = w[:, None] * G
        N = np.zeros((P, P))
        N[np.arange(M), np.arange(M)] = self.by_view @ w if self.use_offsets else 0.0
        N[:M, M:] = self.by_view @ wG if self.use_offsets else 0.0
        N[M:, :M] = N[:M, M:].T
        N[M:, M:] = G.T @ wG
        rhs = np.concatenate([self.by_view @ (w * y) if self.use_offsets else np.zeros(M), wG.T @ y])
        root = B / np.sqrt(a)[:, None]
        N -= root.T @ root
        rhs -= B.T @ (c / a)
        self._add_priors(N, rhs)
        row, target, row_variance = self._level(a, c, B, N, rhs)
        p_new, covariance, level_gain = _constrained(N, rhs, row, target)
        p_new[M + K] = np.clip(p_new[M + K], *SHAPE_BOUNDS)
        x_new = (c - B @ p_new) / a
        return p_new, x_new, (covariance, N, level_gain, row_variance)

    def _add_priors(self, N: Float, rhs: Float) -> None:
        """Weak knowledge that only matters where the overlap has none; never on the common level."""
        M, K, P = self._size
        spread = (OFFSET_PRIOR_K * self.slope_L) ** -2 if self.use_offsets else 1.0
        N[:M, :M] += spread * (np.eye(M) - 1 / M if self.use_offsets else np.eye(M))
        N[M : M + K, M : M + K] += np.eye(K) * (FIELD_PRIOR_K * self.slope_L) ** -2
        N[P - 2, P - 2] += SHAPE_PRIOR**-2
        N[P - 1, P - 1] += GAIN_PRIOR**-2
        for r in self.readings:
            row = self._reading_row(r) - self._mean_reading()[0]
            target = r.measured - r.expected - self._mean_reading()[1]
            w = 1 / (r.sigma_measured**2 + (READING_FLOOR_K * self.slope_L) ** 2)
            N += w * np.outer(row, row)
            rhs += w * target * row

    def _reading_row(self, r: BlackbodyReading) -> Float:
        """Derivative of a reading by the parameters."""
        M, K, P = self._size
        row = np.zeros(P)
        row[r.view] = 1.0 if self.use_offsets else 0.0
        u, v = np.array([r.u_px]), np.array([r.v_px])
        row[M : M + K] = (self.field.patterns(u, v) @ self.keep)[0]
        row[-1] = r.expected - self.pivot if self.use_gain else 0.0
        return row

    def _mean_reading(self) -> tuple[Float, float, float]:
        """Mean row, mean target and variance of the readings: what is imposed on the level."""
        floor = (READING_FLOOR_K * self.slope_L) ** 2
        w = np.array([1 / (r.sigma_measured**2 + floor) for r in self.readings])
        variance = 1 / w.sum() + max(r.sigma_expected for r in self.readings) ** 2
        w /= w.sum()
        row = np.sum([wi * self._reading_row(r) for wi, r in zip(w, self.readings, strict=True)], axis=0)
        target = float(np.sum([wi * (r.measured - r.expected) for wi, r in zip(w, self.readings, strict=True)]))
        return row, target, float(variance)

    def _level(self, a: Float, c: Float, B: Float, N: Float, rhs: Float) -> tuple[Float, float, float]:
        """The hard constraint row·p = target on the common level, and its variance."""
        M, _, P = self._size
        if self.readings:
            return self._mean_reading()
        if self.contact_rows:
            w = np.array([1 / max(sigma, 1e-9) ** 2 for _, _, sigma in self.contact_rows])
            rows = [np.mean(B[v] / a[v, None], axis=0) for v, _, _ in self.contact_rows]
            targets = [float(np.mean(c[v] / a[v])) - expected for v, expected, _ in self.contact_rows]
            variance = 1 / w.sum()
            w = w / w.sum()
            return np.sum(w[:, None] * rows, axis=0), float(w @ targets), float(variance)
        row = np.zeros(P)
        row[:M] = 1.0 / M
        return row, 0.0, 0.0

    # ---- what the data carry

    def without_uncarried(self, solution: _Solution) -> _Problem:
        """The problem without the parameters whose uncertainty says that the overlap does not carry them."""
        M, K, _ = self._size
        held, keep, use_shape = list(self.held), self.keep, self.use_shape
        if K:
            values, vectors = np.linalg.eigh(solution.covariance[M : M + K, M : M + K])
            carried = np.sqrt(np.maximum(values, 0)) < FIELD_HELD_K * self.slope_L
            if not carried.all():
                keep = self.keep @ vectors[:, carried]
                held.append(f"{int((~carried).sum())} of {K} field patterns")
        if use_shape and np.sqrt(solution.covariance[M + K, M + K]) > SHAPE_HELD:
            use_shape = False
            held.append("shape")
        if keep is self.keep and use_shape == self.use_shape:
            return self
        patterns = self.patterns @ (self.keep.T @ keep)
        return replace(self, keep=keep, patterns=patterns, use_shape=use_shape, held=tuple(held))

    def result(self, solution: _Solution) -> CrosscalResult:
        """The solution in the terms of the outside."""
        M, K, _ = self._size
        expand = np.zeros((M + len(self.keep) + 2, M + K + 2))
        expand[:M, :M] = np.eye(M)
        expand[M:-2, M : M + K] = self.keep
        expand[-2:, -2:] = np.eye(2)
        p, covariance = expand @ solution.p, expand @ solution.covariance @ expand.T
        for position, used in ((-2, self.use_shape), (-1, self.use_gain)):
            if not used:
                covariance[position, :] = covariance[:, position] = p[position] = 0.0
        if not self.use_offsets:
            covariance[:M, :] = covariance[:, :M] = 0.0
        alive = solution.weight > 0
        residual = (self.y - self._predict(solution.p, solution.x)) / self.slope_L
        robust = solution.weight * self.sigma2
        view_sum = self.by_view @ robust
        with np.errstate(invalid="ignore", divide="ignore"):
            view_rms = np.sqrt((self.by_view @ (robust * residual**2)) / np.where(view_sum > 0, view_sum, np.nan))
        return CrosscalResult(
            offset_radiance=p[:M],
            field=replace(self.field, coefficients=p[M:-2]),
            shape=float(p[-2]),
            shape_sigma=float(np.sqrt(covariance[-2, -2])),
            gain=1 + float(p[-1]),
            pivot_radiance=self.pivot,
            covariance=covariance,
            slope_L=self.slope_L,
            anchored=self.anchored,
            reference_sigma_K=np.sqrt(solution.level_variance) / self.slope_L if self.anchored else float("nan"),
            level_sigma_K=self._level_sigma_K(solution),
            residual_sigma=solution.scale,
            view_rms_K=view_rms,
            outlier_fraction=float(1 - alive.mean()),
            condition=_condition(solution.normal[:M, :M]),
            held=self.held,
            iterations=solution.iterations,
            converged=solution.converged,
            messages=self._messages(solution),
        )

    def _level_sigma_K(self, solution: _Solution) -> float:
        """One sigma of the common level of all vertices, K."""
        if not self.anchored:
            return float("nan")
        M, K, P = self._size
        g = np.zeros(P)
        g[:M] = (self.by_view @ solution.weight) / solution.weight.sum()
        g[M : M + K] = (solution.weight @ self.patterns) / solution.weight.sum()
        variance = g @ solution.covariance @ g + solution.level_variance
        return float(np.sqrt(variance) / self.slope_L)

    def _messages(self, solution: _Solution) -> tuple[str, ...]:
        out = []
        if not solution.converged:
            out.append("the cross-calibration stopped before it converged")
        if not self.anchored:
            out.append("no reference sets the level: temperatures are relative")
        if self.held:
            out.append(f"held, because the overlap does not carry it: {', '.join(self.held)}")
        groups = self._groups(solution.weight > 0)
        if groups > 1:
            out.append(f"the views fall into {groups} groups that share no surface: their levels are not tied")
        s = solution.p[self._size[0] + self._size[1]]
        if self.use_shape and (s <= SHAPE_BOUNDS[0] or s >= SHAPE_BOUNDS[1]):
            out.append("the shape of ε(θ) ran to its bound: check normals, angle limit and reflected temperature")
        return tuple(out)

    def _groups(self, alive: Bool) -> int:
        """Number of groups of views connected by at least `MIN_SHARED` common vertices."""
        seen = csr_matrix(
            (np.ones(int(alive.sum())), (self.view[alive], self.vertex[alive])),
            shape=(self.n_views, self.by_vertex.shape[0]),
        )
        shared = (seen @ seen.T).toarray()
        present = np.diag(shared) > 0
        if not present.any():
            return 0
        return int(connected_components(shared[np.ix_(present, present)] >= min(MIN_SHARED, shared.max()))[0])


def _constrained(N: Float, rhs: Float, row: Float, target: float) -> tuple[Float, Float, Float]:
    """min ½pᵀNp - rhsᵀp under row·p = target: (p, covariance on the constraint's plane, dp/dtarget).

    A symmetric scaling first: parameters differ by orders of magnitude.
    """
    d = 1 / np.sqrt(np.maximum(np.diag(N), 1e-30))
    P = len(d)
    r = row * d
    norm = np.linalg.norm(r)
    kkt = np.zeros((P + 1, P + 1))
    kkt[:P, :P] = N * np.outer(d, d)
    kkt[:P, P] = kkt[P, :P] = r / norm
    inverse = np.linalg.inv(kkt)
    p = d * (inverse[:P, :P] @ (rhs * d) + inverse[:P, P] * (target / norm))
    return p, inverse[:P, :P] * np.outer(d, d), d * inverse[:P, P] / norm


def _condition(N: Float) -> float:
    """Condition of the offsets' system on what overlap can see: the common level left out."""
    if len(N) < 2:
        return 1.0
    mean = np.full((len(N), len(N)), 1 / len(N))
    centred = np.eye(len(N)) - mean
    values = np.linalg.eigvalsh(centred @ N @ centred)[1:]
    return float(values[-1] / max(values[0], 1e-300))
