"""Floor, background and the standing room, on scenes whose every pixel is known."""

from __future__ import annotations

import numpy as np
import pytest
from support import tracking_scenes as scenes

from thermofusion.depth.filter import DepthFrames
from thermofusion.depth.subject import SubjectFrames, behind_subject, find_floor, static_scene
from thermofusion.geometry.camera import pixel_rays
from thermofusion.geometry.rigid import transform_points
from thermofusion.recipe import load_recipe
from thermofusion.scans import open_scan


def subject_frames(scan, recipe):
    return SubjectFrames(scan, input=recipe.input, subject=recipe.subject)


RAYS = (pixel_rays(scenes.CAMERA) / pixel_rays(scenes.CAMERA)[..., 2:]).astype(np.float32)
WALL = scenes.box([-1.5, -1.2, 1.0], [1.5, 1.2, 1.05])


def truth_mask(poses):
    """Where the body alone would be seen."""
    return np.isfinite(scenes.walk(poses, noise=0).depth_m)


@pytest.mark.parametrize("down_m", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("turn_deg", [0, 50])
def test_the_floor_is_found_where_it_is(down_m, turn_deg):
    poses = scenes.orbit(2, turn_deg, down_m=down_m)[1:]
    depth = scenes.walk(poses, room=(scenes.floor(),)).depth_m[0]
    floor = find_floor(depth, RAYS)
    assert floor is not None
    T_depth_body = np.linalg.inv(poses[0])
    points = np.array([[x, scenes.FLOOR_Y_M, z] for x in (-0.4, 0.4) for z in (-0.4, 0.4)])
    assert np.abs(transform_points(T_depth_body, points) @ floor[:3] + floor[3]).max() < 0.012
    assert floor[3] == pytest.approx(scenes.FLOOR_Y_M - poses[0][1, 3], abs=0.01)  # camera height


def test_a_body_is_no_floor():
    for depth in scenes.walk(scenes.orbit(6, 300, down_m=0.4)).depth_m:
        assert find_floor(depth, RAYS) is None


def test_nothing_is_no_floor():
    assert find_floor(np.full((120, 160), np.nan, np.float32), RAYS) is None


def test_a_wall_behind_goes_and_the_body_stays():
    poses = scenes.orbit(1, 0)
    depth = scenes.walk(poses, room=(WALL,)).depth_m[0]
    body = truth_mask(poses)[0]
    behind = behind_subject(depth)
    assert behind[~body].mean() > 0.99
    assert behind[body].mean() < 0.005


def test_a_body_alone_has_nothing_behind():
    depth = scenes.walk(scenes.orbit(1, 0)).depth_m[0]
    assert not behind_subject(depth).any()
    assert not behind_subject(np.full((120, 160), np.nan, np.float32)).any()


def test_subject_frames_leave_the_body():
    poses = scenes.orbit(4, 60, down_m=0.3)
    scan = scenes.walk(poses, room=(scenes.floor(), WALL)).scan()
    frames = subject_frames(scan, load_recipe("full-body"))
    for i, body in enumerate(truth_mask(poses)):
        depth, floor = frames.load(i)
        kept = np.isfinite(depth)
        assert kept[~body].sum() < 0.02 * body.sum()
        assert kept[body].mean() > 0.85  # at this resolution a tenth of the body is outline, which the filter takes
        assert floor is not None


def test_what_the_recipe_keeps_is_kept():
    poses = scenes.orbit(1, 0, down_m=0.3)
    scan = scenes.walk(poses, room=(scenes.floor(), WALL)).scan()
    recipe = load_recipe("full-body", ["subject.floor=keep", "subject.background=keep", "input.max_grazing_deg=90"])
    kept = np.isfinite(subject_frames(scan, recipe).load(0)[0])
    seen = np.isfinite(scan.depth.load(0))
    assert kept.sum() > 0.97 * seen.sum()  # flying pixels alone are gone


def test_what_stands_still_behind_a_turning_subject_is_known():
    poses = scenes.orbit(40, 300)
    standing = (scenes.box([-1.5, -1.2, 1.55], [1.5, 1.2, 1.6]),)
    scan = scenes.walk(poses, standing=standing).scan()
    recipe = load_recipe("turntable-object")
    room = static_scene(DepthFrames(scan, recipe.input))
    bodies = truth_mask(poses)
    never = ~bodies.any(0)
    assert np.isfinite(room[never]).mean() > 0.95
    np.testing.assert_allclose(np.nanmedian(room[never]), 1.55, atol=0.01)
    kept = [np.isfinite(subject_frames(scan, recipe).load(i)[0]) for i in (0, 13, 26)]
    for mask, body in zip(kept, bodies[[0, 13, 26]], strict=True):
        assert mask[never].mean() < 0.01
        assert mask[body].mean() > 0.75


def test_feet_and_floor_of_a_recording(shared_data):
    scan = open_scan(shared_data("body-dev"))
    frames = subject_frames(scan, load_recipe("full-body"))
    heights = []
    for i in range(250, 600, 50):
        depth, floor = frames.load(i)
        assert floor is not None
        heights.append(floor[3])
        assert 0.05 < np.isfinite(depth).mean() < 0.3  # the body alone
        assert np.nanmax(depth) < 2.3
    assert np.ptp(heights) < 0.6  # a hand-held camera goes down along the body, not through the floor
