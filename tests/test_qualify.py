"""A camera's qualification on simulated blackbody recordings: each figure against what was put in, derived apart."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from test_cli_calibration import call, run

from thermofusion.calibration.thermal.qualify import Shown, figures_of, qualify

H, W, RATE_HZ, NETD_K = 44, 55, 8.0, 0.06


def shown(seed=0, degC=35.0, error_K=0.0, drift=0.0, pattern_K=0.0, jumps=(), frames=400, sag_K=0.0):
    """A source that fills the part: an error, a drift in K/min, a fixed pattern, shutter jumps [(frame, K)]."""
    rng, t = np.random.default_rng(seed), np.arange(frames) / RATE_HZ
    pattern = pattern_K * rng.normal(size=(H, W))
    level = degC + error_K + drift * (t - t.mean()) / 60
    for at, size in jumps:
        level = level + size * (np.arange(frames) >= at)
        level = level + sag_K * ((t >= t[at]) & (t < t[at] + 1.0))
    images = (x + pattern + rng.normal(0, NETD_K, (H, W)) for x in level)
    return Shown(f"source {seed}", degC, images, t, np.zeros(frames, bool))


def test_each_figure_is_what_was_put_in():
    s = figures_of(shown(error_K=0.12, drift=0.5, pattern_K=0.03))
    n, pixels = 400, H * W
    assert s.error_K == pytest.approx(0.12, abs=0.004)  # the pattern's own mean is .03/49
    # least squares: variance of a slope is sigma²/Σ(t - mean)²; Σ of n even steps is n (n² - 1)/12 of a step²
    spread = np.sqrt(n * (n**2 - 1) / 12) / RATE_HZ / 60
    assert s.drift_sigma_K_per_min == pytest.approx(NETD_K / np.sqrt(pixels) / spread, rel=0.1)
    assert abs(s.drift_K_per_min - 0.5) < 3 * s.drift_sigma_K_per_min
    assert s.stability_K == pytest.approx(NETD_K / np.sqrt(pixels), rel=0.1)
    assert s.netd_K == pytest.approx(NETD_K, rel=0.02)
    assert s.uniformity_K == pytest.approx(0.03, rel=0.05)
    # between percentiles 0.5 and 99.5 of a Gaussian lie 2·2.5758 sigmas; noise of the mean adds a tenth of a per cent
    assert s.range_K == pytest.approx(2 * 2.5758 * np.hypot(0.03, NETD_K / np.sqrt(n)), rel=0.06)
    for side in (1, 3, 5, 11):
        assert s.resolvable_K[str(side)] == pytest.approx(1.96 * np.sqrt(2) * np.hypot(0.03, NETD_K) / side, rel=0.2)
    assert s.shutter.events == 0
    assert s.shutter.between_K_per_min == pytest.approx(0.5, abs=0.02)


def test_the_shutter_is_found_by_its_jumps_and_its_first_second_told():
    jumps = ((100, 0.4), (200, -0.3), (320, 0.2))
    r = figures_of(shown(jumps=jumps, sag_K=0.05)).shutter
    assert r.events == 3
    assert r.first_K == pytest.approx(0.05, rel=0.05)
    s = figures_of(shown(jumps=jumps)).shutter
    assert s.events == 3
    assert s.jump_K == pytest.approx(np.sqrt((0.16 + 0.09 + 0.04) / 3), rel=0.02)
    assert s.largest_K == pytest.approx(0.4, rel=0.02)
    assert abs(s.first_K) < 0.002
    frames = shown()
    marked = np.zeros(400, bool)
    marked[150] = True
    told = figures_of(Shown("marked", 35.0, frames.frames, frames.times_s, marked)).shutter
    assert told.events == 1
    assert told.jump_K < 0.002


def test_recordings_repeat_and_two_sources_differ():
    errors = (0.02, -0.01, 0.05, 0.3)
    groups = [[shown(k, 35.0, e, frames=60)] for k, e in enumerate(errors[:3])] + [[shown(9, 40.0, 0.3, frames=60)]]
    found = qualify(groups, 0.05)
    assert found.repeatability_freedom == 2
    assert found.repeatability_K == pytest.approx(np.std(errors[:3], ddof=1), rel=0.03)
    assert found.accuracy_K == pytest.approx(0.3, abs=0.003)
    alone = qualify([[shown(frames=60)]], 0.05)
    assert (alone.repeatability_freedom, np.isnan(alone.repeatability_K)) == (0, True)
    (pair,) = qualify([[shown(1, 35.0, 0.1, frames=200), shown(2, 35.2, 0.15, frames=200)]], 0.05).pairs
    assert pair.true_K == pytest.approx(0.2)
    assert pair.error_K == pytest.approx(0.05, abs=0.001)
    assert pair.noise_K == pytest.approx(NETD_K * np.sqrt(2 / (H * W)), rel=0.15)


def test_the_verb_reads_a_session_and_writes_figures_and_a_page(tmp_path, capsys):
    for name, error in (("a", 0.1), ("b", 0.14)):
        (tmp_path / name).mkdir()
        for i, frame in enumerate(shown(3, 35.0, error, frames=30).frames):
            cv2.imwrite(str(tmp_path / name / f"{i:03d}.tiff"), frame.astype(np.float32))
    rows = "file,degC,left_px,top_px,width_px,height_px\na/,35,2,2,20,20\na/,35,30,2,20,20\nb/,35,2,2,20,20\n"
    (tmp_path / "s.csv").write_text(rows)
    out = tmp_path / "q.json"
    told = run(capsys, "thermal", "qualify", tmp_path / "s.csv", "--rate", RATE_HZ, "-o", out)
    assert told == json.loads(out.read_text())
    assert told["accuracy_K"] == pytest.approx(0.14, abs=0.005)
    assert told["repeatability_K"] == pytest.approx(0.04 / np.sqrt(2), rel=0.05)
    assert len(told["pairs"]) == 1
    page = (tmp_path / "q.html").read_text()
    assert "no conformity is claimed" in " ".join(page.split()).replace("&#x27;", "'")
    assert page.count("<svg") >= 1
    code, _, err = call(capsys, "thermal", "qualify", tmp_path / "s.csv")
    assert code == 3
    assert "--rate" in err
    (tmp_path / "c.csv").write_text("counts,degC\n20000,35\n")
    code, _, err = call(capsys, "thermal", "qualify", tmp_path / "c.csv")
    assert code == 3
    assert "rows file,degC" in err
