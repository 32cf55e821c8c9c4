"""Figs. 11-16: a face from one depth and thermal pair, and the same figures for a phantom head.

Pictures of the real face show an identifiable person: they are written to the user's folder only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..export import palettes
from ..report.casts import Cast, cast_views
from ..report.lettering import Scale
from ..report.pictures import paint
from ..report.plot import BLUE, GREY, ORANGE, Axis, Bar, Line, Picture, Plot, Points
from ..types import Float, Int
from .laboratory import FACE_ROOM_DEGC, first_picture_degC
from .models import SKIN
from .prepared import Case, Prepared
from .report import Figure, Number
from .singleview import BackProjection, View, first_view

MAX_ANGLE_DEG = 65.0  # the recipe's limit
LINE_HALF_ROWS = 1  # a profile is the mean of three rows
BAR_K = (0.1, 1.6)  # of the correction along the lines; the paper: 0.2-1.4
PICTURE_PX = 420  # height of a drawn head
SIDES = ("front", "left", "right")


def face(prepared: Prepared) -> list[Figure]:
    """Figs. 11-16 of the paper's own face. Raises ScanError where the recording is unusable."""
    return _figures(Sitting.of(prepared.face, "-face", "the paper's face", {"forehead": 112, "cheeks": 168}))


def head(prepared: Prepared) -> list[Figure]:
    """The same of a phantom head (CC0)."""
    return _figures(Sitting.of(prepared.head_once, "-head", "a phantom head", {"forehead": 92, "cheeks": 155}))


def _figures(s: Sitting) -> list[Figure]:
    return [_figure11(s), _figure12(s), _figure13(s), _figure14(s), _figure15(s), _figure16(s)]


@dataclass(frozen=True, eq=False)
class Sitting:
    """A face, fused, and what all of its figures share.

    suffix : of its files. rows_px : image rows of the two lines (forehead; nose and cheeks). head : vertices that are
    drawn, indices. scale : of all temperatures, raw and corrected. maps : "uncorrected" and each model -> (V,) °C.
    """

    suffix: str
    title: str
    rows_px: dict[str, int]
    case: Case
    view: View
    pixels: BackProjection
    casts: dict[str, Cast]
    head: Int
    scale: Scale
    maps: dict[str, Float]

    @classmethod
    def of(cls, case: Case, suffix: str, title: str, rows_px: dict[str, int]) -> Sitting:
        """From the case's first thermal view."""
        view = first_view(case.result, case.scan, FACE_ROOM_DEGC)
        surface = view.head()
        casts = cast_views(surface, view.axes, PICTURE_PX, views=SIDES)
        vertices = np.unique(surface.triangles)
        lo, hi = np.nanpercentile(view.apparent_degC[vertices], (5, 99.5))
        scale = Scale("inferno", float(np.floor(2 * lo) / 2), float(np.ceil(2 * hi + 0.6) / 2), "°C", "")
        maps = {"uncorrected": view.apparent_degC} | {name: view.paper_degC(model) for name, model in SKIN.items()}
        pixels, named = BackProjection.of(view), {c.name: c for c in casts}
        return cls(suffix, title, rows_px, case, view, pixels, named, vertices, scale, maps)

    def drawn(self, title: str, side: str, values: NDArray, scale: Scale | None = None) -> Picture:
        """The head from one side, coloured by values (V,) °C, or what the scale says."""
        scale = scale or self.scale
        return Picture(title, paint(self.casts[side], values, scale), _bar(scale))

    def line(self, where: str, values: NDArray) -> Float:
        """A per-vertex quantity (V,), any unit, along a row of the thermal image, (W,) px."""
        image, row = self.pixels.image(values), self.rows_px[where]
        return np.asarray(image[row - LINE_HALF_ROWS : row + LINE_HALF_ROWS + 1].mean(axis=0))


# ---------------------------------------------------------------- the figures


def _figure11(s: Sitting) -> Figure:
    """Surface, thermal image, projected grid, overlay."""
    v = s.view
    seen = np.flatnonzero(np.isfinite(v.apparent_degC))
    every = seen[:: max(1, len(seen) // 4000)]
    grid = Points(v.u_px[every], v.v_px[every], "#2f9e44", radius=0.6)
    empty = np.full((*v.camera.shape, 3), 255, np.uint8)
    shape, grey = np.full(len(v.surface), 1.0, np.float32), Scale("grey", 0.0, 1.1, "", "", shading=1.0)
    room = replace(s.scale, lo=FACE_ROOM_DEGC - 3)
    image = palettes.apply(first_picture_degC(s.case.scan), room.palette, room.lo, room.hi)
    note = (
        "The authors' per-pixel field is added, and the picture shifted until the wall reads the paper's 23 °C: "
        f"{s.case.shift_K:+.1f} K. Without the shift every correction is a third smaller."
    )
    return Figure(
        f"fig11{s.suffix}",
        "Surface and thermal image",
        [
            Picture("(a) surface", paint(s.casts["front"], shape, grey)),
            Picture("(b) thermal image", image, _bar(room)),
            Picture("(c) surface grid in thermal pixels", empty, None, [grid]),
            Picture("(d) overlay", image, _bar(room), [grid]),
        ],
        {"": {"vertex": seen, "u_px": v.u_px[seen], "v_px": v.v_px[seen], "apparent_degC": v.apparent_degC[seen]}},
        [
            Number("vertices of the surface", float(len(v.surface))),
            Number("vertices that the thermal camera saw", float(len(seen))),
        ],
        [note] if s.case.shift_K else [],
        f"Fig. 11  Surface and thermal image: {s.title}",
    )


def _figure12(s: Sitting) -> Figure:
    """The raw thermal map, front and sides."""
    return Figure(
        f"fig12{s.suffix}",
        "Raw 3D thermal map",
        [s.drawn(f"{side}, uncorrected", side, s.view.apparent_degC) for side in SIDES],
        {"": _by_angle(s.view, {"apparent_degC": s.view.apparent_degC})},
        heading=f"Fig. 12  Raw 3D thermal map: {s.title}",
        columns=3,
    )


def _figure13(s: Sitting) -> Figure:
    """The viewing angle by the camera's axis (Eq. 28) and by the pixel's ray."""
    v = s.view
    axis, ray = v.angle_deg(axis=True), v.angle_deg()
    angle, signed = Scale("cividis", 0, 75, "°", ""), Scale("difference", -15, 15, "°", "")
    ok = np.flatnonzero(np.isfinite(ray))
    off = np.abs(axis - ray)[s.head]
    error = np.abs(v.linear_degC(SKIN["dielectric"], axis=True) - v.linear_degC(SKIN["dielectric"]))[s.head]
    p95 = float(np.nanpercentile(error, 95))
    note = "Eq. 28 takes the angle to the camera's axis; what decides ε is the angle to the ray that reaches the pixel."
    return Figure(
        f"fig13{s.suffix}",
        "Viewing angle",
        [
            s.drawn("axis of the camera (Eq. 28)", "front", axis, angle),
            s.drawn("the pixel's own ray", "front", ray, angle),
            s.drawn("axis less ray", "front", axis - ray, signed),
        ],
        {"": {"vertex": ok, "axis_deg": axis[ok], "ray_deg": ray[ok]}},
        [
            Number("|axis − ray|, median", float(np.nanmedian(off)), "°"),
            Number("|axis − ray|, largest", float(np.nanmax(off)), "°"),
            Number("error of the corrected temperature by the axis, 95th percentile", p95, "K"),
        ],
        [note],
        f"Fig. 13  Viewing angle: {s.title}",
        columns=3,
    )


def _figure14(s: Sitting) -> Figure:
    """The map corrected by the three models, front and side, and by radiance."""
    raw = s.view.apparent_degC
    maps = {name: s.maps[name] for name in SKIN}
    maps["radiance, dielectric"] = s.view.radiance_degC(SKIN["dielectric"])
    said = {"dielectric": "effective", "non-dielectric": "slightly stronger", "cosine": "over-compensated"}
    oblique = s.head[s.view.angle_deg()[s.head] > 50]
    change = {name: float(np.nanmean((maps[name] - raw)[oblique])) for name in SKIN}
    numbers = [Number(f"mean change beyond 50°, {name}", change[name], "K", said[name]) for name in SKIN]
    numbers += [Number("spread (5th to 95th percentile), uncorrected", _spread_K(raw[s.head]), "K")]
    numbers += [Number(f"spread, {name}", _spread_K(T[s.head]), "K") for name, T in maps.items()]
    return Figure(
        f"fig14{s.suffix}",
        "Three corrected maps",
        [s.drawn(f"{name}, {side}", side, T) for name, T in maps.items() for side in ("front", "left")],
        {"": _by_angle(s.view, {name.replace(", ", "_"): T for name, T in maps.items()} | {"apparent": raw})},
        numbers,
        heading=f"Fig. 14  Corrected 3D thermal maps (Eqs. 25-27): {s.title}",
        columns=4,
        panel_px=(330, 300),
    )


def _figure15(s: Sitting) -> Figure:
    """Back-projection into the thermal image, profiles along two lines, and the correction's size."""
    v = s.view
    maps = {name: s.maps[name] for name in _LINES}
    u = np.arange(v.camera.width_px, dtype=np.float64)
    theta = {w: s.line(w, v.angle_deg()) for w in s.rows_px}
    changes = {(w, m): s.line(w, v.linear_degC(SKIN[m]) - v.apparent_degC) for w in s.rows_px for m in SKIN}
    box = _head_box(s)
    x = Axis("thermal image column [px]", box[1].start, box[1].stop, 50)
    panels: list[Picture | Plot] = [*_back_projected(s, maps, box)]
    table: dict[str, NDArray] = {"column_px": u.astype(int)}
    for letter, w in zip("bd", s.rows_px, strict=True):
        along = {m: s.line(w, T) for m, T in maps.items()}
        curves = [Line(u, y, *_LINES[m]) for m, y in along.items()]
        panels.append(Plot(f"({letter}) {w}", x, _span("T [°C]", list(along.values())), curves, "sw"))
        table |= {f"{w}_theta_deg": theta[w]} | {f"{w}_{m}_degC": y for m, y in along.items()}
        table |= {f"{w}_eq25_{m}_K": changes[w, m] for m in SKIN}
        table |= {f"{w}_eqs25_27_{m}_K": s.line(w, s.maps[m] - v.apparent_degC) for m in SKIN}
    marks = [
        Line(u, changes[w, m], _TONE[w], f"{w}, {m}", dash)
        for w in s.rows_px
        for m, dash in (("dielectric", ""), ("non-dielectric", "6 3"))
    ]
    panels.append(Plot("(f) correction, Eq. 25", x, Axis("Ts − T [K]", 0, 2.2, 0.2), marks, "ne"))
    keep = np.flatnonzero(np.isfinite(theta["forehead"]) | np.isfinite(theta["cheeks"]))
    return Figure(
        f"fig15{s.suffix}",
        "Profiles along forehead and cheeks",
        panels,
        {"": {k: c[keep] for k, c in table.items()}},
        _line_numbers(theta, changes),
        _NOTES15,
        f"Fig. 15  Profiles along two lines: {s.title}",
        columns=3,
        panel_px=(400, 330),
    )


_TONE = {"forehead": "#1971ff", "cheeks": "#2fb344"}
_LINES: dict[str, tuple[str, str] | tuple[str, str, str]] = {
    "uncorrected": (GREY, "uncorrected", "5 3"),
    "dielectric": (BLUE, "dielectric"),
    "non-dielectric": (ORANGE, "non-dielectric", "8 3 2 3"),
}
_NOTES15 = (
    "(f) is Eq. 25 alone. With the scaling of Eqs. 26-27 the correction is zero by construction where the face looks "
    "at the camera; the paper's smallest value of 0.2 °C is what Eq. 25 gives there (ΔT = 10 K, 1 − ε = 0.02), so "
    "its Fig. 15(f) can only be Eq. 25.",
)


def _figure16(s: Sitting) -> Figure:
    """The side view of the raw and of the corrected maps."""
    maps = {name: s.maps[name] for name in _LINES}
    note = (
        "One view can only be looked at; `fig16` of the multi-view scans compares with the view that faces the cheek."
    )
    return Figure(
        f"fig16{s.suffix}",
        "Side views of one frontal view",
        [s.drawn(f"{name}, {side}", side, T) for side in ("left", "right") for name, T in maps.items()],
        {"": _by_angle(s.view, maps)},
        notes=[note],
        heading=f"Fig. 16  Side views: {s.title}",
        columns=3,
    )


# ---------------------------------------------------------------- numbers


def _line_numbers(theta: dict[str, Float], changes: dict[tuple[str, str], Float]) -> list[Number]:
    numbers = []
    for (where, model), change in changes.items():
        ok = np.isfinite(change) & (theta[where] <= MAX_ANGLE_DEG)
        barred = model != "cosine"
        bars = BAR_K if barred else (None, None)
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
        what = f"cosine's correction over dielectric's at 40-50°, {where}"
        numbers.append(Number(what, value, "x", "over-compensated", 5))
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


def _spread_K(x: Float) -> float:
    lo, hi = np.nanpercentile(x, (5, 95))
    return float(hi - lo)


# ---------------------------------------------------------------- drawing


def _back_projected(s: Sitting, maps: dict[str, Float], box: tuple[slice, slice]) -> list[Picture]:
    """Each map in the thermal image, with the two lines."""
    width = box[1].stop - box[1].start
    marks = [Line([0, width - 1], [row - box[0].start] * 2, _TONE[w], width=1.6) for w, row in s.rows_px.items()]
    scale, panels = s.scale, []
    for letter, (name, T) in zip("ace", maps.items(), strict=True):
        rgb = palettes.apply(s.pixels.image(T), scale.palette, scale.lo, scale.hi, nan_rgb=(235, 235, 235))[box]
        panels.append(Picture(f"({letter}) {name}", rgb, _bar(scale), marks))
    return panels


def _bar(scale: Scale) -> Bar:
    return Bar(scale.palette, scale.lo, scale.hi, scale.unit)


def _span(label: str, curves: list[Float]) -> Axis:
    """An axis that holds the curves, with room for a legend below."""
    lo, hi = float(np.nanmin(curves)), float(np.nanmax(curves))
    return Axis(label, np.floor(lo - 0.35 * (hi - lo)), np.ceil(hi), 1.0)


def _head_box(s: Sitting) -> tuple[slice, slice]:
    """The part of the thermal image that shows the head, rows and columns."""
    v, pad = s.view, 12
    u, w = v.u_px[s.head], v.v_px[s.head]
    rows = slice(max(int(np.nanmin(w)) - pad, 0), min(int(np.nanmax(w)) + pad, v.camera.height_px))
    return rows, slice(max(int(np.nanmin(u)) - pad, 0), min(int(np.nanmax(u)) + pad, v.camera.width_px))
