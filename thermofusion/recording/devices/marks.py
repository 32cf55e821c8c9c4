"""Which thermal frames a shutter correction spoils: asked for by us, or made by the camera on its own."""

from __future__ import annotations

import zlib

SETTLING_S = 1.0  # after a correction that was asked for, frames are not believed
GAP_PERIODS = 3.5  # a pause this many frame periods long is a correction that nobody asked for


class ShutterMarks:
    """Marks frames by their arrival and content. rate_hz : of the stream."""

    def __init__(self, rate_hz: float) -> None:
        self._gap_ns = int(GAP_PERIODS / rate_hz * 1e9)
        self._until_ns = self._before_ns = 0
        self._sum: int | None = None

    def asked(self, now_ns: int) -> None:
        """A correction begins now, host monotonic ns."""
        self._until_ns = now_ns + int(SETTLING_S * 1e9)

    def spoiled(self, now_ns: int, data: bytes | memoryview) -> bool:
        """Whether the frame that came now is one of a correction: asked for, frozen, or the first after a pause."""
        checksum = zlib.crc32(data)
        frozen = checksum == self._sum  # noise never repeats: the camera repeats its last frame behind the shutter
        paused = self._before_ns > 0 and now_ns - self._before_ns > self._gap_ns
        self._sum, self._before_ns = checksum, now_ns
        return frozen or paused or now_ns < self._until_ns
