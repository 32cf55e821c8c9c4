"""Depth filtering against planes and steps whose truth is known, and undistortion against the projection itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermofusion.depth.filter import DepthFrames, DepthUndistorter, filter_depth
from thermofusion.geometry.camera import pixel_rays
from thermofusion.recipe import InputSection
from thermofusion.types import Camera, Rig, Scan, Stream

CAMERA = Camera(320, 240, np.array([[300.0, 0, 161.2], [0, 305.0, 117.9], [0, 0, 1]]))
SECTION = InputSection()
rng = np.random.default_rng(5)


def plane(tilt_deg: float, distance_m: float = 1.2, noise_m: float = 0.0) -> np.ndarray:
    """Depth of a plane through (0, 0, distance) turned about the vertical by `tilt_deg`."""
    n = np.array([np.sin(np.radians(tilt_deg)), 0, -np.cos(np.radians(tilt_deg))])
    rays = pixel_rays(CAMERA)
    rays /= rays[..., 2:]
    with np.errstate(divide="ignore"):
        z = n[2] * distance_m / (rays @ n)
    z[(z < 0.1) | (z > 10)] = np.nan
    return (z + rng.normal(0, noise_m, z.shape) * z**2).astype(np.float32)


def true_angle_deg(tilt_deg: float) -> np.ndarray:
    n = np.array([np.sin(np.radians(tilt_deg)), 0, -np.cos(np.radians(tilt_deg))])
    return np.degrees(np.arccos(np.clip(np.abs(pixel_rays(CAMERA) @ n), 0, 1)))


@pytest.mark.parametrize("tilt_deg", [0, 45, 60, 68, 75])
def test_grazing_pixels_go_and_others_stay(tilt_deg: float) -> None:
    """Kinect noise, 1.4 mm at 1 m: within 4° of the limit the noise may decide, elsewhere the angle does."""
    depth = plane(tilt_deg, noise_m=1.4e-3)
    angle = true_angle_deg(tilt_deg)
    usable = np.isfinite(depth) & (depth > SECTION.min_depth_m + 0.02) & (depth < 2.0)
    kept = np.isfinite(filter_depth(depth, CAMERA, SECTION.model_copy(update={"max_grazing_deg": 72.0})))
    flat, oblique = usable & (angle < 66), usable & (angle > 78)
    flat[[0, -1]] = flat[:, [0, -1]] = False
    assert kept[flat].mean() > 0.99 if flat.sum() > 100 else True
    assert kept[oblique].mean() < 0.02 if oblique.sum() > 100 else True


def test_kept_depth_is_unchanged_and_the_input_untouched() -> None:
    depth = plane(30, noise_m=1e-3)
    before = depth.copy()
    out = filter_depth(depth, CAMERA, SECTION)
    kept = np.isfinite(out)
    np.testing.assert_array_equal(depth, before)
    np.testing.assert_array_equal(out[kept], depth[kept])
    assert out.dtype == np.float32
    assert out.shape == depth.shape


def test_a_veil_between_two_surfaces_goes_but_their_edges_stay() -> None:
    depth = np.full(CAMERA.shape, 1.0, np.float32)
    depth[:, 160:] = 1.6
    depth[:, 159] = 1.3  # one column of flying pixels
    depth[60, 60] = 1.2  # speckle on the near surface
    out = filter_depth(depth, CAMERA, SECTION)
    inner = np.s_[2:-2]
    assert np.isnan(out[:, 159]).all()
    assert np.isnan(out[60, 60])
    assert np.isfinite(out[inner, 155:159]).all()
    assert np.isfinite(out[inner, 160:164]).all()


def test_range_limits_and_empty_images() -> None:
    depth = np.full(CAMERA.shape, 1.0, np.float32)
    depth[:, :100] = SECTION.max_depth_m + 0.1
    depth[:, 100:200] = SECTION.min_depth_m - 0.1
    out = filter_depth(depth, CAMERA, SECTION)
    assert np.isnan(out[:, :200]).all()
    assert np.isfinite(out[2:-2, 202:-2]).all()
    assert np.isnan(filter_depth(np.full(CAMERA.shape, np.nan, np.float32), CAMERA, SECTION)).all()
    one = np.full(CAMERA.shape, np.nan, np.float32)
    one[100, 100] = 1.0
    assert np.isnan(filter_depth(one, CAMERA, SECTION)).all()


def test_undistorted_depth_lies_on_the_true_surface() -> None:
    """A tilted plane seen through a distorting lens: points backprojected with the pinhole lie on the plane again."""
    lens = Camera(320, 240, CAMERA.K, np.array([-0.24, 0.11, 0.0011, -0.0006, 0.0]))
    n = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    rays = pixel_rays(lens)
    rays /= rays[..., 2:]
    depth = (n @ [0, 0, 1.2] / (rays @ n)).astype(np.float32)
    undistort = DepthUndistorter(lens)
    out = undistort(depth)
    assert not undistort.camera.is_distorted
    pinhole = pixel_rays(undistort.camera)
    points = (pinhole / pinhole[..., 2:] * out[..., None])[np.isfinite(out)]
    off = (points - [0, 0, 1.2]) @ n
    # Half a pixel in u and in v on this slope is 1.1 mm; the lens squeezes pixels by up to 1/0.6 at the corner.
    assert np.abs(off).max() < 1.8e-3
    assert abs(off.mean()) < 0.02e-3  # rounding to the nearest pixel takes no side


def test_a_camera_without_distortion_passes_through() -> None:
    depth = plane(20)
    assert DepthUndistorter(CAMERA)(depth) is depth


def test_frames_come_in_order_and_filtered() -> None:
    images = [np.full(CAMERA.shape, 0.8 + 0.1 * i, np.float32) for i in range(7)]
    stream = Stream(np.arange(7.0), lambda i: images[i], tuple("abcdefg"), np.arange(7), np.ones(7, bool))
    frames = DepthFrames(Scan("s", Path(), "memory", Rig(CAMERA), stream), SECTION)
    got = list(frames.read_ahead([6, 0, 3, 2]))
    assert [i for i, _ in got] == [6, 0, 3, 2]
    for i, depth in got:
        np.testing.assert_array_equal(depth, filter_depth(images[i], CAMERA, SECTION))
