"""Thermal Master / InfiRay P3 (256 x 192) and P1 (160 x 120): commands and bulk frames. Never tried on hardware.

Frame: a 12-byte marker, 2 h + 2 rows of w little-endian words (picture, 2 rows of metadata, temperatures in K/64), a
marker again. Commands have 18 bytes, the last two a CRC-16/XMODEM of the rest.
"""

from __future__ import annotations

import binascii
import re
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from ...errors import ResourceError
from ..device import POLL_S, Frame, StreamInfo
from ..usb import Allowed, Guarded, only
from .marks import ShutterMarks

MODELS = {(0x3474, 0x45A2): ("Thermal Master P3", 256, 192), (0x3474, 0x45C2): ("Thermal Master P1", 160, 120)}
MARKER = struct.Struct("<BBIIH")  # its length, sync, frame count, time count, counter
SYNC = (0x8C, 0x8D, 0x8E, 0x8F)  # a marker's second byte
_MARK = re.compile(rb"\x0c[\x8c-\x8f]")
COUNT_WRAP = 2048  # of the third counter, which steps by 40 a frame
COUNT_INVERSE = 205  # 5 * 205 = 1 modulo 256: a step of 40 modulo 2048 is one of 5 modulo 256
ENDPOINT, READ_BYTES = 0x81, 16_384
RATE_HZ = 25.0  # as its makers say
START_WAITS_S = (1.0, 2.0)  # after the first start, after the vendor's request
SIGNAL = {"kind": "counts", "curve": {"type": "linear_kelvin", "gain_K": 1 / 64, "offset_K": 0.0}}


def command(kind: int, parameter: int, register: int = 0, length: int = 0) -> bytes:
    """A command of 18 bytes; length : of the answer."""
    body = struct.pack("<HHH6xHH", kind, parameter, register, length, 0)
    return body + struct.pack("<H", binascii.crc_hqx(body, 0))


START = command(0x2F01, 0x0081, length=1)
SHUTTER = command(0x3601, 0x0043)
WRITES = (Allowed(0x41, 0x20, only(START, SHUTTER)), Allowed(0x40, 0xEE, only(b"", indices=(1,))))


@dataclass(frozen=True, eq=False)
class Plane:
    """The temperature rows of a frame, little-endian K/64; the time count; frames lost before it."""

    data: bytes
    ticks: int
    lost: int


class Assembler:
    """A byte stream into whole frames: finds the markers again after a gap, counts what was lost."""

    def __init__(self, width_px: int, height_px: int) -> None:
        self._head = MARKER.size
        rows = 2 * height_px + 2
        self.frame_bytes = rows * width_px * 2 + 2 * self._head
        self._plane = self._head + (height_px + 2) * width_px * 2
        self._buffer = bytearray()
        self._count: int | None = None
        self.skipped = 0  # bytes that belong to no whole frame

    def feed(self, data: bytes) -> list[Plane]:
        """The frames that these bytes complete. Never raises, keeps less than two frames."""
        self._buffer += data
        found, at, size = [], 0, self.frame_bytes
        while (mark := _MARK.search(self._buffer, at)) is not None and len(self._buffer) - mark.start() >= size:
            self.skipped += mark.start() - at
            at = mark.start()
            plane = self._frame_at(at)
            if plane is None:
                self.skipped += 1
                at += 1
            else:
                found.append(plane)
                at += size
        del self._buffer[:at]
        beyond = len(self._buffer) - 2 * size
        if beyond > 0:  # bytes without any marker
            self.skipped += beyond
            del self._buffer[:beyond]
        return found

    def _frame_at(self, at: int) -> Plane | None:
        _, _, frame, ticks, count = MARKER.unpack_from(self._buffer, at)
        size, sync, again, _, last = MARKER.unpack_from(self._buffer, at + self.frame_bytes - self._head)
        if size != self._head or sync not in SYNC or again != frame or max(count, last) >= COUNT_WRAP:
            return None
        lost = 0 if self._count is None else lost_between(self._count, count)
        self._count = count
        return Plane(bytes(self._buffer[at + self._plane : at + self.frame_bytes - self._head]), ticks, lost)


def lost_between(before: int, after: int) -> int:
    """Frames lost between two counters that step by 40 modulo 2048, known modulo 256; 0 for one that does not fit."""
    step = (after - before) % COUNT_WRAP
    if step % 8:
        return 0
    return (step // 8 * COUNT_INVERSE - 1) % 256


class InfirayP:
    """A P3 or P1. wait : sleeps, for tests."""

    def __init__(self, device: Any, wait: Callable[[float], None] = time.sleep) -> None:
        self.name, w, h = MODELS[device.idVendor, device.idProduct]
        about: dict[str, object] = {"model": self.name, "signal": SIGNAL, "band_um": [8.0, 14.0]}
        thermal = StreamInfo("infiray/thermal", "thermal", w, h, "mono16", RATE_HZ, about)
        self.streams: tuple[StreamInfo, ...] = (thermal,)
        self._usb, self._wait = Guarded(device, WRITES), wait
        self._frames, self._marks = Assembler(w, h), ShutterMarks(RATE_HZ)
        self._begun = False

    def start(self) -> None:
        """The order of requests after which it streams. Raises ResourceError."""
        self._usb.claim(0, 1)
        self._begun = True
        self._command(START)
        self._wait(START_WAITS_S[0])
        self._usb.alternate(1, 1)
        self._usb.write(0x40, 0xEE, index=1)
        self._wait(START_WAITS_S[1])
        self._usb.bulk_read(ENDPOINT, self._frames.frame_bytes, 1000)  # what lies in its memory is of no time
        self._command(START)

    def read(self) -> Sequence[Frame]:
        """The frames that arrived. Raises UnpluggedError."""
        found: list[Frame] = []
        until = time.monotonic() + POLL_S
        while not found and time.monotonic() < until:
            data = self._usb.bulk_read(ENDPOINT, READ_BYTES, int(POLL_S * 1000))
            now = time.monotonic_ns()
            for plane in self._frames.feed(data):
                spoiled = self._marks.spoiled(now, plane.data)
                found.append(Frame(0, plane.data, now, plane.ticks, plane.lost, spoiled))
        return found

    def shutter(self) -> bool:
        """Begin a correction. Raises ResourceError."""
        self._marks.asked(time.monotonic_ns())
        self._command(SHUTTER)
        return True

    def stop(self) -> None:
        """The idle setting of its interface, and give it back. Never raises."""
        with suppress(ResourceError):
            if self._begun:
                self._usb.alternate(1, 0)
        self._begun = False
        self._usb.release()

    def _command(self, data: bytes) -> None:
        self._usb.write(0x41, 0x20, data=data)
        self._usb.read(0x41, 0x22, length=1)  # its state; what the bits mean is not known for sure
