"""Images as registration uses them: points, normals and texture of a depth image, and a sample to send elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..depth.filter import bounding_box
from ..types import Float, Float32

NORMAL_WINDOW_PX = 5  # slopes are least-squares fits over this square: wide enough to average noise
NORMAL_JUMP = 0.06  # relative change of depth over the window beyond which it holds a step
Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A depth image as points and normals, ready to be a partner.

    intrinsics : fx, fy, cx, cy of the image. shape : (H, W). surface : (H*W, 6) float32, point and unit normal towards
    the camera, NaN = none. texture : (H*W, 3) float32, intensity and its slopes along u and v, NaN = none; or None.
    sample, sample_normals : (N, 3) float64, an even sample that is sent to other views, with its sample_intensity (N,).
    """

    intrinsics: Intrinsics
    shape: tuple[int, int]
    surface: Float32
    texture: Float32 | None
    sample: Float
    sample_normals: Float
    sample_intensity: Float | None

    @classmethod
    def of(cls, depth_m: Float32, intrinsics: Intrinsics, samples: int, intensity: Float32 | None = None) -> DepthMap:
        """From an image depth_m (H, W), NaN = none, and an intensity image (H, W) of the same view."""
        fx, fy, cx, cy = intrinsics
        h, w = depth_m.shape
        whole = np.full((h, w, 6), np.nan, np.float32)
        rows, columns = box = _around(depth_m, NORMAL_WINDOW_PX // 2)
        x = ((np.arange(w)[columns] - cx) / fx).astype(np.float32)
        y = ((np.arange(h)[rows] - cy) / fy).astype(np.float32)
        if len(x) and len(y):
            part, depth = whole[box], depth_m[box]
            part[..., 0], part[..., 1], part[..., 2] = x * depth, y[:, None] * depth, depth
            part[..., 3:] = _normals(depth, x, y, fx, fy)
        surface = whole.reshape(-1, 6)
        good = np.flatnonzero(np.isfinite(surface[:, 3]))
        # an even sample in image order: same input, same sample
        pick = good[np.linspace(0, len(good) - 1, min(samples, len(good))).astype(np.intp)] if len(good) else good
        sample = surface[pick].astype(np.float64)
        texture = None if intensity is None else _texture(intensity)
        own = None if texture is None else texture[pick, 0].astype(np.float64)
        return cls(intrinsics, (h, w), surface, texture, sample[:, :3], sample[:, 3:], own)

    def sample_only(self) -> DepthMap:
        """Without the image: what is left can be sent to other views, and takes little memory."""
        return replace(self, surface=np.empty((0, 6), np.float32), texture=None)


def _around(depth_m: Float32, margin_px: int) -> tuple[slice, slice]:
    """The rows and columns of an image (H, W) that hold depth, and a margin: a person fills a third of it."""
    box = bounding_box(depth_m)
    if box is None:
        return slice(0, 0), slice(0, 0)
    rows, columns = (slice(max(0, int(of.start) - margin_px), int(of.stop) + margin_px) for of in box)
    return rows, columns


def _normals(depth_m: Float32, x: Float32, y: Float32, fx: float, fy: float) -> Float32:
    """Unit normals (H, W, 3) towards the camera, NaN at depth steps and holes.

    On a plane A X + B Y + C Z = 1 the inverse depth is linear over the image, 1/z = A x + B y + C: its slopes, fitted
    over a window, give the normal (A, B, C) without bias from the window's extent.
    """
    with np.errstate(divide="ignore"):
        inverse = 1 / depth_m
    ones = np.full(NORMAL_WINDOW_PX, 1 / NORMAL_WINDOW_PX, np.float32)
    slope = np.arange(NORMAL_WINDOW_PX, dtype=np.float32) - NORMAL_WINDOW_PX // 2
    slope /= (slope**2).sum()
    du, dv = cv2.sepFilter2D(inverse, -1, slope, ones), cv2.sepFilter2D(inverse, -1, ones, slope)
    A, B = du * np.float32(fx), dv * np.float32(fy)
    C = inverse - A * x[None] - B * y[:, None]
    n = np.empty((*depth_m.shape, 3), np.float32)
    with np.errstate(invalid="ignore"):
        length = -np.sqrt(A * A + B * B + C * C)
        limit = np.float32(NORMAL_JUMP / (NORMAL_WINDOW_PX - 1)) * inverse
        length[~((np.abs(du) < limit) & (np.abs(dv) < limit))] = np.nan
        for k, part in enumerate((A, B, C)):  # whole images: three numbers a pixel at a time take twice as long
            np.divide(part, length, out=n[..., k])
    margin = NORMAL_WINDOW_PX // 2  # there the filter saw mirrored pixels
    n[:margin] = n[-margin:] = n[:, :margin] = n[:, -margin:] = np.nan
    return n


def _texture(intensity: Float32) -> Float32:
    """(H*W, 3) intensity and its slopes per pixel, NaN where the window holds a pixel without intensity."""
    smooth = np.array([0.25, 0.5, 0.25], np.float32)
    slope = np.array([-0.5, 0, 0.5], np.float32)
    du, dv = cv2.sepFilter2D(intensity, -1, slope, smooth), cv2.sepFilter2D(intensity, -1, smooth, slope)
    return np.stack([intensity, du, dv], axis=-1).reshape(-1, 3)
