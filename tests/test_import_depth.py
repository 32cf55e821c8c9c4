"""Depth recordings of other makers: one contract for every row of the table, and what people's folders hide."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from support import foreign
from support.foreign import GL, POSES, TIMES, Moments, plain, put
from typer.testing import CliRunner

from thermofusion.cli import app
from thermofusion.errors import QualityError, RecipeError, ScanError
from thermofusion.geometry.rigid import rotation_angle_deg
from thermofusion.scans import FORMATS, Stated, open_scan
from thermofusion.scans.formats.sensors import ros
from thermofusion.scans.native.write import write_scan
from thermofusion.scans.overlay import looks_mirrored
from thermofusion.tracking.recorded import believed
from thermofusion.types import Trajectory

# Tests of their own.
ELSEWHERE = {"native", "recording", "azure-mkv", "realsense-bag", "flir", "fakenect", "apc-shelf", "jhu"}


def test_every_format_has_a_writer_or_tests_of_its_own():
    assert {f.name for f in FORMATS} == ELSEWHERE | set(foreign.WRITERS)


@pytest.mark.parametrize("name", foreign.WRITERS)
def test_every_reader_keeps_the_contract(tmp_path, name):
    if name == "ros":
        pytest.importorskip("rosbags")
    write, has_times, has_poses = foreign.WRITERS[name]
    path, m = write(tmp_path / "take")
    scan = open_scan(path)
    assert next(f.name for f in FORMATS if f.recognise(path)) == scan.format == name
    np.testing.assert_allclose(scan.rig.depth.K, m.K, atol=1e-4)
    assert scan.times_assumed == (not has_times)
    if has_times:
        np.testing.assert_allclose(np.diff(scan.depth.times_s), np.diff(TIMES), atol=1e-6)
    for i in range(foreign.N):
        np.testing.assert_allclose(scan.depth.load(i), m.metres(i), atol=3e-6)  # NaN where there is none
        assert abs(int(scan.color.load(i).mean()) - (60 + 40 * i)) <= 4
    if has_poses:
        T = scan.trajectory.T_world_depth
        np.testing.assert_allclose(np.linalg.inv(T[0]) @ T, np.linalg.inv(POSES[0]) @ POSES, atol=2e-6)
        np.testing.assert_allclose(scan.trajectory.times_s, scan.depth.times_s, atol=1e-6)
    back = open_scan(write_scan(scan, tmp_path / "native"))
    np.testing.assert_allclose(back.depth.load(1), scan.depth.load(1), atol=1.3e-4)
    assert back.times_assumed == scan.times_assumed
    own = scan.depth.load(1)
    doubled = open_scan(path, stated=Stated(depth_unit_m=2 * _unit(scan, own))).depth.load(1)
    np.testing.assert_allclose(doubled, 2 * own, rtol=1e-5)
    turned = open_scan(path, stated=Stated(mirrored=True))
    if name != "kinect2":  # it is mirrored by itself
        np.testing.assert_array_equal(turned.depth.load(1), own[:, ::-1])
        assert turned.rig.depth.K[0, 2] == pytest.approx(m.w - 1 - m.K[0, 2], abs=1e-4)


def _unit(scan, metres):
    """Metres a stored unit: float recordings are in metres, or millimetres."""
    if scan.format == "kinect2":
        return 0.001
    return 1.0 if scan.format in ("record3d", "icl-nuim") else scan.depth_unit_m


# ---------------------------------------------------------------- folders of images


def test_a_stated_scale_is_obeyed_and_a_contradiction_named(tmp_path):
    m = Moments()
    root = plain(tmp_path, m, lambda m, i: m.mm(i) * 4, depth_scale=4000.0)
    np.testing.assert_allclose(open_scan(root).depth.load(0), m.metres(0), atol=1e-6)
    assert open_scan(root).depth_unit_m == 0.00025
    put(root / "rig.json", foreign.rig(m, depth_unit_m=0.001))
    with pytest.raises(ScanError, match=r"0.001 m a step, but the recording says 0.00025.*--depth-unit"):
        open_scan(root)
    np.testing.assert_allclose(
        open_scan(root, stated=Stated(depth_unit_m=0.00025)).depth.load(0), m.metres(0), atol=1e-6
    )


def test_another_size_is_named_and_a_rig_beside_it_helps(tmp_path):
    m = Moments()
    root = plain(tmp_path, m)
    put(root / "camera_intrinsic.json", {**foreign.open3d_json(m), "width": 128, "height": 96})
    with pytest.raises(ScanError, match=r"128 x 96 px, the depth images have 64 x 48; put a rig.json"):
        open_scan(root)
    put(root / "rig.json", foreign.rig(m))
    np.testing.assert_array_equal(open_scan(root).rig.depth.K, m.K)


@pytest.mark.parametrize(
    ("suffix", "image"),
    [
        (".pgm", Moments.mm),
        (".tiff", Moments.mm),
        (".tiff", Moments.metres),
        (".npy", foreign.npy),
        (".png", lambda m, i: np.where(m.mm(i), m.mm(i), 65535).astype(np.uint16)),
        (".png", lambda m, i: m.mm(i) << 3),
        (".png", lambda m, i: (m.mm(i) << 3) | (m.mm(i) > 0) * np.where(np.arange(m.w) < 30, 2, 0).astype(np.uint16)),
    ],
)
def test_depth_in_other_clothes_is_the_same_depth(tmp_path, suffix, image):
    m = Moments(640, 480)
    scan = open_scan(plain(tmp_path, m, image, suffix, color=False))
    for i in range(foreign.N):
        np.testing.assert_allclose(scan.depth.load(i), m.metres(i), atol=1e-6)


def test_names_that_are_times_are_times_and_system_files_are_none(tmp_path):
    m = Moments()
    for i, stamp in enumerate(("999.984210", "1000.004210", "1000.134210")):  # text order would put 999 last
        put(tmp_path / f"depth/{stamp}.png", m.mm(i))
        put(tmp_path / f"rgb/{stamp}.png", m.color(i))
        put(tmp_path / f"depth/._{stamp}.png", b"\0\5\x16\7")
    put(tmp_path / "depth/Thumbs.db", b"\xd0\xcf")
    put(tmp_path / "camera_intrinsic.json", foreign.open3d_json(m))
    scan = open_scan(tmp_path)
    np.testing.assert_allclose(scan.depth.times_s, [999.98421, 1000.00421, 1000.13421])
    assert not scan.times_assumed
    np.testing.assert_allclose(scan.depth.load(0), m.metres(0), atol=1e-6)


@pytest.mark.parametrize(("ids", "wanted"), [((0, 2), [0, 2]), ((1, 2, 3), [0, 1, 2]), ((8, 10), [0, 2])])
def test_ids_of_a_log_are_obeyed(tmp_path, ids, wanted):
    root = plain(tmp_path, Moments())
    blocks = zip(ids, wanted, strict=True)
    put(root / "trajectory.log", "".join(f"{k} {k} {k + 1}\n{foreign.text(POSES[w])}" for k, w in blocks))
    scan = open_scan(root)
    np.testing.assert_array_equal(scan.trajectory.times_s, scan.depth.times_s[wanted])
    np.testing.assert_allclose(scan.trajectory.T_world_depth, POSES[wanted], atol=1e-8)
    assert any("1 depth frames have no pose (frames 9)" in n for n in scan.notes) == (len(ids) == 2)
    put(root / "trajectory.log", f"7 7 8\n{foreign.text(POSES[0])}")
    with pytest.raises(ScanError, match="numbered 7 to 7, the depth frames 0 to 2"):
        open_scan(root)


def test_microsofts_nan_is_a_lost_pose(tmp_path):
    root, _ = foreign.sevenscenes(tmp_path)
    put(root / "frame-000001.pose.txt", "-nan(ind)\t-1.#IND\tnan\t1.#QNAN\n" * 4)
    scan = open_scan(root)
    assert len(scan.trajectory) == 2
    assert any("1 frame without a finite pose" in n for n in scan.notes)


def test_colour_of_another_size_has_a_camera_of_its_own_or_stays_out(tmp_path):
    m = Moments()
    root = plain(tmp_path, m)
    for i in range(foreign.N):
        put(root / f"color/{i + 8}.png", m.color(i, 2))
    scan = open_scan(root)
    assert scan.color is None
    assert any("cameras.color" in n for n in scan.notes)
    rig = foreign.rig(m)
    rig["cameras"]["color"] = {"width_px": 128, "height_px": 96, "K": (m.K * [[2], [2], [1]]).tolist()}
    rig["extrinsics"]["T_color_depth"] = POSES[1].tolist()
    put(root / "rig.json", rig)
    scan = open_scan(root)
    assert scan.color.load(0).shape == (96, 128, 3)
    np.testing.assert_allclose(scan.rig.T_color_depth, POSES[1])


def test_times_and_a_size_that_are_stated(tmp_path):
    m = Moments()
    root = plain(tmp_path / "take", m, lambda m, i: m.mm(i).tobytes(), ".raw")
    with pytest.raises(ScanError, match="does not say its size; give --size"):
        open_scan(root)
    list_ = tmp_path / "times.csv"
    list_.write_text("path;time_s\n10.raw;7.5\n8.raw;7\n9.raw;7.125\n")
    scan = open_scan(root, stated=Stated(size_px=(64, 48)), times=list_)
    np.testing.assert_allclose(scan.depth.times_s, [7, 7.125, 7.5])
    np.testing.assert_allclose(scan.color.times_s, [7, 7.125, 7.5])
    assert not scan.times_assumed
    list_.write_text("8.raw,7\n10.raw,8\n")
    with pytest.raises(ScanError, match=r"names no time for 9\.raw"):
        open_scan(root, stated=Stated(size_px=(64, 48)), times=list_)
    with pytest.raises(RecipeError, match=r"--depth-unit: scan\.json says it"):
        open_scan(write_scan(scan, tmp_path / "native"), stated=Stated(depth_unit_m=0.001))


def test_a_tiff_that_a_decoder_would_turn_or_cut_is_refused(tmp_path):
    root = plain(tmp_path, Moments(), suffix=".tiff", color=False)
    good = (root / "depth/9.tiff").read_bytes()
    at = good.find(b"\x12\x01\x03\x00")  # tag 274, little-endian, SHORT
    if at < 0:  # OpenCV writes none: 'ImageWidth' (256) of the second directory entry stays, 259 becomes 274
        at = good.find(b"\x16\x01\x03\x00")  # 278, rows per strip
        turned = good[:at] + b"\x12\x01\x03\x00\x01\x00\x00\x00\x03\x00\x00\x00" + good[at + 12 :]
    else:
        turned = good[: at + 8] + b"\x03" + good[at + 9 :]
    (root / "depth/9.tiff").write_bytes(turned)
    with pytest.raises(ScanError, match=r"turned or mirrored \(orientation 3"):
        open_scan(root)
    pages = cv2.imencodemulti(".tiff", [Moments().mm(0), Moments().mm(1)])[1].tobytes()
    (root / "depth/9.tiff").write_bytes(pages)
    with pytest.raises(ScanError, match="more than one page"):
        open_scan(root)


def test_a_mirrored_rig_is_seen(shared_data):
    scan = open_scan(shared_data("torso-dev"))
    load, K = scan.depth.load, scan.rig.depth.K.copy()
    K[0, 2] = scan.rig.depth.width_px - 1 - K[0, 2]
    mirrored = replace(
        scan,
        depth=replace(scan.depth, load=lambda i: load(i)[:, ::-1].copy()),
        rig=replace(scan.rig, depth=replace(scan.rig.depth, K=K)),
    )
    assert looks_mirrored(mirrored)
    assert not looks_mirrored(scan)


# ---------------------------------------------------------------- recorded poses against the depth


@pytest.fixture(scope="module")
def torso(request):
    return open_scan(request.getfixturevalue("shared_data")("torso-dev"))


def _same_motion(got, T, frames):
    mine = np.linalg.inv(got.T_world_depth[0]) @ got.T_world_depth
    np.testing.assert_allclose(mine, np.linalg.inv(T[frames[0]]) @ T[frames], atol=1e-6)


def test_right_poses_are_believed_as_they_are(torso, shared_data):
    for scan in (torso, open_scan(shared_data("redkitchen")), open_scan(shared_data("apc-shelf"))):
        trajectory, faults = believed(scan)
        assert trajectory is scan.trajectory
        assert faults == ()


def _w_first(T):
    from scipy.spatial.transform import Rotation

    out = T.copy()
    q = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    out[:, :3, :3] = Rotation.from_quat(q[:, [3, 0, 1, 2]]).as_matrix()
    return out


def _in_mm(T):
    out = T.copy()
    out[:, :3, 3] *= 1000
    return out


@pytest.mark.parametrize(
    ("misread", "name", "size"),
    [
        (np.linalg.inv, "world-to-camera", None),
        (lambda T: T @ GL, "OpenGL's axes", (180, "deg")),
        (_w_first, "quaternions w first", None),
        (_in_mm, "millimetres", (1000, "times")),
        (lambda T: _w_first(np.linalg.inv(T)), "world-to-camera, quaternions w first", None),
    ],
)
def test_other_readings_of_poses_are_recognised(torso, misread, name, size):
    T = torso.trajectory.T_world_depth
    wrong = replace(torso, trajectory=Trajectory(torso.trajectory.times_s, misread(T)))
    got, (fault,) = believed(wrong)
    assert fault.done.startswith(f"read as {name}")
    if size is not None:
        assert (pytest.approx(fault.size, rel=1e-6), fault.unit) == size
    _same_motion(got, T, np.arange(len(T)))


@pytest.mark.parametrize("lost", [[20], [100], [90, 91], [40, 120]])
def test_lost_lines_are_found_where_they_are(torso, lost):
    t, T = torso.trajectory.times_s, torso.trajectory.T_world_depth
    wrong = replace(torso, trajectory=Trajectory(t[: -len(lost)], np.delete(T, lost, axis=0)))
    got, faults = believed(wrong)
    left = np.delete(np.arange(len(T)), lost)
    np.testing.assert_allclose(got.times_s, t[left])
    _same_motion(got, T, left)
    sizes = [1, 1] if lost == [40, 120] else [len(lost)]
    assert [(f.what, f.size) for f in faults] == [("lines of recorded poses missing", n) for n in sizes]
    turn_deg = rotation_angle_deg(np.linalg.inv(T[: -len(lost)]) @ T[len(lost) :])[lost[0] :]
    told = float(faults[0].evidence.split("off, ")[1].split("°")[0])
    assert told == pytest.approx(np.median(turn_deg) / len(sizes), rel=0.2)


def test_lost_depth_frames_are_no_lost_lines(torso):
    """Poses without an image: nothing is moved, with or without a line that is lost besides."""
    depth = torso.depth
    kept = np.delete(np.arange(len(depth)), [30, 31, 77, 140])
    parts = {k: getattr(depth, k)[kept] for k in ("times_s", "index", "usable")}
    places = tuple(depth.places[i] for i in kept)
    fewer = replace(torso, depth=replace(depth, **parts, places=places, load=lambda i: depth.load(int(kept[i]))))
    got, faults = believed(fewer)
    assert not faults
    np.testing.assert_array_equal(got.T_world_depth, torso.trajectory.T_world_depth)
    t, T = torso.trajectory.times_s, torso.trajectory.T_world_depth
    got, faults = believed(replace(fewer, trajectory=Trajectory(t[:-1], np.delete(T, 100, axis=0))))
    assert len(faults) == 1


def test_poses_of_something_else_are_refused_by_name(torso):
    T = torso.trajectory.T_world_depth[np.random.default_rng(1).permutation(len(torso.trajectory))]
    with pytest.raises(QualityError, match="do not fit the depth"):
        believed(replace(torso, trajectory=Trajectory(torso.trajectory.times_s, T)))


def test_folders_of_two_makers_name_their_fault(tmp_path):
    root, _ = foreign.bop(tmp_path / "bop")
    tree = json.loads((root / "scene_camera.json").read_text())
    tree["1"]["depth_scale"] = 1.0
    put(root / "scene_camera.json", tree)
    with pytest.raises(ScanError, match="differ in camera or depth_scale"):
        open_scan(root)
    path, _ = foreign.sens(tmp_path / "sens")
    path.write_bytes(path.read_bytes()[:-200])
    assert len(open_scan(path).depth) == 2  # the whole frames before the tear


def test_packed_depth_of_ros_is_the_depth():
    mm = np.random.default_rng(3).integers(400, 4000, (6, 8)).astype(np.uint16)
    mm[0, 0] = 0
    png = cv2.imencode(".png", mm)[1].tobytes()
    plain = SimpleNamespace(format="16UC1; compressedDepth png", data=bytes(12) + png)
    np.testing.assert_array_equal(ros._image(plain, "here"), mm)
    assert ros._packed(plain.format) == "16UC1"
    A, B = 150.0, -20.0  # m = A / (value - B)
    inverse = SimpleNamespace(format="32FC1; compressedDepth", data=struct.pack("<iff", 0, A, B) + png)
    m = ros._image(inverse, "here")
    assert np.isnan(m[0, 0])
    np.testing.assert_allclose(m[1:], A / (mm[1:] - B), rtol=1e-6)
    rvl = SimpleNamespace(format="16UC1; compressedDepth rvl", data=bytes(40))
    with pytest.raises(ScanError, match=r"packed as .*rvl.*republish"):
        ros._image(rvl, "here")


def test_a_unit_of_depth_has_a_name_or_a_number_and_no_step_is_a_metre(tmp_path):
    m = Moments()
    root = plain(tmp_path / "take", m, lambda m, i: cv2.imencode(".png", m.mm(i))[1].tobytes(), ".png")

    def unit(text):
        out = tmp_path / "out"
        result = CliRunner().invoke(app, ["import", str(root), "--depth-unit", text, "-o", str(out), "--overwrite"])
        return result, out

    for text in ("mm", "0,001", "0.001"):
        result, out = unit(text)
        assert result.exit_code == 0, result.output
        np.testing.assert_array_equal(open_scan(out).depth.load(0), open_scan(root).depth.load(0))
    for text in ("m", "1000", "parsec", "nan"):
        result, out = unit(text)
        assert isinstance(result.exception, (RecipeError, SystemExit))
        assert result.exit_code != 0
