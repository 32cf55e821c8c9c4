"""Cameras without hardware: parsers on bytes against independent packing, devices on a fake bus, refused writes."""

from __future__ import annotations

import itertools
import struct
from contextlib import suppress

import numpy as np
import pytest
from support import fake_usb as fake

from thermofusion.errors import ResourceError
from thermofusion.recording.device import UnpluggedError
from thermofusion.recording.devices import cameras, chosen, infiray, kinect, lepton, p2pro, seek
from thermofusion.recording.devices import kinect_packets as wire
from thermofusion.recording.devices.marks import ShutterMarks
from thermofusion.recording.devices.v4l2 import node_of
from thermofusion.recording.usb import Guarded, RefusedWriteError

RNG = np.random.default_rng(8)


def mangled(data, seed):
    """Bytes with some flipped, cut, doubled."""
    rng = np.random.default_rng(seed)
    out = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at, kind = int(rng.integers(0, max(len(out), 1))), rng.integers(0, 3)
        if kind == 0 and out:
            out[at] = int(rng.integers(0, 256))
        elif kind == 1:
            del out[at : at + int(rng.integers(1, 3000))]
        else:
            out[at:at] = out[: int(rng.integers(1, 3000))]
    return bytes(out)


# ---------------------------------------------------------------- parsers


@pytest.mark.parametrize("bits", [8, 10, 11, 12, 16])
def test_packed_pixels_are_unpacked(bits):
    values = RNG.integers(0, 1 << bits, 16 * 110).astype(np.uint16)
    np.testing.assert_array_equal(wire.unpack_bits(fake.packed(values, bits), bits), values)


def test_a_kinects_first_11_bit_pixels_are_where_the_protocol_puts_them():
    # 2047, 0, 1, 1024: 11111111 11100000 00000000 00000110 0000 0000 ...
    assert wire.unpack_bits(bytes([0xFF, 0xE0, 0x00, 0x00, 0x60, 0x00, 0, 0, 0, 0, 0]), 11)[:4].tolist() == [
        2047,
        0,
        0,
        1536,
    ]


def assembled(packets):
    frames = wire.Assembler(wire.DEPTH, wire.DEPTH_BYTES, wire.DEPTH_PAYLOAD)
    return frames, [whole for p in packets if (whole := frames.feed(p)) is not None]


def test_a_frame_of_packets_is_whole_or_counted():
    data = [bytes(RNG.integers(0, 256, wire.DEPTH_BYTES, dtype=np.uint8)) for _ in range(4)]
    packets = [fake.iso_packets(d, 1748, 0x70, 100 + i, 242 * i) for i, d in enumerate(data)]
    del packets[1][57], packets[2][-1]  # a packet in the middle, and the last: its frame never ends
    _, found = assembled(itertools.chain(*packets))
    assert [(f.data == data[i], f.ticks, f.lost) for i, f in zip((0, 3), found, strict=True)] == [
        (True, 100, 0),
        (True, 103, 2),
    ]


def test_strange_packets_change_nothing():
    good = fake.iso_packets(bytes(wire.DEPTH_BYTES), 1748, 0x70, 1)
    strange = [b"", b"RB", bytes(5000), b"XX" + good[1][2:], good[1][:3] + b"\x82" + good[1][4:]]
    frames, found = assembled([*good[:100], *strange, *good[100:]])
    assert len(found) == 1
    assert frames.strange == 4  # the empty one is a microframe without data


def test_malformed_bytes_never_break_a_parser():
    iso = fake.iso_packets(bytes(wire.DEPTH_BYTES), 1748, 0x70, 1)
    p3 = fake.SimulatedP3()
    stream = b"".join(p3._bytes() for _ in range(3))
    for seed in range(25):
        assembled(mangled(p, seed) for p in iso[:40])
        planes = infiray.Assembler(256, 192)
        for part in range(0, len(stream), 16_384):
            planes.feed(mangled(stream[part : part + 16_384], seed + part))
        reply = mangled(struct.pack("<2sHHH", b"RB", 2, 4, 1) + bytes(322), seed)
        wire.constants_of(reply, reply[:4])
        wire.tilt_of(reply, 819.0)
        wire.audio_tilt_of(reply, 819.0)
        with suppress(ResourceError):
            assert len(wire.reply_body(reply, 4, 1)) == 4
        words = np.frombuffer(mangled(fake.lepton_frame(seed), seed)[:320].ljust(2, b"\0"), np.uint8)
        lepton.TelemetryReader().read(words[: len(words) // 2 * 2].view("<u2"))
        seek.Corrector(seek.MODELS[0x289D, 0x0010]).feed(mangled(bytes(64_896), seed))
        p2pro.temperatures(mangled(bytes(p2pro.FRAME_BYTES), seed))


class _nothing:
    def __enter__(self):
        return self

    def __exit__(self, *_):
        return False


def test_p3_commands_have_the_bytes_that_its_own_program_sends():
    assert infiray.START.hex() == "012f8100000000000000000001000000" + "4930"
    assert infiray.SHUTTER.hex() == "01364300000000000000000000000000" + "cd0b"


def test_p3_frames_are_found_again_after_a_gap():
    camera = fake.SimulatedP3()
    stream = [camera._bytes() for _ in range(6)]
    planes = infiray.Assembler(256, 192)
    torn = stream[0][5000:] + stream[1] + stream[2][:90_000] + stream[4] + stream[5]
    found = [p for i in range(0, len(torn), 10_007) for p in planes.feed(torn[i : i + 10_007])]
    assert [p.data == camera.frame(k).tobytes() for k, p in zip((1, 4, 5), found, strict=True)] == [True] * 3
    assert [(p.ticks, p.lost) for p in found] == [(1000, 0), (4000, 2), (5000, 0)]
    assert planes.skipped == len(stream[0]) - 5000 + 90_000


@pytest.mark.parametrize("lost", [0, 1, 3, 50, 51, 52, 200])
def test_a_counter_that_wraps_within_a_step_tells_what_was_lost(lost):
    assert infiray.lost_between(40 * 49 % 2048, 40 * (50 + lost) % 2048) == lost


@pytest.mark.parametrize("high_first", [True, False])
def test_lepton_telemetry_whichever_word_is_the_high_one(high_first):
    reader = lepton.TelemetryReader()
    rows = [np.frombuffer(fake.lepton_frame(k, k == 3, high_first)[2 * 160 * 120 :], "<u2") for k in range(5)]
    read = [reader.read(r) for r in rows][1:]
    assert [r.uptime_ms for r in read] == [200_000 + 115 * k for k in range(1, 5)]
    assert [r.frame for r in read] == [70_000 + k for k in range(1, 5)]
    assert [r.correcting for r in read] == [False, False, True, False]
    assert read[0].fpa_degC == pytest.approx(32.0)
    assert reader.read(np.zeros(160, np.uint16)) is None  # no telemetry in these rows


# ---------------------------------------------------------------- devices


def collected(device, count, tries=400):
    frames = []
    for _ in range(tries):
        frames += device.read()
        if len(frames) >= count:
            return frames
    raise AssertionError(f"{len(frames)} frames of {count}")


def test_p3_starts_streams_corrects_drops_and_stops():
    camera = fake.SimulatedP3()
    waits = []
    device = infiray.InfirayP(*fake.on_bus(camera), wait=waits.append)
    device.start()
    assert camera.steps == ["start", "ee", "start"]
    assert waits == [1.0, 2.0]
    assert camera.claimed == {0, 1}
    frames = collected(device, 3)
    assert [bytes(f.data) == camera.frame(k).tobytes() for k, f in enumerate(frames)] == [True] * 3
    assert not any(f.shutter or f.lost for f in frames)
    camera.skip += 2
    frames = collected(device, 1)
    assert frames[0].lost == 2
    assert device.shutter()
    assert camera.shutters == 1
    assert collected(device, 1)[0].shutter
    device.stop()
    device.stop()
    assert camera.alternates[1] == 0
    assert not camera.claimed


def test_p3_unplugged_in_mid_frame_says_so():
    camera = fake.SimulatedP3()
    device = infiray.InfirayP(*fake.on_bus(camera), wait=lambda s: None)
    device.start()
    collected(device, 1)
    camera.plugged = False
    with pytest.raises(UnpluggedError, match="gone from the bus"):
        device.read()
    device.stop()


def test_seek_pictures_are_relative_to_the_last_shutter():
    camera = fake.SimulatedSeek()
    device = seek.Seek(*fake.on_bus(camera))
    device.start()
    frames = collected(device, 4)
    pictures = [np.frombuffer(f.data, "<u2") for f in frames]
    # frames 2, 3, 4 follow the shutter frame 1; 5 is a shutter; the first after each is marked
    assert [int(p[100]) - 0x4000 for p in pictures] == [2, 3, 4, 6]
    assert all((np.delete(p, [10, 100]) == 0x4000).all() for p in pictures)
    assert [f.shutter for f in frames] == [True, False, False, True]
    assert device.streams[0].about["relative"]
    camera.cut = True
    assert not device.read()
    camera.cut = False
    assert sum(f.lost for f in collected(device, 1)) == 1
    device.stop()
    assert camera.idle >= 3
    assert not camera.running
    assert not device.shutter()
    camera.plugged = False
    with pytest.raises(UnpluggedError):
        device.read()


def kinect_of(camera, stream, motor=None, **options):
    devices = fake.on_bus(*([camera] if motor is None else [camera, motor]))
    return kinect.Kinect(devices[0], None if motor is None else devices[1], packets=lambda: stream, **options)


def test_kinect_frames_come_bit_for_bit_with_ticks_that_wrap():
    camera, motor = fake.SimulatedKinect(), fake.SimulatedMotor()
    stream = fake.SimulatedStream(camera, 5, lose=[(2, 30)])
    device = kinect_of(camera, stream, motor)
    device.start()
    assert stream.started
    assert camera.registers == {
        **{0x105: 0, 0x06: 2, 0x12: 3, 0x13: 1, 0x14: 0x1E, 0x17: 0},
        **{0x0C: 0, 0x0D: 1, 0x0E: 0x1E, 0x05: 1, 0x47: 0},
    }
    frames = collected(device, 10)
    depth, color, tilt = ([f for f in frames if f.stream == row] for row in range(3))
    for k, frame in zip((0, 1, 3, 4), depth, strict=True):
        np.testing.assert_array_equal(np.frombuffer(frame.data, np.uint16), camera.disparity(k))
        assert frame.ticks == (2**32 - 3_000_000 + 2_000_000 * k) % 2**32
    assert [f.lost for f in depth] == [0, 0, 1, 0]
    assert [bytes(f.data) for f in color] == [camera.bayer(k).tobytes() for k in range(5)]
    assert struct.unpack("<3d", tilt[0].data) == pytest.approx((0, 1, -41 / 819))
    about = device.streams[0].about
    assert about["kinect_depth"] == pytest.approx(
        {"emitter_cm": 7.5, "reference_cm": 120, "pixel_cm": 0.1042, "const_shift": 200}
    )
    device.stop()
    assert (camera.registers[0x06], camera.registers[0x05], stream.stopped) == (0, 0, True)
    assert motor.written[-1] == (0x40, 0x06, 1, 0, b"")  # green again


def test_kinect_unplugged_in_mid_frame_keeps_what_was_whole():
    camera = fake.SimulatedKinect()
    device = kinect_of(camera, fake.SimulatedStream(camera, 9, unplug_at=2))
    device.start()
    frames = collected(device, 4)
    assert [f.stream for f in frames] == [0, 1, 0, 1]
    assert not device.read()
    with pytest.raises(UnpluggedError):
        device.read()
    device.stop()


def test_a_kinect_that_does_not_answer_is_no_endless_wait(monkeypatch):
    camera = fake.SimulatedKinect()
    camera.silent = True
    monkeypatch.setattr(kinect, "REPLY_S", 0.02)
    device = kinect_of(camera, fake.SimulatedStream(camera, 1))
    with pytest.raises(ResourceError, match="did not reply"):
        device.start()


@pytest.mark.parametrize("motor", [fake.SimulatedMotor, fake.SimulatedAudio])
def test_kinect_motors_tilt_within_their_mechanics(motor):
    simulated = motor()
    device = kinect.Motor(*fake.on_bus(simulated))
    device.tilt(90)
    device.tilt(-12)
    said = [w[2] if motor is fake.SimulatedMotor else struct.unpack("<5I", w[1])[4] for w in simulated.written]
    wrap, scale = (2**16, 2) if motor is fake.SimulatedMotor else (2**32, 1)
    assert said == [31 * scale, -12 * scale % wrap]
    state = device.state()
    assert state.acceleration_g[1] == pytest.approx(1)
    assert state.tilt_deg == (-5 if motor is fake.SimulatedMotor else 7)
    for led in (kinect.LED_OFF, kinect.LED_GREEN, kinect.LED_RED):
        device.led(led)


def test_infrared_takes_colours_place():
    camera = fake.SimulatedKinect()
    device = kinect_of(camera, fake.SimulatedStream(camera, 0), video="infrared")
    device.start()
    assert camera.registers[0x05] == 3
    assert [(s.name, s.height_px) for s in device.streams] == [("kinect/disparity", 480), ("kinect/infrared", 488)]


def test_lepton_and_p2_pro_on_a_video_node():
    capture = fake.FakeCapture(
        [fake.lepton_frame(0), fake.lepton_frame(0), None, b"torn", fake.lepton_frame(1, correcting=True)]
    )
    device = lepton.Lepton(capture)
    device.start()
    assert capture.units == [lepton.TLINEAR_ON]
    frames = collected(device, 2)
    assert [(bytes(f.data) == fake.lepton_frame(k)[:38_400], f.lost) for k, f in enumerate(frames)] == [
        (True, 0),
        (True, 1),
    ]
    assert [f.shutter for f in frames] == [False, True]
    assert frames[0].fpa_degC == pytest.approx(32.0)
    assert device.shutter()
    assert capture.units[-1] == lepton.RUN_FFC
    device.stop()
    assert capture.closed
    plane = RNG.integers(0, 65536, 256 * 192, dtype=np.uint16)
    halves = bytes(2 * 256 * 192) + plane.tobytes()
    capture = fake.FakeCapture([halves, halves, bytes(7), bytes(2 * len(plane)) + bytes(2 * len(plane))])
    capture.frames.append(UnpluggedError("the node is gone"))
    device = p2pro.P2Pro(capture)
    device.start()
    frames = collected(device, 3)
    assert bytes(frames[0].data) == plane.tobytes()
    assert [f.shutter for f in frames] == [False, True, False]  # the second is frozen
    assert [f.lost for f in frames] == [0, 0, 1]
    with pytest.raises(UnpluggedError):
        device.read()
    device.stop()


def test_plain_counts_of_a_lepton_without_radiometry_are_marked():
    counts = np.full(160 * 120, 8000, "<u2").tobytes()
    device = lepton.Lepton(fake.FakeCapture([counts]))
    device.start()
    assert collected(device, 1)[0].shutter


# ---------------------------------------------------------------- writes


def test_only_writes_that_are_known_to_be_safe_are_sent():
    cases = [
        (fake.SimulatedP3(), infiray.WRITES, [(0x41, 0x20, 0, 0, infiray.START), (0x40, 0xEE, 0, 1, b"")]),
        (fake.SimulatedKinect(), kinect.CAMERA_WRITES, [(0x40, 0, 0, 0, wire.command(3, 9, b"\x06\0\x02\0"))]),
        (fake.SimulatedMotor(), kinect.MOTOR_WRITES, [(0x40, 0x31, 62, 0, b""), (0x40, 0x06, 6, 0, b"")]),
        (fake.SimulatedSeek(), seek.writes(seek.MODELS[0x289D, 0x0010]), [(0x41, 60, 0, 0, b"\x01\x00")]),
    ]
    for camera, rules, good in cases:
        guarded = Guarded(*fake.on_bus(camera), rules)
        for request in good:
            sent = len(camera.written)
            guarded.write(*request)
            assert len(camera.written) == sent + 1
        sent = len(camera.written)
        for type_, request, value, index, data in good:
            bad = [(type_, request ^ 1, value, index, data), (type_ ^ 2, request, value, index, data)]
            bad += [(type_, request, value ^ 1, index, data), (type_, request, value, index ^ 2, data)]
            bad += [(type_, request, value, index, data + b"\x01"), (type_ | 0x80, request, value, index, data)]
            for wrong in bad:
                with pytest.raises(RefusedWriteError):
                    guarded.write(*wrong)
        with pytest.raises(RefusedWriteError):
            guarded.bulk_write(0x01, b"anything")
        assert len(camera.written) == sent
    for register, value in [(0x06, 1), (0x12, 2), (0x99, 0)]:
        assert not kinect.is_safe(0, 0, wire.command(3, 1, struct.pack("<2H", register, value)))
    assert not kinect.is_safe_audio(0x01, wire.audio_command(1, 0, 0x803B, 32))
    for number in (*p2pro.NEVER, 0x8405):
        with pytest.raises(RefusedWriteError):
            p2pro.vendor_command(number)
    with pytest.raises(RefusedWriteError):
        lepton.Lepton(fake.FakeCapture([]))._set((6, 1, b"\0"))


# ---------------------------------------------------------------- the bus


def test_cameras_on_the_bus_are_found_with_their_parts():
    devices = fake.on_bus(
        fake.SimulatedKinect(address=3), fake.SimulatedMotor(address=2), fake.SimulatedP3(address=4), fake.Simulated()
    )
    found = cameras(devices)
    assert [f.name for f in found] == ["Kinect v1", "Thermal Master P3"]
    assert [len(f.parts) for f in found] == [1, 0]
    assert chosen(["p3"], found) == [found[1]]
    assert chosen([], found) == found
    assert isinstance(found[0].open(), kinect.Kinect)
    with pytest.raises(ResourceError, match="no camera is called 'optris'; on the bus: Kinect v1, Thermal Master P3"):
        chosen(["optris"], found)


def test_a_video_node_is_found_by_vendor_and_product(tmp_path):
    for i, (vendor, index) in enumerate([("1234", "0"), ("0bda", "1"), ("0bda", "0")]):
        usb, node = tmp_path / f"usb{i}", tmp_path / "class" / f"video{i}"
        (usb / "interface").mkdir(parents=True)
        node.mkdir(parents=True)
        (usb / "idVendor").write_text(vendor)
        (usb / "idProduct").write_text("5830\n")
        (node / "device").symlink_to(usb / "interface")
        (node / "index").write_text(index + "\n")
    assert str(node_of(0x0BDA, 0x5830, tmp_path / "class")) == "/dev/video2"
    with pytest.raises(ResourceError, match="has no video node"):
        node_of(0x1E4E, 0x0100, tmp_path / "class")


def test_marks_of_corrections():
    marks, now = ShutterMarks(25.0), 10**12
    period = 40_000_000
    assert [marks.spoiled(now + k * period, bytes([k])) for k in range(3)] == [False] * 3
    assert marks.spoiled(now + 3 * period, bytes([2]))  # frozen
    assert not marks.spoiled(now + 4 * period, b"x")
    assert marks.spoiled(now + 9 * period, b"y")  # after a pause
    marks.asked(now + 10 * period)
    assert [marks.spoiled(now + (10 + k) * period, bytes([k])) for k in (1, 24, 26)] == [True, True, False]
    assert not marks.spoiled(now + 38 * period, b"z")
