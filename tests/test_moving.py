"""How a subject moved: the solver against dense algebra, motion of a made body found again, frames brought to rest."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.walkround import ellipsoid, walk

from thermofusion.geometry._open3d import o3d
from thermofusion.geometry.camera import pixel_rays
from thermofusion.geometry.outline import OutlineCaster, project_contour
from thermofusion.geometry.rigid import invert, se3_exp, transform_points
from thermofusion.motion.body import moved_by
from thermofusion.motion.coarse import clear_of_edges
from thermofusion.motion.estimate import STILL, Solution, estimate, look_points
from thermofusion.motion.field import BoundPoints, MotionField, affine, displacement, rotations
from thermofusion.motion.gauge import common_motion, poses_without, without
from thermofusion.motion.graph import MAX_NODES, bind, build_graph
from thermofusion.motion.parts import name_parts
from thermofusion.motion.rest import unrest
from thermofusion.motion.rows import CoarseFrames, LeftOver, Normal, Sums, jacobian
from thermofusion.motion.solve import Steps, Tridiagonal, edge_matrix, held_matrix, solve_motion
from thermofusion.motion.told import amplitudes, described, joined, ranges
from thermofusion.motion.warp import RestSurface, Warp
from thermofusion.phantom.scene import ShapeConfig
from thermofusion.phantom.shapes import build_shape
from thermofusion.report.summary import _moved_too_much
from thermofusion.types import Camera, SurfaceMesh

SMALL = Camera(160, 120, np.array([[140.0, 0, 79.5], [0, 140, 59.5], [0, 0, 1]]))
NOISE_M = 1e-3
LEAN_DEG, LEAN_S = 2.0, 8.0  # of the made body's upper half, in and out


@pytest.fixture(scope="module")
def body() -> SurfaceMesh:
    return ellipsoid(60)


def leaning(mesh: SurfaceMesh, angle_rad: float) -> SurfaceMesh:
    """The upper half turned about a hip line; the share of the turn grows over 20 cm."""
    share = np.clip(mesh.vertices_m[:, 2] / 0.2, 0, 1)
    share = share * share * (3 - 2 * share)
    turn = np.zeros((len(mesh), 3))
    turn[:, 0] = share * angle_rad
    moved = np.einsum("vij,vj->vi", rotations(turn), mesh.vertices_m.astype(np.float64))
    return replace(mesh, vertices_m=moved.astype(np.float32))


def depth_of(mesh: SurfaceMesh, camera: Camera, T_world_depth: np.ndarray) -> np.ndarray:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices_m), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    rays = pixel_rays(camera)
    rays = rays / rays[..., 2:]
    eye = np.broadcast_to(T_world_depth[:3, 3], rays.shape)
    cast = np.concatenate([eye, rays @ T_world_depth[:3, :3].T], -1).astype(np.float32)
    z = scene.cast_rays(o3d.core.Tensor(cast))["t_hit"].numpy()
    return np.where(np.isfinite(z), z, np.float32(np.nan))


def recorded(mesh: SurfaceMesh, angle_deg: float) -> CoarseFrames:
    """A walk round a body that leans to and fro."""
    path, rng = walk(12.0, tremor=0.3), np.random.default_rng(4)
    images = []
    for t, T in zip(path.times_s, path.T_world_depth, strict=True):
        z = depth_of(leaning(mesh, np.radians(angle_deg) * np.sin(2 * np.pi * t / LEAN_S)), SMALL, T)
        images.append((z + rng.normal(0, NOISE_M, z.shape) * z**2).astype(np.float32))
    K = SMALL.K
    return CoarseFrames(images, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), path.times_s, path.T_world_depth)


def test_a_block_tridiagonal_system_is_solved_as_dense_algebra_does():
    rng = np.random.default_rng(0)
    F, m = 5, 7
    own = np.array([a @ a.T + 20 * np.eye(m) for a in rng.normal(size=(F, m, m))])
    after = rng.normal(size=(F - 1, m, m))
    dense = np.zeros((F * m, F * m))
    for f in range(F):
        dense[f * m : f * m + m, f * m : f * m + m] = own[f]
    for f in range(F - 1):
        dense[f * m : f * m + m, f * m + m : f * m + 2 * m] = after[f]
        dense[f * m + m : f * m + 2 * m, f * m : f * m + m] = after[f].T
    b = rng.normal(size=(F, m))
    x = Tridiagonal.of(F, lambda f: own[f], lambda f: after[f]).solve(b)
    np.testing.assert_allclose(x.ravel(), np.linalg.solve(dense, b.ravel()), rtol=2e-4, atol=1e-6)


def test_what_holds_knots_together_knows_no_rigid_motion_of_joints_and_lets_jumps_pass(body):
    graph = build_graph(body.vertices_m, body.triangles, 0.15)
    knots = np.arange(4) * 0.67
    turn = np.array([0.002, -0.001, 0.003])
    rigid = np.concatenate([np.tile(turn, (len(graph), 1)), np.cross(turn, graph.at_m)], axis=1)
    twist = np.zeros((4, len(graph), 6))
    twist[1:] = rigid
    twist[3:, 0, 3] += 0.032  # four sigmas
    steps = Steps.of(graph, knots, twist)
    step = np.diff(twist.reshape(4, -1), axis=0)
    pull = steps.pull(step)
    np.testing.assert_allclose(pull[0], steps.node[0] * step[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(pull[2], steps.at(2) @ step[2], rtol=1e-9)
    np.testing.assert_allclose(steps.node[2] / steps.node[1], (1 + (4 / 2.5) ** 2) ** -2, rtol=1e-6)
    assert not steps.at(-1).any()
    assert not steps.at(3).any()


def test_what_is_never_seen_goes_with_what_it_hangs_on(body):
    """The lower part of a body turns at once by 2°; its last 25 cm are not seen."""
    graph = build_graph(body.vertices_m, body.triangles, 0.15)
    at, knots = graph.at_m, np.arange(12) * 0.67
    hinge = np.array([0, 0, at[:, 2].min() + 0.6])
    low = np.clip((hinge[2] - at[:, 2]) / 0.1, 0, 1)[:, None]
    turn = np.array([np.radians(2.0), 0, 0])
    moved = np.concatenate([low * turn, low * np.cross(turn, at - hinge)], axis=1)
    truth = np.where(np.arange(12)[:, None, None] < 6, -0.5, 0.5) * moved
    pick = look_points(body, 0.02)
    points = BoundPoints(body.vertices_m[pick], body.normals[pick], graph.binding.take(pick))
    J = jacobian(points, at)
    end = at[:, 2] < at[:, 2].min() + 0.25
    weight = np.where(points.at_m[:, 2] > points.at_m[:, 2].min() + 0.25, 10 / 0.003**2, 0.0)
    own, twist = np.tile(weight, (12, 1)), np.zeros_like(truth)
    held = held_matrix(graph, edge_matrix(graph))
    for _ in range(6):
        r = (J @ (truth - twist).reshape(12, -1).T).T
        sums = Sums(own, np.zeros((11, len(pick))), own * r, own.sum(0), r.mean(0), 1.0, 1.0)
        slow = Steps.of(graph, knots, twist)
        twist = solve_motion(sums, Normal.of(J), J, twist, held, slow, 0.2).twist
    found, true = twist[:, end, 3:], truth[:, end, 3:]
    assert np.sqrt(((found - true) ** 2).sum(2).mean()) < 0.17 * np.sqrt((true**2).sum(2).mean())


def test_a_rigid_motion_of_all_nodes_is_the_cameras(body):
    """What the whole body does in common leaves the nodes and enters the poses; measured points stay."""
    graph = build_graph(body.vertices_m, body.triangles, 0.15)
    rng = np.random.default_rng(1)
    knots = np.array([0.0, 1.0, 2.0])
    common = se3_exp(rng.normal(0, [0.02] * 3 + [0.01] * 3, (3, 6)))
    there = np.stack([transform_points(T, graph.at_m) for T in common])
    twist = np.concatenate([np.zeros_like(there), there - graph.at_m], axis=2)
    field = MotionField(graph.at_m, knots, twist)
    found = common_motion(field, np.ones(len(graph)))
    np.testing.assert_allclose(found, common, atol=1e-9)
    assert np.abs(without(field, found).twist[..., 3:]).max() < 1e-9
    T = np.tile(np.eye(4), (3, 1, 1))
    np.testing.assert_allclose(poses_without(field, found, knots, T), invert(common), atol=1e-12)


def test_points_of_a_node_s_piece_move_rigidly_and_a_rigid_field_is_exact(body):
    graph = build_graph(body.vertices_m, body.triangles, 0.15)
    w, t = np.array([0.03, -0.02, 0.04]), np.array([0.004, 0.002, -0.003])
    R = rotations(w[None])[0]
    shift = graph.at_m @ R.T + t - graph.at_m
    twist = np.concatenate([np.tile(w, (len(graph), 1)), shift], axis=1)
    moved = body.vertices_m + displacement(body.vertices_m, graph.binding, graph.at_m, twist)
    np.testing.assert_allclose(moved, body.vertices_m @ R.T.astype(np.float32) + t, atol=2e-6)
    turned = moved_by(body, affine(graph.at_m, twist, graph.binding))
    np.testing.assert_allclose(turned.normals, body.normals @ R.T.astype(np.float32), atol=2e-6)
    again = bind(body.vertices_m, body.triangles, graph.at_m)
    np.testing.assert_array_equal(again.node, graph.binding.node)


def test_loose_pieces_carry_no_nodes_and_their_number_is_bounded(body):
    """A surface in rags (a floor that moved against the body) does not take memory without end."""
    alone, rng = build_graph(body.vertices_m, body.triangles, 0.15), np.random.default_rng(2)
    near = body.vertices_m[rng.choice(len(body), 400, replace=False)]
    specks = (near[:, None] * 1.05 + rng.normal(0, 3e-3, (400, 3, 3))).reshape(-1, 3).astype(np.float32)
    triangles = np.arange(1200, dtype=np.int32).reshape(-1, 3)
    vertices = np.concatenate([specks, body.vertices_m])
    torn = build_graph(vertices, np.concatenate([triangles, body.triangles + 1200]), 0.15)
    assert abs(len(torn) - len(alone)) <= 2
    share = np.zeros((len(vertices), len(torn)))
    of = torn.binding.group
    np.add.at(share, (np.arange(len(vertices))[:, None], torn.binding.node[of]), torn.binding.weight[of])
    carrier = (share @ torn.at_m)[:1200]  # about where those stand that carry a speck
    assert np.linalg.norm(carrier - specks, axis=1).max() < 0.2
    assert len(build_graph(body.vertices_m, body.triangles, 0.01)) == MAX_NODES


def test_a_leaning_body_is_found_and_a_still_one_is_left_alone(body):
    still, moving = recorded(body, 0.0), recorded(body, LEAN_DEG)
    knots = np.linspace(0, 12, 19)
    assert unrest(still, body, look_points(body, 0.025), knots, NOISE_M) < 0.6 * STILL
    assert estimate(body, still, NOISE_M, lambda _: body) is None
    found = estimate(body, moving, NOISE_M, lambda _: body)
    assert found is not None
    assert found.after.rms < 0.8 * found.before
    # in the world of the poses that were given, the surface stands where it stood, the far side of the walk included
    top, error, size = body.vertices_m[:, 2] > 0.3, [], []
    for i in range(5, len(moving), 5):
        t, lean = moving.times_s[i], np.radians(LEAN_DEG) * np.sin(2 * np.pi * moving.times_s[i] / LEAN_S)
        rest, field = found.surface.vertices_m, found.field
        now = rest + displacement(rest, found.binding, field.node_m, field.at(t))
        now = transform_points(invert(se3_exp(found.correction[i])), now.astype(np.float64))
        truth = leaning(body, lean).vertices_m
        error.append((now - truth)[top].mean(0))
        size.append((truth - body.vertices_m)[top].mean(0))
    error_m, size_m = (np.sqrt((np.var(x, axis=0)).sum()) for x in (error, size))
    assert size_m > 0.007
    assert error_m < 0.25 * size_m


def test_stretches_of_too_much_motion_are_joined():
    bad = np.array([0, 1, 1, 0, 1, 0, 0, 1, 0, 1, 1, 1, 1], bool)
    assert ranges(np.arange(13.0), bad) == ((1.0, 4.0), (7.0, 12.0))
    assert ranges(np.arange(4.0), np.array([1, 1, 0, 0], bool)) == ()


def before_a_camera(body):
    """A camera, a graph of the body, a pose (4, 4) from which it sees it, and a motion that is none."""
    camera = Camera(320, 240, np.array([[280.0, 0, 159.5], [0, 280, 119.5], [0, 0, 1]]))
    graph = build_graph(body.vertices_m, body.triangles, 0.15)
    return (
        camera,
        graph,
        walk(12.0, tremor=0.0).T_world_depth[10],
        MotionField.at_rest(graph.at_m, np.array([0.0, 1.0])),
    )


def test_frames_are_brought_to_rest(body):
    """A body that leans is seen upright again, to the size of a pixel's slope; without motion nothing changes."""
    camera, graph, T, zero = before_a_camera(body)
    rest = depth_of(body, camera, T)
    same = Warp(RestSurface(body.vertices_m, body.triangles, graph.binding, zero), camera)(rest, T, 0.5)
    np.testing.assert_allclose(same, rest, atol=1e-6)

    twist = np.zeros((2, len(graph), 6))
    twist[:, :, 3:] = [0.012, -0.008, 0.01]
    field = zero.moved(twist)
    moved = moved_by(body, affine(graph.at_m, field.at(0.5), graph.binding))
    seen = depth_of(moved, camera, T)
    back = Warp(RestSurface(body.vertices_m, body.triangles, graph.binding, field), camera)(seen, T, 0.5)
    both = np.isfinite(back) & np.isfinite(rest)
    assert both.sum() > 0.97 * np.isfinite(rest).sum()
    assert np.nanmedian(np.abs(back - rest)) < 1e-3 < np.nanmedian(np.abs(seen - rest))


def test_parts_are_named_by_place():
    """A body that faces -y has its right hand at -x, whichever way the axes are turned."""
    made = build_shape(ShapeConfig(kind="body", subdivisions=0))
    turn = rotations(np.array([[0.3, -0.5, 2.0]]))[0]
    mesh = SurfaceMesh((made.vertices_m @ turn.T).astype(np.float32), made.triangles.astype(np.int32), made.normals)
    names, part = name_parts(mesh, turn @ np.array([0.0, 0.0, 1.0]))
    middle = {n: made.vertices_m[part == k].mean(0) for k, n in enumerate(names)}
    assert all((part == k).any() for k in range(len(names)))
    for pair in ("hand", "forearm", "upper arm", "thigh", "shin", "foot"):
        assert middle[f"right {pair}"][0] < -0.05 < 0.05 < middle[f"left {pair}"][0]
    order = ("foot", "shin", "thigh")
    assert all(middle[f"left {a}"][2] < middle[f"left {b}"][2] for a, b in pairwise(order))
    assert middle["head"][2] > middle["chest"][2] > middle["belly"][2] > middle["pelvis"][2]
    reach = [np.abs(middle[f"left {k}"][0]) for k in ("upper arm", "forearm", "hand")]
    assert reach == sorted(reach)


def test_amplitudes_are_the_rms_of_displacements(body):
    graph = build_graph(body.vertices_m, body.triangles, 0.15)
    twist = np.random.default_rng(3).normal(0, [0.03] * 3 + [0.008] * 3, (5, len(graph), 6))
    field = MotionField(graph.at_m, np.arange(5.0), twist)
    far = [displacement(body.vertices_m, graph.binding, graph.at_m, t) for t in twist]
    rms = np.sqrt((np.array(far) ** 2).sum(2).mean(0))
    np.testing.assert_allclose(amplitudes(body, field, graph.binding), rms, rtol=1e-3)


def test_an_outline_is_carried_along_to_where_the_moved_body_shows_it(body):
    """Cast at rest and carried, it lies where one lies that is cast from the body as it leans."""
    camera = Camera(320, 240, np.array([[280.0, 0, 159.5], [0, 280, 119.5], [0, 0, 1]]))
    share = np.clip(body.vertices_m[:, 2:] / 0.2, 0, 1)
    share = share * share * (3 - 2 * share)
    turn = np.zeros((len(body), 3))
    turn[:, :1] = share * np.radians(3.0)
    R = rotations(turn)
    at, normals = (
        np.einsum("vij,vj->vi", R, x.astype(np.float64)).astype(np.float32) for x in (body.vertices_m, body.normals)
    )
    leans = replace(body, vertices_m=at, normals=normals)
    for T in walk(12.0, tremor=0.0).T_world_depth[::30]:
        caster, T_camera_world = OutlineCaster(body, camera), invert(T)
        true = project_contour(camera, T_camera_world, OutlineCaster(leans, camera).contour(T))
        off = {}
        for name, contour in (("carried", caster.posed(leans).contour(T)), ("left", caster.contour(T))):
            uv = project_contour(camera, T_camera_world, contour).uv_px
            distance, nearest = cKDTree(true.uv_px).query(uv)
            across = np.einsum("ni,ni->n", uv - true.uv_px[nearest], true.normal_px[nearest])
            off[name] = np.percentile(np.abs(across[distance < 5]), 95)
        assert off["carried"] < 0.2
        assert off["left"] > 3 * off["carried"]


def test_what_stands_behind_an_edge_is_not_looked_up():
    """A near square before a slanted wall: pixels on either side of its rim go, those of the slope and inside stay."""
    u = np.arange(50)[None] * np.ones((40, 1))
    z = (1.5 + 0.01 * u).astype(np.float32)
    z[10:30, 15:35] = 1.3
    left = clear_of_edges(z, 300.0)
    rim = np.zeros(z.shape, bool)
    rim[9:31, 14:36] = True
    rim[11:29, 16:34] = False
    np.testing.assert_array_equal(np.isnan(left), rim)
    np.testing.assert_array_equal(left[~rim], z[~rim])


def test_a_look_past_the_body_is_minus_what_stands_behind(body):
    """So that the fusion knows where a finger ends; nothing of it comes to rest."""
    camera, graph, T, zero = before_a_camera(body)
    alone = depth_of(body, camera, T)
    seen = np.where(np.isfinite(alone), alone, np.float32(2.5))
    rest = Warp(RestSurface(body.vertices_m, body.triangles, graph.binding, zero), camera)(seen, T, 0.5)
    past = rest < 0
    np.testing.assert_allclose(rest[past], -2.5)
    assert not np.isfinite(alone[past]).any()
    near = cv2.dilate(np.isfinite(alone).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert past[near & ~np.isfinite(alone)].mean() > 0.99


@pytest.mark.parametrize(("swing_m", "seen"), [(0.01, ()), (0.06, ((10.0, 20.0),))])
def test_motion_too_quick_for_its_knots_is_told_with_its_time(body, swing_m, seen):
    """The upper half swings to and fro within 4 s, from 10 s to 20 s: by 1 cm it is followed, by 6 cm it is not."""
    graph = build_graph(body.vertices_m, body.triangles, 0.15)
    knots = np.linspace(0, 30, 47)
    twist = np.zeros((47, len(graph), 6))
    swing = swing_m * np.sin(2 * np.pi * knots / 4) * ((knots > 10) & (knots < 20))
    high = graph.at_m[:, 2] > 0
    twist[:, high, 3] = swing[:, None]
    points = body.vertices_m[::10]
    left = LeftOver(0.7, np.full(len(points), 0.7), np.linspace(0, 30, 100), np.zeros(100))
    field = MotionField(graph.at_m, knots, twist)
    solution = Solution(field, body, graph.binding, np.zeros((100, 6)), 2.0, left, points)
    path = walk(12.0)
    told = described(body, solution, graph.binding, path, np.array([0, 0, 1.0]))
    np.testing.assert_allclose(told.too_much, seen, atol=1.3)
    low = body.vertices_m[:, 2] < -0.15
    assert not told.unsettled[low].any()
    assert told.unsettled[body.vertices_m[:, 2] > 0.15].all() == bool(seen)
    assert joined(((4.0, 6.0), (1.0, 3.0), (2.0, 4.5), (8.0, 9.0))) == ((1.0, 6.0), (8.0, 9.0))
    sentence = _moved_too_much(told.too_much)
    assert (sentence != []) == bool(seen)
    assert all("the subject moved too much between 10 s and 2" in text for text in sentence)
