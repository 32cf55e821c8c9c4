"""The lens scatter measured by itself: hot targets through the phantom's lens, files, and what `run` makes of it."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_scatter import CAMERA, found_in, spread_by

from thermofusion.calibration.rig_file import read_rig
from thermofusion.calibration.thermal.scatter import measure_scatter, read_scatter
from thermofusion.cli import main
from thermofusion.diagnosis.radiation import of_lens
from thermofusion.errors import ScanError
from thermofusion.mapping.scatter import check_scatter
from thermofusion.phantom.scattering import BLOCK_PX, scattered, wide_camera
from thermofusion.phantom.scene import ScatterConfig, scene_from_mapping
from thermofusion.phantom.thermal_cameras import thermal_camera
from thermofusion.physics.band import Band
from thermofusion.physics.scatter import WIDTHS, on_widths
from thermofusion.scans.native.schema import RigDoc, thermal_camera_of
from thermofusion.types import LensScatter

BAND = Band(7.5, 13.5)
MODEL = thermal_camera(scene_from_mapping({"thermal": {"preset": "p3"}}).thermal)
H, W = MODEL.camera.shape
TARGETS = {
    "plate": lambda u, v: (abs(u - 0.55 * W) < 0.2 * W) & (abs(v - 0.45 * H) < 0.2 * W),
    "disc": lambda u, v: np.hypot(u - 0.35 * W, v - 0.55 * H) < 0.1 * W,
    "half": lambda u, v: u - 0.5 * W + 0.1 * (v - H / 2) > 0,
}


def picture(target: str, share: float = 0.0, width: float = 0.1, kernel: str = "gaussian", seed: int = 0) -> np.ndarray:
    """A target of 55 °C before a wall of 23 °C that is a little uneven, (H, W) in apparent °C."""
    seen = lambda u, v: BAND.radiance(273.15 + np.where(TARGETS[target](u, v), 55.0, 23.0 + 0.1 * u / W))  # noqa: E731
    v, u = np.mgrid[:H, :W]
    image = seen(u, v).astype(np.float32)
    if share:
        wide = wide_camera(MODEL.camera)
        place = lambda n, before: (np.arange(n) - before // BLOCK_PX) * BLOCK_PX + (BLOCK_PX - 1) / 2  # noqa: E731
        beyond = seen(*np.meshgrid(place(wide.width_px, W), place(wide.height_px, H))).astype(np.float32)
        image = scattered(image, beyond, (ScatterConfig(share, width, kernel),), (H, W))
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    noise = np.random.default_rng(seed).normal(0, 0.01, image.shape)
    return BAND.temperature_K(image.astype(float)) - 273.15 + noise


@pytest.mark.parametrize("kernel", ["gaussian", "exponential"])
@pytest.mark.parametrize("targets", [["plate"], ["half"], ["plate", "disc"]], ids="+".join)
def test_hot_targets_tell_the_share_within_its_sigma(targets, kernel):
    for share in (0.01, 0.02):
        found = measure_scatter([picture(t, share, 0.07, kernel) for t in targets], BAND)
        assert abs(found.scatter.share - share) < 2 * found.scatter.sigma
        assert found.scatter.sigma < 0.25 * share
        assert found.scatter.stated
        assert found.contrast_K == pytest.approx(32, abs=1)
    if targets == ["half"]:
        assert found.unseen > 1e-4  # half of the plane lies beyond the picture
    else:
        assert found.unseen < 1e-4


def test_an_ideal_lens_spreads_nothing_and_a_lukewarm_one_is_refused():
    found = measure_scatter([picture("plate"), picture("disc", seed=1)], BAND)
    assert found.scatter.share < 5e-4
    assert found.scatter.share < found.scatter.sigma
    cold = 23 + (picture("plate") - 23) / 10
    with pytest.raises(ScanError, match="5 K warmer"):
        measure_scatter([cold], BAND)


def test_the_verb_writes_it_where_rig_and_scan_keep_it(tmp_path, capsys):
    for name in ("plate", "disc"):
        cv2.imwrite(str(tmp_path / f"{name}.tiff"), picture(name, 0.02).astype(np.float32))
    K = [[100.0, 0, 127.5], [0, 100.0, 95.5], [0, 0, 1]]
    lens = {"width_px": W, "height_px": H, "K": K}
    rig = {"schema": "thermofusion-rig/1", "cameras": {"depth": lens, "thermal": lens}, "notes": ["kept"]}
    rig["extrinsics"] = {"T_thermal_depth": np.eye(4).tolist()}
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    out = ["-o", str(tmp_path / "s.json"), "--rig", str(tmp_path / "rig.json"), "--json"]
    with pytest.raises(SystemExit) as left:
        main(["thermal", "scatter", str(tmp_path / "plate.tiff"), str(tmp_path / "disc.tiff"), *out])
    assert left.value.code == 0
    told = json.loads(capsys.readouterr().out)
    kept = read_scatter(tmp_path / "s.json")
    assert kept.share == pytest.approx(0.02, rel=0.1)
    # beyond 30 px of a Gaussian of 25.6 px: exp(-r²/2s²) of the share
    assert told["beyond"]["30"] == pytest.approx(0.02 * np.exp(-0.5 * (30 / 25.6) ** 2), rel=0.1)
    document = read_rig(tmp_path / "rig.json").document
    assert document["notes"] == ["kept"]
    doc = RigDoc.model_validate(document)
    camera = thermal_camera_of(doc.cameras.thermal, doc.extrinsics, tmp_path)
    assert camera.scatter == kept
    (tmp_path / "s.json").write_text('{"schema": "thermofusion-scatter/1", "scatter": {"parts": [], "sigma": 0.1}}')
    with pytest.raises(ScanError, match="parts"):
        read_scatter(tmp_path / "s.json")


def test_a_stated_kernel_is_taken_as_it_is_and_one_that_the_halo_contradicts_is_said():
    background, _ = found_in(spread_by(((0.02, 30.0),)))
    width = CAMERA.lens.width_px
    right = LensScatter(((0.02, 30.0 / width),), 0.001, stated=True)
    assert check_scatter(background, CAMERA.lens, BAND, right) == right
    assert of_lens(right) == []
    wrong = replace(right, parts=((0.005, 30.0 / width),))
    checked = check_scatter(background, CAMERA.lens, BAND, wrong)
    assert checked.parts == wrong.parts
    assert checked.differs == pytest.approx(0.015, rel=0.2)
    assert checked.sigma == pytest.approx(abs(checked.differs), rel=0.05)
    (said,) = of_lens(checked)
    assert "0.5 % are stated" in said.evidence


def test_any_width_is_put_on_the_dictionary_with_its_light_and_its_size():
    shares = on_widths(LensScatter(((0.01, 0.045), (0.02, 0.1)), 0.0))
    assert shares.sum() == pytest.approx(0.03)
    assert shares @ np.square(WIDTHS) == pytest.approx(0.01 * 0.045**2 + 0.02 * 0.1**2)
    assert on_widths(LensScatter(((0.01, 0.5),), 0.0)).tolist() == [0, 0, 0, 0, 0.01]
