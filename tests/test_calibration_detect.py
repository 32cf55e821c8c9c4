"""Boards printed and found again; pins in thermal pictures; folders read; bad pictures refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.simulated_pictures import Pictures, sensor_pattern, thermal_picture
from support.simulated_rig import Noise, SimulatedRig, picks_csv, plane_depth, simulate_set, true_pixels

from thermofusion.calibration import Board, board_pdf, board_svg, calibrate
from thermofusion.calibration.board.picks import read_picks_csv
from thermofusion.calibration.board.print import draw_board
from thermofusion.calibration.board.views import BoardPoints, BoardView, CalibrationSet
from thermofusion.calibration.detect.blobs import detect_blobs
from thermofusion.calibration.detect.color import detect_color
from thermofusion.calibration.detect.dropouts import register_dropouts
from thermofusion.calibration.detect.thermal import complete, find_shift, spot_map
from thermofusion.calibration.fit.rounds import detect_thermal_set
from thermofusion.calibration.fit.single import fit_camera
from thermofusion.errors import RecipeError, ScanError

DATA = Path(__file__).parent / "data"
BOARDS = [
    Board("checkerboard", 9, 6, 0.025),
    Board("pins", 9, 9, 0.025),
    Board("mask", 12, 8, 0.015),
    Board("circles", 7, 5, 0.03),
    Board("asymmetric-circles", 4, 11, 0.02),
    Board("charuco", 8, 6, 0.025, 0.7),
]


def raster(board: Board, px_per_mm: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """A printed board as a picture, and the true pixels of its points."""
    page = draw_board(board)
    s = px_per_mm * 8
    image = np.full((round(page.height_mm * px_per_mm) * 8, round(page.width_mm * px_per_mm) * 8), 255, np.uint8)
    for p in page.polygons:
        cv2.fillPoly(image, [np.round((p * s - 0.5) * 16).astype(np.int32)], 0, cv2.LINE_8, 4)
    for x, y, r, filled in page.circles:
        center = (round((x * s - 0.5) * 16), round((y * s - 0.5) * 16))
        if filled:
            cv2.circle(image, center, round(r * s * 16), 0, -1, cv2.LINE_8, 4)
    image = cv2.GaussianBlur(image, (0, 0), 6)  # no lens draws edges sharper than a pixel
    small = cv2.resize(image, None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)
    w, h = (1e3 * e for e in board.extent_m)
    corner = [(page.width_mm - w) / 2, 8 + (page.height_mm - 22 - 8 - h) / 2]
    return small, (board.points_m[:, :2] * 1e3 + corner) * px_per_mm - 0.5


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
def test_a_printed_board_is_found_where_it_was_drawn(board):
    image, truth = raster(board)
    found = detect_blobs(image, board) if board.kind == "mask" else detect_color(image, board)
    assert found is not None
    assert len(found) == (49 if board.kind == "pins" else len(board))
    error = found.px - truth[found.index]
    if board.kind == "asymmetric-circles":  # looks the same after half a turn: OpenCV counts from the other end
        error = min(error, found.px - truth[found.index][::-1], key=lambda e: np.abs(e).max())
    assert np.abs(error).max() < 0.25


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
def test_printed_files_are_true_to_scale_and_well_formed(board):
    svg, pdf = board_svg(board), board_pdf(board)
    page = draw_board(board)
    assert f'width="{page.width_mm:g}mm"' in svg
    assert svg.count("<polygon") == len(page.polygons)
    bar = [x2 - x1 for x1, y1, x2, y2, _ in page.lines if y1 == y2 and x2 - x1 >= 50]
    assert bar[0] in (50.0, 100.0)
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert box is not None
    np.testing.assert_allclose([float(g) * 25.4 / 72 for g in box.groups()], [page.width_mm, page.height_mm], rtol=1e-5)
    start = int(pdf.rsplit(b"startxref\n", 1)[1].split()[0])
    assert pdf[start : start + 4] == b"xref"
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n", pdf), 1):
        assert pdf[int(offset) :].startswith(b"%d 0 obj" % number)
    assert board_pdf(board) == pdf


def test_a_board_too_big_for_the_paper_is_refused():
    with pytest.raises(RecipeError, match="does not fit A4"):
        board_svg(Board("pins", 9, 9, 0.0762), paper="A4")


def test_heated_mask_boards_of_others():
    board = Board("mask", 12, 8, 0.025)
    points = {p.stem: detect_blobs(cv2.imread(str(p), -1), board) for p in sorted((DATA / "thermalvis").glob("*.png"))}
    assert all(p is not None and len(p) > 90 for p in points.values())
    views = tuple(BoardView(n, {"thermal": p}) for n, p in points.items() if p is not None)
    s = fit_camera(CalibrationSet(board, {"thermal": (640, 480)}, views), "thermal")
    assert s.rms_px < 0.6
    assert abs(s.model.focal_px / 608.5 - 1) < 0.03  # five of the author's twenty pictures


def test_pins_of_both_signs_are_found_to_a_fraction_of_a_pixel():
    rig = SimulatedRig()
    _, _, poses = simulate_set(rig, 0, views=4, with_depth=False)
    look, flawless = Pictures(missing=0.15), np.zeros(rig.thermal.shape, np.float32)
    errors = []
    for i, T in enumerate(poses):
        truth = true_pixels(rig, "thermal", T)
        spots = spot_map(thermal_picture(rig, T, i, look, flawless))
        guess = truth + np.array([9.0, -6.0])
        shift, _ = find_shift(spots, guess, 14)
        np.testing.assert_allclose(shift, [-9, 6], atol=2)
        d = complete(spots, guess + shift)
        assert d.accepted.sum() > 60
        assert d.accepted.sum() <= 0.95 * 81
        errors.append(d.points.px - truth[d.points.index])
    e = np.concatenate(errors)
    assert np.median(np.linalg.norm(e, axis=1)) < 0.15
    assert np.abs(np.mean(e, axis=0)).max() < 0.05


def test_thermal_boards_are_found_from_the_colour_camera_alone():
    rig = SimulatedRig()
    data, _, poses = simulate_set(rig, 4, views=8, with_depth=False)
    look = Pictures()
    pattern = sensor_pattern(rig.thermal, look.thermal_pattern, np.random.default_rng(4))
    pictures = [thermal_picture(rig, T, i, look, pattern) for i, T in enumerate(poses)]
    images = {v.name: picture for v, picture in zip(data.views, pictures, strict=True)}
    blind = replace(
        data,
        image_size={"color": data.image_size["color"]},
        views=tuple(v.with_points("thermal", None) for v in data.views),
    )
    found, _ = detect_thermal_set(blind, images)
    good = 0
    for v, T in zip(found.views, poses, strict=True):
        if "thermal" in v.points:
            p = v.points["thermal"]
            good += np.median(np.linalg.norm(p.px - true_pixels(rig, "thermal", T)[p.index], axis=1)) < 0.2
    assert good >= 7
    burnt = {n: np.minimum(i, i.min() + 2).astype(np.uint16) for n, i in images.items()}
    with pytest.raises(ScanError, match=r"saturated.*temperature range"):
        detect_thermal_set(blind, burnt)


def test_lost_squares_measure_a_shift_of_the_depth_image():
    rig = SimulatedRig()
    T = simulate_set(rig, 0, views=1, with_depth=False)[2][0]
    z = plane_depth(rig, T, 1e-3, 0)
    x = np.linalg.inv(rig.depth.K @ np.column_stack([T[:3, :2], T[:3, 3]]))
    v, u = np.mgrid[0:480, 0:640]
    q = np.einsum("ij,jhw->ihw", x, np.stack([u - 3.0, v + 2.0, np.ones_like(u)]).astype(float))
    a, b = q[0] / q[2] / 0.05, q[1] / q[2] / 0.05
    dark = (a > 0) & (a < 8) & (b > 0) & (b < 8) & ((np.floor(a) + np.floor(b)) % 2 == 0)
    z[dark & (np.random.default_rng(0).random(z.shape) < 0.6)] = np.nan
    found = register_dropouts(z, rig.depth, T, rig.board)
    assert found is not None
    np.testing.assert_allclose(found.shift_px, [3, -2], atol=0.3)


def write_folder(root: Path, kind: str, count: int = 4, board: Board | None = None) -> None:
    board = board or Board("checkerboard", 7, 5, 0.03)
    image, _ = raster(board, 2.0)
    (root / "color").mkdir(parents=True)
    h, w = image.shape
    for i in range(count):
        corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
        tilt = 0.12 * np.array([[i % 2, 0], [-(i % 3) / 2, i % 2], [0, -(i % 2)], [(i % 3) / 2, 0]], np.float32) * h
        H = cv2.getPerspectiveTransform(corners, corners * 0.8 + 0.1 * w + tilt)
        picture = cv2.warpPerspective(image, H, (w, h), borderValue=200)
        if kind == "two":
            picture = np.concatenate([picture, picture], axis=1)
        cv2.imwrite(str(root / "color" / f"{i:02d}.png"), picture)
    config = {"board": {"kind": board.kind, "columns": board.columns, "rows": board.rows, "spacing_m": board.spacing_m}}
    if kind == "size":
        config["board"]["columns"] = 8
    (root / "calibration.json").write_text(json.dumps(config))


def test_bad_folders_say_which_and_what_to_do(tmp_path):
    write_folder(tmp_path / "size", "size")
    with pytest.raises(
        ScanError, match=r"8 x 5 points was found in 0 of 4 color pictures, but one of (7 x 5|5 x 7); check"
    ):
        calibrate(tmp_path / "size")
    write_folder(tmp_path / "two", "two")
    with pytest.raises(ScanError, match=r"two boards are in view in color picture 00; leave one"):
        calibrate(tmp_path / "two")
    with pytest.raises(ScanError, match="no such calibration folder"):
        calibrate(tmp_path / "absent")
    (tmp_path / "bare").mkdir()
    with pytest.raises(ScanError, match="the board is not described"):
        calibrate(tmp_path / "bare")
    (tmp_path / "bare" / "calibration.json").write_text(
        '{"board": {"columns": 3, "rows": 3, "spacing_m": 0.1}, "bord": 1}'
    )
    with pytest.raises(ScanError, match="bord"):
        calibrate(tmp_path / "bare")


def test_picks_round_trip_and_name_the_faulty_line(tmp_path):
    board = Board("pins", 9, 9, 0.05)
    data, _, _ = simulate_set(SimulatedRig(), 0, views=3, noise=Noise(missing=0.3), with_depth=False)
    file = tmp_path / "picks.csv"
    file.write_text(picks_csv(data))
    for a, b in zip(read_picks_csv(file, board), data.views, strict=True):
        for camera in ("color", "thermal"):
            np.testing.assert_array_equal(a.points[camera].index, b.points[camera].index)
            np.testing.assert_allclose(a.points[camera].px, b.points[camera].px, atol=1e-4)
    file.write_text("view,camera,point,u_px,v_px\n1,color,81,3,4\n")
    with pytest.raises(ScanError, match=r"line 2: point 81 does not exist on a board of 9 x 9"):
        read_picks_csv(file, board)


def test_points_without_pixels_are_left_out():
    p = BoardPoints(np.arange(3), np.array([[1.0, 2], [np.nan, 1], [3, 4]]))
    np.testing.assert_array_equal(p.index, [0, 2])
