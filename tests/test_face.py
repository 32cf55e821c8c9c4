"""What a newcomer meets: hints that work, help, one-line objects, plots with their legends off the data."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT
from support.result_maker import result
from test_cli import call
from typer.main import get_command

import thermofusion as tf
from thermofusion import pipeline
from thermofusion.cli import app
from thermofusion.errors import ScanError, counted
from thermofusion.files.shipped import data_dir
from thermofusion.recipe import Recipe
from thermofusion.report import plot
from thermofusion.report.summary import summary
from thermofusion.results.folder import load_mesh
from thermofusion.types import VertexFlag

SOURCES = sorted((ROOT / "thermofusion").rglob("*.py"))
POSIX_ONLY = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}


# ---------------------------------------------------------------- hints and help


def texts(node):
    """The text of a string or an f-string, with X where a value goes in."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    return "".join(texts(v) if isinstance(v, ast.Constant) else "X" for v in node.values)


def written():
    """(file, text) of every string of the package that is no docstring."""
    for path in SOURCES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        inner = {id(v) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for v in ast.walk(n) if v is not n}
        docs = {
            id(n.body[0].value)
            for n in ast.walk(tree)
            if isinstance(n, ast.Module | ast.ClassDef | ast.FunctionDef) and n.body and isinstance(n.body[0], ast.Expr)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr | ast.Constant) and id(node) not in inner | docs and texts(node):
                yield path.relative_to(ROOT).as_posix(), texts(node)


def test_commands_in_messages_are_understood_by_the_program():
    """Every `thermofusion ...` in a message goes through the program's own parser, arguments and options."""
    found = [(path, c) for path, text in written() for c in re.findall(r"`thermofusion ([^`]+)`", text)]
    assert len(found) >= 10
    for path, line in found:
        command, words = get_command(app), shlex.split(line)
        while words and hasattr(command, "commands"):
            assert words[0] in command.commands, f"{path}: thermofusion {line}"
            command = command.commands[words.pop(0)]
        command.make_context(command.name, words)  # raises for an option that does not exist, an argument that lacks


def test_options_and_recipe_keys_in_messages_exist():
    leaves = [c for g in get_command(app).commands.values() for c in getattr(g, "commands", {"": g}).values()]
    known = {o for c in leaves for p in c.params for o in p.opts}
    for path, text in written():
        if not path.startswith("thermofusion/cli/") and " " in text:  # a sentence
            ours = re.sub(r"`(?!thermofusion )[^`]*`|\b[a-z]+-[a-z]+( --\w+)+", "", text)  # other programs' commands
            for option in re.findall(r"(?<![\w-])--[a-z][a-z-]+(?![\w-])", ours):
                assert option in known, f"{path}: {text}"
        for section, key in re.findall(r"\b([a-z]+)\.([a-z][A-Za-z0-9_]+)\b(?=[ ,=;]|$)", text):
            if section in Recipe.model_fields and " " in text and key not in ("json", "toml", "npz"):
                fields = Recipe.model_fields[section].annotation.model_fields
                assert key in fields, f"{path}: {text}"


@pytest.mark.parametrize("arguments", [[], ["recipe"], ["thermal"]])
def test_no_verb_prints_the_help(arguments, capsys):
    code, out, err = call(capsys, *arguments)
    assert (code, err) == (0, "")
    assert "Usage" in out
    assert len(out.splitlines()) > 8


def test_stages_scenes_and_paper_are_named(capsys, tmp_path):
    _, out, _ = call(capsys, "run", "--help")
    assert ", ".join(pipeline.STAGE_NAMES) in re.sub(r"[\s│]+", " ", out)
    _, out, _ = call(capsys, "recipe", "list", "--json")
    assert {"recipes", "scenes"} == set(json.loads(out))
    assert json.loads(out)["scenes"]["torso"]
    _, out, _ = call(capsys, "board", "-o", tmp_path / "b.svg")
    assert "A3 landscape, 420 x 297 mm" in out
    assert "A3 landscape, 420 x 297 mm" in (tmp_path / "b.svg").read_text()


def test_every_recipe_key_has_a_meaning():
    def walk(model, prefix=""):
        for name, field in model.model_fields.items():
            if isinstance(field.annotation, type) and hasattr(field.annotation, "model_fields"):
                yield from walk(field.annotation, f"{prefix}{name}.")
            elif not field.description:
                yield prefix + name

    assert not list(walk(Recipe))


def test_what_was_looked_for_is_said(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(ScanError) as e:
        tf.open_scan(tmp_path)
    for words in ("scan.json", "*.mkv", "rgb.txt and depth.txt", "--format"):
        assert words in e.value.sentence()


def test_an_unfinished_result_says_how_to_go_on(tmp_path):
    folder = tmp_path / "my result"
    (folder / "stages").mkdir(parents=True)
    with pytest.raises(ScanError, match="did not reach the temperature stage") as e:
        load_mesh(folder)
    assert f"`thermofusion run SCAN -o '{folder}'` goes on from there" in e.value.sentence()


def test_the_demo_gives_no_warning_of_itself(capsys):
    _, out, _ = call(capsys, "check", data_dir() / "demo")
    assert "warning" not in out


def report(**temperature):
    kind = {"mode": "absolute", "anchored": False, "coverage": 0.9, "median_sigma_K": 0.059, "level_sigma_K": {}}
    values = {"percentiles_degC": {"1": 27.0, "50": 28.31, "99": 30.0}, **kind, **temperature}
    tracking = {"source": "estimated", "frames": 51, "tracked": 50, "lost": [{}]}
    mapping = {"used": 1, "left_out": {"shutter": 2, "no pose": 0}}
    out = {"tracking": tracking, "mapping": mapping, "temperature": values}
    return summary({**out, "messages": [], "quality": {"failed": []}}, None)


def test_the_summary_says_what_is_known():
    relative = report()
    assert "unknown" in relative
    assert "absolute" not in relative
    assert "50 of 51 frames" in relative
    assert "1 frame used; left out: 2 (shutter)" in relative
    anchored = report(anchored=True, level_sigma_K={"reference": 0.08, "reflected": 0.06})
    assert "set by a reference, to ±0.10 K" in anchored
    assert "nothing is corrected" in report(mode="apparent")
    assert "°C" not in report(percentiles_degC={"1": None, "50": None, "99": None})
    assert [counted(n, "frame") for n in (0, 1, 1200)] == ["0 frames", "1 frame", "1,200 frames"]


# ---------------------------------------------------------------- from Python


def test_objects_show_themselves_in_one_line():
    scan, mesh = tf.open_scan(data_dir() / "demo"), result()
    trajectory = tf.types.Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    nouns = [scan, scan.rig, scan.depth, scan.thermal, scan.thermal.camera, scan.rig.depth, *scan.references]
    for noun in [*nouns, trajectory, mesh, mesh.surface]:
        assert "\n" not in repr(noun)
        assert len(repr(noun)) <= 200, repr(noun)
        assert type(noun).__name__ in repr(noun)
    assert repr(scan) == "<Scan 'demo' (native): 90 depth, 30 color, 30 thermal frames, 1 references>"
    assert "relative" in repr(mesh)


def test_a_place_on_a_mesh_is_looked_up():
    mesh = result()
    i = 123
    found = mesh.at(mesh.surface.vertices_m[i] + np.float32(0.0004))
    assert found.vertex == i
    assert found.off_m == pytest.approx(0.0004 * np.sqrt(3), rel=1e-3)
    assert found.temperature_degC == mesh.temperature_degC[i]
    assert found.flags == VertexFlag(int(mesh.flags[i]))
    assert np.isnan(mesh.at([0, 0, -0.1]).temperature_degC)
    for wrong in ([0, 0], [0, 0, np.nan], "abc"):
        with pytest.raises(ValueError, match=r"three finite coordinates|could not convert"):
            mesh.at(wrong)


def test_a_mesh_becomes_a_table():
    pytest.importorskip("pandas")
    mesh = result()
    table = mesh.to_dataframe()
    assert list(table.columns[:4]) == ["x_m", "y_m", "z_m", "temperature_degC"]
    np.testing.assert_array_equal(table["uncertainty_noise_K"], mesh.uncertainty_parts["noise"])
    assert len(table) == len(mesh)


def test_a_mesh_becomes_a_pyvista_surface():
    pytest.importorskip("pyvista")
    mesh = result()
    drawn = mesh.to_pyvista()
    assert (drawn.n_points, drawn.n_cells) == (len(mesh), len(mesh.surface.triangles))
    np.testing.assert_array_equal(drawn.point_data["temperature_degC"], mesh.temperature_degC)
    np.testing.assert_allclose(drawn.volume, 4 / 3 * np.pi * 0.1**3, rtol=0.03)  # the winding is kept


@pytest.mark.parametrize(("name", "make"), [("pandas", "to_dataframe"), ("pyvista", "to_pyvista")])
def test_an_absent_library_is_named(name, make, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=f"pip install {name}"):
        getattr(result(), make)()


# What inside functions may be Linux's own: a terminal's keys, and cameras that only V4L2 knows.
LATE = {
    "thermofusion/batch/job.py": {"resource"},
    "thermofusion/cli/record.py": {"termios", "tty"},
    "thermofusion/recording/devices/v4l2.py": {"fcntl"},
}


def test_types_are_shipped_and_posix_is_not_needed():
    assert (ROOT / "thermofusion" / "py.typed").is_file()
    for path in SOURCES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            late = LATE.get(path.relative_to(ROOT).as_posix(), set()) if node not in tree.body else set()
            assert not POSIX_ONLY & {n.split(".")[0] for n in names} - late, path
    code = (
        "import os\n"
        "import concurrent.futures, importlib.metadata, platform, subprocess, tempfile, threading, numpy, cv2, open3d\n"
        "for name in ('sysconf', 'sched_getaffinity', 'fork', 'getuid', 'geteuid', 'uname', 'fchmod'):\n"
        "    delattr(os, name)\n"
        "from thermofusion.cli.doctor import examine\n"
        "assert not [f for f in examine() if f.status == 'problem']\n"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    subprocess.run([sys.executable, "-c", code], check=True, env=env)


# ---------------------------------------------------------------- plots


def legend_box(svg):
    box = re.search(r'<rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)" rx="3"', svg)
    return [float(x) for x in box.groups()]


@pytest.mark.parametrize("filled", ["nothing", "corner", "lines", "area", "everything"])
@pytest.mark.parametrize("wanted", ["ne", "nw", "se", "sw"])
def test_a_legend_stands_off_the_data(filled, wanted):
    """Sampled independently: no point, no line, no area under the box, wherever it was wanted."""
    x = np.linspace(0, 1, 400)
    curves = {"nothing": [], "corner": [(x * 0.2 + 0.8, x * 0.2 + 0.8)], "lines": [(x, x), (x, 1 - x)]}
    curves["area"] = [(x, np.full(400, level)) for level in np.linspace(0.4, 1, 80)]
    curves["everything"] = [(x, np.full(400, level)) for level in np.linspace(0, 1, 80)]
    marks = [plot.Points([0.5], [0.5], label="a long name of a thing"), plot.Line([], [], label="another")]
    if filled == "lines":
        marks += [plot.Line([0, 1], [0, 1]), plot.Line([0, 1], [1, 0])]
    elif filled == "area":
        marks.append(plot.Area([0, 1], [0.4, 0.4], [1, 1]))
    elif filled != "nothing":
        marks += [plot.Points(cx, cy) for cx, cy in curves[filled]]
    axis = plot.Axis("", 0, 1, 0.2)
    svg = plot.Plot("", axis, axis, marks, legend=wanted).draw(470, 360, "k")
    left, top, w, h = (
        float(v)
        for v in re.search(
            r'<clipPath id="k"><rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"', svg
        ).groups()
    )
    bx, by, bw, bh = legend_box(svg)
    for cx, cy in curves[filled]:
        px, py = left + w * np.asarray(cx), top + h * (1 - np.asarray(cy))
        assert not ((px > bx) & (px < bx + bw) & (py > by) & (py < by + bh)).any()
    assert 0 <= bx < bx + bw <= 470
    assert 0 <= by < by + bh <= 360 + 1
    if filled == "nothing":
        assert (bx > 235) == ("e" in wanted)
        assert (by < 180) == ("n" in wanted)


@pytest.mark.parametrize(("lo", "hi"), [(0, 1), (-0.3, 0.3), (1e-4, 9e-4), (20, 37.5), (0, 12345)])
def test_axes_get_round_ticks(lo, hi):
    axis = plot.Axis.spanning("", lo, hi)
    assert 3 <= len(axis.ticks()) <= 10
    assert f"{axis.step:.0e}"[0] in "125"
    assert [float(axis.text(v).replace("−", "-")) for v in axis.ticks()] == pytest.approx(axis.ticks())
