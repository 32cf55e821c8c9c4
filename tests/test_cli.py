"""The command line as a user meets it: the demo end to end, resume, exit codes, one sentence per error."""

from __future__ import annotations

import itertools
import json
import tomllib

import numpy as np
import pytest
from support.truth import truth_of

from thermofusion.cli import main
from thermofusion.export import read_mesh, read_trajectory
from thermofusion.files.shipped import data_dir
from thermofusion.recipe import Recipe
from thermofusion.results.artifacts import load_artifact


def call(capsys, *arguments):
    """(exit code, stdout, stderr) of `thermofusion arguments`."""
    with pytest.raises(SystemExit) as stopped:
        main(list(map(str, arguments)))
    captured = capsys.readouterr()
    return stopped.value.code, captured.out, captured.err


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The demo's result folder and report."""
    out = tmp_path_factory.mktemp("demo") / "result"
    with pytest.raises(SystemExit) as stopped:
        main(["demo", "-o", str(out), "--json"])
    assert stopped.value.code == 0
    return out, json.loads((out / "result.json").read_text())


def test_the_demo_finds_the_true_temperatures(demo):
    """Poses withheld, rig and clock as written, blackbody in three frames; truth at the nearest true vertex."""
    out, report = demo
    truth = truth_of(data_dir() / "demo")
    mesh = read_mesh(out / "mesh.ply")
    T_true_world = _to_truth(out)
    p = mesh.surface.vertices_m @ T_true_world[:3, :3].T + T_true_world[:3, 3]
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(truth["vertices_m"]).query(p, distance_upper_bound=0.02)
    good = mesh.measured & np.isfinite(distance) & (mesh.view_angle_deg < 55) & (mesh.observations >= 3)
    error = mesh.temperature_degC[good] - truth["temperature_degC"][nearest[good]]
    relative = np.abs(error - np.median(error))
    assert good.mean() > 0.6
    assert relative.mean() < 0.07  # with the 5 mm or so between a vertex and the nearest true one
    assert abs(np.median(error)) < 0.15
    assert report["tracking"]["tracked"] == report["tracking"]["frames"] == 90
    assert report["temperature"]["anchored"] is True
    assert report["quality"]["failed"] == []
    stated, used = (row for row in report["radiometry"] if row["what"].startswith("reflected"))
    assert stated["source"] == "scan.json"
    assert used["source"] == "background of the views"
    said, taken = (float(row["value"].split()[0]) for row in (stated, used))
    low, high = sorted((said, said + report["temperature"]["room"]["mean_differs_from_stated_K"]))
    assert low - 0.006 <= taken <= high + 0.006  # as both say, to the digits that are told


def _to_truth(out):
    from thermofusion.geometry.rigid import rigid_alignment

    estimated, true = (read_trajectory(p) for p in (out / "trajectory.txt", data_dir() / "demo/truth/trajectory.txt"))
    i = np.searchsorted(true.times_s, estimated.times_s - 1e-4)
    return rigid_alignment(estimated.T_world_depth[:, :3, 3], true.T_world_depth[i, :3, 3])


def test_a_result_folder_is_complete(demo):
    out, _ = demo
    files = [p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file() and "stages" not in p.parts]
    names = set(files) - {".thermofusion.lock"}
    assert names == set(json.loads((out / "result.json").read_text())["files"])
    views = {f"views/{v}.png" for v in ("front", "back", "left", "right", "overview", "uncertainty", "residual")}
    assert names == {
        *("mesh.ply", "mesh.glb", "mesh.vtp", "trajectory.txt", "result.json", "result.npz", "recipe.resolved.toml"),
        "report.html",
        *views,
    }
    assert Recipe.model_validate(tomllib.loads((out / "recipe.resolved.toml").read_text())).name == "torso"
    shown = load_artifact(out / "result.npz")
    for mode in ("absolute", "normal-equivalent", "apparent"):
        assert shown.shown(mode).mode == mode
    # a skin at 33 °C in a cooler room: absolute > normal-equivalent > apparent, everywhere but in noise
    steps = [shown.apparent_degC, shown.normal_equivalent_degC, shown.absolute_degC]
    assert all(np.nanmedian(b - a) > 0 for a, b in itertools.pairwise(steps))


def test_nothing_is_computed_twice_and_the_plan_says_why(demo, capsys):
    out, _ = demo
    scan = data_dir() / "demo"
    code, text, _ = call(capsys, "run", scan, "-r", "torso", "-o", out, "--dry-run", "--json")
    assert code == 0
    assert all(p["reuse"] for p in json.loads(text))
    changed = ("--set", "temperature.reflected_degC=21")
    code, text, _ = call(capsys, "run", scan, "-r", "torso", "-o", out, "--dry-run", "--json", *changed)
    plan = {p["name"]: p for p in json.loads(text)}
    assert plan["tracking"]["reuse"]
    assert plan["surface"]["reuse"]
    assert not plan["temperature"]["reuse"]
    again = [(out / name).read_bytes() for name in ("mesh.ply", "result.npz")]
    assert not (out / "stages" / "temperature.npz").exists()  # result.npz holds it
    code, text, _ = call(capsys, "run", scan, "-r", "torso", "-o", out, "--json")
    assert code == 0
    assert json.loads(text)["stages_reused"] == ["tracking", "surface", "rig", "mapping", "temperature"]
    assert [(out / name).read_bytes() for name in ("mesh.ply", "result.npz")] == again


def test_export_writes_other_formats_palettes_and_modes(demo, tmp_path, capsys):
    out, _ = demo
    code, _, _ = call(
        capsys, *("export", out, "-o", tmp_path, "--format", "ply,csv", "--show", "apparent", "--range", "28:36")
    )
    assert code == 0
    mesh = read_mesh(tmp_path / "mesh-apparent.ply")
    assert mesh.mode == "apparent"
    np.testing.assert_array_equal(mesh.temperature_degC, read_mesh(out / "mesh.ply").apparent_degC)
    assert (tmp_path / "mesh-apparent.csv").is_file()
    assert read_mesh(out / "mesh.ply").mode == "absolute"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run"], 2, ["Missing argument"]),
        (["run", "nowhere"], 3, ["nowhere", "no such scan"]),
        (["run", "DEMO", "-r", "tors"], 2, ["did you mean 'torso'"]),
        (["run", "DEMO", "--set", "surface.voxelmm=3"], 2, ["surface.voxelmm", "voxel_mm"]),
        (["run", "DEMO", "--until", "fuse"], 2, ["no stage 'fuse'", "surface"]),
        (["run", "DEMO", "--format", "tmu"], 2, ["tmu", "tum"]),
        (["export", "nowhere"], 3, ["no finished result"]),
        (["export", "nowhere", "--range", "36:26"], 2, ["low < high"]),
        (["recipe", "lsit"], 2, ["list"]),
        (["import", "nowhere", "-o", "x"], 3, ["no such scan"]),
        (["simulate", "torsso", "-o", "x"], 2, ["torso"]),
    ],
)
def test_errors_are_one_sentence_with_the_documented_code(arguments, code, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = [str(data_dir() / "demo") if a == "DEMO" else a for a in arguments]
    got, out, err = call(capsys, *arguments)
    assert got == code
    assert not out
    assert err.startswith("error: ")
    assert len(err.strip().splitlines()) == 1
    for word in words:
        assert word in err
    assert not list(tmp_path.iterdir())  # nothing partial is left


def test_doctor_recipe_and_check_answer(capsys):
    code, text, _ = call(capsys, "doctor", "--json")
    assert code == 0
    assert {"python", "open3d loads", "memory"} <= {f["subject"] for f in json.loads(text)}
    code, text, _ = call(capsys, "recipe", "show", "torso")
    assert code == 0
    assert tomllib.loads(text)["temperature"]["emissivity"]["model"] == "dielectric"
    code, text, _ = call(capsys, "recipe", "show", "torso", "--source")
    assert text.startswith("# torso")
    code, text, _ = call(capsys, "check", data_dir() / "demo", "--json")
    assert code == 0
    assert not json.loads(text)["unusable"]


def test_a_scan_without_thermal_frames_becomes_a_mesh_without_temperatures(tmp_path, capsys):
    from dataclasses import replace

    import thermofusion as tf
    from thermofusion.scans.native.write import excerpt, write_scan

    scan = excerpt(tf.open_scan(data_dir() / "demo"), depth=slice(0, 6), color=slice(0, 2), thermal=slice(0, 0))
    scan = replace(scan, thermal=None, references=())
    write_scan(scan, tmp_path / "scan")
    code, text, _ = call(capsys, "run", tmp_path / "scan", "-o", tmp_path / "out", "--json")
    assert code == 0
    mesh = read_mesh(tmp_path / "out" / "mesh.ply")
    assert not mesh.measured.any()
    assert any("no thermal" in m for m in json.loads(text)["messages"])
