"""Bytes of a Kinect v1: isochronous packets, commands, fixed parameters, accelerometer. Pure, nothing is sent."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import ResourceError

HEADER = struct.Struct("<2sBBBBBBI")  # magic, pad, flag, ?, sequence, ?, ?, ticks
MAGIC = b"RB"
DEPTH, VIDEO = 0x70, 0x80  # upper half of a packet's flag
START, MIDDLE, END = 1, 2, 5  # lower half
DEPTH_PAYLOAD, VIDEO_PAYLOAD = 1748, 1908  # bytes of a packet behind its header
SHAPE = (480, 640)  # of depth and colour, px
INFRARED_SHAPE = (488, 640)  # px
DEPTH_BYTES, BAYER_BYTES, INFRARED_BYTES = 422_400, 307_200, 390_400  # 11, 8 and 10 bits a pixel
MAX_MOTOR_DEG = 31  # tilt beyond is refused by the mechanics
COMMAND = struct.Struct("<2sHHH")  # magic, words of the body, command, tag
COMMAND_MAGIC, REPLY_MAGIC = b"GM", b"RB"
WRITE_REGISTER, FIXED_PARAMETERS, ALGORITHM_PARAMETERS = 0x03, 0x04, 0x16
AUDIO_MAGIC, AUDIO_ACK = 0x06022009, 0x0A6FE000


@dataclass(frozen=True, eq=False)
class Whole:
    """A whole frame: its bytes, the device's ticks, and how many frames before it were not whole."""

    data: bytes
    ticks: int
    lost: int


class Assembler:
    """Packets of one stream into whole frames; a frame with a packet missing is dropped and counted.

    kind : DEPTH or VIDEO. frame_bytes : of a frame. payload : of a full packet, bytes.
    """

    def __init__(self, kind: int, frame_bytes: int, payload: int) -> None:
        self._kind, self._size, self._payload = kind, frame_bytes, payload
        self._parts: list[bytes] = []
        self._filled = self._sequence = self._lost = 0
        self._open = False
        self._ticks_before: int | None = None
        self.strange = 0  # packets that are none of ours: another magic or kind, too short, too long

    def feed(self, packet: bytes | memoryview) -> Whole | None:
        """The frame that this packet ends, if it does. Never raises."""
        if len(packet) == 0:
            return None  # a microframe without data
        if len(packet) < HEADER.size or len(packet) > HEADER.size + self._payload:
            self.strange += 1
            return None
        magic, _, flag, _, sequence, _, _, ticks = HEADER.unpack_from(packet)
        if magic != MAGIC or flag & 0xF0 != self._kind or flag & 0x0F not in (START, MIDDLE, END):
            self.strange += 1
            return None
        step = flag & 0x0F
        if step == START:
            self._lost += self._open  # the one before never ended
            self._parts, self._filled, self._open = [], 0, True
        elif self._open and sequence != (self._sequence + 1) & 0xFF:
            self._drop()
        self._sequence = sequence
        if not self._open:
            return None
        body = bytes(packet[HEADER.size :])
        self._parts.append(body)
        self._filled += len(body)
        if self._filled > self._size or (step != END and len(body) != self._payload):
            self._drop()
        elif step == END:
            return self._ended(ticks)
        return None

    def _drop(self) -> None:
        self._open, self._parts = False, []
        self._lost += 1

    def _ended(self, ticks: int) -> Whole | None:
        if self._filled != self._size:
            self._drop()
            return None
        data, lost = b"".join(self._parts), self._lost
        self._open, self._parts, self._lost = False, [], 0
        return Whole(data, ticks, lost)


def unpack_bits(data: bytes, bits: int) -> NDArray[np.uint16]:
    """(N,) numbers of `bits` bits (8 to 16), packed most significant bit first; what is left over is padding."""
    period = math.lcm(bits, 8)
    width, count = period // 8, period // bits
    whole = len(data) // width * width
    groups = np.zeros((whole // width, width + 3), np.uint8)
    groups[:, :width] = np.frombuffer(data, np.uint8, whole).reshape(-1, width)
    columns = groups.T.astype(np.uint32)
    out = np.empty((whole // width, count), np.uint16)
    for k in range(count):
        byte, shift = divmod(k * bits, 8)
        window = columns[byte] << 16 | columns[byte + 1] << 8 | columns[byte + 2]
        out[:, k] = window >> np.uint32(24 - bits - shift) & np.uint32((1 << bits) - 1)
    return out.ravel()


def command(number: int, tag: int, body: bytes) -> bytes:
    """A camera command; body : whole 16-bit words."""
    return COMMAND.pack(COMMAND_MAGIC, len(body) // 2, number, tag) + body


def reply_body(reply: bytes, number: int, tag: int) -> bytes:
    """The body of a camera's reply to a command. Raises ResourceError for another one's, or a torn one."""
    if len(reply) < COMMAND.size:
        raise ResourceError(f"the Kinect's reply has {len(reply)} bytes, expected at least {COMMAND.size}")
    magic, words, of, tagged = COMMAND.unpack_from(reply)
    body = reply[COMMAND.size :]
    if magic != REPLY_MAGIC or (of, tagged) != (number, tag) or 2 * words > len(body):
        raise ResourceError(f"the Kinect's reply to command {number:02x} does not fit it")
    return body[: 2 * words]


@dataclass(frozen=True)
class Constants:
    """What a Kinect says of its own depth: `scans.formats.fakenect.KinectDepth` in the device's words, cm and 1."""

    emitter_cm: float
    reference_cm: float
    pixel_cm: float
    const_shift: float


def constants_of(fixed: bytes, shift: bytes) -> Constants | None:
    """From the replies for fixed parameters (floats at +94) and const shift; None where they are no such numbers."""
    if len(fixed) < 110 or len(shift) < 2:
        return None
    emitter, _, reference, pixel = struct.unpack_from("<4f", fixed, 94)
    const = float(struct.unpack_from("<H", shift, len(shift) - 2)[0])
    bounds = ((emitter, 1, 30), (reference, 10, 1000), (pixel, 0.01, 1), (const, 1, 2047))
    if not all(math.isfinite(x) and low <= x <= high for x, low, high in bounds):
        return None
    return Constants(emitter, reference, pixel, const)


@dataclass(frozen=True)
class Tilt:
    """The motor's state: acceleration in g along the device's axes, tilt in degrees (NaN while it moves), status."""

    acceleration_g: tuple[float, float, float]
    tilt_deg: float
    status: int


def tilt_of(reply: bytes, counts_per_g: float) -> Tilt | None:
    """From the 10 bytes of a model 1414's motor; None for fewer."""
    if len(reply) < 10:
        return None
    x, y, z, tilt, status = struct.unpack_from(">hhhbB", reply, 2)
    return Tilt((x / counts_per_g, y / counts_per_g, z / counts_per_g), math.nan if tilt == -128 else tilt / 2, status)


def audio_tilt_of(reply: bytes, counts_per_g: float) -> Tilt | None:
    """From the 104 bytes that the audio device of later models sends; None for fewer."""
    if len(reply) < 32:
        return None
    x, y, z, tilt = struct.unpack_from("<4i", reply, 16)
    return Tilt((x / counts_per_g, y / counts_per_g, z / counts_per_g), float(tilt), 0)


def audio_command(tag: int, length: int, number: int, argument: int) -> bytes:
    """A command to the audio device of later models."""
    return struct.pack("<5I", AUDIO_MAGIC, tag, length, number, argument & 0xFFFFFFFF)


def audio_acknowledged(reply: bytes, tag: int) -> bool:
    """Whether a 12-byte acknowledgement is that of the command with this tag."""
    return len(reply) >= 12 and struct.unpack_from("<2I", reply) == (AUDIO_ACK, tag)
