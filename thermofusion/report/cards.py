"""The report's tables and plots, as HTML: what stands beside and below the body. Every text is escaped here."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np

from ..regions import Difference
from ..robust import NORMAL_95
from ..temperature.solve import Temperature
from ..types import ThermalMesh
from .lettering import ticks
from .plot import BLUE, GREY, ORANGE, Axis, Line, Mark, Plot, Points, Rule, page

Cell = object


def head(report: dict[str, Any], mesh: ThermalMesh) -> str:
    """Who, what level, and the quality in words."""
    scan = report.get("scan", {})
    level = "Absolute, anchored to a reference" if mesh.anchored else "Relative: no reference set the level"
    mode = "" if mesh.mode == "absolute" else f"{mesh.mode} temperatures, "
    failed = report.get("quality", {}).get("failed", [])
    word = "Below the gate" if failed else "Good"
    day = str(scan.get("recorded_at") or "")
    return (
        f'<div class="who"><h1><bdi>{escape(str(scan.get("name", "")))}</bdi></h1><p><bdi>{escape(day)}</bdi></p></div>'
        f'<div class="level">{escape(mode)}{escape(level)}</div>'
        f'<div class="verdict{" failed" if failed else ""}"><p><b>{word}.</b> {escape("; ".join(_quality(report)))}</p>'
        + "".join(f"<p><bdi>{escape(str(text))}</bdi></p>" for text in failed)
        + "</div>"
    )


def _quality(report: dict[str, Any]) -> list[str]:
    """The banner: one number each, in words."""
    tracking, rig, mapping = report.get("tracking", {}), report.get("rig", {}), report.get("mapping", {})
    temperature = report.get("temperature", {})
    crosscal = temperature.get("crosscal") or {}
    out = []
    if tracking:
        out.append(f"{tracking['tracked']} of {tracking['frames']} depth frames tracked")
    if _number(rig.get("residual_px_after")):
        out.append(f"thermal outlines fit to {rig['residual_px_after']:.2f} px")
    if rig.get("mount") == "free":
        out.append(f"{rig['views_used']} thermal views placed to {rig['sigma_translation_mm']:.1f} mm")
    elif rig:
        out.append(f"clock {rig['time_offset_s'] * 1e3:+.0f} ms")
    if _number(temperature.get("coverage")):
        out.append(f"{temperature['coverage']:.0%} of the surface measured")
    if _number(temperature.get("median_sigma_K")):
        out.append(f"median uncertainty {temperature['median_sigma_K']:.3f} K")
    offsets = crosscal.get("offsets_K")
    if offsets is not None and len(offsets):
        out.append(f"views drifted by {np.std(np.asarray(offsets, float)):.2f} K, removed")
    motion = report.get("motion") or mapping.get("motion")
    if isinstance(motion, dict) and _number(motion.get("correction_mm")):
        out.append(f"motion {motion['correction_mm']:.1f} mm")
    return out


def below(
    report: dict[str, Any],
    temperature: Temperature,
    recipe: str,
    hashes: dict[str, str],
    changes: Sequence[Difference] = (),
) -> str:
    """What stands under the body, card by card. changes : of regions, since the visit before."""
    cards = [
        _card("Diagnosis", _diagnosis(report), wide=True),
        _card("Since the visit before", _changes(changes)),
        _card("What is not bare skin", _materials(temperature)),
        _card("How views were calibrated against each other", _plots(temperature), wide=True),
        _card("Uncertainty", _budget(temperature)),
        _card("Face, read before its shape was taken out", _face(report)),
        _card("Radiometric numbers", _radiometry(report)),
        _card("Study and preparation", _checklist(report)),
        _card("Notes of the run", _list(report.get("messages", []))),
        _card("Recipe", f"<pre>{escape(recipe)}</pre>", folded=True),
        _card("Files", table(("file", "SHA-256"), hashes.items()) if hashes else ""),
    ]
    return "\n".join(c for c in cards if c)


def table(heads: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """An HTML table; every cell is text."""
    top = "".join(f'<th scope="col">{escape(h)}</th>' for h in heads)
    body = "".join("<tr>" + "".join(f"<td><bdi>{escape(str(c))}</bdi></td>" for c in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _card(title: str, body: str, *, wide: bool = False, folded: bool = False) -> str:
    if not body:
        return ""
    if folded:
        return f'<details class="card wide"><summary>{escape(title)}</summary>{body}</details>'
    return f'<section class="card{" wide" if wide else ""}"><h2>{escape(title)}</h2>{body}</section>'


def _list(texts: Iterable[object]) -> str:
    items = "".join(f"<li><bdi>{escape(str(text))}</bdi></li>" for text in texts)
    return f"<ul>{items}</ul>" if items else ""


def _diagnosis(report: dict[str, Any]) -> str:
    """What the data say against the model: one sentence each, its evidence unfolds."""
    items = []
    for found in report.get("diagnosis") or []:
        sizes = [f"{found['size']:.3g} {found.get('unit', '')}"] if _number(found.get("size")) else []
        sizes += [f"{found['size_K']:.2f} K"] if _number(found.get("size_K")) else []
        size = f" ({', '.join(sizes)})" if sizes else ""
        sentence = f"{found.get('what', '')}{size}, {found.get('where', '')}: {found.get('done', '')}"
        facts = "".join(f"<p><bdi>{escape(str(found[k]))}</bdi></p>" for k in ("evidence", "advice") if found.get(k))
        items.append(f"<li><details><summary><bdi>{escape(sentence)}</bdi></summary>{facts}</details></li>")
    return f"<ul>{''.join(items)}</ul>" if items else ""


def _changes(changes: Sequence[Difference]) -> str:
    """How each region changed, against what the two scans' errors alone would show."""
    rows = []
    for c in changes:
        chance = NORMAL_95 * c.sigma_K
        if not np.isfinite(c.delta_K):
            rows.append((c.first, "not measured", "", ""))
        elif not np.isfinite(chance):
            rows.append((c.first, f"{c.delta_K:+.2f}", "not known: a level is relative", ""))
        else:
            rows.append(
                (c.first, f"{c.delta_K:+.2f}", f"{chance:.2f}", "beyond" if abs(c.delta_K) > chance else "within")
            )
    if not rows:
        return ""
    heads = ("region", "now - before, K", "95 % by chance, K", "")
    return table(heads, rows) + "<p>Chance holds both scans' errors; the skin's own, of the same person, cancel.</p>"


def _materials(temperature: Temperature) -> str:
    """What was read of dressings, hair and the like, by their own emissivity; why, where nothing was."""
    rows = []
    for name, m in temperature.materials.items():
        read = m.get("reason") or "not measured"
        if _number(m.get("median_degC")):
            read = f"{m['median_degC']:.2f} °C ± {m['median_sigma_K']:.2f} K"
        epsilon = "" if not _number(m.get("epsilon0")) else f"{m['epsilon0']:.3f}"
        rows.append((name, "as skin" if m.get("as_skin") else epsilon, read, f"{m['measured']} of {m['vertices']}"))
    return table(("part", "ε(0)", "median, or why not", "vertices measured"), rows) if rows else ""


def _budget(temperature: Temperature) -> str:
    mesh, rows = temperature.mesh, []
    for name, values in mesh.uncertainty_parts.items():
        known = values[np.isfinite(values)]
        if name != "absolute" and len(known) and known.max() > 0:
            rows.append((name, *(f"{np.percentile(known, p):.3f}" for p in (50, 95))))
    known = mesh.uncertainty_K[np.isfinite(mesh.uncertainty_K)]
    if not len(known):
        return "<p>No uncertainty is known for this result.</p>"
    rows.append(("all, about the common level", *(f"{np.percentile(known, p):.3f}" for p in (50, 95))))
    text = table(("one sigma of a spot, K", "median", "95 %"), rows)
    level = [(k, f"{v:.3f}") for k, v in temperature.level_sigma_K.items() if np.isfinite(v)]
    if level:
        text += "<h3>Of the level common to the whole body</h3>" + table(("part", "K"), level)
    if not mesh.anchored:
        text += "<p>The level itself is not known: differences on the body are right, absolute values are not.</p>"
    return text


def _face(report: dict[str, Any]) -> str:
    """Of a de-identified result: what forehead and inner eye corners read."""
    rows = [
        (row["name"], f"{row['value_degC']:.2f} ± {row['sigma_K']:.2f}", f"{row['max_degC']:.2f}")
        for row in report.get("face") or []
    ]
    return table(("place", "mean, °C", "highest, °C"), rows) if rows else ""


def _radiometry(report: dict[str, Any]) -> str:
    rows = [(r.get("what", ""), r.get("value", ""), r.get("source", "")) for r in report.get("radiometry") or []]
    return table(("number", "value", "source"), rows) if rows else ""


def _checklist(report: dict[str, Any]) -> str:
    rows = report.get("metadata") or []
    if not rows:
        return ""
    body = ""
    for row in rows:
        value, source = row.get("value"), row.get("source")
        stated = f'<span class="given"><bdi>{escape(str(value))}</bdi></span>' if value is not None else (
            '<span class="missing">not stated</span>')  # fmt: skip
        tisem = f"TISEM {row['tisem']}" if row.get("tisem") else ""
        what = escape(str(row.get("what", "")))
        body += f"<tr><td>{what}</td><td>{stated}</td><td>{escape(str(source or tisem))}</td></tr>"
    given = sum(row.get("value") is not None for row in rows)
    top = '<thead><tr><th scope="col">item</th><th scope="col">stated</th><th scope="col">source</th></tr></thead>'
    return f"<p>{given} of {len(rows)} items are stated.</p><table>{top}<tbody>{body}</tbody></table>"


# ---------------------------------------------------------------- plots


def _plots(temperature: Temperature) -> str:
    crosscal, panels = temperature.crosscal, list[Plot]()
    offsets = np.asarray(crosscal.get("offsets_K", ()), np.float64)
    if len(offsets):
        frames = np.asarray(crosscal["view_frames"], np.float64)
        mark = Points(frames, offsets, BLUE)
        panels.append(
            Plot("Offset of each view", _axis("thermal frame", frames), _axis("K", offsets), [mark, Rule(0.0)])
        )
    angles = crosscal.get("by_angle") or {}
    if angles:
        x, before, after = (np.asarray(angles[k], np.float64) for k in ("angle_deg", "before_K", "after_K"))
        marks: list[Mark] = [
            Line(x, before, ORANGE, "as the camera reads"),
            Line(x, after, BLUE, "corrected"),
            Rule(0.0, color=GREY),
        ]
        both = np.concatenate([before, after])
        panels.append(
            Plot(
                "Reading less normal-equivalent temperature",
                _axis("viewing angle, °", x),
                _axis("K", both),
                marks,
                "sw",
            )
        )
    known = temperature.mesh.temperature_degC[temperature.mesh.measured]
    if len(known):
        low, high = np.percentile(known, (0.2, 99.8)).tolist()
        counts, edges = np.histogram(known, 80, (low - 0.1, high + 0.1))
        share = 100 * counts / len(known)
        line = Line(np.repeat(edges, 2)[1:-1], np.repeat(share, 2), BLUE)
        panels.append(
            Plot("Temperatures of the surface", _axis("°C", edges), _axis("% of the vertices", share), [line])
        )
    if not panels:
        return ""
    text = page(panels, columns=3, panel_px=(430.0, 300.0))
    data = base64.b64encode(text.encode()).decode("ascii")
    names = "; ".join(panel.title for panel in panels)
    return f'<img src="data:image/svg+xml;base64,{data}" alt="{escape(names)}">'


def _axis(label: str, values: np.ndarray) -> Axis:
    """An axis round values (N,), in their unit, with about five ticks."""
    finite = values[np.isfinite(values)]
    lo, hi = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    pad = 0.06 * (hi - lo) or 0.5
    lo, hi = lo - pad, hi + pad
    marks = ticks(lo, hi, 5)
    return Axis(label, lo, hi, marks[1] - marks[0] if len(marks) > 1 else hi - lo)


def _number(value: object) -> bool:
    return isinstance(value, int | float) and bool(np.isfinite(value))
