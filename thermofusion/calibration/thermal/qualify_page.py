"""The page of a camera's qualification: figures with their methods, how the mean went, how even the source looks."""

from __future__ import annotations

from html import escape

import numpy as np

from ...report.plot import BLUE, Axis, Line, Panel, Picture, Plot, Rule, page
from ...report.skeleton import html_page
from .qualify import FIRST_S, Qualification, SourceFigures

SHOWN = 6  # recordings that are drawn
LEAST_SPAN_K = 0.02  # of the drawn axis
CLAIM = (
    "Terms after IEC 80601-2-59 and ISO/TR 13154; methods as written here. No limit of a standard was applied, and no "
    "conformity is claimed: sources, distances, warm-up and room of a test are the standards' own."
)


def qualify_page(found: Qualification) -> str:
    """The page's text, one HTML file."""
    sources = [["source", "°C", "frames", "error, K", "drift, K/min", "stability, mK", "uniformity, mK", "NETD, mK"]]
    for s in found.sources:
        drift = f"{s.drift_K_per_min:+.3f} ± {s.drift_sigma_K_per_min:.3f}"
        mK = [f"{1e3 * x:.1f}" for x in (s.stability_K, s.uniformity_K, s.netd_K)]
        sources.append([s.name, f"{s.degC:.2f}", str(s.frames), f"{s.error_K:+.3f}", drift, *mK])
    body = [
        "<h1>Thermal camera by itself</h1>",
        f"<p>{escape(CLAIM)}</p>",
        _table([["figure", "value", "how"], *_figures(found)]),
        "<h2>Sources</h2>",
        _table(sources),
        "<h2>Over time, and over the picture</h2>",
        page([p for s in found.sources[:SHOWN] for p in _panels(s)], columns=2, panel_px=(440.0, 320.0)),
    ]
    return html_page("thermofusion: thermal camera", "\n".join(body), style="td{text-align:left}")


def _figures(q: Qualification) -> list[list[str]]:
    """Rows (figure, value, how)."""
    events = [s.shutter for s in q.sources if s.shutter.events]
    rows = [
        [
            "laboratory accuracy",
            f"{q.accuracy_K:+.3f} K",
            f"largest mean error; the sources' own sigma {q.accuracy_sigma_K:.3f} K",
        ],
        ["drift", f"{q.drift_K_per_min:+.3f} K/min", "slope of the mean over a recording, the steepest"],
        ["stability", f"{1e3 * q.stability_K:.1f} mK", "one sigma of the frames' means about that slope, the largest"],
        [
            "uniformity",
            f"{1e3 * q.uniformity_K:.1f} mK",
            "one sigma of the pixels' means over time, noise taken off, the largest",
        ],
        ["NETD", f"{1e3 * q.netd_K:.1f} mK", "noise of a pixel, from differences of frames, the largest"],
    ]
    if q.repeatability_freedom:
        how = f"one sigma of recordings at one temperature, {q.repeatability_freedom} degrees of freedom"
        rows.append(["repeatability", f"{1e3 * q.repeatability_K:.1f} mK", how])
    for side, value in q.resolvable_K.items():
        how = f"two areas of {side} x {side} px in one frame, told apart at 95 %, fixed pattern included"
        rows.append(["minimum resolvable difference", f"{1e3 * value:.0f} mK", how])
    for p in q.pairs:
        how = f"{p.second} less {p.first}, {p.true_K:.3f} K; told in one frame from {1e3 * p.resolvable_K:.0f} mK on"
        rows.append(["difference of two sources", f"{p.error_K:+.3f} K of error", how])
    if events:
        jump = max(e.jump_K for e in events)
        first = max((e.first_K for e in events), key=abs)
        rows.append(["response to the shutter", f"{1e3 * jump:.0f} mK", "rms step of the mean across it, the largest"])
        rows.append(["", f"{1e3 * first:+.0f} mK", f"first {FIRST_S:g} s after it, less the rest of the stretch"])
    return rows


def _panels(s: SourceFigures) -> list[Panel]:
    """The mean over time, and the source as it looks."""
    reach = max(float(np.abs(s.means_K - s.means_K.mean()).max()), LEAST_SPAN_K / 2)
    x = Axis.spanning("time, s", 0.0, float(s.times_s[-1]))
    y = Axis.spanning(
        "mean less source, K", float(s.means_K.mean()) - 1.2 * reach, float(s.means_K.mean()) + 1.2 * reach
    )
    line = Plot(s.name, x, y, [Line(s.times_s, s.means_K, BLUE, width=1.2), Rule(float(s.means_K.mean()))])
    spread = 3 * float(np.nanstd(s.map_K)) + 1e-9
    grey = np.nan_to_num(255 * (0.5 + s.map_K / (2 * spread)), nan=0.0)
    rgb = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    return [line, Picture(f"{s.name}: black to white {2e3 * spread:.0f} mK", rgb)]


def _table(rows: list[list[str]]) -> str:
    head = "".join(f"<th>{escape(c)}</th>" for c in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows[1:])
    return f"<table><tr>{head}</tr>{body}</table>"
