"""Thermal views onto a surface of known shape: visibility, angle, signal, silhouettes."""

from __future__ import annotations

import numpy as np
import pytest

from thermofusion.geometry._open3d import o3d
from thermofusion.geometry.camera import pixel_rays, project
from thermofusion.geometry.rigid import invert, pose, transform_points
from thermofusion.mapping.observe import SurfaceRays, clear_of_silhouettes, observe_view, sample_bilinear
from thermofusion.recipe import MappingSection
from thermofusion.types import Camera, SurfaceMesh

CAMERA = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), np.array([-0.2, 0.05, 0.001, 0, 0]))
MAPPING = MappingSection(silhouette_px=3, border_px=4, last_resort_angle_deg=75, last_resort_silhouette_px=3)


def sphere(center=(0.0, 0.0, 0.0), radius=0.2, resolution=90):
    m = o3d.t.geometry.TriangleMesh.create_sphere(radius, resolution)
    v = m.vertex.positions.numpy().astype(np.float64)
    n = v / np.linalg.norm(v, axis=1, keepdims=True)
    return (v + center).astype(np.float32), m.triangle.indices.numpy().astype(np.int32), n.astype(np.float32)


def mesh_of(*parts):
    base, V, F, N = 0, [], [], []
    for v, f, n in parts:
        V.append(v), F.append(f + base), N.append(n)
        base += len(v)
    return SurfaceMesh(np.concatenate(V), np.concatenate(F).astype(np.int32), np.concatenate(N))


@pytest.fixture(scope="module")
def view():
    """The eye 1 m before the origin, looking along +z, slightly turned and shifted."""
    a = np.radians(4)
    R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return pose(R, np.array([-0.05, 0.02, -1.0]))


def test_angle_range_and_footprint_of_a_sphere_are_the_analytic_ones(view):
    mesh = mesh_of(sphere())
    o = observe_view(SurfaceRays(mesh), CAMERA, view, np.ones(CAMERA.shape, np.float32), MAPPING, view=7)
    p, eye = mesh.vertices_m[o.vertex].astype(np.float64), view[:3, 3]
    d = np.linalg.norm(eye - p, axis=1)
    cos = np.einsum("ij,ij->i", p / 0.2, eye - p) / d
    np.testing.assert_allclose(o.cos_angle, cos, atol=2e-4)
    np.testing.assert_allclose(o.range_m, d, rtol=1e-5)
    np.testing.assert_allclose(o.footprint_m2, d**2 / (300**2 * cos), rtol=2e-3)
    assert (np.diff(o.vertex) > 0).all()
    assert (o.view == 7).all()
    # nothing beyond the angle limit, and everything well inside it
    assert np.degrees(np.arccos(cos)).max() < 75
    cos_all = np.einsum("ij,ij->i", mesh.vertices_m / 0.2, eye - mesh.vertices_m)
    cos_all /= np.linalg.norm(eye - mesh.vertices_m, axis=1)
    assert np.isin(np.flatnonzero(cos_all > np.cos(np.radians(60))), o.vertex).all()


def test_signal_is_the_one_painted_on_the_surface(view):
    """An image rendered from a pattern on the sphere gives the pattern back at every vertex."""
    mesh = mesh_of(sphere())
    rays = pixel_rays(CAMERA) @ view[:3, :3].T
    eye = view[:3, 3]
    b = rays @ eye
    t = -b - np.sqrt(np.maximum(b**2 - (eye @ eye - 0.2**2), 0))
    hit = eye + rays * t[..., None]
    image = (60 + 5 * hit[..., 0] + 3 * hit[..., 1]).astype(np.float32)
    o = observe_view(SurfaceRays(mesh), CAMERA, view, image, MAPPING)
    p = mesh.vertices_m[o.vertex]
    near = o.cos_angle > 0.6
    np.testing.assert_allclose(o.radiance[near], (60 + 5 * p[:, 0] + 3 * p[:, 1])[near], atol=2e-3)


def test_a_sphere_in_front_hides_what_is_behind_and_both_sides_of_its_outline_are_rejected(view):
    front, back = sphere((0, 0, -0.45), 0.05), sphere()
    mesh = mesh_of(front, back)
    o = observe_view(SurfaceRays(mesh), CAMERA, view, np.ones(CAMERA.shape, np.float32), MAPPING)
    n_front, eye = len(front[0]), view[:3, 3]
    behind = o.vertex[o.vertex >= n_front]
    p = mesh.vertices_m[behind].astype(np.float64)
    ray = p - eye
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    miss = np.linalg.norm(np.cross(ray, np.array([0, 0, -0.45]) - eye), axis=1)
    assert miss.min() > 0.05  # no vertex in the shadow
    # the outline of the front sphere in pixels: 3 px clear on both sides
    angle = np.linspace(0, 2 * np.pi, 2000)
    c = np.array([0, 0, -0.45]) - eye
    dist = np.linalg.norm(c)
    w = c / dist
    e1 = np.cross(w, [0, 1, 0]) / np.linalg.norm(np.cross(w, [0, 1, 0]))
    e2 = np.cross(w, e1)
    r, along = 0.05 * np.sqrt(1 - (0.05 / dist) ** 2), dist - 0.05**2 / dist
    rim = eye + along * w + r * (np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2)
    rim_px, _ = project(CAMERA, transform_points(invert(view), rim))
    uv = np.stack([o.u_px, o.v_px], 1)
    gap = np.linalg.norm(uv[:, None] - rim_px[None, ::10], axis=2).min(1)
    assert gap.min() > 3 - 1.2  # contour points are rounded to pixels
    assert (o.vertex < n_front).any()


def test_nan_pixels_and_the_border_give_no_observation(view):
    mesh = mesh_of(sphere())
    image = np.ones(CAMERA.shape, np.float32)
    image[:, 160:] = np.nan
    o = observe_view(SurfaceRays(mesh), CAMERA, view, image, MAPPING)
    assert len(o)
    assert o.u_px.max() <= 159
    assert np.isfinite(o.radiance).all()


def test_bilinear_sampling():
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    uv = np.array([[0, 0], [1.5, 0.5], [3, 2], [3.01, 1], [-0.01, 0]])
    np.testing.assert_allclose(sample_bilinear(image, uv), [0, 3.5, 11, np.nan, np.nan])


def test_rows_near_an_outline_count_only_where_nothing_clearer_saw_the_spot():
    from thermofusion.types import Observations

    edge_px = np.array([2.2, 5, 2.5, 9], np.float32)
    vertex = np.array([0, 0, 1, 2], np.int32)
    column = np.ones(4, np.float32)
    rows = Observations(vertex, np.zeros(4, np.int32), *[column] * 6, edge_px)
    clear, counts = clear_of_silhouettes(rows, 4, 3.0)
    assert clear.tolist() == [False, True, False, True]
    assert counts.tolist() == [False, True, True, True]
