"""Radiometric curve, per-pixel field, noise, point spread and time offset: against closed forms and known truth."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.io
from scipy.special import ndtr
from support.averaged_frames import decode
from support.simulated_rig import SimulatedRig

from thermofusion.calibration.thermal.noise import allan_deviation, edge_spread, still_noise
from thermofusion.calibration.thermal.radiometric import check_monotone, evaluate, fit_field, fit_planck, fit_polynomial
from thermofusion.calibration.thermal.timeoffset import estimate_time_offset, nearest_centroid, warm_centroid
from thermofusion.errors import ScanError
from thermofusion.report.plot import LogAxis

# The curve of the paper's camera, digits as stored by its authors.
EQ1 = (-3.459387450320374e05, 56.540702698830174, -3.46948481e-03, 9.47054240e-08, -9.69938020e-13)
# The curve of their mid-wave camera, as the phantom images themselves give it (test below); stored nowhere.
PHANTOM_QUARTIC = (-53.771, 4.5575e-3, -1.1621e-7, 1.692e-12, -9.9176e-18)


def test_a_quartic_keeps_its_digits():
    truth = (-345938.74503203743, 56.540702698830174, -0.003469484808056, 9.47054240339e-08, -9.6993801966e-13)
    g = np.linspace(23_800, 25_900, 40)
    curve = fit_polynomial(g, evaluate("polynomial", truth, g))
    np.testing.assert_allclose(curve.parameters, truth, rtol=1e-6)  # five numbers that cancel to 1e-5 of themselves
    np.testing.assert_allclose(curve.to_degC(g), evaluate("polynomial", truth, g), atol=1e-6)
    assert curve.signal_curve().parameters["coefficients_degC"] == curve.parameters


def test_the_papers_own_curve_turns_above_its_range():
    check_monotone("polynomial", EQ1, (23_800, 25_900))
    with pytest.raises(ScanError, match=r"turns between 259\d\d and"):
        check_monotone("polynomial", EQ1, (23_800, 27_000))


def test_counts_outside_the_readings_are_an_error():
    g = np.linspace(1000, 2000, 12)
    curve = fit_polynomial(g, 0.02 * g)
    with pytest.raises(ScanError, match="1 counts lie outside 1000 to 2000"):
        curve.to_degC(np.array([1500.0, 2001.0, np.nan]))
    with pytest.raises(ScanError, match="6 are the least"):
        fit_polynomial(g[:5], g[:5])


def test_planck_parameters_are_recovered():
    truth = (366_545.0, 1428.0, 1.0, -342.0)
    T = np.linspace(5, 60, 12)
    counts = truth[0] / (np.exp(truth[1] / (T + 273.15)) - truth[2]) + truth[3]
    curve = fit_planck(counts, T)
    np.testing.assert_allclose(curve.parameters, truth, rtol=1e-4, atol=1)
    np.testing.assert_allclose(curve.to_degC(counts), T, atol=1e-6)
    noisy = fit_planck(counts, T + np.random.default_rng(0).normal(0, 0.02, T.shape))
    assert noisy.residual_K < 0.04
    np.testing.assert_allclose(noisy.to_degC(counts), T, atol=0.08)


def test_a_field_flattens_a_uniform_source():
    y, x = np.mgrid[0:48, 0:64]
    bowl = 1.2 * ((x - 32) ** 2 + (y - 24) ** 2) / 1600
    levels = np.array([20.0, 30.0, 40.0])
    frames = np.stack([T + bowl * (1 + 0.02 * (T - 30)) for T in levels])
    field = fit_field(frames, levels)
    assert np.ptp(field.correct(35 + bowl * 1.1)) < 0.05 * np.ptp(bowl)
    frames[1, 3, 4] = np.nan  # a dead pixel takes no other with it
    again = fit_field(frames, levels)
    assert again.z[:, 3, 4].tolist() == [0, 0]
    np.testing.assert_allclose(
        np.delete(again.z.reshape(2, -1), 3 * 64 + 4, 1), np.delete(field.z.reshape(2, -1), 196, 1)
    )
    with pytest.raises(ScanError, match="do not carry"):
        fit_field(frames[:1], levels[:1])


def test_noise_drift_and_allan_deviation():
    rng = np.random.default_rng(0)
    t = np.arange(240) / 10
    frames = rng.normal(0, 0.05, (240, 24, 32)) + 0.02 * t[:, None, None] / 60 * 60 + rng.normal(0, 1, (24, 32))
    n = still_noise(frames, t)
    assert abs(n.netd_K / 0.05 - 1) < 0.03
    assert abs(n.drift_K_per_min - 1.2) < 0.01
    white = rng.normal(size=20_000)
    tau, a = allan_deviation(white, 0.5)
    np.testing.assert_allclose(a[tau < 100], 1 / np.sqrt(tau[tau < 100] / 0.5), rtol=0.15)
    tau, a = allan_deviation(3.0 * np.arange(500.0), 1.0)  # a ramp of slope r: σ = r τ / √2
    np.testing.assert_allclose(a, 3 * tau / np.sqrt(2), rtol=1e-9)
    with pytest.raises(ScanError, match="too few"):
        still_noise(frames[:3], t[:3])
    axis = LogAxis.over("s", [0.1, 30.0])
    assert [axis.text(v) for v in axis.ticks()] == ["0.1", "0.2", "0.5", "1", "2", "5", "10", "20"]


@pytest.mark.parametrize("sigma", [0.6, 1.0, 1.8])
@pytest.mark.parametrize("upright", [True, False])
def test_point_spread_of_a_slanted_edge(sigma, upright):
    v, u = np.mgrid[0:50, 0:60]
    image = 20 + 10 * ndtr((u - 29 - 0.11 * (v - 25)) / np.hypot(1, 0.11) / sigma)
    image += np.random.default_rng(0).normal(0, 0.05, image.shape)
    e = edge_spread(image if upright else image.T)
    assert abs(e.sigma_px / sigma - 1) < 0.02
    with pytest.raises(ScanError, match="hot edge"):
        edge_spread(np.random.default_rng(0).normal(size=(40, 40)))


@pytest.mark.parametrize("offset", [-0.13, 0.02, 0.2])
def test_the_thermal_clock_is_found_from_a_waved_object(offset):
    rng = np.random.default_rng(1)

    def track(t):
        return np.stack(
            [0.3 * np.sin(2 * t) + 0.05 * np.sin(5 * t), 0.1 * np.cos(3.1 * t), 1.2 + 0.1 * np.sin(1.3 * t)], 1
        )

    td, tt = np.arange(0, 12, 1 / 30), np.arange(0, 12, 1 / 9) + 0.004
    p = track(td) + rng.normal(0, 0.002, (len(td), 3))
    q = track(tt + offset) + np.array([0.02, -0.09, 0])
    px = q[:, :2] / q[:, 2:] * 800 + [320, 240] + rng.normal(0, 0.5, (len(tt), 2))
    px[7] = np.nan
    px[20:22] += 60  # half out of view
    r = estimate_time_offset(td, p, tt, px)
    assert abs(r.offset_s - offset) < 0.004
    assert r.sigma_s < 0.004
    with pytest.raises(ScanError, match="hardly moves"):
        estimate_time_offset(td, p, tt, np.full((len(tt), 2), 100.0))


def test_the_warm_object_is_seen_by_both_cameras():
    y, x = np.mgrid[0:120, 0:160]
    warm = (
        22 + 12 * np.exp(-((x - 70.0) ** 2 + (y - 40.0) ** 2) / 60) + np.random.default_rng(0).normal(0, 0.05, x.shape)
    )
    np.testing.assert_allclose(warm_centroid(warm), [70, 40], atol=0.2)
    assert np.isnan(warm_centroid(np.full((120, 160), 22.0) + np.random.default_rng(0).normal(0, 0.05, x.shape))).all()
    camera = SimulatedRig().depth
    depth = np.full(camera.shape, 2.0, np.float32)
    depth[200:230, 300:340] = 1.0
    X = nearest_centroid(depth, camera)
    np.testing.assert_allclose(X, [(319.5 - camera.K[0, 2]) / 585, (214.5 - camera.K[1, 2]) / 585, 1.0], atol=1e-6)


def test_the_authors_phantom_pictures_are_reproduced(shared_data):
    """Their images are the mean of eight frames' temperatures, one quartic, no field; the recording keeps one frame.

    Every pixel of all three images says so to below a microkelvin, and the kept frame is a possible one of the eight
    everywhere. Where all eight agree (whole levels of 16 counts), its counts alone give the image, and the quartic.
    """
    counts, degC = phantom(shared_data("jhu") / "phantom")
    found = decode(degC, (counts - 3) / 16, frames=8)
    assert np.abs(found.degC - degC).max() < 1e-6
    assert found.may_hold((counts - 3) / 16).all()
    same = found.spread < 1e-6
    assert same.sum() > 200
    curve = fit_polynomial(counts[same], degC[same])
    np.testing.assert_allclose(curve.parameters, PHANTOM_QUARTIC, rtol=1e-11)
    np.testing.assert_allclose(evaluate("polynomial", PHANTOM_QUARTIC, counts[same]), degC[same], atol=1e-12)
    # a frame by itself cannot: one level is 6 to 14 mK, its noise as much
    single = np.abs(evaluate("polynomial", PHANTOM_QUARTIC, counts) - degC)
    assert np.mean(single < 1e-3) < 0.1
    assert decode(degC, (counts - 3) / 16, frames=7).may_hold((counts - 3) / 16).mean() < 0.2  # and seven frames do not


def test_averaged_frames_are_told_apart():
    """The method of the test above on images made for it; one frame's own mean is half a level off."""
    rng = np.random.default_rng(0)
    level = np.round(2300 + 1600 * rng.beta(0.6, 0.6, 60_000) + rng.normal(0, 1, (8, 60_000)))
    level[0] = np.round(level[0] - 0.5)
    degC = evaluate("polynomial", PHANTOM_QUARTIC, 16 * level + 3).mean(axis=0)
    found = decode(degC, level[0], frames=8)
    np.testing.assert_array_equal(found.total, level.sum(axis=0))
    np.testing.assert_allclose(found.spread, 8 * level.var(axis=0), atol=1e-6)
    np.testing.assert_allclose(
        found.curve(level[0]), evaluate("polynomial", PHANTOM_QUARTIC, 16 * level[0] + 3), atol=1e-8
    )


def test_a_curve_from_raw_frames_is_true_in_level(shared_data):
    """What a laboratory would do: the quartic from single frames against the images, noise and all."""
    counts, degC = phantom(shared_data("jhu") / "phantom")
    curve = fit_polynomial(counts, degC)
    for g, T in zip(counts.reshape(3, -1), degC.reshape(3, -1), strict=True):
        error = curve.to_degC(g) - T
        assert abs(error.mean()) < 2e-3
        assert np.median(np.abs(error)) < 0.01


def phantom(folder):
    """Raw counts (N,) of one frame and the authors' mean temperatures (N,), three images after each other."""
    counts, degC = [], []
    for T in (36, 40, 44):
        counts.append(np.frombuffer((folder / f"{T}.raw").read_bytes(), ">u2", 81_920, 240).astype(float))
        degC.append(scipy.io.loadmat(folder / f"Aver_ImT_{T}.mat")["Aver_ImT"].ravel())
    return np.concatenate(counts), np.concatenate(degC)


def test_the_authors_field_flattens_a_real_frame(shared_data):
    import cv2

    folder = shared_data("jhu")
    stored = scipy.io.loadmat(folder / "radiometry" / "0301_BB_Calibration_Polynimial.mat")["poly"].ravel()[::-1]
    z = [scipy.io.loadmat(folder / "radiometry" / f"0301_z{k}.mat")[f"z{k}"] for k in (1, 2, 3, 4)]
    raw = np.fromfile(folder / "calibration" / "0000_0000.raw", ">u2").reshape(476, 632).astype(float)
    T = evaluate("polynomial", tuple(stored), raw)
    flat = T + sum(zk * T**k for k, zk in enumerate(z))  # theirs is what has to be added
    before, after = (float(cv2.GaussianBlur(a, (0, 0), 8).std()) for a in (T, flat))
    assert after < before / 4
