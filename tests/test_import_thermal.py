"""Thermal files of any maker: temperatures against truth, units that are named, clocks that are joined."""

from __future__ import annotations

import contextlib
import csv
import json
import struct
from collections import defaultdict
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support import scan_maker as make
from support.foreign import put
from typer.testing import CliRunner

from thermofusion.calibration.thermal.clocks import depth_outline, join_outlines, thermal_outline
from thermofusion.cli import app
from thermofusion.errors import ScanError
from thermofusion.files.tiff import tiff_pages, upright
from thermofusion.scans import open_scan, with_thermal
from thermofusion.scans.check import verify
from thermofusion.scans.native.write import scan_json, write_scan
from thermofusion.scans.thermal import KINDS, ThermalSaid, flir, read_thermal
from thermofusion.scans.thermal.frames import joined, one_frame
from thermofusion.scans.thermal.units import looks_like
from thermofusion.types import SignalCurve

# What is refused, and the words of its sentence: the cause, and the way.
NAMED = {
    "flir-no-raw-image.jpg": "no raw image.*radiometric JPEG",
    "flir-vue-pro.jpg": "does not measure temperatures.*thermal curve",
    "dji-h20t.jpg": "DJI R-JPEG.*Thermal SDK",
    "hikmicro-pocket.jpeg": "HIKMICRO.*Analyzer as CSV",
    "uni-t-uti260b.bmp": "UNI-T.*CSV or float TIFF",
}
# A window in the file is taken off, so what its counts alone would read is not what comes out.
BEFORE_OPTICS = ("flir-window.jpg", "flir-e40-window.jpg")


def truths(folder):
    found = defaultdict(list)
    for row in csv.DictReader((folder / "truth_degC.csv").read_text(encoding="utf-8").splitlines()):
        found[row["file"]].append(row)
    return found


def options(expect):
    words = expect.replace(",", " ").split()
    said = {k: float(words[words.index(k) + 1]) for k in ("--gain", "--offset-degC") if k in words}
    return ThermalSaid(said.get("--gain"), said.get("--offset-degC"))


def test_every_field_file_reads_as_truth_or_names_its_cause(shared_data):
    pytest.importorskip("imagecodecs")
    folder = shared_data("field/thermal")
    checked = 0
    for name, rows in truths(folder).items():
        if name in NAMED:
            with pytest.raises(ScanError, match=NAMED[name]):
                read_thermal(folder / name)
            continue
        said = options(rows[0]["expect"])
        path = folder / name.split("/")[0]
        if said.linear is not None:
            with pytest.raises(ScanError, match=r"look like .*(kelvin|0\.04 K)"):
                read_thermal(path)
        frames = read_thermal(path, said)
        files = [p.rsplit("/", 1)[-1].split(",")[0] for p in frames.places]
        if rows[0]["expect"] == "left out":
            assert name.split("/")[1] not in files
            assert any("left out, no temperatures" in n for n in frames.notes)
            continue
        for row in rows:
            if row["expect"] in ("comparison", "never silent") and row["quantity"] != "object":
                continue
            if row["quantity"] == "apparent" and name in BEFORE_OPTICS:
                assert any("infrared window" in n for n in frames.notes)
                continue
            if row["statistic"] == "spot":  # the camera's own, 0.8 K from its own model
                continue
            i = files.index(name.split("/")[1]) if "/" in name else int(row["frame"])
            degC = frames.apparent_degC(i)
            if row["quantity"] == "object" and frames.object_degC is not None:
                degC = frames.object_degC(i)
            found = {"mean": np.nanmean, "min": np.nanmin, "max": np.nanmax}.get(row["statistic"])
            value = degC[int(row["row"]), int(row["col"])] if found is None else found(degC)
            assert value == pytest.approx(float(row["degC"]), abs=0.02), (name, row)
            checked += 1
    assert checked > 200


# ---------------------------------------------------------------- FLIR


def parameters(**more):
    return flir.FlirParameters(R1=21106.77, R2=0.012545258, B=1501, F=1, O=-7340, **more)


def test_a_window_goes_into_the_curve_and_no_window_leaves_it():
    from thermofusion.physics.signal import counts_to_kelvin

    skin, raw = 34.0, np.array([[15000.0, 17000.0, 19000.0]])
    p = parameters(window_transmission=0.7, window_degC=40.0, air_degC=22.0, emissivity=1.0, distance_m=1.0)
    tau = p.air_transmission()
    s = p.signal(skin)  # forwards through air, window, air: what the camera would store
    for share, own in ((tau, 22.0), (0.7, 40.0), (tau, 22.0)):
        s = share * s + (1 - share) * p.signal(own)
    assert counts_to_kelvin(p.curve(), np.array(float(s))) - 273.15 == pytest.approx(skin, abs=1e-6)
    assert float(p.apparent_degC(s)) > skin + 1.5  # what the counts alone say
    plain = parameters()
    np.testing.assert_allclose(counts_to_kelvin(plain.curve(), raw) - 273.15, plain.apparent_degC(raw), atol=1e-9)


def smooth(shape=(48, 64)):
    v, u = np.mgrid[: shape[0], : shape[1]]
    return (15000 + 13 * u + 29 * v).astype(np.uint16)


def test_a_raw_png_is_read_in_the_byte_order_that_is_smooth(tmp_path):
    raw = smooth()
    swapped = make.flir_block(raw, png=True)
    true_order = make.flir_block(raw.byteswap(), png=True)  # the maker swaps once more
    for block in (swapped, true_order):
        np.testing.assert_array_equal(flir.parse(make.flir_jpeg(block))[0].raw, raw)


def test_a_torn_sequence_keeps_its_whole_frames_and_a_long_one_is_streamed(tmp_path):
    block = make.flir_block(smooth())
    (tmp_path / "a.seq").write_bytes(3 * block + block[:2000])
    frames = read_thermal(tmp_path / "a.seq")
    assert len(frames) == 3
    assert any("torn" in n for n in frames.notes)
    np.testing.assert_array_equal(frames.load(2), smooth())
    (tmp_path / "b.seq").write_bytes(block[:2000])
    with pytest.raises(ScanError, match="truncated"):
        read_thermal(tmp_path / "b.seq")
    (tmp_path / "c.seq").write_bytes(b"AFF\0" + block[4:] + bytes(300) + block)
    assert len(read_thermal(tmp_path / "c.seq")) == 2


def test_frames_of_moving_curves_and_of_counted_names_join(tmp_path):
    a, b = (
        SignalCurve("counts", "planck", {"R": (482576.0,), "B": (1620.0,), "F": (1.0,), "O": (o,)}) for o in (9, 23)
    )
    image = np.full((4, 5), 3000, np.uint16)
    both = joined([one_frame(image, "a", a), one_frame(image + np.uint16(14), "b", b)])
    np.testing.assert_allclose(both.apparent_degC(0), both.apparent_degC(1), atol=1e-5)
    for name, time_s in (("FLIR10.jpg", 1_300_000_009), ("FLIR9.jpg", 1_300_000_004)):
        put(tmp_path / name, make.flir_jpeg(make.flir_block(smooth(), time_s=time_s)))
    put(tmp_path / "seen.JPG", np.zeros((20, 20, 3), np.uint8))
    frames = read_thermal(tmp_path)
    assert [p.rsplit("/", 1)[-1] for p in frames.places] == ["FLIR9.jpg", "FLIR10.jpg"]
    assert any("1 file(s) left out" in n for n in frames.notes)
    assert frames.environment.reflected_degC == 20.0


# ---------------------------------------------------------------- pictures and tables


@pytest.mark.parametrize("tag", range(1, 9))
def test_a_tiff_is_turned_upright_as_its_tag_says(tag):
    stored = np.arange(6).reshape(2, 3)
    seen = upright(stored, tag)
    # TIFF 6.0: which side of the scene the stored 0th row and 0th column are
    row0 = {1: "top", 2: "top", 3: "bottom", 4: "bottom", 5: "left", 6: "right", 7: "right", 8: "left"}[tag]
    col0 = {1: "left", 2: "right", 3: "right", 4: "left", 5: "top", 6: "top", 7: "bottom", 8: "bottom"}[tag]
    side = {"top": lambda x: x[0], "bottom": lambda x: x[-1], "left": lambda x: x[:, 0], "right": lambda x: x[:, -1]}
    assert sorted(side[row0](seen)) == [0, 1, 2]
    assert sorted(side[col0](seen)) == [0, 3]


def tiff(image, big=False):
    """A plain TIFF or BigTIFF of one page."""
    kind = {"u": 1, "i": 2, "f": 3}[image.dtype.kind]
    tags = [(256, image.shape[1]), (257, image.shape[0]), (258, 8 * image.itemsize), (259, 1), (262, 1), (273, 0)]
    tags += [(277, 1), (278, image.shape[0]), (279, image.nbytes), (339, kind)]
    head, entry = (16, 20) if big else (8, 12)
    start = head + (8 if big else 2) + entry * len(tags) + (8 if big else 4)
    q = "Q" if big else "I"
    data = b"II" + (struct.pack("<HHHQ", 43, 8, 0, head) if big else struct.pack("<HI", 42, head))
    data += struct.pack("<Q" if big else "<H", len(tags))
    for tag, value in tags:
        data += struct.pack(f"<HH{q}{q}", tag, 16 if big else 4, 1, start if tag == 273 else value)
    return data + struct.pack("<" + q, 0) + image.tobytes()


@pytest.mark.parametrize("dtype", ["<f2", "<f4", "<f8"])
@pytest.mark.parametrize("big", [False, True])
def test_float_tiffs_of_any_width_are_degC(tmp_path, dtype, big):
    degC = np.linspace(20, 36, 48, dtype=dtype).reshape(6, 8)
    data = tiff(degC, big)
    assert (tiff_pages(data)[0].width_px, tiff_pages(data)[0].bits) == (8, 8 * degC.itemsize)
    put(tmp_path / "a.tif", data)
    np.testing.assert_allclose(read_thermal(tmp_path / "a.tif").apparent_degC(0), degC, atol=2e-6)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("Temperatur [°C]\n21,5;22,25;30;36,125\n20;21;22;23\n", "utf-8-sig"),
        ("File:;a.jpg\nUnit:;°F\nImage 1;70.7;72.05;86;97.025\n;68;69.8;71.6;73.4\n", "cp1252"),
        ("21.5\t22.25\t30\t36.125\r\n20\t21\t22\t23\r\n", "utf-16"),
        ("All in Kelvin\n,1,2,3,4\n1,294.65,295.4,303.15,309.275\n2,293.15,294.15,295.15,296.15\n", "utf-8"),
    ],
)
def test_tables_in_every_dialect(tmp_path, text, encoding):
    (tmp_path / "a.csv").write_text(text, encoding=encoding)
    degC = read_thermal(tmp_path / "a.csv").apparent_degC(0)
    np.testing.assert_allclose(degC, [[21.5, 22.25, 30, 36.125], [20, 21, 22, 23]], atol=2e-5)


@pytest.mark.parametrize(
    "text",
    [
        '"21,5","22,25","30,0","36,125"\n"20,0","21,0","22,0","23,0"\n',
        "21,5 22,25 30 36,125\n20 21 22 23\n",
        "21.5,,30,36.125\n20,21,22,23\n",
        "21.5,22.25,-nan(ind),36.125\n20,21,22,23\n",
        "21.5,22.25,30,36.125\n20,21,--,23\n",
    ],
)
def test_decimal_commas_and_missing_pixels_in_tables(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    degC = read_thermal(tmp_path / "a.csv").apparent_degC(0)
    assert degC.shape == (2, 4)
    seen = np.isfinite(degC)
    assert seen.sum() >= 7
    np.testing.assert_allclose(degC[seen], np.array([[21.5, 22.25, 30, 36.125], [20, 21, 22, 23]])[seen], atol=2e-5)


@pytest.mark.parametrize("between", ["\n", "Frame 2\n", "0;1\n"])
def test_a_second_table_is_not_left_out_in_silence(tmp_path, between):
    row = "21.5,22.25,30,36.125\n"
    (tmp_path / "a.csv").write_text(row * 3 + between + row * 3)
    with pytest.raises(ScanError, match=r"ends at line 4, and another begins.*one picture a file"):
        read_thermal(tmp_path / "a.csv")


def test_plain_numbers_of_other_programs(tmp_path):
    degC = np.random.default_rng(2).normal(30, 3, (6, 8)).astype(np.float32)
    for name, order in (("a.raw", "<f4"), ("b.raw", ">f4")):  # the first as DJI's own kit writes
        (tmp_path / name).write_bytes(degC.astype(order).tobytes())
        np.testing.assert_array_equal(read_thermal(tmp_path / name, shape=(6, 8)).apparent_degC(0), degC)
    np.save(tmp_path / "channel.npy", degC[..., None])
    np.testing.assert_array_equal(read_thermal(tmp_path / "channel.npy").apparent_degC(0), degC)
    np.save(tmp_path / "twentieths.npy", degC * 20)
    with pytest.raises(ScanError, match=r"no temperatures in degC.*--gain"):
        read_thermal(tmp_path / "twentieths.npy")
    np.testing.assert_allclose(
        read_thermal(tmp_path / "twentieths.npy", ThermalSaid(0.05, 0)).apparent_degC(0), degC, rtol=1e-6
    )


def test_units_are_named_with_the_options_that_mend_them():
    degC = np.linspace(19, 36, 100)
    assert looks_like(degC) is None
    assert looks_like(degC + 273.15) == ("kelvin", "--offset-degC -273.15")
    assert looks_like((degC + 273.15) * 100)[1] == "--gain 0.01 --offset-degC -273.15"
    assert looks_like((degC + 273.15) / 0.04)[0].startswith("steps of 0.04 K")
    assert looks_like((degC + 273.15) * 64)[0].startswith("kelvin x 64")
    assert looks_like(degC * 1.8 + 32)[0] == "degrees Fahrenheit"


def test_fahrenheit_and_kelvin_in_a_native_scan_are_no_temperatures(tmp_path):
    scan = make.tiny_scan()
    camera = replace(scan.thermal.camera, signal=SignalCurve("apparent_degC"))
    for values, word in ((np.linspace(70, 95, 2240), "Fahrenheit"), (np.linspace(292, 309, 2240), "kelvin")):
        image = values.astype(np.float32).reshape(40, 56)
        wrong = replace(scan, thermal=replace(scan.thermal, camera=camera, load=lambda i, image=image: image))
        with pytest.raises(ScanError, match=f"look like .*{word}"):
            verify(wrong)


def test_damaged_thermal_files_end_in_one_sentence(tmp_path, shared_data):
    folder = shared_data("field/thermal")
    rng = np.random.default_rng(4)
    for name in (
        "infiray-c200.irg",
        "infratec-variocam.irb",
        "lepton-tcam.tjsn",
        "infiray-p2pro.jpg",
        "tiff-pages.tif",
    ):
        data = bytearray((folder / name).read_bytes())
        for _ in range(12):
            torn = bytearray(data[: rng.integers(1, len(data))])
            for k in rng.integers(0, min(len(torn), 2000), 4):
                torn[k] = rng.integers(0, 256)
            (tmp_path / name).write_bytes(torn)
            with contextlib.suppress(ScanError):  # nothing else may come out
                read_thermal(tmp_path / name).load(0)


def test_kinds_have_names_and_a_folder_without_any_says_so(tmp_path):
    assert len({k.name for k in KINDS}) == len(KINDS)
    with pytest.raises(ScanError, match="no thermal files"):
        read_thermal(tmp_path)
    put(tmp_path / "a.bmt", b"BMT1234")
    with pytest.raises(ScanError, match="Testo recording; export it from testo IRSoft"):
        read_thermal(tmp_path)


# ---------------------------------------------------------------- joined


def test_two_unrelated_clocks_are_joined_to_milliseconds(shared_data):
    scan = open_scan(shared_data("torso-dev"))
    camera = scan.thermal.camera
    depth = np.array([depth_outline(scan.depth.load(i), scan.rig.depth, camera) for i in range(len(scan.depth))])
    thermal = np.array([thermal_outline(scan.thermal.load(i)) for i in range(len(scan.thermal))])
    own = scan.thermal.depth_times_s
    for offset, drift in ((7200.1234, 50e-6), (-7.3e8, -50e-6)):
        other = (own - offset) / (1 + drift)
        found = join_outlines(scan.depth.times_s, depth, other, thermal)
        assert np.abs(found.on_depth_clock(other) - own).max() < 0.005  # measured 0.001
        assert found.sigma_s < 0.003
    still = np.repeat(thermal[:1], len(thermal), axis=0)
    with pytest.raises(ScanError, match=r"--clock-offset SECONDS"):
        join_outlines(scan.depth.times_s, depth, own, still)


def bare_and_frames(tmp_path):
    """A native scan without thermal, its rig, and its thermal frames as a folder of PNG."""
    scan = make.tiny_scan()
    tree = scan_json(scan)
    put(tmp_path / "rig.json", {"cameras": {"thermal": tree["cameras"]["thermal"]}, "extrinsics": tree["extrinsics"]})
    for i in range(len(scan.thermal)):
        put(tmp_path / f"frames/{i + 8}.png", scan.thermal.load(i))
    return scan, write_scan(replace(scan, thermal=None, references=()), tmp_path / "bare")


def run(*words):
    return CliRunner().invoke(app, ["import", *map(str, words)])


def test_import_joins_any_pictures_on_any_clock(tmp_path):
    scan, bare = bare_and_frames(tmp_path)
    common = (bare, "--thermal", tmp_path / "frames", "--rig", tmp_path / "rig.json")
    lines = [f"{i + 8}.png,{t}" for i, t in enumerate(scan.thermal.times_s + 7200)]
    (tmp_path / "times.csv").write_text("\n".join(["path,time_s", *lines]))
    assert "state no times" in str(
        run(*common, "-o", tmp_path / "a").exception or run(*common, "-o", tmp_path / "a").output
    )
    far = run(*common, "--times", tmp_path / "times.csv", "-o", tmp_path / "a")
    assert far.exit_code != 0
    assert not (tmp_path / "a").exists()
    good = run(*common, "--times", tmp_path / "times.csv", "--clock-offset", "-7200", "-o", tmp_path / "a")
    assert good.exit_code == 0, good.output
    back = open_scan(tmp_path / "a")
    np.testing.assert_allclose(back.thermal.depth_times_s, scan.thermal.times_s, atol=1e-9)
    np.testing.assert_array_equal(back.thermal.load(2), scan.thermal.load(2))
    assert back.thermal.camera.signal.curve == scan.thermal.camera.signal.curve  # the rig's own
    linear = run(*common, "--fps", 15, "--gain", 0.01, "--offset-degC", -100, "--band", "8-14", "-o", tmp_path / "b")
    assert linear.exit_code == 0, linear.output
    camera = json.loads((tmp_path / "b/scan.json").read_text())["cameras"]["thermal"]
    assert camera["band_um"] == [8.0, 14.0]
    assert camera["signal"]["curve"] == {"type": "linear_kelvin", "gain_K": 0.01, "offset_K": pytest.approx(173.15)}


def test_thermal_finds_no_place_among_assumed_times(tmp_path):
    scan, _ = bare_and_frames(tmp_path)
    frames = replace(read_thermal(tmp_path / "frames", ThermalSaid(1, 0)), times_s=scan.thermal.times_s)
    with pytest.raises(ScanError, match=r"depth carries no times.*--times LIST"):
        with_thermal(replace(scan, thermal=None, times_assumed=True), frames, tmp_path / "rig.json")


def test_opencv_compressed_pages_are_read(tmp_path):
    pages = [np.full((6, 7), 20 + i, np.float32) for i in range(3)]
    put(tmp_path / "a.tiff", cv2.imencodemulti(".tiff", pages)[1].tobytes())
    frames = read_thermal(tmp_path / "a.tiff")
    assert [float(frames.apparent_degC(i)[0, 0]) for i in range(3)] == [20, 21, 22]
