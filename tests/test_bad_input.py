"""Bad recordings: one clear sentence and exit code 3, never a traceback, never a partial result."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import struct
import subprocess
import sys
import zlib
from contextlib import contextmanager

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import scan_maker as make
from support.scan_maker import write_pnm

from thermofusion.errors import ScanError
from thermofusion.files.pnm import read_pnm
from thermofusion.files.reading import decode_image
from thermofusion.scans import open_scan
from thermofusion.scans.check import verify
from thermofusion.scans.native.write import write_scan
from thermofusion.scans.thermal import flir


@pytest.fixture(scope="session")
def good(tmp_path_factory):
    """A faultless native scan; tests copy it."""
    return write_scan(make.tiny_scan(), tmp_path_factory.mktemp("good") / "scan")


@pytest.fixture
def root(good, tmp_path):
    return shutil.copytree(good, tmp_path / "scan")


# ---------------------------------------------------------------- ways to spoil a scan


def scan_json(change):
    """Spoil scan.json: `change(tree)`."""

    def spoil(root):
        path = root / "scan.json"
        tree = json.loads(path.read_text())
        change(tree)
        path.write_text(json.dumps(tree))

    return spoil


def put(path, value):
    """Set a dotted key of scan.json; value `...` deletes it."""

    def change(tree):
        *parents, last = path.split(".")
        for key in parents:
            tree = tree[int(key)] if isinstance(tree, list) else tree[key]
        if value is ...:
            del tree[last]
        else:
            tree[int(last) if isinstance(tree, list) else last] = value

    return scan_json(change)


def frames(change):
    """Spoil frames.csv: `change(rows)` on lists of dicts."""

    def spoil(root):
        path = root / "frames.csv"
        rows = list(csv.DictReader(io.StringIO(path.read_text())))
        rows = change(rows) or rows
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]) if rows else ["stream", "index", "time_s", "path", "shutter"])
        writer.writeheader()
        writer.writerows(rows)
        path.write_text(text.getvalue())

    return spoil


def cell(row, column, value):
    return frames(lambda rows: rows[row].__setitem__(column, value))


def times(stream, shift):
    def change(rows):
        for r in rows:
            if r["stream"] == stream:
                r["time_s"] = str(shift(float(r["time_s"])))

    return frames(change)


def file(name, data):
    """Replace a file's bytes: bytes, or a function of the old ones."""

    def spoil(root):
        path = root / name
        path.write_bytes(data(path.read_bytes()) if callable(data) else data)

    return spoil


def image(name, pixels):
    return file(name, cv2.imencode(".png", pixels)[1].tobytes())


def absent(name):
    return lambda root: (root / name).unlink()


def png_claiming(width, height):
    """A valid, tiny PNG file whose header claims a huge image."""

    def chunk(name, body):
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    pixels = zlib.compress(b"\0" * 99)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def tiff_claiming(width, height):
    """The head of a TIFF whose directory claims a huge image."""
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, size) for tag, size in ((256, width), (257, height)))
    return b"II*\0" + struct.pack("<IH", 8, 2) + entries + bytes(4)


def all_depth(value):
    def spoil(root):
        for path in (root / "depth").iterdir():
            path.write_bytes(cv2.imencode(".png", np.full((48, 64), value, np.uint16))[1].tobytes())

    return spoil


def fifo(root):
    (root / "depth/000001.png").unlink()
    os.mkfifo(root / "depth/000001.png")


def folder_instead(root):
    (root / "depth/000001.png").unlink()
    (root / "depth/000001.png").mkdir()


def link_outside(root):
    outside = root.parent / "secret.png"
    shutil.copy(root / "depth/000001.png", outside)
    (root / "depth/000001.png").unlink()
    (root / "depth/000001.png").symlink_to(outside)


def link_loop(root):
    (root / "depth/000001.png").unlink()
    (root / "depth/000001.png").symlink_to("000001.png")


def rename_column(root):
    path = root / "frames.csv"
    path.write_text(path.read_text().replace("time_s", "seconds", 1))


def duplicate_row(rows):
    first = next(r for r in rows if r["stream"] == "depth")
    return [*rows, dict(first, time_s="9.9")]


def table_curve(counts, degC):
    return put("cameras.thermal.signal", {"kind": "counts", "curve": {"type": "table", "counts": counts, "degC": degC}})


def trajectory(text):
    return file("trajectory.txt", text.encode())


DEPTH, COLOR, THERMAL = "depth/000000.png", "color/000000.png", "thermal/000000.png"
SCALED = [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
AWAY = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]  # looks backwards
K_HERE = [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]

# name: (how to spoil the good scan, what the sentence must say)
FAULTS = {
    "no scan.json": (absent("scan.json"), "no scan.json"),
    "no frames.csv": (absent("frames.csv"), "no frames.csv"),
    "not JSON": (file("scan.json", b"{"), "not valid JSON"),
    "not text": (file("scan.json", b"\xff\xfe\x00{"), "no UTF-8 text"),
    "empty JSON": (file("scan.json", b""), "empty"),
    "JSON of another kind": (file("scan.json", b"[1, 2]"), "the whole document"),
    "nested too deep": (file("scan.json", b"[" * 100_000), "not valid JSON"),
    "wrong schema": (put("schema", "thermofusion-scan/9"), "key 'schema'"),
    "no schema": (put("schema", ...), "key 'schema'"),
    "no cameras": (put("cameras", ...), "key 'cameras'"),
    "no K": (put("cameras.depth.K", ...), "key 'cameras.depth.K'"),
    "K of words": (put("cameras.depth.K", [["x"]]), "key 'cameras.depth.K.0.0'"),
    "K ragged": (put("cameras.depth.K", [[600], [0, 600, 240], [0, 0, 1]]), "K must be"),
    "K no camera matrix": (put("cameras.depth.K", [[0, 0, 0]] * 3), "not a camera matrix"),
    "K with NaN": (put("cameras.depth.K", [[float("nan"), 0, 1], [0, 1, 1], [0, 0, 1]]), "finite"),
    "K transposed": (put("cameras.color.K", [[60, 0, 0], [0, 60, 0], [31, 23, 1]]), "not a camera matrix"),
    "distortion too short": (put("cameras.thermal.distortion", [0.1, 0.2, 0.3]), "distortion"),
    "huge image size": (put("cameras.depth.width_px", 10**9), "key 'cameras.depth.width_px'"),
    "unit in metres": (put("cameras.depth.depth_unit_m", 1.0), "key 'cameras.depth.depth_unit_m'"),
    "unit ten times too large": (put("cameras.depth.depth_unit_m", 0.01), "depth unit looks wrong"),
    "unit twenty times too small": (put("cameras.depth.depth_unit_m", 0.00005), "depth unit looks wrong"),
    "no extrinsic": (put("extrinsics.T_thermal_depth", ...), "'extrinsics.T_thermal_depth' is needed"),
    "extrinsic not 4x4": (put("extrinsics.T_thermal_depth", [[1, 0], [0, 1]]), "4x4"),
    "extrinsic no rotation": (put("extrinsics.T_thermal_depth", SCALED), "not a rotation"),
    "cameras share no view": (put("extrinsics.T_thermal_depth", AWAY), "share no view"),
    "band falling": (put("cameras.thermal.band_um", [14, 8]), "band_um"),
    "band in nanometres": (put("cameras.thermal.band_um", [8000, 14000]), "band_um"),
    "no curve": (put("cameras.thermal.signal.curve", ...), "curve' is needed"),
    "no coefficients": (put("cameras.thermal.signal.curve.coefficients_degC", ...), "coefficients_degC' is needed"),
    "curve constant": (put("cameras.thermal.signal.curve.coefficients_degC", [30]), "depend on the counts"),
    "curve of another camera": (put("cameras.thermal.signal.curve.coefficients_degC", [9e3, 1]), "radiometric curve"),
    "table not rising": (table_curve([1, 3, 2], [1, 2, 3]), "rise strictly"),
    "table not monotone": (table_curve([1, 2, 3], [1, 3, 2]), "monotone"),
    "table uneven": (table_curve([1, 2, 3], [1, 3]), "equally long"),
    "counts said to be degrees": (put("cameras.thermal.signal", {"kind": "apparent_degC"}), "expected float"),
    "emissivity of a reference": (put("references.0.emissivity", 1.5), "emissivity"),
    "reference of unknown kind": (put("references.0.kind", "candle"), "references.0"),
    "humidity": (put("environment.relative_humidity_pct", 450), "relative_humidity_pct"),
    "missing column": (rename_column, "column(s) time_s"),
    "empty csv": (file("frames.csv", b""), "empty"),
    "header only": (frames(lambda rows: rows.clear()), "no depth frames"),
    "csv with NUL": (file("frames.csv", b"stream,index,time_s,path\ndepth,0,0,\0.png\n"), "not usable"),
    "unknown stream": (cell(0, "stream", "lidar"), "stream 'lidar'"),
    "index no number": (cell(0, "index", "first"), "index must be"),
    "index huge": (cell(0, "index", "9" * 30), "index"),
    "time no number": (cell(0, "time_s", "noon"), "time_s"),
    "time NaN": (cell(0, "time_s", "nan"), "not finite"),
    "path empty": (cell(0, "path", ""), "path is empty"),
    "path leaves the scan": (cell(0, "path", "../../etc/passwd"), "leaves the scan's folder"),
    "path absolute": (cell(0, "path", "/etc/passwd"), "leaves the scan's folder"),
    "path too long": (cell(0, "path", "a" * 5000), "5000 characters"),
    "times run backwards": (times("depth", lambda t: -t), "run backwards"),
    "times repeat": (times("color", lambda t: 1.0), "repeat"),
    "frame listed twice": (frames(duplicate_row), "stands twice"),
    "no depth rows": (frames(lambda rows: [r for r in rows if r["stream"] != "depth"]), "no depth frames"),
    "thermal on another clock": (times("thermal", lambda t: t + 1.7e9), "no time in common"),
    "colour on another clock": (times("color", lambda t: t - 500), "no time in common"),
    "all thermal in shutter": (frames(lambda rows: [dict(r, shutter="1") for r in rows]), "shutter correction"),
    "colour camera not described": (put("cameras.color", ...), "no 'cameras.color'"),
    "file absent": (absent(DEPTH), "absent"),
    "file empty": (file(DEPTH, b""), "empty"),
    "PNG truncated": (file(DEPTH, lambda b: b[: len(b) // 2]), "truncated"),
    "PNG without its last bytes": (file(THERMAL, lambda b: b[:-6]), "truncated"),
    "PNG damaged": (file(DEPTH, lambda b: b[:50] + bytes([b[50] ^ 1]) + b[51:]), "damaged"),
    "JPEG truncated": (
        file(COLOR, cv2.imencode(".jpg", np.zeros((48, 72, 3), np.uint8))[1].tobytes()[:-40]),
        "truncated (JPEG",
    ),
    "no image at all": (file(COLOR, b"Lorem ipsum dolor sit amet" * 9), "no image of a known kind"),
    "wrong size": (image(DEPTH, np.zeros((40, 64), np.uint16)), "64 x 40 px, expected 64 x 48"),
    "decompression bomb": (file(DEPTH, png_claiming(60_000, 60_000)), "60000 x 60000 px"),
    "bomb in PGM": (file(DEPTH, b"P5 60000 60000 65535\n" + b"\0" * 100), "60000 x 60000 px"),
    "bomb in TIFF": (file(THERMAL, tiff_claiming(90_000, 90_000)), "90000 x 90000 px"),
    "depth of 8 bits": (image(DEPTH, np.ones((48, 64), np.uint8)), "depth is uint8"),
    "depth in colour": (image(DEPTH, np.ones((48, 64, 3), np.uint16)), "with 3 axes"),
    "colour of 16 bits": (image(COLOR, np.ones((48, 72, 3), np.uint16)), "colour is uint16"),
    "thermal of 8 bits": (image(THERMAL, np.ones((40, 56), np.uint8)), "thermal is uint8"),
    "thermal byte-swapped": (
        image(THERMAL, np.full((40, 56), 20500, np.uint16).byteswap()),
        "thermal signal looks wrong",
    ),
    "depth mask empty": (all_depth(0), "mask is empty"),
    "a pipe": (fifo, "no regular file"),
    "a folder": (folder_instead, "no regular file"),
    "a link out of the scan": (link_outside, "leaves the scan's folder"),
    "a loop of links": (link_loop, ""),
    "pose NaN": (trajectory("0 nan 0 0 0 0 0 1\n"), "finite"),
    "pose without a unit quaternion": (trajectory("0 0 0 0 0 0 0 2\n"), "length is not 1"),
    "pose with a missing number": (trajectory("0 0 0 0 0 0 1\n"), "expected 8 numbers"),
    "pose of words": (trajectory("hello world\n"), "numbers only"),
    "poses run backwards": (trajectory("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n"), "run backwards"),
    "poses in millimetres": (trajectory("0 0 0 1500000 0 0 0 1\n"), "expected metres"),
    "no pose": (trajectory("# nothing\n"), "no poses"),
    "poses of another day": (trajectory("9e5 0 0 0 0 0 0 1\n"), "no time in common"),
}


def test_the_good_scan_is_good(root):
    verify(open_scan(root))


def test_enough_faults_are_tried():
    assert len(FAULTS) >= 25


@pytest.mark.parametrize("name", FAULTS)
def test_one_clear_sentence(root, name):
    spoil, expected = FAULTS[name]
    spoil(root)
    with pytest.raises(ScanError) as caught:
        verify(open_scan(root))
    text = str(caught.value)
    assert expected in text
    assert "\n" not in text
    assert len(text) < 400 + len(str(root))
    assert caught.value.place  # it says where
    assert caught.value.exit_code == 3


# ---------------------------------------------------------------- from the command line


def thermofusion(*words):
    run = subprocess.run([sys.executable, "-m", "thermofusion", *map(str, words)], capture_output=True, text=True)
    return run.returncode, run.stdout, run.stderr


@pytest.mark.parametrize("name", ["PNG truncated", "path leaves the scan"])
def test_import_of_a_bad_scan_leaves_nothing(root, tmp_path, name):
    FAULTS[name][0](root)
    code, out, err = thermofusion("import", root, "-o", tmp_path / "made")
    assert code == 3
    assert out == ""
    assert err.count("\n") == 1
    assert re.match(r"error: .*(truncated|leaves)", err)
    assert [p.name for p in tmp_path.iterdir()] == ["scan"]


# ---------------------------------------------------------------- foreign formats


def test_foreign_faults(tmp_path):
    cases = {
        "take.mkv": (b"\x1a\x45\xdf\xa3" + b"\0" * 40, None, "no DEPTH track"),
        "take.bag": (b"#ROSBAG V2.0\n" + b"\0" * 4000, None, "Open3D cannot read"),
        "shot.jpg": (cv2.imencode(".jpg", np.zeros((8, 8)))[1].tobytes(), "flir", "no FLIR radiometric data"),
        "walk.seq": (b"FFF\0" + b"\0" * 60, None, "truncated"),
        "plain.bin": (b"hello", "azure-mkv", "no Matroska"),
        "other.bin": (b"hello", "realsense-bag", "no ROS bag"),
        "third.bin": (b"hello", "tum", ""),
        "fourth.bin": (b"hello", "redwood", ""),
        "fifth.bin": (b"hello", "fakenect", ""),
        "sixth.bin": (b"hello", "native", ""),
        "seventh.bin": (b"hello", "7-scenes", ""),
        "eighth.bin": (b"hello", "apc-shelf", ""),
        "ninth.bin": (b"hello", "jhu", ""),
    }
    for name, (data, form, expected) in cases.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ScanError, match=expected or None) as caught:
            open_scan(tmp_path / name, format=form)
        assert "\n" not in str(caught.value), name


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("INDEX.txt", "d-1.0-5.pgm\nd-2.0-x.pgm\n", "line 2"),
        ("INDEX.txt", "d-1.0-5.pgm\n../d-1.0-5.pgm\n", "line 2"),
    ],
)
def test_fakenect_index(tmp_path, name, text, expected):
    (tmp_path / name).write_text(text)
    with pytest.raises(ScanError, match=expected):
        open_scan(tmp_path)


def test_jhu_counts_of_another_size(tmp_path):
    (tmp_path / "a.pgm").write_bytes(write_pnm(np.full((480, 640), 1200, np.uint16)))
    (tmp_path / "a_0000.raw").write_bytes(b"\0" * 1000)
    with pytest.raises(ScanError, match="expected 601664 bytes"):
        verify(open_scan(tmp_path))


# ---------------------------------------------------------------- damaged bytes: only ScanError may come out

FUZZ = settings(
    max_examples=120,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@contextmanager
def only_scan_error():
    """Lets a ScanError of one line pass; anything else fails the test."""
    caught = None
    try:
        yield
    except ScanError as e:
        caught = str(e)
    assert caught is None or "\n" not in caught


def damage(data, edits, cut):
    """Bytes replaced at relative places, then cut off."""
    out = bytearray(data)
    for where, value in edits:
        out[int(where * (len(out) - 1))] = value
    return bytes(out[: int(cut * len(out))] if cut < 1 else out)


EDITS = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=0, max_size=4)
CUT = st.one_of(st.just(1.0), st.floats(0, 1))


@FUZZ
@given(name=st.sampled_from(["scan.json", "frames.csv", "trajectory.txt", DEPTH, THERMAL]), edits=EDITS, cut=CUT)
def test_damaged_native_files(good, tmp_path_factory, name, edits, cut):
    root = tmp_path_factory.mktemp("fuzz") / "scan"
    shutil.copytree(good, root)
    (root / name).write_bytes(damage((good / name).read_bytes(), edits, cut))
    with only_scan_error():
        verify(open_scan(root))
    shutil.rmtree(root.parent)


CONTAINERS = {
    "raw": make.flir_jpeg(make.flir_block(np.full((12, 16), 15000, np.uint16))),
    "png": make.flir_jpeg(make.flir_block(np.full((12, 16), 15000, np.uint16), png=True)),
    "seq": 2 * make.flir_block(np.full((12, 16), 15000, np.uint16), order=">"),
}


@FUZZ
@given(kind=st.sampled_from(sorted(CONTAINERS)), edits=EDITS, cut=CUT)
def test_damaged_flir(kind, edits, cut):
    with only_scan_error():
        for frame in flir.parse(damage(CONTAINERS[kind], edits, cut), "x"):
            assert frame.parameters.temperature_degC(frame.raw).shape == frame.raw.shape


@pytest.fixture(scope="session")
def small_mkv():
    depth = np.full((2, 288, 320), 1000, np.uint16)
    jpeg = [cv2.imencode(".jpg", np.zeros((720, 1280, 3), np.uint8))[1].tobytes()] * 2
    parameters = (0.5, 0.5, 0.5, 0.6, *[0.0] * 10)
    return make.azure_mkv(depth, jpeg, [0, 33], make.calibration_json(parameters, parameters))


@FUZZ
@given(edits=st.lists(st.tuples(st.floats(0, 0.012), st.integers(0, 255)), max_size=4), cut=CUT)
def test_damaged_mkv(small_mkv, tmp_path_factory, edits, cut):
    """Most edits fall on the structure: the first hundredth of the file."""
    file = tmp_path_factory.mktemp("fuzz") / "take.mkv"
    file.write_bytes(damage(small_mkv, edits, cut))
    with only_scan_error():
        verify(open_scan(file, format="azure-mkv"))
    file.unlink()


HEADS = [b"P5 4 4 255\n", b"P6 ", b"II*\0", b"MM\0*", b"\xff\xd8\xff"]


@FUZZ
@given(data=st.binary(max_size=200), head=st.sampled_from(HEADS))
def test_damaged_image_headers(data, head):
    with only_scan_error():
        decode_image(head + data, shape=None, kind="depth", place="x")
    with only_scan_error():
        read_pnm(head + data, place="x")
