"""The scans border: every reader, the writer's round trip, pairing in time, the check of a recording."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import ROOT
from support import scan_maker as make
from support.scan_maker import backproject, write_pnm

from thermofusion.errors import RecipeError, ScanError
from thermofusion.files.pnm import read_pnm
from thermofusion.geometry.camera import project
from thermofusion.geometry.rigid import pose, se3_exp, transform_points
from thermofusion.mapping.views import NO_POSE, OUTSIDE, SHUTTER, thermal_views
from thermofusion.physics.signal import counts_to_kelvin
from thermofusion.scans import FORMATS, open_scan, with_rig, with_thermal
from thermofusion.scans.check import check_scan, missing_metadata, overlays, verify
from thermofusion.scans.common import as_thermal
from thermofusion.scans.formats import apcshelf, azure, ebml, fakenect, jhu
from thermofusion.scans.native.depth_correction import MetricDepth
from thermofusion.scans.native.write import excerpt, scan_json, write_scan
from thermofusion.scans.overlay import edge_overlays
from thermofusion.scans.pairing import pair_color
from thermofusion.scans.thermal import flir, read_thermal
from thermofusion.types import SignalCurve, Trajectory


def same_stream(a, b, times_atol=0.0):
    np.testing.assert_allclose(a.times_s, b.times_s, rtol=0, atol=times_atol)
    np.testing.assert_array_equal(a.index, b.index)
    np.testing.assert_array_equal(a.usable, b.usable)
    for i in range(len(a)):
        x, y = a.load(i), b.load(i)
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


# ---------------------------------------------------------------- native form


def test_what_is_written_reads_back_identical(tmp_path):
    scan = make.tiny_scan()
    back = open_scan(write_scan(scan, tmp_path / "out"))
    for name in ("depth", "color", "thermal"):
        same_stream(getattr(scan, name), getattr(back, name))
    assert scan_json(back) == scan_json(scan)  # cameras, rig, radiometry, room, references, subject, notes
    np.testing.assert_array_equal(back.trajectory.times_s, scan.trajectory.times_s)
    np.testing.assert_allclose(back.trajectory.T_world_depth, scan.trajectory.T_world_depth, atol=1e-14)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]  # no temporary folder left
    assert sorted(p.name for p in back.root.iterdir()) == [
        "color", "depth", "frames.csv", "scan.json", "thermal", "trajectory.txt",
    ]  # fmt: skip


def test_float_thermal_keeps_its_digits(tmp_path):
    scan = make.tiny_scan()
    degC = [np.linspace(20, 36, 40 * 56, dtype=np.float32).reshape(40, 56)]
    degC[0][0, 0] = np.nan
    camera = replace(scan.thermal.camera, signal=SignalCurve("apparent_degC"))
    scan = replace(scan, thermal=as_thermal(make.stream(degC, [0.0]), camera), references=())
    back = open_scan(write_scan(scan, tmp_path / "out"))
    same_stream(scan.thermal, back.thermal)
    assert vars(back.thermal.camera.signal) == vars(camera.signal)


def test_original_files_are_copied_byte_for_byte(tmp_path):
    first = write_scan(make.tiny_scan(), tmp_path / "first")
    jpeg = cv2.imencode(".jpg", make.tiny_scan().color.load(0))[1].tobytes()
    (first / "color/000000.png").write_bytes(jpeg)  # a JPEG whatever its name says
    second = write_scan(open_scan(first), tmp_path / "second")
    assert (second / "color/000000.jpg").read_bytes() == jpeg
    assert (second / "depth/000002.png").read_bytes() == (first / "depth/000002.png").read_bytes()


def test_an_existing_folder_is_replaced_only_on_request(tmp_path):
    scan, out = make.tiny_scan(), tmp_path / "out"
    write_scan(scan, out)
    with pytest.raises(ScanError, match="exists already"):
        write_scan(scan, out)
    write_scan(replace(scan, name="again"), out, overwrite=True)
    assert open_scan(out).name == "again"
    with pytest.raises(ScanError, match="over itself"):
        write_scan(open_scan(out), out, overwrite=True)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("dear")
    with pytest.raises(ScanError, match="no scan folder"):
        write_scan(scan, tmp_path / "mine", overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", "out"]


def test_a_failing_frame_leaves_nothing_behind(tmp_path):
    scan = make.tiny_scan()

    def load(i):
        raise ScanError("torn", place=f"frame {i}")

    with pytest.raises(ScanError, match="torn"):
        write_scan(replace(scan, thermal=replace(scan.thermal, load=load)), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_excerpt_keeps_what_belongs_to_the_kept_depth_frames():
    scan = make.tiny_scan(frames=6)
    part = excerpt(scan, depth=slice(1, 4))
    assert part.depth.index.tolist() == [1, 2, 3]
    assert part.color.index.tolist() == [1, 2, 3]
    assert part.thermal.index.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(part.depth.load(2), scan.depth.load(3))
    assert part.references[0].frames == (2,)
    t = part.trajectory.times_s
    assert t[0] <= part.depth.times_s[0]
    assert t[-1] >= part.depth.times_s[-1]
    assert excerpt(scan, depth=[5, 0, 5], thermal=[]).depth.index.tolist() == [0, 5]
    assert excerpt(scan, depth=[0], thermal=[]).thermal is None
    with pytest.raises(ScanError, match="no depth frame"):
        excerpt(scan, depth=[])


def test_a_byte_order_mark_and_spaces_do_no_harm(tmp_path):
    root = write_scan(make.tiny_scan(), tmp_path / "out")
    for name in ("scan.json", "frames.csv"):
        (root / name).write_bytes(b"\xef\xbb\xbf" + (root / name).read_bytes())
    assert len(open_scan(root).depth) == 4


def test_unknown_keys_are_kept_as_a_note(tmp_path):
    root = write_scan(make.tiny_scan(), tmp_path / "out")
    tree = json.loads((root / "scan.json").read_text())
    tree["environment"]["fan"] = True
    (root / "scan.json").write_text(json.dumps(tree))
    assert any("environment.fan" in note for note in open_scan(root).notes)


# ---------------------------------------------------------------- the table of readers


def test_a_folder_around_one_recording_is_that_recording(tmp_path):
    scan = make.tiny_scan()
    (tmp_path / "walk").mkdir()
    write_scan(scan, tmp_path / "walk/first")
    found = open_scan(tmp_path / "walk")
    assert len(found.depth) == len(scan.depth)
    assert "read from first, the only recording in the folder" in found.notes
    write_scan(scan, tmp_path / "walk/second")
    with pytest.raises(ScanError, match=r"2 recordings here.*name one of them: first, second"):
        open_scan(tmp_path / "walk")


def test_unknown_format_names_the_nearest(tmp_path):
    with pytest.raises(RecipeError, match="did you mean 'redwood'"):
        open_scan(tmp_path, format="redwod")
    with pytest.raises(ScanError, match="no known recording format"):
        open_scan(tmp_path)
    with pytest.raises(ScanError, match="no such scan"):
        open_scan(tmp_path / "nothing")


def test_recognisers_do_not_claim_each_others_recordings(shared_data):
    expected = {
        "torso-dev": "native", "apc-shelf": "apc-shelf", "redkitchen": "7-scenes", "turntable-toy/data1": "redwood",
        "jhu/face": "jhu", "jhu/calibration": "jhu", "flir": "flir", "flir/IR_2412.jpg": "flir",
        "flir/SampleSEQ.seq": "flir",
    }  # fmt: skip
    for name, wanted in expected.items():
        claims = [f.name for f in FORMATS if f.recognise(shared_data(name))]
        assert claims[:1] == [wanted], (name, claims)


def test_scan_format_page_names_every_format_and_key():
    page = (ROOT / "docs/scan-format.md").read_text(encoding="utf-8")
    for f in FORMATS:
        assert f"`{f.name}`" in page, f.name
    keys = json.dumps(scan_json(make.tiny_scan()))
    for key in (
        "depth_unit_m",
        "band_um",
        "netd_K",
        "time_offset_s",
        "psf_sigma_px",
        "thermal_polygon_px",
        "p_world_m",
    ):
        assert key in keys
        assert key in page


# ---------------------------------------------------------------- foreign folders


def png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


def test_tum(tmp_path):
    root = tmp_path / "rgbd_dataset_freiburg1_desk"
    raw = np.full((480, 640), 6000, np.uint16)
    raw[0, 0] = 0
    color = np.zeros((480, 640, 3), np.uint8)
    color[..., 2] = 200  # red, as OpenCV stores it
    png(root / "depth/1305031102.160407.png", raw)
    png(root / "rgb/1305031102.175304.png", color)
    (root / "depth.txt").write_text("# depth maps\n1305031102.160407 depth/1305031102.160407.png\n")
    (root / "rgb.txt").write_text("# color\n1305031102.175304 rgb/1305031102.175304.png\n")
    (root / "groundtruth.txt").write_text("# t tx ty tz qx qy qz qw\n1305031102.16 1 2 3 0 0 0 1\n")
    scan = open_scan(root)
    depth = scan.depth.load(0)
    assert scan.format == "tum"
    assert np.isnan(depth[0, 0])
    assert depth[1, 1] == pytest.approx(1.2, abs=1e-6)
    assert scan.color.load(0)[5, 5].tolist() == [200, 0, 0]
    assert scan.rig.depth.K[0, 0] == 517.3
    np.testing.assert_allclose(scan.trajectory.T_world_depth[0, :3, 3], [1, 2, 3])
    assert pair_color(scan, 20).color_index.tolist() == [0]
    same_stream(scan.depth, open_scan(write_scan(scan, tmp_path / "native")).depth)


@pytest.mark.parametrize("layout", ["color", "image", "rgb", "flat", "stamped"])
def test_redwood_layouts(tmp_path, layout):
    for i in (0, 1, 10):
        raw = np.full((480, 640), 1000 + i, np.uint16)
        rgb = np.full((480, 640, 3), i, np.uint8)
        if layout == "flat":
            png(tmp_path / f"depth_{i}.png", raw)
            png(tmp_path / f"rgb_{i}.png", rgb)
        elif layout == "stamped":
            png(tmp_path / f"depth/{i:07d}-{33333 * i:012d}.png", raw)
            png(tmp_path / f"image/{i:07d}-{33333 * i + 4000:012d}.jpg", rgb)
        else:
            png(tmp_path / f"depth/{i}.png", raw)
            png(tmp_path / f"{layout}/{i}.jpg", rgb)
    K = [600, 0, 0, 0, 601, 0, 320, 240, 1]  # by columns
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps({"width": 640, "height": 480, "intrinsic_matrix": K}))
    log = "".join(f"{i} {i} {i + 1}\n1 0 0 {i}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" for i in range(3))
    (tmp_path / "trajectory.log").write_text(log)
    scan = open_scan(tmp_path)
    assert scan.format == "redwood"
    assert scan.depth.index.tolist() == [0, 1, 10]  # by number, not by name
    assert [round(float(scan.depth.load(i)[0, 0]) * 1000) for i in range(3)] == [1000, 1001, 1010]
    assert scan.rig.depth.K[0].tolist() == [600, 0, 320]
    np.testing.assert_allclose(scan.trajectory.T_world_depth[:, 0, 3], [0, 1, 2])
    step = 0.033333 if layout == "stamped" else 1 / 30
    np.testing.assert_allclose(scan.depth.times_s, [0, step, 10 * step], atol=1e-9)


def test_seven_scenes_drops_lost_poses_and_far_invalid(tmp_path):
    for i in range(3):
        raw = np.full((48, 64), 1500, np.uint16)
        raw[0] = 65535
        png(tmp_path / f"frame-{i:06d}.depth.png", raw)
        png(tmp_path / f"frame-{i:06d}.color.png", np.zeros((48, 64, 3), np.uint8))
        T = np.full((4, 4), np.nan) if i == 1 else pose(np.eye(3), np.array([i, 0, 0.0]))
        np.savetxt(tmp_path / f"frame-{i:06d}.pose.txt", T)
    scan = open_scan(tmp_path)
    assert np.isnan(scan.depth.load(0)[0]).all()
    assert len(scan.trajectory) == 2
    assert any("1 frame without a finite pose" in n for n in scan.notes)


# ---------------------------------------------------------------- fakenect


def fakenect_recording(root, ticks, walls):
    names = []
    raw = np.full((480, 640), 1000, np.uint16)
    raw[0, :3] = [2047, 800, 0]
    for k, (t, w) in enumerate(zip(ticks, walls, strict=True)):
        names.append(f"d-{w:.6f}-{t}.pgm")
        (root / names[-1]).write_bytes(write_pnm(raw, "<"))  # the trap: little-endian under a PGM header
        if k % 2 == 0:
            names.append(f"r-{w + 0.001:.6f}-{(t + 60_000) % 2**32}.ppm")
            (root / names[-1]).write_bytes(write_pnm(np.full((480, 640, 3), (10, 20, 30), np.uint8)))
    names.append(f"a-{walls[0]:.6f}-{ticks[0]}.dump")
    (root / names[-1]).write_bytes(struct.pack("<hhhbxI", 0, 819, -82, 6, 4))
    (root / "INDEX.txt").write_text("\n".join(names) + "\n")


def test_fakenect_byte_order_clock_and_millimetres(tmp_path):
    start = 2**32 - 3_000_000  # wraps after 50 ms
    ticks = [(start + 2_000_000 * i) % 2**32 for i in range(4)] + [(start + 60_000_000 * 200) % 2**32]
    walls = [1.3e9 + i / 30 + 0.004 * (i % 2) for i in range(4)] + [1.3e9 + 200.01]  # a pause of many wraps
    fakenect_recording(tmp_path, ticks, walls)
    scan = open_scan(tmp_path)
    np.testing.assert_allclose(scan.depth.times_s, [0, 1 / 30, 2 / 30, 0.1, 200], atol=1e-9)
    depth = scan.depth.load(0)
    assert np.isnan(depth[0, 0])  # 2047
    # by hand: m = ((1000-800)/4 - 0.375) 0.1042 = 5.170925; 10 (m 120 / (7.5-m) + 120) = 3864.2 mm
    assert depth[5, 5] == np.float32(3.864)
    # m = -0.375 x 0.1042 = -0.039075 -> 10 (-4.689 / 7.539075 + 120) = 1193.8 mm
    assert depth[0, 1] == np.float32(1.194)
    assert scan.color.load(0)[0, 0].tolist() == [30, 20, 10]
    assert len(scan.color) == 3
    assert any("(0.000, 1.000, -0.100) g" in n for n in scan.notes)
    assert scan.rig.depth.K[0, 0] == pytest.approx(575.8, abs=0.05)


def test_fakenect_refuses_depth_in_the_other_byte_order(tmp_path):
    fakenect_recording(tmp_path, [0], [1.3e9])
    file = next(tmp_path.glob("d-*.pgm"))
    file.write_bytes(write_pnm(np.full((480, 640), 1000, np.uint16), ">"))
    with pytest.raises(ScanError, match="big-endian"):
        open_scan(tmp_path).depth.load(0)


def test_accelerometer_dump():
    g, tilt, status = fakenect.read_acceleration(struct.pack("<hhhbxI", 819, 0, -819, -40, 1))
    np.testing.assert_allclose(g, [1, 0, -1])
    assert (tilt, status) == (-20.0, 1)


def test_pnm_round_trip_and_comments():
    image = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    for order in "<>":
        np.testing.assert_array_equal(read_pnm(write_pnm(image, order), place="x", byteorder=order), image)
    data = b"P5\n# a comment\n4 3\n255\n" + bytes(range(12))
    np.testing.assert_array_equal(read_pnm(data, place="x"), np.arange(12, dtype=np.uint8).reshape(3, 4))


# ---------------------------------------------------------------- Azure Kinect

# A real device's factory calibration and what the vendor's SDK made of it for 640x576 depth and 1920x1080 colour
# (published beside a student project); order cx cy fx fy k1..k6 codx cody p2 p1.
DEVICE_DEPTH = (
    0.5122697949409485, 0.49451231956481934, 0.4921168386936188, 0.4921667277812958, 3.1305770874023438,
    2.324939012527466, 0.1304156482219696, 3.458651542663574, 3.350114583969116, 0.6629416346549988, 0, 0,
    -0.0000511557373101823, 0.00008132171933539212,
)  # fmt: skip
DEVICE_COLOR = (
    0.4967627227306366, 0.5108628273010254, 0.470907062292099, 0.6274453997612, 0.7227460145950317,
    -2.8855903148651123, 1.6327226161956787, 0.6021990180015564, -2.7196261882781982, 1.565053105354309, 0, 0,
    -0.0001431911950930953, 0.0007828465895727277,
)  # fmt: skip


def test_azure_calibration_equals_the_vendors_numbers():
    tree = json.loads(make.calibration_json(DEVICE_DEPTH, DEVICE_COLOR))
    depth, _ = azure.azure_camera(tree, "depth", 640, 576, "x")
    color, T = azure.azure_camera(tree, "color", 1920, 1080, "x")
    K = depth.K
    np.testing.assert_allclose(
        [K[0, 2], K[1, 2], K[0, 0], K[1, 1]], [332.064270, 325.880615, 503.927643, 503.978729], atol=2e-5
    )
    K = color.K
    np.testing.assert_allclose(
        [K[0, 2], K[1, 2], K[0, 0], K[1, 1]], [953.284424, 555.142456, 904.141541, 903.521362], atol=5e-5
    )
    k1, k2, p1, p2, k3, k4, k5, k6 = depth.distortion
    np.testing.assert_allclose((k1, k2, k3, k4, k5, k6), DEVICE_DEPTH[4:10])
    np.testing.assert_allclose((p1, p2), (DEVICE_DEPTH[13], DEVICE_DEPTH[12]))
    np.testing.assert_allclose(T[:3, 3], [-0.032, -0.002, 0.004])


def azure_recording(n=3, **options):
    rng = np.random.default_rng(1)
    depth = rng.integers(400, 4000, (n, 288, 320)).astype(np.uint16)
    jpeg = [cv2.imencode(".jpg", np.full((720, 1280, 3), 40 * i, np.uint8))[1].tobytes() for i in range(n)]
    times = [1000 + 33 * i for i in range(n)]
    calibration = make.calibration_json(DEVICE_DEPTH, DEVICE_COLOR)
    return depth, make.azure_mkv(depth, jpeg, times, calibration, **options)


@pytest.mark.parametrize("options", [{}, {"unknown": True}, {"groups": True}, {"unknown": True, "groups": True}])
def test_azure_mkv_round_trip(tmp_path, options):
    depth, data = azure_recording(**options)
    file = tmp_path / "take.mkv"
    file.write_bytes(data)
    scan = open_scan(file)
    assert scan.format == "azure-mkv"
    np.testing.assert_allclose(scan.depth.times_s, [1.001, 1.034, 1.067], atol=1e-12)
    np.testing.assert_allclose(scan.color.times_s, [1.0, 1.033, 1.066], atol=1e-12)
    for i in range(3):
        np.testing.assert_array_equal(np.rint(scan.depth.load(i) * 1000).astype(np.uint16), depth[i])
        assert abs(int(scan.color.load(i).mean()) - 40 * i) <= 1
    back = open_scan(write_scan(scan, tmp_path / "native"))
    same_stream(scan.depth, back.depth)
    same_stream(scan.color, back.color)


def test_a_torn_mkv_gives_the_frames_before_the_tear(tmp_path):
    depth, data = azure_recording()
    file = tmp_path / "take.mkv"
    file.write_bytes(data[: len(data) - depth[0].nbytes // 2])
    scan = open_scan(file)
    assert len(scan.depth) == 2
    assert any("torn" in n for n in scan.notes)
    assert not ebml.parse(file.read_bytes(), file).complete


# ---------------------------------------------------------------- FLIR


def test_flir_known_answer():
    p = flir.FlirParameters(R1=21106.77, R2=0.012545258, B=1501, F=1, O=-7340, window_transmission=0.96)
    assert float(p.temperature_degC(np.array(17994.06))) == pytest.approx(23.31223, abs=1e-5)


@pytest.mark.parametrize("png", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_flir_container_round_trip(png, order):
    raw = np.arange(15000, 15000 + 12 * 16, dtype=np.uint16).reshape(12, 16)
    container = make.flir_block(raw, png=png, order=order)
    (frame,) = flir.parse(make.flir_jpeg(container))
    np.testing.assert_array_equal(frame.raw, raw)
    assert frame.time_s == 1_300_000_000.25
    frames = flir.parse(container + container)
    assert len(frames) == 2
    signal = replace(frame.parameters, window_transmission=1.0).curve()  # the native form of the same curve
    K = counts_to_kelvin(signal, raw.astype(float))
    np.testing.assert_allclose(K - 273.15, frame.parameters.apparent_degC(raw), atol=1e-9)


@pytest.mark.parametrize("name", ["IR_2412.jpg", "SampleSEQ.seq"])
def test_flir_equals_the_independent_decoding(shared_data, name):
    folder = shared_data("flir")
    frames = read_thermal(folder / name)
    truth = np.fromfile(folder / f"{name.split('.')[0]}.float32.raw", "<f4").reshape(frames.degC.shape)
    assert np.abs(frames.degC - truth).max() < 0.001  # measured 4e-6


def test_flir_alone_is_no_scan_but_joins_one(tmp_path):
    raw = (14000 + np.arange(40 * 56) % 7).astype(np.uint16).reshape(40, 56)
    blocks = b"".join(make.flir_block(raw + i, time_s=1_300_000_000 + i) for i in range(2))
    file = tmp_path / "walk.seq"
    file.write_bytes(blocks)
    with pytest.raises(ScanError, match="thermal recording alone"):
        open_scan(file)
    scan = make.tiny_scan()
    rig = tmp_path / "rig.json"
    tree = scan_json(scan)
    camera = tree["cameras"]["thermal"]
    rig.write_text(json.dumps({"cameras": {"thermal": camera}, "extrinsics": tree["extrinsics"]}))
    bare = replace(scan, thermal=None, references=())
    frames = read_thermal(file)
    joined = with_thermal(bare, frames, rig, times_s=np.array([0.0, 0.1]))
    verify(joined)
    back = open_scan(write_scan(joined, tmp_path / "native"))
    np.testing.assert_array_equal(back.thermal.load(1), raw + 1)
    assert back.thermal.camera.signal.curve == "planck"


# ---------------------------------------------------------------- composing


def test_rig_json_beside_a_recording_replaces_assumed_cameras(tmp_path):
    fakenect_recording(tmp_path, [0], [1.3e9])
    K = [[588.0, 0, 321.0], [0, 589.0, 241.0], [0, 0, 1]]
    T = pose(np.eye(3), np.array([-0.0249, 0.0003, 0.001])).tolist()
    camera = {"width_px": 640, "height_px": 480, "K": K}
    rig = {"cameras": {"depth": camera, "thermal": None}, "extrinsics": {"T_color_depth": T}}
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    scan = open_scan(tmp_path)
    assert scan.rig.depth.K.tolist() == K
    np.testing.assert_allclose(scan.rig.T_color_depth, T)
    rig["cameras"]["depth"]["width_px"] = 320
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    with pytest.raises(ScanError, match="320 x 480 px, but the scan's images have 640 x 480"):
        open_scan(tmp_path)


# ---------------------------------------------------------------- pairing


def test_colour_pairs_to_the_nearest_within_the_tolerance():
    scan = make.tiny_scan(frames=5)  # depth at i/15, colour 4 ms later
    pairs = pair_color(scan, 10)
    assert pairs.color_index.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(pairs.offset_s, 0.004)
    assert pair_color(scan, 3).color_index.tolist() == [-1] * 5
    sparse = replace(scan, color=make.stream([None] * 3, [0.0, 0.1, 5.0]))
    pairs = pair_color(sparse, 40)
    assert pairs.color_index.tolist() == [0, 1, 1, -1, -1]  # 0.0667 is nearer to 0.1, as is 0.133
    assert (pairs.unpaired_depth, pairs.unpaired_color) == (2, 1)
    assert pair_color(replace(scan, color=None), 40).unpaired_depth == 5


def test_thermal_views_take_poses_at_their_own_time_and_count_the_rest():
    scan = make.tiny_scan()
    twist = np.array([0.3, -0.2, 0.1, 0.5, 0.1, -0.2])
    t = np.array([0.0, 0.1, 0.2, 1.0, 1.1])
    T = np.stack([se3_exp(twist * x) for x in t])
    times = [0.05, 0.15, 0.6, 1.05, 2.0, 0.12 + 2]
    camera = replace(scan.thermal.camera, time_offset_s=-0.02)
    stream = make.stream([None] * 6, times, [True, False, True, True, True, True])
    scan = replace(scan, thermal=as_thermal(stream, scan.thermal.camera))
    views, left_out = thermal_views(scan, Trajectory(t, T), 0.5, camera)
    assert views.frame.tolist() == [0, 3]
    assert left_out == {SHUTTER: 1, NO_POSE: 1, OUTSIDE: 2}
    np.testing.assert_allclose(views.times_s, [0.03, 1.03])
    expected = se3_exp(twist * 0.03) @ np.linalg.inv(scan.thermal.camera.T_thermal_depth)  # constant twist: exact
    np.testing.assert_allclose(views.T_world_thermal[0], expected, atol=1e-12)
    with pytest.raises(ScanError, match="none of 6 thermal frames"):
        thermal_views(scan, Trajectory(t, T), 0.5, replace(camera, time_offset_s=100.0))


# ---------------------------------------------------------------- the check


def test_check_of_a_good_scan_and_of_a_bad_one():
    scan = make.tiny_scan((128, 96))
    report = check_scan(scan)
    assert not report.unusable
    assert report.streams["depth"].rate_hz == pytest.approx(15)
    assert 0.5 < report.depth_coverage <= 1
    assert "every sampled frame decodes" in report.text()
    assert missing_metadata(scan) == ("subject.acclimatisation_min",)
    far = replace(scan, depth=replace(scan.depth, load=lambda i: scan.depth.load(i) * 1000))
    bad = check_scan(far)
    assert bad.unusable
    assert "depth unit looks wrong" in bad.text()


def test_overlay_measures_a_turned_rig():
    scan = make.tiny_scan((160, 120))
    camera = scan.thermal.camera
    f = camera.lens.K[0, 0]
    turn = pose(cv2.Rodrigues(np.array([0, np.arctan(5 / f), 0]))[0], np.zeros(3))  # edges land 5 px too far right
    turned = replace(camera, T_thermal_depth=turn @ camera.T_thermal_depth)
    wrong = replace(scan, thermal=replace(scan.thermal, camera=turned))
    for s, expected in ((scan, 0), (wrong, -5)):
        thermal = [o for o in edge_overlays(s) if o.camera == "thermal"]
        assert thermal[0].contrast > 1.25
        assert abs(thermal[0].shift_px[0] - expected) <= 1
        assert abs(thermal[0].shift_px[1]) <= 1
    pictures = overlays(scan)
    assert all(p.dtype == np.uint8 and p.shape[2] == 3 for p in pictures.values())
    assert any("overlay thermal" in f.subject and f.severity == "warning" for f in check_scan(wrong).findings)


def test_with_rig_shows_another_rig(tmp_path):
    scan = make.tiny_scan()
    tree = scan_json(scan)
    tree["extrinsics"]["T_thermal_depth"][0][3] = 0.05
    (tmp_path / "rig.json").write_text(json.dumps({k: tree[k] for k in ("cameras", "extrinsics")}))
    assert with_rig(scan, tmp_path / "rig.json").thermal.camera.T_thermal_depth[0, 3] == 0.05


def test_a_rigs_depth_correction_reaches_the_depth_images(tmp_path):
    scan = make.tiny_scan()
    h, w = scan.rig.depth.shape
    model = MetricDepth((w, h))
    theta = np.random.default_rng(0).normal(0, 1, len(model.names)) * model.prior_sigma()
    tree = {k: v for k, v in scan_json(scan).items() if k in ("cameras", "extrinsics")}
    tree["depth_correction"] = {"model": "metric", "parameters": dict(zip(model.names, theta.tolist(), strict=True))}
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(tree))
    corrected, before = with_rig(scan, path), scan.depth.load(0)
    v, u = np.nonzero(np.isfinite(before))
    expected = model.to_depth_m(theta, before[v, u], u, v)
    assert np.abs(expected - before[v, u]).max() > 2e-3
    np.testing.assert_allclose(corrected.depth.load(0)[v, u], expected, atol=1e-6)
    write_scan(corrected, tmp_path / "native")
    again = open_scan(tmp_path / "native").depth.load(0)
    np.testing.assert_allclose(again[v, u], expected, atol=0.13e-3)
    np.testing.assert_array_equal(np.isnan(again), np.isnan(before))

    tree["depth_correction"]["parameters"].pop("offset_m")
    path.write_text(json.dumps(tree))
    with pytest.raises(ScanError, match="offset_m"):
        with_rig(scan, path)
    tree["depth_correction"]["model"] = "disparity"
    path.write_text(json.dumps(tree))
    kept = with_rig(scan, path)
    np.testing.assert_array_equal(kept.depth.load(0), before)
    assert "raw disparity" in kept.notes[-1]


# ---------------------------------------------------------------- real recordings


def test_shelf_registered_depth_is_predicted_from_raw_depth(shared_data):
    """The shipped registration moves pixels but not z: with z as the raw camera has it the two agree; with the full
    extrinsic they differ by its z, 4.3 mm."""
    folder = shared_data("apc-shelf")
    raw = apcshelf.read_shelf(folder, registered=False)
    registered = apcshelf.read_shelf(folder, registered=True)
    T = raw.rig.T_color_depth
    kept, moved = [], []
    for i in range(len(raw.depth)):
        points = backproject(raw.rig.depth, raw.depth.load(i)).reshape(-1, 3)
        points = points[np.isfinite(points).all(1)]
        uv, z = project(raw.rig.color, transform_points(T, points))
        shipped = registered.depth.load(i)
        u, v = np.rint(uv).astype(int).T
        ok = (u >= 0) & (u < 640) & (v >= 0) & (v < 480)
        for values, out in ((points[ok, 2], kept), (z[ok], moved)):
            nearest = np.full(shipped.shape, np.inf)
            np.minimum.at(nearest, (v[ok], u[ok]), values)
            both = np.isfinite(nearest) & np.isfinite(shipped)
            out.append((nearest - shipped)[both])
    kept_mm, moved_mm = np.concatenate(kept) * 1e3, np.concatenate(moved) * 1e3
    assert len(kept_mm) > 300_000
    assert np.median(np.abs(kept_mm)) < 0.8
    assert np.percentile(np.abs(kept_mm), 80) < 3
    assert np.median(moved_mm) == pytest.approx(T[2, 3] * 1e3, abs=0.5)
    assert (np.abs(kept_mm) < 0.05).mean() > 0.3  # a third of the pixels carry the very number: the unit is right
    verify(raw)


def test_redkitchen(shared_data):
    scan = open_scan(shared_data("redkitchen"))
    assert (len(scan.depth), len(scan.color), len(scan.trajectory)) == (240, 240, 240)
    path_m = np.linalg.norm(np.diff(scan.trajectory.T_world_depth[:, :3, 3], axis=0), axis=1).sum()
    assert path_m == pytest.approx(1.64, abs=0.01)
    assert scan.rig.depth.K[0, 0] == 585
    verify(scan)
    assert not check_scan(scan, 3).unusable


def test_face(shared_data):
    scan = open_scan(shared_data("jhu/face"))
    verify(scan)
    views, _ = thermal_views(scan, scan.trajectory, 0.5)
    assert len(views) == 1
    depth = scan.depth.load(0)
    person = depth[(depth > 0.9) & (depth < 1.35)]
    assert 1.05 < np.median(person) < 1.3
    K = counts_to_kelvin(scan.thermal.camera.signal, scan.thermal.load(0).astype(float))
    assert 303 < np.percentile(K, 98) < 306  # the forehead is the warmest thing there
    person_only = np.where(depth < 1.4, depth, np.nan)
    scan = replace(scan, depth=replace(scan.depth, load=lambda i: person_only))
    (overlay,) = edge_overlays(scan)
    assert max(map(abs, overlay.shift_px)) <= 2  # the outline fits
    other = jhu.read(shared_data("jhu/face"), depth_to_color_x_m=0.025)
    assert (other.thermal.camera.T_thermal_depth - scan.thermal.camera.T_thermal_depth)[0, 3] == pytest.approx(
        0.05, abs=1e-3
    )


def test_turntable(shared_data):
    scan = open_scan(shared_data("turntable-toy/data1"))
    assert (len(scan.depth), scan.trajectory) == (6, None)
    assert pair_color(scan, 40).color_index.tolist() == list(range(6))
    verify(scan)


def test_an_excerpt_of_the_simulated_walk_survives_the_round_trip(shared_data, tmp_path):
    scan = excerpt(open_scan(shared_data("torso-dev")), depth=slice(0, 6))
    back = open_scan(write_scan(scan, tmp_path / "part"))
    for name in ("depth", "color", "thermal"):
        same_stream(getattr(scan, name), getattr(back, name))
    assert (back.root / "color/000000.jpg").read_bytes() == (shared_data("torso-dev") / "color/000000.jpg").read_bytes()
