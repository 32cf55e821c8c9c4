"""The report: one HTML file that opens from disk without network, shows the body and answers with numbers.

Script and style stand ready in `page/page.html`; here data are filled in. Whatever a person wrote is text: escaped in
HTML, `<` never stands in JSON.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..export import palettes
from ..export.axes import axes_of
from ..files.json import plain
from ..files.png import encode_png
from ..files.whole import write_text
from ..mapping.observe import Mapped
from ..physics.band import ZERO_DEGC_K, Band
from ..recipe import Recipe
from ..regions import Difference, Measurer, Region
from ..robust import evenly
from ..temperature.solve import Temperature
from ..types import Float32, UInt8, VertexFlag
from ..version import __version__
from . import cards
from .pack import FINE_K, Columns, pack
from .pictures import render_views

TEMPLATE = Path(__file__).parent / "page" / "page.html"
PICTURE_PX = 620  # height of the picture that stands in where WebGL is missing
VIEWS_SHOWN = 4  # thermal images that can be laid onto the body: each costs 0.1 MB
CAMERAS_SHOWN = 200
FLAG_TEXT = {
    VertexFlag.SINGLE_VIEW: "one view only",
    VertexFlag.OBLIQUE: "seen obliquely",
    VertexFlag.CAVITY: "in a fold",
    VertexFlag.HIGH_RESIDUAL: "views disagree",
    VertexFlag.MOVED: "moved",
    VertexFlag.NOT_SKIN: "not skin",
}
TITLES = {
    "absolute": "Skin temperature",
    "normal-equivalent": "Normal-equivalent temperature",
    "apparent": "Apparent temperature",
}


@dataclass(frozen=True, eq=False)
class Reported:
    """What a report is made of.

    report : result.json. recipe : resolved; its palette and range are shown. mapped : what the thermal views saw, if it
    is at hand: without it no camera and no thermal image can be shown. hashes : SHA-256 of the result's files by name.
    changes : of the regions, since an earlier visit.
    """

    temperature: Temperature
    report: dict[str, Any]
    recipe: Recipe
    mapped: Mapped | None = None
    regions: Sequence[Region] = ()
    hashes: dict[str, str] = field(default_factory=dict)
    changes: Sequence[Difference] = ()


def write_report(path: Path, reported: Reported, picture: UInt8 | None = None) -> Path:
    """Write the page, whole or not at all. picture : as of `report_html`. Raises ResourceError."""
    return write_text(path, report_html(reported, picture))


def report_html(reported: Reported, picture: UInt8 | None = None) -> str:
    """The page. picture : (H, W, 3) sRGB overview that stands in where WebGL is missing, drawn if absent."""
    temperature = reported.temperature
    measurer = Measurer(temperature.mesh, temperature.shared)
    columns, errors = pack(temperature, measurer)
    views = _view_maps(reported, columns)
    facts = _facts(reported, columns, errors, views)
    if picture is None and len(temperature.mesh.surface.triangles):
        output = reported.recipe.output
        drawn = render_views(temperature.mesh, palette=output.palette, range_degC=output.range_degC)
        picture = drawn["overview"]
    parts = {
        "TITLE": escape(f"{facts['scan']}: thermofusion report"),
        "HEAD": cards.head(reported.report, temperature.mesh),
        "PICTURES": _picture(picture),
        "BELOW": cards.below(
            reported.report, temperature, reported.recipe.to_toml(), reported.hashes, reported.changes
        ),
        "FOOT": f"thermofusion {escape(__version__)} · research use, not a diagnosis · scan "
        f"<bdi>{escape(str(facts['scan']))}</bdi>, run {escape(str(reported.report.get('run', '')))}",
        "FACTS": _json(facts),
        "COLUMNS": columns.text(),
    }
    page = TEMPLATE.read_text(encoding="utf-8")
    for name, text in parts.items():
        head, mark, tail = page.partition(f"<!--{name}-->")
        if not mark:
            raise ValueError(f"the report's template has no place for {name}")
        page = head + text + tail
    return page


def _json(value: object) -> str:
    """JSON that no HTML or JavaScript reader takes for anything else."""
    text = json.dumps(plain(value), allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _facts(reported: Reported, columns: Columns, errors: dict[str, Any], views: list[dict[str, Any]]) -> dict[str, Any]:
    mesh = reported.temperature.mesh
    named = (*palettes.PALETTES, "difference")
    return {
        "software": f"thermofusion {__version__}",
        "scan": str(reported.report.get("scan", {}).get("name", "")),
        "level": "level anchored to a reference" if mesh.anchored else "level relative: no reference",
        "relative": not mesh.anchored,
        "anchored": mesh.anchored and reported.temperature.shared is not None,
        "palettes": {n: base64.b64encode(palettes.table(n).tobytes()).decode() for n in named},
        "warnings": palettes.WARNINGS,
        "flags": [{"bit": int(flag), "name": text} for flag, text in FLAG_TEXT.items()],
        "maps": [*_maps(reported), *views],
        "columns": columns.described,
        "errors": errors,
        "cameras": _cameras(reported),
        "regions": [region.model_dump() for region in reported.regions],
    }


def _maps(reported: Reported) -> list[dict[str, Any]]:
    """What can be shown: column, unit, palette, range."""
    mesh, output = reported.temperature.mesh, reported.recipe.output
    shown = palettes.color_range(mesh.temperature_degC, output.range_degC)

    def degC(key: str, title: str, column: str) -> dict[str, Any]:
        return {"id": key, "title": title, "unit": "°C", "column": column, "digits": 2, "range": shown,
                "palette": output.palette, "level": True, "only": True}  # fmt: skip

    def scalar(
        key: str, title: str, unit: str, values: NDArray, digits: int, palette: str = "cividis"
    ) -> dict[str, Any]:
        finite = values[np.isfinite(values)]
        high = float(np.percentile(finite, 99)) if len(finite) else 1.0
        return {"id": key, "title": title, "unit": unit, "column": key, "digits": digits,
                "range": (0.0, max(float(f"{high:.2g}"), 10.0**-digits)), "palette": palette, "only": True}  # fmt: skip

    difference = mesh.temperature_degC - mesh.apparent_degC
    signed = {"id": "correction", "title": "Correction (shown less apparent)", "unit": "K", "column": "temperature",
              "less": "apparent", "digits": 2, "palette": "difference",
              "range": palettes.color_range(difference, step=0.1, symmetric=True)}  # fmt: skip
    maps = [degC("temperature", TITLES[mesh.mode], "temperature")]
    if mesh.mode != "normal-equivalent":
        maps.append(degC("normal-equivalent", TITLES["normal-equivalent"], "normal_equivalent"))
    if mesh.mode != "apparent":
        maps += [degC("apparent", TITLES["apparent"], "apparent"), signed]
    maps += [
        scalar("sigma", "Uncertainty, one sigma", "K", mesh.uncertainty_K, 3),
        scalar("angle", "Viewing angle", "°", mesh.view_angle_deg, 0),
        scalar("count", "Thermal views", "", mesh.observations.astype(np.float64), 0),
        {**scalar("flag", "Flags", "", np.array([6.0]), 0, "rainbow"), "range": (0, 6)},
    ]
    if mesh.moved_mm is not None:
        maps.append(scalar("moved", "Motion against the trunk, rms", "mm", mesh.moved_mm, 1))
    if mesh.surface.color_rgb is not None:
        maps.append({"id": "color", "title": "Colour picture", "unit": "", "kind": "color", "digits": 0,
                     "range": (0, 1), "palette": "grey"})  # fmt: skip
    return maps


def _view_maps(reported: Reported, columns: Columns) -> list[dict[str, Any]]:
    """Some thermal images laid onto the body as they were seen; their columns are added."""
    mapped, mesh = reported.mapped, reported.temperature.mesh
    if mapped is None or not len(mapped.views) or reported.temperature.calibration is None:
        return []
    band, out = Band(*reported.report.get("band_um", (7.5, 13.5))), []
    for view in evenly(len(mapped.views), VIEWS_SHOWN).tolist():
        rows = mapped.observations.select(mapped.observations.view == view)
        seen: Float32 = np.full(len(mesh), np.nan, np.float32)
        seen[rows.vertex] = band.temperature_K(rows.radiance.astype(np.float64)) - ZERO_DEGC_K
        frame = int(mapped.views.frame[view])
        columns.steps(f"view {frame}", seen, FINE_K)
        out.append({"id": f"view {frame}", "title": f"Thermal image {frame}, as seen", "unit": "°C", "digits": 2,
                    "column": f"view {frame}", "palette": reported.recipe.output.palette, "only": False,
                    "range": palettes.color_range(seen)})  # fmt: skip
    return out


def _cameras(reported: Reported) -> list[list[float]]:
    """Where the thermal camera stood: (4, 4) in the upright frame, row by row."""
    if reported.mapped is None:
        return []
    poses = reported.mapped.views.T_world_thermal
    turn = np.eye(4)
    turn[:3, :3] = axes_of(reported.temperature.mesh.metadata)
    turn = turn @ np.array(reported.report.get("frame", {}).get("T_result_world", np.eye(4)))
    step = max(1, -(-len(poses) // CAMERAS_SHOWN))
    return [np.round(turn @ T, 5).ravel().tolist() for T in poses[::step]]


def _picture(picture: UInt8 | None) -> str:
    if picture is None:
        return "<p>The result holds no surface.</p>"
    h, w = picture.shape[:2]
    if h > PICTURE_PX:
        size = round(w * PICTURE_PX / h), PICTURE_PX
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    h, w = picture.shape[:2]
    source = base64.b64encode(encode_png(picture, small=True)).decode("ascii")
    return (
        f'<figure><img src="data:image/png;base64,{source}" width="{w}" height="{h}" alt="The body from the front, the '
        'back, its left and its right side, with the colour bar"><figcaption class="quiet">Seen from the front, the '
        "person's right is on the left of the picture.</figcaption></figure>"
    )
