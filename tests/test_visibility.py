"""Views that contradict each other: what stands before the surface, means of few views, the camera's field."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from support.scan_maker import camera, stream, tiny_scan

from thermofusion.geometry.camera import pixel_rays
from thermofusion.geometry.rigid import pose
from thermofusion.mapping.observe import SurfaceRays, observe_view
from thermofusion.mapping.witness import MAX_GAP_S, DepthWitness
from thermofusion.recipe import MappingSection
from thermofusion.temperature.mean import Groups, RobustMean
from thermofusion.temperature.sensor.field import ImageField
from thermofusion.temperature.sensor.pattern import Pattern
from thermofusion.temperature.sensor.shown import table
from thermofusion.types import Rig, SurfaceMesh, ThermalViews, Trajectory

DEPTH, THERMAL = camera(320, 240, 280.0), camera(160, 120, 150.0)
WALL_M, BALL_M, RADIUS_M = 1.0, np.array([0.03, 0.01, 0.6]), 0.06
T_WORLD_THERMAL = pose(np.eye(3), np.array([0.08, 0.0, 0.0]))


def depth_image(*, ball):
    """What the depth camera, in the world's origin, sees of the wall z = WALL_M, and of a ball before it; m along z."""
    rays = pixel_rays(DEPTH)
    rays = rays / rays[..., 2:]
    z = np.full(DEPTH.shape, WALL_M)
    if ball:
        a, b = (rays**2).sum(-1), rays @ BALL_M
        root = b**2 - a * (BALL_M @ BALL_M - RADIUS_M**2)
        hit = root > 0
        z[hit] = ((b - np.sqrt(np.maximum(root, 0))) / a)[hit]
    return (z + np.random.default_rng(5).normal(0, 0.001, z.shape)).astype(np.float32)


def wall():
    """The wall as a mesh of vertices 5 mm apart, facing the cameras; the ball is not in it."""
    n = 121
    x = np.linspace(-0.3, 0.3, n)
    X, Y = np.meshgrid(x, x)
    V = np.stack([X.ravel(), Y.ravel(), np.full(n * n, WALL_M)], 1).astype(np.float32)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    F = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)]).astype(np.int32)
    return SurfaceMesh(V, F, np.tile(np.array([0, 0, -1], np.float32), (len(V), 1)))


def rows_of(images, times_s, at_s, mapping=None):
    """Vertices that the thermal view of at_s sees, and those among them that count as clear, with depth as given."""
    n = len(images)
    scan = replace(tiny_scan(), root=Path("memory"), rig=Rig(DEPTH), depth=stream(images, times_s))
    still = Trajectory(np.array(times_s, float), np.tile(np.eye(4), (n, 1, 1)))
    views = ThermalViews(np.zeros(1, int), np.array([at_s]), T_WORLD_THERMAL[None])
    mapping, mesh = mapping or MappingSection(), wall()
    depths = DepthWitness(scan, still, views, THERMAL, mapping.visibility_tolerance_mm / 1e3).of(0)
    image = np.ones(THERMAL.shape, np.float32)
    rows = observe_view(SurfaceRays(mesh), THERMAL, T_WORLD_THERMAL, image, mapping, depths=depths)
    return rows.vertex, rows.vertex[rows.edge_px >= mapping.silhouette_px]


def miss_m(vertices_m):
    """How far the ray from each vertex to the thermal eye passes the ball's middle by, m."""
    eye = T_WORLD_THERMAL[:3, 3]
    ray = vertices_m - eye
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return np.linalg.norm(np.cross(ray, BALL_M - eye), axis=1)


def test_what_stands_before_the_surface_and_is_not_in_the_mesh_hides_it_at_its_time_alone():
    free, free_clear = rows_of([depth_image(ball=False)], [0.0], 0.0)
    there = [depth_image(ball=False), depth_image(ball=True)]
    seen, clear = rows_of(there, [0.0, 0.2], 0.19)
    miss = miss_m(wall().vertices_m.astype(np.float64))
    pixel_m = 0.6 / THERMAL.focal_px
    assert (miss[seen] > RADIUS_M - 2 * pixel_m).all()  # the outline itself is a cell wide
    assert (miss[clear] > RADIUS_M).all()
    assert (miss[free] < RADIUS_M).sum() > 300  # they would have been seen
    assert np.isin(free_clear[miss[free_clear] > RADIUS_M + 5 * pixel_m], clear).all()  # nothing else is lost
    # the frame of the moment speaks, one too far in time is silent
    np.testing.assert_array_equal(rows_of(there, [0.0, 0.2], 0.01)[0], free)
    np.testing.assert_array_equal(rows_of(there, [0.0, 0.2], 0.21 + MAX_GAP_S)[0], free)
    # without a last resort, what is doubtful is dropped
    strict = MappingSection(silhouette_px=2.0, last_resort_silhouette_px=2.0)
    assert (miss[rows_of(there, [0.0, 0.2], 0.19, strict)[0]] > RADIUS_M).all()


def test_holes_beside_something_near_may_be_part_of_it():
    """A ball whose lower half gives no depth: rows behind that half count only where nothing clearer saw the spot."""
    image = depth_image(ball=True)
    lower = (np.arange(DEPTH.height_px)[:, None] > 125) & (image < 0.9)
    near_ball = lower & (np.cumsum(lower, axis=0) <= 10)
    image[lower] = np.nan
    _, clear = rows_of([image], [0.0], 0.0)
    behind = np.isin(np.flatnonzero(near_ball.ravel()), np.flatnonzero(lower.ravel())).sum()
    assert behind > 200
    V = wall().vertices_m.astype(np.float64)
    just_below = (miss_m(V) < RADIUS_M * 0.9) & (V[:, 1] < BALL_M[1] / BALL_M[2] + 0.02)
    assert just_below.sum() > 100
    assert not just_below[clear].any()


def test_where_no_two_views_agree_they_share_their_difference():
    """Two rows of variances v, a difference d: E[d²] = v1 + v2 + 2τ² gives τ² by itself, and 1/(v + τ²) the weights."""
    v = np.array([0.01, 0.02, 0.01, 0.02, 0.03, 0.01, 0.0001, 0.02])
    y = np.array([5.0, 7.0, 5.0, 5.05, 9.0, 5.1, 5.0, 9.0])
    vertex = np.array([0, 0, 1, 1, 1, 2, 3, 3], np.int32)
    groups, order = Groups.by_vertex(vertex, 4)
    assert (order == np.arange(8)).all()
    mean = RobustMean(groups, y, np.ones(8), (1 / v).astype(np.float32), statistical=True)
    solved = mean.solve(robust=True, scale=1.0)
    tau2 = ((y[1] - y[0]) ** 2 - v[0] - v[1]) / 2
    w = 1 / (v[:2] + tau2)
    assert solved.x[0] == pytest.approx((w @ y[:2]) / w.sum(), rel=1e-6)
    np.testing.assert_allclose(solved.weight[:2], w, rtol=1e-5)
    assert solved.x[1] == pytest.approx((5.0 / 0.01 + 5.05 / 0.02) / (1 / 0.01 + 1 / 0.02), abs=0.01)  # two of three
    assert solved.x[2] == pytest.approx(5.1)
    assert solved.x[3] == pytest.approx(5.0, abs=0.05)  # one known to be far better is followed
    plain = RobustMean(groups, y, np.ones(8), (1 / v).astype(np.float32), statistical=False)
    assert plain.solve(robust=False).x[0] == pytest.approx((y[0] / v[0] + y[1] / v[1]) / (1 / v[0] + 1 / v[1]))


@pytest.mark.parametrize("drift_K", [0.0, 0.1])
def test_the_fields_table_gives_the_field_back(drift_K):
    rng, size, slope = np.random.default_rng(3), (160, 120), 0.6
    field = ImageField.zero(*size)
    field = replace(field, coefficients=rng.normal(0, 0.1, len(field.coefficients)))
    u, v = rng.uniform(0, 159, 500), rng.uniform(0, 119, 500)

    def read(shown):
        shown = json.loads(json.dumps({k: np.asarray(x).tolist() for k, x in shown.items()}))
        return RegularGridInterpolator((shown["v_px"], shown["u_px"]), np.array(shown["K"]))(np.stack([v, u], 1))

    truth = field(u, v) / slope
    assert np.sqrt(((read(table(field, None, slope)) - truth) ** 2).mean()) < 0.02 * truth.std()
    stretch, since = np.zeros(2, np.intp), np.array([0.0, 1.0])
    bare = Pattern(*size, drift_K, 0.05, 0.02, 0.02, stretch, since, np.zeros(0))
    n_lines, n = sum(size), len(bare.precision())
    coefficients = np.where(np.arange(n) < n - n_lines, rng.normal(0, 0.03, n), 0.0)  # columns and rows add nothing
    sensor = replace(bare, coefficients=coefficients)
    at_shutter = truth + sensor(u, v, np.zeros(500, np.intp)) / slope  # where nothing has drifted yet
    tabled = read(table(field, sensor, slope))
    assert np.abs(at_shutter - truth).std() > 0.02
    assert np.sqrt(((tabled - at_shutter) ** 2).mean()) < 0.15 * (at_shutter - truth).std()  # knots lie between nodes
    lines = replace(sensor, coefficients=coefficients + np.where(np.arange(n) < n - n_lines, 0.0, 1.0))
    np.testing.assert_array_equal(read(table(field, lines, slope)), tabled)
