"""Rigid motions and the camera, against OpenCV and against identities."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from support.scan_maker import backproject

from thermofusion.geometry.camera import pixel_rays, project, viewing_cosine
from thermofusion.geometry.rigid import (
    interpolate_trajectory,
    invert,
    rigid_alignment,
    se3_exp,
    se3_log,
    transform_points,
)
from thermofusion.types import Camera, Trajectory, check_rigid

twists = arrays(np.float64, 6, elements=st.floats(-1.5, 1.5, allow_subnormal=False))
K = np.array([[589.4, 0, 322.4], [0, 609.3, 243.9], [0, 0, 1]])
BARREL = np.array([-0.24, 0.11, 0.0011, -0.0006, -0.02])
RATIONAL = np.array([0.4, -0.2, 0.001, -0.0005, 0.02, 0.7, -0.1, 0.03])


@given(twists)
@settings(max_examples=60, deadline=None)
def test_exponential_is_the_matrix_exponential_and_inverts(xi):
    A = np.zeros((4, 4))
    A[:3, :3] = [[0, -xi[2], xi[1]], [xi[2], 0, -xi[0]], [-xi[1], xi[0], 0]]
    A[:3, 3] = xi[3:]
    T = se3_exp(xi)
    np.testing.assert_allclose(T, expm(A), atol=1e-9)
    np.testing.assert_allclose(se3_log(T), xi, atol=1e-7)
    np.testing.assert_allclose(invert(T) @ T, np.eye(4), atol=1e-12)


@given(twists, twists)
@settings(max_examples=30, deadline=None)
def test_interpolation_is_independent_of_the_world_frame(a, b):
    T = np.stack([np.eye(4), se3_exp(0.3 * a)])
    W = se3_exp(b)
    times = np.array([0.2, 0.5, 0.9])
    here, ok = interpolate_trajectory(Trajectory(np.array([0.0, 1.0]), T), times)
    there, _ = interpolate_trajectory(Trajectory(np.array([0.0, 1.0]), W @ T), times)
    assert ok.all()
    np.testing.assert_allclose(W @ here, there, atol=1e-9)
    # constant velocity along the geodesic
    np.testing.assert_allclose(se3_log(here), 0.3 * a * times[:, None], atol=1e-7)


def test_interpolation_refuses_gaps_and_far_ends():
    trajectory = Trajectory(np.array([0.0, 0.1, 0.2, 2.0]), np.tile(np.eye(4), (4, 1, 1)))
    _, ok = interpolate_trajectory(trajectory, np.array([-1.0, -0.04, 0.05, 1.0, 0.2, 3.0]), max_gap_s=0.5)
    assert ok.tolist() == [False, True, True, False, True, False]


@pytest.mark.parametrize("distortion", [np.zeros(5), BARREL, RATIONAL], ids=["none", "barrel", "rational"])
def test_projection_agrees_with_opencv(distortion):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, 500), rng.uniform(-0.3, 0.3, 500), rng.uniform(0.8, 1.5, 500)])
    uv, z = project(Camera(640, 480, K, distortion), points)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)
    np.testing.assert_allclose(uv, expected[:, 0], atol=1e-8)
    np.testing.assert_array_equal(z, points[:, 2])


@pytest.mark.parametrize("distortion", [np.zeros(5), BARREL, RATIONAL], ids=["none", "barrel", "rational"])
def test_pixel_rays_project_back_to_their_pixels(distortion):
    camera = Camera(640, 480, K, distortion)
    rays = pixel_rays(camera)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-12)
    uv, _ = project(camera, rays.reshape(-1, 3))
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    np.testing.assert_allclose(uv.reshape(480, 640, 2), np.stack([u, v], -1), atol=1e-3)


def test_points_far_outside_the_field_do_not_fold_back_into_the_image():
    camera = Camera(640, 480, K, np.array([-0.4, 0.0, 0.0, 0.0, 0.0]))
    x = np.linspace(0, 3, 400)
    uv, _ = project(camera, np.column_stack([x, np.zeros(400), np.ones(400)]))
    seen = np.isfinite(uv[:, 0])
    assert seen[0]
    assert not seen[-1]
    assert (np.diff(uv[seen, 0]) > 0).all()  # one pixel, one direction


def test_points_behind_the_camera_are_not_seen():
    uv, _ = project(Camera(640, 480, K), np.array([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.1, 0.1, 1.0]]))
    assert np.isnan(uv[:2]).all()
    assert np.isfinite(uv[2]).all()


def test_backprojection_inverts_projection():
    camera = Camera(64, 48, np.array([[60.0, 0, 31], [0, 61, 23], [0, 0, 1]]), BARREL)
    depth = np.random.default_rng(1).uniform(0.5, 2, (48, 64))
    depth[3, 4] = np.nan
    points = backproject(camera, depth)
    assert np.isnan(points[3, 4]).all()
    uv, z = project(camera, np.delete(points.reshape(-1, 3), 3 * 64 + 4, 0))
    np.testing.assert_allclose(z, np.delete(depth.ravel(), 3 * 64 + 4), atol=1e-12)
    assert np.isfinite(uv).all()


@given(twists)
@settings(max_examples=30, deadline=None)
def test_alignment_recovers_a_motion(xi):
    points = np.random.default_rng(2).normal(size=(30, 3))
    T = se3_exp(xi)
    np.testing.assert_allclose(rigid_alignment(points, transform_points(T, points)), T, atol=1e-9)


def test_viewing_angle_is_to_the_eye_not_to_the_axis():
    # a patch 30° off the axis that faces the eye squarely
    p = np.array([[np.sin(np.radians(30)), 0, np.cos(np.radians(30))]])
    assert viewing_cosine(p, -p, np.zeros(3))[0] == pytest.approx(1.0)
    assert viewing_cosine(p, p, np.zeros(3))[0] == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("T", "word"),
    [
        (np.eye(3), "4x4"),
        (np.diag([1, 1, -1, 1]), "rotation"),
        (np.diag([2, 2, 2, 1]), "rotation"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_what_is_no_rigid_transform_is_named(T, word):
    with pytest.raises(ValueError, match=word):
        check_rigid(T, "T_thermal_depth")


def test_gradient_of_a_plane_and_of_noise():
    """A plane in a field of 10 K/m, seen as its rms over directions; noise of single vertices is hardly one."""
    from thermofusion.geometry.mesh import edge_gradient

    n = 40
    y, x = np.mgrid[0:n, 0:n].reshape(2, -1) * 3e-3
    vertices = np.column_stack([x, y, 0 * x]).astype(np.float32)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    inner = i[3:-3, 3:-3].ravel()
    angle = np.radians(22.5)  # no edge of this mesh is preferred
    slope = edge_gradient(vertices, triangles, 10 * (np.cos(angle) * x - np.sin(angle) * y))
    np.testing.assert_allclose(slope[inner], slope[inner][0], rtol=1e-3)
    assert 7 < slope[inner][0] < 13
    noise = 0.01 * np.random.default_rng(2).normal(size=n * n)
    assert np.median(edge_gradient(vertices, triangles, noise)[inner]) < 0.3 * np.sqrt(2) * 0.01 / 3e-3
    holed = np.where(x > 0.06, np.nan, 10 * x)
    assert np.isfinite(edge_gradient(vertices, triangles, holed)).all()


def test_fine_structure_is_half_the_laplacian_of_what_a_blur_leaves():
    """On a wave of wave number k a blur of variance s² leaves exp(-k²s²/2), and a second one takes 1 - that of it."""
    from thermofusion.geometry.mesh import fine_structure

    edge = 3e-3
    n = 80
    grid = np.arange(n * n).reshape(n, n)
    x, y = edge * (grid // n).ravel(), edge * (grid % n).ravel()
    vertices = np.stack([x, y, 0 * x], axis=1).astype(np.float32)
    a, b, c, d = (grid[i : n - 1 + i, j : n - 1 + j].ravel() for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]).astype(np.int32)
    inner = (np.minimum(x, y) > 0.06) & (np.maximum(x, y) < edge * (n - 1) - 0.06)
    width, k = 5e-3, 2 * np.pi / 0.03
    found = fine_structure(vertices, triangles, np.cos(k * x), width) * width**2
    left = np.exp(-((k * width) ** 2) / 2)
    np.testing.assert_allclose(found[inner].max(), left * (1 - left), rtol=0.15)
    assert fine_structure(vertices, triangles, 30 + 20 * x, width)[inner].max() * width**2 < 1e-3
    holed = np.where(x < 0.1, np.nan, 33.0)
    assert not fine_structure(vertices, triangles, holed, width)[x < 0.1].any()
    assert np.isfinite(fine_structure(vertices, triangles, holed, width)).all()


def test_points_along_the_curve_cover_a_surface_evenly_in_whatever_order_they_stand():
    from thermofusion.geometry.patches import along_curve

    rng = np.random.default_rng(5)
    sphere = rng.normal(size=(20_000, 3))
    sphere *= 0.5 / np.linalg.norm(sphere, axis=1, keepdims=True)
    drawn = sphere[along_curve(sphere, 1e-5)[::20]]
    shuffled = sphere[rng.permutation(len(sphere))]
    np.testing.assert_array_equal(shuffled[along_curve(shuffled, 1e-5)[::20]], drawn)

    def counts(points):  # in cubes of 20 cm
        return np.bincount(np.ravel_multi_index(((points + 0.6) / 0.2).astype(int).T, (6, 6, 6)), minlength=216)

    expected = counts(sphere) / 20

    def uneven(points):
        return np.mean((counts(points) - expected)[expected > 3] ** 2 / expected[expected > 3])

    assert uneven(drawn) < 0.5 * uneven(sphere[rng.choice(len(sphere), 1000, replace=False)])
