"""Pictures of a result: front, back, left, right, with a colour bar; drawn by ray casting, never with OpenGL.

Made to be measured in: temperatures are interpolated on the surface and averaged over the pixel, then coloured, and
shaded so lightly that a colour stays its own on the bar; unmeasured skin is hatched. Each page says whose it is, what
is known of the level, how the values spread, what lies outside the colours, and where the subject's right and left are.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import ResourceError
from ..export import palettes
from ..export.axes import axes_of, axes_rotation
from ..export.palettes import Beyond, beyond_range, percent
from ..files.png import encode_png
from ..files.whole import write_whole
from ..types import Float, Float32, SurfaceMesh, ThermalMesh, UInt8
from . import lettering
from .casts import RAYS, Cast, cast_views
from .lettering import ALERT, INK, LEFT_TO_RIGHT, QUIET, Scale

HEIGHT_PX = 900  # of a page; all sizes on it follow
SHADING = 0.12  # of pages of a result: seen at 45°, a colour loses 4 % of its light; at the very edge 12 %
SHAPE_SHADING = 0.75  # of geometry alone, where no colour is to be read
SHAPE_RGB = (222, 220, 214)  # of a surface without colour
RESIDUAL_RANGE = (0.0, 3.0)  # sigmas: beyond 3 a vertex is flagged HIGH_RESIDUAL
UNMEASURED_RGB = ((226, 226, 226), (190, 190, 190))  # stripes falling to the left,
INSIDE_RGB = ((112, 112, 112), (84, 84, 84))  # and to the right: no palette can be mistaken for either
OUTLINE_RGB, OUTLINE_ALPHA = (40, 40, 44), 0.75  # sRGB and opacity of the line round contours
CREASE_PX = 10.0  # a step in depth of this many pixels is an edge: a slope of 84° is none
_LABELS = {"left": "left side", "right": "right side"}
_OUTLINES: WeakKeyDictionary[Cast, Float32] = WeakKeyDictionary()  # go with their views
_SIDES = {"front": ("R", "L"), "back": ("L", "R")}  # of the subject, at the picture's left and right


def render_views(
    mesh: ThermalMesh,
    *,
    palette: str = "inferno",
    range_degC: tuple[float, float] | None = None,
    height_px: int = HEIGHT_PX,
    shading: float = SHADING,
    casts: list[Cast] | None = None,
) -> dict[str, UInt8]:
    """Pictures of the temperature: `front`, `back`, `left`, `right` and all four as `overview`; (H, W, 3) sRGB.

    Where nothing is measured they show the shape alone. range_degC : None = `palettes.color_range`. shading : 0 = none.
    casts : of `cast_mesh`, where several maps of one surface are drawn or it is seen along other axes. Raises
    RecipeError, ValueError (no triangles).
    """
    casts = casts or cast_mesh(mesh, height_px=height_px)
    if not mesh.measured.any():
        return draw_shape(casts, mesh, height_px=height_px)
    scale = replace(_temperature_scale(mesh, palette, range_degC), shading=shading)
    alert = "" if range_degC is None else beyond_range(mesh.temperature_degC, *range_degC)
    return draw(casts, mesh.temperature_degC, scale, height_px=height_px, alert=alert)


def render_scalar(mesh: ThermalMesh, values: NDArray, scale: Scale, *, height_px: int = HEIGHT_PX) -> dict[str, UInt8]:
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
    height_px: int = HEIGHT_PX,
    casts: list[Cast] | None = None,
) -> list[Path]:
    """Write `front.png` … `overview.png`, and, where they are known, `uncertainty.png`, `residual.png` and
    `motion.png`.

    The folder is made if need be. Raises as `render_views`, ResourceError.
    """
    casts = casts or cast_mesh(mesh, height_px=height_px)
    pictures = render_views(mesh, palette=palette, range_degC=range_degC, height_px=height_px, casts=casts)
    for name, (values, scale) in _doubts(mesh).items():
        pictures[name] = draw(casts, values, scale, height_px=height_px, overview_only=True)["overview"]
    paths = [Path(folder) / f"{name}.png" for name in pictures]
    whose = {k.capitalize(): str(mesh.metadata[k]) for k in ("scan", "run") if k in mesh.metadata}
    with ThreadPoolExecutor(max_workers=2) as pool:
        return list(pool.map(partial(write_png, texts=whose), paths, pictures.values()))


def write_png(path: str | Path, image: UInt8, texts: Mapping[str, str] = MappingProxyType({})) -> Path:
    """Write an RGB (H, W, 3) or grey (H, W) picture, whole or not at all, its folder made. Raises ResourceError.

    texts : by keyword, kept in the file.
    """
    path = Path(path)
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.size == 0:
        raise ValueError(f"a picture of shape {image.shape} and type {image.dtype} cannot be written")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ResourceError(f"the folder cannot be made ({e.strerror})", place=path.parent) from None
    return write_whole(path, [encode_png(image, texts)])


# ---------------------------------------------------------------- drawing


def cast_mesh(
    mesh: ThermalMesh, *, height_px: int = HEIGHT_PX, up: ArrayLike | None = None, front: ArrayLike | None = None
) -> list[Cast]:
    """The four views of a mesh, to draw several maps from.

    up, front : (3,) in the world frame, any length; None = the mesh's metadata, or else the first depth camera's frame
    (y down).
    """
    axes = axes_of(mesh.metadata)
    if up is not None or front is not None:
        axes = axes_rotation(axes[1] if up is None else up, axes[2] if front is None else front)
    return cast_surface(mesh.surface, axes, height_px=height_px)


def cast_surface(surface: SurfaceMesh, axes: Float, *, height_px: int = HEIGHT_PX) -> list[Cast]:
    """The same before there are temperatures. axes : (3, 3) unit rows right, up and front (`export.axes_of`)."""
    return cast_views(surface, axes, height_px - _Page(height_px).chrome_px)


def draw(
    casts: list[Cast],
    values: NDArray,
    scale: Scale,
    *,
    height_px: int,
    alert: str = "",
    overview_only: bool = False,
) -> dict[str, UInt8]:
    """One page (H, W, 3) sRGB per view, and `overview` with all of them side by side under one bar.

    values : (V,) in the scale's unit, NaN = unmeasured. alert : a warning that stands under the title.
    """
    legend = ["unmeasured"] if np.isnan(values).any() else []
    legend += ["inside"] if any((cast.facing < 0).any() for cast in casts) else []
    with ThreadPoolExecutor(max_workers=2) as pool:
        painted = dict(zip([c.name for c in casts], pool.map(lambda c: paint(c, values, scale), casts), strict=True))
    heading = [scale.title, *scale.subtitle.split("\n"), alert]
    page = _Page(height_px, heading, scale, Beyond.of(values, scale.lo, scale.hi), legend)
    return page.sheets(painted, casts[0].px_per_m, overview_only=overview_only)


def draw_shape(casts: list[Cast], mesh: ThermalMesh, *, height_px: int) -> dict[str, UInt8]:
    """The pages (H, W, 3) sRGB of a surface without temperatures: its colour if it has one, shaded, no colour bar."""
    surface, axes = mesh.surface, axes_of(mesh.metadata)
    size_cm = 100 * np.ptp(surface.vertices_m @ axes.T, axis=0)
    extent = f"{size_cm[1]:.0f} cm high, {size_cm[0]:.0f} cm wide, {size_cm[2]:.0f} cm deep; {len(surface):,} vertices"
    heading = ["Shape", "no temperature was measured", _whose(mesh), extent]
    painted = {cast.name: _paint_shape(cast, surface) for cast in casts}
    return _Page(height_px, heading).sheets(painted, casts[0].px_per_m)


def _temperature_scale(mesh: ThermalMesh, palette: str, range_degC: tuple[float, float] | None) -> Scale:
    T, (lo, hi) = mesh.temperature_degC, palettes.color_range(mesh.temperature_degC, range_degC)
    names = {"absolute": "Skin temperature", "normal-equivalent": "Temperature as seen straight on"}
    known = {
        "absolute": "emissivity and reflection corrected",
        "normal-equivalent": "corrected for oblique view, not for emissivity and reflection",
        "apparent": "as a camera shows it that takes skin for a blackbody; nothing corrected",
    }[mesh.mode]
    title = names.get(mesh.mode, "Apparent temperature")
    if mesh.mode == "apparent":
        level = ""
    elif mesh.anchored:
        level = f"; level set by a reference{_level_sigma(mesh)}"
    else:
        title += ": relative, its level is unknown"
        level = "; differences on the body hold, °C as such do not: no reference set the level"
    low, middle, high = np.percentile(T[mesh.measured], (1, 50, 99))
    sigma = np.nanmedian(mesh.uncertainty_K) if np.isfinite(mesh.uncertainty_K).any() else np.nan
    spread = f"median {middle:.2f} °C; 98 % of the skin within {low:.2f} to {high:.2f} °C"
    spread += f"; median sigma {sigma:.3f} K between places" if np.isfinite(sigma) else ""
    unit = "°C" if mesh.anchored or mesh.mode == "apparent" else "°C, relative"
    return Scale(palette, lo, hi, unit, title, f"{known}{level}\n{_whose(mesh)}\n{spread}")


def _doubts(mesh: ThermalMesh) -> dict[str, tuple[Float32, Scale]]:
    """Name of the picture -> values (V,) and scale: how sure a temperature is, and how well the views agree."""
    maps = {}
    sigma_K, residual = mesh.uncertainty_K, mesh.residual
    if np.isfinite(sigma_K).any():
        low, middle, most, high = np.nanpercentile(sigma_K, (1, 50, 95, 99))
        hi = palettes.color_range(np.array([0.0, most]), step=_round_step(np.array([0.0, most])))[1]
        level = f"the level that all share adds{_level_sigma(mesh)}" if mesh.anchored else "the level is unknown"
        about = f"one sigma between places; {level}\n{_whose(mesh)}\n"
        about += f"median {middle:.3f} K; 98 % of the skin within {low:.3f} to {high:.3f} K"
        maps["uncertainty"] = sigma_K, Scale("cividis", 0.0, hi, "K", "Uncertainty of the temperature", about, SHADING)
    if residual is not None and np.isfinite(residual).any():
        much = float((residual[np.isfinite(residual)] > RESIDUAL_RANGE[1]).mean())
        about = (
            "rms of the views about a place's mean, in sigmas of their own errors: 1 is as expected; striped: fewer "
        )
        about += f"than two views\n{_whose(mesh)}\n"
        about += f"median {np.nanmedian(residual):.2f}; beyond 3 (hair, clothes, movement): {percent(much)}"
        scale = Scale("cividis", *RESIDUAL_RANGE, "sigmas", "How well the views agree", about, SHADING)
        maps["residual"] = residual, scale
    if mesh.moved_mm is not None:
        maps["motion"] = mesh.moved_mm, _motion_scale(mesh, mesh.moved_mm)
    return maps


def _motion_scale(mesh: ThermalMesh, moved_mm: Float32) -> Scale:
    """Of the picture of how much the subject moved (V,) mm."""
    half, most, high = np.percentile(moved_mm, (50, 95, 99))
    hi = palettes.color_range(np.array([0.0, high]), step=_round_step(np.array([0.0, high])))[1]
    about = f"rms against the trunk while it was recorded; what is shown is at rest\n{_whose(mesh)}\n"
    about += f"median {half:.1f} mm; a twentieth by more than {most:.1f} mm"
    return Scale("cividis", 0.0, hi, "mm", "How the subject moved", about, SHADING)


def _level_sigma(mesh: ThermalMesh) -> str:
    """` ±0.10 K`, of the level that all vertices share, where the mesh states it."""
    parts = [float(v) for k, v in mesh.metadata.items() if k.startswith("level_sigma_K_")]
    return f" ±{np.hypot.reduce(parts):.2f} K" if parts else ""


def _whose(mesh: ThermalMesh) -> str:
    """Name, day, recipe and room, as far as the mesh states them."""
    known = {
        k: " ".join(str(mesh.metadata[k]).split())
        for k in ("scan", "recorded_at", "recipe", "room")
        if mesh.metadata.get(k)
    }
    name, recipe = known.get("scan", ""), known.get("recipe", "")
    name = name if len(name) <= 60 else name[:59] + "…"
    day = known.get("recorded_at", "")[:16].replace("T", " ")
    name += LEFT_TO_RIGHT if name else ""
    return "; ".join(x for x in (name, day, recipe and f"recipe {recipe}", known.get("room", "")) if x)


def paint(cast: Cast, values: NDArray, scale: Scale) -> UInt8:
    """The view alone, (H, W, 3) on white.

    A pixel is the share-weighted mix of what its rays meet: skin (their mean value, coloured), unmeasured skin
    (hatched), the surface's inside (dark: its temperature is the other side's), background; plus a thin outline.
    """
    value, inside = cast.interpolate(values), cast.facing < 0
    skin = ~inside & ~np.isnan(value)
    share = {"skin": cast.per_pixel(skin), "bare": cast.per_pixel(~inside & ~skin), "inside": cast.per_pixel(inside)}
    total, line = cast.per_pixel(np.where(skin, value, 0)), _outline(cast)
    # most of a picture is background, and stays white
    at = np.flatnonzero((share["skin"] + share["bare"] + share["inside"] + line).ravel())
    share = {k: s.ravel()[at] for k, s in share.items()}
    some = np.maximum(share["skin"], 1e-6)
    rgb = palettes.apply(total.ravel()[at] / some, scale.palette, scale.lo, scale.hi) * share["skin"][:, None]
    if scale.shading > 0:
        lit = cast.per_pixel(np.where(skin, 1 - scale.shading * (1 - cast.facing), 0))
        rgb *= (lit.ravel()[at] / some)[:, None]
    for kind in ("bare", "inside"):
        if share[kind].any():
            rgb += share[kind][:, None] * _hatch(cast.shape, inside=kind == "inside").reshape(-1, 3)[at]
    rgb += (1 - share["skin"] - share["bare"] - share["inside"])[:, None] * np.float32(255)
    painted = np.full((*cast.shape, 3), 255, np.uint8)
    painted.reshape(-1, 3)[at] = _lined(rgb, line.reshape(-1, 1)[at])
    return painted


def _paint_shape(cast: Cast, surface: SurfaceMesh) -> UInt8:
    """The view (H, W, 3) of the surface's own colour, or of one light colour, darker where it turns away."""
    if surface.color_rgb is None:
        rgb = np.broadcast_to(np.array(SHAPE_RGB, np.float32), (len(cast.pixel), 3))
    else:
        rgb = np.stack([cast.interpolate(channel) for channel in surface.color_rgb.T], axis=1)
    inside = cast.facing < 0
    lit = np.where(inside, 0, 1 - SHAPE_SHADING * (1 - cast.facing))
    share, line = [cast.per_pixel(~inside)[..., None], cast.per_pixel(inside)[..., None]], _outline(cast)[..., None]
    page = np.stack([cast.per_pixel(rgb[:, c] * lit) for c in range(3)], axis=-1)
    page += share[1] * _hatch(cast.shape, inside=True) + (1 - share[0] - share[1]) * np.float32(255)
    return _lined(page, line)


def _lined(rgb: NDArray, line: Float32) -> UInt8:
    """Colours (..., 3) under a line of opacity (..., 1)."""
    return np.asarray(np.round(np.clip(rgb * (1 - line) + line * np.array(OUTLINE_RGB), 0, 255)), np.uint8)


def _outline(cast: Cast) -> Float32:
    """(H, W) opacity of the line round contours: on rays whose neighbour's surface stands well before theirs, so that
    the nearer side stays untouched. Found once for all maps of a view.
    """
    found = _OUTLINES.get(cast)
    if found is None:
        found = _OUTLINES[cast] = _found_outline(cast)
    return found


def _found_outline(cast: Cast) -> Float32:
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
    """What stands on a page round its panels, and where; all sizes follow its height."""

    def __init__(
        self,
        height_px: int,
        heading: list[str] | None = None,
        scale: Scale | None = None,
        beyond: Beyond | None = None,
        legend: list[str] | None = None,
    ) -> None:
        self.height, self.unit = height_px, height_px / HEIGHT_PX
        self.heading, self.scale, self.beyond, self.legend = heading or [], scale, beyond, legend or []
        self.top, self.bottom, self.side = (self._px(x) for x in (152, 52, 28))
        self.bar = self._px(176) if scale is not None else 0
        self.chrome_px = self.top + self.bottom
        self.letters, self.small = 15 * self.unit, 10.5 * self.unit

    def _px(self, at_900: float) -> int:
        return round(at_900 * self.unit)

    def sheets(self, painted: Mapping[str, UInt8], px_per_m: float, *, overview_only: bool = False) -> dict[str, UInt8]:
        """Every panel on its own page, and all on `overview`."""
        pages = {} if overview_only else {name: {name: panel} for name, panel in painted.items()}
        pages["overview"] = dict(painted)
        with ThreadPoolExecutor(max_workers=2) as pool:
            composed = pool.map(lambda panels: self._composed(panels, px_per_m), pages.values())
            return dict(zip(pages, composed, strict=True))

    def _composed(self, panels: Mapping[str, UInt8], px_per_m: float) -> UInt8:
        """Heading above, panels side by side, bar at the right, a ruler below."""
        widths = [panel.shape[1] for panel in panels.values()]
        panels_px = sum(widths) + self.side * (len(widths) - 1)
        sizes = [self.letters, *[self.small] * len(self.heading)]
        text_px = max((lettering.text_width(t, s) for t, s in zip(self.heading, sizes, strict=False)), default=0)
        ground = max(panels_px, text_px + self.side - self.bar)
        image = np.full((self.height, self.side * 2 + ground + self.bar, 3), 255, np.uint8)
        self._heading(image, sizes)
        x = self.side + (ground - panels_px) // 2
        for name, panel in panels.items():
            h, w = panel.shape[:2]
            image[self.top : self.top + h, x : x + w] = panel
            label, base = _LABELS.get(name, name), self.top - self._px(10)
            lettering.write(image, label, x + w / 2, base, self.small, align="center")
            for letter, at in zip(_SIDES.get(name, ()), (x + self._px(8), x + w - self._px(8)), strict=False):
                lettering.write(image, letter, at, base, self.letters, align="center")
            x += w + self.side
        if self.scale is not None:
            self._bar(image, self.scale)
        self._ruler(image, px_per_m, bool(panels.keys() & _SIDES.keys()))
        return image

    def _heading(self, image: UInt8, sizes: list[float]) -> None:
        colors = [INK, *[QUIET] * 3, ALERT]
        rows = zip(self.heading, sizes, colors, (36, 60, 80, 100, 120), strict=False)
        for text, size, rgb, base in rows:
            lettering.write(image, text, self.side, self._px(base), size, rgb)

    def _bar(self, image: UInt8, scale: Scale) -> None:
        """The colour bar, and below it what the colours beside it mean."""
        x, y, side, size = image.shape[1] - self.bar + self._px(10), self._px(222), self._px(26), 12 * self.unit
        box = (x, y, side, self.height - y - self._px(190))
        lettering.color_bar(image, box, scale, size, self.beyond)
        top = self.height - self._px(116)
        for name in self.legend:
            image[top : top + side, x : x + side] = _hatch((side, side), inside=name == "inside")
            cv2.rectangle(image, (x - 1, top - 1), (x + side, top + side), INK, max(self._px(1), 1))
            lettering.write(image, name, x + side + size * 0.9, top + (side + size) / 2, size)
            top += self._px(40)

    def _ruler(self, image: UInt8, px_per_m: float, sided: bool) -> None:
        """A length to go by: 1, 2 or 5 times a power of ten, about a tenth of the page's height; and what R, L mean."""
        marks = lettering.ticks(0, self.height / px_per_m, 9)
        length = marks[1] - marks[0]
        x0, y = self.side, self.height - self._px(24)
        x1 = x0 + round(length * px_per_m)
        thick = max(self._px(2), 1)
        cv2.line(image, (x0, y), (x1, y), INK, thick)
        for x in (x0, x1):
            cv2.line(image, (x, y - self._px(5)), (x, y + self._px(5)), INK, thick)
        name = f"{length * 100:g} cm" if length >= 0.01 else f"{length * 1000:g} mm"
        name += "     R, L: the subject's right and left" if sided else ""
        lettering.write(image, name, x1 + self._px(10), y + self._px(5), self.small)
