"""InfiRay P2 Pro and Topdon TC001: UVC, the picture's lower half is temperatures. Never tried on hardware.

256 x 384 YUYV: rows 0-191 a picture, rows 192-383 little-endian K/64. Sources disagree on the byte order of the
vendor's standard parameters and no shutter command is sure, so nothing is sent at all: the camera corrects itself,
and frozen frames are marked.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from ...errors import ResourceError
from ..device import Frame, StreamInfo
from ..usb import RefusedWriteError
from .infiray import SIGNAL
from .marks import ShutterMarks
from .v4l2 import Capture, VideoNode, node_of

IDS = (0x0BDA, 0x5830)  # vendor, product
WIDTH_PX, HEIGHT_PX = 256, 192
FRAME_BYTES = WIDTH_PX * 2 * HEIGHT_PX * 2
RATE_HZ = 25.0  # as its makers say
NEVER = (0x0805, 0x8201)  # vendor commands that make the camera unusable: reset into its loader, its flash


def temperatures(raw: bytes) -> bytes | None:
    """The temperature half of a frame, little-endian K/64; None for another size."""
    return raw[FRAME_BYTES // 2 :] if len(raw) == FRAME_BYTES else None


def vendor_command(number: int) -> None:
    """No vendor command is sent: their byte order is not sure. Raises RefusedWriteError, always."""
    known = "it would make the camera unusable" if number in NEVER else "sources disagree on its layout"
    raise RefusedWriteError(f"the P2 Pro's command {number:04x} is not sent: {known}")


class P2Pro:
    """A P2 Pro or TC001. capture : a source of frames, for tests."""

    name = "InfiRay P2 Pro / Topdon TC001"

    def __init__(self, capture: Capture | None = None) -> None:
        about: dict[str, object] = {"model": self.name, "signal": SIGNAL, "band_um": [8.0, 14.0]}
        thermal = StreamInfo("p2pro/thermal", "thermal", WIDTH_PX, HEIGHT_PX, "mono16", RATE_HZ, about)
        self.streams: tuple[StreamInfo, ...] = (thermal,)
        self._capture, self._marks, self._torn = capture, ShutterMarks(RATE_HZ), 0

    def start(self) -> None:
        """Open the video node. Raises ResourceError."""
        self._capture = self._capture or VideoNode(node_of(*IDS), WIDTH_PX, 2 * HEIGHT_PX, "YUYV")

    def read(self) -> Sequence[Frame]:
        """The frame that arrived. Raises UnpluggedError."""
        if self._capture is None:
            raise ResourceError("it was not started", place=self.name)
        raw = self._capture.read()
        if raw is None:
            return []
        plane, now = temperatures(raw.tobytes()), time.monotonic_ns()
        if plane is None:
            self._torn += 1
            return []
        lost, self._torn = self._torn, 0
        return [Frame(0, plane, now, lost=lost, shutter=self._marks.spoiled(now, plane))]

    def shutter(self) -> bool:
        """It cannot be asked for: the camera corrects itself."""
        return False

    def stop(self) -> None:
        """Give the node back. Never raises."""
        if self._capture is not None:
            self._capture.close()
        self._capture = None
