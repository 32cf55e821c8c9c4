"""What the depth frames nearest in time show along the rays of a thermal view.

The fused surface holds what was kept as the subject. What else stood in the way - a hand, a chair, the rim of a mug
that fusion dropped - hides nothing in it; the depth frame of the same moment has seen it. Frames are compared in the
camera's own frame at that moment, so that a subject that moves between frames makes no difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import pixel_rays, project
from ..geometry.rigid import interpolate_trajectory, invert, transform_points
from ..scans.pairing import nearest_in_time
from ..types import Bool, Camera, Float, Float32, Scan, ThermalViews, Trajectory

MAX_GAP_S = 0.25  # a depth frame farther in time from a view says nothing of it
STEP = 2  # depth pixels across and down that one point stands for: the nearest of them
JUMP_M_AT_1M = 0.03  # between the pixels of a step: beyond it they are a veil between two surfaces; grows with range²
HOLE_PX = 12 / 640  # image widths over which a hole beside something near may be part of it
LEAST_PIXELS = 3  # of the four of a step that must hold depth: fewer are speckles
NOISE_M_AT_1M = 0.01  # nearest of some 36 pixels of an ordinary depth camera; grows with range²
FAR_M = np.float32(1e3)


@dataclass(frozen=True, eq=False)
class Depths:
    """Of one thermal view: depth along z of the nearest thing in each cell of its image, m; FAR_M = nothing known.

    measured : (H, W) float32, as the depth frame shows it. beside : the same in a cell or its neighbours. filled :
    holes beside near things as if they were part of these. cell_px : side of a cell, px of the image. focal_px : of the
    thermal camera. own_m : tolerance beyond noise and slope. hole_rad : how far about a hole `filled` has looked.
    """

    measured: Float32
    beside: Float32
    filled: Float32
    cell_px: float
    focal_px: float
    own_m: float
    hole_rad: float

    def judge(self, uv: NDArray, z_m: NDArray, cos_angle: NDArray) -> tuple[Bool, Bool]:
        """Points at pixels uv (N, 2), z_m (N,) deep, seen at cos_angle (N,): which are hidden by what is before them,
        (N,), and which are doubtful, (N,): beside what would hide them, beside a hole that may be part of something
        near, or the frame looks through the place where the point should be.
        """
        h, w = self.measured.shape
        at = np.clip(np.rint(uv / self.cell_px).astype(np.intp), 0, (w - 1, h - 1))
        cell = at[:, 1] * w + at[:, 0]
        slope = np.sqrt(np.maximum(1 - cos_angle**2, 0)) / np.maximum(cos_angle, 0.2)
        spread_m = z_m * (1.5 * self.cell_px / self.focal_px) * slope
        tolerance_m = (self.own_m + NOISE_M_AT_1M * z_m**2 + spread_m).astype(np.float32)
        near, beside, filled = (b.ravel().take(cell) for b in (self.measured, self.beside, self.filled))
        before = z_m - tolerance_m
        through = (beside > z_m + tolerance_m) & (near < FAR_M)
        # a slanted surface has holes of its own, and is itself what is nearer beside them
        part_of_other = filled < before - z_m * self.hole_rad * slope
        return near < before, (beside < before) | part_of_other | through


class DepthWitness:
    """A scan's depth frames, asked for what stood before the thermal camera at a view's time."""

    def __init__(self, scan: Scan, trajectory: Trajectory, views: ThermalViews, lens: Camera, own_m: float) -> None:
        """trajectory : of the depth camera. own_m : how far behind the surface a vertex may lie."""
        self._stream, self._views, self._lens, self._own_m = scan.depth, views, lens, own_m
        self._frame, off_s = nearest_in_time(views.times_s, scan.depth.times_s)
        poses, valid = interpolate_trajectory(trajectory, scan.depth.times_s[self._frame], max_gap_s=MAX_GAP_S)
        self._T_thermal_depth = invert(views.T_world_thermal) @ poses
        self._known = valid & (np.abs(off_s) <= MAX_GAP_S) & scan.depth.usable[self._frame]
        depth = scan.rig.depth
        v, u = np.mgrid[: depth.height_px // STEP, : depth.width_px // STEP] * STEP + 0.5 * (STEP - 1)
        rays = pixel_rays(depth, u, v)
        self._rays = (rays / rays[..., 2:]).astype(np.float32)
        self._no_ray = ~np.isfinite(self._rays[..., 0])
        self._hole = max(3, 2 * round(HOLE_PX * depth.width_px / STEP) + 1)
        self._hole_rad = STEP * (self._hole // 2) / depth.focal_px
        # a cell is no finer than the points are, so that near surfaces have no gaps
        self._cell_px = max(2.0, 1.5 * STEP * lens.focal_px / depth.focal_px)

    def of(self, view: int) -> Depths | None:
        """What a view's moment shows; None where no depth frame is near in time."""
        if not self._known[view]:
            return None
        near, veil = self._nearest(self._stream.load(int(self._frame[view])))
        filled = cv2.erode(near, np.ones((self._hole, self._hole), np.uint8))
        filled = np.where((near == FAR_M) & ~veil, filled, FAR_M)
        T = self._T_thermal_depth[view]
        measured = self._buffer(near, T)
        around = np.ones((3, 3), np.uint8)
        holes = self._buffer(np.asarray(filled, np.float32), T)
        beside, filled = (np.asarray(cv2.erode(b, around), np.float32) for b in (measured, holes))
        return Depths(measured, beside, filled, self._cell_px, self._lens.focal_px, self._own_m, self._hole_rad)

    def _nearest(self, depth_m: Float32) -> tuple[Float32, Bool]:
        """Of each step's pixels, depth_m (H, W), the nearest (h, w) m, FAR_M = none; and which lie across two surfaces.

        The pixels of a step side by side as whole images: reductions over axes of two take ten times as long.
        """
        h, w = self._rays.shape[:2]
        z = np.nan_to_num(depth_m[: h * STEP, : w * STEP], nan=0.0)
        parts = [z[r::STEP, c::STEP] for r in range(STEP) for c in range(STEP)]
        near, far = np.full((h, w), FAR_M), np.zeros((h, w), np.float32)
        count = np.zeros((h, w), np.uint8)
        for part in parts:
            valid = part > 0
            np.minimum(near, part, out=near, where=valid)
            np.maximum(far, part, out=far)
            count += valid
        veil = far - near > JUMP_M_AT_1M * near**2
        near[veil | (count < LEAST_PIXELS) | self._no_ray] = FAR_M
        return near, veil

    def _buffer(self, z: Float32, T_thermal_depth: Float) -> Float32:
        """Nearest depth in each cell of the thermal image, of z (h, w) of the depth camera."""
        known = z < FAR_M
        seen = transform_points(T_thermal_depth, self._rays[known] * z[known][:, None])
        uv, depth = project(self._lens, seen)
        good = np.isfinite(uv[:, 0])
        u, v = np.rint(uv[good] / np.float32(self._cell_px)).astype(np.int32).T
        shape = int(self._lens.height_px / self._cell_px) + 2, int(self._lens.width_px / self._cell_px) + 2
        inside = (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
        out = np.full(shape, FAR_M, np.float32)
        np.minimum.at(out.ravel(), v[inside] * shape[1] + u[inside], depth[good][inside])
        return out
