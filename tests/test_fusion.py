"""Fusion against shapes whose surface is a formula: rendered with Kinect noise, fused, compared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.truth import truth_of

from thermofusion.depth.filter import DepthFrames
from thermofusion.errors import ResourceError, ScanError
from thermofusion.geometry.camera import pixel_rays
from thermofusion.geometry.mesh import (
    canonical,
    close_pinholes,
    components,
    keep_vertices,
    smooth_positions,
    triangle_normals,
    vertex_areas,
)
from thermofusion.geometry.normals import plane_normals, window_normals
from thermofusion.recipe import load_recipe
from thermofusion.surface import surface as fusion
from thermofusion.surface.clean import subject_only
from thermofusion.surface.surface import SurfaceResult, depth_poses, fuse_surface
from thermofusion.surface.tsdf import (
    FramePoses,
    Frames,
    VoxelGrid,
    depth_noise,
    integrate_frames,
    plan_grid,
    survey_depth,
)
from thermofusion.types import Camera, Rig, Scan, Stream, Trajectory

CAMERA = Camera(240, 180, np.array([[230.0, 0, 121.3], [0, 233.0, 88.2], [0, 0, 1]]))
WIDE = Camera(240, 180, np.array([[130.0, 0, 120.0], [0, 130.0, 90.0], [0, 0, 1]]))
LENS = Camera(
    320, 240, np.array([[260.0, 0, 158.0], [0, 262.0, 121.0], [0, 0, 1]]), np.array([0.05, -0.1, 1e-3, -8e-4, 0])
)
NOISE = 1.425e-3  # m at 1 m, Kinect v1
RECIPE = {"surface": {"voxel_mm": 4, "normal_window_mm": 30}, "subject": {"min_component_cm2": 20}}
COARSE = {**RECIPE, "surface": {"voxel_mm": 10}, "input": {"max_depth_m": 2.7}}


# ---------------------------------------------------------------- shapes: nearest distance along rays, inf = missed


def sphere(center, radius):
    def hit(origin, direction):
        m = origin - np.asarray(center)
        b = direction @ m
        with np.errstate(invalid="ignore"):
            t = -b - np.sqrt(b**2 - (m @ m - radius**2))
        return np.where(t > 0, t, np.inf)

    return hit


def post(x, y, radius, bottom, top):
    """An upright cylinder without lids."""

    def hit(origin, direction):
        m, d = origin[:2] - [x, y], direction[..., :2]
        a, b, c = (d**2).sum(-1), d @ m, m @ m - radius**2
        with np.errstate(invalid="ignore", divide="ignore"):
            t = (-b - np.sqrt(b**2 - a * c)) / a
            z = origin[2] + t * direction[..., 2]
        return np.where((t > 0) & (z > bottom) & (z < top), t, np.inf)

    return hit


def plane(n, d):
    def hit(origin, direction):
        with np.errstate(divide="ignore"):
            t = -(origin @ n + d) / (direction @ n)
        return np.where(t > 0, t, np.inf)

    return hit


def look_at(eye, target):
    z = np.asarray(target, float) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3] = np.stack([x, np.cross(z, x), z, eye], axis=1)
    return T


def orbit(n, radius=1.0, height=0.2, target=(0, 0, 0), arc_deg=360.0):
    a = np.radians(np.arange(n) * arc_deg / n)
    return np.stack([look_at([radius * np.cos(t), radius * np.sin(t), height], target) for t in a])


def render(shapes, poses, camera=CAMERA, noise=NOISE, seed=0):
    rng, rays = np.random.default_rng(seed), pixel_rays(camera)
    images = []
    for T in poses:
        t = np.min([s(T[:3, 3], rays @ T[:3, :3].T) for s in shapes], axis=0)
        z = t * rays[..., 2]
        z = z + rng.normal(0, noise, z.shape) * np.where(np.isfinite(z), z, 0) ** 2
        images.append(np.where(np.isfinite(z), np.round(z, 3), np.nan).astype(np.float32))
    return images


def stream(images, times=None):
    n = len(images)
    times = np.arange(n) / 15 if times is None else times
    return Stream(times, lambda i: images[i], tuple(f"frame {i}" for i in range(n)), np.arange(n), np.ones(n, bool))


def scan_of(images, camera=CAMERA, **more):
    return Scan("shapes", Path("shapes"), "memory", Rig(camera), stream(images), **more)


def fuse(images, poses, recipe=None, camera=CAMERA, **more):
    scan = scan_of(images, camera)
    return fuse_along(scan, Trajectory(scan.depth.times_s, poses), recipe or RECIPE, **more)


def fuse_along(scan, trajectory, recipe, floor_plane=None):
    tracked, recipe = SimpleNamespace(trajectory=trajectory, floor_plane=floor_plane), load_recipe(recipe)
    return fuse_surface(scan, tracked, input=recipe.input, subject=recipe.subject, surface=recipe.surface)


def closed(mesh):
    """Every edge belongs to two triangles that run along it in opposite directions."""
    t = mesh.triangles
    e = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    forth, back = (np.unique(x, axis=0) for x in (e, e[:, ::-1]))
    return len(forth) == len(e) and np.array_equal(forth, back)


@pytest.fixture(scope="module")
def ball() -> tuple[list, np.ndarray, SurfaceResult]:
    """A 300 mm ball seen from a ring above and a ring below: all round."""
    poses = np.concatenate([orbit(16, height=0.6), orbit(16, height=-0.6)])
    images = render([sphere((0, 0, 0), 0.15)], poses)
    return images, poses, fuse(images, poses)


# ---------------------------------------------------------------- accuracy


def test_a_ball_comes_out_round_closed_and_facing_outward(ball) -> None:
    mesh = ball[2].mesh
    radius = np.linalg.norm(mesh.vertices_m, axis=1)
    error = np.abs(radius - 0.15)
    assert error.mean() < 0.4e-3
    assert np.percentile(error, 95) < 1.0e-3
    assert closed(mesh)
    outward = mesh.vertices_m / radius[:, None]
    angle = np.degrees(np.arccos(np.clip((mesh.normals * outward).sum(1), -1, 1)))
    assert angle.mean() < 1.5
    assert np.percentile(angle, 99) < 4.0
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    face = triangle_normals(mesh.vertices_m, mesh.triangles)
    assert ((face * outward[mesh.triangles[:, 0]]).sum(1) > 0).mean() > 0.999  # counter-clockwise from outside


def test_a_pixel_centre_is_where_the_conventions_say() -> None:
    """Seen from one side only, half a pixel of error (2 mm here) would shift the ball sideways by as much."""
    poses = orbit(12, arc_deg=30, height=0.0)
    result = fuse(render([sphere((0, 0, 0), 0.15)], poses, noise=0.3e-3), poses)
    V = result.mesh.vertices_m.astype(float)
    A = np.column_stack([2 * V, np.ones(len(V))])
    centre = np.linalg.lstsq(A, (V**2).sum(1), rcond=None)[0][:3]
    assert np.linalg.norm(centre) < 0.4e-3


def test_no_memory_to_begin_with_costs_no_surface(ball) -> None:
    """A grid that starts with room for a single block grows to the same surface as one with room for all."""
    images, poses, expected = ball
    scan, recipe = scan_of(images), load_recipe(RECIPE)
    frames: Frames = DepthFrames(scan, recipe.input)
    placed = depth_poses(scan, Trajectory(scan.depth.times_s, poses), 0.5)
    survey = survey_depth(scan, frames, placed)
    sections = {"input": recipe.input, "surface": recipe.surface}
    plan = plan_grid(scan, survey, **sections)
    grid, _ = integrate_frames(survey, frames, placed, replace(plan, blocks=1), **sections)
    V, F = canonical(*grid.extract(3))
    assert grid.blocks == expected.blocks_used
    F = close_pinholes(V, F, fusion.PINHOLE_VOXELS * plan.voxel_m)
    np.testing.assert_array_equal(V, expected.mesh.vertices_m)
    np.testing.assert_array_equal(F, expected.mesh.triangles)
    assert expected.blocks_used <= expected.blocks_estimated < 2 * expected.blocks_used


def test_the_same_input_gives_the_same_bits(ball) -> None:
    images, poses, first = ball
    again = fuse(images, poses)
    np.testing.assert_array_equal(first.mesh.vertices_m, again.mesh.vertices_m)
    np.testing.assert_array_equal(first.mesh.triangles, again.mesh.triangles)
    np.testing.assert_array_equal(first.mesh.normals, again.mesh.normals)


def test_noise_is_found_in_the_data(ball) -> None:
    assert depth_noise(ball[0]) == pytest.approx(NOISE, rel=0.1)
    still = [np.round(d, 3) for d in render([plane(np.array([1.0, 0, 0]), 0)], orbit(2, arc_deg=20), noise=3e-3)]
    assert depth_noise(still) == pytest.approx(3e-3, rel=0.1)


# ---------------------------------------------------------------- floor, background


PERSON = [
    post(0, -0.12, 0.06, 0, 0.75),  # two legs on the floor z = 0 ...
    post(0, 0.12, 0.06, 0, 0.75),
    sphere((0, 0, 0.85), 0.25),  # ... and a trunk that joins them
]
FLOOR, WALL = plane(np.array([0, 0, 1.0]), 0), plane(np.array([-1.0, 0, 0]), 1.5)


@pytest.fixture(scope="module")
def standing() -> tuple[list, np.ndarray]:
    """A walk round, the wall behind the subject for half of it and behind the camera for the other half."""
    poses = orbit(24, radius=1.1, height=1.1, target=(0, 0, 0.5))
    return render([*PERSON, FLOOR, WALL], poses, camera=WIDE), poses


def test_the_floor_goes_and_the_feet_stay(standing) -> None:
    images, poses = standing
    result = fuse(images, poses, COARSE, WIDE)
    V = result.mesh.vertices_m
    np.testing.assert_allclose(result.floor_plane, [0, 0, 1, 0], atol=4e-3)
    trunk = np.linalg.norm(V - [0, 0, 0.85], axis=1) - 0.25
    legs = np.hypot(V[:, :1], V[:, 1:2] - [-0.12, 0.12]) - 0.06
    off = np.minimum(np.abs(trunk), np.abs(legs).min(1))
    assert (off > 0.02).mean() < 0.002
    for side in (V[:, 1] < 0, V[:, 1] > 0):
        assert 0.012 <= V[side, 2].min() < 0.022  # from floor_clearance_mm up to a voxel more
    reasons = {r.reason: r.area_cm2 for r in result.removed}
    assert reasons["floor"] > 5000
    assert reasons["wall"] > 5000


def test_floor_and_background_stay_if_asked(standing) -> None:
    images, poses = standing
    keep = {**COARSE, "subject": {"floor": "keep", "background": "keep"}}
    V = fuse(images, poses, keep, WIDE).mesh.vertices_m
    assert (np.abs(V[:, 2]) < 0.01).mean() > 0.3
    assert (np.abs(V[:, 0] - 1.5) < 0.02).any()


def test_a_given_floor_is_refined_and_a_body_has_none(standing, ball) -> None:
    images, poses = standing
    tilted = np.array([0.01, 0, 1, 0.006])
    result = fuse(images, poses, COARSE, WIDE, floor_plane=tilted / np.linalg.norm(tilted[:3]))
    np.testing.assert_allclose(result.floor_plane, [0, 0, 1, 0], atol=4e-3)
    assert ball[2].floor_plane is None
    asked = fuse(ball[0], ball[1], {**RECIPE, "subject": {"floor": "remove"}})
    assert any("no floor" in m for m in asked.messages)
    assert len(asked.mesh) == len(ball[2].mesh)


def test_the_subject_is_what_was_looked_at_not_what_is_largest() -> None:
    poses = orbit(24, height=0.3)
    near, large = sphere((0, 0, 0), 0.12), sphere((-1.35, 0, 0), 0.5)
    both = render([near, large], poses)
    V = fuse(both, poses).mesh.vertices_m
    assert np.abs(np.linalg.norm(V, axis=1) - 0.12).max() < 0.02


# ---------------------------------------------------------------- memory, poses, faults


def test_memory_bounds_the_grid_and_the_message_says_so(ball) -> None:
    images, poses, free = ball
    bound = free.memory_gib / 3
    result = fuse(images, poses, {**RECIPE, "surface": {"voxel_mm": 4, "max_memory_gib": bound}})
    assert result.memory_gib <= bound
    assert result.voxel_m > free.voxel_m
    assert any("max_memory_gib" in m for m in result.messages)
    with pytest.raises(ResourceError, match="GiB"):
        fuse(images, poses, {**RECIPE, "surface": {"voxel_mm": 4, "max_memory_gib": 1e-5}})


def test_a_frame_that_tracking_lost_is_not_interpolated(ball) -> None:
    images, poses, _ = ball
    scan = scan_of(images)
    has = np.arange(len(images)) != 7
    own = Trajectory(scan.depth.times_s[has] + 2e-4, poses[has])
    assert 7 not in depth_poses(scan, own, 0.5).frame
    mocap = Trajectory(np.arange(200) * 0.0113, np.repeat(poses[:1], 200, 0))
    assert len(depth_poses(scan, mocap, 0.5).frame) == len(images)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d, T, t: (d, T, t + 100), ["pose", "clock"]),
        (lambda d, T, t: ([x * 1000 for x in d], T, t), ["depth_unit_m", "1e+03"]),
        (lambda d, T, t: ([x / 1000 for x in d], T, t), ["depth_unit_m"]),
        (lambda d, T, t: ([x * np.nan for x in d], T, t), ["empty", "depth_unit_m"]),
        (lambda d, T, t: (d, T * np.array([1, 1, 1, 1000])[None, None], t), ["m across", "metres"]),
        (lambda d, T, t: (d, T * np.array([1, 1, 1, 20])[None, None], t), ["surface"]),
    ],
    ids=["no overlap", "depth in mm", "depth in km", "no depth", "poses in mm", "poses apart"],
)
def test_bad_input_is_one_clear_sentence(ball, change, words) -> None:
    images, poses, _ = ball
    scan = scan_of(images)
    d, T, t = change(images, poses.copy(), scan.depth.times_s)
    T[:, 3, 3] = 1
    with pytest.raises(ScanError) as e:
        fuse_along(scan_of(d), Trajectory(t, T), RECIPE)
    assert all(w in str(e.value) for w in words), e.value


def test_one_frame_is_a_surface(ball) -> None:
    images, poses, _ = ball
    result = fuse(images[:1], poses[:1])
    assert result.frames_used == 1
    assert len(result.mesh) > 1000
    assert np.isfinite(result.mesh.normals).all()


# ---------------------------------------------------------------- colour


def test_vertices_take_the_colour_painted_on_them(ball) -> None:
    """A ball painted by direction, seen through a distorting lens beside the depth camera; one view spoilt."""
    images, poses, plain = ball
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = -0.025
    rays, hit = pixel_rays(LENS), sphere((0, 0, 0), 0.15)
    photos = []
    for T in poses:
        W = T @ np.linalg.inv(T_color_depth)
        d = rays @ W[:3, :3].T
        t = hit(W[:3, 3], d)
        n = (W[:3, 3] + np.where(np.isfinite(t), t, 0)[..., None] * d) / 0.15
        photos.append(np.where(np.isfinite(t)[..., None], 128 + 100 * n, 255).astype(np.uint8))
    photos[5] = np.full_like(photos[5], 0)
    scan = replace(scan_of(images), rig=Rig(CAMERA, color=LENS, T_color_depth=T_color_depth), color=stream(photos))
    mesh = fuse_along(scan, Trajectory(scan.depth.times_s, poses), RECIPE).mesh
    np.testing.assert_array_equal(mesh.vertices_m, plain.mesh.vertices_m)
    expected = 128 + 100 * mesh.vertices_m / np.linalg.norm(mesh.vertices_m, axis=1, keepdims=True)
    off = np.abs(mesh.color_rgb.astype(float) - expected).max(1)
    assert np.median(off) < 3
    assert np.percentile(off, 99) < 10


# ---------------------------------------------------------------- meshes


def test_pinholes_close_and_openings_stay(ball) -> None:
    """Triangles lost here and there come back as a closed surface of the same side; a hole of 40 mm is an opening."""
    mesh = ball[2].mesh
    rng = np.random.default_rng(2)
    middle = mesh.vertices_m[mesh.triangles].mean(1)
    far = np.linalg.norm(middle - [0.15, 0, 0], axis=1) > 0.02
    lost = rng.choice(len(mesh.triangles), 150, replace=False)
    torn = np.delete(mesh.triangles, lost, axis=0)
    assert not closed(replace(mesh, triangles=torn))
    mended = close_pinholes(mesh.vertices_m, torn, 0.05)
    assert closed(replace(mesh, triangles=mended))
    np.testing.assert_allclose(
        vertex_areas(mesh.vertices_m, mended).sum(), vertex_areas(mesh.vertices_m, mesh.triangles).sum()
    )
    np.testing.assert_array_equal(close_pinholes(mesh.vertices_m, mesh.triangles[far], 0.05), mesh.triangles[far])


def test_canonical_order_depends_on_the_shape_alone(ball) -> None:
    mesh = ball[2].mesh
    rng = np.random.default_rng(1)
    shuffle = rng.permutation(len(mesh))
    back = np.empty_like(shuffle)
    back[shuffle] = np.arange(len(shuffle))
    tri = np.roll(back[mesh.triangles], 1, axis=1)[rng.permutation(len(mesh.triangles))]
    V, F = canonical(mesh.vertices_m[shuffle], tri)
    np.testing.assert_array_equal(V, mesh.vertices_m)
    np.testing.assert_array_equal(F, mesh.triangles)


def test_pieces_areas_and_smoothing(ball) -> None:
    mesh = ball[2].mesh
    V = np.concatenate([mesh.vertices_m, mesh.vertices_m + np.float32([1, 0, 0])]).astype(np.float32)
    F = np.concatenate([mesh.triangles, mesh.triangles + len(mesh)])
    label = components(F, len(V))
    assert len(np.unique(label)) == 2
    kept, tri = keep_vertices(V, F, label == label[0])
    np.testing.assert_array_equal(kept, mesh.vertices_m)
    np.testing.assert_array_equal(tri, mesh.triangles)
    assert vertex_areas(V, F).sum() == pytest.approx(2 * 4 * np.pi * 0.15**2, rel=0.03)
    smooth = smooth_positions(kept, tri, 10)
    error = [np.abs(np.linalg.norm(x, axis=1) - 0.15) for x in (kept, smooth)]
    assert error[1].mean() < 0.9 * error[0].mean()
    assert np.linalg.norm(smooth, axis=1).mean() == pytest.approx(0.15, abs=0.2e-3)  # Taubin does not shrink


def test_planes_are_those_of_all_points_within_the_radius() -> None:
    """Against eigenvectors of the scatter of the points themselves; a far point makes no plane, nor a large table."""
    rng = np.random.default_rng(4)
    points = rng.uniform(-0.5, 0.5, (400, 3)) * [0.1, 0.1, 0.03]
    points = np.vstack([points, [[2e3, 0.0, 0.0]]]).astype(np.float32)
    normals = plane_normals(points, 0.02)
    x = points.astype(np.float64)
    for i in range(400):
        near = x[((x - x[i]) ** 2).sum(1) <= 0.02**2]
        _, spread, axes = np.linalg.svd(near - near.mean(0), full_matrices=False)
        if len(near) >= 4 and spread[1] > 2 * spread[2]:
            assert abs(normals[i] @ axes[2]) > 1 - 1e-6
    assert np.isnan(normals[400]).all()
    assert plane_normals(points[:0], 0.02).shape == (0, 3)


def test_window_normals_of_two_near_surfaces_do_not_mix() -> None:
    """Two parallel sheets 5 mm apart, facing away from each other, like two fingers."""
    g = np.arange(0, 0.1, 0.004)
    x, y = np.meshgrid(g, g)
    n = len(g)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    F = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    top = np.stack([x.ravel(), y.ravel(), np.full(n * n, 0.0)], 1)
    V = np.concatenate([top, top - [0, 0, 0.005]]).astype(np.float32)
    both = np.concatenate([F, F[:, ::-1] + n * n]).astype(np.int32)
    N = window_normals(V, both, 0.02)
    assert (N[: n * n, 2] > 0.9).all()
    assert (N[n * n :, 2] < -0.9).all()


# ---------------------------------------------------------------- a recording


def test_torso_recording_meets_its_bars(shared_data) -> None:
    """Every third frame of the simulated torso, given poses, against its true surface."""
    from thermofusion.geometry._open3d import o3d
    from thermofusion.scans import open_scan

    folder = shared_data("torso-dev")
    scan = open_scan(folder)
    third = Trajectory(scan.trajectory.times_s[::3], scan.trajectory.T_world_depth[::3])
    result = fuse_along(scan, third, "torso")
    assert result.frames_used == 60
    truth = truth_of(folder)
    surface = o3d.t.geometry.RaycastingScene()
    surface.add_triangles(truth["vertices_m"], truth["triangles"].astype(np.uint32))
    near = surface.compute_closest_points(o3d.core.Tensor(result.mesh.vertices_m))
    off = np.linalg.norm(result.mesh.vertices_m - near["points"].numpy(), axis=1)
    assert (off > 0.02).mean() < 0.002
    assert off.mean() < 0.35e-3
    assert np.percentile(off, 95) < 0.9e-3
    cos = (result.mesh.normals * near["primitive_normals"].numpy()).sum(1)
    assert np.median(np.degrees(np.arccos(np.clip(cos, -1, 1)))) < 1.8  # the truth's own facets differ by 1° from it
    assert result.mesh.color_rgb is not None
    skin = result.mesh.color_rgb[(result.mesh.color_rgb != 128).any(1)]
    assert len(skin) > 0.8 * len(result.mesh)


def test_a_floor_smeared_into_layers_goes_where_tracking_saw_it() -> None:
    """Poses that hold a swaying body still move the floor under it: no one plane is left of it, its layers all go."""
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 81), np.linspace(-0.8, 0.8, 81))
    n = np.arange(80 * 81).reshape(80, 81)[:, :-1].ravel()
    sheet = np.concatenate([np.stack([n, n + 1, n + 82], 1), np.stack([n, n + 82, n + 81], 1)])
    vertices, triangles = [], []
    for k, z in enumerate((-0.05, -0.02, 0.02, 0.05)):  # about where it was seen
        vertices.append(np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3))
        triangles.append(sheet + k * x.size)
    body = np.stack([0.2 * np.cos(np.pi * y), 0.2 * np.sin(np.pi * y), 0.8 + x], -1).reshape(-1, 3)  # a tube
    vertices, triangles = [*vertices, body], [*triangles, sheet + 4 * x.size]
    survey = SimpleNamespace(T_world_depth=orbit(12, radius=1.1, height=1.1, target=(0, 0, 0.5)), camera=WIDE, depth=())
    subject = load_recipe(COARSE).subject
    soup = np.concatenate(vertices).astype(np.float32), np.concatenate(triangles).astype(np.int32)
    left = subject_only(*soup, survey, None, subject=subject, floor_plane=np.array([0, 0, 1.0, 0.004]))
    np.testing.assert_allclose(left.floor_plane, [0, 0, 1, 0], atol=0.021)
    assert left.vertices_m[:, 2].min() > 0.06
    assert len(left.vertices_m) > 0.8 * x.size
    all_of_it = subject.model_copy(update={"background": "keep"})
    kept = subject_only(*soup, survey, None, subject=all_of_it, floor_plane=np.array([0, 0, 1.0, -0.3]))
    assert (np.abs(kept.vertices_m[:, 2]) < 0.06).any()  # much lies below what was given: it was no floor


def test_a_look_past_the_subject_empties_what_is_nearer_and_ends_in_no_surface() -> None:
    """Depth below 0: what was closed by mistake opens again where later frames look through."""
    near = np.full(CAMERA.shape, 1.0, np.float32)
    past = near.copy()
    past[:, 120:126] = -1.6  # a gap between fingers
    images, poses = [near] * 2 + [past] * 6, np.tile(np.eye(4), (8, 1, 1))
    scan, recipe = scan_of([near] * 8), load_recipe(RECIPE)
    frames = DepthFrames(scan, recipe.input)
    placed = depth_poses(scan, Trajectory(scan.depth.times_s, poses), 0.1)
    survey = survey_depth(scan, frames, placed)
    grid = VoxelGrid(survey, plan_grid(scan, survey, input=recipe.input, surface=recipe.surface), 4000)
    assert all(grid.integrate(image, T) for image, T in zip(images, poses, strict=True))
    vertices, _ = grid.extract(1)
    left, right = ((u - CAMERA.K[0, 2]) / CAMERA.K[0, 0] for u in (119.5, 125.5))
    x = vertices[:, 0]
    assert not ((x > left + 5e-3) & (x < right - 5e-3) & (np.abs(vertices[:, 2] - 1.0) < 5e-3)).any()
    assert vertices[:, 2].max() < 1.1
    np.testing.assert_allclose(vertices[(x < left - 0.02) | (x > right + 0.02), 2], 1.0, atol=2e-3)


def test_frames_are_averaged_as_open3d_averages_them():
    """Of every voxel, against Open3D's own loop over the same blocks, with a look past the subject."""
    poses = orbit(6)
    images = render([sphere((0, 0, 0), 0.15), post(0.1, 0.1, 0.06, -0.2, 0.2)], poses)
    images[2] = np.where(np.isnan(images[2]), np.float32(-1.1), images[2])  # the room behind, as a look past
    scan, recipe = scan_of(images), load_recipe(RECIPE)
    frames, placed = DepthFrames(scan, recipe.input), FramePoses(np.arange(6), poses)
    survey = survey_depth(scan, frames, placed)
    plan = plan_grid(scan, survey, input=recipe.input, surface=recipe.surface)
    ours, theirs = VoxelGrid(survey, plan, plan.blocks), VoxelGrid(survey, plan, plan.blocks)
    tensor, K = ours._o3d.core.Tensor, CAMERA.K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    for depth, T in zip(images, poses, strict=True):
        assert ours.integrate(depth, T)
        whole = ours._depth(depth)
        blocks = theirs._blocks(np.maximum(whole, np.float32(0)), tensor(np.linalg.inv(T)))
        seen = theirs._o3d.t.geometry.Image(tensor(np.abs(whole)))
        theirs._grid.integrate(
            blocks, seen, tensor(K), tensor(np.linalg.inv(T)), 1.0, plan.max_range_m, plan.truncation_m / plan.voxel_m
        )

    def voxels(grid):
        table = grid._grid.hashmap()
        row = table.active_buf_indices().numpy()
        row = row[np.lexsort(table.key_tensor().numpy()[row].T)]
        return [grid._grid.attribute(name).numpy().reshape(-1, 512)[row] for name in ("tsdf", "weight")]

    (distance, weight), (their_distance, their_weight) = voxels(ours), voxels(theirs)
    assert distance.shape == their_distance.shape
    assert weight.max() > 3
    same = weight == their_weight
    assert same.mean() > 0.9999  # a voxel between two pixels may fall to either
    assert np.abs(distance - their_distance)[same].max() < 1e-5
