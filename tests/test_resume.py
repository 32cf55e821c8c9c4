"""A resumed run is a fresh one, bit for bit, whichever key of the recipe was changed in between."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import Literal, get_args, get_origin

import numpy as np
import pytest
from pydantic import BaseModel
from threadpoolctl import threadpool_info, threadpool_limits

from thermofusion.errors import ThermofusionError
from thermofusion.files.strict import _bounds
from thermofusion.phantom import load_scene, simulate
from thermofusion.pipeline import STAGES, fuse
from thermofusion.recipe import Recipe, load_recipe
from thermofusion.scans import open_scan

BASE = ["surface.voxel_mm=10", "tracking.fragment_frames=3", "output.views=false", "output.formats=[]"]
BASE += ["output.report=false", "temperature.crosscal.max_vertices=1000", "temperature.crosscal.vignetting=false"]
SPECIAL = {  # where a value has to fit others
    "mapping.last_resort_angle_deg": 80.0,
    "mapping.max_angle_deg": 50.0,
    "input.max_depth_m": 0.75,
    "input.min_depth_m": 0.75,
    "temperature.emissivity.angles_deg": [0.0, 90.0],
    "temperature.emissivity.values": [0.98, 0.2],
    "temperature.emissivity.k": 0.1,
    "temperature.emissivity.model": "water",
    "temperature.crosscal.field": {"K": [0.05] * 14, "sigma_K": [0.05] * 14, "width_px": 160, "height_px": 120},
    "temperature.method": "mean",
    "temperature.air_degC": 30.0,
    "temperature.transmission_per_m": 0.9,
    "surface.truncation_voxels": 4.0,
    "temperature.reflected_degC": 27.0,
}


def keys(model=Recipe, prefix=""):
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from keys(field.annotation, f"{prefix}{name}.")
        elif prefix and not prefix.startswith(("output.", "quality.")):
            yield f"{prefix}{name}", field


def changed(key, field, now):
    """Another value that the key may have."""
    if key in SPECIAL:
        return SPECIAL[key]
    words = [w for part in (field.annotation, *get_args(field.annotation)) if get_origin(part) is Literal
             for w in get_args(part)]  # fmt: skip
    if isinstance(now, bool):
        return not now
    if words and not isinstance(now, float):
        return next(w for w in words if w != now)
    low, high = _bounds(field)
    if isinstance(now, int):
        return now + 1
    value = 1.5 * now if now else (1.0 if now is not None else 0.5 * ((low or 0) + min(high or 2, 2)))
    value = min(max(value, low or value), high or value)
    return float(value)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A small sphere with a blackbody in view, its poses known."""
    scene = load_scene("sphere")
    walk, depth = replace(scene.walk, depth_frames=12, depth_hz=3.0), replace(scene.depth, scale=0.25)
    thermal = replace(scene.thermal, scale=0.25, every=1)
    return open_scan(simulate(replace(scene, walk=walk, depth=depth, thermal=thermal, color=None),
                              tmp_path_factory.mktemp("sphere") / "scan", seed=0))  # fmt: skip


@pytest.fixture(scope="module")
def first(scan, tmp_path_factory):
    """A finished result of the recipe that everything is changed against."""
    out = tmp_path_factory.mktemp("first") / "result"
    fuse(scan, load_recipe({}, BASE), out=out)
    return out


def outcome(scan, recipe, out=None):
    """All numbers of a run, or the sentence it ends with."""
    try:
        result = fuse(scan, recipe, out=out)
    except ThermofusionError as e:
        return {"error": e.cause}
    mesh = result.mesh
    columns = ("temperature_degC", "apparent_degC", "uncertainty_K", "view_angle_deg", "observations", "flags")
    parts = {f"sigma of {k}": v for k, v in mesh.uncertainty_parts.items()}
    arrays = {"vertices_m": mesh.surface.vertices_m, "triangles": mesh.surface.triangles, **parts}
    return arrays | {k: getattr(mesh, k) for k in columns} | {"poses": result.trajectory.T_world_depth}


def test_every_key_belongs_to_a_stage():
    read = {section for stage in STAGES for section in stage.reads}
    assert {key.split(".")[0] for key, _ in keys()} == read


@pytest.mark.parametrize(("key", "field"), list(keys()), ids=lambda x: x if isinstance(x, str) else "")
def test_resumed_is_fresh(key, field, scan, first, tmp_path):
    recipe = load_recipe({}, BASE)
    now = recipe
    for part in key.split("."):
        now = getattr(now, part)
    value = changed(key, field, now)
    assert value != now
    tree = recipe.model_dump(mode="json", exclude_none=True)
    node = tree
    for part in key.split(".")[:-1]:
        node = node[part]
    node[key.split(".")[-1]] = value
    if key.startswith("temperature.emissivity.") and key.split(".")[-1] in ("angles_deg", "values"):
        tree["temperature"]["emissivity"] |= {"model": "tabulated", "angles_deg": [0.0, 90.0], "values": [0.98, 0.2]}
    if key == "temperature.emissivity.k":
        tree["temperature"]["emissivity"]["model"] = "non-dielectric"
    other = load_recipe(tree)
    shutil.copytree(first, tmp_path / "resumed")
    resumed, fresh = outcome(scan, other, tmp_path / "resumed"), outcome(scan, other)
    assert resumed.keys() == fresh.keys()
    for name in fresh:
        np.testing.assert_array_equal(resumed[name], fresh[name], err_msg=name)


def test_a_finished_result_is_taken_back_into_the_world(scan, tmp_path):
    """`result.npz` stands upright; a run that goes on from it hands out the same as one that computes."""
    upright = load_recipe({}, [*BASE, "output.frame=upright"])
    world = load_recipe({}, [*BASE, "output.frame=world"])
    fuse(scan, upright, out=tmp_path)
    resumed, fresh = fuse(scan, world, out=tmp_path), fuse(scan, world)
    assert resumed.report["stages_reused"][-1] == "temperature"
    assert resumed.report["run"] == fresh.report["run"] == resumed.mesh.metadata["run"]
    assert resumed.mesh.metadata == fresh.mesh.metadata
    np.testing.assert_array_equal(resumed.mesh.surface.vertices_m, fresh.mesh.surface.vertices_m)
    np.testing.assert_array_equal(resumed.mesh.temperature_degC, fresh.mesh.temperature_degC)


@pytest.mark.parametrize("folder", [True, False])
def test_blas_has_one_thread_whoever_calls(folder, scan, tmp_path):
    """In a notebook, say, where nobody set it before NumPy was loaded; afterwards it is as it was."""

    def threads():
        return [lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"]

    seen = []
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        fuse(
            scan,
            load_recipe({}, BASE),
            out=tmp_path if folder else None,
            progress=lambda *_: seen.append(threads()),
            until="mapping",
        )
        assert threads()[: len(before)] == before
    assert before
    assert max(before) == 2
    assert seen
    assert {n for counts in seen for n in counts} == {1}
