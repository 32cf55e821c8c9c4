"""Rig and clock found from outlines: a bumpy warm body walked round by a cheap, distorted thermal camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.truth import truth_of
from support.walkround import ROOM_DEGC, T_THERMAL_DEPTH, blank, ellipsoid, make_scan, repainted, walk

from thermofusion.diagnosis import of_knocks
from thermofusion.errors import ScanError
from thermofusion.geometry._open3d import o3d
from thermofusion.geometry.rigid import interpolate_trajectory, invert, pose, se3_exp, se3_log
from thermofusion.mapping.views import thermal_views
from thermofusion.recipe import load_recipe
from thermofusion.rig.align import RigResult, align
from thermofusion.rig.estimate import PRIOR_TIME_S
from thermofusion.scans import open_scan
from thermofusion.types import Scan, SurfaceMesh, Trajectory


def turned(scan: Scan, rotation_deg: list[float], translation_m: tuple[float, ...] = (0, 0, 0)) -> Scan:
    T = se3_exp(np.array([*np.radians(rotation_deg), *translation_m])) @ scan.thermal.camera.T_thermal_depth
    return with_camera(scan, T_thermal_depth=T)


def with_camera(scan: Scan, **changes) -> Scan:
    return replace(scan, thermal=replace(scan.thermal, camera=replace(scan.thermal.camera, **changes)))


def delayed(scan: Scan, seconds: float) -> Scan:
    return replace(scan, thermal=replace(scan.thermal, times_s=scan.thermal.times_s + seconds))


def errors(result: RigResult, truth: np.ndarray) -> tuple[float, float]:
    """Rotation [deg] and translation [m] from the truth."""
    twist = se3_log(result.camera.T_thermal_depth @ invert(truth))
    return float(np.degrees(np.linalg.norm(twist[:3]))), float(np.linalg.norm(twist[3:]))


def inside_covariance(result: RigResult, time_offset_s: float = 0.0) -> bool:
    """Whether the truth lies within 99.9 % of the stated covariance (chi-square with 7 degrees of freedom)."""
    twist = se3_log(T_THERMAL_DEPTH @ invert(result.camera.T_thermal_depth))
    error = np.append(twist, time_offset_s - result.camera.time_offset_s)
    return bool(error @ np.linalg.solve(result.covariance, error) < 24.3)


@pytest.fixture(scope="module")
def body() -> SurfaceMesh:
    return ellipsoid()


@pytest.fixture(scope="module")
def scan(body) -> Scan:
    return make_scan(body, walk())


RECIPE = load_recipe({})


def aligned(scan, body, trajectory, recipe=RECIPE):
    return align(scan, body, trajectory, input=recipe.input, rig=recipe.rig)


@pytest.mark.parametrize(
    ("rotation_deg", "translation_m", "clock_s"),
    [
        ([0.3, -0.3, 0.26], (0, 0, 0), 0.04),
        ([-0.5, 0, 0], (0.003, -0.002, 0.002), -0.04),
        ([0, 0.5, 0], (0, 0, 0), 0.04),
    ],
)
def test_wrong_rig_and_clock_are_found(body, scan, rotation_deg, translation_m, clock_s):
    wrong = delayed(turned(scan, rotation_deg, translation_m), clock_s)
    result = aligned(wrong, body, walk())
    rotation, translation = errors(result, T_THERMAL_DEPTH)
    assert result.changed
    assert result.converged
    assert rotation < 0.1
    assert translation < 4e-3
    assert result.camera.time_offset_s == pytest.approx(-clock_s, abs=0.002)
    assert result.residual_px_after < 0.2 * result.residual_px_before
    assert inside_covariance(result, -clock_s)


@pytest.mark.parametrize("rotation_deg", [[1.0, -5.0, 0.3], [-3.0, 3.0, 0.0]])
def test_a_rig_off_by_degrees_is_searched_for(body, scan, rotation_deg):
    """Farther than edges are looked for. Said, so that the rig gets calibrated again."""
    wrong = delayed(turned(scan, rotation_deg, (0.003, 0.004, 0)), 0.05)
    result = aligned(wrong, body, walk())
    rotation, _ = errors(result, T_THERMAL_DEPTH)
    assert result.changed
    assert result.converged
    assert "calibrate it again" in result.messages[0]
    assert rotation < 0.1
    assert abs(result.camera.time_offset_s + 0.05) < 0.01
    assert inside_covariance(result, -0.05)


def test_right_rig_is_left_alone(body, scan):
    result = aligned(scan, body, walk())
    assert not result.changed
    np.testing.assert_array_equal(result.camera.T_thermal_depth, scan.thermal.camera.T_thermal_depth)
    assert result.camera.time_offset_s == 0
    assert result.messages == ()  # no news
    assert result.residual_px_before == pytest.approx(result.residual_px_after)
    assert result.residual_px_before < 0.3
    assert result.frame_dt_s is None
    assert result.depth_scale == 0
    assert result.knocks is None


@pytest.mark.parametrize(
    ("stands_deg", "first"),
    [([[-2.0, 2.5, 1.0]], [15]), ([[0.0, 0.6, 0.0], [0.7, 0.6, 0.0]], [7, 16])],
)
def test_a_camera_that_was_knocked_has_a_rig_before_and_another_one_after(body, scan, stands_deg, first):
    """Beyond the reach of edges, and twice within it; told to the frame."""
    twist = np.zeros((24, 6))
    for rotation_deg, frame in zip(stands_deg, first, strict=True):
        twist[frame:, :3] = np.radians(rotation_deg)
    result = aligned(make_scan(body, walk(), knocked=twist), body, walk())
    assert result.knocks.frame.tolist() == first
    off = se3_log(result.knocks.of(np.arange(24)) @ invert(se3_exp(twist)))
    assert np.degrees(np.linalg.norm(off[:, :3], axis=1)).max() < 0.15
    assert errors(result, T_THERMAL_DEPTH)[0] < 0.1
    assert result.residual_px_after < 0.3
    size_deg, _ = result.knocks.sizes()
    steps = np.diff([[0.0, 0.0, 0.0], *stands_deg], axis=0)
    assert size_deg == pytest.approx(np.linalg.norm(steps, axis=1).max(), abs=0.1)
    (entry,) = of_knocks(result.knocks, np.arange(24))
    assert entry.what == "thermal camera was knocked"
    assert (entry.size, entry.unit) == (size_deg, "deg")
    assert f"frame {first[0]}" in entry.where
    # and so each view stands where it was taken
    views, _ = thermal_views(scan, walk(), 0.1, result.camera, None, result.knocks.of(np.arange(24)))
    T_world_depth, _ = interpolate_trajectory(walk(), scan.thermal.times_s)
    true = T_world_depth @ invert(se3_exp(twist) @ T_THERMAL_DEPTH)
    apart = se3_log(invert(true) @ views.T_world_thermal)
    assert np.degrees(np.linalg.norm(apart[:, :3], axis=1)).max() < 0.15


def test_a_wrong_scale_of_depth_is_told_from_a_turned_rig(body, scan):
    """Depth, and poses tracked with it, 8 % too large: what this coarse camera sees of the cameras' spacing."""
    large = SurfaceMesh(1.08 * body.vertices_m, body.triangles, body.normals)
    path = walk()
    poses = path.T_world_depth.copy()
    poses[:, :3, 3] *= 1.08
    result = aligned(scan, large, Trajectory(path.times_s, poses))
    assert result.depth_scale == pytest.approx(0.08, rel=0.25)
    assert aligned(turned(scan, [0.3, -0.3, 0.26]), body, walk()).depth_scale == 0


def test_rows_that_are_read_one_after_another_are_told(body, scan):
    """From the last to the first. Outlines move by some 20 px a second; taken all at once, rows say nothing."""
    readout_s = -0.05
    found = aligned(make_scan(body, walk(), readout_s=readout_s), body, walk()).readout
    assert found.readout_s == pytest.approx(readout_s, rel=0.25)
    assert abs(found.readout_s - readout_s) < 3 * found.sigma_s
    assert aligned(scan, body, walk()).readout is None


@pytest.mark.parametrize(("rotation_deg", "left_s"), [([0, 0, 0], 0.005), ([0.3, -0.3, 0.26], 0.01)])
def test_jitter_of_single_frames_is_solved_beside_the_rig(body, scan, rotation_deg, left_s):
    wrong = turned(scan, rotation_deg)
    jitter_s = np.random.default_rng(8).normal(0, 0.03, len(scan.thermal))
    times_s = wrong.thermal.times_s + jitter_s
    result = aligned(replace(wrong, thermal=replace(wrong.thermal, times_s=times_s)), body, walk())
    assert result.frame_dt_s is not None
    # a steady part of what is left goes with the rig: 10 px a second are slow for this camera
    assert np.std(jitter_s + result.camera.time_offset_s + result.frame_dt_s) < left_s
    assert result.jitter_s == pytest.approx(np.std(jitter_s), rel=0.4)
    assert result.residual_px_after < 0.2
    assert errors(result, T_THERMAL_DEPTH)[0] < 0.1
    assert inside_covariance(result)
    assert "jitter" in result.messages[-1]


def test_the_sensors_own_offset_is_the_start(body, scan):
    """A clock shift that scan.json already declares is none."""
    declared = with_camera(delayed(scan, 0.25), time_offset_s=-0.25)
    result = aligned(declared, body, walk())
    assert not result.changed
    assert result.camera.time_offset_s == -0.25


def test_cold_body_in_a_warm_room(body, scan):
    cold = repainted(scan, lambda image: 2 * ROOM_DEGC - image)
    result = aligned(turned(cold, [0.2, 0.3, -0.2]), body, walk())
    assert errors(result, T_THERMAL_DEPTH)[0] < 0.1


def test_nothing_to_see_says_so(body, scan):
    nothing = turned(blank(scan), [0.5, 0, 0])
    result = aligned(nothing, body, walk())
    assert not result.changed
    assert not result.converged
    np.testing.assert_array_equal(result.camera.T_thermal_depth, nothing.thermal.camera.T_thermal_depth)
    assert "does not stand out" in result.messages[0]
    assert result.sigma_time_s == PRIOR_TIME_S


def test_cut_end_of_the_model_is_no_outline(body, scan):
    """The upper half fused only: the body goes on below the cut, and the rig must not follow the cut."""
    keep = body.vertices_m[body.triangles].mean(1)[:, 2] > -0.05
    half = SurfaceMesh(body.vertices_m, body.triangles[keep], body.normals)
    result = aligned(turned(scan, [0.3, -0.3, 0.26]), half, walk())
    assert result.residual_px_after < 0.3
    assert inside_covariance(result)
    assert not result.changed or errors(result, T_THERMAL_DEPTH)[0] < 0.25  # one end less to hold the vertical


def test_model_swollen_by_fusion_moves_only_the_nuisance(body, scan):
    """2 mm of common swelling is 0.5 px: it goes into the outline's width, not into the rig."""
    swollen = SurfaceMesh(body.vertices_m + np.float32(0.002) * body.normals, body.triangles, body.normals)
    result = aligned(turned(scan, [0.3, -0.3, 0.26]), swollen, walk())
    assert errors(result, T_THERMAL_DEPTH)[0] < 0.1
    assert result.outline_width_px < -0.4


def test_steady_walk_leaves_the_clock_uncertain(body, scan):
    """Along a constant twist a clock error is a rig error: the covariance must not claim to know either."""
    steady_walk = walk(tremor=0.0)
    steady = make_scan(body, steady_walk)
    shaky = aligned(delayed(scan, 0.04), body, walk())
    result = aligned(delayed(steady, 0.04), body, steady_walk)
    assert result.sigma_time_s > 2 * shaky.sigma_time_s
    assert abs(result.camera.time_offset_s + 0.04) < 4 * result.sigma_time_s


def test_same_input_same_result_and_switches(body, scan):
    wrong = turned(scan, [0.3, 0, 0])
    first, second = (aligned(wrong, body, walk()) for _ in range(2))
    np.testing.assert_array_equal(first.camera.T_thermal_depth, second.camera.T_thermal_depth)
    off = aligned(wrong, body, walk(), load_recipe({"rig": {"align": False}}))
    assert not off.changed
    assert "recipe" in off.messages[0]
    with pytest.raises(ScanError, match="no thermal stream"):
        aligned(replace(scan, thermal=None), body, walk())


@pytest.mark.parametrize(("rotation_deg", "clock_s"), [([0.3, -0.3, 0.26], 0.04), ([0.0, 0.5, 0.0], -0.04)])
def test_torso_recording(shared_data, rotation_deg, clock_s):
    """The simulated walk round a person, with its true surface: half a degree and 40 ms are found."""
    root = shared_data("torso-dev")
    truth = truth_of(root)
    mesh = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(truth["vertices_m"]), o3d.core.Tensor(truth["triangles"]))
    mesh.compute_vertex_normals()
    surface = SurfaceMesh(truth["vertices_m"], truth["triangles"], mesh.vertex.normals.numpy())
    rows = np.loadtxt(root / "truth" / "trajectory.txt")
    R = Rotation.from_quat(rows[:, 4:8]).as_matrix()
    trajectory = Trajectory(rows[:, 0], np.stack([pose(r, p) for r, p in zip(R, rows[:, 1:4], strict=True)]))
    wrong = delayed(turned(open_scan(root), rotation_deg), clock_s)
    result = aligned(wrong, surface, trajectory)
    assert errors(result, truth["T_thermal_depth"])[0] < 0.1
    assert result.camera.time_offset_s == pytest.approx(-clock_s, abs=0.010)
