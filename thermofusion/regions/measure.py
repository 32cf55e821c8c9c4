"""What regions read: values with an honest sigma, left against right. The only place where region statistics are
defined; the report's page follows it, and is tested against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from csv import writer
from dataclasses import dataclass, field, replace
from functools import cached_property
from io import StringIO
from itertools import pairwise
from typing import Any

import numpy as np

from ..errors import RecipeError
from ..files.table import inert
from ..types import Bool, BudgetInput, Float, Int, SharedErrors, ThermalMesh, VertexFlag, cause_of
from ..version import __version__
from .body import Body, along
from .budget import BudgetRow, UncertaintyBudget, between_visits, of_difference, of_mean
from .errors import DERIVED, MeanErrors, VertexErrors
from .patch import Patch, border_of, patch_of
from .region import Line, Region, Slab, Spot, opposite
from .volume import slab_volume, swelling_volume

MEASURED = "thermofusion-measured/1"
NAN = float("nan")
PROFILE_STEP_M = 2e-3  # about a vertex


@dataclass(frozen=True, eq=False)
class Reading:
    """What one region reads.

    value_degC : a spot's temperature, else the mean over the measured area or along the line; NaN = nothing measured.
    sigma_K : one sigma about the level common to the body; sigma_absolute_K : on an absolute scale, NaN for a relative
    result. sd_K, min_degC, max_degC, n : of the vertices inside. area_cm2 : measured or not; measured_fraction : of it,
    less what is flagged as no skin. length_mm : over the surface. profile : a line's columns (N,). volume_cm3 : between
    a slab's planes, or above the membrane that a region's border spans (a swelling). errors : for differences.
    """

    name: str
    kind: str
    value_degC: float = NAN
    sigma_K: float = NAN
    sigma_absolute_K: float = NAN
    sd_K: float = NAN
    min_degC: float = NAN
    max_degC: float = NAN
    n: int = 0
    area_cm2: float = NAN
    measured_fraction: float = NAN
    length_mm: float = NAN
    volume_cm3: float = NAN
    sigma_volume_cm3: float = NAN
    profile: dict[str, list[float]] = field(default_factory=dict)
    errors: MeanErrors | None = None

    def row(self) -> dict[str, Any]:
        """The numbers, for a table."""
        return {k: v for k, v in vars(self).items() if k not in ("profile", "errors")}


@dataclass(frozen=True)
class Difference:
    """Two readings compared: delta_K = first - second, with one sigma; what both have in common cancels.

    distance_mm : over the surface, between two spots. budget : of sigma_K, input by input.
    """

    first: str
    second: str
    delta_K: float
    sigma_K: float
    distance_mm: float = NAN
    budget: UncertaintyBudget | None = None

    def row(self) -> dict[str, Any]:
        """The numbers, for a table."""
        return {k: v for k, v in vars(self).items() if k != "budget"}


@dataclass(frozen=True, eq=False)
class Measured:
    """What a set of regions reads."""

    readings: tuple[Reading, ...]
    differences: tuple[Difference, ...]
    budgets: tuple[UncertaintyBudget, ...] = ()
    changes: tuple[Difference, ...] = ()

    @classmethod
    def of(cls, measurer: Measurer, regions: Sequence[Region], vertices: Sequence[int] = ()) -> Measured:
        """Read every region and every vertex of these numbers, then compare the regions."""
        readings = [measurer.read(region) for region in regions]
        differences = tuple(measurer.differences(regions, readings))
        readings += [measurer.vertex(number) for number in vertices]
        budgets = [measurer.budget(reading) for reading in readings] + [d.budget for d in differences]
        return cls(tuple(readings), differences, tuple(b for b in budgets if b is not None))

    def since(self, before: Measured, inputs: Sequence[BudgetInput]) -> Measured:
        """With how each region changed since an earlier visit; before : the same regions there, one by one. inputs : of
        this visit's budget.

        Where either level is unknown (a relative result) a change has no sigma and no budget.
        """
        changes = []
        for now, then in zip(self.readings, before.readings, strict=False):  # vertices, which come last, have no before
            name, budget = f"{now.name}, change", None
            if now.errors and then.errors and np.isfinite(now.sigma_absolute_K + then.sigma_absolute_K):
                budget = between_visits(name, now.errors, then.errors, inputs)
            sigma = NAN if budget is None else budget.combined_K
            delta = now.value_degC - then.value_degC
            changes.append(Difference(now.name, f"{then.name}, before", delta, sigma, budget=budget))
        budgets = tuple(c.budget for c in changes if c.budget is not None)
        return replace(self, changes=tuple(changes), budgets=self.budgets + budgets)

    @property
    def table(self) -> Any:
        """The readings as a pandas DataFrame where pandas is installed, else as a list of dicts."""
        rows = [reading.row() for reading in self.readings]
        try:
            import pandas  # type: ignore[import-untyped, unused-ignore]
        except ImportError:
            return rows
        return pandas.DataFrame(rows)

    def document(self) -> dict[str, Any]:
        """For JSON, profiles and budgets included."""
        readings = [
            {**r.row(), "budget_K": {} if r.errors is None else r.errors.budget_K, "profile": r.profile}
            for r in self.readings
        ]
        told = {"schema": MEASURED, "software": f"thermofusion {__version__}"}
        return {
            **told,
            "regions": readings,
            "differences": [d.row() for d in self.differences],
            "changes": [d.row() for d in self.changes],
            "budgets": [b.document() for b in self.budgets],
        }

    def csv(self) -> str:
        """One line a region, then a difference, then a change since the visit before; an empty cell is not measured."""
        keys = list(Reading("", "").row())
        lines = [keys, *(list(r.row().values()) for r in self.readings)]
        kinds = [(d, "difference_K") for d in self.differences] + [(d, "change_K") for d in self.changes]
        for d, kind in kinds:
            row: dict[str, Any] = dict.fromkeys(keys, "") | {"name": f"{d.first} - {d.second}", "kind": kind}
            row |= {"value_degC": d.delta_K, "sigma_K": d.sigma_K, "length_mm": d.distance_mm}
            lines.append(list(row.values()))
        text = StringIO()
        writer(text, lineterminator="\n").writerows([_cell(x) for x in line] for line in lines)
        return text.getvalue()

    def budget_csv(self) -> str:
        """One line an input of each quantity, then its combined and expanded (k = 2) uncertainty, K."""
        keys = list(BudgetRow.__dataclass_fields__)
        lines: list[list[Any]] = [["quantity", *keys]]
        for budget in self.budgets:
            lines += [[budget.quantity, *vars(row).values()] for row in budget.rows]
            for name, size in (("combined", budget.combined_K), ("expanded (k = 2)", budget.expanded_K)):
                lines.append([budget.quantity, name, NAN, NAN, "K", "", budget.freedom, NAN, size])
        text = StringIO()
        writer(text, lineterminator="\n").writerows([_cell(x) for x in line] for line in lines)
        return text.getvalue()


def _cell(x: Any) -> str:
    """A number without noise digits, no cell that a spreadsheet would run as a formula."""
    if isinstance(x, str):
        return inert(x)
    return "" if not np.isfinite(x) else f"{x:.6g}"


class Measurer:
    """Reads regions of one mesh."""

    def __init__(
        self, mesh: ThermalMesh, shared: SharedErrors | None = None, inputs: Sequence[BudgetInput] = ()
    ) -> None:
        """shared : what the vertices' errors have in common (`Temperature.shared`); None: nothing averages. inputs :
        what temperatures depend on (`Temperature.inputs`)."""
        self.mesh, self.shared, self.inputs, self.body = mesh, shared, tuple(inputs), Body.of(mesh)

    @cached_property
    def errors(self) -> VertexErrors:
        """Of every vertex."""
        return VertexErrors.of(self.mesh, self.shared, self.body)

    @cached_property
    def _skin(self) -> Bool:
        """(V,) what means are taken over: measured, and not told to be cloth or hair."""
        return self.mesh.measured & ((self.mesh.flags & VertexFlag.NOT_SKIN) == 0)

    @cached_property
    def _T(self) -> Float:
        return self.mesh.temperature_degC.astype(np.float64)

    def read(self, region: Region) -> Reading:
        """What a region reads; one off the surface, or on unmeasured skin, reads NaN."""
        if isinstance(region, Spot):
            return self._spot(region)
        if isinstance(region, Line):
            return self._line(region)
        patch = patch_of(region, self.body, self._skin)
        volume = slab_volume(region, self.body) if isinstance(region, Slab) else swelling_volume(region, self.body)
        size: dict[str, Any] = {
            "volume_cm3": volume[0] * 1e6,
            "sigma_volume_cm3": volume[1] * 1e6,
            "area_cm2": patch.area_m2 * 1e4,
        }
        if not len(patch.vertex):
            return Reading(region.name, region.kind, **size)
        area, mean = float(patch.weight.sum()), float(patch.mean(self._T))
        inside = patch.inside if patch.inside.any() else ~patch.inside
        T, weight = self._T[patch.vertex[inside]], patch.weight[inside]
        sd = float(np.sqrt(weight @ (T - mean) ** 2 / weight.sum()))
        found = {"sd_K": sd, "min_degC": T.min(), "max_degC": T.max(), "n": int(patch.inside.sum())}
        found |= {"measured_fraction": area / patch.area_m2}
        return self._reading(region.name, region.kind, mean, self.errors.of_area(patch, area), **size, **found)

    def vertex(self, number: int) -> Reading:
        """What one vertex of the mesh reads, its errors by every part of its sigma. Raises RecipeError: no such vertex.

        A spot is a mean of three vertices, and its parts are gathered; here they stand as the mesh has them.
        """
        if not 0 <= number < len(self.mesh):
            raise RecipeError(f"there is no vertex {number}", hint=f"this result has {len(self.mesh)}, from 0")
        errors = self.errors
        causes = [cause_of(name) for name in errors.names]
        parts = {k: float(np.nan_to_num(v[number])) for k, v in self.mesh.uncertainty_parts.items() if k not in DERIVED}
        own = {k: v for k, v in parts.items() if k not in causes} or {"other": float(self.mesh.uncertainty_K[number])}
        common = errors.common_K[number].astype(np.float64)
        off = common - errors.level_K
        for cause in set(causes) & set(parts):  # signed effects are stored in coarse steps, the parts are not
            mine = np.array([c == cause for c in causes])
            size = float(np.linalg.norm(off[mine]))
            off[mine] *= parts[cause] / size if size else 0.0
        found = MeanErrors(own, off, common, errors.names)
        return self._reading(f"vertex {number}", "vertex", float(self._T[number]), found, n=1)

    def labels(self, regions: Sequence[Region]) -> Int:
        """(V,) number of the region that a vertex lies in, from 1 in their order; 0 = in none.

        Spots and lines cover nothing. Measured or not. Of two that overlap the later one lies on top, as with the
        materials of a scan.
        """
        out = np.zeros(len(self.mesh), np.int32)
        for number, region in enumerate(regions, 1):
            if not isinstance(region, Spot | Line):
                out[np.nan_to_num(border_of(region, self.body), nan=np.inf) < 0] = number
        return out

    def budget(self, reading: Reading) -> UncertaintyBudget | None:
        """Of a reading on an absolute scale, else about the level common to the body; None = nothing measured."""
        if reading.errors is None or not np.isfinite(reading.sigma_K):
            return None
        return of_mean(reading.name, reading.errors, self.inputs, absolute=bool(np.isfinite(reading.sigma_absolute_K)))

    def differences(self, regions: Sequence[Region], readings: Sequence[Reading]) -> list[Difference]:
        """Left less right of regions that are named alike, and every other spot less the next."""
        sides = {key: k for k, region in enumerate(regions) if (key := opposite(region.name))}
        pairs = [(k, sides["right", what]) for (side, what), k in sides.items() if side == "left"
                 and ("right", what) in sides]  # fmt: skip
        spots = [k for k, region in enumerate(regions) if isinstance(region, Spot) and not opposite(region.name)]
        return [self._difference(regions, readings, i, j) for i, j in (*pairs, *pairwise(spots))]

    def _difference(self, regions: Sequence[Region], readings: Sequence[Reading], i: int, j: int) -> Difference:
        a, b, p, q = readings[i], readings[j], regions[i], regions[j]
        sigma = NAN if a.errors is None or b.errors is None else a.errors.minus(b.errors)
        distance = NAN
        if isinstance(p, Spot) and isinstance(q, Spot):
            line = self.body.path(np.array(p.point_m), np.array(q.point_m))
            distance = NAN if line is None else along(line)[-1] * 1e3
        budget = None
        if a.errors is not None and b.errors is not None and np.isfinite(a.sigma_K + b.sigma_K):
            budget = of_difference(f"{a.name} - {b.name}", a.errors, b.errors, self.inputs)
        return Difference(a.name, b.name, a.value_degC - b.value_degC, sigma, distance, budget)

    def _spot(self, region: Spot) -> Reading:
        _, corners, weights = self.body.nearest(np.array([region.point_m]))
        spot = Patch(corners[0], weights[0], np.ones(3, bool), 0.0)
        return self._reading(region.name, region.kind, float(spot.mean(self._T)), self.errors.of_area(spot, 0.0), n=1)

    def _line(self, region: Line) -> Reading:
        ends = pairwise(np.array(region.points_m))
        pieces = [line for start, end in ends if (line := self.body.path(start, end)) is not None]
        if len(pieces) < len(region.points_m) - 1:
            return Reading(region.name, region.kind)
        line = np.vstack(pieces)
        s, length = along(line), along(line)[-1]
        at = np.linspace(0, length, max(int(np.ceil(length / PROFILE_STEP_M)), 1) + 1)
        points = np.stack([np.interp(at, s, x) for x in line.T], axis=1)
        _, corners, weights = self.body.nearest(points)
        T = (weights * self._T[corners]).sum(1)
        sigma = (weights * self.mesh.uncertainty_K[corners]).sum(1)
        known = np.isfinite(T)
        size = {"length_mm": length * 1e3, "profile": {"mm": at * 1e3, "degC": T, "sigma_K": sigma}}
        if not known.any():
            return Reading(region.name, region.kind, **size)
        way = Patch(corners[known].ravel(), weights[known].ravel(), np.ones(3 * int(known.sum()), bool), 0.0)
        found = {"sd_K": T[known].std(), "min_degC": T[known].min(), "max_degC": T[known].max()}
        found |= {"measured_fraction": known.mean(), "n": int(known.sum())}
        errors = self.errors.of_line(way, length)
        return self._reading(region.name, region.kind, float(T[known].mean()), errors, **size, **found)

    def _reading(self, name: str, kind: str, value: float, errors: MeanErrors, **rest: Any) -> Reading:
        absolute = errors.sigma_absolute_K if self.mesh.anchored and np.isfinite(value) else NAN
        sigma = errors.sigma_K if np.isfinite(value) else NAN
        return Reading(name, kind, value, sigma, absolute, errors=errors, **rest)
