"""Shares of the hemisphere filled by the body, against analytic form factors and energy conservation."""

from __future__ import annotations

import numpy as np
import pytest

from thermofusion.temperature.room.surroundings import SurroundingsResult, surroundings
from thermofusion.types import SurfaceMesh

TINY_OFFSET_M = 1e-4  # analytic form factors are those of the surface itself
QUADRATURE = 0.02  # largest error of 400 directions with interpolation between samples


def grid_mesh(points: np.ndarray, *, flip: bool = False) -> SurfaceMesh:
    """A mesh of a (rows, columns, 3) net of points; normals towards the side from which i, j turn counter-clockwise."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (s.ravel() for s in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1)).reshape(-1, 3)
    if flip:
        triangles, normals = triangles[:, ::-1], -normals
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return SurfaceMesh(
        points.reshape(-1, 3).astype(np.float32),
        np.ascontiguousarray(triangles),
        (normals / np.maximum(length, 1e-12)).astype(np.float32),
    )


def join(*meshes: SurfaceMesh) -> SurfaceMesh:
    start = np.cumsum([0, *(len(m) for m in meshes)])
    return SurfaceMesh(
        np.concatenate([m.vertices_m for m in meshes]),
        np.concatenate([m.triangles + s for m, s in zip(meshes, start, strict=False)]).astype(np.int32),
        np.concatenate([m.normals for m in meshes]),
    )


def sphere_part(radius: float, polar_from: float, polar_to: float, *, inward: bool, n: int = 60) -> SurfaceMesh:
    polar, azimuth = np.meshgrid(np.linspace(polar_from, polar_to, n), np.linspace(0, 2 * np.pi, 2 * n), indexing="ij")
    p = radius * np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    mesh = grid_mesh(p, flip=inward)
    normals = mesh.vertices_m / radius * (-1 if inward else 1)
    return SurfaceMesh(mesh.vertices_m, mesh.triangles, normals.astype(np.float32))


def disc(radius: float, z: float, *, up: bool) -> SurfaceMesh:
    r, azimuth = np.meshgrid(np.linspace(1e-4, radius, 40), np.linspace(0, 2 * np.pi, 121), indexing="ij")
    mesh = grid_mesh(np.stack([r * np.cos(azimuth), r * np.sin(azimuth), np.full_like(r, z)], -1), flip=not up)
    normals = np.tile(np.float32([0, 0, 1 if up else -1]), (len(mesh), 1))
    return SurfaceMesh(mesh.vertices_m, mesh.triangles, normals)


def test_convex_body_sees_only_room():
    ball = sphere_part(0.3, 1e-3, np.pi - 1e-3, inward=False)
    assert surroundings(ball).body_fraction.max() == 0


@pytest.mark.parametrize("cap_deg", [60, 90, 120])
def test_inside_of_a_spherical_bowl(cap_deg):
    """Between elements of a sphere's inside dF = dA / 4πR²: every point sees the bowl's own share of the sphere."""
    bowl = sphere_part(0.5, 1e-3, np.radians(cap_deg), inward=True)
    expected = (1 - np.cos(np.radians(cap_deg))) / 2
    fine = surroundings(bowl, offset_m=TINY_OFFSET_M, directions=400).body_fraction - expected
    default = surroundings(bowl, offset_m=TINY_OFFSET_M).body_fraction - expected
    assert np.abs(fine).max() < QUADRATURE
    assert abs(fine.mean()) < 0.002
    assert np.sqrt(np.mean(default**2)) < QUADRATURE / 2


def test_parallel_discs():
    """Element to a coaxial disc: F = ½ (1 - (Z - 2R²)/√(Z² - 4R²)), Z = 1 + H² + R² (Howell's catalogue B-13)."""
    radius, h = 0.3, 0.25
    lower, upper = disc(radius, 0.0, up=True), disc(radius, h, up=False)
    result = surroundings(join(lower, upper), offset_m=TINY_OFFSET_M, directions=400)
    a = np.hypot(*lower.vertices_m[:, :2].T).clip(1e-4)
    Z = 1 + (h / a) ** 2 + (radius / a) ** 2
    expected = 0.5 * (1 - (Z - 2 * (radius / a) ** 2) / np.sqrt(Z**2 - 4 * (radius / a) ** 2))
    inner = a < radius - 0.02  # at the rim samples lie on one side only
    assert np.abs(result.body_fraction[: len(lower)] - expected)[inner].max() < QUADRATURE


def test_v_groove():
    """Element at x from the apex of a long groove of opening α, walls of width w: ½ (1 + (w cos α - x)/√(...))."""
    alpha, width, length = np.radians(60), 0.4, 12.0
    s, y = np.meshgrid(np.linspace(0.002, width, 60), np.linspace(-length / 2, length / 2, 241), indexing="ij")
    flat = grid_mesh(np.stack([s, y, 0 * s], -1))
    tilted = grid_mesh(np.stack([s * np.cos(alpha), y, s * np.sin(alpha)], -1), flip=True)
    result = surroundings(join(flat, tilted), offset_m=TINY_OFFSET_M, directions=400)
    x = flat.vertices_m[:, 0]
    middle = (np.abs(flat.vertices_m[:, 1]) < 1) & (x > 0.05)
    expected = 0.5 * (1 + (width * np.cos(alpha) - x) / np.sqrt(x**2 + width**2 - 2 * x * width * np.cos(alpha)))
    assert np.abs(result.body_fraction[: len(flat)] - expected)[middle].max() < QUADRATURE


def test_isothermal_body_in_a_room_of_its_own_temperature_is_lit_by_exactly_that():
    bowl = sphere_part(0.3, 1e-3, np.radians(100), inward=True)
    level = 61.08
    skin = np.full(len(bowl), level)
    skin[::7] = np.nan
    reflected = surroundings(bowl).reflected_radiance(level, skin, emissivity=0.95, bounces=3)
    np.testing.assert_allclose(reflected, level, rtol=1e-12)


def test_bounces_reach_the_radiosity_of_a_grey_bowl():
    """In a uniform bowl L_r = (1-F) L_room + F (ε L + (1-ε) L_r): closed form at every point."""
    F, eps, room, skin = 0.5, 0.8, 50.0, 60.0
    bowl = sphere_part(0.5, 1e-3, np.pi / 2, inward=True)
    got = surroundings(bowl, offset_m=TINY_OFFSET_M, directions=400).reflected_radiance(
        room, np.full(len(bowl), skin), emissivity=eps, bounces=12
    )
    expected = ((1 - F) * room + F * eps * skin) / (1 - F * (1 - eps))
    assert np.abs(got - expected).max() < QUADRATURE * (skin - room)


def test_radiance_comes_from_the_wall_that_is_hit():
    """Two facing plates, one half of the upper warm: the lower one is lit more below the warm half; NaN is no zero."""
    lower, upper = disc(0.4, 0.0, up=True), disc(0.4, 0.1, up=False)
    mesh, room = join(lower, upper), 50.0
    warm = mesh.vertices_m[:, 0] > 0
    skin = np.where(warm, 70.0, 60.0)
    skin[: len(lower)] = np.nan  # the lower plate was not measured: it must not pull anything towards 0
    result = surroundings(mesh)
    lit = result.reflected_radiance(room, skin)[: len(lower)]
    x, r = lower.vertices_m[:, 0], np.hypot(*lower.vertices_m[:, :2].T)
    F = result.body_fraction[: len(lower)]
    expected = room + F * (np.where(x > 0, 70.0, 60.0) - room)
    inside = (np.abs(x) > 0.2) & (r < 0.3)
    assert np.abs(lit - expected)[inside].max() < 0.8
    unmeasured = result.reflected_radiance(room, np.full(len(mesh), np.nan))
    np.testing.assert_array_equal(unmeasured, room)


def test_holes_count_as_body():
    """An open tube over a plate: what the plate sees through the tube's open end is body, not room."""
    z, azimuth = np.meshgrid(np.linspace(0, 0.5, 50), np.linspace(0, 2 * np.pi, 121), indexing="ij")
    tube = grid_mesh(0.15 * np.stack([np.cos(azimuth), np.sin(azimuth), z / 0.15], -1), flip=True)
    assert (tube.normals * tube.vertices_m)[:, :2].sum(1).min() > 0
    plate = disc(0.05, -0.05, up=True)  # looks up into the open end: only backs of triangles
    result = surroundings(join(tube, plate), offset_m=TINY_OFFSET_M)
    into_the_tube = result.body_fraction[-len(plate) :]
    assert into_the_tube.min() > 0.7
    skin = np.full(len(tube) + len(plate), 60.0)
    assert result.reflected_radiance(50.0, skin)[-1] == pytest.approx(50 + 10 * float(into_the_tube[-1]), abs=1e-3)


def test_noise_of_the_mesh_is_no_cavity():
    """3 mm of vertex noise at 4 mm spacing (raw Kinect fusion) must not make a flat patch see itself."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(-0.2, 0.2, 0.004), np.arange(-0.2, 0.2, 0.004), indexing="ij")
    rough = grid_mesh(np.stack([x, y, rng.normal(0, 0.0015, x.shape)], -1))
    flat_normals = np.tile(np.float32([0, 0, 1]), (len(rough), 1))
    result = surroundings(SurfaceMesh(rough.vertices_m, rough.triangles, flat_normals))
    assert result.body_fraction.max() < 0.02


def test_same_mesh_same_result_and_bad_input():
    bowl = sphere_part(0.3, 1e-3, 1.2, inward=True, n=30)
    first, second = surroundings(bowl), surroundings(bowl)
    assert isinstance(first, SurroundingsResult)
    np.testing.assert_array_equal(first.body_fraction, second.body_fraction)
    assert (first.hits != second.hits).nnz == 0
    with pytest.raises(ValueError, match="triangles"):
        surroundings(SurfaceMesh(bowl.vertices_m, np.zeros((0, 3), np.int32), bowl.normals))
