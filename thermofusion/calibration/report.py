"""The calibration report: one HTML file that works from disk and asks for nothing from outside."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from ..report.plot import Area, Axis, Mark, Plot, Points, Rule, page
from ..report.skeleton import html_page
from ..types import Float
from .fit.cameras import INTRINSIC_NAMES, SHIFT, TURN, to_rt
from .fit.coverage import coverage
from .fit.rig import Calibration
from .rig_file import figures

WIDTH = 420  # px, of an embedded picture
COLORS = {"color": "#1f6feb", "thermal": "#d1242f", "depth": "#1a7f37"}
STYLE = """.warn{background:#fff8c5;padding:.4rem .8rem;border-left:4px solid #d4a72c}
figure{display:inline-block;margin:.5rem 1rem .5rem 0;vertical-align:top}figcaption{font-size:.85rem;color:#57606a}
svg{background:#fff;border:1px solid #d0d7de}"""


def report_html(
    calibration: Calibration,
    *,
    advice: Sequence[str] = (),
    pictures: Mapping[str, NDArray[np.uint8]] | None = None,
    date: str | None = None,
) -> str:
    """The report's text. pictures : caption -> (H, W, 3) RGB of the points found, embedded as they are."""
    f = figures(calibration)
    body = [
        "<h1>Calibration report</h1>",
        f"<p>{escape(date)}</p>" if date else "",
        "".join(f'<p class="warn">{escape(n)}</p>' for n in calibration.notes),
        _summary(calibration, f),
        "<h2>Cameras</h2>",
        _cameras(calibration),
        "<h2>Rig</h2>",
        _extrinsics(calibration),
        "<h2>Residuals and coverage</h2>",
        _plots(calibration, f),
        _worst_views(f),
        "<h2>What to record next</h2>",
        "<ul>" + "".join(f"<li>{escape(a)}</li>" for a in advice) + "</ul>" if advice else "<p>Nothing is missing.</p>",
        "<h2>Points found</h2>" if pictures else "",
        *(_picture(caption, image) for caption, image in (pictures or {}).items()),
    ]
    return html_page("thermofusion calibration", "\n".join(b for b in body if b), style=STYLE)


def _summary(calibration: Calibration, f: dict) -> str:
    rows = [["camera", "views", "alone, px rms", "joint, px rms"]]
    for c in calibration.single:
        views = len(calibration.data.seen_by(c))
        rows.append([c, str(views), f"{f['alone_rms_px'][c]:.3f}", f"{f['joint_rms_px'][c]:.3f}"])
    out = _table(rows)
    spacing = f"{1e3 * calibration.spacing_m:.3f} mm"
    if calibration.spacing_sigma_m > 0:
        spacing += f" ± {1e3 * calibration.spacing_sigma_m:.3f} (from depth)"
    out += f"<p>Board spacing {spacing}. Joint fit {'converged' if f['converged'] else 'did not converge'}.</p>"
    if calibration.grouping is not None and calibration.grouping.count > 1:
        rows = [["state of the rig", "views", "thermal, px rms"]]
        for k, (names, rms) in enumerate(zip(f["groups"], f["group_rms_px"], strict=True)):
            mark = " (reported)" if k == calibration.chosen_group else ""
            rows.append([f"{names[0]} to {names[-1]}{mark}", str(len(names)), f"{rms:.3f}"])
        out += _table(rows)
    return out


def _cameras(calibration: Calibration) -> str:
    rows = [["", *(f"{c} [95 %]" for c in calibration.cameras)]]
    fit = calibration.fit
    for i, name in enumerate(INTRINSIC_NAMES):
        digits = 2 if i < 4 else 5
        row = [name]
        for c in calibration.cameras:
            value, sigma = fit.block(c)[i], float(np.sqrt(fit.block_covariance(c)[i, i]))
            row.append(f"{value:.{digits}f} ± {1.96 * sigma:.{digits}f}" if sigma > 0 else f"{value:.{digits}f} held")
        rows.append(row)
    return _table(rows)


def _extrinsics(calibration: Calibration) -> str:
    rows = [["", "rotation vector, deg", "95 %", "translation, mm", "95 %"]]
    for name, T in calibration.extrinsics.items():
        rt = to_rt(T) * np.array([180 / np.pi] * 3 + [1e3] * 3)
        s = 1.96 * np.sqrt(np.diag(calibration.extrinsic_covariance[name])) * np.array([180 / np.pi] * 3 + [1e3] * 3)
        rows.append([name, _list(rt[TURN], 3), _list(s[TURN], 3), _list(rt[SHIFT], 2), _list(s[SHIFT], 2)])
    return _table(rows)


def _plots(calibration: Calibration, f: dict) -> str:
    """Residuals of every camera, by view and of the depth, and where the board was seen: one sheet of plots."""
    panels = [_residual_scatter(calibration, c) for c in calibration.fit.problem.cameras]
    panels.append(_by_view(calibration, f))
    panels += [] if calibration.fit.problem.depth is None else [_depth_plot(calibration)]
    panels += [_coverage_plot(calibration, c) for c in calibration.single]
    return page(panels, columns=2, panel_px=(440.0, 340.0))


def _residual_scatter(calibration: Calibration, camera: str) -> Plot:
    e, _ = calibration.fit.residuals()[camera]
    reach = max(float(np.percentile(np.abs(e), 99)), 0.1)
    x, y = Axis.spanning("right, px", -reach, reach), Axis.spanning("down, px", -reach, reach)
    inside = e[(np.abs(e) <= reach).all(axis=1)]
    marks: list[Mark] = [Rule(0.0, "x"), Rule(0.0), Points(inside[:, 0], inside[:, 1], COLORS[camera], radius=1.2)]
    return Plot(f"{camera}: projected minus seen", x, y, marks)


def _by_view(calibration: Calibration, f: dict) -> Plot:
    views = list(f["views_rms_px"].items())
    top = max((v for _, row in views for v in row.values()), default=1.0)
    marks: list[Mark] = []
    for c in calibration.fit.problem.cameras:
        at = [i for i, (_, row) in enumerate(views, 1) if c in row]
        marks.append(Points(at, [views[i - 1][1][c] for i in at], COLORS[c], c))
    x = Axis.spanning("view, in order of recording", 0, len(views) + 1)
    return Plot("rms by view", x, Axis.spanning("px", 0, 1.1 * top), marks)


def _worst_views(f: dict) -> str:
    rms = [(v, name, c) for name, row in f["views_rms_px"].items() for c, v in row.items()]
    worst = ", ".join(f"{escape(name)} ({c}, {v:.2f} px)" for v, name, c in sorted(rms, reverse=True)[:3])
    return f"<p>Largest rms of a view: {worst}.</p>" if worst else ""


def _depth_plot(calibration: Calibration) -> Plot:
    problem = calibration.fit.problem
    assert problem.depth is not None
    r, _ = calibration.fit.residuals()["depth_plane"]
    value, mm = problem.depth.value, r * problem.depth.sigma * 1e3
    reach = max(float(np.percentile(np.abs(mm), 99)), 1e-3)
    pick = slice(None, None, max(1, len(value) // 3000))
    x = Axis.spanning("reported value", float(value.min()), max(float(value.max()), float(value.min()) + 1e-6))
    marks: list[Mark] = [Rule(0.0), Points(value[pick], mm[pick], COLORS["depth"], radius=1.2)]
    return Plot("depth minus board plane", x, Axis.spanning("mm", -reach, reach), marks)


def _coverage_plot(calibration: Calibration, camera: str) -> Plot:
    """Where the board was seen; thirds of the picture in which it never was are tinted."""
    w, h = calibration.fit.problem.sizes[camera]
    px = np.concatenate([v.points[camera].px for v in calibration.data.seen_by(camera)])
    marks: list[Mark] = [
        Area([w * i / 3, w * (i + 1) / 3], [h * (2 - j) / 3] * 2, [h * (3 - j) / 3] * 2, "#d1242f", opacity=0.15)
        for j, i in np.argwhere(coverage(calibration, camera).counts == 0)
    ]
    marks.append(Points(px[:, 0], h - px[:, 1], COLORS[camera], radius=1.2))
    x, y = Axis.spanning("px from the left", 0, w), Axis.spanning("px from the bottom", 0, h)
    return Plot(f"{camera}: where the board was seen; red: never", x, y, marks)


def _picture(caption: str, image: NDArray[np.uint8]) -> str:
    ok, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 80])
    if not ok:
        return ""
    text = base64.b64encode(data.tobytes()).decode("ascii")
    return _figure(f'<img width="{WIDTH}" alt="" src="data:image/jpeg;base64,{text}">', caption)


def _table(rows: list[list[str]]) -> str:
    head = "".join(f"<th>{escape(c)}</th>" for c in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows[1:])
    return f"<table><tr>{head}</tr>{body}</table>"


def _figure(content: str, caption: str) -> str:
    return f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def _list(values: Float, digits: int) -> str:
    return ", ".join(f"{v:.{digits}f}" for v in values)
