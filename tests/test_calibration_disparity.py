"""A folder of 11-bit disparity pictures, bent as Herrera's model says, to a rig: everything within its interval."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from support.simulated_disparity import NONE, disparity_image, true_parameters
from support.simulated_rig import SimulatedRig, picks_csv, simulate_set

from thermofusion.calibration import calibrate, rig_document
from thermofusion.calibration.fit.cameras import to_rt
from thermofusion.calibration.fit.depth_model import DisparityDepth
from thermofusion.calibration.folder import open_folder
from thermofusion.errors import ScanError

VIEWS = 14
RIG, MODEL = SimulatedRig(), DisparityDepth((640, 480))
THETA = true_parameters(MODEL, 1000)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("kinect")
    data, _, poses = simulate_set(RIG, 0, views=VIEWS, with_depth=False)
    for camera, (w, h) in data.image_size.items():
        (root / camera).mkdir()
        for view in data.views:
            cv2.imwrite(str(root / camera / f"{view.name}.png"), np.zeros((h, w), np.uint8))
    (root / "disparity").mkdir()
    for i, (view, T) in enumerate(zip(data.views, poses, strict=True)):
        cv2.imwrite(str(root / "disparity" / f"{view.name}.png"), disparity_image(RIG, T, MODEL, THETA, i))
    (root / "picks.csv").write_text(picks_csv(data))
    b = RIG.board
    config = {
        "board": {"kind": b.kind, "columns": b.columns, "rows": b.rows, "spacing_m": b.spacing_m},
        "files": {"color": "color/*.png", "thermal": "thermal/*.png", "depth": "disparity/*.png"},
        "depth": {"kind": "disparity"},  # and a lens that nobody knows: a Kinect's field of view is the first guess
        "picks": "picks.csv",
    }
    (root / "calibration.json").write_text(json.dumps(config))
    return root


@pytest.fixture(scope="module")
def calibrated(folder):
    return calibrate(folder).calibration


def test_depth_model_and_rig_come_back_within_their_intervals(calibrated):
    c = calibrated
    assert c.fit.converged
    found, sigma = c.fit.block("depth_model"), np.sqrt(np.diag(c.fit.block_covariance("depth_model")))
    z = [(found - THETA) / sigma]
    assert (sigma[:2] < [0.02, 3e-5]).all()  # the boards tell, not the prior (0.15 and 1.5e-4)
    for name in ("color", "thermal"):
        key = f"T_{name}_depth"
        se = np.sqrt(np.diag(c.extrinsic_covariance[key]))
        assert (1e3 * se[3:] < 8).all()
        z.append((to_rt(c.extrinsics[key]) - to_rt(RIG.T_camera_depth(name))) / se)
    z = np.abs(np.concatenate(z))
    assert np.mean(z < 1.96) >= 0.85
    assert z.max() < 3.5


def test_depth_is_true_after_and_was_not_before(calibrated):
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(140, 500, 9), np.linspace(110, 370, 7)))
    for distance in (1.0, 1.3, 1.6):
        true = np.full(len(u), distance)
        d = MODEL.to_disparity(THETA, true, u, v)
        after = MODEL.to_depth_m(calibrated.fit.block("depth_model"), d, u, v) - true
        before = MODEL.to_depth_m(MODEL.start(), d, u, v) - true
        assert np.sqrt(np.mean(after**2)) < 4e-3
        assert np.sqrt(np.mean(before**2)) > 4 * np.sqrt(np.mean(after**2))


def test_the_rig_file_tells_the_disparity_model(calibrated):
    correction = rig_document(calibrated)["depth_correction"]
    assert correction["model"] == "disparity"
    assert list(correction["parameters"])[:3] == ["c0", "c1", "decay"]


def test_what_the_kinect_did_not_see_is_nan(folder):
    image = open_folder(folder).depth("0000")
    raw = cv2.imread(str(folder / "disparity" / "0000.png"), cv2.IMREAD_UNCHANGED)
    assert (raw == NONE).any()
    np.testing.assert_array_equal(np.isnan(image), raw == NONE)
    np.testing.assert_array_equal(image[raw < NONE], raw[raw < NONE])


def test_eight_bit_disparity_is_refused(folder, tmp_path):
    config = json.loads((folder / "calibration.json").read_text()) | {"files": {"depth": "*.png"}, "picks": None}
    cv2.imwrite(str(tmp_path / "0000.png"), np.zeros((480, 640), np.uint8))
    with pytest.raises(ScanError, match=r"0000\.png: disparity is uint8"):
        open_folder(tmp_path, config=config).depth("0000")
