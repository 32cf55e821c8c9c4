"""The Allan-type plot of a still recording: how far averaging helps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...report.plot import BLUE, DASHED, GREY, ORANGE, Axis, Line, Mark, Plot, Points, page
from ...types import Float
from .noise import StillNoise


@dataclass(frozen=True)
class LogAxis(Axis):
    """An axis of powers of ten: lo, hi and the data in log10, ticks at 1, 2 and 5 of every decade."""

    def ticks(self) -> list[float]:
        """Values (log10) that carry a tick."""
        decades = range(int(np.floor(self.lo)), int(np.ceil(self.hi)) + 1)
        values = [np.log10(m) + d for d in decades for m in (1, 2, 5)]
        return [float(v) for v in values if self.lo - 1e-9 <= v <= self.hi + 1e-9]

    def text(self, value: float) -> str:
        """A tick's label: the number itself."""
        return f"{10**value:g}"


def allan_svg(noise: StillNoise) -> str:
    """Allan deviation of a pixel and of the image mean [mK] over the averaging time [s], as an SVG document."""
    good = (noise.allan_K > 0) & (noise.allan_mean_K > 0)
    x, y, common = np.log10(noise.tau_s[good]), *(np.log10(a[good] * 1e3) for a in (noise.allan_K, noise.allan_mean_K))
    white = y[0] - 0.5 * (x - x[0])  # independent frames: down with the root of the time
    marks: list[Mark] = [
        Line(x, white, GREY, "independent frames", DASHED, 1.5),
        Line(x, y, BLUE),
        Points(x, y, BLUE, "a pixel"),
        Line(x, common, ORANGE),
        Points(x, common, ORANGE, "image mean"),
    ]
    lo, hi = _span(np.concatenate([y, white, common]))
    plot = Plot(
        "Allan deviation",
        LogAxis("averaging time, s", *_span(x), 1.0),
        LogAxis("deviation, mK", lo, hi, 1.0),
        marks,
        legend="sw",
    )
    caption = (
        f"NETD {noise.netd_K * 1e3:.1f} mK, drift {noise.drift_K_per_min:+.3f} K/min; averaging a pixel helps up to "
        f"{noise.best_tau_s:.3g} s; {noise.frames} frames in {noise.duration_s:.1f} s"
    )
    return page([plot], caption=caption, columns=1, panel_px=(640.0, 420.0))


def _span(values: Float) -> tuple[float, float]:
    """A little more than the values cover."""
    lo, hi = float(np.min(values)), float(np.max(values))
    margin = max(0.05 * (hi - lo), 0.05)
    return lo - margin, hi + margin
