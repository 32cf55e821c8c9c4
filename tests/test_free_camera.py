"""A thermal camera that is not on the depth rig: a small simulated scan through the real readers, against its truth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from thermofusion.errors import ScanError
from thermofusion.geometry.outline import ProjectedContour
from thermofusion.geometry.rays import RayScene
from thermofusion.geometry.rigid import invert, rotation_angle_deg, se3_log
from thermofusion.phantom import scene_from_mapping, simulate
from thermofusion.phantom.physics import fresnel_emissivity
from thermofusion.pipeline import fuse
from thermofusion.recipe import load_recipe
from thermofusion.rig.edges import find_edges, smooth_image
from thermofusion.rig.free.limb import limb_shift_px
from thermofusion.scans import open_scan, with_thermal
from thermofusion.scans.check import check_scan
from thermofusion.scans.native.write import write_scan
from thermofusion.scans.thermal import ThermalSaid, read_thermal

HOURS_LATER_S = 7200.0
WALK = {"radius_m": 1.15, "height_from_m": 1.35, "height_to_m": 1.3, "look_from_m": 1.2, "look_to_m": 1.2}
SCENE = {
    "name": "free",
    "shape": {"kind": "body", "subdivisions": 1, "arms_deg": 10.0},
    "skin": {"smooth_K": 0.7, "spots": 24, "veins_K": 0.5, "extremities_K": 3.0},
    "room": {"reflected_degC": 22.8},
    "walk": {**WALK, "depth_frames": 60, "tremor_mm": 2.0},
    "depth": {"scale": 0.5},
    "thermal": {
        "scale": 0.5,
        "netd_K": 0.04,
        "drift": {"level_K": 0.4, "ramp_K_per_min": 1.0},
        "apart": {
            **{**WALK, "radius_m": 1.3, "radius_wobble_m": 0.08, "height_wobble_m": 0.1, "start_deg": 130.0},
            **{"roll_deg": 4.0, "turns": -1.0, "tremor_mm": 4.0, "tremor_deg": 1.0},
            **{"frames": 12, "hz": 1.0, "start_s": HOURS_LATER_S},
        },
    },
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return simulate(scene_from_mapping(SCENE), tmp_path_factory.mktemp("free") / "scan", seed=4)


@pytest.fixture(scope="module")
def fused(recorded):
    return fuse(open_scan(recorded), load_recipe("torso"))


def true_poses(recorded):
    """T_body_thermal (N, 4, 4), by the writer's columns: t x y z qx qy qz qw; the body is the world of given poses."""
    from scipy.spatial.transform import Rotation

    rows = np.loadtxt(recorded / "truth" / "thermal_trajectory.txt")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]
    return T


def test_views_are_placed_against_the_surface_hours_after_it_and_say_how_well(recorded, fused):
    free = fused.rig.free
    T, truth = free.T_world_thermal, true_poses(recorded)[free.frame]
    off_mm = 1e3 * np.linalg.norm(T[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert len(free.frame) == 12
    assert fused.rig.converged
    assert np.median(off_mm) < 2
    assert np.median(rotation_angle_deg(invert(T) @ truth)) < 0.2
    error = np.stack([se3_log(x) for x in invert(T) @ truth])
    chi2 = np.einsum("ni,ni->n", error, np.linalg.solve(free.covariance, error[..., None])[..., 0]) / 6
    assert 0.1 < chi2.mean() < 3
    told = fused.report["rig"]
    assert told["mount"] == "free"
    assert [v["index"] for v in told["views"]] == list(range(12))


def test_temperature_is_as_good_as_from_a_rig(recorded, fused):
    with np.load(recorded / "truth" / "surface.npz") as z:
        vertices, triangles, degC = z["vertices_m"], z["triangles"], z["temperature_degC"]
    found = RayScene(vertices, triangles).closest(fused.surface.mesh.vertices_m)
    true = (degC[triangles[found.triangle]] * found.weights).sum(axis=1)
    mesh = fused.temperature.mesh
    good = np.isfinite(mesh.temperature_degC) & (found.distance < 0.008) & (mesh.view_angle_deg < 60)
    error = mesh.temperature_degC[good] - true[good]
    error -= np.median(error)
    assert good.mean() > 0.5
    assert np.percentile(np.abs(error), 95) < 0.12
    assert np.mean(np.abs(error) < 1.96 * mesh.uncertainty_K[good]) > 0.9


def test_a_scan_says_that_its_thermal_camera_is_free_and_clocks_do_not_matter(recorded, tmp_path):
    scan = open_scan(recorded)
    assert scan.thermal.camera.mount == "free"
    assert scan.thermal.times_s[0] - scan.depth.times_s[-1] > HOURS_LATER_S / 2
    assert not [f for f in check_scan(scan).findings if f.severity != "ok"]
    document = json.loads((write_scan(scan, tmp_path / "again") / "scan.json").read_text())
    assert document["cameras"]["thermal"]["mount"] == "free"
    assert "T_thermal_depth" not in document["extrinsics"]


def test_where_no_view_shows_the_subject_one_sentence_says_so(recorded):
    scan, recipe = open_scan(recorded), load_recipe("torso")
    stream = scan.thermal
    rng, cold = np.random.default_rng(1), int(stream.load(0).min())
    noise = rng.integers(0, 4, stream.camera.lens.shape).astype(np.uint16)
    even = replace(scan, thermal=replace(stream, load=lambda i: noise + cold))
    with pytest.raises(ScanError, match="does not stand out of the room"):
        fuse(even, recipe)
    # warm things, but nobody of this shape
    blobs = np.kron(rng.integers(0, 2, (6, 8)), np.ones((40, 40))) * 400 + cold
    other = replace(scan, thermal=replace(stream, load=lambda i: np.roll(blobs, 40 * i, 1).astype(np.uint16)))
    with pytest.raises(ScanError, match="can be placed"):
        fuse(other, recipe)


@pytest.mark.parametrize("radius_px", [6.0, 25.0, 100.0])
def test_an_edge_lies_inside_a_round_body_as_far_as_the_limb_model_says(radius_px):
    u = np.arange(-20, 20, 0.05)  # a cylinder of skin whose outline stands at u = 0, drawn by the phantom's optics
    cos = np.sqrt(np.clip(1 - np.clip(1 + u / radius_px, -1, 1) ** 2, 0, 1))
    bright = np.where((u < 0) & (u > -2 * radius_px), fresnel_emissivity(cos, 1.33), 0.0)
    fine = gaussian_filter1d(bright, 0.7 / 0.05)
    normal, still, found = np.tile([1.0, 0.0], (9, 1)), np.zeros((9, 3)), []
    for phase in np.arange(0, 1, 0.1):  # where between two pixels the outline falls
        row = np.array([fine[np.abs(u - c + phase) <= 0.5].mean() for c in range(-18, 19)])
        image = smooth_image(np.tile(row, (40, 1)).astype(np.float32))
        points = np.column_stack([np.full(9, 18.0 + phase), np.arange(16.0, 25.0)])
        found.append(np.median(find_edges(image, ProjectedContour(points, normal, still, still), 3.0, 1.0).offset_px))
    inside = np.sqrt(1 - (1 - 4 / radius_px) ** 2)
    assert np.mean(found) == pytest.approx(limb_shift_px(np.full(9, inside), 4.0)[0], abs=0.06)


def test_a_round_subject_is_refused_for_it_looks_alike_from_every_side(tmp_path):
    walk = {"height_from_m": 0.35, "height_to_m": 0.35, "look_from_m": 0.25, "look_to_m": 0.25}
    apart = {**SCENE["thermal"]["apart"], **walk, "frames": 5, "start_s": 0.0}
    scene = {
        "shape": {"kind": "cylinder", "diameter_m": 0.3, "edge_mm": 12.0},
        "skin": {"mean_degC": 35.0, "smooth_K": 0.8},
        "walk": {**walk, "radius_m": 1.1, "depth_frames": 40},
        "depth": {"scale": 0.5, "noise": False},
        "thermal": {"scale": 0.5, "netd_K": 0.04, "apart": apart},
    }
    scan = open_scan(simulate(scene_from_mapping(scene), tmp_path / "scan", seed=1))
    with pytest.raises(ScanError, match="from several sides"):
        fuse(scan, load_recipe("phantom-cylinder"))


def test_frames_of_another_clock_join_by_their_lens_alone(recorded, tmp_path):
    scan = open_scan(recorded)
    document = json.loads((recorded / "scan.json").read_text())
    lens = {k: v for k, v in document["cameras"]["thermal"].items() if k != "mount"}
    rig = tmp_path / "rig.json"
    rig.write_text(json.dumps({"cameras": {"thermal": lens}}))
    camera = scan.thermal.camera
    frames = read_thermal(recorded / "thermal", ThermalSaid(curve=camera.signal), camera.lens.shape)
    with pytest.raises(ScanError, match="--free"):
        with_thermal(replace(scan, thermal=None), frames, rig)
    joined = with_thermal(replace(scan, thermal=None), frames, rig, free=True)
    assert joined.thermal.camera.mount == "free"
    assert len(joined.thermal) == 12
