"""Recordings: what devices deliver is in the file, bit for bit, whatever happens to devices, disk, clock or process."""

from __future__ import annotations

import errno
import json
import os
import random
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from support import fake_usb
from support import scan_maker as make
from support.fake_device import Steady, pixels
from typer.testing import CliRunner

from thermofusion.cli import app
from thermofusion.errors import ResourceError, ScanError
from thermofusion.files import mcap
from thermofusion.files.mcap import scan_mcap
from thermofusion.recording import record as recorder
from thermofusion.recording.devices import infiray, kinect
from thermofusion.recording.record import Beside, Until, record
from thermofusion.recording.replay import open_replay
from thermofusion.recording.ring import Ring
from thermofusion.recording.worker import Delivered, Ended, Started, Worker
from thermofusion.scans import open_scan
from thermofusion.scans.clock import fit_clock
from thermofusion.scans.native.write import scan_json, write_scan


def recorded(out, *devices, until=Until(), **options):  # noqa: B008 - frozen
    """Devices as threads."""
    return record([partial(lambda d: d, d) for d in devices], out, until, own_process=False, **options)


def numbers_of(stream):
    """Which frame each image is, by its pixels."""
    found = []
    for i in range(len(stream)):
        raw = np.rint(np.nan_to_num(stream.load(i)) * 1000).astype(int)
        found.append(int(stream.index[i]))
        np.testing.assert_array_equal(raw, pixels(found[-1]))
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording of 60 frames, one of them lost at the device."""
    out = tmp_path_factory.mktemp("whole") / "rec"
    recorded(out, Steady(lose=[20]))
    return out


# ---------------------------------------------------------------- what is in the file


def test_what_a_device_delivers_is_read_back_bit_for_bit(whole):
    scan = open_scan(whole)
    assert scan.format == "recording"
    assert numbers_of(scan.depth) == [k for k in range(60) if k != 20]
    assert any(re.match(r"1 frame of steady/depth lost: 1 before \d+\.\d\d s$", n) for n in scan.notes)
    assert np.diff(scan.depth.times_s)[:19] == pytest.approx(0.005, abs=1e-4)  # the device's own clock


def test_other_readers_take_the_file_with_its_checksums(whole):
    reader = pytest.importorskip("mcap.reader", reason="the package mcap is not installed")
    with (whole / "recording.mcap").open("rb") as f:
        counts = reader.make_reader(f, validate_crcs=True).get_summary().statistics
        assert counts.message_count == 59 * 2 + 1
        f.seek(0)
        found = list(reader.NonSeekingReader(f, validate_crcs=True).iter_messages(topics=["steady/depth"]))
        assert [m.sequence for _, _, m in found] == [k for k in range(60) if k != 20]
        assert all(m.data.endswith(pixels(m.sequence).tobytes()) for _, _, m in found)
    with (whole / "recording.mcap").open("rb") as f:
        ends, at = [], 8
        while head := f.seek(at) and f.read(9):
            opcode, length = struct.unpack("<BQ", head)
            ends += [length + 9] if opcode == 6 else []
            at += 9 + length
            if opcode == 2:
                break
        assert max(ends) <= 2**20
    rosbags = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")
    from rosbags.typesys import Stores, get_typestore

    with rosbags.AnyReader([whole / "recording.mcap"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        kinds = {c.topic: (c.msgtype, c.msgcount) for c in bag.connections}
        assert kinds["steady/depth"] == ("sensor_msgs/msg/Image", 59)
        topic = next(c for c in bag.connections if c.topic == "steady/depth/info")
        infos = [bag.deserialize(raw, topic.msgtype) for _, _, raw in bag.messages([topic])]
        assert [i.lost for i in infos] == [1 if i.number == 21 else 0 for i in infos]


def test_a_kinect_and_a_p3_through_the_recorder_and_the_reader(tmp_path):
    camera, p3 = fake_usb.SimulatedKinect(), fake_usb.SimulatedP3()
    all_came = threading.Event()

    class Patient(fake_usb.SimulatedStream):
        """Its last frame, which ends the recording, waits until every camera has given one."""

        def take(self, timeout_s):
            return [] if self._next == 5 and not all_came.is_set() else super().take(timeout_s)

    def look(state):
        if {s.info.kind for s in state.streams.values() if s.frames} >= {"depth", "color", "thermal"}:
            all_came.set()

    stream = Patient(camera, 6, lose=[(2, 30)])
    devices = fake_usb.on_bus(camera, fake_usb.SimulatedMotor(), p3)
    depth = kinect.Kinect(devices[0], devices[1], packets=lambda: stream)
    thermal = infiray.InfirayP(devices[2], wait=lambda s: None)
    rig = json.loads(json.dumps({k: scan_json(make.tiny_scan())[k] for k in ("cameras", "extrinsics")}))
    rig["cameras"] = {"thermal": {**rig["cameras"]["thermal"], "width_px": 256, "height_px": 192}}
    del rig["cameras"]["thermal"]["signal"]
    said = {"environment": {"reflected_degC": 21.5}}
    options = {"until": Until(10.0, depth_frames=6), "beside": Beside(said, rig), "status": look}
    state = recorded(tmp_path / "rec", depth, thermal, **options)
    assert not state.problems
    assert state.streams["kinect/disparity"].lost == 1
    scan = open_scan(tmp_path / "rec")
    assert scan.depth.index.tolist() == [0, 1, 3, 4, 5]
    raw = camera.disparity(3).reshape(480, 640)
    table = make_table()
    np.testing.assert_allclose(scan.depth.load(2), np.where(table[raw] > 0, table[raw] / 1000, np.nan), rtol=1e-6)
    assert scan.color.load(0).shape == (480, 640, 3)
    counts = scan.thermal.load(0)
    np.testing.assert_array_equal(counts, p3.frame(int(scan.thermal.index[0])))
    assert scan.thermal.camera.signal.parameters["gain_K"] == (1 / 64,)
    assert scan.environment.reflected_degC == 21.5
    assert any("(0.000, 1.000, -0.050) g" in n for n in scan.notes)


def make_table():
    """Millimetres of a raw disparity by the formula of the device's own constants."""
    raw = np.arange(2048.0)
    m = ((raw - 800) / 4 - 0.375) * np.float32(0.1042)
    with np.errstate(divide="ignore"):
        mm = 10 * (m * 120 / (7.5 - m) + 120)
    return np.where((m < 7.5) & (mm > 0) & (mm < 10_000) & (raw < 2047), np.rint(np.where(m < 7.5, mm, 0)), 0)


def test_bayer_pixels_have_their_colours(tmp_path):
    from thermofusion.scans.formats.recorded import _color

    raw = np.zeros((8, 8), np.uint8)
    raw[0::2, 1::2] = 200  # red in G R / B G
    assert _color(raw)[4, 4].tolist() == [200, 0, 0]


# ---------------------------------------------------------------- torn files


@pytest.fixture
def torn(tmp_path, whole):
    """`torn(n, zeros)` is the recording cut behind byte n, zeros behind it."""
    data = (whole / "recording.mcap").read_bytes()
    folder = tmp_path / "torn"
    folder.mkdir()

    def cut(n, zeros=0):
        (folder / "recording.mcap").write_bytes(data[:n] + bytes(zeros))
        return folder

    return cut


def test_every_whole_frame_before_a_tear_is_read(whole, torn):
    index = scan_mcap(whole / "recording.mcap")
    channel = next(c for c, x in index.channels.items() if x.topic == "steady/depth")
    ends = {e.sequence: e.offset + e.length for e in index.messages if e.channel == channel}
    size = (whole / "recording.mcap").stat().st_size
    chance = random.Random(26)
    for k in range(200):
        at = chance.randrange(10, size)
        expected = [n for n, end in ends.items() if end <= at]
        folder = torn(at, chance.choice([0, 0, 5000]) if k % 2 else 0)
        if not expected:
            with pytest.raises(ScanError, match=r"no whole depth frame|no MCAP"):
                open_scan(folder)
            continue
        scan = open_scan(folder)
        assert scan.depth.index.tolist() == expected, at
        assert any("breaks off after" in n and "without its end" in n for n in scan.notes)
        if k % 20 == 0:
            numbers_of(scan.depth)


def test_the_frame_that_a_tear_went_through_is_named(whole, torn):
    index = scan_mcap(whole / "recording.mcap")
    channel = next(c for c, x in index.channels.items() if x.topic == "steady/depth")
    entry = next(e for e in index.messages if e.channel == channel and e.sequence == 42)
    notes = open_scan(torn(entry.offset + 1000)).notes
    assert any(n.startswith("frame 42 of steady/depth was cut in two") for n in notes), notes


def test_flipped_bytes_never_break_the_reader(whole, torn):
    data = bytearray((whole / "recording.mcap").read_bytes())
    chance, read = random.Random(5), 0
    for _ in range(60):
        folder = torn(0)
        bad = bytearray(data)
        for _ in range(chance.randrange(1, 30)):
            bad[chance.randrange(len(bad))] ^= 1 << chance.randrange(8)
        (folder / "recording.mcap").write_bytes(bad)
        try:
            scan = open_scan(folder)
            for i in range(0, len(scan.depth), 9):
                try:
                    np.testing.assert_array_equal(
                        np.rint(np.nan_to_num(scan.depth.load(i)) * 1000), pixels(int(scan.depth.index[i]))
                    )
                    read += 1
                except ScanError:
                    pass
        except ScanError:
            pass
    assert read > 60


# ---------------------------------------------------------------- what happens to devices, disk, clock


def test_an_unplugged_device_ends_alone_and_is_said(tmp_path):
    state = recorded(tmp_path / "rec", Steady("one", unplug_at=10), Steady("two", kind="thermal", frames=50))
    assert [p for p in state.problems if "one: the device has gone from the bus" in p]
    assert (state.streams["one/depth"].frames, state.streams["two/thermal"].frames) == (10, 50)
    assert scan_mcap(tmp_path / "rec" / "recording.mcap").complete
    assert numbers_of(open_scan(tmp_path / "rec").depth) == list(range(10))


def test_a_drivers_fault_does_not_end_the_others(tmp_path):
    one = Steady("one", break_at=3)
    state = recorded(tmp_path / "rec", one, Steady("two", frames=30))
    assert any("ZeroDivisionError" in p for p in state.problems)
    assert state.streams["two/depth"].frames == 30
    assert one.stopped


def test_nothing_that_starts_leaves_nothing_behind(tmp_path):
    def refuse():
        raise ResourceError("there is no permission to open it", place="045e:02ae at 1:7")

    with pytest.raises(ResourceError, match="nothing was recorded: 045e:02ae at 1:7: there is no permission"):
        record([refuse], tmp_path / "rec", Until(), own_process=False)
    assert not (tmp_path / "rec").exists()
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "notes.txt").write_text("mine")
    with pytest.raises(ScanError, match="it exists already"):
        recorded(tmp_path / "rec", Steady())


@pytest.mark.parametrize("room", [100, 700, 3000, 700_000, 1_000_001])
def test_a_full_disk_leaves_whole_frames_and_is_said(tmp_path, monkeypatch, room):
    written = 0

    def write(file, pieces):
        nonlocal written
        left = room - written
        if left <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        data = b"".join(pieces)[:left]
        written += len(data)
        return os.write(file, data)

    monkeypatch.setattr(mcap, "_write", write)
    if room < 4000:
        with pytest.raises(ResourceError, match=r"No space left|the disk is full"):
            recorded(tmp_path / "rec", Steady())
        return
    state = recorded(tmp_path / "rec", Steady(frames=300))
    assert state.disk_full
    assert any("the disk is full; what was written before is whole" in p for p in state.problems)
    scan = open_scan(tmp_path / "rec")
    kept = numbers_of(scan.depth)
    assert kept == list(range(len(kept)))
    assert state.streams["steady/depth"].frames == len(kept)
    assert room - 700_000 < len(kept) * 6250 < room  # half a second at most was on its way


def test_a_clock_that_jumps_moves_no_frame(tmp_path, monkeypatch):
    real, calls = time.time_ns, []

    def jumping():
        calls.append(1)
        return real() + (3600 * 10**9 if len(calls) > 1 else 0)

    monkeypatch.setattr(time, "time_ns", jumping)
    monkeypatch.setattr(time, "time", lambda: real() * 1e-9 - 7200)
    recorded(tmp_path / "rec", Steady(frames=40))
    t = open_scan(tmp_path / "rec").depth.times_s
    assert t[-1] - t[0] == pytest.approx(39 / 200, abs=0.01)


def test_a_devices_counter_wraps_in_mid_recording(tmp_path):
    recorded(tmp_path / "rec", Steady(frames=60, first_ticks=2**32 - 100_000))
    t = open_scan(tmp_path / "rec").depth.times_s
    assert np.diff(t) == pytest.approx(0.005, abs=1e-6)


def test_a_silent_stream_is_said(tmp_path, monkeypatch):
    class Stuck(Steady):
        def read(self):
            return super().read() if self._next < 5 else time.sleep(0.02) or []

    monkeypatch.setattr(recorder, "SILENT_S", 0.3)
    state = recorded(tmp_path / "rec", Stuck(), Steady("other", frames=20), until=Until(seconds=1.5))
    assert state.problems == ["steady/depth: no frame for 0.3 s"]


def test_a_ring_that_is_full_drops_and_counts_and_never_waits():
    class Slow(Steady):
        def read(self):
            return super().read() if self._next < 30 else []

    worker = Worker(lambda: Slow(rate_hz=1e4, frames=60), own_process=False, ring_bytes=5 * 6144)
    time.sleep(0.5)  # nobody takes anything, 30 frames come, 5 find room
    worker.ask(b"stop")
    said = []
    while not said or not isinstance(said[-1], Ended):
        if (word := worker.take()) is not None:
            said.append(word)
    frames = [s for s in said if isinstance(s, Delivered)]
    assert isinstance(said[0], Started)
    assert [f.number for f in frames] == [0, 1, 2, 3, 4]
    assert said[-1].numbers == (30,)
    worker.end()


def test_ring_bytes_come_out_as_they_went_in():
    import multiprocessing

    ring, chance = Ring(multiprocessing.get_context("spawn"), 1000), random.Random(1)
    waiting, refused = [], 0
    for k in range(2000):
        data = bytes([k % 256]) * chance.randrange(1, 400)
        place = ring.offer(data)
        refused += place is None
        if place is not None:
            waiting.append((data, place))
        if place is None or chance.random() < 0.5:
            data, (offset, end) = waiting.pop(0)
            assert ring.take(offset, len(data), end) == data
    assert 0 < refused < 1500
    assert ring.offer(bytes(1001)) is None


def test_shutter_corrections_are_asked_for_and_marked(tmp_path):
    device = Steady("cam", kind="thermal", frames=60)
    words = iter([None] * 2 + ["shutter"])
    recorded(tmp_path / "rec", Steady(frames=60), device, control=lambda: next(words, None))
    assert device.corrections == 1
    index = scan_mcap(tmp_path / "rec" / "recording.mcap")
    from thermofusion.files.ros import read_frame_info

    topic = next(c for c, x in index.channels.items() if x.topic == "cam/thermal/info")
    data = (tmp_path / "rec" / "recording.mcap").read_bytes()
    marks = [
        read_frame_info(data[e.offset : e.offset + e.length]).shutter for e in index.messages if e.channel == topic
    ]
    assert not marks[0]
    assert marks[-1]


def test_it_begins_and_ends_as_told(tmp_path):
    words = iter([None] * 3 + ["start"])
    state = recorded(tmp_path / "a", Steady(frames=90), until=Until(waits=True), control=lambda: next(words, None))
    assert 0 < state.streams["steady/depth"].frames < 90
    assert state.streams["steady/depth"].lost == 0
    assert open_scan(tmp_path / "a").depth.index[0] == 0
    state = recorded(tmp_path / "b", Steady(frames=9999), until=Until(seconds=0.4))
    assert 1 < state.streams["steady/depth"].frames < 400
    state = recorded(tmp_path / "c", Steady(frames=9999), until=Until(depth_frames=20))
    assert 20 <= state.streams["steady/depth"].frames < 400


def test_seconds_count_from_the_first_frame(tmp_path, monkeypatch):
    class Late(Steady):
        def start(self):
            time.sleep(0.7)
            super().start()

    class Never(Steady):
        def read(self):
            return time.sleep(0.02) or []

    state = recorded(tmp_path / "late", Late(frames=9999), until=Until(seconds=0.4))
    assert 20 < state.streams["steady/depth"].frames < 200
    monkeypatch.setattr(recorder, "FIRST_S", 0.3)
    with pytest.raises(ResourceError, match="no frame came"):
        recorded(tmp_path / "never", Never(), until=Until(seconds=0.2))


# ---------------------------------------------------------------- clocks


@pytest.mark.parametrize(("drift", "jump"), [(0.0, False), (80e-6, False), (-60e-6, True)])
def test_a_devices_clock_is_found_under_its_delays(drift, jump):
    rng = np.random.default_rng(4)
    true = np.arange(3600) / 30.0
    ticks = (true * (1 + drift) * 60e6 + 4e9).astype(np.int64)
    if jump:
        ticks[2000:] -= ticks[2000] - 77  # the device began anew
    arrivals = true + 0.004 + rng.gamma(1.2, 0.006, len(true)) + (rng.random(len(true)) < 0.01) * 0.3
    arrivals = np.maximum.accumulate(arrivals)
    fit = fit_clock(arrivals, ticks % 2**32, 60e6, 2**32)
    assert fit.used
    assert fit.jumps == jump
    assert np.abs(fit.times_s - 0.004 - true).max() < 0.4e-3
    assert -fit.drift == pytest.approx(drift, abs=5e-6)
    assert fit.delay_s == pytest.approx(np.median(arrivals - true) - 0.004, abs=5e-4)


def test_frames_that_wait_at_the_start_keep_their_times():
    true = np.arange(60) / 15.0
    slow = 2.2 + np.arange(60) * 0.004  # a process that started late hands over what waited
    arrivals = np.maximum(true + 0.002, slow)
    fit = fit_clock(arrivals, (true * 1e6).astype(np.int64), 1e6, 2**32)
    assert fit.used
    assert np.abs(fit.times_s - 0.002 - true).max() < 1e-4


def test_a_host_that_stood_still_is_no_jump_of_the_devices_clock():
    true = np.arange(600) / 30.0
    arrivals = true + 0.003
    arrivals[300:330] = np.maximum(arrivals[300:330], arrivals[329] + np.arange(30) * 1e-4)  # a second late, at once
    fit = fit_clock(arrivals, (true * 1e6).astype(np.int64), 1e6, 2**32)
    assert fit.jumps == 0
    assert np.abs(fit.times_s - 0.003 - true).max() < 1e-4


def test_a_clock_that_is_none_is_not_believed():
    host = np.arange(300) / 30.0
    assert not fit_clock(host, np.random.default_rng(1).integers(0, 2**32, 300), 60e6, 2**32).used
    assert not fit_clock(host, (host * 50e6).astype(np.int64), 60e6, 2**32).used  # 20 % off its rate


# ---------------------------------------------------------------- processes


def test_a_scan_played_as_devices_is_the_same_scan(tmp_path):
    write_scan(make.tiny_scan(), tmp_path / "scan")
    arguments = ["record", "--from", str(tmp_path / "scan"), "-o", str(tmp_path / "rec"), "--speed", "20", "--json"]
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code == 0, answer.output
    old, new = open_scan(tmp_path / "scan"), open_scan(tmp_path / "rec")
    for kind in ("depth", "color", "thermal"):
        a, b = getattr(old, kind), getattr(new, kind)
        assert len(a) == len(b)
        for i in range(len(a)):
            np.testing.assert_array_equal(a.load(i), b.load(i))
        np.testing.assert_allclose(a.times_s - old.depth.times_s[0], b.times_s - new.depth.times_s[0], atol=2e-6)
    np.testing.assert_array_equal(old.thermal.camera.T_thermal_depth, new.thermal.camera.T_thermal_depth)
    assert new.environment.reflected_degC == old.environment.reflected_degC
    blackbodies = [r for r in old.references if r.kind == "blackbody"]
    assert [(r.degC, r.frames) for r in new.references] == [(r.degC, r.frames) for r in blackbodies]
    assert blackbodies
    opener = partial(open_replay, tmp_path / "rec", ("depth", "color"), time.monotonic_ns(), 20.0, None)
    record([opener], tmp_path / "again", Until(), own_process=False)
    np.testing.assert_array_equal(open_scan(tmp_path / "again").depth.load(1), old.depth.load(1))


CRASH = """
import signal
import sys
from pathlib import Path
from support.fake_device import Steady
from thermofusion.recording.record import Until, record
class Told(Steady):
    def read(self):
        frames = super().read()
        for f in frames:
            print(self._next - 1, f.host_ns, flush=True)
        return frames
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell in the background has its children ignore it
record([lambda: Told(rate_hz=100.0, frames=10**6)], Path(sys.argv[1]), Until(), own_process=False)
"""


def killed(out, after_s, how=signal.SIGKILL):
    """A recording that is killed: the frames that its device had delivered, host ns of the last."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    process = subprocess.Popen([sys.executable, "-c", CRASH, str(out)], env=env, stdout=subprocess.PIPE, text=True)
    lines = [process.stdout.readline()]
    until = time.monotonic() + after_s
    while time.monotonic() < until:
        lines.append(process.stdout.readline())
    process.send_signal(how)
    try:
        rest, _ = process.communicate(timeout=20)
    finally:
        process.kill()
    return [int(line.split()[1]) for line in [*lines, *rest.splitlines()] if line.count(" ") == 1]


def test_kill_9_costs_half_a_second_at_most(tmp_path):
    chance = random.Random(9)
    for k in range(3):
        made_ns = killed(tmp_path / f"{k}", chance.uniform(0.7, 1.5))
        scan = open_scan(tmp_path / f"{k}")
        kept = numbers_of(scan.depth)
        assert kept == list(range(len(kept)))
        assert (made_ns[-1] - made_ns[len(kept) - 1]) * 1e-9 <= 0.6
        assert any("breaks off after" in n for n in scan.notes)


def test_ctrl_c_ends_a_recording_as_it_should_end(tmp_path):
    made = killed(tmp_path / "rec", 0.5, signal.SIGINT)
    index = scan_mcap(tmp_path / "rec" / "recording.mcap")
    assert index.complete
    assert len(open_scan(tmp_path / "rec").depth) >= len(made) - 2


def test_a_device_whose_process_dies_is_said(tmp_path):
    worker = Worker(partial(Path, "no device"), own_process=True)
    said = None
    until = time.monotonic() + 20
    while not isinstance(said, Ended) and time.monotonic() < until:
        said = worker.take()
        time.sleep(0.01)
    assert "has no attribute" in said.problem
    worker.end()
    assert recorder.FILE == "recording.mcap"
    shutil.rmtree(tmp_path)


def test_a_fakenect_folder_plays_as_a_kinect(tmp_path):
    taken = tmp_path / "taken"
    taken.mkdir()
    frames = [((np.arange(480 * 640) * 3 + 7 * k) % 2048).astype("<u2") for k in range(3)]
    lines = [f"d-{1000 + k / 30:.6f}-{(2**32 - 3_000_000 + 2_000_000 * k) % 2**32}.pgm" for k in range(3)]
    (taken / "INDEX.txt").write_text("\n".join(lines) + "\n")
    for line, frame in zip(lines, frames, strict=True):
        (taken / line).write_bytes(b"P5 640 480 65535\n" + frame.tobytes())
    opener = partial(open_replay, taken, ("depth", "color"), time.monotonic_ns(), 100.0, None)
    record([opener], tmp_path / "rec", Until(), own_process=False)
    old, new = open_scan(taken), open_scan(tmp_path / "rec")
    index = scan_mcap(tmp_path / "rec" / "recording.mcap")
    assert "kinect/disparity" in {c.topic for c in index.channels.values()}
    np.testing.assert_allclose(new.depth.times_s - new.depth.times_s[0], old.depth.times_s, atol=1e-6)
    for k in range(3):
        np.testing.assert_array_equal(old.depth.load(k), new.depth.load(k))


def test_verbs_without_a_camera_say_so(tmp_path, monkeypatch):
    from thermofusion.recording import devices

    monkeypatch.setattr(devices, "cameras", list)
    answer = CliRunner().invoke(app, ["devices", "--json"])
    assert json.loads(answer.output) == {"devices": []}
    with pytest.raises(ResourceError, match="no camera known to thermofusion is on the USB bus; plug one in"):
        CliRunner().invoke(app, ["record", "-o", str(tmp_path / "x")], catch_exceptions=False)
    assert not (tmp_path / "x").exists()
    rules = tmp_path / "60-thermofusion.rules"
    CliRunner().invoke(app, ["doctor", "--udev", str(rules)], catch_exceptions=False)
    text = rules.read_text()
    for (vendor, product), name in devices.KNOWN.items():
        assert f"# {name}\n" in text
        ids = f'ATTRS{{idVendor}}=="{vendor:04x}", ATTRS{{idProduct}}=="{product:04x}"'
        assert f'SUBSYSTEM=="usb", {ids}, MODE="0660", TAG+="uaccess"' in text


def test_the_terminal_shows_what_a_person_must_see(tmp_path):
    from thermofusion.cli.record import state_lines

    warm = {"curve": {"gain_K": 1 / 64, "offset_K": 0.0}}
    shown = []
    device = Steady("cam", kind="thermal", frames=200, signal=warm)
    recorded(tmp_path / "rec", device, Steady(unplug_at=30), status=lambda s: shown.append(state_lines(s)))
    last = "\n".join(shown[-1])
    middle = np.median(pixels(199)[20:28, 28:36]) / 64 - 273.15
    assert re.search(rf"cam/thermal: \d+\.\d Hz, 200 frames, 0 lost, middle {middle:.1f} °C", last), last
    assert "problem: steady: the device has gone from the bus" in last
    assert "GiB free" in shown[0][0]
