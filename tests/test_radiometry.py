"""Radiance and temperature against golden values of independent derivations; identities of the measurement equation."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermofusion.errors import ScanError
from thermofusion.physics.band import ZERO_DEGC_K, Band
from thermofusion.physics.emissivity import Fresnel
from thermofusion.physics.equation import absolute, apparent_radiance, leaving_radiance, normal_equivalent, paper_chain
from thermofusion.physics.signal import SignalConverter
from thermofusion.types import Camera, SignalCurve, ThermalCamera

BAND = Band()
BANDS = [Band(7.5, 13.5), Band(8, 14), Band(3, 5)]


def L(degC):
    return BAND.integrate(degC + ZERO_DEGC_K)


@pytest.mark.parametrize(("degC", "golden"), [(23, 52.15789899), (33, 61.08293643), (37, 64.89666616)])
def test_in_band_radiance_golden(degC, golden):
    assert L(degC) == pytest.approx(golden, rel=1e-9)
    assert BAND.radiance(degC + ZERO_DEGC_K) == pytest.approx(golden, rel=1e-9)


def test_slope_golden():
    assert BAND.d_radiance_dT(33 + ZERO_DEGC_K) == pytest.approx(0.9359259, abs=5e-8)


def test_fit_of_the_design_holds():
    """L = R/(exp(B/T) - F) is within 2.8 mK over 10-45 °C."""
    T = np.linspace(10, 45, 71) + ZERO_DEGC_K
    fit = 5364.036 / (np.exp(1381.851 / T) - 3.43676)
    assert np.abs(BAND.temperature_K(fit) - T).max() < 2.9e-3


@pytest.mark.parametrize("band", BANDS)
def test_tables_equal_the_quadrature(band):
    T = np.random.default_rng(0).uniform(150, 1500, 20_000)
    exact = band.integrate(T)
    np.testing.assert_allclose(band.radiance(T), exact, rtol=1e-7)
    np.testing.assert_allclose(band.temperature_K(exact), T, atol=1e-6, rtol=0)
    h = 1e-2
    slope = (band.integrate(T + h) - band.integrate(T - h)) / (2 * h)
    np.testing.assert_allclose(band.d_radiance_dT(T), slope, rtol=1e-6)


def test_whole_spectrum_is_stefan_boltzmann():
    T, sigma = 300.0, 5.670374419e-8
    edges = np.geomspace(1, 3000, 60)
    total = sum(float(Band(a, b).integrate(T)) for a, b in pairwise(edges))
    assert total == pytest.approx(sigma * T**4 / np.pi, rel=1e-6)


def test_outside_the_table_is_nan():
    with np.errstate(all="raise"):
        assert np.isnan(BAND.radiance([100.0, 1600.0, np.nan])).all()
        assert np.isnan(BAND.temperature_K([-1.0, 0.0, 1e-12, 1e9, np.nan])).all()


@pytest.mark.parametrize(("lo", "hi"), [(13.5, 7.5), (0, 5), (8, 8)])
def test_impossible_band(lo, hi):
    with pytest.raises(ValueError, match="µm"):
        Band(lo, hi)


# ---------------------------------------------------------------- measurement equation

APPARENT = [  # T_s, T_a °C; θ; model; T_app; what the linear Eq. 25 returns
    (33, 23, 0, Fresnel(1.33), 32.808542, 33.009322),
    (33, 23, 60, Fresnel(1.33), 32.434684, 33.027570),
    (33, 23, 70, Fresnel(1.33, 0.25), 31.377513, 33.079489),
    (36, 20, 60, Fresnel(1.33, 0.25), 34.765879, 36.096719),
    (40, 18, 80, Fresnel(1.33, 0.25), 31.893629, 40.894115),
]


@pytest.mark.parametrize(("T_s", "T_a", "theta", "model", "T_app", "linear"), APPARENT)
def test_apparent_temperature_golden(T_s, T_a, theta, model, T_app, linear):
    eps = model(np.cos(np.radians(theta)))
    seen = apparent_radiance(L(T_s), eps, L(T_a))
    degC = BAND.temperature_K(seen) - ZERO_DEGC_K
    assert degC == pytest.approx(T_app, abs=1e-6)
    assert paper_chain(degC, eps, T_a)[0] == pytest.approx(linear, abs=1e-5)
    L0 = normal_equivalent(seen, eps / model.normal, L(T_a))
    back = BAND.temperature_K(absolute(L0, model.normal, L(T_a))) - ZERO_DEGC_K
    assert back == pytest.approx(T_s, abs=1e-6)


@settings(max_examples=100, deadline=None)
@given(
    st.floats(0.3, 1.0),
    st.floats(0.3, 1.0),
    st.floats(280, 320),
    st.floats(260, 320),
    st.floats(0.8, 1.0),
    st.floats(-2, 2),
)
def test_measurement_inverts(E, epsilon0, T_s, T_r, tau, offset):
    L_s, L_r, L_air = (float(BAND.radiance(t)) for t in (T_s, T_r, 295.0))
    seen = apparent_radiance(L_s, epsilon0 * E, L_r, transmission=tau, L_air=L_air, offset=offset)
    left = leaving_radiance(seen, transmission=tau, L_air=L_air, offset=offset)
    L0 = normal_equivalent(left, E, L_r)
    assert BAND.temperature_K(absolute(L0, epsilon0, L_r)) == pytest.approx(T_s, abs=1e-6)
    # straight on, the normal-equivalent is what the camera would report, whatever ε(0)
    assert pytest.approx(float(apparent_radiance(L_s, epsilon0, L_r)), rel=1e-10) == L0


def test_paper_chain_scales_degrees_celsius():
    corrected, scaled = paper_chain(32.0, 0.95, 23.0, S=0.99)
    assert corrected == pytest.approx((32 - 0.05 * 23) / 0.95, rel=1e-12)
    assert scaled == pytest.approx(0.99 * corrected, rel=1e-12)


def test_anodised_phantom_is_uniform_after_correction():
    """44 °C, n = 2.84, 23 °C room: the normal-equivalent does not depend on the angle; ΔT ≈ 10 K straight on."""
    model, mu = Fresnel(2.84), np.cos(np.radians(np.arange(0, 85)))
    seen = apparent_radiance(L(44), model(mu), L(23))
    flat = BAND.temperature_K(normal_equivalent(seen, model.relative(mu), L(23)))
    assert np.ptp(flat) < 1e-9
    assert BAND.temperature_K(absolute(BAND.radiance(flat), model.normal, L(23))) - ZERO_DEGC_K == pytest.approx(44)


# ---------------------------------------------------------------- sensors


def sensor(kind="counts", curve="none", band=(7.5, 13.5), **parameters):
    return ThermalCamera(
        Camera(2, 2, np.eye(3)),
        np.eye(4),
        SignalCurve(kind, curve, {k: tuple(np.atleast_1d(v).tolist()) for k, v in parameters.items()}),
        band,
    )


CURVES = [
    (sensor(curve="polynomial", coefficients_degC=[-30.0, 0.0026, 1.1e-8]), lambda g: -30 + 0.0026 * g + 1.1e-8 * g**2),
    (sensor(curve="linear_kelvin", gain_K=0.01, offset_K=0.0), lambda g: 0.01 * g - ZERO_DEGC_K),
    (
        sensor(curve="planck", R=21106.77 / 0.012545258, B=1501.0, F=1.0, O=-7340.0),
        lambda g: 1501 / np.log(21106.77 / 0.012545258 / (g + 7340) + 1) - ZERO_DEGC_K,
    ),
    (sensor(curve="table", counts=[20000, 30000, 40000], degC=[10.0, 30.0, 45.0]), None),
]


@pytest.mark.parametrize(("sensor", "degC"), CURVES)
def test_counts_become_radiance(sensor, degC):
    g = np.arange(24_000, 34_000, 8, dtype=np.uint16).reshape(-1, 5)
    got = SignalConverter(sensor).radiance(g)
    assert got.dtype == np.float32
    assert got.shape == g.shape
    x = g.astype(float)
    expected = np.interp(x, [20000, 30000, 40000], [10, 30, 45]) if degC is None else degC(x)
    np.testing.assert_allclose(BAND.temperature_K(got) - ZERO_DEGC_K, expected, atol=1e-4)


def test_float_images():
    image = np.array([[20.0, 33.0], [np.nan, 40.0]], np.float32)
    got = SignalConverter(sensor("apparent_degC")).radiance(image)
    np.testing.assert_allclose(got[0], [L(20), L(33)], rtol=1e-6)
    assert np.isnan(got[1, 0])
    radiance = SignalConverter(sensor("radiance")).radiance(np.array([[61.0, np.nan]], np.float32))
    assert radiance[0, 0] == np.float32(61)
    assert np.isnan(radiance[0, 1])


def test_falling_curve_is_a_curve():
    converter = SignalConverter(sensor(curve="linear_kelvin", gain_K=-0.01, offset_K=600.0))
    a, b = converter.radiance(np.array([[29_000, 30_000]], np.uint16))[0]
    assert a > b


def test_a_dead_pixel_is_unmeasured_and_many_are_an_error():
    """A quartic like the paper's Eq. 1 turns round below its range: those counts mean nothing."""
    quartic = [
        -3.459387438171146e5,
        56.54070250039669,
        -0.003469484795606,
        9.470542369512357e-8,
        -9.699380162015556e-13,
    ]
    converter = SignalConverter(sensor(curve="polynomial", coefficients_degC=quartic))
    image = np.full((40, 40), 24_300, np.uint16)
    image[3, 4] = 0
    got = converter.radiance(image, "thermal/7.png")
    assert np.isnan(got[3, 4])
    assert np.isfinite(got).sum() == image.size - 1
    image[:5] = 65_535
    with pytest.raises(ScanError, match=r"thermal/7\.png.*12% of the thermal pixels lie off the radiometric curve"):
        converter.radiance(image, "thermal/7.png")


@pytest.mark.parametrize(
    ("sensor", "image", "message"),
    [
        (sensor(curve="linear_kelvin", gain_K=0.01, offset_K=0.0), np.ones((2, 2), np.float32), "16-bit"),
        (sensor(curve="linear_kelvin", gain_K=0.01, offset_K=0.0), np.full((2, 2), -1, np.int16), "negative"),
        (sensor(curve="linear_kelvin", gain_K=0.01, offset_K=0.0), np.full((2, 2), 70_000, np.int32), "16-bit"),
        (sensor("apparent_degC"), np.ones((2, 2), np.uint16), "expected float"),
        (sensor("apparent_degC"), np.full((2, 2), 3000.0, np.float32), "off the radiometric curve"),
        (sensor("radiance"), np.full((2, 2), -3.0, np.float32), "off the radiometric curve"),
    ],
)
def test_images_that_do_not_fit(sensor, image, message):
    with pytest.raises(ScanError, match=message):
        SignalConverter(sensor).radiance(image, "thermal/0.png")


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (sensor(curve="planck", R=1.0, B=2.0, F=1.0), "lacks its parameter 'O'"),
        (sensor(), "need a radiometric curve"),
        (sensor(curve="table", counts=[1, 2], degC=[3.0]), "equally many"),
        (sensor(curve="table", counts=[2, 1], degC=[3.0, 4.0]), "rising"),
        (sensor(curve="polynomial", coefficients_degC=[5000.0]), "between 150 and 1500 K"),
    ],
)
def test_curves_that_are_none(sensor, message):
    with pytest.raises(ScanError, match=message):
        SignalConverter(sensor)
