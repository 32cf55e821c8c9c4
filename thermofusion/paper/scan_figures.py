"""Figures from whole scans: the cylinder in 3D (Fig. 9's phantom), and Fig. 16's question put to several views."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..export.axes import axes_of
from ..phantom import SceneConfig, load_scene, simulate
from ..physics.emissivity import Cosine, Fresnel
from ..pipeline import Result, fuse
from ..recipe import Recipe, load_recipe
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
    page,
)
from ..scans import open_scan
from ..types import Float, Scan
from .report import FigureReport, Number, Writer
from .sideview import BINS_DEG, ByAngle, Compared, compared

ALUMINIUM = {"dielectric": Fresnel(2.84), "non-dielectric": Fresnel(2.84, 0.0003), "cosine": Cosine(0.77)}
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
UNIFORM_TO_DEG, UNIFORM_BAR_K = 60.0, 0.10


def cylinder_scan(out: Path, work: Path) -> FigureReport:
    """The phantom cylinder as a 3D scan, through the whole way from depth and thermal frames to temperatures."""
    scene = cylinder_scene()
    folder = simulate(scene, work / "cylinder", seed=0, overwrite=True)
    scan, recipe = open_scan(folder), load_recipe("phantom-cylinder", ["crosscal.vignetting=false"])
    result = fuse(scan, recipe)
    c = compared(result, scan, recipe, given=ALUMINIUM)
    table = ByAngle.of(c.angle_deg, c.values_degC)
    level = {name: m - m[0] for name, m in table.median_K.items()}
    upto = table.centre_deg < UNIFORM_TO_DEG
    chosen = ("uncorrected", "Eqs. 25-27, dielectric", "radiance, dielectric", "joint")
    lines = [Line(table.centre_deg, level[n], STYLE[n][0], n, STYLE[n][1]) for n in chosen]
    x = Axis("viewing angle θ [°]", 0, 75, 15)
    mesh = result.mesh
    T, ok = mesh.temperature_degC, mesh.measured
    cosine = Line(table.centre_deg, level["Eqs. 25-27, cosine"], PURPLE, "Eqs. 25-27, cosine", DOTTED)
    writer = Writer(out, "fig9-cylinder")
    writer.svg(
        page(
            [
                *_pictures(result, {"apparent": mesh.apparent_degC, "result": T}, ("front",)),
                Plot("over the viewing angle", x, Axis("T − T(0) [K]", -1, 0.4, 0.2), lines, "sw"),
                Plot("with the cosine model", x, Axis("T − T(0) [K]", -5, 25, 5), [*lines, cosine], "nw"),
            ],
            title="Fig. 9 in 3D  The phantom cylinder through the whole way",
            caption=f"Simulated: isothermal, {scene.skin.mean_degC:g} °C, n = {scene.material.n}, room "
            f"{scene.room.reflected_degC:g} °C; recipe phantom-cylinder.",
        )
    )
    writer.csv(_table(table, level))
    said = {"uncorrected": "drops beyond 40°", "Eqs. 25-27, dielectric": "uniform to 60°"}
    numbers = [
        Number(f"peak to peak of the medians, 0-60°: {n}", float(np.ptp(level[n][upto])), "K", said.get(n),
               None, UNIFORM_BAR_K if n == "joint" else None)
        for n in (*chosen, "Eqs. 25-27, cosine")
    ]  # fmt: skip
    truth = scene.skin.mean_degC
    error = float(np.median(T[ok]) - truth)
    numbers += [
        Number("temperature of the mesh less the truth, median", error, "K"),
        Number(
            "the same over its stated uncertainty", error / float(np.median(mesh.uncertainty_K[ok])), "σ", None, -2, 2
        ),
        Number("|temperature − truth|, 95th percentile", float(np.percentile(np.abs(T[ok] - truth), 95)), "K"),
        Number("coverage of the surface", 100 * float(ok.mean()), "%"),
    ]
    return writer.report("The cylinder as a 3D scan", numbers, _NOTES_CYLINDER)


_NOTES_CYLINDER = (
    "The phantom's lens has no vignetting, and none is fitted (crosscal.vignetting = false): the cylinder covers a "
    "sixth of the image's width, always the same columns, where a field cannot be told from ε(θ). Fitted all the "
    "same, and carried on to the blackbody in the image's corner, it would shift the level by 0.9 K.",
)


def cylinder_scene() -> SceneConfig:
    """The shipped cylinder with fewer and smaller frames, through an even lens."""
    scene = load_scene("cylinder")
    assert scene.thermal.blackbody is not None
    return replace(
        scene,
        walk=replace(scene.walk, depth_frames=36, depth_hz=6.0),
        depth=replace(scene.depth, scale=0.5),
        thermal=replace(
            scene.thermal,
            scale=0.5,
            every=3,
            vignetting_K=0.0,
            blackbody=replace(scene.thermal.blackbody, frames=(0, 5, 10)),
        ),
    )


# ---------------------------------------------------------------- Fig. 16


def side_view_head(out: Path, work: Path) -> FigureReport:
    """A phantom head, half way round."""
    folder = simulate(head_scene(), work / "head-half-turn", seed=0, overwrite=True)
    scan, recipe = open_scan(folder), load_recipe("head")
    return _side_view(out, "fig16-head-views", "a phantom head", scan, recipe, fuse(scan, recipe))


def head_scene() -> SceneConfig:
    """The shipped head, from its front past one side to the back, with drift."""
    scene = load_scene("head")
    assert scene.thermal.blackbody is not None
    return replace(
        scene,
        shape=replace(scene.shape, subdivisions=1),
        walk=replace(scene.walk, turns=0.45, depth_frames=33, depth_hz=5.0),
        depth=replace(scene.depth, scale=0.5),
        thermal=replace(scene.thermal, every=3, blackbody=replace(scene.thermal.blackbody, frames=(0, 5, 10))),
        color=None,
    )


def side_view_scan(out: Path, work: Path, folder: Path) -> FigureReport:
    """A recorded scan: its result is kept in `work`, and taken from there the next time."""
    scan, recipe = open_scan(folder), load_recipe("torso")
    result = fuse(scan, recipe, out=work / folder.name)
    return _side_view(out, f"fig16-{folder.name}", folder.name, scan, recipe, result)


def _side_view(out: Path, stem: str, title: str, scan: Scan, recipe: Recipe, result: Result) -> FigureReport:
    c = compared(result, scan, recipe)
    pairs, difference = c.against_facing()
    table = ByAngle.of(c.angle_deg[pairs], difference)
    frontal = _front_view(result)
    ahead = c.rows.view[pairs] == frontal
    one = ByAngle.of(c.angle_deg[pairs][ahead], {n: d[ahead] for n, d in difference.items()})

    x = Axis("viewing angle θ [°]", 0, 75, 15)
    shown = [n for n in table.median_K if n not in ("Eqs. 25-27, cosine", "radiance, non-dielectric")]
    bias = [Line(table.centre_deg, table.median_K[n], STYLE[n][0], n, STYLE[n][1]) for n in shown]
    spread = [Line(table.centre_deg, table.spread_K[n], STYLE[n][0], "", STYLE[n][1]) for n in shown]
    writer = Writer(out, stem)
    writer.svg(
        page(
            [
                *_side_pictures(result, c, frontal),
                Plot(
                    "oblique less facing, all views: median", x, Axis("[K]", -2.5, 1.0, 0.5), [Rule(0.0), *bias], "sw"
                ),
                Plot("and spread (1.48 MAD)", x, Axis("[K]", 0, _ceiling(table, shown), 0.2), spread),
            ],
            columns=3,
            panel_px=(430, 350),
            title=f"Fig. 16  What a view says of skin it sees obliquely: {title}",
            caption="Pictures: the side that the frontal view sees obliquely; camera offsets removed in (a)-(c), only "
            f"ε(θ) differs. Facing: below 25°.\nBelow: {len(pairs):,} pairs, {len(np.unique(c.rows.view))} views.",
        )
    )
    writer.csv(_table(table, table.median_K, table.spread_K))
    writer.csv(_table(one, one.median_K, one.spread_K), "-front")
    return writer.report(f"Oblique against facing views: {title}", _side_numbers(table), _NOTES16)


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
    assert result.seen is not None
    eye = result.seen.views.T_world_thermal[:, :3, 3] - result.mesh.surface.vertices_m.mean(0)
    front = axes_of(result.mesh.metadata)[2]
    return int(np.argmax(eye @ front / np.linalg.norm(eye, axis=1)))


def _side_pictures(result: Result, c: Compared, frontal: int) -> list[Picture]:
    """A side as the views that face it have it, the frontal view uncorrected and corrected, and the whole result."""
    V = len(result.mesh.surface)
    in_front = c.rows.view == frontal

    def column(values: Float, rows: NDArray) -> Float:
        out = np.full(V, np.nan)
        out[c.rows.vertex[rows]] = values[rows]
        return out

    facing = np.flatnonzero(c.angle_deg < 35)
    facing = facing[np.argsort(-c.angle_deg[facing], kind="stable")]  # the straightest is written last
    base = "offsets removed, uncorrected" if "joint" in c.values_degC else "uncorrected"
    corrected = "joint" if "joint" in c.values_degC else "radiance, dielectric"
    maps = {
        "(a) views that face it": column(c.values_degC[base], facing),
        "(b) frontal view, uncorrected": column(c.values_degC[base], np.flatnonzero(in_front)),
        "(c) frontal view, corrected": column(c.values_degC[corrected], np.flatnonzero(in_front)),
        "(d) the whole result": result.temperature.normal_equivalent_degC if result.temperature else None,
    }
    return _pictures(result, {k: v for k, v in maps.items() if v is not None}, (_better_side(result, c, facing),))


def _better_side(result: Result, c: Compared, facing: NDArray) -> str:
    """`left` or `right`: the side that more views face."""
    assert result.seen is not None
    right = axes_of(result.mesh.metadata)[0]
    seen = np.unique(c.rows.vertex[facing])
    return "left" if float(np.median(result.mesh.surface.normals[seen] @ right)) > 0 else "right"


def _pictures(result: Result, maps: dict[str, NDArray], views: tuple[str, ...]) -> list[Picture]:
    """Maps (V,) on the surface, on one scale."""
    casts = cast_views(result.mesh.surface, axes_of(result.mesh.metadata), 420, views=views)
    everything = np.concatenate([m[np.isfinite(m)] for m in maps.values()])
    lo, hi = np.percentile(everything, (2, 99))
    scale = Scale("inferno", float(np.floor(2 * lo) / 2), float(np.ceil(2 * hi) / 2), "°C", "")
    bar = Bar(scale.palette, scale.lo, scale.hi, scale.unit)
    return [
        Picture(name, paint(cast, np.asarray(values, np.float32), scale), bar)
        for cast in casts
        for name, values in maps.items()
    ]


def _table(table: ByAngle, medians: dict[str, Float], spreads: dict[str, Float] | None = None) -> dict[str, NDArray]:
    columns: dict[str, NDArray] = {"theta_deg": table.centre_deg, "observations": table.pairs}
    for name, m in medians.items():
        key = name.replace(".", "").replace(",", "").replace(" ", "_").replace("(", "").replace(")", "")
        columns[f"{key}_K"] = m
        if spreads is not None:
            columns[f"{key}_spread_K"] = spreads[name]
    return columns
