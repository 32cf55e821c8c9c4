"""Depth filtering against planes and steps whose truth is known, and undistortion against the projection itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermofusion.depth.filter import DepthFrames, DepthUndistorter, filter_depth
from thermofusion.depth.loops import blot_out, cell_means, coarser, from_steps, in_steps, near_enough
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


# ---------------------------------------------------------------- compiled loops against whole arrays


def rough(seed, shape=(37, 53)):
    """Depth of two surfaces with steps, noise and holes."""
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random(shape) < 0.5, 1.0, 1.4) + rng.normal(0, 0.004, shape)
    depth[rng.random(shape) < 0.2] = np.nan
    return np.round(depth, 3).astype(np.float32)


def test_pixels_with_enough_neighbours_are_kept():
    depth = rough(0)
    kept, top, bottom, left, right = near_enough(depth, 0.99, 1.402, 0.006, 3)
    inside = np.where((depth >= np.float32(0.99)) & (depth <= np.float32(1.402)), depth, np.float32(np.nan))
    near = np.zeros(depth.shape, int)
    for dv, du in ((0, 1), (1, -1), (1, 0), (1, 1)):
        there = np.full_like(inside, np.nan)
        there[: len(depth) - dv, max(0, -du) : 53 - max(0, du)] = inside[dv:, max(0, du) : 53 + min(0, du)]
        close = np.abs(inside - there) < inside * inside * np.float32(0.006)
        near += close
        near[dv:, max(0, du) : 53 + min(0, du)] += close[: len(depth) - dv, max(0, -du) : 53 - max(0, du)]
    np.testing.assert_array_equal(kept, np.where(near >= 3, inside, np.nan))
    rows, columns = (np.flatnonzero(np.isfinite(inside).any(k)) for k in (1, 0))
    assert (top, bottom, left, right) == (rows[0], rows[-1] + 1, columns[0], columns[-1] + 1)


def test_cells_of_pixels_have_their_means():
    depth = rough(1)
    depth[:, 20:] = np.where(np.isnan(depth[:, 20:]), np.nan, 1.2)
    whole = depth[:36, :52].reshape(9, 4, 13, 4).swapaxes(1, 2).reshape(9, 13, 16)
    count = np.isfinite(whole).sum(2)
    mean = cell_means(np.where(np.arange(53) < 52, depth, np.nan)[:36], 4, 0.25)[:, :13]
    np.testing.assert_allclose(mean, np.where(count > 4, np.nanmean(1 / whole, axis=2), np.nan), rtol=1e-5)
    assert cell_means(depth, 4, 0.25).shape == (10, 14)
    even = (2 * count >= 16) & (np.nanmax(whole, 2) - np.nanmin(whole, 2) < 0.03 * np.nanmin(whole, 2))
    assert even.any()
    np.testing.assert_allclose(coarser(depth, 4, 0.03), np.where(even, np.nanmean(whole, axis=2), np.nan), rtol=1e-6)
    cell = count > 12
    blotted = depth.copy()
    blot_out(blotted[:36, :52], cell, 4)
    np.testing.assert_array_equal(
        np.isnan(blotted[:36, :52]), np.isnan(depth[:36, :52]) | np.kron(cell, np.ones((4, 4), bool))
    )


def test_a_kept_image_comes_back_to_the_last_bit():
    steps = np.random.default_rng(2).integers(0, 65536, (8, 9)).astype(np.uint16)
    depth = np.where(steps > 0, steps.astype(np.float32) * np.float32(0.001), np.float32(np.nan))
    kept, again = np.empty((8, 9), np.uint16), np.empty((8, 9), np.float32)
    assert in_steps(depth, 0.001, kept)
    from_steps(kept, 0.001, again)
    np.testing.assert_array_equal(again, depth)
    assert not in_steps(depth + np.float32(3e-4), 0.001, kept)
