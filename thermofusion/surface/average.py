"""A depth frame averaged into blocks of voxels: Open3D's arithmetic to the last bit, in a third of its time.

Open3D takes voxel by voxel through branches that no processor can foresee. Here each step is done for a whole block
before the next one: simple loops without branches, several voxels at a time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..types import Float32, Int

EDGE = 8  # voxels along a block's edge
VOXELS = EDGE**3
NOWHERE_M = np.float32(1e9)  # stands for the depth of a voxel that the image does not show


class Look(NamedTuple):
    """A depth frame, and how it looks at the world; all float32, lengths in m.

    depth_m : (H, W), 0 = none. T_depth_world : (4, 4). pinhole : (4,) fx, fy, cx, cy, where the first pixel spans
    [0, 1).
    """

    depth_m: Float32
    T_depth_world: Float32
    pinhole: Float32


class Limits(NamedTuple):
    """voxel_m : a voxel's edge. truncation_m : of the distance. far_m : depth beyond it does not count; float32."""

    voxel_m: Any
    truncation_m: Any
    far_m: Any


@compiled
def average_frame(
    look: Look, limits: Limits, block: Int, row: Int, distance: Float32, weight: Float32
) -> None:  # pragma: no cover
    """Average a frame into blocks (N, 3), whose 8³ voxels stand in rows (N,) of `distance` and `weight` (M, 512).

    Distances are in truncations, along z, cut at 1; what lies deeper than one behind the surface keeps its own.
    """
    h, w = look.depth_m.shape
    depth, T = look.depth_m.reshape(-1), look.T_depth_world
    fx, fy, cx, cy = look.pinhole
    zero, one, width = np.float32(0), np.float32(1), np.int32(w)
    right, bottom = np.float32(w - 1), np.float32(h - 1)
    count = np.uint32(VOXELS)
    x, y, z = np.empty(VOXELS, np.float32), np.empty(VOXELS, np.float32), np.empty(VOXELS, np.float32)
    pixel, ahead, seen = np.empty(VOXELS, np.int32), np.empty(VOXELS, np.float32), np.empty(VOXELS, np.float32)
    for b in range(block.shape[0]):
        i, j, k = np.int32(block[b, 0] * EDGE), np.int32(block[b, 1] * EDGE), np.int32(block[b, 2] * EDGE)
        for n in range(count):
            m = np.int32(n)
            x[n] = np.float32(np.int32(i + (m & 7))) * limits.voxel_m
            y[n] = np.float32(np.int32(j + ((m >> 3) & 7))) * limits.voxel_m
            z[n] = np.float32(np.int32(k + (m >> 6))) * limits.voxel_m
        for n in range(count):
            forward = x[n] * T[2, 0] + y[n] * T[2, 1] + z[n] * T[2, 2] + T[2, 3]
            across = x[n] * T[0, 0] + y[n] * T[0, 1] + z[n] * T[0, 2] + T[0, 3]
            down = x[n] * T[1, 0] + y[n] * T[1, 1] + z[n] * T[1, 2] + T[1, 3]
            inverse = one / forward
            u, v = fx * across * inverse + cx, fy * down * inverse + cy
            inside = (u >= zero) & (v >= zero) & (u <= right) & (v <= bottom) & (forward > zero)
            pixel[n] = np.int32(v if inside else zero) * width + np.int32(u if inside else zero)
            ahead[n] = forward if inside else NOWHERE_M
        for n in range(count):
            seen[n] = depth[np.uint32(pixel[n])]
        old_distance, old_weight = distance[row[b]], weight[row[b]]
        for n in range(count):
            off = seen[n] - ahead[n]
            counts = (seen[n] > zero) & (seen[n] <= limits.far_m) & (off >= -limits.truncation_m)
            cut = (off if off < limits.truncation_m else limits.truncation_m) / limits.truncation_m
            before, times = old_distance[n], old_weight[n]
            mean = (times * before + cut) * (one / (times + one))
            old_distance[n] = mean if counts else before
            old_weight[n] = times + one if counts else times


def pinhole_of(K: NDArray) -> Float32:
    """(4,) fx, fy, cx, cy of a camera matrix K (3, 3), px."""
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float32)
