"""Parts of the surface that are not bare skin, as the user states them: dressing, cream, wet skin, cloth, hair, metal.

They take no part in the calibration. Once that is done, their observations are blended again with their own ε(θ), and
their own sigma of ε(0); what they send and reflect to the skin around follows. What reflects more than it emits shows
the room rather than itself: it gets no temperature, and neither does what has no emissivity. What is told to have the
skin's own ε(θ) stays skin: it calibrates, and the shape that was fitted to skin is its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RecipeError, ScanError
from ..mapping.observe import Mapped
from ..physics.band import ZERO_DEGC_K
from ..physics.emissivity import AngleTable, EmissivityModel, model_from_recipe
from ..recipe import EmissivitySection
from ..types import Bool, BudgetInput, Float, Int, Material, Scan, cause_of
from .blend import BlendResult, blend
from .crosscal import Calibration
from .problem import ThermalProblem
from .uncertainty import Uncertainty

MATERIAL_SIGMA = 0.03  # of an ε(0) whose sigma nobody stated: tables of cloth, hair and creams differ by as much
LEAST_EPSILON0 = 0.5  # below it, an error of the room's temperature is larger in the result than it was
PART = "material"  # of the budget


@dataclass(frozen=True, eq=False)
class Cover:
    """One material: where it was found (N,), and its ε(θ), or the reason why it has no temperature.

    is_skin : its ε(θ) is the skin's. not_skin : it also is what is found not to behave as skin. as_warm : as the skin
    below it, of which its temperature may be taken to be one.
    """

    name: str
    vertices: Int
    model: EmissivityModel | None
    sigma_emissivity0: float
    reason: str = ""
    is_skin: bool = False
    not_skin: bool = False
    as_warm: bool = False


@dataclass(frozen=True, eq=False)
class Covers:
    """All materials of a scan on V vertices; each vertex belongs to one. messages : what could not be done."""

    covers: tuple[Cover, ...]
    n_vertices: int
    messages: tuple[str, ...] = ()

    @classmethod
    def of(cls, scan: Scan, mapped: Mapped, problem: ThermalProblem) -> Covers:
        """Found on the surface. Raises ScanError: numbers of another surface, or an emissivity without sense."""
        n_vertices = len(problem)
        covers, messages = [], []
        owner = np.full(n_vertices, -1)
        for number, material in enumerate(scan.materials):
            found, missed = _where(material, scan, mapped, n_vertices)
            owner[found] = number  # of two that overlap the later one lies on top
            messages += missed
        for number, material in enumerate(scan.materials):
            vertices = np.asarray(np.flatnonzero(owner == number), np.int32)
            covers.append(_cover(material, vertices, problem, f"{scan.root}/scan.json: key 'materials.{number}'"))
        return cls(tuple(covers), n_vertices, tuple(messages))

    @property
    def anywhere(self) -> Bool:
        """(V,) True where something lies that is not skin."""
        out = np.zeros(self.n_vertices, bool)
        for cover in self.covers:
            if not cover.is_skin:
                out[cover.vertices] = True
        return out

    def flagged(self, other: Bool) -> Bool:
        """(V,) what is no skin: what was found (V,) or stated, less films as warm as the skin that could be read."""
        out = other | self.anywhere
        for cover in self.covers:
            if cover.as_warm and cover.model is not None:
                out[cover.vertices] = False
        return out

    def with_found(self, other: Bool) -> Covers:
        """With what was found not to behave as skin (V,) given to the material that claims it; none lies on another."""
        free = other.copy()
        for cover in self.covers:
            free[cover.vertices] = False
        found = np.flatnonzero(free).astype(np.int32)
        claims = [c.not_skin for c in self.covers]
        if not (len(found) and any(claims)):
            return self
        covers = list(self.covers)
        last = len(claims) - 1 - claims[::-1].index(True)  # of two that claim it the later one lies on top
        covers[last] = replace(covers[last], vertices=np.union1d(covers[last].vertices, found).astype(np.int32))
        return replace(self, covers=tuple(covers))

    @property
    def said(self) -> tuple[str, ...]:
        """For the user."""
        out = list(self.messages)
        for c in self.covers:
            where = f"material '{c.name}' ({len(c.vertices):,} vertices)"
            if not len(c.vertices):
                out.append(f"material '{c.name}' was found nowhere on the surface")
            elif c.reason:
                out.append(f"{where} unmeasured: {c.reason}")
            elif c.is_skin:
                out.append(f"{where} has the ε(θ) of the skin: it is read as skin")
        return tuple(out)

    @property
    def inputs(self) -> tuple[BudgetInput, ...]:
        """Of the budget: ε(0), where one material alone has one."""
        known = [c for c in self.covers if c.model is not None and len(c.vertices)]
        if len(known) != 1 or known[0].model is None:
            return ()
        one = known[0]
        return (BudgetInput(PART, float(known[0].model.normal), one.sigma_emissivity0, "1", "B", float("inf")),)

    def apart_from(self, problem: ThermalProblem) -> ThermalProblem:
        """The problem with materials out of the calibration, and with what they send to the skin around."""
        where = self.anywhere
        if not where.any():
            return problem
        return self.sent(problem.without(where))

    def sent(self, problem: ThermalProblem) -> ThermalProblem:
        """The problem with what materials send to the skin around."""
        sends = np.full(self.n_vertices, problem.emissivity.hemispherical)
        for cover in self.covers:
            sends[cover.vertices] = 0.0 if cover.model is None else cover.model.hemispherical
        return replace(problem, hemispherical=sends) if self.anywhere.any() else problem

    def read(
        self,
        result: BlendResult,
        problem: ThermalProblem,
        calibration: Calibration | None,
        *,
        with_uncertainty: bool = True,
    ) -> BlendResult:
        """A blend with every material read by its own ε(θ); NaN where it cannot be."""
        if not self.covers:
            return result
        out, changed = _Repainted.of(result), False
        for cover, part in self._parts(problem):
            own = None
            if part is not None:
                seen_by = calibration if cover.is_skin else _as_modelled(calibration)
                own = blend(part, seen_by, with_uncertainty=with_uncertainty)
            out.paint(cover, own)
            changed = True
        return out.result(result, with_uncertainty=with_uncertainty) if changed else result

    def _parts(self, problem: ThermalProblem) -> Iterator[tuple[Cover, ThermalProblem | None]]:
        every = np.ones(problem.n_views, bool)
        for cover in self.covers:
            if not len(cover.vertices) or (cover.is_skin and np.isnan(cover.sigma_emissivity0)):
                continue
            if cover.model is None:
                yield cover, None
                continue
            mine = np.zeros(self.n_vertices, bool)
            mine[cover.vertices] = True
            errors = replace(problem.errors, sigma_emissivity0=cover.sigma_emissivity0)
            part = replace(problem.part(every, mine), emissivity=cover.model, errors=errors, other=None)
            yield cover, part if len(part.observations) else None

    def told(self, result: BlendResult) -> dict[str, dict[str, Any]]:
        """By name, for result.json."""
        out = {}
        for c in self.covers:
            T_degC, sigma = result.temperature_K[c.vertices] - ZERO_DEGC_K, result.uncertainty.total_K[c.vertices]
            known = np.isfinite(T_degC)
            out[c.name] = {
                "vertices": len(c.vertices),
                "measured": int(known.sum()),
                "epsilon0": None if c.model is None else float(c.model.normal),
                "sigma_emissivity0": None if np.isnan(c.sigma_emissivity0) else c.sigma_emissivity0,
                "as_skin": c.is_skin,
                "median_degC": float(np.median(T_degC[known])) if known.any() else None,
                "median_sigma_K": float(np.median(sigma[known])) if known.any() else None,
                "reason": c.reason,
            }
        return out


def _where(material: Material, scan: Scan, mapped: Mapped, n_vertices: int) -> tuple[NDArray[np.intp], list[str]]:
    """Vertices (N,) that it covers, and what was not found. Raises ScanError."""
    if material.of_vertices not in (0, n_vertices) or material.vertices.max(initial=-1) >= n_vertices:
        told = material.of_vertices or int(material.vertices.max()) + 1
        text = f"material '{material.name}' is told on a surface of {told} vertices, this one has {n_vertices}"
        hint = "tell it on the surface that this recipe gives, or by an outline in a thermal picture"
        raise ScanError(text, place=scan.root, hint=hint)
    assert scan.thermal is not None
    rows, index = mapped.observations, scan.thermal.index[mapped.views.frame]
    found, missed = [material.vertices.astype(np.intp)], []
    for frame, polygon in material.polygons_px:
        view = np.flatnonzero(index == frame)
        if not len(view):
            missed.append(f"material '{material.name}': thermal frame {frame} is none of those that were used")
            continue
        lo, hi = np.searchsorted(rows.view, [view[0], view[0] + 1])
        inside = _inside(rows.u_px[lo:hi], rows.v_px[lo:hi], polygon)
        found.append(rows.vertex[lo:hi][inside].astype(np.intp))
    return np.unique(np.concatenate(found)), missed


def _inside(u: NDArray, v: NDArray, polygon: Float) -> Bool:
    """(N,) whether places u, v, px, lie inside a closed outline (M, 2), by the even-odd rule."""
    inside = np.zeros(len(u), bool)
    for (x1, y1), (x2, y2) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y1 != y2:
            inside ^= ((y1 > v) != (y2 > v)) & (u < (x2 - x1) * (v - y1) / (y2 - y1) + x1)
    return inside


def _cover(material: Material, vertices: Int, problem: ThermalProblem, place: str) -> Cover:
    """A material on vertices (N,); with the skin's ε(θ) and without a sigma of its own, sigma is NaN: the skin's."""
    sigma = MATERIAL_SIGMA if material.sigma_emissivity0 is None else material.sigma_emissivity0
    cover = Cover(material.name, vertices, None, sigma, "no emissivity is stated")
    cover = replace(cover, not_skin=material.not_skin, as_warm=material.counts_as_skin)
    if material.emissivity is None:
        return cover
    try:
        stated = problem.settings.emissivity
        if material.emissivity != "skin":
            stated = EmissivitySection.model_validate(material.emissivity)
        model = model_from_recipe(stated, problem.band)
    except RecipeError as e:
        raise ScanError(e.cause, place=f"{place}.emissivity", hint=e.hint) from None
    mu = AngleTable.knots()
    if np.array_equal(model(mu), problem.emissivity(mu)):
        sigma = np.nan if material.sigma_emissivity0 is None else sigma
        return replace(cover, model=model, sigma_emissivity0=sigma, reason="", is_skin=True)
    if model.normal < LEAST_EPSILON0:
        reason = f"it reflects more than it emits: its emissivity is {model.normal:.2f}, {LEAST_EPSILON0:g} is needed"
        return replace(cover, reason=reason)
    return replace(cover, model=model, reason="")


def _as_modelled(calibration: Calibration | None) -> Calibration | None:
    """The cameras' calibration without the shape that was fitted to skin."""
    return None if calibration is None else replace(calibration, shape=0.0, shape_sigma=0.0)


@dataclass(frozen=True, eq=False)
class _Repainted:
    """Columns (V,) of a blend, to be written to at the vertices of materials; the budget before it was summed."""

    columns: dict[str, NDArray]
    parts_K: dict[str, NDArray]
    common_K: dict[str, NDArray]
    modes_K: NDArray

    @classmethod
    def of(cls, result: BlendResult) -> _Repainted:
        held = ("absolute_K", "normal_equivalent_K", "residual", "spread_K", "own_K2")
        u = result.uncertainty
        return cls(
            {name: getattr(result, name).copy() for name in held},
            _own_parts(u),
            {name: value.copy() for name, value in u.common_K.items()},
            u.modes_K.copy(),
        )

    def paint(self, cover: Cover, own: BlendResult | None) -> None:
        """A material as it was read by itself; None: not at all."""
        v = cover.vertices
        if own is None:
            for name in ("absolute_K", "normal_equivalent_K"):
                self.columns[name][v] = np.nan
            for value in (*self.parts_K.values(), *self.common_K.values(), self.modes_K):
                value[v] = np.nan
            return
        for name, column in self.columns.items():
            column[v] = getattr(own, name)[v]
        parts, common = _own_parts(own.uncertainty), own.uncertainty.common_K
        for name, value in self.parts_K.items():
            value[v] = parts[name][v] if name in parts else np.where(np.isnan(own.absolute_K[v]), np.nan, 0)
        if own.uncertainty.modes_K.shape[1] == self.modes_K.shape[1]:
            self.modes_K[v] = own.uncertainty.modes_K[v]
        for name in [n for n in self.common_K if n in common]:
            self.common_K[name][v] = common[name][v]
        if "emissivity0" in common:  # of the material, not of skin: an error of its own
            mine = f"{PART} {cover.name}"
            self.common_K["emissivity0"][v] = 0 * common["emissivity0"][v]
            self.common_K.setdefault(mine, np.where(np.isnan(self.common_K["emissivity0"]), np.nan, 0))
            self.common_K[mine][v] = common["emissivity0"][v]

    def result(self, before: BlendResult, *, with_uncertainty: bool) -> BlendResult:
        """The whole again."""
        c, u = self.columns, before.uncertainty
        if with_uncertainty:
            u = Uncertainty.of(self.parts_K, self.common_K, self.modes_K)
        return replace(
            before,
            absolute_K=c["absolute_K"],
            normal_equivalent_K=c["normal_equivalent_K"],
            residual=c["residual"],
            spread_K=c["spread_K"],
            own_K2=c["own_K2"],
            uncertainty=u,
        )


def _own_parts(u: Uncertainty) -> dict[str, NDArray]:
    """Parts of single vertices, without those that are made of what is common."""
    causes = {cause_of(name) for name in u.common_K}
    return {name: value.copy() for name, value in u.parts_K.items() if name not in causes}
