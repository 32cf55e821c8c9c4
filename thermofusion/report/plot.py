"""A small SVG plot writer: Cartesian and polar plots, pictures with a colour bar, several panels on a page.

Text in, text out: the same data give the same bytes. Colours stay apart for colour-blind readers (Okabe and Ito).
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..export import palettes
from ..files.png import encode_png
from ..types import Float, UInt8
from ..version import __version__

BLUE, ORANGE, GREEN, PURPLE, SKY, AMBER, INK, GREY = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#a8559a",
    "#56b4e9",
    "#e0a000",
    "#222222",
    "#8a8a8a",
)
DASHED, DOTTED = "7 4", "2 4"
_FONT = "font-family=\"Helvetica, Arial, 'DejaVu Sans', sans-serif\""
_LETTER_PX = 6.8  # mean advance of a letter at 12 px
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 16.0, 38.0, 48.0  # px round a plot's frame
_BAR_PX = 74.0  # room for a colour bar
Corner = Literal["ne", "nw", "se", "sw"]


@dataclass(frozen=True)
class Axis:
    """A linear axis from lo to hi with a tick every `step`, all in the unit that the label gives."""

    label: str
    lo: float
    hi: float
    step: float

    @classmethod
    def spanning(cls, label: str, lo: float, hi: float) -> Axis:
        """An axis from lo to hi in the label's unit, with a round step that leaves at most nine ticks."""
        rough = (hi - lo) / 9
        power = 10.0 ** np.floor(np.log10(rough))
        return cls(label, lo, hi, float(next(power * s for s in (1, 2, 5, 10) if power * s >= rough)))

    def ticks(self) -> list[float]:
        """Values that carry a tick."""
        first = int(np.ceil(self.lo / self.step - 1e-9))
        return [i * self.step for i in range(first, int(np.floor(self.hi / self.step + 1e-9)) + 1)]

    def text(self, value: float) -> str:
        """A tick's label, with as many decimals as the step needs."""
        decimals = max(0, int(np.ceil(-np.log10(self.step) - 1e-9)))
        if abs(self.step * 10**decimals - round(self.step * 10**decimals)) > 1e-9:
            decimals += 1
        return f"{value:.{decimals}f}".replace("-", "−")

    def scaled(self, values: ArrayLike) -> Float:
        """Values, any shape and unit, as they lie along the axis."""
        return np.asarray(values, np.float64)


@dataclass(frozen=True)
class LogAxis(Axis):
    """A logarithmic axis from lo to hi > 0 with ticks at 1, 2 and 5 of every decade."""

    step: float = 1.0  # decades

    @classmethod
    def over(cls, label: str, values: ArrayLike) -> LogAxis:
        """An axis over a little more than positive values, any shape and unit."""
        lo, hi = float(np.log10(np.min(values))), float(np.log10(np.max(values)))
        margin = max(0.05 * (hi - lo), 0.05)
        return cls(label, 10 ** (lo - margin), 10 ** (hi + margin))

    def ticks(self) -> list[float]:
        """Values that carry a tick."""
        decades = range(int(np.floor(np.log10(self.lo))), int(np.ceil(np.log10(self.hi))) + 1)
        return [v for d in decades for m in (1, 2, 5) if self.lo <= (v := m * 10.0**d) <= self.hi]

    def text(self, value: float) -> str:
        """A tick's label: the number itself."""
        return f"{value:g}"

    def scaled(self, values: ArrayLike) -> Float:
        """Decimal logarithms of values, any shape and unit."""
        return np.log10(np.asarray(values, np.float64))


@dataclass(frozen=True, eq=False)
class Line:
    """A curve through x, y, each (N,) in the axes' units; it breaks at NaN. width : px."""

    x: ArrayLike
    y: ArrayLike
    color: str = INK
    label: str = ""
    dash: str = ""
    width: float = 2.0


@dataclass(frozen=True, eq=False)
class Area:
    """The area between two curves lo and hi over x, each (N,) in the axes' units."""

    x: ArrayLike
    lo: ArrayLike
    hi: ArrayLike
    color: str = GREEN
    label: str = ""
    opacity: float = 0.28


@dataclass(frozen=True, eq=False)
class Points:
    """Dots at x, y, each (N,) in the axes' units, with optional symmetric error bars (N,). radius : px."""

    x: ArrayLike
    y: ArrayLike
    color: str = INK
    label: str = ""
    error: ArrayLike | None = None
    radius: float = 3.0
    hollow: bool = False


@dataclass(frozen=True)
class Rule:
    """A thin line across the whole plot at one x or y."""

    at: float
    axis: Literal["x", "y"] = "y"
    color: str = GREY
    dash: str = DOTTED


Mark = Line | Area | Points | Rule


@dataclass(frozen=True, eq=False)
class Plot:
    """A Cartesian plot."""

    title: str
    x: Axis
    y: Axis
    marks: Sequence[Mark]
    legend: Corner = "ne"  # where it stands if no data lie there; else in another corner, or below the plot

    def draw(self, width: float, height: float, key: str) -> str:
        """SVG elements of the panel, width by height px, its origin at the top left. key : unique on the page."""
        w, h, legend = width - _LEFT - _RIGHT, height - _TOP - _BOTTOM, _Legend.of(self.marks)

        def at(x: ArrayLike, y: ArrayLike) -> tuple[NDArray, NDArray]:
            (x_lo, x_hi), (y_lo, y_hi) = (a.scaled([a.lo, a.hi]) for a in (self.x, self.y))
            return (
                _LEFT + w * (self.x.scaled(x) - x_lo) / (x_hi - x_lo),
                _TOP + h * (y_hi - self.y.scaled(y)) / (y_hi - y_lo),
            )

        corner = legend.free_corner(_drawn(self.marks, at), self.legend, (_LEFT, _TOP, w, h))
        if corner is None:  # `at` follows h
            h -= legend.height
        parts = [_text(_LEFT, 22, self.title, size=14, weight="600")]
        for v in self.x.ticks():
            px = float(at(v, self.y.lo)[0])
            parts.append(_segment(px, _TOP, px, _TOP + h, "#e7e7e7"))
            parts.append(_text(px, _TOP + h + 17, self.x.text(v), anchor="middle", size=11, color="#444"))
        for v in self.y.ticks():
            py = float(at(self.x.lo, v)[1])
            parts.append(_segment(_LEFT, py, _LEFT + w, py, "#e7e7e7"))
            parts.append(_text(_LEFT - 7, py + 4, self.y.text(v), anchor="end", size=11, color="#444"))
        clip = f'<clipPath id="{key}"><rect x="{_LEFT}" y="{_TOP}" width="{w:.1f}" height="{h:.1f}"/></clipPath>'
        parts.append(f'{clip}<g clip-path="url(#{key})">')
        for mark in self.marks:
            if isinstance(mark, Rule):
                ends = ([mark.at] * 2, [self.y.lo, self.y.hi])
                (x0, x1), (y0, y1) = at(*(ends if mark.axis == "x" else ([self.x.lo, self.x.hi], [mark.at] * 2)))
                parts.append(_segment(x0, y0, x1, y1, mark.color, mark.dash))
            else:
                parts.append(_mark(mark, at))
        parts.append("</g>")
        parts.append(f'<rect x="{_LEFT}" y="{_TOP}" width="{w:.1f}" height="{h:.1f}" fill="none" stroke="#555"/>')
        parts.append(_text(_LEFT + w / 2, _TOP + h + _BOTTOM - 10, self.x.label, anchor="middle", size=12))
        middle = _TOP + h / 2
        parts.append(_text(15, middle, self.y.label, anchor="middle", size=12, turn=f"rotate(-90 15 {middle:.1f})"))
        parts.append(legend.draw(*legend.place(corner, (_LEFT, _TOP, w, h))))
        return "".join(parts)


@dataclass(frozen=True, eq=False)
class Polar:
    """A half disc: radius over the angle from the vertical, both sides alike (x of the marks (N,) in degrees)."""

    title: str
    r: Axis
    marks: Sequence[Line | Area]
    angle_step_deg: float = 15.0

    def draw(self, width: float, height: float, key: str) -> str:
        """SVG elements of the panel, width by height px."""
        radius = min((width - 60) / 2, height - 110)
        cx, cy = width / 2, 58 + radius

        def at(theta_deg: ArrayLike, r: ArrayLike) -> tuple[NDArray, NDArray]:
            a = np.radians(np.asarray(theta_deg, np.float64))
            length = radius * (np.asarray(r, np.float64) - self.r.lo) / (self.r.hi - self.r.lo)
            return cx + length * np.sin(a), cy - length * np.cos(a)

        parts = [_text(_LEFT, 22, self.title, size=14, weight="600")]
        for v in self.r.ticks():
            rr = radius * (v - self.r.lo) / (self.r.hi - self.r.lo)
            if rr > 0:
                parts.append(
                    f'<path d="M{cx - rr:.1f} {cy:.1f}A{rr:.1f} {rr:.1f} 0 0 1 {cx + rr:.1f} {cy:.1f}"'
                    ' fill="none" stroke="#dddddd"/>'
                )
            parts.append(_text(cx + rr, cy + 16, self.r.text(v), anchor="middle", size=11, color="#444"))
        for angle in np.arange(-90, 90.1, self.angle_step_deg):
            (x0, x1), (y0, y1) = at([angle, angle], [self.r.lo, self.r.hi])
            parts.append(_segment(x0, y0, x1, y1, "#e2e2e2"))
            tx, ty = at(angle, self.r.lo + 1.07 * (self.r.hi - self.r.lo))
            parts.append(_text(float(tx), float(ty) + 4, f"{abs(angle):.0f}°", anchor="middle", size=11, color="#444"))
        for mark in self.marks:
            for side in (1.0, -1.0):

                def mirrored(x: ArrayLike, y: ArrayLike, side: float = side) -> tuple[NDArray, NDArray]:
                    return at(side * np.asarray(x, np.float64), y)

                parts.append(_mark(mark, mirrored))
        parts.append(_text(cx, cy + 36, self.r.label, anchor="middle", size=12))
        return "".join(parts)


@dataclass(frozen=True)
class Bar:
    """How a picture's values became colours."""

    palette: str
    lo: float
    hi: float
    unit: str


@dataclass(frozen=True, eq=False)
class Picture:
    """An image, rgb (H, W, 3) sRGB, with a title, lines and points over it (in its pixels), and a colour bar."""

    title: str
    rgb: UInt8
    bar: Bar | None = None
    marks: Sequence[Line | Points] = ()

    def draw(self, width: float, height: float, key: str) -> str:
        """SVG elements of the panel, width by height px."""
        rows, columns = self.rgb.shape[:2]
        room = width - 24 - (_BAR_PX if self.bar else 0)
        scale = min(room / columns, (height - _TOP - 14) / rows)
        w, h = columns * scale, rows * scale
        left = 12 + (room - w) / 2

        def at(x: ArrayLike, y: ArrayLike) -> tuple[NDArray, NDArray]:
            return left + (np.asarray(x, np.float64) + 0.5) * scale, _TOP + (np.asarray(y, np.float64) + 0.5) * scale

        parts = [_text(12, 22, self.title, size=14, weight="600"), _embed(self.rgb, left, _TOP, w, h)]
        parts += [_mark(mark, at) for mark in self.marks]
        if self.bar:
            parts.append(_color_bar(self.bar, left + w + 14, _TOP, min(h, 260.0)))
        return "".join(parts)


Panel = Plot | Polar | Picture


def page(
    panels: Sequence[Panel],
    *,
    title: str = "",
    caption: str = "",
    columns: int = 2,
    panel_px: tuple[float, float] = (470.0, 360.0),
) -> str:
    """An SVG document with the panels in rows, a title above and a caption (broken at newlines) below.

    columns : panels beside each other. panel_px : width and height of each.
    """
    pw, ph = panel_px
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    head = 44.0 if title else 8.0
    lines = caption.split("\n") if caption else []
    width, height = columns * pw + 16, head + rows * ph + 16 * len(lines) + (18 if lines else 8)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}"'
        f' viewBox="0 0 {width:.0f} {height:.0f}" {_FONT}>',
        f"<metadata>thermofusion {__version__}</metadata>",
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
    ]
    if title:
        parts.append(_text(20, 30, title, size=17, weight="700"))
    for i, panel in enumerate(panels):
        x, y = 8 + (i % columns) * pw, head + (i // columns) * ph
        parts.append(f'<g transform="translate({x:.1f} {y:.1f})">{panel.draw(pw, ph, f"clip{i}")}</g>')
    for i, line in enumerate(lines):
        parts.append(_text(20, head + rows * ph + 16 * (i + 1), line, size=11.5, color="#555"))
    return "\n".join([*parts, "</svg>\n"])


def csv_text(columns: Mapping[str, ArrayLike], digits: int = 6) -> str:
    """Columns, each (N,), as CSV with a head, numbers to so many digits; NaN is an empty cell.

    Raises ValueError where they are not equally long.
    """
    values = [np.asarray(v) for v in columns.values()]
    if len({len(v) for v in values}) > 1:
        raise ValueError("columns of a CSV file must be equally long")

    def cell(x: object) -> str:
        if isinstance(x, float | np.floating):
            return f"{x:.{digits}g}" if np.isfinite(x) else ""
        return str(x)

    rows = [",".join(columns), *(",".join(cell(x) for x in row) for row in zip(*values, strict=True))]
    return "\n".join(rows) + "\n"


# ---------------------------------------------------------------- elements


def _mark(mark: Line | Area | Points, at: Callable[[ArrayLike, ArrayLike], tuple[NDArray, NDArray]]) -> str:
    if isinstance(mark, Line):
        d = _path(*at(mark.x, mark.y))
        dash = f' stroke-dasharray="{mark.dash}"' if mark.dash else ""
        style = f'stroke="{mark.color}" stroke-width="{mark.width:g}" stroke-linejoin="round"{dash}'
        return f'<path d="{d}" fill="none" {style}/>'
    if isinstance(mark, Area):
        x = np.concatenate([np.asarray(mark.x, np.float64), np.asarray(mark.x, np.float64)[::-1]])
        y = np.concatenate([np.asarray(mark.lo, np.float64), np.asarray(mark.hi, np.float64)[::-1]])
        good = np.isfinite(y)
        return f'<path d="{_path(*at(x[good], y[good]))}Z" fill="{mark.color}" fill-opacity="{mark.opacity:g}"/>'
    px, py = at(mark.x, mark.y)
    error = np.full(np.shape(px), np.nan) if mark.error is None else np.asarray(mark.error, np.float64)
    up, down = at(mark.x, np.asarray(mark.y) + error)[1], at(mark.x, np.asarray(mark.y) - error)[1]
    parts = []
    for x, y, y0, y1 in zip(px, py, up, down, strict=True):
        if not np.isfinite(y):
            continue
        if np.isfinite(y0):
            parts.append(_segment(x, y0, x, y1, mark.color))
        parts.append(_dot(x, y, mark))
    return "".join(parts)


def _dot(x: float, y: float, mark: Points) -> str:
    fill = "#ffffff" if mark.hollow else mark.color
    return f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{mark.radius:g}" fill="{fill}" stroke="{mark.color}"/>'


def _path(x: NDArray, y: NDArray) -> str:
    good = np.isfinite(x) & np.isfinite(y)
    starts = good & ~np.r_[False, good[:-1]]
    pairs = zip(x[good], y[good], starts[good], strict=True)
    return "".join(f"{'M' if start else 'L'}{a:.2f} {b:.2f}" for a, b, start in pairs)


def _segment(x0: float, y0: float, x1: float, y1: float, color: str, dash: str = "") -> str:
    d = f' stroke-dasharray="{dash}"' if dash else ""
    return f'<line x1="{x0:.2f}" y1="{y0:.2f}" x2="{x1:.2f}" y2="{y1:.2f}" stroke="{color}"{d}/>'


def _text(
    x: float,
    y: float,
    text: str,
    *,
    size: float = 12,
    anchor: str = "start",
    weight: str = "400",
    color: str = INK,
    turn: str = "",
) -> str:
    turned = f' transform="{turn}"' if turn else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}" font-weight="{weight}"'
        f' fill="{color}"{turned}>{escape(text)}</text>'
    )


def _drawn(marks: Iterable[Mark], at: Callable[[ArrayLike, ArrayLike], tuple[NDArray, NDArray]]) -> NDArray:
    """(N, 2) px that marks cover, close enough together that none slips through a legend."""
    parts = [np.empty((0, 2))]
    for mark in marks:
        if isinstance(mark, Rule):
            continue
        if isinstance(mark, Points):
            y, error = np.asarray(mark.y, np.float64), 0.0 if mark.error is None else np.asarray(mark.error, np.float64)
            parts += [np.stack(at(mark.x, y + share * error), axis=-1) for share in np.linspace(-1, 1, 33)]
        elif isinstance(mark, Line):
            parts.append(_dense(np.stack(at(mark.x, mark.y), axis=-1)))
        else:
            lower, upper = (_dense(np.stack(at(mark.x, y), axis=-1)) for y in (mark.lo, mark.hi))
            parts += [lower + share * (upper - lower) for share in np.linspace(0, 1, 17)]
    found = np.concatenate(parts)
    return found[np.isfinite(found).all(axis=1)]


def _dense(curve: NDArray) -> NDArray:
    """A curve (N, 2) px with a point at least every few px."""
    steps = np.linspace(0, 1, 64, endpoint=False)[:, None, None]
    return np.concatenate([(curve[:-1] + steps * (curve[1:] - curve[:-1])).reshape(-1, 2), curve[-1:]])


@dataclass(frozen=True, eq=False)
class _Legend:
    """What the labelled marks mean, in a box that must not lie on data."""

    entries: Sequence[Line | Area | Points]

    @classmethod
    def of(cls, marks: Iterable[Mark]) -> _Legend:
        return cls([m for m in marks if not isinstance(m, Rule) and m.label])

    @property
    def width(self) -> float:
        return 44 + _LETTER_PX * max((len(m.label) for m in self.entries), default=0)

    @property
    def height(self) -> float:
        return 18.0 * len(self.entries) + 8

    def place(self, corner: Corner | None, frame: tuple[float, float, float, float]) -> tuple[float, float]:
        """Left and top px of the box in a corner of the frame (left, top, width, height), or below it and its axis."""
        left, top, w, h = frame
        if corner is None:
            return left, top + h + _BOTTOM - 4
        x = left + 8 if "w" in corner else left + w - self.width - 8
        return x, top + 8 if "n" in corner else top + h - self.height - 8

    def free_corner(self, drawn: NDArray, wanted: Corner, frame: tuple[float, float, float, float]) -> Corner | None:
        """The first corner, the wanted one first, where the box covers nothing drawn (N, 2) px; None: no corner."""
        corners: tuple[Corner, ...] = ("ne", "nw", "se", "sw")
        for corner in (wanted, *corners):
            x, y = self.place(corner, frame)
            near = (drawn > [x - 4, y - 4]) & (drawn < [x + self.width + 4, y + self.height + 4])
            if not self.entries or not near.all(axis=1).any():
                return corner
        return None

    def draw(self, x: float, y: float) -> str:
        """SVG of the box with its top left at x, y px."""
        if not self.entries:
            return ""
        parts = [
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{self.width:.1f}" height="{self.height:g}" rx="3" fill="#ffffff"'
            ' fill-opacity="0.86" stroke="#d5d5d5"/>'
        ]
        for i, m in enumerate(self.entries):
            my = y + 17 + 18 * i - 4
            if isinstance(m, Area):
                at = f'x="{x + 8:.1f}" y="{my - 5:.1f}"'
                parts.append(f'<rect {at} width="24" height="10" fill="{m.color}" fill-opacity="{m.opacity:g}"/>')
            elif isinstance(m, Line):
                dash = f' stroke-dasharray="{m.dash}"' if m.dash else ""
                parts.append(
                    f'<line x1="{x + 8:.1f}" y1="{my:.1f}" x2="{x + 32:.1f}" y2="{my:.1f}" stroke="{m.color}"'
                    f' stroke-width="{m.width:g}"{dash}/>'
                )
            else:
                parts.append(_dot(x + 20, my, m))
            parts.append(_text(x + 38, my + 4, m.label, size=12))
        return "".join(parts)


def _embed(rgb: UInt8, x: float, y: float, w: float, h: float) -> str:
    text = base64.b64encode(encode_png(rgb)).decode()
    return f'<image x="{x:.2f}" y="{y:.2f}" width="{w:.2f}" height="{h:.2f}" href="data:image/png;base64,{text}"/>'


def _color_bar(bar: Bar, x: float, y: float, height: float) -> str:
    rgb = palettes.apply(np.linspace(bar.hi, bar.lo, 256)[:, None], bar.palette, bar.lo, bar.hi)
    axis = Axis.spanning("", bar.lo, bar.hi)
    parts = [
        _embed(rgb, x, y, 14, height).replace("<image ", '<image preserveAspectRatio="none" '),
        f'<rect x="{x:.1f}" y="{y:.1f}" width="14" height="{height:.1f}" fill="none" stroke="#555"/>',
    ]
    for v in axis.ticks():
        ty = y + height * (bar.hi - v) / (bar.hi - bar.lo)
        parts.append(_segment(x + 14, ty, x + 18, ty, "#555"))
        parts.append(_text(x + 21, ty + 4, axis.text(v), size=11, color="#444"))
    parts.append(_text(x, y - 8, bar.unit, size=11, color="#444"))
    return "".join(parts)
