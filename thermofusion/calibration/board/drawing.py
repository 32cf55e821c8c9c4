"""A page of black shapes in millimetres, written as SVG or as PDF: vectors, true to scale, no library."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from xml.sax.saxutils import escape

import numpy as np

from ...types import Float

POINT_PER_MM = 72 / 25.4  # PDF's unit is the point, 1/72 inch
KAPPA = 0.5522847498  # handle length of the cubic that draws a quarter circle


@dataclass
class Page:
    """Shapes on a page of width x height mm; origin at the top left, y down."""

    width_mm: float
    height_mm: float
    title: str = ""
    polygons: list[Float] = field(default_factory=list)
    circles: list[tuple[float, float, float, bool]] = field(default_factory=list)  # x, y, radius, filled
    lines: list[tuple[float, float, float, float, float]] = field(default_factory=list)  # x1 y1 x2 y2 width
    texts: list[tuple[float, float, float, str]] = field(default_factory=list)  # x, baseline y, size, text

    def rectangle(self, x: float, y: float, w: float, h: float) -> None:
        """A black rectangle of w x h mm, its top left corner at (x, y) mm."""
        self.polygons.append(np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]]))

    def svg(self) -> str:
        """The page as a self-contained SVG document, sizes in mm."""
        w, h = _n(self.width_mm), _n(self.height_mm)
        out = [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}mm" height="{h}mm" viewBox="0 0 {w} {h}">',
            f"<title>{escape(self.title)}</title>",
            f'<rect width="{w}" height="{h}" fill="white"/>',
        ]
        for p in self.polygons:
            out.append('<polygon points="' + " ".join(f"{_n(x)},{_n(y)}" for x, y in p) + '"/>')
        for x, y, r, filled in self.circles:
            style = "" if filled else ' fill="none" stroke="black" stroke-width="0.15"'
            out.append(f'<circle cx="{_n(x)}" cy="{_n(y)}" r="{_n(r)}"{style}/>')
        for x1, y1, x2, y2, width in self.lines:
            ends = f'x1="{_n(x1)}" y1="{_n(y1)}" x2="{_n(x2)}" y2="{_n(y2)}"'
            out.append(f'<line {ends} stroke="black" stroke-width="{_n(width)}"/>')
        for x, y, size, text in self.texts:
            at = f'x="{_n(x)}" y="{_n(y)}"'
            out.append(
                f'<text {at} font-family="Helvetica,Arial,sans-serif" font-size="{_n(size)}">{escape(text)}</text>'
            )
        return "\n".join([*out, "</svg>", ""])

    def pdf(self) -> bytes:
        """The page as a one-page PDF 1.4."""
        body = ["0 g 0 G", f"{_n(POINT_PER_MM)} 0 0 {_n(-POINT_PER_MM)} 0 {_n(self.height_mm * POINT_PER_MM)} cm"]
        for p in self.polygons:
            body.append(" ".join(f"{_n(x)} {_n(y)} {'l' if i else 'm'}" for i, (x, y) in enumerate(p)) + " h f")
        for x, y, r, filled in self.circles:
            body.append(("" if filled else "0.15 w ") + _circle(x, y, r) + (" f" if filled else " S"))
        for x1, y1, x2, y2, width in self.lines:
            body.append(f"{_n(width)} w {_n(x1)} {_n(y1)} m {_n(x2)} {_n(y2)} l S")
        for x, y, size, text in self.texts:
            safe = text.encode("latin-1", "replace").decode("latin-1")
            for c in "\\()":
                safe = safe.replace(c, "\\" + c)
            body.append(f"BT /F1 {_n(size)} Tf 1 0 0 -1 {_n(x)} {_n(y)} Tm ({safe}) Tj ET")
        stream = "\n".join(body).encode("latin-1")
        box = f"[0 0 {_n(self.width_mm * POINT_PER_MM)} {_n(self.height_mm * POINT_PER_MM)}]"
        objects = [
            b"<< /Type /Catalog /Pages 2 0 R >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
            "/Resources << /Font << /F1 5 0 R >> >> >>".encode("latin-1"),
            b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        ]
        return _pdf_file(objects)


def _pdf_file(objects: list[bytes]) -> bytes:
    out, offsets = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"), []
    for number, content in enumerate(objects, 1):
        offsets.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, content)
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % o for o in offsets)
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)
    return bytes(out)


def _circle(x: float, y: float, r: float) -> str:
    k = KAPPA * r
    corners = [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 0)]
    out = [f"{_n(x + r)} {_n(y)} m"]
    for (ax, ay), (bx, by) in pairwise(corners):
        c1, c2 = (x + r * ax + k * bx, y + r * ay + k * by), (x + r * bx + k * ax, y + r * by + k * ay)
        out.append(f"{_n(c1[0])} {_n(c1[1])} {_n(c2[0])} {_n(c2[1])} {_n(x + r * bx)} {_n(y + r * by)} c")
    return " ".join(out)


def _n(value: float) -> str:
    """A number with at most four decimals, no exponent."""
    return f"{value:.4f}".rstrip("0").rstrip(".") or "0"
