"""A simulated afternoon: pictures of three cameras with known truth, through files, detectors and adjustment."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.simulated_pictures import Kinect, Pictures, color_picture, depth_picture, write_folder
from support.simulated_rig import SimulatedRig, board_poses, true_pixels

from thermofusion.calibration import calibrate, calibrate_views
from thermofusion.calibration.board.views import BoardView, CalibrationSet
from thermofusion.calibration.detect.color import detect_color
from thermofusion.calibration.fit.cameras import intrinsics_of, to_rt
from thermofusion.calibration.fit.rounds import detect_thermal_set
from thermofusion.calibration.folder import open_folder
from thermofusion.geometry.rigid import invert, rotation_angle_deg


@pytest.fixture(scope="module")
def rig():
    return SimulatedRig()


def test_pictures_calibrate_the_rig_within_its_own_intervals(rig, tmp_path):
    """The long form, 50 seeds of 24 views, is benchmarks/calibration_coverage.py pictures. Here 16 views: with infrared
    pictures of the board the depth camera is placed as well as the others; without, by planes and the maker's lens."""
    poses = write_folder(tmp_path / "day", rig, 0, views=16, kinect=Kinect.drawn(0), infrared=True)
    found = calibrate(tmp_path / "day")
    assert found.found == {"color": 16, "thermal": 16, "depth": 16}
    _check(rig, found.calibration, poses, 0.05, 0.3e-3)
    assert found.picture("depth", "0003").shape == (960, 1280, 3)  # small pictures are drawn at twice their size
    images = {n: partial(found.folder.depth, n) for n in found.folder.files["depth"]}
    views = tuple(v.with_points("depth", None) for v in found.calibration.data.views)
    blind = replace(found.calibration.data, views=views)
    planes = calibrate_views(blind, depth_images=images, depth_camera=rig.depth, depth_lens_known=True)
    _check(rig, planes, poses, 0.05, 0.8e-3)


def _check(rig, c, poses, degrees, metres):
    """Points found, extrinsics to the depth camera within limits, all within their intervals."""
    assert not c.notes
    for camera, median_px in (("color", 0.02), ("thermal", 0.1)):
        for v in c.data.seen_by(camera):
            error = v.points[camera].px - true_pixels(rig, camera, poses[int(v.name)])[v.points[camera].index]
            assert np.median(np.linalg.norm(error, axis=1)) < median_px
    key, z = c.fit.problem.extrinsic_key("thermal", 0), []
    truth = rig.T_thermal_depth @ invert(rig.T_color_depth)
    z.append((c.fit.block(key) - to_rt(truth)) / np.sqrt(np.diag(c.fit.block_covariance(key))))
    T = c.extrinsics["T_thermal_depth"] @ invert(c.extrinsics["T_color_depth"])
    _assert_near(T, truth, 0.03, 0.1e-3)
    for camera in ("color", "thermal"):
        T, truth = c.extrinsics[f"T_{camera}_depth"], rig.T_camera_depth(camera)
        _assert_near(T, truth, degrees, metres)
        z.append((to_rt(T) - to_rt(truth)) / np.sqrt(np.diag(c.extrinsic_covariance[f"T_{camera}_depth"])))
        sigma = np.sqrt(np.diag(c.fit.block_covariance(camera)))[:8]
        z.append((c.fit.block(camera) - intrinsics_of(rig.camera(camera)))[:8] / sigma)
    inside = np.abs(np.concatenate(z)) < 1.96
    assert inside.mean() > 0.85
    assert np.abs(np.concatenate(z)).max() < 4


def _assert_near(T: np.ndarray, truth: np.ndarray, degrees: float, metres: float) -> None:
    assert rotation_angle_deg(T @ invert(truth)) < degrees
    assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < metres


def test_crossings_are_found_to_hundredths_of_a_pixel_on_tilted_boards(rig):
    for seed, T in enumerate(board_poses(rig, 3, np.random.default_rng(5))):
        points = detect_color(color_picture(rig, T, seed, Pictures()), rig.board)
        assert points is not None
        error = points.px - true_pixels(rig, "color", T)[points.index]
        assert np.sqrt(np.mean(error**2)) < 0.03
        assert np.abs(error.mean(0)).max() < 0.01


def test_a_boards_bright_edge_is_not_taken_for_a_row_of_pins(rig, tmp_path):
    poses = write_folder(tmp_path / "day", rig, 1, views=6, pictures=replace(Pictures(), board_warmer=60.0))
    folder = open_folder(tmp_path / "day")
    colour = {n: detect_color(folder.color(n), rig.board) for n in folder.names}
    data = CalibrationSet(
        rig.board, {"color": (1280, 960)}, tuple(BoardView(n, {"color": p}) for n, p in colour.items())
    )
    found, _ = detect_thermal_set(data, {n: folder.thermal(n) for n in folder.names})
    for v in found.seen_by("thermal"):
        p = v.points["thermal"]
        error = p.px - true_pixels(rig, "thermal", poses[int(v.name)])[p.index]
        assert np.median(np.linalg.norm(error, axis=1)) < 0.2
    assert len(found.seen_by("thermal")) == 6


def test_simulated_boards_stand_as_the_guide_asks(rig):
    T = np.stack(board_poses(rig, 40, np.random.default_rng(2)))
    n = T[:, :3, 2]
    tilt = np.degrees(np.arccos(n[:, 2]))
    assert tilt.min() > 19.9
    assert tilt.max() < 45.1
    for axis in (0, 1):
        assert (np.degrees(np.arcsin(n[:, axis])) > 15).sum() >= 5
        assert (np.degrees(np.arcsin(n[:, axis])) < -15).sum() >= 5
    distance = np.linalg.norm(T[:, :3, :3] @ rig.board.points_m.mean(0) + T[:, :3, 3], axis=1)
    assert distance.max() > 1.6 * distance.min()


def test_the_depth_picture_is_a_kinects(rig):
    T = board_poses(rig, 1, np.random.default_rng(0))[0]
    still = Kinect(ragged_px=0, grown_px=0, bend_m=0, scale=0, offset_m=0, lost=0, noise_m=0)
    z = depth_picture(rig, T, 0, still)
    counts = 1 / (z[np.isfinite(z)] * still.step_m)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-3)
    u, v = true_pixels(rig, "depth", T)[40].round().astype(int)
    centre = T[:3, :3] @ rig.board.points_m[40] + T[:3, 3]
    patch = z[v - 15 : v + 16, u - 15 : u + 16]
    assert abs(patch.mean() - centre[2]) < 0.01
    shadow = np.isnan(z).mean()  # what the projector, 75 mm to the right, does not reach behind the board
    assert 0.003 < shadow < 0.1
    assert np.isnan(depth_picture(rig, T, 0, replace(still, lost=0.2))).mean() > 0.19
