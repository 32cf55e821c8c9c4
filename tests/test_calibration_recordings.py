"""The paper's own 24 triplets, with hand picks (the recording is not part of the repository)."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from thermofusion.calibration import calibrate, calibrate_views, held_out_px, predict_px
from thermofusion.calibration.board.picks import interpolated

CONFIG = {
    "board": {"kind": "pins", "columns": 9, "rows": 9, "spacing_m": 0.04},  # the authors' assumption, twice too small
    "files": {"color": "*.jpg", "thermal": "*_0000.raw", "depth": "*.pgm"},
    "depth": {"invalid": [0, 3975]},
    "thermal_raw": {"width_px": 632, "height_px": 476, "big_endian": True},
    "free_spacing": True,
}


@pytest.fixture(scope="module")
def picked(shared_data):
    folder = shared_data("jhu") / "calibration"
    return calibrate(folder, config=CONFIG, picks=folder / "picks.mat")


def test_cameras_alone_and_a_rig_that_was_knocked(picked):
    c = picked.calibration
    assert c.single["color"].rms_px < 0.9
    assert c.single["thermal"].rms_px < 0.65
    assert not c.single["color"].uses_k3
    assert c.grouping is not None
    assert max(c.grouping.outliers, key=lambda n: c.grouping.outliers[n]) == "0017"
    assert c.grouping.count >= 2
    for k in range(c.grouping.count):
        assert c.fit.rms_px("thermal", set(c.grouping.names(k))) < 1.5
    for name in ("color", "thermal"):
        f = c.fit.block(name)[:2] / c.single[name].intrinsics[:2]
        assert np.abs(f - 1).max() < 0.03
        assert np.abs(c.fit.block(name)[2:4] - c.single[name].intrinsics[2:4]).max() < 30


def test_square_size_and_the_side_of_the_depth_camera(picked):
    c = picked.calibration
    assert abs(c.spacing_m - 0.0762) < 0.0008
    t, s = c.extrinsics["T_color_depth"][0, 3], np.sqrt(c.extrinsic_covariance["T_color_depth"][3, 3])
    assert abs(t + 0.025) < 0.012  # the colour lens of a Kinect sits 25 mm to the right of its infrared lens
    assert t + 3 * s < 0  # ... not to the left


def test_boards_held_out_are_predicted(picked):
    """Named before fitting, two of each run; as a training view has its residual, from both cameras, and from colour
    alone against training views predicted from colour alone."""
    held = {"0005", "0021", "0029", "0033"}
    data = picked.calibration.data
    c = calibrate_views(data.named({v.name for v in data.views} - held))
    for name in sorted(held):
        view, k, training = _neighbours(c, data, name)
        residual = c.fit.rms_px("thermal", {v.name for v in training})
        assert _rms(held_out_px(c, view, group=k)) < 1.5 * residual
        one_eyed = np.concatenate([predict_px(c, v, group=k) for v in training])
        assert _rms(predict_px(c, view, group=k)) < 1.5 * _rms(one_eyed)


def test_most_hand_picks_are_no_observations(picked):
    """Four corners were clicked and a homography laid on them: such points cannot be held against what is seen."""
    views = [v for v in picked.calibration.data.views if "thermal" in v.points]
    shares = [interpolated(v.points["thermal"], picked.calibration.data.board).mean() for v in views]
    assert np.median(shares) > 0.6
    assert any("thermal picks" in text and "interpolated" in text for text in picked.advice)
    seen = picked.calibration.data.views[0].points["thermal"]
    noisy = replace(seen, px=seen.px + np.random.default_rng(0).normal(0, 0.2, seen.px.shape))
    assert interpolated(noisy, picked.calibration.data.board).mean() < 0.2


@pytest.fixture(scope="module")
def detected(shared_data):
    return calibrate(shared_data("jhu") / "calibration", config=CONFIG)


def test_pins_are_found_without_picks(detected, picked):
    """The pins, not the picks: a homography for each view, all that four clicks can get wrong, takes up the rest."""
    views = {v.name: v.points["thermal"] for v in detected.calibration.data.views if "thermal" in v.points}
    board = detected.calibration.data.board
    assert sum(len(board) - len(r) > 60 for r in detected.rejected_px["thermal"].values()) >= 16
    assert not any("interpolated" in text for text in detected.advice)
    assert any("in one housing they stand side by side" in note for note in detected.calibration.notes)
    hand = {v.name: v.points["thermal"] for v in picked.calibration.data.views if "thermal" in v.points}
    apart = []
    for name in sorted(hand.keys() & views.keys()):
        p = views[name]
        q = hand[name].px[np.searchsorted(hand[name].index, p.index)]
        H = cv2.findHomography(q, p.px, cv2.LMEDS)[0]
        apart.append(np.linalg.norm(cv2.perspectiveTransform(q[:, None], H)[:, 0] - p.px, axis=1))
    assert len(apart) >= 12
    assert np.median(np.concatenate(apart)) < 0.8


def test_detected_boards_held_out_are_predicted_from_colour_alone(detected):
    """The strictest reading: the pose from the colour picture only, against the residual of views that were fitted."""
    held = {"0006", "0022", "0028", "0034"}
    data = detected.calibration.data
    c = calibrate_views(data.named({v.name for v in data.views} - held))
    for name in sorted(held):
        view, k, training = _neighbours(c, data, name)
        assert _rms(predict_px(c, view, group=k)) < 1.5 * c.fit.rms_px("thermal", {v.name for v in training})


def _neighbours(c, data, name):
    """A view left out of a calibration, the run it lies in, and the views of that run."""
    k = c.grouping.group[max(n for n in c.grouping.group if n < name)]
    training = [v for v in c.data.views if v.name in c.grouping.names(k)]
    return next(v for v in data.views if v.name == name), k, training


def _rms(e: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(e**2, axis=1))))
