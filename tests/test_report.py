"""The report as a person uses it, in Chromium; what it says against `measure`; hostile text; the built page."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from hashlib import sha256
from html.parser import HTMLParser

import numpy as np
import pytest
from conftest import ROOT
from support.result_maker import result, sphere

from thermofusion.export import palettes
from thermofusion.geometry.rays import RayScene
from thermofusion.recipe import Recipe
from thermofusion.regions import Brush, Difference, Measured, Measurer, Spot, read_regions, write_regions
from thermofusion.report.deidentify import deidentified
from thermofusion.report.html import TEMPLATE, Reported, write_report
from thermofusion.temperature.solve import Temperature
from thermofusion.types import SharedErrors

HOSTILE = "</script><script>window.pwned=1</script><img src=x onerror=pwned=1>\"'`--!><!--FACTS--> \u202eabc "
HOSTILE += "x" * 10_000
PAGE = TEMPLATE.parent


@pytest.fixture(scope="module")
def temperature():
    """An egg of 25,000 vertices, tall and unlike in its axes; everything measured but a cap."""
    mesh = result(sphere(130, 190, (0.16, 0.12, 0.3)), unmeasured_below_m=-0.27)
    x, _, z = mesh.surface.vertices_m.astype(np.float64).T
    T = np.where(mesh.measured, 33 + 3 * z + 0.6 * np.sin(40 * x) * np.cos(30 * z), np.nan).astype(np.float32)
    noise = np.where(mesh.measured, 0.03 + 0.05 * np.abs(x), np.nan)
    parts = {"noise": noise, "normals": noise, "registration": noise / 2, "air": noise / 3, "calibration": noise / 3}
    flags = mesh.flags | np.where((z > 0.08) & (x > 0.03), 64, 0).astype(np.uint8)  # not skin
    mesh = type(mesh)(**{**vars(mesh), "flags": flags, "temperature_degC": T, "apparent_degC": T - 0.5 - np.abs(x),
                         "anchored": True, "uncertainty_parts": parts, "moved_mm": 20 * np.abs(x),
                         "observations": np.where(mesh.measured, 9, 0)})  # fmt: skip
    effects = {"reference": np.full(len(T), 0.03), "emissivity0": 0.02 + 0.01 * z, "calibration 1": 0.03 * x}
    shared = SharedErrors.of({k: np.where(mesh.measured, v, np.nan) for k, v in effects.items()}, 400.0, 0.025)
    return Temperature(mesh, T, T, mesh.apparent_degC, shared=shared, level_sigma_K={"reference": 0.03})


def document(name="egg"):
    return {
        "scan": {"name": name, "recorded_at": "2026-05-04"},
        "quality": {"failed": []},
        "messages": [name],
        "diagnosis": [{"what": name, "size_K": 3.2, "where": "", "done": "", "evidence": name}],
        "metadata": [{"key": "a", "what": "asked", "tisem": 1, "value": name, "source": "x"},
                     {"key": "b", "what": "asked too", "tisem": 2, "value": None, "source": None}],
        "radiometry": [{"what": "number", "value": name, "source": "x"}],
    }  # fmt: skip


@pytest.fixture(scope="module")
def used(temperature, tmp_path_factory):
    """(folder, what page.mjs saw); skipped with the reason where browser or node is absent."""
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium")
    if not chromium or not shutil.which("node"):
        pytest.skip("no Chromium or no node here: apt-get install chromium nodejs")
    if not (ROOT / "tests/js/node_modules/playwright-core").is_dir():
        pytest.skip("npm ci --prefix tests/js installs playwright-core")
    folder = tmp_path_factory.mktemp("report")
    page = write_report(folder / "report.html", Reported(temperature, document(HOSTILE), Recipe()))
    more = [
        Spot(name="left <b>side</b>", point_m=(0.15, 0.05, 0.02)),
        Spot(name="right <b>side</b>", point_m=(-0.15, 0.05, 0.02)),
        Brush(name="back", points_m=[(0, 0, -0.12)], normals=[(0, 0, -1)], radius_m=0.05),
    ]
    regions = write_regions(folder / "more.json", more)
    done = subprocess.run(
        ["node", ROOT / "tests/js/page.mjs", page, regions, folder],
        capture_output=True, text=True, timeout=300, env={**os.environ, "CHROMIUM": chromium},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return folder, json.loads(done.stdout.splitlines()[-1])


def test_no_request_leaves_the_page_and_nothing_hostile_runs(used):
    _, seen = used
    assert seen["requests"] == []
    assert seen["errors"] == []
    assert seen["scripts"] == ["application/json", "application/octet-stream", "module"]
    assert seen["title"].startswith(HOSTILE[:60].replace("\u202e", "")[:40])


def test_picking_is_ray_casting_and_colours_are_the_legend_s(used, temperature):
    _, seen = used
    mesh, body = temperature.mesh, Measurer(temperature.mesh).body
    rays = np.array([p["ray"]["origin"] + p["ray"]["direction"] for p in seen["picks"]])
    hits = RayScene(body.vertices_m, body.triangles).hits(rays.astype(np.float32))
    T = (hits.weights * mesh.temperature_degC[body.triangles[hits.triangle]]).sum(1)
    picked = np.array([np.nan if p["temperature"] is None else p["temperature"] for p in seen["picks"]])
    assert (np.isnan(T) == np.isnan(picked)).all()
    assert np.nanmax(np.abs(T - picked)) < 1e-4
    inner = np.array([p["inner"] for p in seen["picks"]]) & ~np.isnan(picked)
    assert inner.sum() > 120
    lo, hi = palettes.color_range(mesh.temperature_degC)
    index = palettes.palette_index(picked[inner], lo, hi).astype(int)
    near = np.stack([palettes.table("inferno")[np.clip(index + k, 0, 255)] for k in (-1, 0, 1)]).astype(int)
    rgb = np.array([p["rgb"] for p in seen["picks"]])[inner]
    assert np.abs(near - rgb).max(axis=2).min(axis=0).max() <= 2
    assert np.median([p["ms"] for p in seen["picks"]]) < 50
    assert "°C" in seen["readout"]
    assert "9 views" in seen["readout"]


def test_maps_palettes_views_and_sides_show_something_of_their_own(used):
    _, seen = used
    assert {"temperature", "normal-equivalent", "apparent", "correction", "sigma", "angle", "count", "flag",
            "moved", "color"} == set(seen["maps"])  # fmt: skip
    assert all(seen["changes"].values()), seen["changes"]
    assert seen["same_again"]
    assert seen["cut"]["cut_z_m"] <= seen["cut"]["whole_z_m"] - 0.01  # the far side, seen through the cut
    assert seen["sides"] == {"front": "RL", "back": "LR"}


def test_numbers_of_the_page_are_those_of_measure(used, temperature):
    """Hand-drawn spots, line, lasso and brush: the page's CSV against Python on the regions that the page saved."""
    folder, seen = used
    regions = read_regions(folder / "page.json")
    assert [r.kind for r in regions] == ["spot", "spot", "line", "lasso", "brush", "spot", "spot", "brush"]
    found = Measured.of(Measurer(temperature.mesh, temperature.shared), regions)
    rows = list(csv.DictReader((folder / "page.csv").read_text().splitlines()))
    assert len(rows) == len(regions) + len(found.differences) == seen["rows"]
    close = {"value_degC": 1e-3, "sd_K": 2e-3, "min_degC": 2e-3, "max_degC": 2e-3, "measured_fraction": 2e-3}
    relative = {"sigma_K": 0.03, "sigma_absolute_K": 0.03, "area_cm2": 3e-3, "length_mm": 5e-3, "n": 0.01}
    for row, reading in zip(rows, found.readings, strict=False):
        ours = reading.row()
        for key in (*close, *relative):
            if row[key] == "":
                assert not np.isfinite(ours[key]), (row["name"], key)
                continue
            expected = pytest.approx(ours[key], abs=close.get(key, 0), rel=relative.get(key, 0))
            assert float(row[key]) == expected, (row["name"], key)
    for row, ours in zip(rows[len(regions) :], found.differences, strict=True):
        assert float(row["value_degC"]) == pytest.approx(ours.delta_K, abs=1e-3)
        assert float(row["sigma_K"]) == pytest.approx(ours.sigma_K, rel=0.03)
        assert float(row["length_mm"]) == pytest.approx(ours.distance_mm, rel=5e-3)
    assert "left <b>side</b>" in seen["loaded_names"]
    assert "version" in seen["refused"]


def test_pictures_print_and_phones(used):
    folder, seen = used
    assert (folder / "page.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert (folder / "page.pdf").read_bytes()[:5] == b"%PDF-"
    assert seen["pdf"]["shots"] == 5  # four sides and the scale
    assert seen["phone_overflow"] <= 0


def test_without_webgl_the_pictures_stand_in(used):
    _, seen = used
    assert seen["without"]["picture"] > 200
    assert seen["without"]["stage"] is True
    assert "pictures and tables below are complete" in seen["without"]["fault"]
    assert seen["without"]["tables"] >= 3


def test_no_serious_barrier(used):
    _, seen = used
    assert seen["axe"] == []


# ---------------------------------------------------------------- without a browser


class _Elements(HTMLParser):
    def __init__(self):
        super().__init__()
        self.found, self.data = [], []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.data.append(data)


def test_hostile_text_is_text(temperature, tmp_path):
    """The same elements whatever the scan is called; no handler, no style attribute, no address but data."""
    pages = [
        write_report(tmp_path / f"{i}.html", Reported(temperature, document(name), Recipe())).read_text()
        for i, name in enumerate(("egg", HOSTILE))
    ]
    elements = []
    for page in pages:
        parser = _Elements()
        parser.feed(page)
        elements.append([tag for tag, _ in parser.found])
        for tag, attributes in parser.found:
            assert not any(k.startswith("on") or k == "style" for k in attributes), tag
            assert str(attributes.get("src", "data:")).startswith("data:")
    assert elements[0] == elements[1]


def test_the_page_says_what_changed_and_what_is_not_skin(temperature, tmp_path):
    """A region against the visit before, beyond chance or within; a dressing by its own ε, and why a foil is empty."""
    told = {"vertices": 90, "measured": 88, "epsilon0": 0.85, "as_skin": False, "median_degC": 31.5,
            "median_sigma_K": 0.21, "reason": ""}  # fmt: skip
    foil = told | {"measured": 0, "epsilon0": None, "median_degC": None, "reason": "metal mirrors the room"}
    covered = replace(temperature, materials={f"dressing of {HOSTILE}": told, "foil": foil})
    changes = [Difference("knee", "knee, before", 0.84, 0.2), Difference("shin", "shin, before", 0.1, 0.2),
               Difference("foot", "foot, before", 0.1, float("nan"))]  # fmt: skip
    regions = [Spot(name=n, point_m=(0.15, 0.05, 0.02)) for n in ("knee", "shin", "foot")]
    shown = Reported(covered, document(), Recipe(), regions=regions, changes=changes)
    page = write_report(tmp_path / "report.html", shown).read_text()
    assert re.search(r"knee.*?\+0\.84.*?0\.39.*?beyond.*?shin.*?within.*?foot.*?a level is relative", page)
    assert re.search(
        r"dressing of.*?0\.850.*?31\.50 °C ± 0\.21 K.*?88 of 90.*?foil.*?metal mirrors the room.*?0 of 90", page
    )
    assert "<script>window.pwned" not in page
    filed = write_report(tmp_path / "filed.html", deidentified(shown)).read_text()
    assert "knee" not in filed
    assert "dressing" not in filed
    assert re.search(r"spot 1.*?\+0\.84", filed)
    assert re.search(r"material 1.*?31\.50 °C", filed)


def test_the_same_result_gives_the_same_bytes(temperature, tmp_path):
    a, b = (write_report(tmp_path / n, Reported(temperature, document(), Recipe())).read_bytes() for n in ("a", "b"))
    assert a == b


def test_the_built_page_is_what_its_sources_give():
    page = (PAGE / "page.html").read_bytes()
    assert (PAGE / "page.html.sha256").read_text().split()[0] == sha256(page).hexdigest()
    assert page.count(b"MIT License") == 2 or page.count(b"The MIT License") + page.count(b"MIT License") >= 2
    if not (PAGE / "node_modules/esbuild").is_dir():
        pytest.skip("npm ci --prefix thermofusion/report/page installs what builds the page")
    subprocess.run(["node", PAGE / "build.mjs", "--check"], check=True, capture_output=True)
