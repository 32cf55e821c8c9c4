"""Artifacts, atomic files and hashed stages."""

from __future__ import annotations

import json
import os
import resource
import stat
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thermofusion.errors import ResourceError, ScanError
from thermofusion.files.json import to_json
from thermofusion.files.whole import replacing, write_text
from thermofusion.progress import silent
from thermofusion.recipe import load_recipe
from thermofusion.results.artifacts import load_artifact, save_artifact
from thermofusion.results.folder import load_mesh
from thermofusion.results.frame import _toward_the_toes
from thermofusion.results.nouns import OLD_NAMES, stored
from thermofusion.results.stages import Stage, Stages
from thermofusion.types import SurfaceMesh, Trajectory


def test_artifacts_round_trip(tmp_path):
    mesh = SurfaceMesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.eye(3, dtype=np.float32))
    poses = Trajectory(np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))
    value = {"mesh": mesh, "poses": poses, "text": ("a", None, True, 3, float("nan")), "list": [1.5, np.float32(2)]}
    save_artifact(tmp_path / "a.npz", value)
    back = load_artifact(tmp_path / "a.npz")
    np.testing.assert_array_equal(back["mesh"].vertices_m, mesh.vertices_m)
    assert back["mesh"].vertices_m.dtype == np.float32
    assert back["mesh"].color_rgb is None
    np.testing.assert_array_equal(back["poses"].T_world_depth, poses.T_world_depth)
    assert back["text"][:4] == ("a", None, True, 3)
    assert np.isnan(back["text"][4])
    assert back["list"] == [1.5, 2.0]


def crafted(path, tree, arrays=(), **options):
    """A file of somebody else's making."""
    with zipfile.ZipFile(path, "w", **options) as z:
        for name, value in (("__tree__", np.frombuffer(json.dumps(tree).encode(), np.uint8)), *arrays):
            with z.open(f"{name}.npy", "w") as f:
                np.lib.format.write_array(f, value, allow_pickle=False)
    return path


@dataclass
class Foreign:
    x: int


def test_only_our_own_nouns_are_stored(tmp_path):
    for value, words in ((Foreign(1), "Foreign is no noun"), (crafted, "function cannot be stored")):
        with pytest.raises(TypeError, match=words):
            save_artifact(tmp_path / "b.npz", value)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name",
    [
        "thermofusion.files.whole:write_text",
        "thermofusion.results.nouns:class_of",
        "thermofusion.planted:Noun",
        "temperature/9",
        "os:system",
        {"a": 1},
        7,
    ],
)
def test_a_name_in_a_file_calls_and_imports_nothing(tmp_path, name, monkeypatch):
    marker = tmp_path / "marker"
    monkeypatch.setattr("importlib.import_module", lambda *_: pytest.fail("a file's word imports a module"))
    tree = {"type": name, "fields": {"path": {"path": str(marker)}, "text": "ran"}}
    with pytest.raises(ScanError, match="does not know") as caught:
        load_artifact(crafted(tmp_path / "a.npz", tree))
    assert caught.value.exit_code == 3
    assert not marker.exists()


BOMB = np.zeros(600 << 20, np.uint8)


@pytest.mark.parametrize(
    "make",
    [
        lambda p: crafted(p, {"array": "big"}, [("big", BOMB)], compression=zipfile.ZIP_DEFLATED),
        lambda p: crafted(p, {"array": "a"}, [("a", np.zeros(9))], compression=zipfile.ZIP_BZIP2),
        lambda p: crafted(p, [[[{"array": "nothing"}]]]),
        lambda p: crafted(p, {"type": "trajectory/1", "fields": []}),
        lambda p: crafted(p, {"type": "trajectory/1", "fields": {"times_s": 1, "T_world_depth": 2, "more": 3}}),
        lambda p: crafted(p, {"type": "trajectory/1", "fields": {}}),
        lambda p: crafted(p, {"neither": 1}),
        lambda p: crafted(p, {}),
        lambda p: (p.write_bytes(b"") and p) or p,
        lambda p: p.write_bytes(b"PK\x03\x04torn") and p,
        lambda p: crafted(p, None, [(f"m{i}", np.zeros(0)) for i in range(5000)]),
        lambda p: p.write_bytes(p.with_suffix(".ok").read_bytes()[:-100]) and p,
    ],
)
def test_a_damaged_or_swollen_file_is_one_sentence_and_little_memory(tmp_path, make):
    save_artifact(tmp_path / "a.ok", Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1))))
    path = make(tmp_path / "a.npz")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ScanError, match="damaged, or no result"):
        load_artifact(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


def test_a_header_that_claims_more_than_there_is_allocates_nothing(tmp_path):
    path = crafted(tmp_path / "a.npz", {"array": "a"}, [("a", np.zeros(4, np.uint8))])
    path.write_bytes(path.read_bytes().replace(b"(4,), ", b"(9,), "))
    with pytest.raises(ScanError):
        load_artifact(path)


def test_a_result_of_an_earlier_layout_stays_readable(tmp_path):
    """Written by version 0.1.0 when `Temperature` lived in `thermometry`."""
    old = Path(__file__).parent / "data" / "result-0.1.0"
    mesh, kept = load_mesh(old), json.loads((old / "figures.json").read_text())
    assert np.nanmedian(mesh.temperature_degC) == pytest.approx(kept["median_degC"], abs=1e-6)
    assert len(mesh) == kept["vertices"]
    assert load_mesh(old, "apparent").mode == "apparent"
    temperature = load_artifact(old / "result.npz")
    assert temperature.calibration.offsets_K == pytest.approx(kept["offsets_K"], abs=1e-9)
    save_artifact(tmp_path / "again.npz", temperature)
    again = load_artifact(tmp_path / "again.npz")
    np.testing.assert_array_equal(again.mesh.temperature_degC, mesh.temperature_degC)
    assert b"thermofusion." not in (tmp_path / "again.npz").read_bytes()


def test_every_stored_noun_has_one_name_and_old_names_lead_to_one():
    kinds = {(name.split("/")[0], cls) for name, cls in stored().items()}
    assert len(kinds) == len({name for name, _ in kinds}) == len(set(stored().values()))
    assert set(OLD_NAMES.values()) <= set(stored())


def test_files_appear_whole_or_not_at_all(tmp_path):
    path = tmp_path / "x" / "out.txt"
    write_text(path, "old thermofusion")
    with pytest.raises(RuntimeError), replacing(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old thermofusion"
    assert [p.name for p in path.parent.iterdir()] == ["out.txt"]
    with pytest.raises(ResourceError, match="cannot be written"), replacing(path):
        raise OSError(28, "No space left on device")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    for name in ("pipe", "link", "x"):  # a device is never replaced by a file
        with pytest.raises(ResourceError, match="stands where"):
            write_text(tmp_path / name, "thermofusion")
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)


A, B = Stage("a", ("input",)), Stage("b", ("input", "mapping"))


def run(folder, scan, calls, recipe, stages=(A, B), **options):
    """Two stages; each notes that it was computed, and what it was handed."""
    runner = Stages(folder, {"scan": scan}, recipe)

    def compute(name, before=0.0):
        def stage(*, progress, **sections):
            calls.append((name, *sections))
            return Trajectory(np.array([before + sections["input"].min_depth_m]), np.eye(4)[None])

        return stage

    first, second = stages
    a = runner.run(first, compute("a"), silent, **options)
    runner.run(second, compute("b", float(a.times_s[0])), silent)
    return runner


def test_a_stage_reruns_when_its_inputs_or_an_earlier_stage_change_and_says_why(tmp_path):
    calls: list[tuple] = []
    recipe = load_recipe({})
    run(tmp_path, "s", calls, recipe)
    assert calls == [("a", "input"), ("b", "input", "mapping")]  # exactly what its key holds
    assert run(tmp_path, "s", calls, recipe).reused == ["a", "b"]
    other = load_recipe({"mapping": {"border_px": 9}, "output": {"views": False}})
    assert run(tmp_path, "s", calls, other).reused == ["a"]
    assert [c[0] for c in calls] == ["a", "b", "b"]

    def whys(scan="s", recipe=other, stages=(A, B)):
        runner = Stages(tmp_path, {"scan": scan}, recipe)
        return [runner.plan(stage).why for stage in stages]

    assert whys() == ["inputs unchanged"] * 2
    near = load_recipe({"input": {"min_depth_m": 0.5}, "mapping": {"border_px": 9}})
    assert whys(recipe=near) == ["changed: input.min_depth_m"] * 2
    assert whys(scan="other") == ["changed: scan"] * 2
    assert whys(stages=(replace(A, edition=2), B)) == ["changed: edition", "an earlier stage changed"]
    assert run(tmp_path, "s", calls, other, anew=True).reused == ["b"]  # the same bits again: the next one still fits

    before = list(calls)
    for damage in (b"torn", b"", (tmp_path / "stages" / "a.npz").read_bytes()[:200]):
        (tmp_path / "stages" / "a.npz").write_bytes(damage)
        assert whys()[0] == "what is stored cannot be read"
        run(tmp_path, "s", calls, other)
    assert [c[0] for c in calls[len(before) :]] == ["a"] * 3


def test_what_an_earlier_version_left_under_other_names_goes(tmp_path):
    (tmp_path / "stages").mkdir()
    for name in ("track.npz", "track.json", "observe.npz", "mine.txt"):
        (tmp_path / "stages" / name).write_text("x")
    Stages(tmp_path, {}, load_recipe({})).tidy()
    assert [p.name for p in (tmp_path / "stages").iterdir()] == ["mine.txt"]


def test_json_has_no_nan():
    assert to_json({"a": np.array([1.0, np.nan]), "b": (np.int32(3), float("inf"))}).split() == (
        ["{", '"a":', "[", "1.0,", "null", "],", '"b":', "[", "3,", "null", "]", "}"]
    )


def test_feet_say_where_the_front_is_and_cut_legs_say_nothing():
    """Legs of 10 cm across with feet of 26 cm, turned; then the same legs cut off at two heights."""
    rng, turned = np.random.default_rng(0), Rotation.from_rotvec([0, 0, 0.7]).as_matrix()

    def legs(bottom_m):
        angle, height = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(0, 1.6, 4000)
        ring = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), height], 1)
        return np.concatenate([ring[height > b] + [x, 0, 0] for x, b in zip((-0.12, 0.12), bottom_m, strict=True)])

    feet = [rng.uniform([x - 0.05, -0.21, 0], [x + 0.05, 0.05, 0.07], (900, 3)) for x in (-0.12, 0.12)]
    front = turned @ [0, -1, 0]
    found = _toward_the_toes(np.concatenate([legs((0.05, 0.05)), *feet]) @ turned.T, np.array([0.0, 0, 1]))
    assert found @ front / np.linalg.norm(found) > 0.99
    for cut in ((0.3, 0.3), (0.2, 0.3), (0.1, 0.45)):
        assert _toward_the_toes(legs(cut) @ turned.T, np.array([0.0, 0, 1])) is None
