"""Validation against synthetic truth: left-out readings, and a map's own error told without the truth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.problems import errors, problem_of
from support.synthetic_views import BAND, L_ROOM, REFLECTED_K, make_world, vignetting_K
from support.truth import truth_of

from thermofusion.cli import main
from thermofusion.diagnosis import VOCABULARY
from thermofusion.errors import RecipeError, ScanError
from thermofusion.judge.leftout import WELL_SEEN_COS, Bench
from thermofusion.judge.limits import LEFT_OUT, SHARED_FAULTS, gain_limit, limits
from thermofusion.judge.maperror import MapError, map_error
from thermofusion.judge.validate import validate
from thermofusion.phantom import load_scene, simulate
from thermofusion.physics.band import ZERO_DEGC_K
from thermofusion.physics.emissivity import Fresnel
from thermofusion.recipe import load_recipe
from thermofusion.robust import Statistics, mad_sigma, weighted_quantile
from thermofusion.scans import open_scan
from thermofusion.temperature.references import ExpectedReading
from thermofusion.temperature.room.stated import Room
from thermofusion.temperature.uncertainty import BILINEAR_VARIANCE
from thermofusion.types import SurfaceMesh

NEVER = lambda stage, done, total: None  # noqa: E731


def make_bench(world, netd_K, normal_deg=0.3, *, field=True, **changes):
    """A bench of a synthetic world. Its readings are single pixels, so the camera's NETD is stated accordingly."""
    settings = load_recipe({}, [f"temperature.{k.replace('__', '.')}={v}" for k, v in changes.items()]).temperature
    quiet = errors(
        netd_K / np.sqrt(BILINEAR_VARIANCE),
        sigma_normal_deg=normal_deg,
        sigma_registration_px=0.0,
        sigma_reflected_K=0.0,
        sigma_emissivity0=0.0,
    )
    rows, n = world.observations, world.n_vertices
    problem = problem_of(
        rows,
        n,
        world.n_views,
        blackbodies=blackbodies(world, field=field),
        errors=replace(quiet, gradient_K_per_m=np.zeros(n, np.float32)),
        room=Room(REFLECTED_K, 32.5 + ZERO_DEGC_K),
        settings=settings,
    )
    problem = replace(problem, counts=rows.cos_angle >= np.cos(np.radians(65)))
    return Bench(problem, np.bincount(rows.vertex[rows.cos_angle > WELL_SEEN_COS], minlength=n) >= 2)


def blackbodies(world, *, field, T_K=308.15, u=200.0, v=150.0):
    """A source of known temperature in every sixth view: without a level, ε(θ) times it would stay in the map."""
    expected = 0.98 * float(BAND.radiance(T_K)) + 0.02 * L_ROOM
    slope = float(BAND.d_radiance_dT(T_K))
    fault_K = world.offsets_K + (vignetting_K(u, v) if field else 0.0)
    return tuple(
        ExpectedReading(k, 0, expected + world.slope_L * float(fault_K[k]), 1e-3, u, v, expected, 0.03 * slope)
        for k in range(0, world.n_views, 6)
    )


def surface_of(world):
    unit = world.points_m / np.linalg.norm(world.points_m, axis=1, keepdims=True)
    return SurfaceMesh(world.points_m.astype(np.float32), np.zeros((0, 3), np.int32), unit.astype(np.float32))


def true_error(world, bench):
    everything = np.ones(world.n_views, bool)
    result = bench.blend(everything, bench.calibrate(everything))
    error = (result.temperature_K - world.T_K)[bench.well_seen & np.isfinite(result.temperature_K)]
    return Statistics.of(error - np.median(error)), result.uncertainty.total_K


@pytest.mark.parametrize("netd_K", [0.03, 0.10])
def test_left_out_residual_is_the_noise(netd_K):
    """Readings with nothing wrong but noise: the residual is that noise, not biased, and 95 % lie in the interval."""
    world = make_world(1, netd_K=netd_K, drift_K=1.0)
    left = make_bench(world, netd_K).predictions(5, NEVER)
    assert len(left.residual_K) > 0.97 * len(world.observations)  # the rest: spots that no other view saw well
    under = left.angle_deg < 60
    assert np.sqrt(np.mean(left.residual_K[under] ** 2)) == pytest.approx(netd_K, rel=0.10)
    assert abs(left.residual_K.mean()) < 0.05 * netd_K
    assert 0.93 < np.mean(np.abs(left.residual_K[under]) < 1.96 * left.sigma_K[under]) < 0.975
    for lo, hi in ((0, 20), (20, 40), (40, 60)):
        bin_ = (left.angle_deg >= lo) & (left.angle_deg < hi)
        assert abs(left.residual_K[bin_].mean()) < 0.1 * netd_K


def test_a_wrong_model_shows_at_large_angles():
    """Skin of another ε(θ) than assumed, shape held: the left-out residual grows with the angle, and says so."""
    world = make_world(2, model=Fresnel(1.33, 0.25), field=False)
    held = make_bench(world, 0.05, field=False, crosscal__shape="false").predictions(4, NEVER)
    fitted = make_bench(world, 0.05, field=False).predictions(4, NEVER)
    steep = lambda r: float(np.median(r.residual_K[r.angle_deg > 68]))  # noqa: E731
    assert abs(steep(held)) > 0.08
    assert abs(steep(fitted)) < 0.03


def test_method_without_calibration_is_predicted_too():
    """Plain means keep the views' drift in the map: worse by far than the joint solution on the same views."""
    world = make_world(3, drift_K=1.0)
    joint = make_bench(world, 0.05).predictions(4, NEVER)
    mean = make_bench(world, 0.05, method='"mean"').predictions(4, NEVER)
    assert mad_sigma(mean.residual_K) > 2 * mad_sigma(joint.residual_K)


@pytest.mark.parametrize(
    ("seed", "netd_K", "drift_K", "normal_deg", "field"),
    [(0, 0.05, 0.5, 0.0, True), (1, 0.15, 2.0, 0.0, True), (2, 0.03, 1.0, 0.3, True), (3, 0.10, 0.2, 0.3, False)],
)
def test_the_maps_own_error_is_told_without_truth(seed, netd_K, drift_K, normal_deg, field):
    """MAE, RMSE and p95 of the relative temperature within 20 % of the true ones, whatever noise, drift and normals."""
    world = make_world(
        seed, n_vertices=6000, n_views=36, netd_K=netd_K, drift_K=drift_K, normal_error_deg=normal_deg, field=field
    )
    bench = make_bench(world, netd_K, normal_deg=max(normal_deg, 0.3), field=field)
    truth, sigma_K = true_error(world, bench)
    told = map_error(bench, bench, surface_of(world), sigma_K, psf_sigma_px=0.0)
    assert told.error.mae_K == pytest.approx(truth.mae_K, rel=0.20)
    assert told.error.rmse_K == pytest.approx(truth.rmse_K, rel=0.20)
    assert told.error.p95_K == pytest.approx(truth.p95_K, rel=0.20)
    assert told.coverage > 0.9


def test_three_views_are_enough():
    """One view has no overlap to be calibrated by: views are left out one at a time. Right in the mean of six worlds:
    what three views say of their own calibration is as uncertain as the calibration."""
    told, true = [], []
    for seed in range(6):
        world = make_world(seed, n_vertices=1500, n_views=3, turn_deg=60.0, field=False)
        bench = make_bench(world, 0.05, field=False)
        truth, sigma_K = true_error(world, bench)
        true.append(truth.mae_K)
        told.append(map_error(bench, bench, surface_of(world), sigma_K, psf_sigma_px=0.0).error.mae_K)
    assert np.mean(told) == pytest.approx(np.mean(true), rel=0.25)


def test_point_spread_is_found_in_the_map():
    """Stripes that the point spread flattens by 15 %: what it took off, told from the map within a quarter."""
    wave, sigma_m = 0.05, 0.0045
    stripes = lambda p: 33.0 + 0.5 * np.sin(2 * np.pi * p[:, 2] / wave)  # noqa: E731
    gain = np.exp(-2 * (np.pi * sigma_m / wave) ** 2)
    blurred = lambda p: 33.0 + gain * (stripes(p) - 33.0)  # noqa: E731
    world = make_world(4, n_vertices=9000, temperature=blurred, field=False)
    bench = make_bench(world, 0.05, field=False)
    pixel_m = np.sqrt(np.median(world.observations.footprint_m2 * world.observations.cos_angle))
    psf_px = np.sqrt((sigma_m / pixel_m) ** 2 - 1 / 6)
    told = map_error(bench, bench, surface_of(world), true_error(world, bench)[1], psf_px)
    assert told.spread_rms_K == pytest.approx(0.5 / np.sqrt(2) * (1 - gain), rel=0.25)


def test_where_the_error_cannot_be_told_is_said():
    error = MapError(Statistics(9, 0, 0.02, 0.03, 0.05, 0.95), Statistics(9, 0, 0, 0, 0, 1), 0, 0, 4, 3, 1, 1, 0.2)
    assert limits((), error) == ()
    assert limits([{"what": "dead pixels"}, {"what": "time stamps jitter"}], error) == ()
    (said,) = limits([{"what": "rows are read one after another"}], error)
    assert "cannot be told" in said
    assert set(SHARED_FAULTS) | {LEFT_OUT} <= set(VOCABULARY)
    assert "70%" in limits((), replace(error, tail_share=0.7))[0]
    # a map that is stretched by g about its middle errs by g times its spread
    T = np.array([30.0, 33.0, 34.0, np.nan, 33.0])
    assert gain_limit(error, T) == pytest.approx(0.2 * 0.02 / np.mean([3, 0, 1, 0]))


def test_too_few_views(tmp_path):
    world = make_world(0, n_vertices=500, n_views=24)
    alone = replace(make_bench(world, 0.05), well_seen=np.zeros(500, bool))
    with pytest.raises(ScanError, match="two views under 60"):
        map_error(alone, alone, surface_of(world), np.ones(500), 0.7)


def test_statistics():
    e = np.array([-1.0, 1.0, 3.0, 5.0])
    s = Statistics.of(e, np.array([1.0, 1.0, 1.0, 3.0]))
    assert (s.n, s.bias_K, s.mae_K) == (4, 2.0, 2.5)
    assert s.rmse_K == pytest.approx(3.0)
    assert s.within_95 == pytest.approx(0.75)
    assert Statistics.of(e, weight=np.array([1.0, 1.0, 0.0, 0.0])).bias_K == 0.0
    assert Statistics.of(np.zeros(0)).n == 0
    assert weighted_quantile(np.array([3.0, 1.0, 2.0]), np.ones(3), 0.5) == 2.0
    assert mad_sigma(np.random.default_rng(0).normal(size=20_000)) == pytest.approx(1.0, rel=0.03)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A small simulated recording of an isothermal sphere."""
    scene = load_scene("sphere")
    scene = replace(
        scene,
        color=None,
        walk=replace(scene.walk, depth_frames=36, depth_hz=6.0),
        depth=replace(scene.depth, scale=0.5),
        thermal=replace(scene.thermal, scale=0.5, every=3, netd_K=0.08, blackbody=None),
    )
    return simulate(scene, tmp_path_factory.mktemp("ball") / "scan", seed=5)


def test_validate_from_recording_to_report(ball, tmp_path, capsys):
    """The verb: runs the scan, leaves views out, reports; the second time it reuses what is stored."""
    out = tmp_path / "out"
    arguments = ["validate", str(ball), "-r", "torso", "--set", "temperature.reflected_degC=20", "-o", str(out)]
    with pytest.raises(SystemExit) as stopped:
        main([*arguments, "--set", "output.views=false", "--folds", "3", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert stopped.value.code == 0
    assert report == json.loads((out / "validation.json").read_text())
    assert report["folds"] == 3
    assert report["views"] >= 8
    assert report["overall"]["n"] == sum(s["n"] for s in report["by_angle"].values())
    assert 0.9 < report["overall"]["within_95"] <= 1.0
    straight = report["by_angle"]["0-20"]
    assert straight["rmse_K"] == pytest.approx(report["noise_K"], rel=0.25)  # an isothermal body: noise is all there is
    truth = truth_of(ball)
    assert np.ptp(truth["temperature_degC"]) < 1e-6
    from thermofusion.results.folder import load_mesh

    mesh = load_mesh(out)
    well = mesh.measured & (mesh.view_angle_deg < 60) & (mesh.observations >= 2)
    error = mesh.temperature_degC[well] - np.median(mesh.temperature_degC[well])
    assert report["map_error"]["error"]["mae_K"] == pytest.approx(np.abs(error).mean(), rel=0.35)
    assert any("motion" in m for m in report["messages"])


def test_validate_refuses(ball):
    scan = open_scan(ball)
    with pytest.raises(RecipeError, match="at least 2 folds"):
        validate(scan, load_recipe("torso"), folds=1)
    with pytest.raises(ScanError, match="no thermal stream"):
        validate(replace(scan, thermal=None), load_recipe("torso"))
