"""A few consecutive frames as one: their depth averaged in the middle frame's view, with far less noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import invert, transform_points
from ..types import Float, Float32
from .registration import DepthMap

SAMPLES = 4000
MIN_VALID_SHARE = 0.01  # a frame with fewer valid pixels shows nothing
SAME_SURFACE_M = 0.02  # depth this far behind the nearest is another surface
MIN_SHARE = 1 / 3  # of the frames that must see a pixel


@dataclass(frozen=True, eq=False)
class Frame:
    """A depth frame as tracking uses it: half resolution, subject only.

    depth_m : (H, W) float32, NaN = none.
    """

    index: int
    time_s: float
    depth_m: Float32

    @property
    def empty(self) -> bool:
        return bool(np.isfinite(self.depth_m).mean() < MIN_VALID_SHARE)


@dataclass(frozen=True, eq=False)
class Fragment:
    """frames : (N,) positions in the depth stream. T_middle_frame : (N, 4, 4). map : averaged depth, middle's view."""

    frames: NDArray[np.intp]
    T_middle_frame: Float
    map: DepthMap


def build_fragment(frames: Sequence[Frame], T: Float, intrinsics: tuple[float, float, float, float]) -> Fragment:
    """Average the frames' depth in the view of the middle one.

    T : (N, 4, 4) poses in any common frame. Every frame's points are projected into the middle view; what lies behind
    the nearest surface of a pixel is dropped; the rest is averaged.
    """
    middle = len(frames) // 2
    T_middle_frame = invert(T[middle]) @ T
    fx, fy, cx, cy = intrinsics
    h, w = frames[0].depth_m.shape
    x = np.broadcast_to(((np.arange(w) - cx) / fx).astype(np.float32), (h, w))
    y = np.broadcast_to(((np.arange(h) - cy) / fy).astype(np.float32)[:, None], (h, w))
    pixels, depths = [], []
    for frame, pose in zip(frames, T_middle_frame, strict=True):
        ok = np.isfinite(frame.depth_m)
        z = frame.depth_m[ok]
        p = transform_points(pose, np.stack([x[ok] * z, y[ok] * z, z], axis=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = np.rint(p[:, 0] / p[:, 2] * fx + cx), np.rint(p[:, 1] / p[:, 2] * fy + cy)
        inside = (p[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
        pixels.append(v[inside].astype(np.intp) * w + u[inside].astype(np.intp))
        depths.append(p[inside, 2])
    depth = _average(np.concatenate(pixels), np.concatenate(depths), h * w, len(frames))
    return Fragment(
        np.array([f.index for f in frames]),
        T_middle_frame,
        DepthMap.of(depth.reshape(h, w), intrinsics, SAMPLES),
    )


def _average(pixel: NDArray[np.intp], depth: Float32, size: int, frames: int) -> Float32:
    """Mean depth per pixel of the nearest surface; NaN where fewer than a third of the frames (at least two) saw it."""
    nearest = np.full(size, np.inf, np.float32)
    np.minimum.at(nearest, pixel, depth)
    same = depth < nearest[pixel] + np.float32(SAME_SURFACE_M)
    count = np.bincount(pixel[same], minlength=size)
    mean = np.bincount(pixel[same], depth[same], size) / np.maximum(count, 1)
    needed = min(max(2, int(MIN_SHARE * frames)), frames)
    return np.where(count >= needed, mean, np.nan).astype(np.float32)
