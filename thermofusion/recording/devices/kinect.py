"""Kinect v1 (models 1414, 1473 and Kinect for Windows): depth, colour or infrared, tilt. Never tried on hardware.

Facts of the OpenKinect project's protocol notes. Depth and video are isochronous streams of the camera device; tilt
motor, LED and accelerometer are a device of their own (1414), or the audio device (1473, K4W; needs its firmware).
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any, Literal

from ...errors import ResourceError
from ...scans.formats.fakenect import COUNTS_PER_G, TICK_HZ, KinectDepth
from ..device import POLL_S, Frame, StreamInfo, UnpluggedError
from ..iso import IsoQueue, PacketSource
from ..usb import Allowed, Guarded, only
from . import kinect_packets as wire

CAMERAS = {(0x045E, 0x02AE): "Kinect v1", (0x045E, 0x02BF): "Kinect for Windows v1"}
MOTOR, AUDIO = (0x045E, 0x02B0), (0x045E, 0x02AD)
MODEL_1414 = 267  # bcdDevice of a camera whose motor device works
DEPTH_ENDPOINT, VIDEO_ENDPOINT = 0x82, 0x81
TILT_EVERY_S = 0.5  # a rig that is carried turns slowly
SILENT_S = 1.0  # without a packet for so long, it is asked whether it is still there
REPLY_S = 1.0  # time for a camera's reply
MAX_POLLS = 200  # of a reply, whatever the clock does
RATE_HZ = 30.0  # of both streams
COLOR_F_PX = 525.0  # nominal: a rig.json replaces it
LED_OFF, LED_GREEN, LED_RED = 0, 1, 2

# Register -> values that are known to be safe, and the orders in which streams are started.
SAFE = {0x05: (0, 1, 3), 0x06: (0, 2), 0x0C: (0,), 0x0D: (1,), 0x0E: (0x1E,), 0x12: (3,), 0x13: (1,), 0x14: (0x1E,)}
SAFE |= {0x17: (0,), 0x19: (0,), 0x1A: (1,), 0x1B: (0x1E,), 0x47: (0,), 0x48: (0,), 0x105: (0,)}
START_DEPTH = ((0x105, 0), (0x06, 0), (0x12, 3), (0x13, 1), (0x14, 0x1E), (0x06, 2), (0x17, 0))
START_COLOR = ((0x0C, 0), (0x0D, 1), (0x0E, 0x1E), (0x05, 1), (0x47, 0))
START_INFRARED = ((0x19, 0), (0x1A, 1), (0x1B, 0x1E), (0x105, 0), (0x05, 3), (0x48, 0))
STOP = ((0x06, 0), (0x05, 0))


def is_safe(value: int, index: int, data: bytes) -> bool:
    """Whether a command to the camera may be sent: a register that is known with a value that is, or a question."""
    if value or index or len(data) < wire.COMMAND.size:
        return False
    magic, words, number, _ = wire.COMMAND.unpack_from(data)
    body = data[wire.COMMAND.size :]
    if magic != wire.COMMAND_MAGIC or 2 * words != len(body):
        return False
    if number == wire.WRITE_REGISTER:
        return len(body) == 4 and struct.unpack("<2H", body)[1] in SAFE.get(struct.unpack("<2H", body)[0], ())
    return number in (wire.FIXED_PARAMETERS, wire.ALGORITHM_PARAMETERS) and len(body) <= 10


def is_safe_audio(endpoint: int, data: bytes) -> bool:
    """Whether a bulk command to the audio device may be sent: tilt within the mechanics, LED, state."""
    if endpoint != 0x01 or len(data) != 20 or struct.unpack_from("<I", data)[0] != wire.AUDIO_MAGIC:
        return False
    number, argument = struct.unpack_from("<Ii", data, 12)
    if number == 0x803B:
        return abs(argument) <= wire.MAX_MOTOR_DEG
    return (number == 0x10 and 0 <= argument <= 6) or (number == 0x8032 and argument == 0)


CAMERA_WRITES = (Allowed(0x40, 0x00, is_safe),)
_TILTS = tuple(2 * d & 0xFFFF for d in range(-wire.MAX_MOTOR_DEG, wire.MAX_MOTOR_DEG + 1))
MOTOR_WRITES = (
    Allowed(0x40, 0x31, only(b"", values=_TILTS)),
    Allowed(0x40, 0x06, only(b"", values=(0, 1, 2, 3, 4, 6))),
)


class Motor:
    """Tilt, LED and accelerometer of either generation; works as far as the device answers."""

    def __init__(self, device: Any) -> None:
        self._old = (device.idVendor, device.idProduct) == MOTOR
        self._usb = Guarded(device, MOTOR_WRITES if self._old else (), is_safe_audio)
        self._tag = 0
        if not self._old:
            self._usb.claim(0)

    def led(self, state: int) -> None:
        """Set the LED: LED_OFF, LED_GREEN, LED_RED."""
        if self._old:
            self._usb.write(0x40, 0x06, state)
        else:
            self._ask(0x10, {LED_OFF: 1, LED_GREEN: 3, LED_RED: 4}[state])

    def tilt(self, degrees: float) -> None:
        """Tilt to an angle above the horizon, clamped to what the mechanics allow."""
        angle = round(max(-wire.MAX_MOTOR_DEG, min(wire.MAX_MOTOR_DEG, degrees)))
        if self._old:
            self._usb.write(0x40, 0x31, 2 * angle & 0xFFFF)
        else:
            self._ask(0x803B, angle)

    def state(self) -> wire.Tilt | None:
        """Acceleration and tilt; None where the device does not answer."""
        if self._old:
            return wire.tilt_of(self._usb.read(0x40, 0x32, length=10), COUNTS_PER_G)
        return wire.audio_tilt_of(self._ask(0x8032, 0, 104), COUNTS_PER_G)

    def _ask(self, number: int, argument: int, length: int = 0) -> bytes:
        self._tag += 1
        self._usb.bulk_write(0x01, wire.audio_command(self._tag, length, number, argument))
        reply = self._usb.bulk_read(0x81, 512, 100) if length else b""
        acknowledged = wire.audio_acknowledged(self._usb.bulk_read(0x81, 512, 100), self._tag)
        return reply if acknowledged else b""

    def close(self) -> None:
        """Give the device back. Never raises."""
        self._usb.release()


class Kinect:
    """A Kinect v1. video : what its second stream shows. packets : makes the packets' source, for tests."""

    def __init__(
        self,
        device: Any,
        motor: Any = None,
        video: Literal["color", "infrared"] = "color",
        packets: Callable[[], PacketSource] | None = None,
    ) -> None:
        self.name = CAMERAS.get((device.idVendor, device.idProduct), "Kinect")
        self.streams: tuple[StreamInfo, ...] = ()
        self._usb, self._video, self._device = Guarded(device, CAMERA_WRITES), video, device
        self._motor = None if motor is None else Motor(motor)
        self._make_packets = packets or (lambda: IsoQueue(device, (DEPTH_ENDPOINT, VIDEO_ENDPOINT)))
        self._packets: PacketSource | None = None
        self._tag, self._tilt_at, self._heard_at = 0, 0.0, time.monotonic()
        size = wire.BAYER_BYTES if video == "color" else wire.INFRARED_BYTES
        self._depth = wire.Assembler(wire.DEPTH, wire.DEPTH_BYTES, wire.DEPTH_PAYLOAD)
        self._second = wire.Assembler(wire.VIDEO, size, wire.VIDEO_PAYLOAD)

    def start(self) -> None:
        """Ask for the device's constants, queue transfers, start depth and video. Raises ResourceError."""
        self._usb.claim(0)
        if (self._device.idVendor, self._device.idProduct) == (0x045E, 0x02BF):
            self._usb.alternate(0, 1)
        self.streams = self._described(self._constants())
        with suppress(ResourceError):
            if self._motor is not None:
                self._motor.led(LED_RED)
        self._packets = self._make_packets()
        self._packets.start()
        self._registers((*START_DEPTH, *(START_COLOR if self._video == "color" else START_INFRARED)))

    def read(self) -> Sequence[Frame]:
        """The frames that arrived. Raises UnpluggedError."""
        assert self._packets is not None
        frames = []
        packets = self._packets.take(POLL_S)
        self._listen(bool(packets))
        for packet in packets:
            row, assembler = (0, self._depth) if packet.endpoint == DEPTH_ENDPOINT else (1, self._second)
            whole = assembler.feed(packet.data)
            if whole is not None:
                frames.append(Frame(row, self._pixels(row, whole.data), packet.host_ns, whole.ticks, whole.lost))
        return [*frames, *self._tilted()]

    def shutter(self) -> bool:
        """It has none."""
        return False

    def stop(self) -> None:
        """Stop both streams and give the device back. Never raises."""
        with suppress(ResourceError):
            self._registers(STOP)
        if self._packets is not None:
            self._packets.stop()
        with suppress(ResourceError):
            if self._motor is not None:
                self._motor.led(LED_GREEN)
        if self._motor is not None:
            self._motor.close()
        self._usb.release()

    def _listen(self, heard: bool) -> None:
        """Ask a camera that has been silent whether it is still there. Raises UnpluggedError."""
        now = time.monotonic()
        if heard:
            self._heard_at = now
        elif now - self._heard_at > SILENT_S:
            self._heard_at = now
            self._usb.read(0x40, 0x00, length=512)

    def _pixels(self, row: int, data: bytes) -> bytes:
        if row == 1 and self._video == "color":
            return data
        return wire.unpack_bits(data, 11 if row == 0 else 10).tobytes()

    def _tilted(self) -> list[Frame]:
        now = time.monotonic()
        if self._motor is None or now < self._tilt_at:
            return []
        self._tilt_at = now + TILT_EVERY_S
        try:
            state = self._motor.state()
        except UnpluggedError:
            self._motor = None  # the cameras go on without it
            return []
        except ResourceError:
            return []
        return [] if state is None else [Frame(2, struct.pack("<3d", *state.acceleration_g), time.monotonic_ns())]

    def _described(self, constants: wire.Constants | None) -> tuple[StreamInfo, ...]:
        model: dict[str, object] = {"model": self.name}
        if constants is not None:
            model["kinect_depth"] = vars(constants)
        f = (KinectDepth() if constants is None else KinectDepth(**vars(constants))).focal_px
        h, w = wire.SHAPE
        depth = StreamInfo("kinect/disparity", "depth", w, h, "mono16", RATE_HZ, model | _lens(f, w, h), TICK_HZ)
        if self._video == "color":
            about = {"model": self.name, "T_color_depth_m": [-0.025, 0, 0]} | _lens(COLOR_F_PX, w, h)
            second = StreamInfo("kinect/color", "color", w, h, "bayer_grbg8", RATE_HZ, about, TICK_HZ)
        else:
            h, w = wire.INFRARED_SHAPE
            second = StreamInfo("kinect/infrared", "infrared", w, h, "mono16", RATE_HZ, {"model": self.name}, TICK_HZ)
        tilt = StreamInfo("kinect/gravity", "gravity", 3, 1, "float64", 1 / TILT_EVERY_S)
        return (depth, second, tilt) if self._motor is not None else (depth, second)

    def _constants(self) -> wire.Constants | None:
        """The device's own constants; None where it does not tell them, which the recording then says."""
        try:
            fixed = self._ask(wire.FIXED_PARAMETERS, struct.pack("<5H", 0, 0, 0, 0, 0))
            shift = self._ask(wire.ALGORITHM_PARAMETERS, struct.pack("<5H", 0x00, 0, 1, 30, 0))
        except UnpluggedError:
            raise
        except ResourceError:
            return None
        return wire.constants_of(fixed, shift)

    def _registers(self, orders: Iterable[tuple[int, int]]) -> None:
        for address, value in orders:
            self._ask(wire.WRITE_REGISTER, struct.pack("<2H", address, value))

    def _ask(self, number: int, body: bytes) -> bytes:
        """A command and the body of its reply. Raises ResourceError where none comes."""
        self._tag = (self._tag + 1) & 0xFFFF
        self._usb.write(0x40, 0x00, data=wire.command(number, self._tag, body))
        until = time.monotonic() + REPLY_S
        for _ in range(MAX_POLLS):
            reply = self._usb.read(0x40, 0x00, length=512)
            if len(reply) not in (0, 512):
                return wire.reply_body(reply, number, self._tag)
            if time.monotonic() > until:
                break
            time.sleep(0.001)
        raise ResourceError(f"it did not reply to command {number:02x}", place=self._usb.name)


def _lens(f_px: float, width_px: int, height_px: int) -> dict[str, object]:
    return {"K": [[f_px, 0, (width_px - 1) / 2], [0, f_px, (height_px - 1) / 2], [0, 0, 1]], "K_nominal": True}
