"""The Allan-type plot of a still recording: how far averaging helps."""

from __future__ import annotations

import numpy as np

from ...report.plot import BLUE, DASHED, GREY, ORANGE, Line, LogAxis, Mark, Plot, Points, page
from .noise import StillNoise


def allan_svg(noise: StillNoise) -> str:
    """Allan deviation of a pixel and of the image mean [mK] over the averaging time [s], as an SVG document."""
    good = (noise.allan_K > 0) & (noise.allan_mean_K > 0)
    x, y, common = noise.tau_s[good], *(1e3 * a[good] for a in (noise.allan_K, noise.allan_mean_K))
    white = y[0] * np.sqrt(x[0] / x)  # independent frames: down with the root of the time
    marks: list[Mark] = [
        Line(x, white, GREY, "independent frames", DASHED, 1.5),
        Line(x, y, BLUE),
        Points(x, y, BLUE, "a pixel"),
        Line(x, common, ORANGE),
        Points(x, common, ORANGE, "image mean"),
    ]
    axes = LogAxis.over("averaging time, s", x), LogAxis.over("deviation, mK", np.concatenate([y, white, common]))
    plot = Plot("Allan deviation", *axes, marks, legend="sw")
    caption = (
        f"NETD {noise.netd_K * 1e3:.1f} mK, drift {noise.drift_K_per_min:+.3f} K/min; averaging a pixel helps up to "
        f"{noise.best_tau_s:.3g} s; {noise.frames} frames in {noise.duration_s:.1f} s"
    )
    return page([plot], caption=caption, columns=1, panel_px=(640.0, 420.0))
