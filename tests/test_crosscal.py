"""Cross-calibration against synthetic truth: recovery, gauge, invariances, what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems import errors, problem_of
from support.synthetic_views import BAND, HEIGHT, L_ROOM, WIDTH, make_world, vignetting_K, with_view_order

from thermofusion.errors import ScanError
from thermofusion.mapping.references import BlackbodyReading, read_polygon
from thermofusion.physics.emissivity import Fresnel, shape_direction, water
from thermofusion.recipe import CrosscalSection, MappingSection, TemperatureSection
from thermofusion.temperature import crosscal
from thermofusion.temperature.blend import blend
from thermofusion.temperature.references import ContactReading, ExpectedReading, expected_readings
from thermofusion.temperature.sensor.field import ImageField
from thermofusion.types import BlackbodyReference

SKIN = {"dielectric": Fresnel(1.33), "non-dielectric": Fresnel(1.33, 0.25), "water": water(BAND)}


def calibrate(world, model=SKIN["dielectric"], observations=None, *, settings=None, max_angle_deg=65.0, **known):
    temperature = TemperatureSection(crosscal=settings or CrosscalSection())
    mapping = MappingSection(max_angle_deg=max_angle_deg)
    observations = world.observations if observations is None else observations
    known = {k: tuple(v) if k in ("blackbodies", "contacts") else v for k, v in known.items()}
    problem = problem_of(
        observations, world.n_vertices, world.n_views, emissivity=model, settings=temperature, mapping=mapping, **known
    )
    return crosscal.calibrate(problem)


def blackbodies(world, views=(0, 11, 23), u=200.0, v=150.0, T_K=308.15, sigma_K=0.03):
    """A 35 °C source of ε = 0.98 in some views, read without error."""
    expected = 0.98 * float(BAND.radiance(T_K)) + 0.02 * L_ROOM
    measured = [expected + world.slope_L * float(world.offsets_K[k] + vignetting_K(u, v)) for k in views]
    slope = float(BAND.d_radiance_dT(T_K))
    known = (1e-3, u, v, expected, sigma_K * slope)
    return [ExpectedReading(k, 0, m, *known) for k, m in zip(views, measured, strict=True)]


def temperatures(world, calibration, model=SKIN["dielectric"], observations=None):
    observations = world.observations if observations is None else observations
    return blend(problem_of(observations, world.n_vertices, world.n_views, emissivity=model), calibration)


def true_shape(truth, assumed):
    """s that carries the assumed model into the true one."""
    mu = np.cos(np.radians(np.arange(65)))
    D = shape_direction(mu)
    return float(D @ (truth.relative(mu) - assumed.relative(mu)) / (D @ D))


@pytest.mark.parametrize("truth", ["dielectric", "non-dielectric"])
def test_parameters_are_recovered(truth):
    """Offsets to 0.02 K, the field where the body was seen to 0.02 K, the shape within its interval, over 20 seeds."""
    inside, field_errors = 0, []
    for seed in range(20):
        world = make_world(seed, model=SKIN[truth], outliers=0.03)
        c = calibrate(world, blackbodies=blackbodies(world))
        assert c.converged
        assert c.anchored
        assert np.std(c.offsets_K - world.offsets_K) < 0.02
        obs = world.observations
        field_errors.append(np.std(c.field(obs.u_px, obs.v_px) / c.slope_L - vignetting_K(obs.u_px, obs.v_px)))
        inside += abs(c.shape - true_shape(SKIN[truth], SKIN["dielectric"])) < 1.96 * c.shape_sigma
        assert 0.7 < c.residual_sigma < 1.1
        assert c.outlier_fraction == pytest.approx(0.03, abs=0.01)
    assert np.sqrt(np.mean(np.square(field_errors))) < 0.02
    assert inside > 18


@pytest.mark.parametrize("truth", SKIN)
@pytest.mark.parametrize("assumed", SKIN)
def test_a_wrong_preset_does_little_harm(truth, assumed):
    world = make_world(5, model=SKIN[truth], n_vertices=3000)
    c = calibrate(world, SKIN[assumed], blackbodies=blackbodies(world))
    result = temperatures(world, c, SKIN[assumed])
    error = result.absolute_K - world.T_K
    error = error[np.isfinite(error)]
    level = np.median(error)
    assert abs(level) < 0.08
    assert np.percentile(np.abs(error - level), 95) < 0.15
    held = calibrate(world, SKIN[assumed], settings=CrosscalSection(shape=False))
    assert held.shape == 0.0
    assert held.shape_sigma == 0.0


def test_normals_with_errors_and_outliers():
    """The design's expectation: about 0.1 K RMS with 2.5° normals, 0.12 K with 5 % outliers."""
    world = make_world(1, normal_error_deg=2.5, outliers=0.05)
    c = calibrate(world, blackbodies=blackbodies(world), errors=errors(sigma_normal_deg=2.5))
    result = temperatures(world, c)
    error = (result.absolute_K - world.T_K)[result.count >= 5]
    assert np.sqrt(np.mean((error - np.median(error)) ** 2)) < 0.1


# ---------------------------------------------------------------- the level


def test_without_a_reference_the_result_is_relative():
    world = make_world(2)
    c = calibrate(world)
    assert not c.anchored
    assert np.isnan(c.level_sigma_K)
    assert abs(c.offsets_K.mean()) < 1e-9
    assert any("relative" in m for m in c.messages)
    assert np.std(c.offsets_K - world.offsets_K) < 0.02


def test_a_blackbody_sets_the_level_hard():
    """2 K of common offset leave the absolute result where it is; without a reference they go into it."""
    world = make_world(2)
    for common in (0.0, 2.0):
        moved = replace(world, offsets_K=world.offsets_K + common)
        obs = replace(world.observations, radiance=world.observations.radiance + np.float32(common * world.slope_L))
        c = calibrate(moved, observations=obs, blackbodies=blackbodies(moved))
        error = temperatures(moved, c, observations=obs).absolute_K - world.T_K
        assert abs(np.nanmedian(error)) < 0.03
        assert c.reference_sigma_K == pytest.approx(0.03, rel=0.1)
        assert c.level_sigma_K >= c.reference_sigma_K


def test_a_blackbody_beside_the_body_is_read_with_the_nearest_known_field():
    """In a corner where no skin was seen: the dark corner goes into the level only as far as the stated sigma says."""
    world = make_world(2)
    seen = replace(world, observations=world.observations.select(world.observations.u_px < 200))
    errors_K = []
    for u in (195.0, 230.0, 310.0):
        c = calibrate(seen, blackbodies=blackbodies(world, u=u, v=120.0))
        error = float(np.nanmedian(temperatures(seen, c, observations=seen.observations).absolute_K - world.T_K))
        errors_K.append(abs(error) / c.reference_sigma_K)
        away = max(u - 200, 0) / WIDTH
        assert c.reference_sigma_K == pytest.approx(np.hypot(0.03, 0.3 * min(away / 0.25, 1)), abs=0.025)
    assert max(errors_K) < 2
    budget = temperatures(seen, c, observations=seen.observations).uncertainty
    known = np.isfinite(budget.total_K)
    assert (budget.absolute_K[known] >= c.reference_sigma_K * 0.99).all()
    assert np.nanmedian(budget.total_K) < 0.1 < np.nanmedian(budget.absolute_K)


def test_a_contact_thermometer_sets_the_level():
    world = make_world(3)
    spot = np.argsort(np.linalg.norm(world.points_m - [0.18, 0, 0], axis=1))[:8].astype(np.int32)
    contact = ContactReading(spot, float(BAND.radiance(world.T_K[spot].mean())), 0.05 * world.slope_L)
    c = calibrate(world, contacts=[contact])
    error = temperatures(world, c).absolute_K - world.T_K
    assert c.anchored
    assert abs(np.nanmedian(error)) < 0.05
    assert c.level_sigma_K == pytest.approx(0.05, rel=0.2)


def test_gain_is_carried_by_two_references_only():
    world = make_world(4, field=False)
    gain, pivot = 1.03, 58.0
    obs = world.observations
    obs = replace(obs, radiance=(obs.radiance + (gain - 1) * (obs.radiance - pivot)).astype(np.float32))
    readings = []
    for T_K in (303.15, 313.15):
        for r in blackbodies(replace(world, offsets_K=world.offsets_K), T_K=T_K, sigma_K=0.01):
            with_offset = r.expected + world.slope_L * world.offsets_K[r.view]
            readings.append(replace(r, measured=with_offset + (gain - 1) * (with_offset - pivot)))
    settings = CrosscalSection(gain=True, vignetting=False)
    c = calibrate(world, observations=obs, blackbodies=readings, settings=settings)
    assert c.gain == pytest.approx(gain, abs=0.003)
    error = temperatures(world, c, observations=obs).absolute_K - world.T_K
    assert abs(np.nanmedian(error)) < 0.05
    told, sigma = calibrate(world, observations=obs, blackbodies=readings).criticism["gain"]  # without solving for it
    assert told == pytest.approx(gain - 1, abs=0.003)
    assert sigma < 0.004
    right = [replace(r, measured=r.expected + world.slope_L * world.offsets_K[r.view]) for r in readings]
    told, sigma = calibrate(world, blackbodies=right).criticism["gain"]
    assert abs(told) < 2.5 * sigma < 0.01
    assert calibrate(world, observations=obs, blackbodies=readings[:3]).criticism["gain"] is None
    one = calibrate(world, observations=obs, blackbodies=readings[:3], settings=settings)
    assert one.gain == 1.0
    assert "gain" in one.held


def test_one_offset_for_all_views():
    world = make_world(6, drift_K=0.0)
    c = calibrate(world, blackbodies=blackbodies(world), settings=CrosscalSection(offsets=False))
    assert np.ptp(c.offset_radiance) == 0
    assert abs(np.nanmedian(temperatures(world, c).absolute_K - world.T_K)) < 0.03


# ---------------------------------------------------------------- invariances


def solved(world, observations=None, readings=None):
    c = calibrate(world, observations=observations, blackbodies=blackbodies(world) if readings is None else readings)
    return temperatures(world, c, observations=observations).absolute_K, c


def test_view_order_changes_nothing():
    world = make_world(7, n_vertices=2000, outliers=0.02)
    order = np.random.default_rng(1).permutation(world.n_views)
    rank = np.argsort(order)
    T, c = solved(world)
    readings = [replace(r, view=int(rank[r.view])) for r in blackbodies(world)]
    T2, c2 = solved(world, with_view_order(world.observations, order), readings)
    np.testing.assert_allclose(T2, T, atol=1e-6, rtol=0)
    np.testing.assert_allclose(c2.offsets_K, c.offsets_K[order], atol=1e-6)


def test_vertex_numbering_changes_nothing():
    world = make_world(7, n_vertices=2000)
    new = np.random.default_rng(2).permutation(world.n_vertices).astype(np.int32)
    obs = replace(world.observations, vertex=new[world.observations.vertex])
    obs = obs.select(np.lexsort((obs.vertex, obs.view)))
    T, _ = solved(world)
    T2, _ = solved(world, obs)
    np.testing.assert_allclose(T2[new], T, atol=1e-6, rtol=0)


@pytest.mark.parametrize("common", [-0.5, 0.25])
def test_a_common_offset_changes_nothing(common):
    """Also seen by the blackbody. Half and quarter add without rounding; 1e-6 K is the bar."""
    world = make_world(8, n_vertices=2000)
    L = np.round(world.observations.radiance * 2**16) / 2**16
    base = replace(world.observations, radiance=L.astype(np.float32))
    moved = replace(world.observations, radiance=(L + common).astype(np.float32))
    readings = [replace(r, measured=r.measured + common) for r in blackbodies(world)]
    T, c = solved(world, base)
    T2, c2 = solved(world, moved, readings)
    np.testing.assert_allclose(T2, T, atol=1e-6, rtol=0)
    np.testing.assert_allclose(c2.offset_radiance, c.offset_radiance + common, atol=1e-6)


def test_same_input_same_output():
    world = make_world(9, n_vertices=1500)
    a, b = solved(world)[0], solved(world)[0]
    np.testing.assert_array_equal(a, b)


# ---------------------------------------------------------------- what it refuses


def test_shape_is_held_where_nothing_is_seen_obliquely():
    world = make_world(10)
    c = calibrate(world, max_angle_deg=20.0, blackbodies=blackbodies(world))
    assert "shape" in c.held
    assert c.shape == 0.0


def test_a_few_views_do_not_carry_the_whole_field():
    world = make_world(11, n_views=3, turn_deg=20.0, field=False, n_vertices=400)
    c = calibrate(world)
    assert any("field patterns" in h for h in c.held)
    rms = np.sqrt((c.field.coefficients**2).sum()) / c.slope_L
    assert rms < 0.3
    assert np.std(c.offsets_K - world.offsets_K) < 0.1


def test_views_without_overlap_are_said_to_be_untied():
    world = make_world(12)
    obs = world.observations
    upper = world.points_m[obs.vertex, 2] > 0.02
    lower = world.points_m[obs.vertex, 2] < -0.02
    first = obs.view < 12
    c = calibrate(world, observations=obs.select((first & upper) | (~first & lower)))
    assert any("2 groups" in m for m in c.messages)


def test_no_overlap_at_all():
    world = make_world(13)
    with pytest.raises(ScanError, match="two thermal views"):
        calibrate(world, observations=world.observations.select(world.observations.view == 3))


def test_a_view_without_observations_stays_at_the_mean():
    world = make_world(14)
    c = calibrate(world, observations=world.observations.select(world.observations.view != 5))
    assert np.isfinite(c.offset_radiance).all()
    assert np.isnan(c.view_rms_K[5])
    assert np.sqrt(c.covariance[5, 5]) / c.slope_L > 1


def test_covariance_is_what_noise_does():
    """Spread of the offsets over draws of the noise, against the covariance."""
    world = make_world(3, netd_K=0.0, n_vertices=1500, field=False)
    spread, claimed = [], 0.0
    clean = world.observations.radiance
    for seed in range(24):
        noise = np.random.default_rng(seed).normal(0, 0.05 * world.slope_L, len(clean))
        obs = replace(world.observations, radiance=(clean + noise).astype(np.float32))
        flat = errors(sigma_normal_deg=0.0, sigma_shape=0.0, sigma_reflected_K=0.0)
        c = calibrate(world, observations=obs, errors=flat, settings=CrosscalSection(vignetting=False))
        spread.append(c.offsets_K)
        claimed = np.sqrt(np.diag(c.covariance)[: world.n_views].mean()) / c.slope_L
    assert claimed == pytest.approx(np.std(spread, axis=0).mean(), rel=0.15)


# ---------------------------------------------------------------- field and references


def test_field_patterns_are_orthonormal_without_a_constant():
    field = ImageField.zero(WIDTH, HEIGHT)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].reshape(2, -1)
    P = field.patterns(u, v)
    np.testing.assert_allclose(P.mean(0), 0, atol=2e-3)
    np.testing.assert_allclose(P.T @ P / len(P), np.eye(P.shape[1]), atol=1e-2)
    coefficients = np.random.default_rng(0).normal(size=P.shape[1])
    np.testing.assert_allclose(replace(field, coefficients=coefficients)(u, v), P @ coefficients, atol=1e-10)


def test_blackbody_is_read_from_inside_its_polygon():
    rng = np.random.default_rng(0)
    image = np.full((240, 320), 50.0)
    yy, xx = np.mgrid[0:240, 0:320]
    disc = np.hypot(xx - 100.3, yy - 80.0) < 20
    image[disc] = 63.0
    image += 0.05 * rng.normal(size=image.shape)
    image[80, 100] = np.nan
    image[85, 95] = 90.0  # a bad pixel
    a = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    polygon = np.stack([100.3 + 20 * np.cos(a), 80 + 20 * np.sin(a)], axis=1)
    netd_L = 0.05 * float(BAND.d_radiance_dT(308.15))
    measured, sigma, u, v = read_polygon(image, polygon, netd_L)
    assert measured == pytest.approx(63.0, abs=0.01)
    assert (u, v) == pytest.approx((100.3, 80.0), abs=0.5)
    assert sigma < 0.01
    assert read_polygon(np.full((240, 320), np.nan), polygon, netd_L) is None


def test_a_blackbody_should_read_its_own_radiation_and_the_rooms():
    source = BlackbodyReference(35.0, 0.03, 0.98, np.zeros((3, 2)), (4,))
    (reading,) = expected_readings([BlackbodyReading(4, 0, 63.0, 0.01, 100.3, 80.0)], [source], BAND, L_ROOM)
    assert reading.measured == 63.0
    assert reading.expected == pytest.approx(0.98 * float(BAND.radiance(308.15)) + 0.02 * L_ROOM)
    assert reading.sigma_expected == pytest.approx(0.98 * 0.03 * float(BAND.d_radiance_dT(308.15)))
