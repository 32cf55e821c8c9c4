"""The uncertainty budget of what a region reads, input by input, after the GUM (JCGM 100:2008).

Rows are independent of each other: what the vertices of a region share is followed by its signed effect before it is
squared, so that contributions add up to the sigma that is shown. What one input does to left and to right cancels in
their difference as far as it is alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..types import BudgetInput, cause_of
from .errors import MeanErrors

COVERAGE_FACTOR = 2.0  # of the expanded uncertainty: 95 % for a normal distribution
LEAST_K = 1e-9  # less is the rounding of what cancels
# What stays the same from one visit to the next: the same skin through the same camera. All else is new each time.
SAME_AT_EACH_VISIT = ("emissivity0", "gain", "scatter", "scale")


@dataclass(frozen=True)
class BudgetRow(BudgetInput):
    """One input, and what it does: sensitivity in K per unit, contribution_K = |sensitivity| u. Without a known input
    only the contribution stands, the rest is NaN."""

    sensitivity: float
    contribution_K: float


@dataclass(frozen=True)
class UncertaintyBudget:
    """Rows, largest first; combined_K = √Σ contribution², freedom by Welch and Satterthwaite, expanded_K with k = 2."""

    quantity: str
    rows: tuple[BudgetRow, ...]
    combined_K: float
    freedom: float
    expanded_K: float

    @classmethod
    def of(
        cls, quantity: str, contributions_K: Mapping[str, float], inputs: Sequence[BudgetInput]
    ) -> UncertaintyBudget:
        """From the contributions by name, K."""
        known = {i.name: i for i in inputs}
        rows = []
        for name, size in contributions_K.items():
            i = known.get(name, BudgetInput(name, np.nan, np.nan, "", "B", np.inf))
            sensitivity = size / i.u if i.u > 0 else np.nan
            rows.append(BudgetRow(**vars(i), sensitivity=sensitivity, contribution_K=size))
        rows.sort(key=lambda row: -row.contribution_K)
        combined = float(np.sqrt(sum(row.contribution_K**2 for row in rows)))
        spread = sum(row.contribution_K**4 / row.freedom for row in rows)
        freedom = combined**4 / spread if spread > 0 else float("inf")
        return cls(quantity, tuple(rows), combined, float(freedom), COVERAGE_FACTOR * combined)

    def document(self) -> dict[str, object]:
        """For JSON."""
        return {**vars(self), "rows": [vars(row) for row in self.rows]}


def of_mean(
    quantity: str, errors: MeanErrors, inputs: Sequence[BudgetInput], *, absolute: bool = False
) -> UncertaintyBudget:
    """Of one spot, line or region's mean; absolute : with the level, else about the level common to the body."""
    effect = errors.absolute_K if absolute else errors.common_K
    return UncertaintyBudget.of(quantity, _by_cause(errors.own_K, errors.names, effect), inputs)


def of_difference(
    quantity: str, first: MeanErrors, second: MeanErrors, inputs: Sequence[BudgetInput]
) -> UncertaintyBudget:
    """Of two means of one result, left less right: what both have in common cancels."""
    own = {k: float(np.hypot(first.own_K[k], second.own_K[k])) for k in first.own_K}
    return UncertaintyBudget.of(quantity, _by_cause(own, first.names, first.common_K - second.common_K), inputs)


def between_visits(
    quantity: str, first: MeanErrors, second: MeanErrors, inputs: Sequence[BudgetInput]
) -> UncertaintyBudget:
    """Of the same region at two visits, both on an absolute scale. Skin and camera stay the same; level, room, air and
    the views' calibration are new each time, unless the same reference stood in both: that is not assumed."""
    own = {k: float(np.hypot(first.own_K[k], second.own_K[k])) for k in first.own_K}
    one, other = (dict(zip(e.names, e.absolute_K.tolist(), strict=True)) for e in (first, second))
    names, effects = [], []
    for name in dict.fromkeys([*one, *other]):
        a, b = one.get(name, 0.0), other.get(name, 0.0)
        names.append(name)
        effects.append(a - b if cause_of(name) in SAME_AT_EACH_VISIT else float(np.hypot(a, b)))
    return UncertaintyBudget.of(quantity, _by_cause(own, tuple(names), np.array(effects)), inputs)


def _by_cause(own_K: Mapping[str, float], names: Sequence[str], effects_K: np.ndarray) -> dict[str, float]:
    """Contributions by cause, K; effects_K (R,)."""
    out = {k: v for k, v in own_K.items() if v > 0}
    for name, effect in zip(names, effects_K.tolist(), strict=True):
        if abs(effect) > LEAST_K:
            cause = cause_of(name)
            out[cause] = float(np.hypot(out.get(cause, 0.0), effect))
    return out
