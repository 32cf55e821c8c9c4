"""Pictures of a result: front, back, left, right, with a colour bar; drawn by ray casting, never with OpenGL.

Made to be measured in: temperatures are interpolated on the surface and averaged over the pixel, then coloured, so that
every colour inside the outline is one of the bar's; unmeasured skin is hatched; shading is off unless asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import ResourceError
from ..export import palettes
from ..export.axes import axes_of, axes_rotation
from ..files.whole import write_whole
from ..types import Float, Float32, SurfaceMesh, ThermalMesh, UInt8
from . import lettering
from .casts import RAYS, Cast, cast_views
from .lettering import INK, QUIET, Scale

UNMEASURED_RGB = ((226, 226, 226), (190, 190, 190))  # stripes falling to the left,
INSIDE_RGB = ((112, 112, 112), (84, 84, 84))  # and to the right: no palette can be mistaken for either
OUTLINE_RGB, OUTLINE_ALPHA = (40, 40, 44), 0.75  # sRGB and opacity of the line round contours
CREASE_PX = 10.0  # a step in depth of this many pixels is an edge: a slope of 84° is none
_LABELS = {"front": "front (toward the first camera)"}


def render_views(
    mesh: ThermalMesh,
    *,
    palette: str = "inferno",
    range_degC: tuple[float, float] | None = None,
    height_px: int = 900,
    shading: float = 0.0,
    casts: list[Cast] | None = None,
) -> dict[str, UInt8]:
    """Pictures of the temperature: `front`, `back`, `left`, `right` and all four as `overview`; (H, W, 3) sRGB.

    range_degC : None = `palettes.color_range`. shading : 0 = none, for measuring; 0.3 shows the shape. casts : of
    `cast_mesh`, where several maps of one surface are drawn or it is seen along other axes. Raises RecipeError,
    ValueError (no triangles).
    """
    lo, hi = palettes.color_range(mesh.temperature_degC, range_degC)
    level = "level anchored to a reference" if mesh.anchored else "level relative: no reference"
    what = {"absolute": "Skin temperature", "normal-equivalent": "Normal-equivalent temperature"}
    title = what.get(mesh.mode, "Apparent temperature")
    scale = Scale(palette, lo, hi, "°C", title, f"output {mesh.mode}; {level}", shading)
    return draw(casts or cast_mesh(mesh, height_px=height_px), mesh.temperature_degC, scale, height_px=height_px)


def render_scalar(mesh: ThermalMesh, values: NDArray, scale: Scale, *, height_px: int = 900) -> dict[str, UInt8]:
    """Pictures of any quantity (V,) in the scale's unit, NaN = none: angle, uncertainty, count, difference.

    (H, W, 3) sRGB and errors as of `render_views`.
    """
    return draw(cast_mesh(mesh, height_px=height_px), values, scale, height_px=height_px)


def difference_scale(values: NDArray, title: str, unit: str) -> Scale:
    """Blue-white-red about 0 for values of any shape, in `unit`; the range is a round number."""
    lo, hi = palettes.color_range(values, step=_round_step(values), symmetric=True)
    return Scale("difference", lo, hi, unit, title)


def write_views(
    mesh: ThermalMesh,
    folder: str | Path,
    *,
    palette: str = "inferno",
    range_degC: tuple[float, float] | None = None,
    height_px: int = 900,
    casts: list[Cast] | None = None,
) -> list[Path]:
    """Write `front.png` … `overview.png` into a folder, made if need be. Raises as `render_views`, ResourceError."""
    pictures = render_views(mesh, palette=palette, range_degC=range_degC, height_px=height_px, casts=casts)
    paths = [Path(folder) / f"{name}.png" for name in pictures]
    with ThreadPoolExecutor(max_workers=2) as pool:
        return list(pool.map(write_png, paths, pictures.values()))


def write_png(path: str | Path, image: UInt8) -> Path:
    """Write an RGB (H, W, 3) or grey (H, W) picture, whole or not at all, its folder made. Raises ResourceError."""
    path = Path(path)
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.size == 0:
        raise ValueError(f"a picture of shape {image.shape} and type {image.dtype} cannot be written")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ResourceError(f"the folder cannot be made ({e.strerror})", place=path.parent) from None
    _, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    return write_whole(path, [data.tobytes()])


# ---------------------------------------------------------------- drawing


def cast_mesh(
    mesh: ThermalMesh, *, height_px: int = 900, up: ArrayLike | None = None, front: ArrayLike | None = None
) -> list[Cast]:
    """The four views of a mesh, to draw several maps from.

    up, front : (3,) in the world frame, any length; None = the mesh's metadata, or else the first depth camera's frame
    (y down).
    """
    axes = axes_of(mesh.metadata)
    if up is not None or front is not None:
        axes = axes_rotation(axes[1] if up is None else up, axes[2] if front is None else front)
    return cast_surface(mesh.surface, axes, height_px=height_px)


def cast_surface(surface: SurfaceMesh, axes: Float, *, height_px: int = 900) -> list[Cast]:
    """The same before there are temperatures. axes : (3, 3) unit rows right, up and front (`export.axes_of`)."""
    return cast_views(surface, axes, height_px - _Page(height_px).chrome_px)


def draw(casts: list[Cast], values: NDArray, scale: Scale, *, height_px: int) -> dict[str, UInt8]:
    """One page (H, W, 3) sRGB per view, and `overview` with all of them side by side under one bar.

    values : (V,) in the scale's unit, NaN = unmeasured.
    """
    finite = values[np.isfinite(values)]
    beyond = bool((finite < scale.lo).any()), bool((finite > scale.hi).any())
    legend = ["unmeasured"] if len(finite) < len(values) else []
    legend += ["inside"] if any((cast.facing < 0).any() for cast in casts) else []
    page, px_per_m = _Page(height_px), casts[0].px_per_m
    with ThreadPoolExecutor(max_workers=2) as pool:
        painted = pool.map(lambda cast: paint(cast, values, scale), casts)
        panels = {cast.name: panel for cast, panel in zip(casts, painted, strict=True)}
        sheets = {name: {name: panel} for name, panel in panels.items()} | {"overview": panels}
        composed = pool.map(lambda sheet: page.compose(sheet, scale, beyond, legend, px_per_m), sheets.values())
        return dict(zip(sheets, composed, strict=True))


def paint(cast: Cast, values: NDArray, scale: Scale) -> UInt8:
    """The view alone, (H, W, 3) on white.

    A pixel is the share-weighted mix of what its rays meet: skin (their mean value, coloured), unmeasured skin
    (hatched), the surface's inside (dark: its temperature is the other side's), background; plus a thin outline.
    """
    value, inside = cast.interpolate(values), cast.facing < 0
    skin = ~inside & ~np.isnan(value)
    share = {"skin": cast.per_pixel(skin), "bare": cast.per_pixel(~inside & ~skin), "inside": cast.per_pixel(inside)}
    mean = cast.per_pixel(np.where(skin, value, 0)) / np.maximum(share["skin"], 1e-6)
    rgb = palettes.apply(mean, scale.palette, scale.lo, scale.hi) * share["skin"][..., None]
    if scale.shading > 0:
        lit = cast.per_pixel(np.where(skin, 1 - scale.shading * (1 - cast.facing), 0))
        rgb *= (lit / np.maximum(share["skin"], 1e-6))[..., None]
    rgb += share["bare"][..., None] * _hatch(cast.shape)
    rgb += share["inside"][..., None] * _hatch(cast.shape, inside=True)
    rgb += (1 - share["skin"] - share["bare"] - share["inside"])[..., None] * np.float32(255)
    line = _outline(cast)[..., None]
    painted: UInt8 = np.round(np.clip(rgb * (1 - line) + line * np.array(OUTLINE_RGB), 0, 255)).astype(np.uint8)
    return painted


def _outline(cast: Cast) -> Float32:
    """(H, W) opacity of the line round contours: on rays whose neighbour's surface stands well before theirs, so that
    the nearer side stays untouched.
    """
    depth = np.minimum(cast.distance_m, np.float32(1e6))  # the background is far, not infinitely
    step, line = np.float32(CREASE_PX / cast.px_per_m), np.zeros(depth.shape, bool)
    down, right = depth[1:] - depth[:-1], depth[:, 1:] - depth[:, :-1]
    line[1:] |= down > step
    line[:-1] |= down < -step
    line[:, 1:] |= right > step
    line[:, :-1] |= right < -step
    h, w = cast.shape
    return np.float32(OUTLINE_ALPHA) * line.reshape(h, RAYS, w, RAYS).any(axis=3).sum(axis=1, dtype=np.float32) / RAYS


def _hatch(shape: tuple[int, int], *, inside: bool = False) -> Float32:
    """Diagonal stripes (H, W, 3) of unmeasured skin, or of the surface seen from inside."""
    columns = np.arange(shape[1])
    stripe = (np.add.outer(np.arange(shape[0]), columns[::-1] if inside else columns) // 4) % 2
    return np.array(INSIDE_RGB if inside else UNMEASURED_RGB, np.float32)[stripe]


def _round_step(values: NDArray) -> float:
    """A step to round a range to: a fiftieth to a tenth of the values' spread, 1, 2 or 5 times a power of ten."""
    finite = values[np.isfinite(values)]
    spread = float(np.ptp(np.percentile(finite, (1, 99)))) if len(finite) else 0.0
    marks = lettering.ticks(0, spread, 20) if spread > 0 else [0.0, 0.5]
    return marks[1] - marks[0]


class _Page:
    """Where things stand on a page; all sizes follow its height."""

    def __init__(self, height_px: int) -> None:
        self.height, self.unit = height_px, height_px / 900
        self.top, self.bottom, self.side, self.bar = (self._px(x) for x in (104, 52, 28, 168))
        self.chrome_px = self.top + self.bottom

    def _px(self, at_900: float) -> int:
        return round(at_900 * self.unit)

    def compose(
        self,
        panels: Mapping[str, UInt8],
        scale: Scale,
        beyond: tuple[bool, bool],
        legend: list[str],
        px_per_m: float,
    ) -> UInt8:
        """Title above, panels side by side, bar at the right, a ruler below."""
        widths = [panel.shape[1] for panel in panels.values()]
        small, letters = 11 * self.unit, 15 * self.unit
        titles = max(lettering.text_width(scale.title, letters), lettering.text_width(scale.subtitle, small))
        ground = max(sum(widths) + self.side * (len(widths) - 1), titles + self.side - self.bar)
        image = np.full((self.height, self.side * 2 + ground + self.bar, 3), 255, np.uint8)
        lettering.write(image, scale.title, self.side, self._px(36), letters)
        lettering.write(image, scale.subtitle, self.side, self._px(61), small, QUIET)
        x = self.side + (ground - sum(widths) - self.side * (len(widths) - 1)) // 2
        for name, panel in panels.items():
            h, w = panel.shape[:2]
            image[self.top : self.top + h, x : x + w] = panel
            label = _LABELS.get(name, name) if len(panels) == 1 else name
            lettering.write(image, label, x + w / 2, self._px(92), small, align="center")
            x += w + self.side
        self._bar(image, scale, beyond, legend)
        self._ruler(image, px_per_m)
        return image

    def _bar(self, image: UInt8, scale: Scale, beyond: tuple[bool, bool], legend: list[str]) -> None:
        """The colour bar, and below it what the colours beside it mean."""
        x, y, side, size = image.shape[1] - self.bar + self._px(10), self._px(190), self._px(26), 12 * self.unit
        box = (x, y, side, self.height - y - self._px(170))
        below, above = beyond
        lettering.color_bar(image, box, scale, size, below=below, above=above)
        top = self.height - self._px(122)
        for name in legend:
            image[top : top + side, x : x + side] = _hatch((side, side), inside=name == "inside")
            cv2.rectangle(image, (x - 1, top - 1), (x + side, top + side), INK, max(self._px(1), 1))
            lettering.write(image, name, x + side + size * 0.9, top + (side + size) / 2, size)
            top += self._px(40)

    def _ruler(self, image: UInt8, px_per_m: float) -> None:
        """A length to go by: 1, 2 or 5 times a power of ten, about a tenth of the page's height."""
        marks = lettering.ticks(0, self.height / px_per_m, 9)
        length = marks[1] - marks[0]
        x0, y = self.side, self.height - self._px(24)
        x1 = x0 + round(length * px_per_m)
        thick = max(self._px(2), 1)
        cv2.line(image, (x0, y), (x1, y), INK, thick)
        for x in (x0, x1):
            cv2.line(image, (x, y - self._px(5)), (x, y + self._px(5)), INK, thick)
        name = f"{length * 100:g} cm" if length >= 0.01 else f"{length * 1000:g} mm"
        lettering.write(image, name, x1 + self._px(10), y + self._px(5), 11 * self.unit)
