"""Tracking against truth: synthetic walks with every fault we know of, and a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import tracking_scenes as scenes

from thermofusion.errors import ScanError
from thermofusion.files.tum import read_trajectory
from thermofusion.geometry.rigid import invert, se3_exp, transform_points
from thermofusion.recipe import load_recipe
from thermofusion.scans import open_scan
from thermofusion.tracking import track as tracking
from thermofusion.tracking.frames import coarse_depth, local_contrast, stiffness_of
from thermofusion.tracking.joint import solve_jointly
from thermofusion.tracking.maps import DepthMap
from thermofusion.tracking.registration import agreement, register_view
from thermofusion.types import Rig, Stream, Trajectory

RECIPE = load_recipe("torso")
ATE_MM = 2.0  # of 160 x 120 pixels that measure 7 mm each: a third of a pixel


def track(scan, recipe):
    return tracking.track(scan, input=recipe.input, subject=recipe.subject, tracking=recipe.tracking)


@pytest.fixture(scope="module")
def walk():
    """40 frames, a third of a turn: 3 degrees a frame, as fast as anybody walks."""
    return scenes.walk(scenes.orbit(40, 120))


@pytest.fixture(scope="module")
def tracked(walk):
    return track(walk.scan(), RECIPE)


def test_a_walk_is_tracked_to_millimetres(walk, tracked):
    assert tracked.tracked.all()
    assert tracked.converged
    assert tracked.lost == ()
    assert tracked.messages == ()
    assert tracked.source == "estimated"
    assert walk.ate_mm(tracked.trajectory) < ATE_MM
    np.testing.assert_allclose(tracked.trajectory.T_world_depth[0], np.eye(4), atol=1e-12)
    assert np.nanmin(tracked.fitness) > RECIPE.tracking.min_fitness
    assert np.nanmedian(tracked.residual_mm) < 1.5  # simulated noise is 1.2 mm


def test_same_input_same_poses(walk, tracked):
    again = track(walk.scan(), RECIPE)
    np.testing.assert_array_equal(again.trajectory.T_world_depth, tracked.trajectory.T_world_depth)


def test_a_whole_turn_closes_its_loop():
    walk = scenes.walk(scenes.orbit(90, 360))
    result = track(walk.scan(), RECIPE)
    assert result.tracked.all()
    assert result.loop_closures > 0
    assert walk.ate_mm(result.trajectory) < ATE_MM
    ends = invert(result.trajectory.T_world_depth[0]) @ result.trajectory.T_world_depth[-1]
    truth = invert(walk.T_body_depth[0]) @ walk.T_body_depth[-1]
    assert np.linalg.norm((invert(truth) @ ends)[:3, 3]) < 4e-3  # m, where the drift of the whole turn would show


@pytest.mark.parametrize(("start", "stop"), [(15, 25), (12, 22)])
def test_frames_without_a_subject_are_reported_and_bridged(walk, start, stop):
    result = track(walk.blanked(start, stop).scan(), RECIPE)
    expected = np.ones(40, bool)
    expected[start:stop] = False
    np.testing.assert_array_equal(result.tracked, expected)
    assert [(r.start, r.stop, r.outcome) for r in result.lost] == [(start, stop, "empty"), (stop, stop + 1, "joined")]
    assert any("joined again" in m for m in result.messages)
    assert walk.ate_mm(result.trajectory) < ATE_MM


def test_a_jump_is_noticed_and_bridged(walk):
    jumped = walk.without(15, 25)  # 30 degrees from one frame to the next
    result = track(jumped.scan(), RECIPE)
    assert result.tracked.all()
    assert [(r.start, r.stop, r.outcome) for r in result.lost] == [(15, 16, "joined")]
    assert jumped.ate_mm(result.trajectory) < ATE_MM


def test_what_cannot_be_joined_is_left_out_and_said(walk):
    front = scenes.walk(scenes.orbit(12, 20, seed=8), seed=4)
    back = scenes.orbit(24, 200)[-12:]  # a stretch of the other side: too far for a believable join
    both = replace(
        front,
        depth_m=np.concatenate([front.depth_m, scenes.walk(back).depth_m]),
        T_body_depth=np.concatenate([front.T_body_depth, back]),
    )
    result = track(both.scan(), RECIPE)
    left_out = [r for r in result.lost if r.outcome == "left out"]
    assert len(left_out) == 1
    assert left_out[0].stop - left_out[0].start == 12
    assert result.tracked.sum() == 12
    assert any("left out" in m for m in result.messages)
    assert both.ate_mm(result.trajectory) < ATE_MM


def test_the_same_lump_twice_is_not_joined_by_chance():
    """A ball looks the same from everywhere: no place may be chosen, and the sliding is said."""
    ball = scenes.ellipsoid([0, 0, 0], [0.25, 0.25, 0.25], 0)
    poses = scenes.orbit(20, 60)
    walk = scenes.walk(poses, shape=[ball]).blanked(9, 16)
    result = track(walk.scan(), RECIPE)
    assert not result.tracked[16:].any() or not result.tracked[:9].any()
    assert any("leaves some motion free" in m for m in result.messages)


def test_a_floor_in_view_does_not_hold_the_camera_back():
    walk = scenes.walk(scenes.orbit(40, 120, down_m=0.3), room=(scenes.floor(),))
    result = track(walk.scan(), load_recipe("full-body"))
    assert result.tracked.all()
    assert walk.ate_mm(result.trajectory) < ATE_MM
    # the floor in the world: through the truth's floor, seen from the first camera
    T = walk.T_body_depth[0]
    on_floor = np.array([[x, scenes.FLOOR_Y_M, z] for x in (-0.5, 0.5) for z in (-0.3, 0.4)])
    plane = result.floor_plane
    assert plane is not None
    height = transform_points(invert(T), on_floor) @ plane[:3] + plane[3]
    assert np.abs(height).max() < 0.01
    assert plane[3] > 0  # the camera is above it


def test_a_subject_who_turns_before_a_standing_camera():
    room = (scenes.box([-1.5, -1.2, 1.55], [1.5, 1.2, 1.6]), scenes.box([-1.5, 0.45, 0.3], [1.5, 0.5, 1.6]))
    walk = scenes.walk(scenes.orbit(50, 170), standing=room)
    result = track(walk.scan(), load_recipe("turntable-object"))
    assert result.tracked.all()
    assert walk.ate_mm(result.trajectory) < ATE_MM


def test_small_and_near_is_tracked_as_well_as_large_and_far(walk, tracked):
    small = replace(walk, depth_m=walk.depth_m * np.float32(0.3), T_body_depth=scenes.scaled(walk.T_body_depth, 0.3))
    recipe = load_recipe("torso", ["input.min_depth_m=0.1", "input.flying_pixel_mm=80"])
    result = track(small.scan(), recipe)
    assert result.tracked.all()
    assert small.ate_mm(result.trajectory) < 0.3 * ATE_MM


def test_a_recorded_start_is_refined(walk):
    rng = np.random.default_rng(2)
    shaken = walk.T_body_depth @ se3_exp(rng.normal(0, [0.003] * 3 + [0.004] * 3, (40, 6)))
    scan = walk.scan(recorded=shaken)
    before = walk.ate_mm(Trajectory(scan.depth.times_s, shaken))
    result = track(scan, RECIPE)
    assert result.source == "refined"
    assert walk.ate_mm(result.trajectory) < min(ATE_MM, 0.4 * before)
    # it stays in the recording's world
    assert np.linalg.norm(result.trajectory.T_world_depth[:, :3, 3] - walk.T_body_depth[:, :3, 3], axis=1).max() < 0.02


def test_texture_holds_what_shape_leaves_free():
    """A cylinder turns unseen; with paint on it, it does not."""
    walk, color = scenes.painted_cylinder(30, 60)
    bare = walk.scan()
    stream = Stream(bare.depth.times_s, lambda i: color[i], bare.depth.places, bare.depth.index, bare.depth.usable)
    rig = Rig(scenes.CAMERA, color=scenes.CAMERA, T_color_depth=np.eye(4))
    painted = track(replace(bare, rig=rig, color=stream), RECIPE)
    assert painted.tracked.all()
    assert painted.messages == ()
    assert walk.ate_mm(painted.trajectory) < 10
    unpainted = track(bare, RECIPE)
    assert any("leaves some motion free" in m for m in unpainted.messages)


def test_nothing_in_view_is_an_error(walk):
    with pytest.raises(ScanError, match="no depth frame shows a subject"):
        track(walk.blanked(0, 40).scan(), RECIPE)


# ---------------------------------------------------------------- the parts


INTRINSICS = (147.0, 147.0, 79.5, 59.5)


def maps_of(walk, *frames):
    return [DepthMap.of(walk.depth_m[i], INTRINSICS, 3000) for i in frames]


@pytest.mark.parametrize("seed", range(4))
def test_register_finds_a_motion_back(walk, seed):
    a, b = maps_of(walk, 10, 12)
    truth = invert(walk.T_body_depth[10]) @ walk.T_body_depth[12]
    off = se3_exp(np.random.default_rng(seed).normal(0, [0.02] * 3 + [0.015] * 3))
    T, partners = register_view(b, [(a, np.eye(4))], off @ truth, (0.08, 0.06, 0.05, 0.04, 0.03, 0.03, 0.03, 0.03))
    error = invert(truth) @ T
    assert partners is not None
    assert np.linalg.norm(error[:3, 3]) < 5e-3
    assert agreement(b, a, T) > 0.95


def test_agreement_tells_a_wrong_place(walk):
    a, b = maps_of(walk, 0, 30)
    assert agreement(b, a, np.eye(4)) < 0.75  # 90 degrees apart, laid on top of each other


def test_normals_of_a_plane_are_exact():
    normal = np.array([0.3, -0.5, -0.8]) / np.linalg.norm([0.3, -0.5, -0.8])
    v, u = np.mgrid[:60, :80]
    rays = np.stack([(u - 40) / 100, (v - 30) / 100, np.ones(u.shape)], axis=-1)
    depth = (-1.0 / (rays @ normal)).astype(np.float32)
    m = DepthMap.of(depth, (100.0, 100.0, 40.0, 30.0), 500)
    np.testing.assert_allclose(m.sample_normals, np.broadcast_to(normal, m.sample_normals.shape), atol=2e-4)


def test_coarse_depth_averages_surfaces_and_drops_edges():
    depth = np.full((4, 6), 1.0, np.float32)
    depth[0, 0], depth[0, 1] = 1.004, np.nan
    depth[:2, 3] = 1.5  # an edge inside a cell
    depth[2:, 4:] = np.nan
    coarse = coarse_depth(depth, 2)
    assert coarse.shape == (2, 3)
    np.testing.assert_allclose(coarse[0, 0], (1.004 + 1 + 1) / 3, rtol=1e-6)
    assert np.isnan(coarse[0, 1])
    assert np.isnan(coarse[1, 2])
    np.testing.assert_allclose(coarse[1, :2], 1.0)


def test_contrast_ignores_exposure():
    image = np.random.default_rng(0).uniform(20, 120, (60, 80)).astype(np.float32)
    np.testing.assert_allclose(local_contrast(image, 1), local_contrast(2 * image + 10, 1), atol=0.1)


def test_stiffness_orders_shapes(walk):
    ball = scenes.walk(scenes.orbit(1, 0), shape=[scenes.ellipsoid([0, 0, 0], [0.25, 0.25, 0.25], 0)])
    (body,), (sphere,) = maps_of(walk, 0), maps_of(ball, 0)
    assert stiffness_of(sphere) < 0.08 < 0.13 < stiffness_of(body)


def test_joint_solution_moves_all_to_agreement(walk):
    frames = [0, 5, 10, 15]
    maps, truth = maps_of(walk, *frames), walk.T_body_depth[frames]
    start = truth @ se3_exp(np.random.default_rng(1).normal(0, 0.008, (4, 6)))
    start[0] = truth[0]
    edges = [(i, j) for i in range(4) for j in range(i)]
    T, rms, converged = solve_jointly(maps, start, edges, 0.05, fixed=0, max_iterations=20)
    assert converged
    assert rms < 2e-3
    np.testing.assert_array_equal(T[0], truth[0])
    assert np.linalg.norm((invert(truth) @ T)[:, :3, 3], axis=1).max() < 4e-3


# ---------------------------------------------------------------- recordings


def test_torso_recording(shared_data):
    root = shared_data("torso-dev")
    scan, n = open_scan(root), 60
    d = scan.depth
    scan = replace(scan, trajectory=None, depth=Stream(d.times_s[:n], d.load, d.places[:n], d.index[:n], d.usable[:n]))
    result = track(scan, RECIPE)
    truth = read_trajectory(root / "truth" / "trajectory.txt")
    assert result.tracked.all()
    walk = scenes.Walk(np.empty(0), truth.T_world_depth[:n])
    on_grid = Trajectory(scenes.FRAME_S * np.arange(n), result.trajectory.T_world_depth)
    assert walk.ate_mm(on_grid) < 1.5


def test_a_hand_held_room_whose_camera_errs_with_range(shared_data):
    """Every fourth frame of a real recording: walls seen from 1 m and 3 m, where it errs differently."""
    scan = open_scan(shared_data("redkitchen"))
    truth, d, every = scan.trajectory, scan.depth, slice(None, None, 4)
    depth = Stream(d.times_s[every], lambda i: d.load(4 * i), d.places[every], d.index[every], d.usable[every])
    result = track(replace(scan, trajectory=None, depth=depth), load_recipe("room"))
    assert result.tracked.all()
    assert result.converged
    walk = scenes.Walk(np.empty(0), truth.T_world_depth[every])
    on_grid = Trajectory(scenes.FRAME_S * np.arange(len(depth)), result.trajectory.T_world_depth)
    assert walk.ate_mm(on_grid) < 15  # the reference itself is good to about 10 mm
