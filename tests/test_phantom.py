"""The phantom measures itself: its physics against closed forms, its sensors against their statistics, its scans
through the real reader against the solver's own (independent) forward model."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.truth import truth_of

from thermofusion.errors import RecipeError, ScanError
from thermofusion.files.tum import read_trajectory
from thermofusion.geometry.rigid import interpolate_trajectory, rotation_angle_deg, transform_points
from thermofusion.phantom import Studio, build_phantom, load_scene, scene_from_mapping, shipped_scenes, simulate
from thermofusion.phantom.depth_cameras import depth_camera, measure_depth
from thermofusion.phantom.physics import Band, fresnel_emissivity
from thermofusion.phantom.render import image_rays
from thermofusion.phantom.scene import DepthConfig, DriftConfig, ShapeConfig, ThermalConfig
from thermofusion.phantom.shapes import build_shape
from thermofusion.phantom.thermal_cameras import counts_to_degC, draw_drift, expose, thermal_camera
from thermofusion.physics.band import Band as SolverBand
from thermofusion.physics.emissivity import Fresnel, model_from_recipe
from thermofusion.pipeline import fuse
from thermofusion.recipe import load_recipe
from thermofusion.scans import open_scan

SMALL = {
    "name": "small",
    "shape": {"kind": "body", "subdivisions": 0},
    "skin": {"mean_degC": 33.0, "smooth_K": 0.6, "spots": 6, "extremities_K": 3.0},
    "room": {"rays": 24},
    "walk": {"depth_frames": 24, "tremor_mm": 2.0, "tremor_deg": 0.3},
    "depth": {"scale": 0.25},
    "thermal": {"scale": 0.25, "every": 3},
}


def scene(**changes):
    """The small scene with some groups changed."""
    tree = {k: dict(v) if isinstance(v, dict) else v for k, v in SMALL.items()}
    for key, value in changes.items():
        tree[key] = {**tree.get(key, {}), **value} if isinstance(value, dict) else value
    return scene_from_mapping(tree)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small scan with every imperfection, its scene and its folder."""
    config = scene(
        rig={"rotation_error_deg": 0.4, "translation_error_mm": 3.0, "clock_error_s": 0.02},
        thermal={
            "vignetting_K": 0.3,
            "drift": {"level_K": 0.5, "shutter_every_s": 0.7},
            "blackbody": {"degC": 35.0, "frames": [0, 5]},
        },
        motion={"breathing_mm": 4.0, "sway_mm": 2.0, "sway_deg": 0.2},
        color={"width_px": 160, "height_px": 120, "every": 4},
        room={"floor": True, "wall_radius_m": 3.0, "transmission_per_m": 0.98},
    )
    out = tmp_path_factory.mktemp("phantom") / "scan"
    return config, simulate(config, out, seed=3)


# ---------------------------------------------------------------- physics


def test_planck_and_fresnel_match_the_reference_values():
    band = Band.of((7.5, 13.5))
    degC = np.array([23.0, 33.0, 37.0])
    np.testing.assert_allclose(band.emit(degC), [52.15789899, 61.08293643, 64.89666616], rtol=1e-8)
    np.testing.assert_allclose(band.invert(band.emit(degC + 0.0077)), degC + 0.0077, atol=1e-6)
    cos = np.cos(np.radians([0, 60, 85]))
    np.testing.assert_allclose(fresnel_emissivity(cos, 1.33), [0.9799406878, 0.9408744008, 0.4172717551], atol=1e-10)
    np.testing.assert_allclose(
        fresnel_emissivity(cos, 1.33, 0.25), [0.9687875587, 0.9173222454, 0.3796290041], atol=1e-10
    )
    np.testing.assert_allclose(fresnel_emissivity(cos, 2.84), [0.7703993056, 0.7439272474, 0.3921550387], atol=1e-10)


def test_isothermal_body_in_a_room_of_its_temperature_is_flat_to_1_mK():
    """The energy check: whatever ε(θ), reflections, floor, air path and patches do, nothing may show."""
    config = scene(
        skin={"mean_degC": 31.0, "smooth_K": 0, "spots": 0, "extremities_K": 0},
        material={"n": 2.84},
        patches=[{"name": "cap", "center_m": [0, 0, 1.7], "radius_m": 0.12}],
        room={
            "reflected_degC": 31.0,
            "air_degC": 31.0,
            "floor": True,
            "floor_degC": 31.0,
            "transmission_per_m": 0.9,
        },
    )
    studio = Studio.of(build_phantom(config))
    for i in range(0, 8, 3):
        apparent = studio.phantom.thermal.band.invert(studio.radiance(i))
        assert np.abs(apparent - 31.0).max() < 1e-3


@pytest.mark.parametrize("opening", [0.5, 0.03])
def test_reflections_in_a_bowl_reach_the_closed_form(opening):
    """Inside a sphere every point sees every other alike: F = 1 - opening, and with constant ε the received radiance
    is H = [(1 - F) L_room + F ε L] / [1 - F (1 - ε)]. A nearly closed bowl approaches a black body."""
    eps = 0.6
    config = scene_from_mapping(
        {
            "shape": {"kind": "bowl", "diameter_m": 0.2, "opening": opening, "edge_mm": 8},
            "skin": {"mean_degC": 44.0},
            "material": {"model": "diffuse", "epsilon": eps},
            "room": {"reflections": 20, "rays": 256},
            "walk": {"depth_frames": 3},
        }
    )
    p = build_phantom(config)
    middle = np.array([0, p.mesh.vertices_m[:, 1].max() - 1.05 * 0.1, 1.05 * 0.1])
    radius = np.linalg.norm(p.mesh.vertices_m - middle, axis=1)
    inside = (radius < 0.1001) & (p.mesh.vertices_m[:, 1] > p.mesh.vertices_m[:, 1].min() + 0.02)
    F = 1 - opening
    assert inside.sum() > 300
    assert abs(p.exchange.body_fraction[inside].mean() - F) < 0.01
    hot, cold = (float(p.thermal.band.emit(np.array(t))) for t in (44.0, 23.0))
    H = ((1 - F) * cold + F * eps * hot) / (1 - F * (1 - eps))
    leaving = eps * hot + (1 - eps) * p.exchange.incoming[inside].mean()
    expected = eps * hot + (1 - eps) * H
    assert abs(p.thermal.band.invert(leaving) - p.thermal.band.invert(expected)) < 0.12
    if opening < 0.1:
        assert 44.0 - p.thermal.band.invert(leaving) < 0.4  # the same surface in the open shows 36.3 °C


# ---------------------------------------------------------------- sensors


def test_thermal_noise_and_quantisation():
    model = thermal_camera(ThermalConfig(scale=0.5))
    flat = np.full((480, 640), model.band.emit(np.array(30.0)), np.float32)
    frames = np.stack([counts_to_degC(model, expose(model, flat, 0.0, np.random.default_rng(i))) for i in range(40)])
    step = counts_to_degC(model, np.array([20001])) - counts_to_degC(model, np.array([20000]))
    expected = np.hypot(model.netd_K, step[0] / np.sqrt(12))
    assert frames.std(0, ddof=1).mean() / expected == pytest.approx(1, abs=0.02)
    assert frames.mean() == pytest.approx(30.0, abs=1e-3)


def test_point_spread_has_the_stated_width():
    """A line one sample wide at every place within a pixel: variance = σ² + the pixel's own (1 - 1/s²)/12 px²."""
    s, sigma = 4, 0.7
    model = thermal_camera(ThermalConfig(scale=0.1, supersample=s, netd_K=0, psf_sigma_px=sigma))
    h, w = model.camera.shape
    base = float(model.band.emit(np.array(20.0)))
    moments = []
    for k in range(s):
        line = np.full((h * s, w * s), base, np.float32)
        line[:, w * s // 2 + k] += 40 * model.band.slope(30)
        degC = counts_to_degC(model, expose(model, line, 0.0, np.random.default_rng(0)))
        profile = model.band.emit(degC).mean(0)
        profile -= profile[0]  # the base as quantised
        at = (w * s // 2 + k + 0.5) / s - 0.5
        moments.append((profile * (np.arange(w) - at) ** 2).sum() / profile.sum())
    assert np.mean(moments) == pytest.approx(sigma**2 + (1 - 1 / s**2) / 12, rel=0.02)


def test_drift_statistics_and_shutter():
    config = DriftConfig(level_K=0.5, ramp_K_per_min=1.2, wander_K=0.1, shutter_every_s=5.0)
    times = np.arange(100) * 0.2
    draws = [draw_drift(config, times, np.random.default_rng(i)) for i in range(300)]
    offsets = np.stack([d[0] for d in draws])
    assert offsets[:, 0].std() == pytest.approx(np.hypot(0.5, 0.1), rel=0.15)
    assert abs(offsets.mean()) < 0.03
    assert all(3 <= d[1].sum() <= 5 for d in draws)
    jumps = np.abs(np.diff(offsets, axis=1))
    assert np.median(jumps) < 0.05 < jumps.max()


def test_offset_and_vignetting_arrive_in_the_image():
    model = thermal_camera(ThermalConfig(scale=0.25, netd_K=0, vignetting_K=0.4))
    flat = np.full((240, 320), model.band.emit(np.array(30.0)), np.float32)
    a, b = (counts_to_degC(model, expose(model, flat, x, np.random.default_rng(0))) for x in (0.0, 0.7))
    assert np.median(b - a) == pytest.approx(0.7, abs=2e-3)
    corners = a[[0, 0, -1, -1], [0, -1, 0, -1]].mean()
    assert a[60, 80] - corners == pytest.approx(0.4, abs=0.01)


@pytest.mark.parametrize("preset", ["kinect-v1", "kinect-v2", "azure-kinect", "realsense-d435"])
@pytest.mark.parametrize("tilt_deg", [0.0, 55.0])
def test_depth_noise_follows_the_published_model(preset, tilt_deg):
    """On a plane at 1.2 m, the residual's standard deviation is the model's, with the quantum's share."""
    model = depth_camera(DepthConfig(preset))
    rays = image_rays(model.camera)
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    z = (normal @ [0, 0, 1.2] / (rays @ normal)).astype(np.float32)
    z[(z < 0.2) | (z > 5)] = np.nan
    cos = -(rays @ normal) / np.linalg.norm(rays, axis=-1)
    theta = np.arccos(np.clip(cos, -1, 1)).astype(np.float32)
    none = np.zeros(z.shape, bool)
    mm = measure_depth(model, z, theta, none, np.random.default_rng(1)).astype(np.float64)
    middle = (np.abs(z - 1.2) < 0.05) & (mm > 0)
    assert middle.sum() > 2000
    quantum = model.disparity_step_px / model.disparity_px_m * z**2 if model.disparity_px_m else 0.001
    expected = np.sqrt(model.sigma_m(z, theta) ** 2 + quantum**2 / 12 + 1e-6 / 12)[middle]
    residual = (mm / 1e3 - z)[middle] / expected
    assert residual.std() == pytest.approx(1, abs=0.05)
    assert abs(residual.mean()) < 0.05


def test_depth_has_holes_at_grazing_angles_and_flying_pixels():
    model = depth_camera(DepthConfig("kinect-v2"))
    h, w = model.camera.shape
    z = np.full((h, w), 1.0, np.float32)
    z[:, w // 2 :] = 2.0
    theta = np.zeros((h, w), np.float32)
    theta[: h // 4] = np.radians(85)
    mm = measure_depth(model, z, theta, np.zeros((h, w), bool), np.random.default_rng(0))
    assert not mm[: h // 4 - 4].any()  # an edge may be cut some pixels aside
    assert ((mm > 1050) & (mm < 1950)).sum() > 0.2 * h
    assert not ((mm > 1050) & (mm < 1950))[:, : w // 2 - 5].any()


def test_camera_rays_invert_opencv_projection():
    camera = thermal_camera(ThermalConfig()).camera
    rays = image_rays(camera)[::40, ::40].reshape(-1, 3)
    uv, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
    v, u = np.mgrid[0:480:40, 0:640:40]
    np.testing.assert_allclose(uv.reshape(-1, 2), np.stack([u.ravel(), v.ravel()], 1), atol=1e-6)


# ---------------------------------------------------------------- surfaces and scenes


@pytest.mark.parametrize(
    "config",
    [
        *(ShapeConfig(kind=k) for k in ("cylinder", "sphere", "bowl", "torso")),
        *(ShapeConfig(kind=k, subdivisions=1) for k in ("body", "head", "hand")),
        ShapeConfig(subdivisions=0, arms_deg=-22, elbows_deg=20, legs_deg=-3, belly_m=0.06, girth_scale=1.15),
    ],
    ids=lambda c: f"{c.kind}{c.arms_deg or ''}",
)
def test_shapes_are_closed_and_face_outward(config):
    mesh = build_shape(config)
    f = mesh.triangles.astype(np.int64)
    edges = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    directed = edges[:, 0] * len(mesh) + edges[:, 1]
    assert len(np.unique(directed)) == len(directed)  # every edge once in each direction: closed and oriented
    assert np.isin(edges[:, 1] * len(mesh) + edges[:, 0], directed).all()
    corners = mesh.vertices_m[f].astype(np.float64)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume > 0
    if config.kind == "cylinder":
        assert volume == pytest.approx(np.pi * 0.0825**2 * 0.5, rel=0.01)
    if config.kind == "body":
        assert 0.05 < volume < 0.12
    assert mesh.vertices_m[:, 2].min() == pytest.approx(config.base_m, abs=1e-6)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("name", shipped_scenes())
def test_shipped_scenes_load_and_survive_a_round_trip(name, tmp_path):
    config = load_scene(name)
    assert config.name == name
    assert config.description
    path = tmp_path / "again.toml"
    path.write_text(config.to_toml(), encoding="utf-8")
    assert load_scene(path) == config


def test_wrong_scenes_are_refused_with_the_key():
    with pytest.raises(RecipeError, match=r"unknown key 'thermal.netd_k' \(did you mean 'netd_K'\?\)"):
        scene_from_mapping({"thermal": {"netd_k": 0.03}})
    with pytest.raises(RecipeError, match=r"key 'walk.radius_m': .*greater than 0.*-1"):
        scene_from_mapping({"walk": {"radius_m": -1}})
    with pytest.raises(RecipeError, match=r"no scene 'torzo' \(did you mean 'torso'\?\)"):
        load_scene("torzo")


# ---------------------------------------------------------------- scans


def test_scan_opens_and_says_what_it_should(small):
    config, root = small
    scan = open_scan(root)
    assert scan.notes == ()
    assert (len(scan.depth), len(scan.thermal), len(scan.color)) == (24, 8, 6)
    truth = truth_of(root)
    np.testing.assert_array_equal(np.flatnonzero(scan.thermal.usable), truth["thermal_index"])
    assert 0 < (~scan.thermal.usable).sum() < 4
    np.testing.assert_allclose(
        scan.thermal.times_s[scan.thermal.usable] + config.rig.clock_error_s, truth["thermal_times"], atol=1e-5
    )
    assert rotation_angle_deg(
        scan.thermal.camera.T_thermal_depth @ np.linalg.inv(truth["T_thermal_depth"])
    ) == pytest.approx(config.rig.rotation_error_deg, abs=1e-6)
    depth = scan.depth.load(0)
    assert np.isfinite(depth).mean() > 0.5  # the wall is seen
    shutter = scan.thermal.load(int(np.flatnonzero(~scan.thermal.usable)[0]))
    assert shutter.std() < 40  # 0.1 K


def test_depth_frames_lie_on_the_true_surface(small):
    """Back-projected through the reader with the true poses: within the Kinect's noise, breathing and sway included."""
    from thermofusion.geometry._open3d import o3d

    _, root = small
    scan, truth = open_scan(root), truth_of(root)
    trajectory = read_trajectory(root / "truth" / "trajectory.txt")
    surface = o3d.t.geometry.RaycastingScene()
    surface.add_triangles(o3d.core.Tensor(truth["vertices_m"]), o3d.core.Tensor(truth["triangles"].astype(np.uint32)))
    for i in (0, 11, 23):
        depth = scan.depth.load(i)
        v, u = np.nonzero(np.isfinite(depth) & (depth < 1.6))
        K = scan.rig.depth.K
        z = depth[v, u]
        points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], 1)
        points = transform_points(trajectory.T_world_depth[i], points)
        points = points[points[:, 2] > 0.3]  # the floor is room
        gap = surface.compute_signed_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
        assert len(points) > 1000
        assert abs(np.median(gap)) < 0.001
        assert np.median(np.abs(gap)) < 0.003


def test_truth_projects_to_the_images_through_the_solvers_forward_model(tmp_path):
    """True vertices, projected by OpenCV and sent through the *processing* code's Planck and Fresnel, must give the
    image within its noise: two independent implementations of the physics meet here."""
    config = scene(
        shape={"subdivisions": 1},
        walk={"tremor_mm": 3.0, "poses": "given"},
        thermal={"scale": 0.5, "every": 12, "netd_K": 0.03, "psf_sigma_px": 0.0, "drift": {"level_K": 0.5}},
    )
    root = simulate(config, tmp_path / "scan", seed=5)
    scan, truth = open_scan(root), truth_of(root)
    phantom = build_phantom(config, seed=5)
    band = SolverBand(*scan.thermal.camera.band_um)
    pose, _ = interpolate_trajectory(scan.trajectory, scan.thermal.times_s)
    vertices, normals = truth["vertices_m"].astype(np.float64), phantom.mesh.normals
    from thermofusion.geometry._open3d import o3d

    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.core.Tensor(truth["vertices_m"]), o3d.core.Tensor(truth["triangles"].astype(np.uint32)))
    for i in range(len(scan.thermal)):
        T = truth["T_thermal_depth"] @ np.linalg.inv(pose[i])
        eye = np.linalg.inv(T)[:3, 3]
        ray = eye - vertices
        cos = (ray * normals).sum(1) / np.linalg.norm(ray, axis=1)
        uv, _ = cv2.projectPoints(vertices, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], *_k(scan.thermal.camera.lens))
        uv = np.rint(uv.reshape(-1, 2)).astype(int)
        h, w = scan.thermal.camera.lens.shape
        ok = (cos > 0.5) & (uv >= 4).all(1) & (uv < [w - 4, h - 4]).all(1) & (truth["body_fraction"] < 0.6)
        start = vertices + 3e-3 * normals
        rays = np.concatenate([start, eye - start], 1).astype(np.float32)
        ok &= ~caster.test_occlusions(o3d.core.Tensor(rays), 0.0, 1.0).numpy()
        seen = _apparent(scan, i, uv[ok]) - truth["offsets_K"][i]
        eps = Fresnel(1.33)(cos[ok])
        leaving = eps * band.radiance(273.15 + truth["temperature_degC"][ok].astype(float))
        leaving += (1 - eps) * phantom.exchange.incoming[ok]
        expected = band.temperature_K(leaving) - 273.15
        error = seen - expected
        assert ok.sum() > 1500
        assert abs(np.median(error)) < 0.01
        assert np.median(np.abs(error)) < 0.06  # noise of 20 mK (median), temperature gradient within a pixel


def _k(camera):
    return camera.K, camera.distortion


def _apparent(scan, i, uv):
    """Counts through the written polynomial, °C."""
    counts = scan.thermal.load(i)[uv[:, 1], uv[:, 0]].astype(np.float64)
    c = scan.thermal.camera.signal.parameters["coefficients_degC"]
    return c[0] + c[1] * counts + c[2] * counts**2


def test_same_seed_same_bytes_and_other_seed_other_noise(tmp_path):
    config = scene(walk={"depth_frames": 6}, thermal={"drift": {"level_K": 0.3}}, motion={"sway_mm": 1.0})
    a = _digest(simulate(config, tmp_path / "a", seed=1, workers=1))
    b = _digest(simulate(config, tmp_path / "b", seed=1, workers=3))
    c = _digest(simulate(config, tmp_path / "c", seed=2))
    assert a == b
    assert a["thermal/000000.png"] != c["thermal/000000.png"]
    assert a["depth/000000.png"] != c["depth/000000.png"]


def _digest(root: Path) -> dict[str, str]:
    files = sorted(p for p in root.rglob("*") if p.is_file())
    return {p.relative_to(root).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_turntable_truth_is_relative_to_the_subject():
    config = scene(walk={"subject_turns": True, "tremor_mm": 0.0, "tremor_deg": 0.0})
    walking = replace(config, walk=replace(config.walk, subject_turns=False))
    times = np.array([0.0, 0.4, 1.1])
    turning = build_phantom(config).motion
    np.testing.assert_allclose(turning.T_world_depth(times)[0], turning.T_world_depth(times)[2])
    np.testing.assert_allclose(
        turning.T_body_depth(times), build_phantom(walking).motion.T_world_depth(times), atol=1e-12
    )


def test_an_existing_folder_is_not_overwritten(tmp_path):
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan" / "notes.txt").write_text("mine")
    with pytest.raises(ScanError, match="something here already"):
        simulate(scene(), tmp_path / "scan")
    with pytest.raises(ScanError, match="something here already"):
        simulate(scene(), tmp_path / "scan", overwrite=True)  # not a scan: never removed
    assert (tmp_path / "scan" / "notes.txt").read_text() == "mine"


# ---------------------------------------------------------------- the method's bars, through the whole pipeline


def reduced(name, scale=0.5, **shape):
    """A shipped scene with fewer and smaller images."""
    config = load_scene(name)
    blackbody = replace(config.thermal.blackbody, frames=(0, 6, 11))
    return replace(
        config,
        shape=replace(config.shape, **shape),
        walk=replace(config.walk, depth_frames=48, depth_hz=6.0),
        depth=replace(config.depth, scale=scale),
        thermal=replace(config.thermal, scale=scale, every=3, blackbody=blackbody),
    )


@pytest.mark.parametrize(
    ("name", "recipe", "overrides"),
    [("cylinder", "phantom-cylinder", ()), ("sphere", "torso", ("temperature.reflected_degC=20",))],
)
def test_isothermal_phantom_is_uniform_after_correction(name, recipe, overrides, tmp_path):
    """Single observations, corrected for offset, field, ε(θ) and room, must not depend on the viewing angle: less than
    0.05 K between 0 and 60°, where the apparent temperature falls by several times that."""
    config = reduced(name)
    scan = open_scan(simulate(config, tmp_path / "scan", seed=2))
    settings = load_recipe(recipe, overrides)
    result = fuse(scan, settings)
    rows, calibration = result.mapped.observations, result.temperature.calibration
    band = SolverBand(*scan.thermal.camera.band_um)
    eps = calibration.emissivity(model_from_recipe(settings.temperature.emissivity, band))(rows.cos_angle)
    room = band.radiance(273.15 + config.room.reflected_degC)
    corrected = band.temperature_K((calibration.corrected(rows) - (1 - eps) * room) / eps)
    apparent = band.temperature_K(rows.radiance)
    angle = np.degrees(np.arccos(rows.cos_angle))
    bins = [(angle >= lo) & (angle < lo + 10) & (rows.edge_px >= 3) for lo in range(0, 60, 10)]
    assert min(b.sum() for b in bins) > 500
    assert np.ptp([np.median(apparent[b]) for b in bins]) > 0.2
    assert np.ptp([np.median(corrected[b]) for b in bins]) < 0.05
    mesh = result.mesh
    seen = np.isfinite(mesh.temperature_degC) & (mesh.view_angle_deg < 60)
    error = mesh.temperature_degC[seen] - np.median(mesh.temperature_degC[seen])
    assert np.percentile(np.abs(error), 95) < 0.10
    # the object is small and in the middle, the blackbody in the corner: what the image field is there nobody saw, the
    # level may be off by a field's size, and the result must say so
    true_degC = np.median(truth_of(tmp_path / "scan")["temperature_degC"])
    level_error_K = np.median(mesh.temperature_degC[seen]) - true_degC
    assert abs(level_error_K) < 0.35
    assert abs(level_error_K) < 2 * calibration.level_sigma_K


def test_skin_that_sees_skin_is_not_biased(tmp_path):
    """Arms at the flanks, legs together: less than 0.1 K of bias where half of the reflected hemisphere is body,
    although what it reflects there is 13 K warmer than the room."""
    from scipy.spatial import cKDTree

    config = reduced("folds", scale=1.0, subdivisions=1)
    root = simulate(config, tmp_path / "scan", seed=2)
    truth = truth_of(root)
    mesh = fuse(open_scan(root), load_recipe("torso")).mesh_in_world
    gap, nearest = cKDTree(truth["vertices_m"]).query(mesh.surface.vertices_m)
    error = mesh.temperature_degC - truth["temperature_degC"][nearest]
    good = np.isfinite(error) & (gap < 0.008) & (mesh.view_angle_deg < 60)
    error -= np.median(error[good])
    fraction = truth["body_fraction"][nearest]
    cavity = good & (fraction > 0.4) & (fraction < 0.6)
    assert cavity.sum() > 500
    assert abs(np.median(error[cavity])) < 0.1
    assert abs(error[cavity].mean()) < 0.1


def test_a_standing_body_moves_about_its_rest():
    """The soles stay, the chest sways by what was asked for, rest is the mean, hands move most against the trunk."""
    living = scene(shape={"subdivisions": 0}, walk={"depth_frames": 300}, motion={"standing": "quiet", "step_mm": 50.0})
    phantom = build_phantom(living)
    posture, mesh, times = phantom.posture, phantom.mesh, phantom.depth_times_s
    at = np.array([posture.at(t) for t in times])
    moved = at - mesh.vertices_m
    z, x = mesh.vertices_m[:, 2], mesh.vertices_m[:, 0]
    still = (z < 0.04) & (x < -0.02)
    assert np.abs(moved[:, still]).max() < 1e-6
    back = (np.abs(z - 1.25) < 0.05) & (mesh.vertices_m[:, 1] > 0.03) & (np.abs(x) < 0.1)
    sway = np.sqrt((moved[:, back].mean(1)[:, :2] ** 2).sum(1).mean())
    assert sway == pytest.approx(0.006, rel=0.35)  # 20 s hold few periods of the slowest sines
    assert np.abs(moved.mean(0)).max() < 1e-3
    foot = (z < 0.04) & (x > 0.02)
    aside = moved[-1, foot, 0].mean() - moved[0, foot, 0].mean()
    assert aside == pytest.approx(0.05, rel=0.1)
    truth = posture.truth(times[::10])
    rms = dict(zip(truth["part_names"], truth["part_motion_rms_mm"], strict=True))
    assert max(rms["chest"], rms["pelvis"]) < 2 < 3 < min(rms["left hand"], rms["right hand"])
    assert max(rms["right thigh"], rms["right shin"]) < 0.1  # sway is the trunk's own, breath none of it


def test_only_a_body_can_stand_alive():
    with pytest.raises(RecipeError, match=r"need shape\.kind = body"):
        build_phantom(scene(shape={"kind": "sphere"}, motion={"standing": "tired"}))
