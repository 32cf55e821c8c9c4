"""Whether a sensor's pattern is asked for: where residuals are alike by place in the image, and left-out views agree.

The smooth field that stands still is always solved for. A pattern that is fixed, or drifts between shutters, enters
only when residuals are alike beyond chance *and* beyond a floor in kelvin, and when views that were left out are
predicted better with it by twice the standard error, each against the best alternative.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...robust import SIGMA_PER_MAD
from ...types import Float, Observations
from ..problem import ThermalProblem
from ..system import OverlapSystem, Solution
from .criticism import Alike, left_out, statistics
from .pattern import Pattern

SAMPLE = 2000  # vertices that criticism and judgement need
FINAL_SAMPLE = 6000  # and a pattern's solution
FLOOR_K = 0.004  # of agreement: clean scans stay below; scales with the camera's noise beyond 0.04 K
FLOOR_NETD_K = 0.04
MIN_Z = 5.0
# Amplitude of a pattern over the agreement that vertices' means leave of it.
DRIFT_OVER_SIZE, FIXED_OVER_SIZE = 6.0, 3.0
LEFT_OVER_SIZE = 2.0  # error of a vertex over the agreement that is left
JUMP_SIGMAS = 4.0  # a step of the offsets between views beyond this many of their usual ones is a shutter's
MIN_STRETCH_VIEWS = 4
FOLDS = 3
SOLVE_STEPS = 6  # of reweighting: from the solution without a pattern
CLIP_SIGMAS = 4.0  # left-out residuals count up to here
MIN_JUDGED = 3  # views that must be left out for that
MIN_GAIN_SE = 2.0  # standard errors by which left-out views must be predicted better


@dataclass(frozen=True, eq=False)
class Refinement:
    """What was found of the sensor's pattern.

    before, after : agreement of residuals by coordinate. better : share by which the left-out views' mean square falls
    with each term that was kept. pattern : None where nothing was kept.
    """

    before: dict[str, Alike]
    after: dict[str, Alike]
    better: dict[str, float]
    pattern: Pattern | None
    system: OverlapSystem
    solution: Solution
    rows: Observations
    floor_K: float

    @property
    def left_K(self) -> float:
        """One sigma of what residuals still have in common by place in the image, where that is beyond chance."""
        return LEFT_OVER_SIZE * max(a.size_K if _beyond_chance(a, self.floor_K) else 0.0 for a in self.after.values())

    @property
    def hidden_K(self) -> float:
        """One sigma of a pattern that residuals hide or no term explains: any up to the floor may be there."""
        return max(FIXED_OVER_SIZE * self.floor_K / np.sqrt(3), self.left_K)


def refine(problem: ThermalProblem, system: OverlapSystem, solution: Solution, rows: Observations) -> Refinement:
    """The solution with the sensor's pattern, where residuals and left-out views ask for one.

    system, rows : solved without a pattern.
    """
    width, whole = problem.lens.width_px, (system, solution, rows)
    system, solution, chosen = system.sample(solution, SAMPLE)
    rows = rows.select(chosen)
    points = problem.points_m[rows.vertex]
    before = statistics(left_out(system, solution, rows, points), width)
    floor = FLOOR_K * max(1.0, problem.errors.netd_K / FLOOR_NETD_K)
    judge = _Judge(problem, system, solution, rows)
    better: dict[str, float] = {}
    kept, score, now = judge.bare, None, before
    while problem.settings.crosscal.vignetting and problem.settings.crosscal.offsets:
        asked = _asked(now, floor) | judge.by_sensor(_asked(now, floor).get("drift"))
        tried = {name: kept.grown(sizes) for name, sizes in asked.items() if not _has(better, name)}
        if not tried:
            break
        score = judge.score(kept) if score is None else score
        if np.isfinite(score).sum() < MIN_JUDGED:
            break  # too few views to leave any out
        scores = {name: judge.score(pattern) for name, pattern in tried.items()}
        best = min(scores, key=lambda name: float(np.nanmean(scores[name])))
        gain = (score - scores[best])[np.isfinite(score)]
        if not gain.mean() > MIN_GAIN_SE * gain.std(ddof=1) / np.sqrt(len(gain)):
            break
        better[best] = float(gain.mean() / np.nanmean(score))
        kept, score = tried[best], scores[best]
        system, solution = judge.solved(kept)
        now = statistics(left_out(system, solution, rows, points), width)
    if not better:
        return Refinement(before, before, {}, None, *whole, floor)
    system, solution, rows, kept = solved_with(kept, *whole)
    return Refinement(before, now, better, kept, system, solution, rows, floor)


def solved_with(
    pattern: Pattern, system: OverlapSystem, solution: Solution, rows: Observations
) -> tuple[OverlapSystem, Solution, Observations, Pattern]:
    """The final solution with terms of a pattern that were decided on; its coefficients are solved for anew.

    system, solution, rows : without a pattern.
    """
    system, solution, chosen = system.sample(solution, FINAL_SAMPLE)
    rows = rows.select(chosen)
    system = system.with_sensor(pattern, rows.u_px, rows.v_px)
    solution = system.solve(solution, 2 * SOLVE_STEPS)
    return system, solution, rows, replace(pattern, coefficients=solution.p[system.layout.sensor])


def _beyond_chance(a: Alike, floor_K: float) -> bool:
    return a.z > MIN_Z and a.size_K > floor_K


def _has(better: dict[str, float], name: str) -> bool:
    """Whether a term is there already: a drift goes with the time, or with one temperature."""
    return any(term.split()[0] == name.split()[0] for term in better)


def _asked(found: dict[str, Alike], floor_K: float) -> dict[str, dict[str, Any]]:
    """Terms that residuals ask for, beyond chance and the floor, with the amplitudes of their parts, K."""
    size = {name: a.size_K if _beyond_chance(a, floor_K) else 0.0 for name, a in found.items()}
    fixed = {f"{name}_K": FIXED_OVER_SIZE * size[name] for name in ("place", "column", "row") if size[name]}
    drift = {"drift_K": DRIFT_OVER_SIZE * size["place and time"]} if size["place and time"] else {}
    return {name: sizes for name, sizes in (("drift", drift), ("fixed", fixed)) if sizes}


def _stretches(problem: ThermalProblem, system: OverlapSystem, solution: Solution) -> tuple[NDArray[np.intp], Float]:
    """Number of each view's stretch between shutters, and 0 ... 1 the time since its start over the longest stretch."""
    M, times = problem.n_views, problem.view_times_s
    offsets = solution.p[system.layout.offsets]
    starts = {0, *problem.restarts}
    if len(offsets) == M and M > 2 * MIN_STRETCH_VIEWS:
        seen = np.unique(system.group)
        steps = np.diff(offsets[seen])
        usual = SIGMA_PER_MAD * float(np.median(np.abs(steps - np.median(steps))))
        starts |= set(seen[1:][np.abs(steps) > JUMP_SIGMAS * usual].tolist())
    first = np.array(sorted(starts))
    stretch = np.searchsorted(first, np.arange(M), side="right") - 1
    since = times - times[first][stretch]
    return stretch, since / max(float(since.max()), 1e-9)


class _Judge:
    """Left-out views, predicted by the others."""

    def __init__(self, problem: ThermalProblem, system: OverlapSystem, solution: Solution, rows: Observations) -> None:
        self._system, self._solution, self._rows = system, solution, rows
        stretch, since = _stretches(problem, system, solution)
        width, height = problem.lens.width_px, problem.lens.height_px
        self.bare = Pattern(width, height, 0.0, 0.0, 0.0, 0.0, stretch, since, np.zeros(0))
        changing = problem.changing
        self._sensor_degC = {} if changing is None else changing.sensor_degC

    def by_sensor(self, drift: dict[str, Any] | None) -> dict[str, dict[str, Any]]:
        """The drift that is asked for with how the sensor, or the lens, warmed since each shutter in place of time."""
        out: dict[str, dict[str, Any]] = {}
        if drift is None:
            return out
        for name, degC in self._sensor_degC.items():
            first = np.searchsorted(self.bare.stretch, np.arange(self.bare.stretch.max() + 1))
            warmed = degC - degC[first][self.bare.stretch]
            if np.abs(warmed).max() > 0:
                out[f"drift by {name}"] = {**drift, "since": warmed / np.abs(warmed).max()}
        return out

    def solved(self, pattern: Pattern) -> tuple[OverlapSystem, Solution]:
        """All views with a pattern, or without where it is bare."""
        if pattern.is_bare:
            return self._system, self._solution
        system = self._system.with_sensor(pattern, self._rows.u_px, self._rows.v_px)
        return system, system.solve(self._solution, SOLVE_STEPS)

    def score(self, pattern: Pattern) -> Float:
        """(M',) mean square over its own sigma of each view's left-out residuals; a view's own offset is their median.

        Readings keep the robust weight that the solution of all views gave them: one linear step a fold.
        """
        system, solution = self.solved(pattern)
        numbers, view = np.unique(system.group, return_inverse=True)
        out = np.full(len(numbers), np.nan)
        for fold in range(FOLDS):
            left = view % FOLDS == fold
            train = system.part(~left)
            p, x = train.step(solution.p, solution.x, solution.weight[~left])
            known = np.bincount(train.vertex, minlength=system.n_vertices) > 1
            mine = left & known[system.vertex]
            test = system.part(mine)
            p[test.group] = 0.0
            residual, sigma = test.y - test.predict(p, x), np.sqrt(test.sigma2)
            for k in np.unique(view[mine]):
                of_view = test.group == numbers[k]
                r = (residual[of_view] - np.median(residual[of_view])) / sigma[of_view]
                out[k] = np.mean(np.minimum(np.abs(r), CLIP_SIGMAS) ** 2)
        return out
