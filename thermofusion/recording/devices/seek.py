"""Seek Compact and Compact Pro: control requests and bulk frames; *relative* values only. Never tried on hardware.

A frame's word 10 says what it is: 4 the first after the start, 1 the shutter's, 3 a picture. What is recorded is the
picture + 0x4000 - the last shutter frame: differences between places, whose unit and level nobody knows.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import ResourceError
from ..device import POLL_S, Frame, StreamInfo, UnpluggedError
from ..usb import Allowed, Guarded, only

FIRST, SHUTTER, PICTURE = 4, 1, 3  # what a frame is
LEVEL = 0x4000  # of a picture that equals the shutter's
PLATFORM, MODE, FIRMWARE, CHIP, FEATURES, SETTINGS, PROCESSING, GET_IMAGE = 84, 60, 78, 54, 86, 88, 62, 83
IDLE, RUN, PLAIN = b"\x00\x00", b"\x01\x00", b"\x08\x00"
SETTLING = 1  # pictures after the shutter that are marked
ENDPOINT = 0x81  # bulk, of frames


@dataclass(frozen=True)
class Model:
    """A model's raw frame, the bytes of one bulk read, where a frame's type stands, and how often it comes."""

    name: str
    width_px: int
    height_px: int
    read_bytes: int
    type_word: int
    rate_hz: float

    @property
    def frame_bytes(self) -> int:
        """Size of a raw frame."""
        return self.width_px * self.height_px * 2


MODELS = {
    (0x289D, 0x0010): Model("Seek Compact", 208, 156, 16_224, 10, 8.0),
    (0x289D, 0x0011): Model("Seek Compact Pro", 342, 260, 13_680, 2, 9.0),
}


def writes(model: Model) -> tuple[Allowed, ...]:
    """What may be sent to a model."""
    pixels = struct.pack("<I", model.width_px * model.height_px)
    features = (b"\x06\x00\x08\x00\x00\x00", b"\x17\x00", b"\x15\x00")
    payloads = {PLATFORM: (b"\x01",), MODE: (IDLE, RUN), PROCESSING: (PLAIN,), GET_IMAGE: (pixels,), FEATURES: features}
    return tuple(Allowed(0x41, request, only(*data)) for request, data in payloads.items())


class Corrector:
    """Raw frames into differences against the shutter."""

    def __init__(self, model: Model) -> None:
        self._model, self._since = model, 0
        self._shutter: np.ndarray | None = None

    def feed(self, raw: bytes) -> tuple[bytes, bool] | None:
        """(picture as little-endian words, whether it is spoiled); None for what is no picture, or torn."""
        if len(raw) != self._model.frame_bytes:
            return None
        words = np.frombuffer(raw, "<u2")
        kind = int(words[self._model.type_word])
        if kind == SHUTTER:
            self._shutter, self._since = words.astype(np.int32), 0
        if kind != PICTURE or self._shutter is None:
            return None
        picture = np.clip(words.astype(np.int32) + LEVEL - self._shutter, 0, 65535).astype("<u2")
        self._since += 1
        return picture.tobytes(), self._since <= SETTLING


class Seek:
    """A Seek Compact or Compact Pro."""

    def __init__(self, device: Any) -> None:
        self._model = MODELS[device.idVendor, device.idProduct]
        self.name = self._model.name
        about: dict[str, object] = {"model": self.name, "relative": True, "band_um": [7.2, 13.0]}
        w, h = self._model.width_px, self._model.height_px
        thermal = StreamInfo("seek/thermal", "thermal", w, h, "mono16", self._model.rate_hz, about)
        self.streams: tuple[StreamInfo, ...] = (thermal,)
        self._usb, self._corrector = Guarded(device, writes(self._model)), Corrector(self._model)
        self._torn, self._begun = 0, False

    def start(self) -> None:
        """The order of requests after which it answers with frames. Raises ResourceError."""
        self._usb.claim(0)
        self._usb.write(0x41, PLATFORM, data=b"\x01")
        self._begun = True
        self._usb.write(0x41, MODE, data=IDLE)
        for request, length in ((FIRMWARE, 4), (CHIP, 12)):
            self._usb.read(0x41, request, length=length)
        for features, length in ((b"\x06\x00\x08\x00\x00\x00", 12), (b"\x17\x00", 64), (b"\x15\x00", 64)):
            with _Refusals():
                self._usb.write(0x41, FEATURES, data=features)
                self._usb.read(0x41, SETTINGS, length=length)
        self._usb.write(0x41, PROCESSING, data=PLAIN)
        self._usb.write(0x41, MODE, data=RUN)

    def read(self) -> Sequence[Frame]:
        """The frame that arrived. Raises UnpluggedError."""
        size = self._model.frame_bytes
        self._usb.write(0x41, GET_IMAGE, data=struct.pack("<I", size // 2))
        raw, until = bytearray(), time.monotonic() + 4 * POLL_S
        while len(raw) < size and time.monotonic() < until:
            part = self._usb.bulk_read(ENDPOINT, self._model.read_bytes, int(POLL_S * 1000))
            if not part:
                break
            raw += part
        now = time.monotonic_ns()
        if len(raw) != size:
            self._torn += bool(raw)
            return []
        picture = self._corrector.feed(bytes(raw))
        if picture is None:
            return []
        lost, self._torn = self._torn, 0
        return [Frame(0, picture[0], now, 0, lost, picture[1])]

    def shutter(self) -> bool:
        """It cannot be asked for: the camera corrects itself."""
        return False

    def stop(self) -> None:
        """Idle, said three times as its own program does. Never raises."""
        with suppress(ResourceError):
            for _ in range(3 if self._begun else 0):
                self._usb.write(0x41, MODE, data=IDLE)
        self._begun = False
        self._usb.release()


class _Refusals:
    """Factory settings are only asked for because the camera's own program does: refusals do not matter."""

    def __enter__(self) -> None:
        return

    def __exit__(self, kind: type | None, *_: object) -> bool:
        return kind is not None and issubclass(kind, ResourceError) and not issubclass(kind, UnpluggedError)
