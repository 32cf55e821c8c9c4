"""Bundle adjustment, groups, priors and refusals, against simulated rigs with truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from support.simulated_rig import Noise, SimulatedRig, mirrored, simulate_set, true_pixels

from thermofusion.calibration.board.board import Board
from thermofusion.calibration.board.views import BoardPoints, BoardView, CalibrationSet
from thermofusion.calibration.fit.bundle import Options, Problem
from thermofusion.calibration.fit.cameras import (
    from_rt,
    intrinsics_of,
    left_jacobians,
    project_with_jacobian,
    rotations,
    to_rt,
)
from thermofusion.calibration.fit.coverage import advice, coverage
from thermofusion.calibration.fit.depth_model import DisparityDepth
from thermofusion.calibration.fit.rig import calibrate_views, derived_extrinsics, predict_px
from thermofusion.calibration.fit.single import fit_camera
from thermofusion.calibration.fit.solver import solve
from thermofusion.calibration.report import report_html
from thermofusion.calibration.rig_file import read_rig, rig_document, write_rig
from thermofusion.errors import ScanError
from thermofusion.geometry.camera import project
from thermofusion.geometry.rigid import invert, rotation_angle_deg, se3_exp
from thermofusion.scans.native.depth_correction import MetricDepth


@pytest.fixture(scope="module")
def rig():
    return SimulatedRig()


@pytest.fixture(scope="module")
def calibrated(rig):
    """One whole calibration, colour + thermal + depth, on a small rig: 10 views."""
    data, depth, _ = simulate_set(rig, 3, views=10, noise=Noise(0.1, 0.15))
    return calibrate_views(data, depth_images=depth, depth_camera=rig.depth, depth_lens_known=True)


def test_projection_is_opencvs_and_its_derivatives_are_right():
    rng = np.random.default_rng(0)
    X = rng.uniform([-0.5, -0.4, 0.8], [0.5, 0.4, 2.0], (40, 3))
    k = np.array([800.0, 810, 320, 240, -0.2, 0.15, 0.002, -0.003, 0.05])
    K = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]])
    uv, J, D = project_with_jacobian(X, k)
    expected = cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, k[4:])[0][:, 0]
    np.testing.assert_allclose(uv, expected, atol=1e-9)
    h = 1e-6
    for j in range(3):
        d = np.eye(3)[j] * h
        numeric = (project_with_jacobian(X + d, k)[0] - project_with_jacobian(X - d, k)[0]) / (2 * h)
        np.testing.assert_allclose(J[:, :, j], numeric, rtol=1e-6, atol=1e-5)
    for j in range(9):
        d = np.eye(9)[j] * h
        numeric = (project_with_jacobian(X, k + d)[0] - project_with_jacobian(X, k - d)[0]) / (2 * h)
        np.testing.assert_allclose(D[:, :, j], numeric, rtol=1e-5, atol=1e-5)


def test_left_jacobian_of_rotations():
    rng = np.random.default_rng(1)
    w = np.concatenate([rng.normal(size=(5, 3)), 1e-6 * rng.normal(size=(3, 3))])
    d = 1e-6 * rng.normal(size=w.shape)
    change = rotations(w + d) @ np.transpose(rotations(w), (0, 2, 1))
    expected = np.einsum("nij,nj->ni", left_jacobians(w), d)
    got = np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1)
    np.testing.assert_allclose(got, expected, atol=1e-11)


@pytest.mark.parametrize("model", [MetricDepth((640, 480)), DisparityDepth((640, 480))])
def test_the_sparse_jacobian_of_the_bundle_is_the_derivative(rig, model):
    from support.simulated_rig import plane_depth

    from thermofusion.calibration.detect.depth_samples import sample_board

    data, _, poses = simulate_set(rig, 0, views=3, with_depth=False)
    views = []
    for v, T in zip(data.views, poses, strict=True):
        z = plane_depth(rig, T, 1e-3, 0)
        image = (1 / z - 3.0938) / -0.002848 if isinstance(model, DisparityDepth) else z
        views.append(
            replace(v, depth=sample_board(image, rig.depth, T, rig.board.outline_m(), disparity=image is not z))
        )
    assert all(v.depth is not None for v in views)
    problem = Problem(replace(data, views=tuple(views)), depth_model=model, depth_size=(640, 480))
    rng = np.random.default_rng(0)
    x = np.zeros(len(problem.names))
    for c in ("color", "thermal", "depth"):
        x[problem.slices[c]] = intrinsics_of(rig.camera(c))
    x[problem.slices["depth_model"]] = model.start() + 0.3 * rng.normal(size=len(model.names)) * model.prior_sigma()
    x[problem.slices["T_thermal_color[0]"]] = to_rt(rig.T_thermal_depth @ invert(rig.T_color_depth)) + 0.01
    x[problem.slices["T_depth_color"]] = to_rt(invert(rig.T_color_depth)) + 0.01
    x[problem.slices["spacing"]] = 0.02
    for v, T in zip(problem.views, poses, strict=True):
        x[problem.slices[f"view:{v.name}"]] = to_rt(rig.T_color_depth @ T)
    options = Options(fixed=frozenset())
    J = problem.linearise(x, options)[1].tocsc()
    for j in rng.choice(len(x), 40, replace=False):
        h = 1e-6 * max(1.0, abs(x[j]))
        if problem.names[j].startswith("depth_model"):
            h = 1e-4 * model.prior_sigma()[j - problem.slices["depth_model"].start]
        d = np.zeros(len(x))
        d[j] = h
        numeric = (problem.linearise(x + d, options)[0] - problem.linearise(x - d, options)[0]) / (2 * h)
        got = J[:, [j]].toarray().ravel()
        np.testing.assert_allclose(got, numeric, atol=1e-4 * max(np.abs(numeric).max(), 1e-3), err_msg=problem.names[j])


def test_disparity_round_trip_and_recovery():
    model, rng = DisparityDepth((640, 480)), np.random.default_rng(0)
    theta = model.start() + np.concatenate([[0.02, 2e-5, 2e-4], rng.normal(0, 2, len(model.names) - 3)])
    u, v, z = rng.uniform(0, 639, 3000), rng.uniform(0, 479, 3000), rng.uniform(0.6, 3.5, 3000)
    d = model.to_disparity(theta, z, u, v)
    np.testing.assert_allclose(model.to_depth_m(theta, d, u, v), z, rtol=1e-10)
    noisy = np.round(d + rng.normal(0, 0.3, d.shape))
    start, sigma = model.start(), model.prior_sigma()
    fit = least_squares(
        lambda s: np.concatenate([model.residual(start + s * sigma, noisy, u, v, z)[0] / 0.4, s]), np.zeros(len(start))
    )
    error = model.to_depth_m(start + fit.x * sigma, d, u, v) / z - 1
    assert np.abs(error).max() < 2e-3


def test_a_whole_rig_is_recovered_within_its_own_intervals(rig, calibrated):
    c = calibrated
    assert c.fit.converged
    assert c.grouping is not None
    assert c.grouping.count == 1
    assert not c.grouping.outliers
    z = []
    for name in ("color", "thermal"):
        truth = rig.T_camera_depth(name)
        T = c.extrinsics[f"T_{name}_depth"]
        assert rotation_angle_deg(T @ invert(truth)) < 0.2
        assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 4e-3
        z.append((to_rt(T) - to_rt(truth)) / np.sqrt(np.diag(c.extrinsic_covariance[f"T_{name}_depth"])))
        s = np.sqrt(np.diag(c.fit.block_covariance(name)))[:4]
        z.append((c.fit.block(name) - intrinsics_of(rig.camera(name)))[:4] / s)
    assert np.abs(np.concatenate(z)).max() < 4
    assert 0.4 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.7
    assert abs(c.single["color"].sigma_px - 0.1) < 0.01


def test_spacing_comes_from_depth(rig):
    data, depth, _ = simulate_set(rig, 7, views=7, noise=Noise(0.1, 0.15))
    wrong = replace(data, board=replace(data.board, spacing_m=0.04))
    c = calibrate_views(wrong, depth_images=depth, depth_camera=rig.depth, depth_lens_known=True, free_spacing=True)
    assert abs(c.spacing_m - rig.board.spacing_m) < 4 * c.spacing_sigma_m
    assert abs(c.spacing_m / rig.board.spacing_m - 1) < 0.004


def test_a_knocked_tripod_and_a_bad_view_are_named(rig):
    knocked = replace(rig, T_thermal_depth=se3_exp(np.array([0.02, -0.03, 0.01, 0.01, 0, 0])) @ rig.T_thermal_depth)
    data, _, poses = simulate_set(rig, 11, views=16, with_depth=False)
    rng, views = np.random.default_rng(0), []
    for i, (v, T) in enumerate(zip(data.views, poses, strict=True)):
        px = true_pixels(knocked if i >= 9 else rig, "thermal", T)
        if i == 4:
            px = px + rng.normal(0, 0.3, px.shape) + [18, 0]  # a whole view picked off by 18 px
        views.append(v.with_points("thermal", BoardPoints(np.arange(len(px)), px + rng.normal(0, 0.3, px.shape))))
    c = calibrate_views(replace(data, views=tuple(views)))
    assert c.grouping is not None
    assert c.grouping.count == 2
    assert c.grouping.names(1) == [f"{i:04d}" for i in range(9, 16)]
    assert list(c.grouping.outliers) == ["0004"]
    assert any("0004" in n for n in c.notes)
    assert any("moved" in n for n in c.notes)
    for k in (0, 1):
        assert c.fit.rms_px("thermal", set(c.grouping.names(k))) < 0.6
    for name in ("color", "thermal"):
        assert abs(c.fit.block(name)[0] / c.single[name].intrinsics[0] - 1) < 0.03
    held_out = BoardView("new", {"color": data.views[0].points["color"], "thermal": data.views[0].points["thermal"]})
    assert np.sqrt(np.mean(np.sum(predict_px(c, held_out, group=0) ** 2, axis=1))) < 2.0


def test_wild_picks_do_not_pull(rig):
    data, _, _ = simulate_set(rig, 2, views=10, noise=Noise(0.2, 0.2, wild=0.05), with_depth=False)
    s = fit_camera(data, "color")
    assert np.abs(s.intrinsics[:2] / intrinsics_of(rig.color)[:2] - 1).max() < 0.01
    assert s.sigma_px < 3.0


def test_mirrored_pictures_are_refused(rig):
    data, depth, _ = simulate_set(rig, 1, views=6)
    with pytest.raises(ScanError, match="thermal pictures are mirrored"):
        calibrate_views(mirrored(data, "thermal"))
    # a detector numbers a mirrored board as if it were seen from the front
    flipped = mirrored(data, "thermal")
    grid = np.arange(81).reshape(9, 9)[:, ::-1].ravel()
    renumbered = tuple(
        v.with_points("thermal", BoardPoints(grid[v.points["thermal"].index], v.points["thermal"].px))
        for v in flipped.views
    )
    with pytest.raises(ScanError, match="mirrored against each other"):
        calibrate_views(replace(flipped, views=renumbered))
    with pytest.raises(ScanError, match=r"depth images are mirrored"):
        calibrate_views(
            data, depth_images={n: (lambda f=f: f()[:, ::-1]) for n, f in depth.items()}, depth_camera=rig.depth
        )


def test_unusable_views_say_what_to_do(rig):
    board = rig.board
    flat = [
        BoardView(str(i), {"color": BoardPoints(np.arange(81), true_pixels(rig, "color", _flat(i)))}) for i in range(6)
    ]
    data = CalibrationSet(board, {"color": (1280, 960)}, tuple(flat))
    with pytest.raises(ScanError, match=r"parallel.*tilt the board"):
        calibrate_views(data)
    with pytest.raises(ScanError, match=r"sees the board in 2 views"):
        calibrate_views(replace(data, views=data.views[:2]))
    with pytest.raises(ScanError, match="no camera sees the board"):
        calibrate_views(replace(data, views=()))


def _flat(i: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = [-0.2 + 0.02 * i, -0.2, 1.0 + 0.1 * i]
    return T


def test_a_rig_file_round_trip_with_covariances_and_report(calibrated, tmp_path):
    c = calibrated
    steps = [s for name in c.single for s in advice(coverage(c, name))]
    write_rig(tmp_path / "rig.json", rig_document(c, date="2026-01-01", advice=steps))
    back = read_rig(tmp_path / "rig.json")
    for key, T in c.extrinsics.items():
        np.testing.assert_array_equal(back.extrinsics[key], T)
        np.testing.assert_array_equal(back.covariances[key], c.extrinsic_covariance[key])
    for name, camera in c.cameras.items():
        np.testing.assert_array_equal(back.cameras[name].K, camera.K)
    assert back.rig().color is not None
    assert back.document["figures"]["joint_rms_px"]["color"] < 0.2
    html = report_html(c, advice=steps, date="2026-01-01")
    assert html.count("<clipPath") >= 6  # residuals, views, depth, coverage: one sheet of plots
    assert "http://" not in html.replace("http://www.w3.org", "")
    assert "src=" not in html
    (tmp_path / "bad.json").write_text('{"schema": "thermofusion-rig/1", "cameras": {}}')
    with pytest.raises(ScanError, match="extrinsics"):
        read_rig(tmp_path / "bad.json")
    (tmp_path / "bad.json").write_text('{"schema": "thermofusion-scan/1", "cameras": {}, "extrinsics": {}}')
    with pytest.raises(ScanError, match="key 'schema': expected 'thermofusion-rig/1'"):
        read_rig(tmp_path / "bad.json")
    assert list(c.cameras) == ["color", "thermal", "depth"]  # and so the report's columns, on every run


def test_without_depth_the_rig_hangs_on_colour_and_advice_names_the_empty_part(rig, tmp_path):
    data, _, _ = simulate_set(rig, 5, views=12, with_depth=False)
    c = calibrate_views(data)
    write_rig(tmp_path / "rig.json", rig_document(c))
    back = read_rig(tmp_path / "rig.json")
    np.testing.assert_array_equal(back.extrinsics["T_thermal_color"], c.extrinsics["T_thermal_color"])
    with pytest.raises(ScanError, match="without a depth camera"):
        back.rig()
    some = coverage(c, "color")
    empty = replace(some, counts=np.array([[0, 9, 9], [9, 9, 9], [9, 9, 9]]))
    assert any("upper left" in s for s in advice(empty))
    narrow = replace(some, tilts_deg=np.column_stack([np.full(12, 20.0), np.zeros(12)]))
    assert any("looks left" in s for s in advice(narrow))
    assert not any("looks right" in s for s in advice(narrow))


def test_rotation_vectors_round_trip():
    rt = np.random.default_rng(0).normal(size=(6, 6))
    np.testing.assert_allclose(to_rt(from_rt(rt)), rt, atol=1e-12)


def test_boards_check_themselves():
    with pytest.raises(ScanError, match="no board kind"):
        Board("chess")  # type: ignore[arg-type]
    with pytest.raises(ScanError, match="even number"):
        Board("mask", 5, 4, 0.02)
    with pytest.raises(ScanError, match="metres"):
        Board("pins", 9, 9, 76.2)


def test_solve_says_when_it_converged(rig):
    data, _, _ = simulate_set(rig, 5, views=5, with_depth=False)
    s = fit_camera(data, "color")
    again = solve(s.fit.problem, s.fit.x, s.fit.options)
    assert again.converged
    np.testing.assert_allclose(again.x, s.fit.x, atol=1e-3)


def test_intervals_hold_over_seeds(rig):
    """The short form of benchmarks/calibration_coverage.py: lenses and thermal extrinsic, 8 seeds of 8 views."""
    z = []
    for seed in range(8):
        data, _, _ = simulate_set(rig, seed, views=8, with_depth=False)
        c = calibrate_views(data)
        for name in ("color", "thermal"):
            s = np.sqrt(np.diag(c.fit.block_covariance(name)))[:8]
            z.append((c.fit.block(name) - intrinsics_of(rig.camera(name)))[:8] / s)
        truth = rig.T_thermal_depth @ invert(rig.T_color_depth)
        s = np.sqrt(np.diag(c.extrinsic_covariance["T_thermal_color"]))
        z.append((to_rt(c.extrinsics["T_thermal_color"]) - to_rt(truth)) / s)
    inside = np.mean(np.abs(np.concatenate(z)) < 1.96)
    assert 0.88 < inside < 0.995


def test_intervals_hold_where_points_of_a_view_err_alike(rig):
    """A board that bends by 3 mm, in another way in every view: both cameras agree, and views are the witnesses, not
    their 81 points."""
    z, taken_as_independent = [], []
    X = rig.board.points_m
    x, y = ((X - X.mean(0)) / X.std(0).max())[:, :2].T
    shapes = np.stack([x * x, x * y, y * y, x * y * y, x * x * y])
    truth = rig.T_thermal_depth @ invert(rig.T_color_depth)
    for seed in range(6):
        data, _, poses = simulate_set(rig, seed, views=12, with_depth=False)
        rng, views = np.random.default_rng(100 + seed), []
        for view, T in zip(data.views, poses, strict=True):
            bent = X + np.outer(shapes.T @ rng.normal(0, 0.0015, 5), [0, 0, 1.0])
            for name, p in view.points.items():
                T_camera_board = rig.T_camera_depth(name) @ T
                px = project(rig.camera(name), bent @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])[0][p.index]
                view = view.with_points(name, replace(p, px=px + rng.normal(0, 0.05, px.shape)))
            views.append(view)
        c = calibrate_views(replace(data, views=tuple(views)))
        alone = solve(c.fit.problem, c.fit.x, c.fit.options)
        for fit, out in ((c.fit, z), (alone, taken_as_independent)):
            T, covariance = derived_extrinsics(fit, 0)
            off = to_rt(T["T_thermal_color"]) - to_rt(truth)
            out.append(off / np.sqrt(np.diag(covariance["T_thermal_color"])))
            for name in ("color", "thermal"):
                off = (fit.block(name) - intrinsics_of(rig.camera(name)))[:8]
                out.append(off / np.sqrt(np.diag(fit.block_covariance(name)))[:8])
    inside, before = (np.mean(np.abs(np.concatenate(of)) < 1.96) for of in (z, taken_as_independent))
    assert inside > 0.88
    assert before < 0.7
