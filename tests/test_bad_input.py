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
import tracemalloc
import zlib
from collections import deque
from pathlib import Path

import cv2
import numpy as np
import pytest
from support import scan_maker as make
from support.scan_maker import write_pnm

from thermofusion.cli.console import emit, note
from thermofusion.errors import ScanError, visible
from thermofusion.files import reading
from thermofusion.files.npz import read_npz
from thermofusion.files.reading import parse_json, read_bytes
from thermofusion.files.table import table_rows
from thermofusion.scans import open_scan, with_rig
from thermofusion.scans.check import verify
from thermofusion.scans.native.write import write_scan


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


def all_thermal(value):
    def spoil(root):
        for path in (root / "thermal").iterdir():
            path.write_bytes(cv2.imencode(".png", np.full((40, 56), value, np.uint16))[1].tobytes())

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
    "missing column": (rename_column, "1 column missing: time_s"),
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
    "time in microseconds": (cell(0, "time_s", "1.7e15"), "times are in seconds"),
    "more cells than columns": (
        file("frames.csv", lambda b: b.replace(b".png,\n", b".png,,,\n", 1)),
        "cells under 5 columns",
    ),
    "depth of one value": (all_depth(1000), "depth image is constant"),
    "depth of one value but for its rim": (image(DEPTH, np.pad(np.full((46, 62), 900, np.uint16), 1)), "constant"),
    "up without a length": (put("cameras.depth.up", [0, 0, 0]), "key 'cameras.depth.up': expected a direction"),
    "noise of a kilokelvin": (put("cameras.thermal.netd_K", 1000), "expected 0.0001 to 5 K, got 1000"),
    "no noise": (put("cameras.thermal.netd_K", 0), "expected 0.0001 to 5 K"),
    "focal length of nothing": (put("cameras.depth.K", [[1e-9, 0, 32], [0, 60, 24], [0, 0, 1]]), "3.2 to 6400 px"),
    "centre far off": (put("cameras.depth.K", [[60, 0, 1e9], [0, 60, 24], [0, 0, 1]]), "centre"),
    "distortion of millions": (put("cameras.thermal.distortion", [1e6, 0, 0, 0, 0]), "distortion"),
    "cameras in different towns": (
        put("extrinsics.T_color_depth", [[1, 0, 0, 500], *np.eye(4)[1:].tolist()]),
        "metres",
    ),
    "band of no width": (put("cameras.thermal.band_um", [8, 8.0000001]), "rise by at least"),
    "curve of infinite counts": (put("cameras.thermal.signal.curve.coefficients_degC", [0, 1e300]), "expected -1e+12"),
    "polygon outside": (
        put("references.0.thermal_polygon_px", [[90, 1], [95, 1], [95, 5]]),
        "beyond the thermal image",
    ),
    "polygon of no area": (put("references.0.thermal_polygon_px", [[5, 5]] * 3), "less than a pixel"),
    "polygon far below": (
        put("references.0.thermal_polygon_px", [[-1e30, 0], [9, 1], [9, 5]]),
        "expected -0.5 to 32767 px",
    ),
    "reference of molten iron": (put("references.0.degC", 1500), "expected -50 to 150 °C, got 1500"),
    "reference in no frame": (put("references.0.frames", []), "references.0.frames"),
    "reference in frame 10^30": (put("references.0.frames", [10**30]), "references.0.frames"),
    "reference in a frame that is not there": (put("references.0.frames", [77]), "names no thermal frame"),
    "reference seen elsewhere": (put("references.0.degC", 149), "blackbody of 149 degC is seen at"),
    "thermal of one value": (all_thermal(22000), "thermal image is constant"),
    "contact on the moon": (put("references.1.p_world_m", [4e8, 0, 0]), "expected -1000 to 1000 m"),
    "surroundings of hell": (put("environment.reflected_degC", 666), "expected -80 to 150 °C, got 666"),
    "name of a novel": (put("name", "x" * 10_000), "key 'name'"),
    "key twice": (file("scan.json", lambda b: b.replace(b"{", b'{"name": "other",', 1)), "'name' stands twice"),
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
        "shot.jpg": (
            cv2.imencode(".jpg", np.zeros((8, 8)))[1].tobytes(),
            "flir",
            "an ordinary picture: no temperatures",
        ),
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
    (tmp_path / "a.pgm").write_bytes(write_pnm(np.arange(480 * 640, dtype=np.uint16).reshape(480, 640) % 500 + 1200))
    (tmp_path / "a_0000.raw").write_bytes(b"\0" * 1000)
    with pytest.raises(ScanError, match="expected 601664 bytes"):
        verify(open_scan(tmp_path))


# ---------------------------------------------------------------- one door for files, tables, JSON, archives


def test_no_pipe_folder_or_dangling_link_is_waited_for_or_passed_over(root, tmp_path):
    """Optional files, too: what has the name and is no file is said."""
    for name in ("scan.json", "frames.csv", "trajectory.txt", "rig.json"):
        for kind in (os.mkfifo, os.mkdir, lambda path: path.symlink_to("nothing")):
            scan = shutil.copytree(root, tmp_path / "copy")
            (scan / name).unlink(missing_ok=True)
            kind(scan / name)
            with pytest.raises(ScanError, match=r"regular file|link to nothing"):
                with_rig(open_scan(scan), scan / "rig.json")
            shutil.rmtree(scan)
    os.mkfifo(tmp_path / "take.mkv")
    with pytest.raises(ScanError, match="recognised"):
        open_scan(tmp_path / "take.mkv")
    with pytest.raises(ScanError, match="regular file"):
        read_bytes(Path("/dev/zero"))


def test_tables_take_little_memory(tmp_path, monkeypatch):
    """A quoted cell without its end, and endless short ones, stop at a row's length; rows are not kept."""
    head = "x_m,y_m,z_m,degC,uncertainty_K\n"
    for row, match in (('"' + "0\n" * 90_000, "more than 100,000"), ('"a\n",' * 40_000, "more than 100,000")):
        (tmp_path / "t.csv").write_text(head + row)
        with pytest.raises(ScanError, match=match):
            list(table_rows(tmp_path / "t.csv", "table", ["degC"]))
    for text, match in ((head + "1,2,3,4,5,6\n", "6 cells under 5"), ("a,b,a\n1,2,3\n", "column a stands twice")):
        (tmp_path / "t.csv").write_text(text)
        with pytest.raises(ScanError, match=match):
            list(table_rows(tmp_path / "t.csv", "table", ["a"] if text[0] == "a" else ["degC"]))
    (tmp_path / "t.csv").write_text(head + "0,0,0,33\n" * 100_000)
    tracemalloc.start()
    deque(table_rows(tmp_path / "t.csv", "table", ["degC"]), maxlen=0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2e6
    monkeypatch.setattr(reading, "MAX_LINES", 1000)
    with pytest.raises(ScanError, match="more than 1,000 lines"):
        deque(table_rows(tmp_path / "t.csv", "table", ["degC"]), maxlen=0)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('{"a": 1, "b": {"c": 1, "c": 2}}', "key 'c' stands twice"),
        ("[1, NaN]", "NaN stands where a finite"),
        ("[-1e999]", "finite number"),
        ('{"a": -Infinity}', "finite number"),
        ("[" * 65 + "]" * 65, "nested too deep"),
        ("[" * 100_000, "nested too deep"),
        ('["\\ud800"]', "half a character"),
        ("[" + "9" * 5000 + "]", "too many digits"),
    ],
)
def test_json_that_python_would_let_pass(text, match):
    with pytest.raises(ScanError, match=match):
        parse_json(text, "x")
    assert parse_json("[" * 64 + "]" * 64, "x")


def test_truth_archives_are_held_against_their_claims(tmp_path):
    """A bomb, a header of more numbers than there are, objects: refused before anything is unpacked or run."""
    path = tmp_path / "t.npz"
    np.savez_compressed(path, a=np.zeros(20_000_000))
    with pytest.raises(ScanError, match="damaged"):
        read_npz(path, "truth", ["a"])
    np.savez(path, a=np.array([{}], object))
    with pytest.raises(ScanError, match="damaged"):
        read_npz(path, "truth", ["a"])
    np.savez(path, a=np.arange(6.0).reshape(2, 3).T, b=np.array(["x"]))
    assert np.array_equal(read_npz(path, "truth", ["a"])[0], np.arange(6.0).reshape(2, 3).T)
    with pytest.raises(ScanError, match="no array of numbers"):
        read_npz(path, "truth", ["b"])


def test_what_a_user_names_cannot_steer_a_terminal(tmp_path, capsys):
    hostile = "a\x1b[31m\x9b2J\u202e\n\udcff\ud800\U000e0001"
    assert visible(hostile) == r"a\u001b[31m\u009b2J\u202e\u000a\udcff\ud800\udb40\udc01"
    assert visible("Müller \u00a0体") == "Müller \u00a0体"
    assert str(ScanError(hostile, place=hostile, hint=hostile)).isprintable()
    assert len(str(ScanError("x" * 10_000))) < 700
    emit({"name": hostile}, "", True)
    assert json.loads(capsys.readouterr().out) == {"name": hostile}
    note(hostile)
    assert capsys.readouterr().err == visible(hostile) + "\n"
    with pytest.raises(ScanError, match=r"nothing\\u001b"):
        open_scan(tmp_path / "nothing\x1b[2J")
