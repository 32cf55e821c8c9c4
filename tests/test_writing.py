"""What a verb writes never replaces what a recording holds, nor a file that somebody else made."""

from __future__ import annotations

import hashlib
import itertools
import json
import shutil

import numpy as np
import pytest
from support import result_maker

from thermofusion.cli import main
from thermofusion.export import export
from thermofusion.files.png import encode_png
from thermofusion.files.shipped import data_dir
from thermofusion.files.whole import spared
from thermofusion.regions import Spot, write_regions
from thermofusion.results.artifacts import save_artifact
from thermofusion.temperature.solve import Temperature
from thermofusion.types import ThermalMesh

# -o's of verbs that write something, each after the verb and what it reads.
TO_FOLDERS = [
    ["run", "@demo", "--dry-run"],
    ["demo"],
    ["export", "result", "--format", "csv"],
    ["validate", "@demo"],
    ["compare", "result", "result"],
    ["check", "@demo"],
    ["measure", "result", "--regions", "drawn.json"],
    ["paper", "--only", "table1"],
]
TO_FILES = [["report", "result"], ["board"], ["calibrate", "pictures"], ["thermal", "curve", "readings.csv"]]


@pytest.fixture
def world(tmp_path, monkeypatch):
    """A native recording, a TUM one, a result, drawn regions; the working folder is theirs."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(data_dir() / "demo", "scan", ignore=shutil.ignore_patterns("0000[0-9][1-9].png"))
    for name in ("rgb", "depth"):
        (tmp_path / "tum" / name).mkdir(parents=True)
        (tmp_path / "tum" / name / "1.png").write_bytes(b"picture")
        (tmp_path / "tum" / f"{name}.txt").write_text(f"0 {name}/1.png\n")
    (tmp_path / "tum" / "trajectory.txt").write_text("0 0 0 0 0 0 0 1\n")
    (tmp_path / "link").symlink_to("scan/depth", target_is_directory=True)
    surface = result_maker.sphere(5, 6)
    warm = np.full(len(surface), 33, np.float32)
    mesh = ThermalMesh.from_temperature(surface, warm, mode="absolute", anchored=True)
    (tmp_path / "result").mkdir()
    save_artifact(tmp_path / "result" / "result.npz", Temperature(mesh, warm, warm, warm))
    export(mesh, tmp_path / "result", ["ply"])
    write_regions(tmp_path / "drawn.json", [Spot(name="a", point_m=(0, 0, 0))])
    return tmp_path


def held(folder):
    return {p: hashlib.sha256(p.read_bytes()).digest() for p in sorted(folder.rglob("*")) if p.is_file()}


def refused(capsys, arguments, out):
    words = [str(data_dir() / w[1:]) if w.startswith("@") else w for w in (*arguments, "-o", str(out))]
    with pytest.raises(SystemExit) as stopped:
        main(words)
    errors = capsys.readouterr().err.splitlines()
    assert stopped.value.code in (2, 3), words
    assert len([line for line in errors if line.startswith("error:")]) == 1
    return errors[0]


def test_no_verb_writes_into_a_recording(world, capsys):
    """Native or foreign, the folder itself, one inside, one that a link leads to; --overwrite changes nothing."""
    before = held(world / "scan") | held(world / "tum")
    for arguments, place in itertools.product(TO_FOLDERS, ("scan", "scan/new", "link", "tum")):
        assert "recording" in refused(capsys, arguments, place)
    for arguments, place in itertools.product(TO_FILES, ("scan/scan.json", "scan/new.json", "link/000000.png")):
        assert "recording" in refused(capsys, arguments, place)
    for arguments in (["run", "@demo", "--overwrite"], ["demo", "--overwrite"]):
        assert "recording" in refused(capsys, arguments, "tum")
    assert held(world / "scan") | held(world / "tum") == before


def test_no_verb_replaces_somebodys_file(world, capsys):
    mine = world / "mine"
    (mine / "views").mkdir(parents=True)
    for name in (
        "mesh.ply",
        "mesh.csv",
        "a.csv",
        "a.json",
        "comparison.json",
        "bland-altman.svg",
        "x.html",
        "views/front.png",
    ):
        (mine / name).write_text("mine\n")
    write_regions(mine / "regions.json", [Spot(name="a", point_m=(0, 0, 0))])
    before = held(mine)
    for arguments, out in (
        (["export", "result", "--format", "ply"], mine),
        (["export", "result", "--format", "csv"], mine),
        (["measure", "result", "--regions", "drawn.json"], mine / "a"),
        (["measure", "result", "--regions", str(mine / "regions.json")], mine / "regions"),  # what was drawn stays
        (["compare", "result", "result"], mine),
        *((verb, mine / "x.html") for verb in TO_FILES if verb != ["board"]),
    ):
        assert "did not write" in refused(capsys, arguments, out)
    assert {p: digest for p, digest in held(mine).items() if p in before} == before
    for arguments in (["demo"], ["run", "@demo"]):
        assert "no result" in refused(capsys, arguments, mine)


def test_an_earlier_versions_pictures_may_be_drawn_again(world, capsys):
    """They bear no mark, but the result counts them among its files; what it does not count stays."""
    views = world / "result" / "views"
    views.mkdir()
    names = ("front", "back", "left", "right", "overview", "uncertainty")
    for name in names:
        (views / f"{name}.png").write_bytes(b"an earlier version's")
    files = [f"views/{name}.png" for name in names]
    (world / "result" / "result.json").write_text(json.dumps({"thermofusion": "0.1.0", "files": files[1:]}))
    assert "front.png" in refused(capsys, ["export", "result", "--format", "csv"], "result")
    (world / "result" / "result.json").write_text(json.dumps({"thermofusion": "0.1.0", "files": files}))
    with pytest.raises(SystemExit) as stopped:
        main(["export", "result", "--format", "csv"])
    assert stopped.value.code == 0, capsys.readouterr().err


def test_what_was_written_may_be_written_again(world, capsys):
    """Every file says whose it is: in its first bytes, whatever its form."""
    surface = result_maker.sphere(5, 6)
    mesh = ThermalMesh.from_temperature(surface, np.full(len(surface), 33, np.float32), mode="absolute", anchored=True)
    for path in export(mesh, world / "again", ["ply", "glb", "vtp", "csv", "obj", "stl", "vtk-mesh"]):
        spared(path)
    (world / "p.png").write_bytes(encode_png(np.zeros((4, 4, 3), np.uint8)))
    spared(world / "p.png")
    verbs = (["measure", "result", "--regions", "drawn.json", "-o", "m"], ["compare", "result", "result", "-o", "c"])
    verbs += (["board", "-o", "b.svg"], ["board", "-o", "b.pdf"])
    for arguments in (*verbs, *verbs):
        with pytest.raises(SystemExit) as stopped:
            main(arguments)
        assert stopped.value.code == 0, capsys.readouterr().err
    assert json.loads((world / "m.json").read_text())["schema"] == "thermofusion-measured/1"
