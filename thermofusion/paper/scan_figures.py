"""Figures from whole scans: the cylinder in 3D (Fig. 9's phantom), and Fig. 16's question put to several views."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..export.axes import axes_of
from ..physics.emissivity import Cosine
from ..pipeline import Result
from ..report.casts import cast_views
from ..report.lettering import Scale
from ..report.pictures import paint
from ..report.plot import (
    AMBER,
    BLUE,
    DASHED,
    DOTTED,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    SKY,
    Axis,
    Bar,
    Line,
    Picture,
    Plot,
    Rule,
)
from ..types import Float
from .models import CYLINDER
from .prepared import Case, Prepared, cylinder_scene
from .report import Figure, Number
from .sideview import BINS_DEG, ByAngle, Compared, compared
from .singleview import on_vertices

STYLE = {
    "uncorrected": (GREY, DASHED),
    "Eqs. 25-27, dielectric": (BLUE, ""),
    "Eqs. 25-27, non-dielectric": (ORANGE, ""),
    "Eqs. 25-27, cosine": (PURPLE, DOTTED),
    "Eqs. 25-28 (axis), dielectric": (AMBER, DASHED),
    "radiance, dielectric": (SKY, ""),
    "radiance, non-dielectric": (AMBER, ""),
    "offsets removed, uncorrected": (INK, DASHED),
    "joint": (GREEN, ""),
}
THETA = Axis("viewing angle θ [°]", 0, 75, 15)
UNIFORM_TO_DEG, UNIFORM_BAR_K = 60.0, 0.10  # the paper's range; the bar on what is left, peak to peak
STRAIGHT_DEG = 35.0  # what counts as facing in the pictures; the numbers take sideview.FACING_DEG


def cylinder_scan(prepared: Prepared) -> list[Figure]:
    """The phantom cylinder as a 3D scan, through the whole way from depth and thermal frames to temperatures."""
    case, scene = prepared.cylinder, cylinder_scene()
    mesh = case.result.mesh_in_world
    c = compared(case.result, case.scan, case.recipe, CYLINDER | {"cosine": Cosine(0.77)})
    table = ByAngle.of(c.angle_deg, c.values_degC)
    level = {name: m - m[0] for name, m in table.median_K.items()}
    upto = table.centre_deg < UNIFORM_TO_DEG
    *lines, cosine = _lines(table, {n: level[n] for n in _SHOWN})
    return [
        Figure(
            "fig9-cylinder",
            "The cylinder as a 3D scan",
            [
                *_pictures(case.result, {"apparent": mesh.apparent_degC, "result": mesh.temperature_degC}, "front"),
                Plot("over the viewing angle", THETA, Axis("T − T(0) [K]", -1, 0.4, 0.2), lines, "sw"),
                Plot("with the cosine model", THETA, Axis("T − T(0) [K]", -5, 25, 5), [*lines, cosine], "nw"),
            ],
            {"": _table(table, level)},
            _cylinder_numbers(case, scene.skin.mean_degC, {n: level[n][upto] for n in _SHOWN}),
            _NOTES_CYLINDER,
            "Fig. 9 in 3D  The phantom cylinder through the whole way",
            f"Simulated: isothermal, {scene.skin.mean_degC:g} °C, n = {scene.material.n}, room "
            f"{scene.room.reflected_degC:g} °C; recipe phantom-cylinder.",
        )
    ]


_SHOWN = ("uncorrected", "Eqs. 25-27, dielectric", "radiance, dielectric", "joint", "Eqs. 25-27, cosine")
_NOTES_CYLINDER = (
    "The phantom's lens has no vignetting, and none is fitted (crosscal.vignetting = false): the cylinder covers a "
    "sixth of the image's width, always the same columns, where a field cannot be told from ε(θ). Fitted all the "
    "same, and carried on to the blackbody in the image's corner, it would shift the level by 0.9 K.",
)


def _cylinder_numbers(case: Case, truth_degC: float, level_K: dict[str, Float]) -> list[Number]:
    """level_K : method -> medians over the angle up to 60°, less the first."""
    said = {"uncorrected": "drops beyond 40°", "Eqs. 25-27, dielectric": "uniform to 60°"}
    bar = {"joint": UNIFORM_BAR_K}
    numbers = [
        Number(f"peak to peak of the medians, 0-60°: {n}", float(np.ptp(y)), "K", said.get(n), None, bar.get(n))
        for n, y in level_K.items()
    ]
    mesh = case.result.mesh_in_world
    T, ok = mesh.temperature_degC, mesh.measured
    error = float(np.median(T[ok]) - truth_degC)
    sigmas = error / float(np.median(mesh.uncertainty_K[ok]))
    p95 = float(np.percentile(np.abs(T[ok] - truth_degC), 95))
    return [
        *numbers,
        Number("temperature of the mesh less the truth, median", error, "K"),
        Number("the same over its stated uncertainty", sigmas, "σ", None, -2, 2),
        Number("|temperature − truth|, 95th percentile", p95, "K"),
        Number("coverage of the surface", 100 * float(ok.mean()), "%"),
    ]


# ---------------------------------------------------------------- Fig. 16


def side_view_head(prepared: Prepared) -> list[Figure]:
    """A phantom head, half way round."""
    return [_side_view(prepared.head, "fig16-head-views", "a phantom head")]


def side_view_torso(prepared: Prepared) -> list[Figure]:
    """The scan that lies with the recordings."""
    case = prepared.torso
    return [_side_view(case, f"fig16-{case.name}", case.name)]


def _side_view(case: Case, stem: str, title: str) -> Figure:
    c = compared(case.result, case.scan, case.recipe)
    pairs, difference = c.against_facing()
    table = ByAngle.of(c.angle_deg[pairs], difference)
    frontal = _front_view(case.result)
    ahead = c.rows.view[pairs] == frontal
    one = ByAngle.of(c.angle_deg[pairs][ahead], {n: d[ahead] for n, d in difference.items()})
    y = Axis("[K]", -2.5, 1.0, 0.5)
    shown = [n for n in table.median_K if n not in ("Eqs. 25-27, cosine", "radiance, non-dielectric")]
    bias = _lines(table, {n: table.median_K[n] for n in shown})
    spread = _lines(table, {n: table.spread_K[n] for n in shown}, legend=False)
    return Figure(
        stem,
        f"Oblique against facing views: {title}",
        [
            *_side_pictures(case.result, c, frontal),
            Plot("oblique less facing, all views: median", THETA, y, [Rule(0.0), *bias], "sw"),
            Plot("and spread (1.48 MAD)", THETA, Axis("[K]", 0, _ceiling(table, shown), 0.2), spread),
        ],
        {"": _table(table, table.median_K, table.spread_K), "-front": _table(one, one.median_K, one.spread_K)},
        _side_numbers(table),
        _NOTES16,
        f"Fig. 16  What a view says of skin it sees obliquely: {title}",
        "Pictures: the side that the frontal view sees obliquely; camera offsets removed in (a)-(c), only "
        f"ε(θ) differs. Facing: below 25°.\nBelow: {len(pairs):,} pairs, {len(np.unique(c.rows.view))} views.",
        columns=3,
        panel_px=(430, 350),
    )


def _lines(table: ByAngle, curves: dict[str, Float], *, legend: bool = True) -> list[Line]:
    """One per method, in its colour."""
    return [Line(table.centre_deg, y, STYLE[n][0], n if legend else "", STYLE[n][1]) for n, y in curves.items()]


def _ceiling(table: ByAngle, names: list[str]) -> float:
    """Of the spread's axis: a multiple of 0.2 K."""
    return float(0.2 * np.ceil(max(np.nanmax(table.spread_K[n]) for n in names) / 0.2))


_NOTES16 = (
    "Median: what is wrong with ε(θ) and the angle. Spread: the camera's drift between views, noise, registration. "
    "Only the joint calibration takes the drift out.",
)


def _side_numbers(table: ByAngle) -> list[Number]:
    numbers = []
    steep = {f"{lo:g}-{hi:g}°": i for i, (lo, hi) in enumerate(pairwise(BINS_DEG)) if lo in (50, 60, 70)}
    said = {
        "uncorrected": "dramatic decrease",
        "Eqs. 25-27, dielectric": "more similar",
        "Eqs. 25-27, non-dielectric": "more similar",
    }
    for name in table.median_K:
        for where, i in steep.items():
            if np.isfinite(table.median_K[name][i]):
                numbers.append(Number(f"{name}, {where}: median", float(table.median_K[name][i]), "K", said.get(name)))
    for name in ("uncorrected", "Eqs. 25-27, dielectric", "joint"):
        if name in table.spread_K and np.isfinite(table.spread_K[name][steep["60-65°"]]):
            numbers.append(Number(f"{name}, 60-65°: spread", float(table.spread_K[name][steep["60-65°"]]), "K"))
    return numbers


def _front_view(result: Result) -> int:
    """The view from the most frontal place."""
    assert result.mapped is not None
    eye = result.mapped.views.T_world_thermal[:, :3, 3] - result.mesh_in_world.surface.vertices_m.mean(0)
    front = axes_of(result.mesh_in_world.metadata)[2]
    return int(np.argmax(eye @ front / np.linalg.norm(eye, axis=1)))


def _side_pictures(result: Result, c: Compared, frontal: int) -> list[Picture]:
    """A side as the views that face it have it, the frontal view uncorrected and corrected, and the whole result."""
    count, ahead = len(result.mesh_in_world.surface), np.flatnonzero(c.rows.view == frontal)

    def column(values: Float, rows: NDArray) -> Float:
        return on_vertices(count, c.rows.vertex[rows], values[rows])

    facing = np.flatnonzero(c.angle_deg < STRAIGHT_DEG)
    facing = facing[np.argsort(-c.angle_deg[facing], kind="stable")]  # the straightest is written last
    base = "offsets removed, uncorrected" if "joint" in c.values_degC else "uncorrected"
    corrected = "joint" if "joint" in c.values_degC else "radiance, dielectric"
    maps: dict[str, NDArray] = {
        "(a) views that face it": column(c.values_degC[base], facing),
        "(b) frontal view, uncorrected": column(c.values_degC[base], ahead),
        "(c) frontal view, corrected": column(c.values_degC[corrected], ahead),
    }
    if result.temperature:
        maps["(d) the whole result"] = result.temperature.normal_equivalent_degC
    return _pictures(result, maps, _better_side(result, c, facing))


def _better_side(result: Result, c: Compared, facing: NDArray) -> str:
    """`left` or `right`: the side that more views face."""
    assert result.mapped is not None
    right = axes_of(result.mesh_in_world.metadata)[0]
    seen = np.unique(c.rows.vertex[facing])
    return "left" if float(np.median(result.mesh_in_world.surface.normals[seen] @ right)) > 0 else "right"


def _pictures(result: Result, maps: dict[str, NDArray], side: str) -> list[Picture]:
    """Maps (V,) on the surface, on one scale."""
    (cast,) = cast_views(result.mesh_in_world.surface, axes_of(result.mesh_in_world.metadata), 420, views=(side,))
    everything = np.concatenate([m[np.isfinite(m)] for m in maps.values()])
    lo, hi = np.percentile(everything, (2, 99))
    scale = Scale("inferno", float(np.floor(2 * lo) / 2), float(np.ceil(2 * hi) / 2), "°C", "")
    bar = Bar(scale.palette, scale.lo, scale.hi, scale.unit)
    return [Picture(name, paint(cast, np.asarray(T, np.float32), scale), bar) for name, T in maps.items()]


def _table(table: ByAngle, medians: dict[str, Float], spreads: dict[str, Float] | None = None) -> dict[str, NDArray]:
    columns: dict[str, NDArray] = {"theta_deg": table.centre_deg, "observations": table.pairs}
    for name, m in medians.items():
        key = name.replace(".", "").replace(",", "").replace(" ", "_").replace("(", "").replace(")", "")
        columns[f"{key}_K"] = m
        if spreads is not None:
            columns[f"{key}_spread_K"] = spreads[name]
    return columns
