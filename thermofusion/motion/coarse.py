"""Depth frames remembered at a quarter of their size or less while they pass by on their way into the fusion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

import cv2
import numpy as np

from ..types import Camera, Float, Float32
from .rows import CoarseFrames

WIDTH_PX = 320  # of a remembered image, about
MAX_BYTES = 400 << 20  # of all: more frames than fit are thinned out
EDGE_M, EDGE_PX = 0.03, 4.0  # of depth between neighbours: no slope that is looked at makes such a step


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
        h, w = (len(range(self._step // 2, n, self._step)) for n in self.camera.shape)
        self._images: Float32 = np.empty((len(range(0, count, self._every)), h, w), np.float32)
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
        images = [clear_of_edges(self._images[self._kept[i]], intrinsics[0]) for i in kept]
        return CoarseFrames(images, intrinsics, times_s[kept], T)


def clear_of_edges(depth_m: Float32, focal_px: float) -> Float32:
    """depth_m (H, W), NaN = none, without the pixels beside a step in depth or beside none.

    A point looked up there may meet what stands behind it or beside it, more from one side than from the other: a hand
    before the thigh then seems to move as the camera goes round.
    """
    z = np.nan_to_num(depth_m)
    step = np.maximum(np.float32(EDGE_M), np.float32(EDGE_PX / focal_px) * z)
    near = np.ones((3, 3), np.uint8)
    at_edge = (cv2.dilate(z, near) - z > step) | (z - cv2.erode(z, near) > step)
    return np.where(at_edge, np.float32(np.nan), depth_m)
