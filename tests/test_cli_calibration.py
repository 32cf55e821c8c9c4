"""Calibration as a laboratory does it, without Python: every verb on input with known truth, and on faulty input."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
from scipy.special import ndtr
from support import scan_maker as make
from support.simulated_rig import SimulatedRig, picks_csv, simulate_set

from thermofusion.calibration.thermal.blackbody import read_curve, read_field, write_field
from thermofusion.calibration.thermal.radiometric import PixelField, evaluate
from thermofusion.cli import main
from thermofusion.scans import open_scan, with_rig
from thermofusion.scans.common import as_thermal
from thermofusion.scans.native.write import write_scan
from thermofusion.types import Rig, SignalCurve, ThermalCamera

PLANCK = (366_545.0, 1428.0, 1.0, -342.0)
LEVELS_DEGC = (20.0, 25.0, 30.0, 35.0, 40.0, 45.0)
H, W = 60, 80
y, x = np.mgrid[0:H, 0:W]
BOWL_K = 1.2 * ((x - 40) ** 2 + (y - 30) ** 2) / 2500  # vignetting: colder middle, zero there


def call(capsys, *arguments):
    """(exit code, stdout, stderr) of `thermofusion arguments`."""
    with pytest.raises(SystemExit) as stopped:
        main(list(map(str, arguments)))
    captured = capsys.readouterr()
    return stopped.value.code, captured.out, captured.err


def run(capsys, *arguments):
    """The JSON of a call that must do well."""
    code, out, err = call(capsys, *arguments, "--json")
    assert code == 0, err
    return json.loads(out)


def counts_of(degC):
    R, B, F, O = PLANCK  # noqa: E741
    return R / (np.exp(B / (np.asarray(degC) + 273.15)) - F) + O


def picture(path: Path, degC, rng):
    """16-bit counts of a scene with the bowl and 2 counts of noise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    counts = counts_of(degC + BOWL_K * (1 + 0.02 * (degC - 30))) + rng.normal(0, 2, (H, W))
    cv2.imwrite(str(path), np.round(counts).astype(np.uint16))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A blackbody session: six temperatures, eight frames each, a table beside them."""
    folder, rng = tmp_path_factory.mktemp("blackbody"), np.random.default_rng(0)
    rows = ["file,degC,left_px,top_px,width_px,height_px"]
    for T in LEVELS_DEGC:
        for k in range(8):
            picture(folder / f"at{T:.0f}" / f"{k}.png", T, rng)
        rows.append(f"at{T:.0f},{T},36,26,8,8")
    (folder / "curve.csv").write_text("\n".join(rows) + "\n")
    (folder / "field.csv").write_text("\n".join(",".join(r.split(",")[:2]) for r in rows) + "\n")
    picture(folder / "scene.png", np.float64(33.0), rng)
    return folder


def test_a_curve_from_readings_keeps_the_papers_digits(tmp_path, capsys):
    truth = (-345938.74503203743, 56.540702698830174, -0.003469484808056, 9.47054240339e-08, -9.6993801966e-13)
    g = np.linspace(23_800, 27_000, 60)
    rows = [f"{a!r},{T!r}" for a, T in zip(g.tolist(), evaluate("polynomial", truth, g).tolist(), strict=True)]
    (tmp_path / "r.csv").write_text("counts,degC\n" + "\n".join(rows))
    code, _, err = call(capsys, "thermal", "curve", tmp_path / "r.csv", "-o", tmp_path / "c.json")
    assert code == 3
    assert "turns between 259" in err
    assert not (tmp_path / "c.json").exists()
    found = run(capsys, "thermal", "curve", tmp_path / "r.csv", "--range", "23800:25900", "-o", tmp_path / "c.json")
    assert found["counts_range"] == [23_800, 25_900]
    curve = read_curve(tmp_path / "c.json")
    np.testing.assert_allclose(curve.parameters, truth, rtol=1e-6)
    assert found["signal"]["curve"]["coefficients_degC"] == list(curve.parameters)
    code, _, err = call(capsys, "thermal", "curve", tmp_path / "r.csv", "--range", "20000:25900")
    assert (code, "goes beyond the readings" in err) == (3, True)


def test_a_session_before_a_blackbody(session, tmp_path, capsys):
    """Pictures to a curve, to a pixel field, to an even picture in °C."""
    c, f = tmp_path / "curve.json", tmp_path / "field.npz"
    found = run(capsys, "thermal", "curve", session / "curve.csv", "--model", "planck", "-o", c)
    np.testing.assert_allclose(found["degC_range"], [20, 45], atol=0.05)  # the box is 0.03 K off its middle
    assert found["residual_K"] < 0.01
    uneven = run(capsys, "thermal", "field", session / "field.csv", "--curve", c, "-o", f)
    assert abs(uneven["uneven_K"] - BOWL_K.std() * 1.05) < 0.03
    assert uneven["left_K"] < 0.05 * uneven["uneven_K"]
    np.testing.assert_allclose(read_field(f).correct(33.0 + BOWL_K * 1.06), 33.0, atol=0.06)
    done = run(capsys, "thermal", "flatten", session / "scene.png", "--curve", c, "--field", f, "-o", tmp_path / "flat")
    assert done["after_K"] < 0.04 < done["before_K"]  # a pixel's noise is 38 mK
    even = cv2.imread(str(tmp_path / "flat" / "scene.tiff"), cv2.IMREAD_UNCHANGED)
    assert even.dtype == np.float32
    assert np.abs(cv2.GaussianBlur(even, (0, 0), 4) - 33).max() < 0.05
    again = call(capsys, "thermal", "flatten", session / "scene.png", "--curve", c, "-o", tmp_path / "flat")
    assert again[0] == 3
    assert "it exists already" in again[2]


def test_a_whole_scan_is_flattened(session, tmp_path, capsys):
    scan = make.tiny_scan(frames=6)
    shape = scan.thermal.camera.lens.shape
    bowl = np.linspace(-1, 1, shape[1])[None, :] * np.ones((shape[0], 1))
    write_scan(scan, tmp_path / "scan")
    write_field(tmp_path / "field.npz", PixelField(bowl[None].astype(np.float32)))
    done = run(
        capsys, *("thermal", "flatten", tmp_path / "scan", "--field", tmp_path / "field.npz", "-o", tmp_path / "b")
    )
    assert done["frames"] == 4  # one of five was a shutter frame
    flat = open_scan(tmp_path / "b")
    assert flat.thermal.camera.signal.kind == "apparent_degC"
    np.testing.assert_array_equal(flat.thermal.index, [0, 2, 3, 4])
    expected = np.polynomial.polynomial.polyval(scan.thermal.load(2).astype(float), make.COEFFICIENTS) - bowl
    np.testing.assert_allclose(flat.thermal.load(1), expected, atol=1e-5)


def test_netd_drift_and_the_allan_plot(tmp_path, capsys):
    rng, t = np.random.default_rng(1), np.arange(120) / 10
    (tmp_path / "still").mkdir()
    pattern = rng.normal(0, 1, (H, W))
    for i, s in enumerate(t):
        frame = (30 + pattern + 0.6 * s / 60 + rng.normal(0, 0.05, (H, W))).astype(np.float32)
        cv2.imwrite(str(tmp_path / "still" / f"{i:03d}.tiff"), frame)
    plot = tmp_path / "noise.svg"
    found = run(capsys, "thermal", "noise", tmp_path / "still", "--rate", 10, "-o", plot)
    assert abs(found["netd_K"] / 0.05 - 1) < 0.03
    assert abs(found["drift_K_per_min"] - 0.6) < 0.02
    assert found["even_frames"] == found["frames"] == 120
    tau, allan = np.array(found["tau_s"]), np.array(found["allan_K"])
    white, ramp = 0.05 / np.sqrt(tau / 0.1), 0.01 * tau / np.sqrt(2)
    np.testing.assert_allclose(allan, np.hypot(white, ramp), rtol=0.05)
    assert "averaging time, s" in plot.read_text()
    assert found["moving_share"] == 0
    code, _, err = call(capsys, "thermal", "noise", tmp_path / "still")
    assert code == 3
    assert "--rate" in err


def test_a_scene_that_was_not_still_is_told(tmp_path, capsys):
    write_scan(waved(0.0), tmp_path / "scan")
    code, _, err = call(capsys, "thermal", "noise", tmp_path / "scan")
    assert code == 0
    assert "was the scene still?" in err


def test_the_point_spread_needs_no_curve(tmp_path, capsys):
    v, u = np.mgrid[0:100, 0:120]
    edge = 20_000 + 3000 * ndtr((u - 60 - 0.11 * (v - 50)) / np.hypot(1, 0.11) / 1.3)
    edge += np.random.default_rng(0).normal(0, 10, edge.shape)
    cv2.imwrite(str(tmp_path / "edge.png"), np.round(edge).astype(np.uint16))
    found = run(capsys, "thermal", "edge", tmp_path / "edge.png", "--box", "30,25,60,50")
    assert abs(found["sigma_px"] / 1.3 - 1) < 0.02
    assert found["contrast_unit"] == "counts"
    upright = 20_000 + 3000 * ndtr((u - 60.0) / 1.3)
    cv2.imwrite(str(tmp_path / "upright.png"), np.round(upright).astype(np.uint16))
    code, _, err = call(capsys, "thermal", "edge", tmp_path / "upright.png", "--box", "30,25,60,50")
    assert code == 3
    assert "runs along the pixels" in err


@pytest.mark.parametrize("offset_s", [-0.12, 0.07])
def test_the_clock_from_a_waved_hand(offset_s, tmp_path, capsys):
    """A warm block waved before a wall, as a native scan: depth at 30 Hz, thermal at 9 Hz, late by offset_s."""
    write_scan(waved(offset_s), tmp_path / "scan")
    found = run(capsys, "thermal", "time-offset", tmp_path / "scan")
    assert abs(found["time_offset_s"] - offset_s) < max(3 * found["sigma_s"], 0.003)
    assert found["sigma_s"] < 0.005
    assert found["scan_time_offset_s"] == 0
    still = waved(offset_s, reach_m=0.0)
    write_scan(still, tmp_path / "still")
    code, _, err = call(capsys, "thermal", "time-offset", tmp_path / "still")
    assert code == 3
    assert "hardly moves" in err


def waved(offset_s, reach_m=0.2):
    """A block of 12 x 12 cm at 1 m, its centre drawn with a sub-pixel edge, before a wall at 2 m."""
    depth_cam, thermal_cam = make.camera(160, 120, 146.0), make.camera(160, 120, 200.0)
    td, tt = np.arange(0, 8, 1 / 30), np.arange(0, 8, 1 / 9) + 0.004

    def center(t):
        return np.array([reach_m * np.sin(2.5 * t), 0.5 * reach_m * np.cos(3.7 * t), 1.0 + 0.2 * reach_m * np.sin(t)])

    def block(cam, c, shift):
        u, v = np.arange(cam.width_px), np.arange(cam.height_px)
        f, edge = cam.K[0, 0], 0.06 * cam.K[0, 0] / c[2]
        a = np.clip(edge + 0.5 - np.abs(u - cam.K[0, 2] - f * (c[0] + shift[0]) / c[2]), 0, 1)
        b = np.clip(edge + 0.5 - np.abs(v - cam.K[1, 2] - f * (c[1] + shift[1]) / c[2]), 0, 1)
        return b[:, None] * a[None, :]

    def depth(i):
        c = center(td[i])
        return np.where(block(depth_cam, c, (0, 0)) > 0.5, c[2], 2.0).astype(np.float32)

    def thermal(i):
        rng = np.random.default_rng(i)
        warm = 22 + 12 * block(thermal_cam, center(tt[i] + offset_s), (0.02, -0.05))
        return (warm + rng.normal(0, 0.05, warm.shape)).astype(np.float32)

    T = np.eye(4)
    T[:3, 3] = 0.02, -0.05, 0
    tiny = make.tiny_scan()
    camera = ThermalCamera(thermal_cam, T, SignalCurve("apparent_degC"))
    return replace(
        tiny,
        rig=Rig(depth_cam),
        depth=make.stream([depth(i) for i in range(len(td))], td),
        color=None,
        thermal=as_thermal(make.stream([thermal(i) for i in range(len(tt))], tt), camera),
        references=(),
        trajectory=None,
    )


def test_a_rig_says_when_what_the_counts_mean_and_how_late(session, tmp_path, capsys):
    rig = SimulatedRig()
    data, _, _ = simulate_set(rig, 3, views=10, with_depth=False)
    for camera in ("color", "thermal"):
        (tmp_path / camera).mkdir()
        w, h = data.image_size[camera]
        for view in data.views:
            cv2.imwrite(str(tmp_path / camera / f"{view.name}.png"), np.zeros((h, w), np.uint8))
            os.utime(tmp_path / camera / f"{view.name}.png", (1_777_900_000, 1_777_900_000))
    (tmp_path / "picks.csv").write_text(picks_csv(data))
    b = rig.board
    board = {"kind": b.kind, "columns": b.columns, "rows": b.rows, "spacing_m": b.spacing_m}
    (tmp_path / "calibration.json").write_text(json.dumps({"board": board, "picks": "picks.csv"}))
    run(capsys, "thermal", "curve", session / "curve.csv", "--model", "planck", "-o", tmp_path / "curve.json")
    out = tmp_path / "rig.json"
    options = ("--curve", tmp_path / "curve.json", "--time-offset-s", 0.07, "-o", out)
    found = run(capsys, "calibrate", tmp_path, *options)
    assert found == json.loads(out.read_text())
    assert found["date"] == "2026-05-04"  # of the newest picture
    assert found["cameras"]["thermal"]["time_offset_s"] == 0.07
    assert found["cameras"]["thermal"]["signal"]["curve"]["type"] == "planck"
    assert found["radiometry"]["residual_K"] < 0.01
    code, _, err = call(capsys, "calibrate", tmp_path, "--date", "May", "-o", out)
    assert code == 2
    assert "ISO 8601" in err


def test_a_rig_without_a_curve_leaves_the_scans_own(tmp_path):
    scan = make.tiny_scan()
    camera = {"width_px": 56, "height_px": 40, "K": [[51.0, 0, 27], [0, 51, 20], [0, 0, 1]]}
    (tmp_path / "rig.json").write_text(json.dumps({"cameras": {"thermal": {**camera, "time_offset_s": 0.07}}}))
    joined = with_rig(scan, tmp_path / "rig.json")
    assert joined.thermal.camera.lens.K[0, 0] == 51
    ours, own = vars(joined.thermal.camera).copy(), vars(replace(scan.thermal.camera, time_offset_s=0.07)).copy()
    assert ours.pop("lens") is not own.pop("lens")
    np.testing.assert_array_equal(ours.pop("T_thermal_depth"), own.pop("T_thermal_depth"))
    assert ours == own


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["curve", "nowhere.csv"], 3, ["nowhere.csv", "absent"]),
        (["curve", "noise.svg"], 3, ["counts,degC or file,degC"]),
        (["curve", "letters.csv"], 3, ["line 3", "numbers"]),
        (["curve", "three.csv"], 3, ["three.csv", "3 different blackbody readings", "6 are the least"]),
        (["curve", "missing.csv"], 3, ["gone.png", "no such picture"]),
        (["curve", "outside.csv"], 3, ["leaves"]),
        (["curve", "three.csv", "--model", "cubic"], 2, ["cubic", "planck"]),
        (["curve", "three.csv", "--range", "9:1"], 2, ["low < high"]),
        (["field", "three.csv"], 3, ["pictures that the source fills"]),
        (["field", "pictures.csv"], 3, ["counts need a radiometric curve", "--curve"]),
        (["noise", "nowhere"], 3, ["no such picture or recording"]),
        (["noise", "a.png", "--curve", "three.csv"], 3, ["JSON"]),
        (["noise", "a.png", "-o", "noise.jpeg"], 2, [".svg"]),
        (["noise", "a.tiff", "--rate", "9", "-o", "x.svg"], 3, ["a.tiff", "1 frame: too few"]),
        (["noise", "mixed", "--rate", "9"], 3, ["b.tiff", "is 40 x 60 px, expected 80 x 60"]),
        (["edge", "grey8.png"], 3, ["uint8", "16-bit"]),
        (["edge", "a.png"], 3, ["a.png", "edge"]),
        (["edge", "a.png", "--box", "1,2,3"], 2, ["LEFT,TOP,WIDTH,HEIGHT"]),
        (["edge", "a.png", "--box", "0,0,500,20"], 3, ["beyond the picture"]),
        (["edge", "a.raw"], 3, ["--raw"]),
        (["edge", "a.raw", "--raw", "80by60"], 2, ["640x480"]),
        (["edge", "a.raw", "--raw", "80x60"], 3, ["too few"]),
        (
            ["flatten", "a.tiff", "--field", "three.csv", "-o", "x"],
            3,
            ["pixel field", "thermal field READINGS.csv"],
        ),
        (["flatten", "a.tiff", "--field", "small.npz", "-o", "x"], 3, ["of 3 x 2 px"]),
        (["time-offset", "a.png"], 3, ["no known recording format"]),
    ],
)
def test_errors_are_one_sentence(arguments, code, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("noise.svg").write_text("<svg/>")
    Path("letters.csv").write_text("counts,degC\n1,2\nx,3\n")
    Path("three.csv").write_text("counts,degC\n1000,20\n1100,21\n1200,22\n")
    Path("missing.csv").write_text("file,degC\ngone.png,20\n")
    Path("outside.csv").write_text("file,degC\n../gone.png,20\n")
    Path("pictures.csv").write_text("file,degC\na.png,20\na.png,30\n")
    cv2.imwrite("a.png", np.full((H, W), 20_000, np.uint16))
    cv2.imwrite("a.tiff", np.full((H, W), 20, np.float32))
    cv2.imwrite("grey8.png", np.zeros((H, W), np.uint8))
    Path("a.raw").write_bytes(b"12")
    Path("mixed").mkdir()
    cv2.imwrite("mixed/a.tiff", np.full((H, W), 20, np.float32))
    cv2.imwrite("mixed/b.tiff", np.full((H, W // 2), 20, np.float32))
    write_field(Path("small.npz"), PixelField(np.zeros((2, 2, 3), np.float32)))
    before = set(tmp_path.iterdir())
    got, out, err = call(capsys, "thermal", *arguments)
    assert (got, out) == (code, ""), err
    *progress, error = err.strip().splitlines()
    assert error.startswith("error: ")
    assert not [line for line in progress if "done in" not in line]
    for word in words:
        assert word in error
    assert set(tmp_path.iterdir()) == before


def test_the_authors_field_flattens_a_real_frame(shared_data, tmp_path, capsys):
    """Their per-pixel polynomial (what has to be added) and curve, on a real frame of big-endian counts."""
    folder = shared_data("jhu")
    stored = scipy.io.loadmat(folder / "radiometry" / "0301_BB_Calibration_Polynimial.mat")["poly"].ravel()[::-1]
    z = [scipy.io.loadmat(folder / "radiometry" / f"0301_z{k}.mat")[f"z{k}"] for k in (1, 2, 3, 4)]
    write_field(tmp_path / "field.npz", PixelField(-np.stack(z).astype(np.float32)))
    document = {
        "schema": "thermofusion-curve/1",
        "signal": {"kind": "counts", "curve": {"type": "polynomial", "coefficients_degC": stored.tolist()}},
        **{"counts_range": [23_800, 25_900], "residual_K": 0.0, "sigma_K": 0.0},
    }
    (tmp_path / "curve.json").write_text(json.dumps(document))
    frame = folder / "calibration" / "0000_0000.raw"
    options = ("--raw", "632x476,big", "--curve", tmp_path / "curve.json")
    for name, more in (("plain", ()), ("flat", ("--field", tmp_path / "field.npz"))):
        run(capsys, "thermal", "flatten", frame, *options, *more, "-o", tmp_path / name)

    def spread(name):
        T = cv2.imread(str(tmp_path / name / "0000_0000.tiff"), cv2.IMREAD_UNCHANGED)
        return float(cv2.GaussianBlur(np.nan_to_num(T, nan=np.nanmedian(T)), (0, 0), 8).std())

    assert spread("flat") < spread("plain") / 4
