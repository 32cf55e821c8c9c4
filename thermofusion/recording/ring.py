"""A ring of bytes between two processes: one writes frames, one takes them; where it is full, frames are dropped.

Nobody ever waits: a frame for which there is no room is refused, and whoever offers it counts it.
"""

from __future__ import annotations

from multiprocessing.context import BaseContext
from typing import Any

RING_BYTES = 128 * 2**20  # of a device: 4 s of a Kinect; a disk that others flush may stand still for 3 s
MOST_WAITING = 400  # frames in the ring: what is said of them must fit the pipe beside it (64 KiB)


class Ring:
    """A ring for one writer and one reader. It travels to another process when that is started."""

    def __init__(self, context: BaseContext, size: int = RING_BYTES) -> None:
        self._memory: Any = context.RawArray("B", size)
        self._taken: Any = context.RawArray("Q", 2)  # bytes and frames that the reader has finished with
        self._size, self._written, self._frames = size, 0, 0

    def offer(self, data: bytes | memoryview) -> tuple[int, int] | None:
        """Put a frame's bytes: (offset, end), to be told to the reader; None where there is no room."""
        length = len(data)
        offset = self._written % self._size
        skipped = self._size - offset if offset + length > self._size else 0
        end = self._written + skipped + length
        if end - self._taken[0] > self._size or self._frames - self._taken[1] >= MOST_WAITING or length > self._size:
            return None
        offset = 0 if skipped else offset
        memoryview(self._memory).cast("B")[offset : offset + length] = data
        self._written, self._frames = end, self._frames + 1
        return offset, end

    def take(self, offset: int, length: int, end: int) -> bytes:
        """A frame's bytes; its place becomes free."""
        data = bytes(memoryview(self._memory).cast("B")[offset : offset + length])
        self._taken[0], self._taken[1] = end, self._taken[1] + 1
        return data
