"""What a result says against its own model: patterns of the sensor, pixels, skin, pictures made for the eye."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.problems import errors, problem_of
from support.synthetic_views import BAND, WIDTH, make_world

from thermofusion.diagnosis.diagnose import _references
from thermofusion.mapping.pixels import bad_pixels
from thermofusion.physics.signal import SignalConverter
from thermofusion.scans.check import _automatic_gain
from thermofusion.temperature import crosscal, hidden
from thermofusion.temperature.sensor.pattern import Pattern
from thermofusion.types import Camera, ThermalCamera, ThermalStream

SLOPE = float(BAND.d_radiance_dT(306.15))


def solved(world, added_K=None):
    rows = world.observations
    if added_K is not None:
        rows = replace(rows, radiance=rows.radiance + np.float32(SLOPE) * added_K(rows).astype(np.float32))
    problem = problem_of(rows, world.n_vertices, world.n_views, errors=errors(netd_K=0.05, sigma_normal_deg=0.5))
    return problem, crosscal.calibrate(problem)


def test_a_clean_scan_gets_no_pattern():
    _, c = solved(make_world(3, n_views=40))
    assert c.sensor is None
    assert c.criticism["left_out_views_better"] == {}
    assert c.pattern_sigma_K == 0


def test_columns_of_the_sensor_are_found_and_their_size_told():
    column_K = 0.1 * np.random.default_rng(5).normal(size=WIDTH)
    _, c = solved(make_world(3, n_views=40), lambda rows: column_K[np.rint(rows.u_px).astype(int)])
    assert c.sensor is not None
    assert list(c.criticism["left_out_views_better"]) == ["fixed"]
    u = np.arange(60.0, WIDTH - 60)
    found_K = c.sensor(u, np.full(len(u), 120.0), np.zeros(len(u), int)) / c.slope_L
    true_K = column_K[60 : WIDTH - 60]
    left = (found_K - found_K.mean()) - (true_K - true_K.mean())
    assert np.std(left) < 0.4 * np.std(true_K)


def test_a_gain_that_references_contradict_is_named_instead_of_their_scatter():
    _, c = solved(make_world(3, n_vertices=1000, n_views=12))
    named = lambda **told: [(d.what, d.size, d.size_K) for d in _references(replace(c, criticism=told))]  # noqa: E731
    assert named(gain=(-0.02, 0.004), references_K=0.1) == [("gain is off", 2.0, None)]
    assert named(gain=(0.02, 0.007), references_K=0.0) == []
    assert named(gain=(0.004, 0.0005), references_K=0.0) == []
    assert named(gain=None, references_K=0.1) == [("references contradict each other", None, 0.1)]


def test_hats_and_lines_are_partitions_of_one():
    pattern = Pattern(WIDTH, 240, 0.1, 0.1, 0.1, 0.1, np.zeros(3, int), np.array([0.0, 0.5, 1.0]), np.zeros(0))
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, WIDTH - 1, 50), rng.uniform(0, 239, 50)
    X = pattern.columns(u, v, np.full(50, 2))
    assert X.shape[1] == len(pattern.precision())
    # at the end of a stretch the straight rise is 1 and its bend 0; two grids of hats, columns and rows add one each
    np.testing.assert_allclose(X @ np.ones(X.shape[1]), 5.0, atol=1e-9)


def stream_of(images, netd_K=0.05):
    h, w = images[0].shape
    lens = Camera(w, h, np.array([[300.0, 0, w / 2], [0, 300.0, h / 2], [0, 0, 1]]))
    n = len(images)
    camera = ThermalCamera(lens, np.eye(4), netd_K=netd_K)
    return ThermalStream(np.arange(n) * 0.2, images.__getitem__, ("",) * n, np.arange(n), np.ones(n, bool), camera)


def scene(n=24, shape=(120, 160), seed=0):
    """A warm disc that moves before a cold wall, with noise and columns of 0.1 K, °C."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: shape[0], : shape[1]]
    columns = 0.1 * rng.normal(size=shape[1])
    for k in range(n):
        disc = np.hypot(u - 60 - k, v - 60) < 35
        yield (22 + 11.0 * disc + columns + rng.normal(0, 0.05, shape)).astype(np.float32)


@pytest.mark.parametrize("kind", ["stuck", "off", "blinking"])
def test_bad_pixels_are_found_and_no_others(kind):
    images, rng = list(scene()), np.random.default_rng(1)
    at = [(30, 40), (61, 81), (100, 150), (5, 9)]
    for k, image in enumerate(images):
        for p in at:
            if kind == "stuck":
                image[p] = 60.0
            elif kind == "off":
                image[p] += 0.8
            elif k % 2:
                image[p] += rng.choice([-1, 1]) * 1.5
    stream = stream_of(images)
    found = bad_pixels(stream, np.arange(len(images)), SignalConverter(stream.camera))
    assert {tuple(p) for p in np.argwhere(found)} == set(at)


def test_a_good_sensor_has_no_bad_pixels():
    stream = stream_of(list(scene(seed=4)))
    assert not bad_pixels(stream, np.arange(24), SignalConverter(stream.camera)).any()


def test_pictures_stretched_anew_in_every_frame_are_refused_and_eight_bits_alone_are_not():
    images = [image + np.linspace(0, 8, image.shape[1]) for image in scene(3, seed=2)]  # skin has all shades
    coarse = [np.round(image / 0.1).astype(np.uint16) for image in images]
    assert not _automatic_gain(coarse)
    stretched = []
    for image in images:
        lo, hi = np.percentile(image, [0.5, 99.5])
        stretched.append(np.round(255 * np.clip((image - lo) / (hi - lo), 0, 1)).astype(np.uint16))
    assert _automatic_gain(stretched)
    moving = [np.round(s * (40 + k) + 7 * k).astype(np.uint16) for k, s in enumerate(stretched)]
    assert _automatic_gain(moving)


def test_what_errors_of_a_cell_do_to_the_calibration():
    """The shift that is predicted for an error common to one cell of the image is the one that solving again gives."""
    world = make_world(3, n_views=12)
    problem = problem_of(world.observations, world.n_vertices, world.n_views, errors=errors(netd_K=0.05))
    overlap = crosscal.Overlap.of(problem)
    system, solution, rows = overlap.system, overlap.solution, overlap.rows
    cell = (rows.u_px > WIDTH / 2).astype(np.int64)
    error = np.full(len(rows), 0.02 * SLOPE)
    start = system.step(solution.p, solution.x, solution.weight)[0]
    moved = replace(system, y=system.y + np.where(cell == 1, error, 0))
    expected = moved.step(solution.p, solution.x, solution.weight)[0] - start
    found = hidden._Scores(system, solution).shifts(error, cell)[1]
    np.testing.assert_allclose(found, expected, atol=0.02 * np.abs(expected).max())
    wider = hidden.with_hidden(system, solution, rows, world.points_m[rows.vertex], 0.01)
    assert (np.diag(wider.covariance) >= np.diag(solution.covariance) * (1 - 1e-9)).all()


def test_what_a_stretch_of_skin_has_in_common_is_in_the_calibration_s_sigma():
    """Normals that turn slowly over 10 cm bend the field: by 2.2 of the sigma of noise, by 1.6 of what is said."""
    shifts, of_noise = [], []
    for seed in range(4):
        world = make_world(seed, n_vertices=2500, netd_K=0.02)
        rng = np.random.default_rng(50 + seed)
        wave = np.cos(world.points_m @ rng.normal(0, 30, (3, 6)) + rng.uniform(0, 6, 6)).sum(1) / np.sqrt(6)
        rows = world.observations
        angle = np.arccos(rows.cos_angle) + np.radians(1.5) * wave[rows.vertex]
        turned = replace(rows, cos_angle=np.cos(np.clip(angle, 0, 1.4)).astype(np.float32))
        known = {"errors": errors(netd_K=0.02, sigma_normal_deg=0.5), "points_m": world.points_m}
        right, bent = (crosscal.Overlap.of(problem_of(o, world.n_vertices, 24, **known)) for o in (rows, turned))
        at, solution = bent.system.layout, bent.solution
        off = (solution.p - right.solution.p)[at.field]
        said = hidden.with_hidden(bent.system, solution, bent.rows, world.points_m[bent.rows.vertex], 0.0)
        shifts.append(off / np.sqrt(np.diag(said.covariance)[at.field]))
        of_noise.append(off / np.sqrt(np.diag(solution.covariance)[at.field]))
    said_rms, noise_rms = (np.sqrt(np.mean(np.square(of))) for of in (shifts, of_noise))
    assert said_rms < 1.8
    assert noise_rms > 1.25 * said_rms
