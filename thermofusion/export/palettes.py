"""False colours for temperatures: 256-step sRGB tables, applied to values, never to colours.

Each palette is a polyline in sRGB, written `index:rrggbb`. `inferno` (van der Walt & Smith 2015, CC0) and `cividis`
(Nuñez, Anderton & Renslow 2018, doi:10.1371/journal.pone.0199239, published for free use) follow the authors' tables
within 1/255; their lightness rises steadily, so equal steps in temperature look equal, to colour-blind eyes too. `iron`
is the instrument makers' habit. `rainbow` invents edges where there are none (Borland & Taylor 2007): see `WARNINGS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RecipeError
from ..types import UInt8

PaletteName = Literal["inferno", "iron", "grey", "cividis", "rainbow"]

_POLYLINES = {
    "inferno": """0:000004 2:010106 6:02020e 15:0a0722 26:180c3c 40:2f0a5b 48:3d0965 54:470b6a 64:57106e 88:7d1e6d
        110:a02a63 132:c13a50 144:d24644 166:ea632a 175:f1711f 189:f8890c 193:fa9008 199:fb9b06 202:fca108 209:fcae12
        222:f9c72f 232:f5db4c 241:f1ec6d 246:f2f482 251:f6fa96 255:fcffa4""",
    "cividis": """0:00224e 20:003070 23:013271 28:123570 33:1c396f 44:2d416d 53:38476c 86:585e6d 134:828079 151:928d78
        171:a69c74 191:bbad6d 219:d9c55c 233:e8d24f 244:f5dc41 251:fde334 255:fee838""",
    "grey": "0:0a0a0a 255:fafafa",
    "iron": "0:00000a 28:1f0060 64:6b0099 104:b41a8a 136:dc4646 168:f07a10 204:fab414 232:fde65a 255:fffff0",
    "rainbow": "0:1a1a99 51:1a80ff 102:19d0c0 140:40c940 178:e6e619 217:ff8c1a 255:cc1a1a",
    "difference": "0:08306b 48:2171b5 92:9ecae1 128:f7f7f7 164:fcae91 208:cb181d 255:67000d",  # signed, 0 = white
}
PALETTES: tuple[str, ...] = get_args(PaletteName)  # what a recipe may name
WARNINGS = {"rainbow": "the rainbow palette shows edges that are not in the data; use it only to match older pictures"}
UNMEASURED_RGB = (168, 168, 168)  # sRGB: a grey that no coloured palette holds
UNMEASURED_ON_GREY_RGB = (96, 128, 176)  # the grey and cividis palettes pass through grey: unmeasured skin is bluish
MUCH_BEYOND = 0.05  # share of the skin outside a chosen range that is worth a sentence: 2 % are outside by default
DEFAULT_RANGE_DEGC = (20.0, 40.0)  # where nothing is measured


@cache
def table(name: str) -> UInt8:
    """The palette's (256, 3) uint8 sRGB table. Raises RecipeError for a name that does not exist."""
    if name not in _POLYLINES:
        raise RecipeError(f"there is no palette '{name}'", hint=f"choose one of {', '.join(PALETTES)}")
    points = [point.split(":") for point in _POLYLINES[name].split()]
    at = [int(index) for index, _ in points]
    rgb = np.array([list(bytes.fromhex(color)) for _, color in points])
    steps = np.stack([np.interp(np.arange(256), at, channel) for channel in rgb.T], axis=1)
    steps = np.round(steps).astype(np.uint8)
    steps.setflags(write=False)
    return steps


def unmeasured_rgb(name: str) -> tuple[int, int, int]:
    """The colour of unmeasured skin beside a palette: grey, or bluish where the palette itself passes through grey."""
    return UNMEASURED_ON_GREY_RGB if name == "grey" else UNMEASURED_RGB


def apply(values: ArrayLike, palette: str, lo: float, hi: float, nan_rgb: tuple[int, int, int] | None = None) -> UInt8:
    """Values of any shape to sRGB uint8 (..., 3); linear from `lo` to `hi`, clipped, NaN becomes `nan_rgb`."""
    v = np.asarray(values, np.float32)
    rgb = table(palette)[palette_index(v, lo, hi)]
    unmeasured = np.array(unmeasured_rgb(palette) if nan_rgb is None else nan_rgb, np.uint8)
    return np.where(np.isnan(v)[..., None], unmeasured, rgb)


def palette_index(values: NDArray, lo: float, hi: float) -> UInt8:
    """The table's row, an index, for values of any shape; NaN gives 0. Raises RecipeError unless lo < hi."""
    if not (np.isfinite(lo) and np.isfinite(hi) and lo < hi):
        raise RecipeError(f"a colour range needs low < high, got {lo} to {hi}")
    scaled = (np.nan_to_num(values, nan=lo) - np.float32(lo)) * np.float32(255 / (hi - lo))
    return np.round(np.clip(scaled, 0, 255)).astype(np.uint8)


def color_range(
    values: NDArray, given: tuple[float, float] | None = None, *, step: float = 0.5, symmetric: bool = False
) -> tuple[float, float]:
    """The range to show: `given`, else 1st to 99th percentile of values (any shape), rounded outward to `step`.

    In the unit of values. symmetric : about 0, for differences. With nothing measured: `DEFAULT_RANGE_DEGC`.
    """
    if given is not None:
        palette_index(np.zeros(0, np.float32), *given)  # the same complaint about low >= high
        return float(given[0]), float(given[1])
    finite = values[np.isfinite(values)]
    if not len(finite):
        return DEFAULT_RANGE_DEGC
    lo, hi = np.percentile(finite, (1, 99)).tolist()
    if symmetric:
        lo, hi = -max(abs(lo), abs(hi)), max(abs(lo), abs(hi))
    lo, hi = np.floor(lo / step) * step, np.ceil(hi / step) * step
    return (float(lo), float(hi)) if lo < hi else (float(lo - step), float(hi + step))


@dataclass(frozen=True)
class Beyond:
    """What lies outside a range: below and above it, each (share of the values there are, the farthest value)."""

    below: tuple[float, float] = (0.0, 0.0)
    above: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, values: NDArray, lo: float, hi: float) -> Beyond:
        """Of values of any shape and the range lo to hi, in their unit; NaN does not count."""
        finite = values[np.isfinite(values)]
        if not len(finite):
            return cls()
        below, above = float((finite < lo).mean()), float((finite > hi).mean())
        return cls((below, float(finite.min())), (above, float(finite.max())))


def percent(share: float) -> str:
    """A share in percent, never rounded to nothing."""
    return "under 0.1 %" if share < 5e-4 else f"{100 * share:.1f} %" if share < 0.095 else f"{100 * share:.0f} %"


def beyond_range(values: NDArray, lo: float, hi: float) -> str:
    """What of temperatures (any shape, °C) a chosen colour range does not show, in a clause; empty: hardly anything."""
    beyond = Beyond.of(values, lo, hi)
    if beyond.below[0] + beyond.above[0] < MUCH_BEYOND:
        return ""
    sides = ((beyond.below, "colder", "down"), (beyond.above, "warmer", "up"))
    said = [f"{percent(x)} of the skin is {side} ({way} to {end:.1f} °C)" for (x, end), side, way in sides if x > 0]
    return f"the colours run from {lo:g} to {hi:g} °C, but {' and '.join(said)}"


def srgb_to_linear(srgb: UInt8) -> NDArray[np.float32]:
    """sRGB bytes of any shape to linear light, 0..1 (IEC 61966-2-1)."""
    c = np.arange(256) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return linear[srgb]
