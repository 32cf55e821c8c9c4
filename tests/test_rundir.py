"""Artifacts, atomic files and hashed stages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from thermofusion.errors import ResourceError
from thermofusion.files.json import to_json
from thermofusion.files.whole import replacing, write_text
from thermofusion.results.artifacts import load_artifact, save_artifact
from thermofusion.results.stages import Stages
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


@dataclass
class Foreign:
    x: int


def test_an_artifact_names_only_our_own_types(tmp_path):
    save_artifact(tmp_path / "a.npz", Foreign(1))
    with pytest.raises(ValueError, match="may not name"):
        load_artifact(tmp_path / "a.npz")
    with pytest.raises(TypeError, match="function cannot be stored"):
        save_artifact(tmp_path / "b.npz", test_artifacts_round_trip)
    assert not (tmp_path / "b.npz").exists()


def test_files_appear_whole_or_not_at_all(tmp_path):
    path = tmp_path / "x" / "out.txt"
    write_text(path, "old")
    with pytest.raises(RuntimeError), replacing(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert [p.name for p in path.parent.iterdir()] == ["out.txt"]
    with pytest.raises(ResourceError, match="cannot be written"), replacing(path):
        raise OSError(28, "No space left on device")


def run(folder, base, calls, inputs, **options):
    stages = Stages(folder, base, order=("a", "b"), **options)
    a = stages.run("a", inputs["a"], lambda: calls.append("a") or np.array([inputs["a"]["x"]]))
    stages.run("b", inputs["b"], lambda: calls.append("b") or a * 2)
    return stages


def test_a_stage_reruns_when_its_inputs_or_an_earlier_stage_change_and_says_why(tmp_path):
    calls: list[str] = []
    inputs = {"a": {"x": 1}, "b": {"y": {"z": 2}}}
    run(tmp_path, {"scan": "s"}, calls, inputs)
    assert calls == ["a", "b"]
    assert run(tmp_path, {"scan": "s"}, calls, inputs).reused == ["a", "b"]
    run(tmp_path, {"scan": "s"}, calls, {**inputs, "b": {"y": {"z": 3}}})
    assert calls == ["a", "b", "b"]

    plan = Stages(tmp_path, {"scan": "s"})
    assert plan.plan("a", {"x": 5}).why == "changed: x"
    assert plan.plan("b", {"y": {"z": 3}}).why == "an earlier stage changed"
    plan = Stages(tmp_path, {"scan": "other"})
    assert plan.plan("a", {"x": 1}).why == "changed: scan"
    assert not Stages(tmp_path, {"scan": "s"}, redo_from="b", order=("a", "b")).plan("a", {"x": 2}).reuse

    (tmp_path / "stages" / "a.npz").write_bytes(b"torn")
    run(tmp_path, {"scan": "s"}, calls, {**inputs, "b": {"y": {"z": 3}}})
    assert calls[-1] == "a"


def test_json_has_no_nan():
    assert to_json({"a": np.array([1.0, np.nan]), "b": (np.int32(3), float("inf"))}).split() == (
        ["{", '"a":', "[", "1.0,", "null", "],", '"b":', "[", "3,", "null", "]", "}"]
    )
