"""Depth frames remembered at a quarter of their size or less while they pass by on their way into the fusion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from ..types import Camera, Float, Float32
from .rows import CoarseFrames

WIDTH_PX = 320  # of a remembered image, about
MAX_BYTES = 400 << 20  # of all: more frames than fit are thinned out


class Frames(Protocol):
    """Where depth images come from."""

    camera: Camera

    def read_ahead(self, frames: Sequence[int]) -> Iterator[tuple[int, Float32]]:
        """(i, depth (H, W) m of frame i) in the order given."""


class Remembering:
    """The same frames; every image that passes is kept, coarser: the middle pixel of every cell."""

    def __init__(self, frames: Frames, count: int) -> None:
        """count : frames that are to come."""
        self.source, self.camera = frames, frames.camera
        self._step = max(1, round(self.camera.width_px / WIDTH_PX))
        size = 4 * (self.camera.width_px // self._step) * (self.camera.height_px // self._step)
        self._every = max(1, -(-count * size // MAX_BYTES))
        # one block: so many small ones cost more in pages than the pixels do
        size_px = (
            len(range(0, count, self._every)),
            *(len(range(self._step // 2, n, self._step)) for n in self.camera.shape),
        )
        self._images: Float32 = np.empty(size_px, np.float32)
        self._kept: dict[int, int] = {}  # frame -> row of the images

    def read_ahead(self, frames: Sequence[int]) -> Iterator[tuple[int, Float32]]:
        """(i, depth (H, W) m of frame i) in the order given."""
        first = self._step // 2
        for n, (i, depth) in enumerate(self.source.read_ahead(frames)):
            if n % self._every == 0 and len(frames) > 1:
                row = self._kept.setdefault(i, len(self._kept))
                self._images[row] = depth[first :: self._step, first :: self._step]
            yield i, depth

    def frames(self, times_s: Float, T_of_frame: dict[int, Float]) -> CoarseFrames:
        """What was kept. times_s : of the depth stream's frames. T_of_frame : T_world_depth (4, 4) by frame."""
        kept = sorted(i for i in self._kept if i in T_of_frame)
        K, s = self.camera.K, self._step
        first = s // 2
        intrinsics = (K[0, 0] / s, K[1, 1] / s, (K[0, 2] - first) / s, (K[1, 2] - first) / s)
        T = np.array([T_of_frame[i] for i in kept]).reshape(-1, 4, 4)
        return CoarseFrames([self._images[self._kept[i]] for i in kept], intrinsics, times_s[kept], T)
