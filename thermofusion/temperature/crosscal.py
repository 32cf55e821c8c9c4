"""Overlapping views calibrate each other: one offset per view, one field over the image, one shape of ε(θ).

What one view saw obliquely another saw straight on. With x_v the normal-equivalent radiance of vertex v above what it
reflects, an observation of it by view i at pixel (u, v) is

    L' = L + γ·(L - L_pivot) + b_i + φ(u, v) + noise,      L = L_r + (E(θ) + s·D(θ))·x_v,      E = ε(θ)/ε(0),

so that ε(0) plays no part. All x_v are eliminated, which leaves a small system (`overlap`). The common level is no
matter of overlap: it is imposed as a hard constraint (blackbodies, a contact thermometer, else Σ b = 0 and the result
is relative). See docs/radiometry.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtri, stdtrit

from ..errors import ScanError
from ..geometry.patches import along_curve
from ..physics.emissivity import AngleTable, EmissivityModel, reshaped, shape_direction
from ..physics.equation import without_gain
from ..robust import MAD_PER_SIGMA, NORMAL_95, evenly, median
from ..types import Bool, Float, Float32, Observations, brief
from .gain import GAIN_SPAN_K, gain_of_readings
from .hidden import with_hidden
from .layout import Layout
from .mean import Groups
from .problem import ThermalProblem
from .references import ContactReading, ExpectedReading
from .sensor.earlier import CHANGED_AT_ALL, EarlierField, FieldPrior
from .sensor.field import ImageField
from .sensor.pattern import Pattern
from .sensor.refine import Refinement, refine, solved_with
from .system import SHAPE_BOUNDS, ContactRow, KnownField, OverlapSystem, Solution, condition_number
from .uncertainty import DEFAULT_SIGMA_NORMAL_DEG, AngleTables, covariance_modes, observation_variance, skin_slope

FIELD_HELD = 0.7  # of the prior's sigma: a pattern of the field less certain than this is held at zero
SHAPE_HELD = 0.5  # a shape less certain than half the way between the skin presets is held
ROWS_PER_VERTEX = 20  # bound on the system: max_vertices x this many observations
SUPPORT_CELLS = 24  # across the image; the field is known in those that hold so many rows of so many views
SUPPORT_ROWS, SUPPORT_VIEWS = 25, 3
CURVE_M = 1e-5  # cubes of the curve along which vertices are drawn: no two vertices share one
MIN_SHARED = 20  # vertices that two views must share to count as overlapping
SENSOR_MODES = 100  # of the covariance, where a sensor's pattern is in it: its errors are many and small
READINGS_ALIKE = 0.01  # chance below which references' scatter is no chance
NORMALS_VIEWS, NORMALS_ROWS = 5, 5000  # that the normals' sigma is estimated from
NORMALS_HIDDEN = 1.6  # part of a normal's error is the same for all views of a vertex: 1.2° shows as 0.7-0.8°
NORMALS_BOUNDS_DEG = (0.5, 5.0)
ERROR_RASTER = 32  # cells along each side on which the field's error is evaluated


@dataclass(frozen=True, eq=False)
class Calibration:
    """What the overlap of views settled. Radiances in W m-2 sr-1; `slope_L` (dL/dT) turns them into K.

    offset_radiance : (N_views,) b. field : φ(u, v). shape, shape_sigma : s of `emissivity.reshaped`. gain : 1 + γ about
    `pivot_radiance`. covariance : (P, P) of [offsets, field coefficients, s, γ] at a given level, held ones zero.
    anchored : a reference set the level, with the uncertainty reference_sigma_K; level_sigma_K adds how the views hang
    on it. Both are NaN for a relative result. residual_sigma : robust scale of residuals over their predicted σ.
    view_rms_K : (N_views,) weighted residual. outlier_fraction : share of observations left without weight.
    condition : of the offsets on what overlap can see. held : parameters asked for that the data cannot carry.
    sensor : what the sensor adds beyond the field. sigma_normal_deg : as residuals show it. pattern_sigma_K : of what
    residuals still have in common by place in the image. criticism : what residuals said. field_change : of the field
    since the earlier scan, over what fields are; NaN without one. messages : what a user should know.
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
    sensor: Pattern | None = None
    sigma_normal_deg: float = DEFAULT_SIGMA_NORMAL_DEG
    pattern_sigma_K: float = 0.0
    criticism: dict[str, Any] = dataclasses.field(default_factory=dict)
    field_change: float = float("nan")

    __repr__ = brief

    @property
    def layout(self) -> Layout:
        """Where the parameters stand in `covariance`."""
        n_sensor = 0 if self.sensor is None else len(self.sensor.coefficients)
        return Layout(len(self.offset_radiance), len(self.field.coefficients), n_sensor)

    @property
    def offsets_K(self) -> Float:
        """(N_views,) offsets as temperatures at skin level."""
        return self.offset_radiance / self.slope_L

    def emissivity(self, model: EmissivityModel) -> EmissivityModel:
        """The model with the fitted shape (and its ε(0), see `emissivity.reshaped`)."""
        return reshaped(model, self.shape)

    def corrected(self, observations: Observations) -> Float:
        """Radiance of observations with the camera's offset, field and gain removed, (N,) float64."""
        L = observations.radiance.astype(np.float64)
        camera = self.offset_radiance[observations.view]
        if np.any(self.field.coefficients):
            camera = camera + self.field(observations.u_px, observations.v_px)
        if self.sensor is not None:
            camera = camera + self.sensor(observations.u_px, observations.v_px, observations.view)
        return without_gain(L, camera, self.gain, self.pivot_radiance)

    def error_modes(self, count: int) -> Callable[[Observations, NDArray], Float32]:
        """How the strongest error modes of this calibration shift observations: (rows, x of rows) -> (N, R)."""
        modes = covariance_modes(self.covariance, count if self.sensor is None else SENSOR_MODES)
        if self.sensor is not None:  # what the weaker modes hold is not lost: the others bear it
            modes *= np.sqrt(np.trace(self.covariance) / np.sum(modes**2))
        modes = modes.astype(np.float32)
        at, n = self.layout, ERROR_RASTER
        du, dv = self.field.width_px / n, self.field.height_px / n
        v, u = (np.mgrid[0:n, 0:n].reshape(2, -1) + 0.5) * np.array([[dv], [du]])
        raster = (self.field.patterns(u, v) @ modes[at.field]).astype(np.float32)
        direction = AngleTable.of(shape_direction(AngleTable.knots()))

        def effect(rows: Observations, x: NDArray) -> Float32:
            cell = (rows.v_px / np.float32(dv)).astype(np.int32) * n + (rows.u_px / np.float32(du)).astype(np.int32)
            out = modes[rows.view] + raster[np.clip(cell, 0, n * n - 1)]
            if self.sensor is not None:
                out += self.sensor.columns(rows.u_px, rows.v_px, rows.view).astype(np.float32) @ modes[at.sensor]
            return np.asarray(out + (x * direction(rows.cos_angle))[:, None].astype(np.float32) * modes[at.shape])

        return effect


def calibrate(problem: ThermalProblem) -> Calibration:
    """What the overlap says of offsets, field, shape and gain, and of the sensor's pattern where that is asked for.

    Raises ScanError if no vertex was seen by two views.
    """
    return Overlap.of(problem).refined()


@dataclass(frozen=True, eq=False)
class Overlap:
    """A problem's overlap, solved without a pattern of the sensor. held, field_change : as in `Calibration`."""

    problem: ThermalProblem
    system: OverlapSystem
    solution: Solution
    rows: Observations
    held: tuple[str, ...]
    field_change: float

    @classmethod
    def of(cls, problem: ThermalProblem) -> Overlap:
        """Solved; see `_settled`. Raises ScanError."""
        return cls(problem, *_settled(problem))

    def lit_again(self, problem: ThermalProblem) -> Overlap:
        """The same rows where other light meets the vertices, from the solution that is there."""
        L_r = problem.L_reflected[self.rows.vertex]
        change = L_r - self.problem.L_reflected[self.rows.vertex]
        system = replace(
            self.system,
            y=self.system.y - change,
            gain_column=self.system.gain_column + (change if self.system.use_gain else 0.0),
            readings=problem.blackbodies,
        )
        return replace(self, problem=problem, system=system, solution=system.solve(self.solution))

    def plain(self) -> Calibration:
        """Without a pattern of the sensor."""
        return _result(self, None)

    def like(self, sensor: Pattern | None) -> Calibration:
        """With the terms of another solution's pattern, whether or not this one would ask for them."""
        if sensor is None:
            return self.plain()
        system, solution, rows, pattern = solved_with(sensor, self.system, self.solution, self.rows)
        return replace(_result(replace(self, system=system, solution=solution, rows=rows), None), sensor=pattern)

    def refined(self) -> Calibration:
        """With the sensor's pattern, where residuals and left-out views ask for one."""
        found = refine(self.problem, self.system, self.solution, self.rows)
        return _result(replace(self, system=found.system, solution=found.solution, rows=found.rows), found)


def _settled(problem: ThermalProblem) -> tuple[OverlapSystem, Solution, Observations, tuple[str, ...], float]:
    """Solve for offsets, field, shape and gain from all vertices that two or more views saw, clear of outlines.

    Blackbodies set the level together, contact thermometers where no blackbody does. A million rows are not a million
    witnesses: neighbouring vertices share their error (one window of normals), else noise would be taken for a field
    wherever the image shows no skin. Raises ScanError if no vertex was seen by two views.
    """
    rows = problem.observations.select(problem.clear)
    chosen = _choose(rows, problem)
    system = _system(chosen, problem)
    seen = max(int((np.bincount(rows.vertex, minlength=len(problem)) >= 2).sum()), 1)
    system = replace(system, correlated=max(1.0, problem.vertices_per_patch * system.n_vertices / seen))
    solution, settings, change = system.solve(), problem.settings.crosscal, float("nan")
    earlier = EarlierField.of(settings.field, system.field, system.slope_L)
    if earlier is not None and settings.vignetting:
        system, change = _with_earlier(system, solution, earlier)
        solution = system.solve(solution)
    reduced, held = _without_uncarried(system, solution)
    if settings.gain and not system.use_gain:
        held = ("gain", *held)
    if reduced is not system:
        system, solution = reduced, reduced.solve()
    return system, solution, chosen, held, change


def _with_earlier(system: OverlapSystem, solution: Solution, earlier: EarlierField) -> tuple[OverlapSystem, float]:
    """The system that also knows what an earlier scan found of the field, as far as this scan's overlap bears it out;
    and by how much the field changed since. References then read the field at their own places."""
    at = system.layout
    change = earlier.change(solution.p[at.field], solution.covariance[at.field, at.field])
    system = replace(system, field_prior=earlier.prior(change))
    if change < CHANGED_AT_ALL:
        system = replace(system, reading_places=tuple(KnownField(r.u_px, r.v_px) for r in system.readings))
    return system, change


def _choose(observations: Observations, problem: ThermalProblem) -> Observations:
    """Observations under the angle limit of vertices that two or more views saw, drawn evenly over the surface; by
    vertex.

    Drawn by place, not by number: the same surface gives the same sample, in whatever order its vertices stand.
    """
    max_vertices = problem.settings.crosscal.max_vertices
    usable = observations.cos_angle >= np.float32(np.cos(np.radians(problem.mapping.max_angle_deg)))
    usable &= np.isfinite(observations.radiance)
    count = np.bincount(observations.vertex[usable], minlength=len(problem))
    shared = np.flatnonzero(count >= 2)
    if not len(shared):
        raise ScanError(
            "no spot of the surface was seen well by two thermal views",
            hint="cross-calibration needs overlap: choose another temperature.method",
        )
    size = min(len(shared), max_vertices, int(max_vertices * ROWS_PER_VERTEX / count[shared].mean()) + 1)
    wanted = np.zeros(len(problem), bool)
    wanted[shared[along_curve(problem.points_m[shared], CURVE_M)[evenly(len(shared), size)]]] = True
    for contact in problem.contacts:
        wanted[contact.vertices] = True
    rows = np.flatnonzero(usable & wanted[observations.vertex])
    return observations.select(rows[Groups.by_vertex(observations.vertex[rows], len(problem))[1]])


def _system(rows: Observations, problem: ThermalProblem) -> OverlapSystem:
    """The least squares system of chosen rows."""
    errors, settings, blackbodies = problem.errors, problem.settings.crosscal, problem.blackbodies
    L_r, image_size = problem.L_reflected, (problem.lens.width_px, problem.lens.height_px)
    count = np.bincount(rows.vertex)
    numbers = np.flatnonzero(count)
    vertex, count = (np.cumsum(count > 0) - 1)[rows.vertex], count[numbers]
    L, cos, tables = rows.radiance.astype(np.float64), rows.cos_angle, AngleTables.of(problem.emissivity)
    y = L - L_r[rows.vertex]
    # weights must not depend on the camera's common offset: what references say of it is taken off first
    contacts = _contact_rows(problem.contacts, numbers, L_r, problem.emissivity.normal)
    common = _common_offset(np.bincount(vertex, y) / count, blackbodies, contacts)
    slope_L = skin_slope(problem.band, L - common)
    excess = (np.bincount(vertex, y - common) / count)[vertex]
    field = ImageField.zero(*image_size)
    K = len(field.coefficients) if settings.vignetting else 0
    expected = np.array([r.expected for r in blackbodies])
    use_gain = settings.gain and len(expected) > 1 and float(np.ptp(expected)) >= GAIN_SPAN_K * slope_L
    pivot = float(expected.mean()) if len(expected) else 0.0
    return OverlapSystem(
        vertex=vertex.astype(np.int32),
        group=rows.view if settings.offsets else np.zeros(len(rows), np.int32),
        y=y,
        E=tables.relative(cos),
        D=AngleTable.of(shape_direction(AngleTable.knots()), np.float64)(cos),
        sigma2=observation_variance(rows, excess, tables, errors, slope_L).astype(np.float64),
        patterns=field.patterns(rows.u_px, rows.v_px)[:, :K],
        gain_column=L_r[rows.vertex] - pivot if use_gain else np.zeros(len(rows)),
        order=np.argsort(vertex, kind="stable").astype(np.int32),
        start=np.insert(np.cumsum(count), 0, 0).astype(np.int32),
        n_groups=problem.n_views if settings.offsets else 1,
        field=field,
        field_prior=FieldPrior.wide(field, slope_L),
        keep=np.eye(len(field.coefficients))[:, :K],
        use_shape=settings.shape,
        use_gain=use_gain,
        slope_L=slope_L,
        pivot=pivot,
        readings=blackbodies,
        reading_groups=tuple(r.view if settings.offsets else 0 for r in blackbodies),
        contacts=tuple(contacts),
        reading_places=_known_fields(rows, blackbodies, image_size) if blackbodies else (),
    )


def _known_fields(
    rows: Observations, readings: Sequence[ExpectedReading], image_size: tuple[int, int]
) -> tuple[KnownField, ...]:
    """For each reading the nearest place at which skin was seen, so that the field is known: its own, mostly."""
    width, height = image_size
    side = width / SUPPORT_CELLS
    across, down = SUPPORT_CELLS, int(np.ceil(height / side))
    cell = np.clip((rows.v_px / side).astype(np.int64), 0, down - 1) * across
    cell += np.clip((rows.u_px / side).astype(np.int64), 0, across - 1)
    n_views = int(rows.view.max(initial=0)) + 1
    seen = np.bincount(cell * n_views + rows.view, minlength=across * down * n_views).reshape(-1, n_views)
    good = (seen.sum(axis=1) >= SUPPORT_ROWS) & ((seen > 0).sum(axis=1) >= SUPPORT_VIEWS)
    v, u = np.divmod(np.flatnonzero(good), across)

    def nearest(reading: ExpectedReading) -> KnownField:
        if not len(u):
            return KnownField(reading.u_px, reading.v_px, np.inf)
        du = np.clip(reading.u_px, u * side, (u + 1) * side) - reading.u_px
        dv = np.clip(reading.v_px, v * side, (v + 1) * side) - reading.v_px
        distance = np.hypot(du, dv)
        k = int(np.argmin(distance))
        return KnownField(reading.u_px + float(du[k]), reading.v_px + float(dv[k]), float(distance[k]) / width)

    return tuple(nearest(r) for r in readings)


def _contact_rows(
    contacts: Sequence[ContactReading], numbers: NDArray, L_r: Float, epsilon0: float
) -> list[ContactRow]:
    """Contact readings in the system's numbering, as the normal-equivalent excess x = ε(0)(L_s - L_r)."""
    out = []
    for contact in contacts:
        known = contact.vertices[np.isin(contact.vertices, numbers)]
        if len(known):
            expected = epsilon0 * (contact.expected - float(L_r[known].mean()))
            local = np.searchsorted(numbers, known).astype(np.int32)
            out.append(ContactRow(local, expected, epsilon0 * contact.sigma_expected))
    return out


def _common_offset(y_mean: Float, blackbodies: Sequence[ExpectedReading], contacts: Sequence[ContactRow]) -> float:
    """A first guess of the offset common to all views; 0 without a reference."""
    if blackbodies:
        return float(np.mean([r.measured - r.expected for r in blackbodies]))
    if contacts:
        return float(np.mean([y_mean[c.vertices].mean() - c.expected for c in contacts]))
    return 0.0


# ---------------------------------------------------------------- what the data carry


def _without_uncarried(system: OverlapSystem, solution: Solution) -> tuple[OverlapSystem, tuple[str, ...]]:
    """The system without the parameters whose own uncertainty says that the overlap does not carry them."""
    at = system.layout
    K, held, keep, use_shape = at.n_patterns, [], system.keep, system.use_shape
    if K:
        # in units of what was known before: a combination of patterns that the data tell nothing of keeps a sigma of 1
        prior = np.sqrt(1 / FieldPrior.wide(system.field, system.slope_L).precision)
        values, vectors = np.linalg.eigh(solution.covariance[at.field, at.field] / np.outer(prior, prior))
        carried = np.sqrt(np.maximum(values, 0)) < FIELD_HELD
        if not carried.all():
            keep = keep @ (prior[:, None] / prior.max() * vectors[:, carried])
            held.append(f"{int((~carried).sum())} of {K} field patterns")
    if use_shape and np.sqrt(solution.covariance[at.shape, at.shape]) > SHAPE_HELD:
        use_shape = False
        held.append("shape")
    if not held:
        return system, ()
    return system.without(keep, use_shape=use_shape), tuple(held)


def _shape_bias(emissivity: EmissivityModel, sigma_normal_deg: float) -> float:
    """What noise of the normals can do to s: E averaged over it is E + ½E″σ², projected on D under 65°."""
    theta, h = np.radians(np.arange(1.0, 65.0)), 1e-3
    E = [emissivity.relative(np.cos(theta + d)) for d in (-h, 0.0, h)]
    bend = 0.5 * np.radians(sigma_normal_deg) ** 2 * (E[0] - 2 * E[1] + E[2]) / h**2
    D = shape_direction(np.cos(theta))
    return float(bend @ D / (D @ D))


def _result(overlap: Overlap, refinement: Refinement | None) -> Calibration:
    """The solution in terms of views and the whole field."""
    problem, system, solution, rows, held, change = vars(overlap).values()
    if refinement is not None and problem.settings.crosscal.vignetting:
        solution = with_hidden(system, solution, rows, problem.points_m[rows.vertex], refinement.hidden_K)
    at, n, slope = system.layout, problem.n_views, system.slope_L
    group = np.arange(n) if problem.settings.crosscal.offsets else np.zeros(n, np.intp)
    shape_bias = _shape_bias(problem.emissivity, problem.errors.sigma_normal_deg)
    whole = Layout(n, len(system.keep), at.n_sensor)
    expand = np.zeros((whole.size, at.size))
    expand[np.arange(n), group] = 1.0
    expand[whole.field, at.field] = system.keep
    expand[whole.shape, at.shape], expand[whole.gain, at.gain] = float(system.use_shape), float(system.use_gain)
    expand[whole.sensor, at.sensor] = np.eye(at.n_sensor)
    mean, level_variance = _mean_effect(system, solution), _level_variance(system, solution)
    level_sigma = float("nan")
    if system.anchored:
        level_sigma = float(np.sqrt(mean @ solution.covariance @ mean + level_variance) / system.slope_L)
    # what shifts all readings alike is the level's, not the single vertex's
    apart = np.eye(at.size)
    apart[at.offsets] -= mean
    p, covariance = expand @ solution.p, expand @ (apart @ solution.covariance @ apart.T) @ expand.T
    shape_sigma = 0.0
    if system.use_shape:
        # a relative result's level is off by the mean of the true offsets, and takes s along
        off = float(np.sqrt(level_variance)) if system.anchored else float(np.std(p[whole.offsets]))
        shape_sigma = float(
            np.sqrt(covariance[whole.shape, whole.shape] + (solution.level_gain[at.shape] * off) ** 2 + shape_bias**2)
        )
    residual = (system.y - system.predict(solution.p, solution.x)) / slope
    robust = solution.weight * system.sigma2
    total = np.bincount(rows.view, robust, n)
    with np.errstate(invalid="ignore", divide="ignore"):
        view_rms = np.sqrt(np.bincount(rows.view, robust * residual**2, n) / np.where(total > 0, total, np.nan))
    return Calibration(
        offset_radiance=p[whole.offsets],
        field=replace(system.field, coefficients=p[whole.field]),
        shape=float(p[whole.shape]),
        shape_sigma=shape_sigma,
        gain=1 + float(p[whole.gain]),
        pivot_radiance=system.pivot,
        covariance=covariance,
        slope_L=slope,
        anchored=system.anchored,
        reference_sigma_K=float(np.sqrt(level_variance)) / slope if system.anchored else float("nan"),
        level_sigma_K=level_sigma,
        residual_sigma=solution.scale,
        view_rms_K=view_rms,
        outlier_fraction=float(1 - np.mean(solution.weight > 0)),
        condition=condition_number(solution.normal[at.offsets, at.offsets]),
        held=held,
        iterations=solution.iterations,
        converged=solution.converged,
        sensor=None if refinement is None else refinement.pattern,
        sigma_normal_deg=_sigma_normal_deg(rows, system, solution, problem),
        pattern_sigma_K=0.0 if refinement is None else refinement.left_K,
        criticism={} if refinement is None else _told(refinement, system, solution),
        field_change=change,
        messages=_messages(system, solution, held, _groups(rows, n, solution.weight > 0), change),
    )


def _mean_effect(system: OverlapSystem, solution: Solution) -> Float:
    """(P,) what each parameter adds to readings on average: how the level of all vertices hangs on it."""
    at, w = system.layout, solution.weight / solution.weight.sum()
    out = np.zeros(at.size)
    out[at.offsets] = np.bincount(system.group, w, at.n_offsets)
    out[at.field] = w @ system.patterns
    if system.sensor_columns is not None:
        out[at.sensor] = w @ system.sensor_columns
    return out


def _level_variance(system: OverlapSystem, solution: Solution) -> float:
    """Variance of what references say of the level, larger where they contradict each other beyond chance.

    The scatter of readings about the solution over its expected size is Birge's ratio; a few readings know their own
    scatter badly, which Student's t pays for. It shifts all: (W m-2 sr-1)².
    """
    chi2, freedom, weight = _readings_scatter(system, solution)
    if not freedom or chi2 < chdtri(freedom, READINGS_ALIKE):
        return solution.level_variance
    wide = (stdtrit(freedom, 0.975) / NORMAL_95) ** 2 * chi2 / freedom
    return solution.level_variance + (wide - 1) / weight


def _readings_scatter(system: OverlapSystem, solution: Solution) -> tuple[float, int, float]:
    """Of readings of references about the solution: χ², degrees of freedom, and the sum of weights, (W m-2 sr-1)-2."""
    rows = system.reading_rows()
    if len(rows) < 2:
        return 0.0, 0, 1.0
    off = np.array([r.measured - r.expected - row @ solution.p for r, row, _ in rows])
    w = np.array([weight for *_, weight in rows])
    return float(w @ (off - w @ off / w.sum()) ** 2), len(rows) - 1, float(w.sum())


def _sigma_normal_deg(rows: Observations, system: OverlapSystem, solution: Solution, problem: ThermalProblem) -> float:
    """The normals' sigma, deg: as the squares of residuals rise with (x dE/dθ)²; the recipe's where it states one.

    A straight line through the medians of ten classes of slope, times `NORMALS_HIDDEN`.
    """
    stated = problem.settings.sigma_normal_deg
    if stated is not None:
        return stated
    lever = solution.x[system.vertex] * AngleTables.of(problem.emissivity).slope(rows.cos_angle)
    n = np.diff(system.start)[system.vertex]
    good = (n >= NORMALS_VIEWS) & (solution.weight > 0)
    if good.sum() < NORMALS_ROWS:
        return problem.errors.sigma_normal_deg
    square = (system.y - system.predict(solution.p, solution.x))[good] ** 2 * (n / (n - 1))[good]
    lever2 = lever[good] ** 2
    order = np.argsort(lever2)
    lever2, square = lever2[order], square[order]
    edges = np.searchsorted(lever2, np.quantile(lever2, np.linspace(0, 1, 11)[1:-1]), side="right")
    rise = [median(of_class) for of_class in np.split(lever2, edges)]
    variance = [median(of_class) / MAD_PER_SIGMA**2 for of_class in np.split(square, edges)]
    slope = float(np.polyfit(rise, variance, 1)[0])
    return float(np.clip(NORMALS_HIDDEN * np.degrees(np.sqrt(max(slope, 0.0))), *NORMALS_BOUNDS_DEG))


def _told(r: Refinement, system: OverlapSystem, solution: Solution) -> dict[str, Any]:
    """Criticism for the report: agreement of residuals by coordinate, without and with the sensor's pattern, [K, z];
    references_K : scatter of references' readings where it is no chance; gain : [γ, sigma] where references tell it."""
    chi2, freedom, weight = _readings_scatter(system, solution)
    scatter = 0.0
    if freedom and chi2 > chdtri(freedom, READINGS_ALIKE):
        scatter = float(np.sqrt(chi2 / freedom * (freedom + 1) / weight)) / system.slope_L
    return {
        "before": {k: [a.size_K, a.z] for k, a in r.before.items()},
        "after": {k: [a.size_K, a.z] for k, a in r.after.items()},
        "left_out_views_better": r.better,
        "references_K": scatter,
        "gain": gain_of_readings(system, solution),
    }


def _messages(
    system: OverlapSystem, solution: Solution, held: tuple[str, ...], groups: int, change: float
) -> tuple[str, ...]:
    out = []
    if not solution.converged:
        out.append("the cross-calibration stopped before it converged")
    if not system.anchored:
        out.append("no reference sets the level: temperatures are relative")
    if change >= CHANGED_AT_ALL:
        out.append(f"the earlier scan's field is of no use: it changed by {change:.1f} of what fields of cameras are")
    if held:
        out.append(f"held, because the overlap does not carry it: {', '.join(held)}")
    if groups > 1:
        out.append(f"the views fall into {groups} groups that share no surface: their levels are not tied")
    if system.use_shape and not SHAPE_BOUNDS[0] < solution.p[system.layout.shape] < SHAPE_BOUNDS[1]:
        out.append("the shape of ε(θ) ran to its bound: check normals, angle limit and reflected temperature")
    return tuple(out)


def _groups(rows: Observations, n_views: int, alive: Bool) -> int:
    """Number of groups of views connected by at least `MIN_SHARED` common vertices."""
    seen = csr_matrix((np.ones(int(alive.sum())), (rows.view[alive], rows.vertex[alive])))
    shared = (seen @ seen.T).toarray()
    present = np.diag(shared) > 0
    linked = shared[np.ix_(present, present)] >= min(MIN_SHARED, np.diag(shared).max())
    return int(connected_components(linked)[0])
