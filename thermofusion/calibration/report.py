"""The calibration report: one HTML file that works from disk and asks for nothing from outside."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from ..report.page import html_page
from ..types import Float
from .fit.cameras import INTRINSIC_NAMES, SHIFT, TURN, to_rt
from .fit.coverage import coverage
from .fit.rig import Calibration
from .rig_file import figures

WIDTH, HEIGHT = 420, 300  # px of a plot
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
        "<h2>Residuals</h2>",
        *(_residual_scatter(calibration, c) for c in calibration.fit.problem.cameras),
        _view_bars(calibration, f),
        _depth_plot(calibration),
        "<h2>Coverage</h2>",
        *(_coverage_plot(calibration, c) for c in calibration.single),
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


def _residual_scatter(calibration: Calibration, camera: str) -> str:
    e, _ = calibration.fit.residuals()[camera]
    reach = max(float(np.percentile(np.abs(e), 99)), 0.1)
    x, y = WIDTH / 2 * (1 + e[:, 0] / reach), HEIGHT / 2 * (1 + e[:, 1] / reach)
    inside = (np.abs(e) <= reach).all(axis=1)
    dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="1.3"/>' for a, b in zip(x[inside], y[inside], strict=True))
    axes = f'<path d="M0 {HEIGHT / 2}H{WIDTH}M{WIDTH / 2} 0V{HEIGHT}" stroke="#d0d7de"/>'
    picture = _svg(axes + f'<g fill="{COLORS[camera]}" fill-opacity=".5">{dots}</g>')
    return _figure(picture, f"{camera}: projected minus seen; the frame is ±{reach:.2f} px")


def _view_bars(calibration: Calibration, f: dict) -> str:
    views = f["views_rms_px"]
    top = max((v for row in views.values() for v in row.values()), default=1.0)
    step, parts = WIDTH * 2 / max(len(views), 1), []
    cameras = calibration.fit.problem.cameras
    for i, (name, row) in enumerate(views.items()):
        for k, c in enumerate(cameras):
            if c not in row:
                continue
            h = 0.85 * HEIGHT * row[c] / top
            w = 0.8 * step / len(cameras)
            title = f"<title>{escape(name)}, {c}: {row[c]:.2f} px</title>"
            parts.append(
                f'<rect x="{i * step + k * w:.1f}" y="{HEIGHT - h:.1f}" width="{w:.1f}" height="{h:.1f}" '
                f'fill="{COLORS[c]}">{title}</rect>'
            )
    return _figure(_svg("".join(parts), WIDTH * 2), f"rms by view in order of recording; the highest is {top:.2f} px")


def _depth_plot(calibration: Calibration) -> str:
    problem = calibration.fit.problem
    if problem.depth is None:
        return ""
    r, _ = calibration.fit.residuals()["depth_plane"]
    d, mm = problem.depth, r * problem.depth.sigma * 1e3
    reach = max(float(np.percentile(np.abs(mm), 99)), 1e-3)
    lo, hi = float(d.value.min()), float(d.value.max())
    x = WIDTH * (d.value - lo) / max(hi - lo, 1e-9)
    y = HEIGHT / 2 * (1 + mm / reach)
    step = max(1, len(x) // 3000)
    dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="1.2"/>' for a, b in zip(x[::step], y[::step], strict=True))
    axis = f'<path d="M0 {HEIGHT / 2}H{WIDTH}" stroke="#d0d7de"/>'
    picture = _svg(axis + f'<g fill="{COLORS["depth"]}" fill-opacity=".4">{dots}</g>')
    return _figure(picture, f"depth minus board plane, ±{reach:.1f} mm, against reported value {lo:.2f} to {hi:.2f}")


def _coverage_plot(calibration: Calibration, camera: str) -> str:
    w, h = calibration.fit.problem.sizes[camera]
    px = np.concatenate([v.points[camera].px for v in calibration.data.seen_by(camera)])
    scale = WIDTH / w
    counts = coverage(calibration, camera).counts
    dots = "".join(f'<circle cx="{u * scale:.1f}" cy="{v * scale:.1f}" r="1.2"/>' for u, v in px)
    height = h * scale
    lines = "".join(
        f'<path d="M{WIDTH * k / 3:.1f} 0V{height:.1f}M0 {height * k / 3:.1f}H{WIDTH}" stroke="#d0d7de"/>'
        for k in (1, 2)
    )
    empty = "".join(
        f'<rect x="{WIDTH * i / 3:.1f}" y="{height * j / 3:.1f}" width="{WIDTH / 3:.1f}" height="{height / 3:.1f}" '
        'fill="#ffebe9"/>'
        for j, i in np.argwhere(counts == 0)
    )
    picture = _svg(empty + lines + f'<g fill="{COLORS[camera]}" fill-opacity=".5">{dots}</g>', WIDTH, height)
    return _figure(picture, f"{camera}: where the board was seen; red parts never")


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


def _svg(content: str, width: float = WIDTH, height: float = HEIGHT) -> str:
    return f'<svg width="{width:.0f}" height="{height:.0f}" viewBox="0 0 {width:.0f} {height:.0f}">{content}</svg>'


def _list(values: Float, digits: int) -> str:
    return ", ".join(f"{v:.{digits}f}" for v in values)
