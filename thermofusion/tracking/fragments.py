"""A few consecutive frames as one: their depth averaged in the middle frame's view, with far less noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.rigid import invert
from ..types import Float, Float32
from .frames import TrackingFrame
from .maps import DepthMap, Intrinsics

SAMPLES = 4000  # points of a fragment that are sent to other views
SAME_SURFACE_M = 0.02  # depth this far behind the nearest is another surface
MIN_SEEN_SHARE = 1 / 3  # of the frames that must see a pixel


@dataclass(frozen=True, eq=False)
class Fragment:
    """frames : (N,) positions in the depth stream. T_middle_frame : (N, 4, 4). map : averaged depth, middle's view.
    up : (3,) in the middle's camera: away from the floor where the middle saw it, else up in the image.
    """

    frames: NDArray[np.intp]
    T_middle_frame: Float
    map: DepthMap
    up: Float


def build_fragment(frames: Sequence[TrackingFrame], T: Float, intrinsics: Intrinsics) -> Fragment:
    """Average the frames' depth in the view of the middle one.

    T : (N, 4, 4) poses in any common frame. Every frame's points are projected into the middle view; what lies behind
    the nearest surface of a pixel is dropped; the rest is averaged.
    """
    middle = len(frames) // 2
    T_middle_frame = invert(T[middle]) @ T
    fx, fy, cx, cy = intrinsics
    h, w = frames[0].depth_m.shape
    x = ((np.arange(w) - cx) / fx).astype(np.float32)[None]
    y = ((np.arange(h) - cy) / fy).astype(np.float32)[:, None]
    pixels, depths = [], []
    for frame, pose in zip(frames, T_middle_frame, strict=True):
        R, t = pose[:3, :3].astype(np.float32), pose[:3, 3].astype(np.float32)
        px, py, pz = (frame.depth_m * (R[k, 0] * x + R[k, 1] * y + R[k, 2]) + t[k] for k in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = (
                np.rint(px / pz * np.float32(fx) + np.float32(cx)),
                np.rint(py / pz * np.float32(fy) + np.float32(cy)),
            )
            inside = (pz > 0.1) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
        pixels.append(v[inside].astype(np.intp) * w + u[inside].astype(np.intp))
        depths.append(pz[inside])
    depth = _average(np.concatenate(pixels), np.concatenate(depths), h * w, len(frames)).reshape(h, w)
    texture = frames[middle].map.texture
    intensity = None if texture is None else texture[:, 0].reshape(h, w)
    floor = frames[middle].floor
    return Fragment(
        np.array([f.index for f in frames]),
        T_middle_frame,
        DepthMap.of(depth, intrinsics, SAMPLES, intensity),
        np.array([0.0, -1.0, 0.0]) if floor is None else floor[:3],
    )


def _average(pixel: NDArray[np.intp], depth: Float32, size: int, frames: int) -> Float32:
    """Mean depth per pixel of the nearest surface; NaN where fewer than a third of the frames (at least two) saw it."""
    nearest = np.full(size, np.inf, np.float32)
    np.minimum.at(nearest, pixel, depth)
    same = depth < nearest[pixel] + np.float32(SAME_SURFACE_M)
    count = np.bincount(pixel[same], minlength=size)
    mean = np.bincount(pixel[same], depth[same], size) / np.maximum(count, 1)
    needed = min(max(2, int(MIN_SEEN_SHARE * frames)), frames)
    return np.where(count >= needed, mean, np.nan).astype(np.float32)
