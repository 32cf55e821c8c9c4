"""Figs. 11-16: a face from one depth and thermal pair, and the same figures for a phantom head.

Pictures of the real face show an identifiable person: they are written to the user's folder only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..export import palettes
from ..phantom import SceneConfig, load_scene, simulate
from ..pipeline import Result, fuse
from ..recipe import load_recipe
from ..report.casts import Cast, cast_views
from ..report.lettering import Scale
from ..report.pictures import paint
from ..report.plot import BLUE, GREY, ORANGE, Axis, Bar, Line, Picture, Plot, Points, page
from ..scans import open_scan
from ..types import Float, Scan, UInt8
from .emissivity_figures import SKIN
from .report import FigureReport, Number, Writer
from .singleview import BackProjection, View, flat_field, smoothed, view_of

ROOM_DEGC = 23.0  # the paper's T_a
MAX_ANGLE_DEG = 65.0
LINE_HALF_ROWS = 1  # a profile is the mean of three rows
BAR_K = (0.1, 1.6)  # of the correction along the lines; the paper: 0.2-1.4
PICTURE_PX = 420
RECIPE = "paper/face"


@dataclass(frozen=True)
class Sitter:
    """Whose face: the suffix of its files, and the image rows of the two lines (forehead; nose and cheeks)."""

    suffix: str
    title: str
    forehead_px: int
    cheek_px: int
    shift_K: float = 0.0


@dataclass(frozen=True, eq=False)
class Sitting:
    """A face, fused: its view, back-projection, and drawing directions."""

    sitter: Sitter
    scan: Scan
    view: View
    pixels: BackProjection
    casts: dict[str, Cast]

    @classmethod
    def of(cls, sitter: Sitter, scan: Scan) -> Sitting:
        """Through the whole pipeline with the paper's method."""
        result: Result = fuse(scan, load_recipe(RECIPE))
        view = view_of(result, scan, ROOM_DEGC)
        casts = cast_views(view.head(), view.axes, PICTURE_PX, views=("front", "left", "right"))
        return cls(sitter, scan, view, BackProjection.of(view), {c.name: c for c in casts})

    def drawn(self, side: str, values: NDArray, scale: Scale) -> UInt8:
        """The head from one side, coloured."""
        return paint(self.casts[side], values, scale)

    def line(self, row: int, values: NDArray) -> Float:
        """A per-vertex quantity (V,) along an image row, (W,)."""
        image = self.pixels.image(values)
        return np.asarray(image[row - LINE_HALF_ROWS : row + LINE_HALF_ROWS + 1].mean(axis=0))


def face_figures(out: Path, data: Path) -> list[FigureReport]:
    """Figs. 11-16 of the paper's own face. Raises ScanError where the recording is unusable."""
    scan = open_scan(data / "jhu" / "face")
    wall = (slice(0, 140), np.r_[0:190, 450:632])
    flat, shift = flat_field(scan, data / "jhu" / "radiometry", wall, ROOM_DEGC)
    return _figures(out, Sitting.of(Sitter("-face", "the paper's face", 112, 168, shift), smoothed(flat)))


def head_figures(out: Path, work: Path) -> list[FigureReport]:
    """The same of a phantom head (CC0), recorded into `work`."""
    folder = work / "head-one-view"
    simulate(one_view_scene(), folder, seed=0, overwrite=True)
    return _figures(out, Sitting.of(Sitter("-head", "a phantom head", 92, 155), open_scan(folder)))


def one_view_scene() -> SceneConfig:
    """The shipped head, seen once from the front: no walk, no drift."""
    scene = load_scene("head")
    walk = replace(scene.walk, turns=0.0, depth_frames=4, tremor_mm=0.5, height_wobble_m=0.0)
    drift = replace(scene.thermal.drift, level_K=0.0, wander_K=0.0)
    thermal = replace(scene.thermal, every=4, vignetting_K=0.0, drift=drift, blackbody=None)
    return replace(scene, walk=walk, thermal=thermal, color=None)


def _figures(out: Path, s: Sitting) -> list[FigureReport]:
    made = [_figure11(out, s), _figure12(out, s), _figure13(out, s), _figure14(out, s), _figure15(out, s)]
    return [*made, _figure16(out, s)]


# ---------------------------------------------------------------- the figures


def _figure11(out: Path, s: Sitting) -> FigureReport:
    """Surface, thermal image, projected grid, overlay."""
    v, scale = s.view, _temperature(s)
    seen = np.flatnonzero(np.isfinite(v.apparent_degC))
    every = seen[:: max(1, len(seen) // 4000)]
    grid = Points(v.u_px[every], v.v_px[every], "#2f9e44", radius=0.6)
    empty = np.full((*v.camera.shape, 3), 255, np.uint8)
    shape = np.full(len(v.surface), 1.0, np.float32)
    grey = Scale("grey", 0.0, 1.1, "", "", shading=1.0)
    room = replace(scale, lo=ROOM_DEGC - 3)
    image = _thermal_picture(s, room)
    writer = Writer(out, f"fig11{s.sitter.suffix}")
    writer.svg(
        page(
            [
                Picture("(a) surface", s.drawn("front", shape, grey)),
                Picture("(b) thermal image", image, _bar(room)),
                Picture("(c) surface grid in thermal pixels", empty, None, [grid]),
                Picture("(d) overlay", image, _bar(room), [grid]),
            ],
            title=f"Fig. 11  Surface and thermal image: {s.sitter.title}",
        )
    )
    writer.csv({"vertex": seen, "u_px": v.u_px[seen], "v_px": v.v_px[seen], "apparent_degC": v.apparent_degC[seen]})
    numbers = [
        Number("vertices of the surface", float(len(v.surface))),
        Number("vertices that the thermal camera saw", float(len(seen))),
    ]
    note = (
        "The authors' per-pixel field is added, and the picture shifted until the wall reads the paper's 23 °C: "
        f"{s.sitter.shift_K:+.1f} K. Without the shift every correction is a third smaller."
    )
    return writer.report("Surface and thermal image", numbers, [note] if s.sitter.shift_K else [])


def _figure12(out: Path, s: Sitting) -> FigureReport:
    """The raw thermal map, front and sides."""
    scale = _temperature(s)
    views = ("front", "left", "right")
    writer = Writer(out, f"fig12{s.sitter.suffix}")
    panels = [
        Picture(f"{name}, uncorrected", s.drawn(name, s.view.apparent_degC, scale), _bar(scale)) for name in views
    ]
    writer.svg(page(panels, columns=3, title=f"Fig. 12  Raw 3D thermal map: {s.sitter.title}"))
    writer.csv(_by_angle(s.view, {"apparent_degC": s.view.apparent_degC}))
    return writer.report("Raw 3D thermal map")


def _figure13(out: Path, s: Sitting) -> FigureReport:
    """The viewing angle by the camera's axis (Eq. 28) and by the pixel's ray."""
    v = s.view
    axis, ray = v.angle_deg(axis=True), v.angle_deg()
    angle, signed = Scale("cividis", 0, 75, "°", ""), Scale("difference", -15, 15, "°", "")
    writer = Writer(out, f"fig13{s.sitter.suffix}")
    writer.svg(
        page(
            [
                Picture("axis of the camera (Eq. 28)", s.drawn("front", axis, angle), _bar(angle)),
                Picture("the pixel's own ray", s.drawn("front", ray, angle), _bar(angle)),
                Picture("axis less ray", s.drawn("front", axis - ray, signed), _bar(signed)),
            ],
            columns=3,
            title=f"Fig. 13  Viewing angle: {s.sitter.title}",
        )
    )
    ok = np.flatnonzero(np.isfinite(ray))
    writer.csv({"vertex": ok, "axis_deg": axis[ok], "ray_deg": ray[ok]})
    head = np.unique(v.head().triangles)
    off = np.abs(axis - ray)[head]
    error = np.abs(v.linear_degC(SKIN["dielectric"], axis=True) - v.linear_degC(SKIN["dielectric"]))[head]
    numbers = [
        Number("|axis − ray|, median", float(np.nanmedian(off)), "°"),
        Number("|axis − ray|, largest", float(np.nanmax(off)), "°"),
        Number("error of the corrected temperature by the axis, 95th percentile", _p95(error), "K"),
    ]
    note = "Eq. 28 takes the angle to the camera's axis; what decides ε is the angle to the ray that reaches the pixel."
    return writer.report("Viewing angle", numbers, [note])


def _figure14(out: Path, s: Sitting) -> FigureReport:
    """The map corrected by the three models, front and side, and by radiance."""
    scale, v = _temperature(s), s.view
    maps = {name: v.paper_degC(model) for name, model in SKIN.items()}
    maps["radiance, dielectric"] = v.radiance_degC(SKIN["dielectric"])
    panels = [
        Picture(f"{name}, {side}", s.drawn(side, T, scale), _bar(scale))
        for name, T in maps.items()
        for side in ("front", "left")
    ]
    writer = Writer(out, f"fig14{s.sitter.suffix}")
    title = f"Fig. 14  Corrected 3D thermal maps (Eqs. 25-27): {s.sitter.title}"
    writer.svg(page(panels, columns=4, panel_px=(330, 300), title=title))
    writer.csv(_by_angle(v, {name.replace(", ", "_"): T for name, T in maps.items()} | {"apparent": v.apparent_degC}))
    said = {"dielectric": "effective", "non-dielectric": "slightly stronger", "cosine": "over-compensated"}
    head = np.unique(v.head().triangles)
    oblique = head[v.angle_deg()[head] > 50]
    numbers = [
        Number(
            f"mean change beyond 50°, {name}",
            float(np.nanmean((maps[name] - v.apparent_degC)[oblique])),
            "K",
            said[name],
        )
        for name in SKIN
    ]
    facing_spread = _p95_p5(v.apparent_degC[head])
    numbers += [Number("spread (5th to 95th percentile), uncorrected", facing_spread, "K")]
    numbers += [Number(f"spread, {name}", _p95_p5(T[head]), "K") for name, T in maps.items()]
    return writer.report("Three corrected maps", numbers)


def _figure15(out: Path, s: Sitting) -> FigureReport:
    """Back-projection into the thermal image, profiles along two lines, and the correction's size."""
    v, scale, sitter = s.view, _temperature(s), s.sitter
    maps = {"uncorrected": v.apparent_degC, **{m: v.paper_degC(SKIN[m]) for m in ("dielectric", "non-dielectric")}}
    lines = {"forehead": sitter.forehead_px, "cheeks": sitter.cheek_px}
    tone = {"forehead": "#1971ff", "cheeks": "#2fb344"}
    head = _head_box(s)
    panels: list[Picture | Plot] = []
    for letter, (name, T) in zip("ace", maps.items(), strict=True):
        rgb = palettes.apply(s.pixels.image(T), scale.palette, scale.lo, scale.hi, nan_rgb=(235, 235, 235))[head]
        columns = [0, rgb.shape[1] - 1]
        marks = [Line(columns, [row - head[0].start] * 2, tone[k], width=1.6) for k, row in lines.items()]
        panels.append(Picture(f"({letter}) {name}", rgb, _bar(scale), marks))
    u = np.arange(v.camera.width_px, dtype=np.float64)
    x = Axis("thermal image column [px]", head[1].start, head[1].stop, 50)
    for letter, (where, row) in zip("bd", lines.items(), strict=True):
        values = [s.line(row, T) for T in maps.values()]
        curves = [Line(u, y, *_TONES[name]) for name, y in zip(maps, values, strict=True)]
        panels.append(Plot(f"({letter}) {where}", x, _span("T [°C]", values), curves, "sw"))
    changes = {(w, m): s.line(row, v.linear_degC(SKIN[m]) - v.apparent_degC) for w, row in lines.items() for m in SKIN}
    marks = [
        Line(u, changes[w, m], tone[w], f"{w}, {m}", "" if m == "dielectric" else "6 3")
        for w in lines
        for m in ("dielectric", "non-dielectric")
    ]
    panels.append(Plot("(f) correction, Eq. 25", x, Axis("Ts − T [K]", 0, 2.2, 0.2), marks, "ne"))
    writer = Writer(out, f"fig15{sitter.suffix}")
    writer.svg(page(panels, columns=3, panel_px=(400, 330), title=f"Fig. 15  Profiles along two lines: {sitter.title}"))
    theta = {w: s.line(row, v.angle_deg()) for w, row in lines.items()}
    table: dict[str, NDArray] = {"column_px": u.astype(int)}
    for w, row in lines.items():
        table |= {f"{w}_theta_deg": theta[w]} | {f"{w}_{m}_degC": s.line(row, T) for m, T in maps.items()}
        table |= {f"{w}_eq25_{m}_K": changes[w, m] for m in SKIN}
        table |= {f"{w}_eqs25_27_{m}_K": s.line(row, v.paper_degC(SKIN[m]) - v.apparent_degC) for m in SKIN}
    keep = np.flatnonzero(np.isfinite(theta["forehead"]) | np.isfinite(theta["cheeks"]))
    writer.csv({k: c[keep] for k, c in table.items()})
    return writer.report("Profiles along forehead and cheeks", _line_numbers(theta, changes), _NOTES15)


_TONES: dict[str, tuple[str, str] | tuple[str, str, str]] = {
    "uncorrected": (GREY, "uncorrected", "5 3"),
    "dielectric": (BLUE, "dielectric"),
    "non-dielectric": (ORANGE, "non-dielectric", "8 3 2 3"),
}
_NOTES15 = (
    "(f) is Eq. 25 alone. With the scaling of Eqs. 26-27 the correction is zero by construction where the face looks "
    "at the camera; the paper's smallest value of 0.2 °C is what Eq. 25 gives there (ΔT = 10 K, 1 − ε = 0.02), so "
    "its Fig. 15(f) can only be Eq. 25.",
)


def _figure16(out: Path, s: Sitting) -> FigureReport:
    """The side view of the raw and of the corrected maps."""
    scale, v = _temperature(s), s.view
    maps = {"uncorrected": v.apparent_degC, **{m: v.paper_degC(SKIN[m]) for m in ("dielectric", "non-dielectric")}}
    panels = [
        Picture(f"{name}, {side}", s.drawn(side, T, scale), _bar(scale))
        for side in ("left", "right")
        for name, T in maps.items()
    ]
    writer = Writer(out, f"fig16{s.sitter.suffix}")
    writer.svg(page(panels, columns=3, title=f"Fig. 16  Side views: {s.sitter.title}"))
    writer.csv(_by_angle(v, maps))
    note = (
        "One view can only be looked at; `fig16` of the multi-view scans compares with the view that faces the cheek."
    )
    return writer.report("Side views of one frontal view", (), [note])


# ---------------------------------------------------------------- numbers


def _line_numbers(theta: dict[str, Float], changes: dict[tuple[str, str], Float]) -> list[Number]:
    numbers = []
    low, high = BAR_K
    for (where, model), change in changes.items():
        ok = np.isfinite(change) & (theta[where] <= MAX_ANGLE_DEG)
        barred = model != "cosine"
        bars = (low, high) if barred else (None, None)
        paper = "0.2 to 1.4" if barred else "over-compensated"
        numbers += [
            Number(f"correction along the {where}, {model}, smallest", float(change[ok].min()), "K", paper, *bars),
            Number(f"correction along the {where}, {model}, largest", float(change[ok].max()), "K", paper, *bars),
        ]
        if barred:
            grows = _growth(theta[where][ok], change[ok])
            what = f"correction at the steepest fifth of the {where} over the flattest, {model}"
            numbers.append(Number(what, grows, "x", "grows", 1.2))
    for where in theta:
        ratio = changes[where, "cosine"] / changes[where, "dielectric"]
        at = np.isfinite(ratio) & (np.abs(theta[where] - 45) < 5)
        value = float(np.median(ratio[at])) if at.any() else float("nan")
        numbers.append(
            Number(f"cosine's correction over dielectric's at 40-50°, {where}", value, "x", "over-compensated", 5)
        )
        numbers.append(Number(f"largest viewing angle along the {where}", float(np.nanmax(theta[where])), "°"))
    return numbers


def _growth(theta: Float, change: Float) -> float:
    """Mean correction of the steepest fifth of a line over that of the flattest."""
    order = np.argsort(theta, kind="stable")
    fifth = max(1, len(order) // 5)
    return float(change[order[-fifth:]].mean() / change[order[:fifth]].mean())


def _by_angle(view: View, maps: dict[str, Float]) -> dict[str, NDArray]:
    """Means of maps (V,) in bins of 5° of the viewing angle."""
    theta = view.angle_deg()
    centres = np.arange(2.5, MAX_ANGLE_DEG, 5.0)
    rows: dict[str, NDArray] = {"theta_deg": centres}
    inside = [np.flatnonzero(np.abs(theta - c) <= 2.5) for c in centres]
    rows["vertices"] = np.array([len(i) for i in inside])
    for name, T in maps.items():
        rows[name.replace("-", "_").replace(" ", "")] = np.array([T[i].mean() if len(i) else np.nan for i in inside])
    return rows


def _p95(x: Float) -> float:
    return float(np.nanpercentile(x, 95))


def _p95_p5(x: Float) -> float:
    lo, hi = np.nanpercentile(x, (5, 95))
    return float(hi - lo)


# ---------------------------------------------------------------- drawing


def _temperature(s: Sitting) -> Scale:
    """One scale for all of a sitter's temperatures: from the face's own, the same for raw and corrected."""
    on_head = np.unique(s.view.head().triangles)
    T = s.view.apparent_degC[on_head]
    lo, hi = np.nanpercentile(T, (5, 99.5))
    return Scale("inferno", float(np.floor(2 * lo) / 2), float(np.ceil(2 * hi + 0.6) / 2), "°C", "")


def _bar(scale: Scale) -> Bar:
    return Bar(scale.palette, scale.lo, scale.hi, scale.unit)


def _span(label: str, curves: list[Float]) -> Axis:
    """An axis that holds the curves, with room for a legend below."""
    lo, hi = float(np.nanmin(curves)), float(np.nanmax(curves))
    return Axis(label, np.floor(lo - 0.35 * (hi - lo)), np.ceil(hi), 1.0)


def _head_box(s: Sitting) -> tuple[slice, slice]:
    """The part of the thermal image that shows the head, rows and columns."""
    v = s.view
    on_head = np.unique(v.head().triangles)
    u, w = v.u_px[on_head], v.v_px[on_head]
    pad = 12
    rows = slice(max(int(np.nanmin(w)) - pad, 0), min(int(np.nanmax(w)) + pad, v.camera.height_px))
    return rows, slice(max(int(np.nanmin(u)) - pad, 0), min(int(np.nanmax(u)) + pad, v.camera.width_px))


def _thermal_picture(s: Sitting, scale: Scale) -> UInt8:
    """The thermal image itself, apparent temperature, on the scale from the room to the face."""
    from ..physics.band import ZERO_DEGC_K
    from ..physics.signal import SignalConverter

    assert s.scan.thermal is not None
    converter = SignalConverter(s.scan.thermal.camera)
    L = converter.radiance(s.scan.thermal.load(0)).astype(np.float64)
    return palettes.apply(converter.band.temperature_K(L) - ZERO_DEGC_K, scale.palette, scale.lo, scale.hi)
