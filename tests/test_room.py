"""The room as it was: harmonics, what vertices see of them, the background, and what the skin itself says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.problems import LENS, errors, problem_of
from support.synthetic_views import BAND, HEIGHT, L_ROOM, REFLECTED_K, WIDTH, fibonacci_sphere, make_world
from test_crosscal import blackbodies
from test_surroundings import sphere_part

from thermofusion.diagnosis.radiation import of_room
from thermofusion.geometry.sphere import N_CELLS, cell_directions, cell_of, cell_solid_angles, harmonics
from thermofusion.mapping.background import Background, find_background
from thermofusion.physics.emissivity import Fresnel
from thermofusion.physics.scatter import WIDTHS
from thermofusion.physics.signal import SignalConverter
from thermofusion.temperature import crosscal
from thermofusion.temperature.blend import blend
from thermofusion.temperature.room.answer import operator_answered
from thermofusion.temperature.room.harmonics import open_transfer
from thermofusion.temperature.room.map import RoomMap, RoomPrior
from thermofusion.temperature.room.operator import operator_effect, operator_excess, without_operator
from thermofusion.temperature.room.surroundings import surroundings
from thermofusion.temperature.room.survey import survey
from thermofusion.temperature.room.witness import sides_of
from thermofusion.types import BlackbodyReference, ThermalCamera, ThermalStream, ThermalViews

SLOPE = float(BAND.d_radiance_dT(REFLECTED_K))
SLOPE_SKIN = float(BAND.d_radiance_dT(273.15 + 32.5))
DIPOLE_K = np.array([2.0, -1.0, 0.8])  # warmer towards +x, -y, +z
PRIOR = RoomPrior(L_ROOM, SLOPE, sigma_K=0.5, dipole_K=2.0)


def test_harmonics_are_orthonormal_and_cells_cover_the_sphere():
    directions = fibonacci_sphere(20_000)
    Y = harmonics(directions)
    np.testing.assert_allclose(Y.T @ Y / len(Y), np.eye(9), atol=2e-3)
    assert cell_solid_angles().sum() == pytest.approx(4 * np.pi, rel=1e-12)
    np.testing.assert_array_equal(cell_of(cell_directions()), np.arange(N_CELLS))
    share = np.bincount(cell_of(directions), minlength=N_CELLS) / len(directions) * 4 * np.pi
    assert np.abs(share / cell_solid_angles() - 1).max() < 0.15


def test_an_open_hemisphere_is_lit_as_lambert_says():
    """Golden by quadrature: ∫ Y cosθ dω/π over the hemisphere above each normal."""
    normals, directions = fibonacci_sphere(7), fibonacci_sphere(40_000)
    weight = np.maximum(normals @ directions.T, 0) * 4 / len(directions)
    np.testing.assert_allclose(open_transfer(normals), weight @ harmonics(directions), atol=1e-3)


def test_a_ball_sees_all_of_the_room_and_a_bowl_the_part_above_it():
    ball = surroundings(sphere_part(0.3, 1e-3, np.pi - 1e-3, inward=False))
    assert np.abs(ball.transfer[:, 0] - 1).max() < 1e-6
    bowl = sphere_part(0.5, 1e-3, np.pi / 2, inward=True)  # its bottom at +z, open towards -z
    result = surroundings(bowl, offset_m=1e-4, directions=400)
    np.testing.assert_allclose(result.transfer[:, 0], 1 - result.body_fraction, atol=2e-3)
    top = bowl.vertices_m[:, 2] > 0.49
    # from the bottom of a half sphere the opening is a cone of 45°: ∫ √3 cosθ · cosθ dω/π = √3·(2/3)(1 - cos³45°)
    expected = -np.sqrt(3) * 2 / 3 * (1 - 0.5**1.5)
    assert result.transfer[top, 3].mean() == pytest.approx(expected, abs=0.02)
    cells = np.where(cell_directions()[:, 2] < 0, 1.0, 0.0)
    np.testing.assert_allclose(result.from_cells(cells), result.transfer[:, 0], atol=0.02)


def world_in(dipole_K, seed=3, **more):
    """A world whose room is warmer on one side, and the egg's normals."""
    world = make_world(seed, n_views=40, **more)
    radii = np.array([0.18, 0.12, 0.30])
    normals = world.points_m / radii**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    a = np.concatenate([[0.0], dipole_K / np.sqrt(3) * SLOPE, np.zeros(5)])
    lit = open_transfer(normals) @ a
    rows = world.observations
    lost = 1 - problem_of(rows, world.n_vertices, 40).emissivity(rows.cos_angle.astype(float))
    rows = replace(rows, radiance=(rows.radiance + lost * lit[rows.vertex]).astype(np.float32))
    return replace(world, observations=rows), normals, lit


def solved(world, normals):
    problem = problem_of(
        world.observations,
        world.n_vertices,
        world.n_views,
        errors=errors(sigma_normal_deg=0.5),
        transfer=open_transfer(normals).astype(np.float32),
        room_map=RoomMap.unseen(PRIOR),
    )
    return problem, crosscal.Overlap.of(problem)


@pytest.mark.parametrize("dipole_K", [np.zeros(3), DIPOLE_K])
def test_the_skin_itself_says_which_side_is_warmer(dipole_K):
    world, normals, _ = world_in(dipole_K)
    _, overlap = solved(world, normals)
    found, covariance = sides_of(overlap)
    off = found / SLOPE * np.sqrt(3) - dipole_K
    sigma = np.sqrt(np.diag(covariance)) / SLOPE * np.sqrt(3)
    assert np.abs(off).max() < 0.35
    assert (np.abs(off) < 2 * sigma).all()


def test_an_even_room_changes_no_number_and_a_side_is_taken_off():
    world, normals, lit = world_in(DIPOLE_K)
    problem, overlap = solved(world, normals)
    views = ThermalViews(np.arange(40, dtype=np.int32), np.arange(40.0), np.tile(np.eye(4), (40, 1, 1)))
    even = problem.in_room(RoomMap.unseen(PRIOR), views)
    np.testing.assert_array_equal(even.L_reflected, problem.L_reflected)
    found = RoomMap.unseen(PRIOR).with_sides(*sides_of(overlap))
    inside = problem.in_room(found, views)
    before, after = (np.std(p.L_reflected - L_ROOM - lit) / SLOPE for p in (problem, inside))
    assert after < 0.15 * before
    assert (np.diag(found.covariance)[1:4] < 0.2 * PRIOR.variances[1:4]).all()


def background_of(world, calibration, room_L, seed=0):
    """Blocks of background of a walk round, read through the views' offsets."""
    rng, n_views = np.random.default_rng(seed), world.n_views
    v, u = (x.ravel() for x in np.mgrid[2:HEIGHT:8, 2:WIDTH:8].astype(np.float64))
    rays = np.stack([(u - WIDTH / 2) / 300, (v - HEIGHT / 2) / 300, np.ones_like(u)], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    parts = []
    for k in range(n_views):
        a = 2 * np.pi * k / n_views
        forward = -np.array([np.cos(a), np.sin(a), 0.3 * np.sin(2.7 * k)])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        parts.append(rays @ np.stack([right, np.cross(forward, right), forward]))
    direction, view = np.concatenate(parts), np.repeat(np.arange(n_views), len(u))
    L = room_L(direction) + calibration.offset_radiance[view] + rng.normal(0, 0.02 * SLOPE, len(view))
    outliers = rng.random(len(view)) < 0.02
    L[outliers] += 5 * SLOPE
    spread = np.zeros((len(view), len(WIDTHS)), np.float32)
    uv = (np.tile(x, n_views).astype(np.float32) for x in (u, v))
    return Background(
        view.astype(np.int32), direction.astype(np.float32), L.astype(np.float32), spread, *uv, n_views, 8
    )


def window(direction):
    """-8 K within 14° of a direction."""
    axis = np.array([0.8, 0.6, 0.1]) / np.linalg.norm([0.8, 0.6, 0.1])
    return -8.0 * (direction @ axis > np.cos(np.radians(14)))


def test_the_background_gives_the_room_its_sides_and_its_window():
    world, normals, _ = world_in(DIPOLE_K)
    _, overlap = solved(world, normals)
    calibration = replace(overlap.plain(), anchored=True, level_sigma_K=0.02)
    calibration = replace(calibration, field=replace(calibration.field, coefficients=np.zeros(14)))

    def room_L(direction):
        return L_ROOM + SLOPE * (direction @ DIPOLE_K + window(direction))

    found = survey(background_of(world, calibration, room_L), calibration, PRIOR, 0.05)
    np.testing.assert_allclose(found.coefficients[1:4] / SLOPE * np.sqrt(3), DIPOLE_K, atol=0.25)
    assert abs(found.coefficients[0] - L_ROOM) < 0.15 * SLOPE
    assert 0.3 < found.seen_share < 0.9
    assert not found.contradicts
    assert of_room(found) == []
    seen = found.seen & (np.abs(window(cell_directions()) + 4) > 3.9)
    off = found.toward(cell_directions())[seen] - room_L(cell_directions())[seen]
    assert np.median(np.abs(off)) < 0.1 * SLOPE
    middle = cell_of(np.array([[0.8, 0.6, 0.1]]) / np.linalg.norm([0.8, 0.6, 0.1]))
    assert found.cells[middle] / SLOPE == pytest.approx(-8, abs=1.0)


def test_a_reflected_temperature_that_the_background_contradicts_is_said():
    world, normals, _ = world_in(np.zeros(3))
    _, overlap = solved(world, normals)
    calibration = replace(overlap.plain(), anchored=True, level_sigma_K=0.02)
    calibration = replace(calibration, field=replace(calibration.field, coefficients=np.zeros(14)))
    background = background_of(world, calibration, lambda d: np.full(len(d), L_ROOM - 3 * SLOPE))
    found = survey(background, calibration, PRIOR, 0.05)
    assert found.contradicts
    (said,) = of_room(found)
    assert said.size == pytest.approx(3.0, abs=0.3)
    assert found.coefficients[0] == pytest.approx(L_ROOM - 3 * SLOPE, abs=0.1 * SLOPE)
    few = replace(background, **{k: getattr(background, k)[:50] for k in ("view", "direction", "radiance", "spread")})
    few = replace(few, u_px=background.u_px[:50], v_px=background.v_px[:50])
    nothing = survey(few, calibration, PRIOR, 0.05)
    assert not nothing.measured
    np.testing.assert_array_equal(nothing.covariance, np.diag(PRIOR.variances))


def test_background_leaves_out_the_subject_its_legs_sources_and_masks():
    ball = sphere_part(0.2, 1e-3, np.pi - 1e-3, inward=False)
    pose = np.eye(4)
    pose[2, 3] = -1.0  # the camera looks along +z at a ball of 0.2 m, 1 m away: 61 px
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rng = np.random.default_rng(0)
    image = 22 + rng.normal(0, 0.05, (HEIGHT, WIDTH))
    disc = np.hypot(u - WIDTH / 2, v - HEIGHT / 2) < 61
    legs = (np.abs(u - WIDTH / 2) < 25) & (v > HEIGHT / 2)  # warm, and no part of the mesh
    image[disc | legs] += 11
    image[20:40, 20:40] += 13  # a blackbody
    masked = np.where(disc, image, 20.0)
    pictures = [image.astype(np.float32), masked.astype(np.float32)]
    camera = ThermalCamera(LENS, np.eye(4), netd_K=0.05)
    stream = ThermalStream(np.arange(2.0), pictures.__getitem__, ("", ""), np.arange(2), np.ones(2, bool), camera)
    views = ThermalViews(np.arange(2, dtype=np.int32), np.arange(2.0), np.stack([pose, pose]))
    corners = np.array([[20, 20], [40, 20], [40, 40], [20, 40]], float)
    source = BlackbodyReference(35.0, 0.05, 0.98, corners, (0, 1))
    found = find_background(stream, ball, views, SignalConverter(camera), [source])
    assert set(found.view) == {0}
    degC = BAND.temperature_K(found.radiance) - 273.15
    assert np.abs(degC - 22).max() < 0.1
    assert len(found) > 0.5 * (~(disc | legs)).sum() / found.block_px**2
    np.testing.assert_allclose(np.linalg.norm(found.direction, axis=1), 1, atol=1e-5)


def test_the_operator_is_taken_off_in_closed_form():
    """Golden: .5 m² of 29 °C, 1 m before skin seen straight on, fills .159 of its hemisphere."""
    rows = make_world(1, n_vertices=500, n_views=6).observations
    straight = replace(rows, cos_angle=np.ones_like(rows.cos_angle), range_m=np.ones_like(rows.range_m))
    excess = operator_excess(straight, Fresnel(1.33), BAND, REFLECTED_K)
    warmer = float(BAND.radiance(302.15)) - L_ROOM
    np.testing.assert_allclose(0.5 * excess, (1 - 0.9799406878) * 0.5 / np.pi * warmer, rtol=1e-5)
    excess = operator_excess(rows, Fresnel(1.33), BAND, REFLECTED_K)
    with_it = replace(rows, radiance=rows.radiance + np.float32(0.5) * excess)
    np.testing.assert_allclose(without_operator(with_it, excess, 0.5).radiance, rows.radiance, atol=1e-5)
    assert without_operator(rows, excess, 0.0) is rows
    effect = operator_effect(rows, excess, rows.cos_angle > 0.5, 500)
    seen = np.bincount(rows.vertex[rows.cos_angle > 0.5], minlength=500) > 0
    assert (effect[seen] > 0).all()
    assert (effect[~seen] == 0).all()


def test_an_operator_is_followed_through_the_calibration_as_solving_again_says():
    """Views on one side stand near: what is taken off again is not what was added, and places differ."""
    world = make_world(4, n_views=30)
    near = world.observations.view < 12
    rows = replace(world.observations, range_m=np.where(near, 0.6, 1.3).astype(np.float32))
    problem = problem_of(rows, world.n_vertices, world.n_views, blackbodies=tuple(blackbodies(world)))
    overlap = crosscal.Overlap.of(problem)
    first = blend(problem, overlap.plain(), with_uncertainty=False)
    told = operator_answered(overlap, first) / (SLOPE_SKIN * problem.emissivity.normal)
    excess = problem.settings.sigma_operator_m2 * operator_excess(rows, problem.emissivity, BAND, REFLECTED_K)
    warmed = replace(problem, observations=replace(rows, radiance=rows.radiance + excess))
    again = blend(warmed, crosscal.Overlap.of(warmed).plain(), with_uncertainty=False)
    change = again.absolute_K - first.absolute_K
    seen = np.isfinite(change) & (first.best_angle_deg < 60)
    left = np.std((change - told)[seen])
    assert abs(np.median((change - told)[seen])) < 0.05 * np.median(change[seen])
    assert left < 0.6 * np.std(change[seen])  # the rest: robust weights that change
    alone = operator_effect(rows, excess, np.ones(len(rows), bool), world.n_vertices) / SLOPE_SKIN
    assert np.std((change - alone)[seen]) > 5 * left  # what the excess by itself would have said
    assert abs(np.median((change - alone)[seen])) > 0.5 * np.median(change[seen])
