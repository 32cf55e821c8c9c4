"""The inner loops of registration, compiled: partners of a view's points in another, the sums of their equations."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..types import Float, Float32

SEEN_FROM_M = 0.1  # nearer than this nothing is seen
NEAREST_M = 1e-3  # that is divided by


class Sent(NamedTuple):
    """Points (N, 3) m and their unit normals (N, 3) in a view's own frame, float64; only every `stride`-th is sent."""

    points: Float
    normals: Float
    stride: int


class Image(NamedTuple):
    """Another view's surface (H*W, 6) float32, point and normal, NaN = none; its shape, and fx, fy, cx, cy."""

    surface: Float32
    shape: tuple[int, int]
    intrinsics: tuple[float, float, float, float]


class Limits(NamedTuple):
    """Partners lie within reach_m along the normal and thrice that across, and face alike to within a cosine; what
    two views of unlike range may differ by is bias_1_m times the difference of z²."""

    reach_m: float
    cos: float
    bias_1_m: float


class Found(NamedTuple):
    """Room for N partners. points, directions : (3, N) the point in the other frame, and the partner's normal.
    residual : (N,) m along it. bias : (N,) m. sent : (N,) which of those sent. pixel : (N,) its pixel, off_px : (2, N)
    how far from the pixel's centre."""

    points: Float
    directions: Float
    residual: Float
    bias: Float
    sent: NDArray[np.intp]
    pixel: NDArray[np.intp]
    off_px: Float

    @classmethod
    def of(cls, n: int) -> Found:
        """Empty room for n."""
        sent, pixel = np.empty(n, np.intp), np.empty(n, np.intp)
        return cls(np.empty((3, n)), np.empty((3, n)), np.empty(n), np.empty(n), sent, pixel, np.empty((2, n)))

    def first(self, n: int) -> Found:
        """The first n of them."""
        three = self.points[:, :n], self.directions[:, :n]
        return Found(*three, self.residual[:n], self.bias[:n], self.sent[:n], self.pixel[:n], self.off_px[:, :n])


@compiled
def match(sent: Sent, image: Image, T: Float, limits: Limits, found: Found) -> Any:  # pragma: no cover
    """Partners of points, T (4, 4) from their frame to the image's, written into `found`; (how many project into the
    image, how many found a partner, how many face it and stand where it saw through them or saw nothing)."""
    height, width = image.shape
    fx, fy, cx, cy = image.intrinsics
    surface, reach = image.surface, limits.reach_m
    inside, partners, conflicts = 0, 0, 0
    for s, k in enumerate(range(0, sent.points.shape[0], sent.stride)):
        a, b, c = sent.points[k, 0], sent.points[k, 1], sent.points[k, 2]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if not z > SEEN_FROM_M:
            continue
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        u, v = x / z * fx + cx, y / z * fy + cy
        column, row = np.rint(u), np.rint(v)
        if not (column >= 0 and row >= 0 and column < width and row < height):
            continue
        inside += 1
        p, q, r = sent.normals[k, 0], sent.normals[k, 1], sent.normals[k, 2]
        n0 = T[0, 0] * p + T[0, 1] * q + T[0, 2] * r
        n1 = T[1, 0] * p + T[1, 1] * q + T[1, 2] * r
        n2 = T[2, 0] * p + T[2, 1] * q + T[2, 2] * r
        pixel = int(row) * width + int(column)
        depth = np.float64(surface[pixel, 2])
        if x * n0 + y * n1 + z * n2 < 0 and not depth <= z + reach:
            conflicts += 1
        m0, m1, m2 = np.float64(surface[pixel, 3]), np.float64(surface[pixel, 4]), np.float64(surface[pixel, 5])
        d0, d1, d2 = x - surface[pixel, 0], y - surface[pixel, 1], z - depth
        off = d0 * m0 + d1 * m1 + d2 * m2
        if not (abs(off) < reach and d0 * d0 + d1 * d1 + d2 * d2 < (3 * reach) ** 2):
            continue
        if not n0 * m0 + n1 * m1 + n2 * m2 > limits.cos:
            continue
        found.points[0, partners], found.points[1, partners], found.points[2, partners] = x, y, z
        found.directions[0, partners], found.directions[1, partners], found.directions[2, partners] = m0, m1, m2
        found.residual[partners] = off
        found.bias[partners] = limits.bias_1_m * abs(c * c - depth * depth)
        found.sent[partners], found.pixel[partners] = s, pixel
        found.off_px[0, partners], found.off_px[1, partners] = u - column, v - row
        partners += 1
    return inside, partners, conflicts


@compiled
def add_up(points: Float, directions: Float, residual: Float, weight: Float, T: Float) -> Any:  # pragma: no cover
    """(6, 6) Σ w J Jᵀ and (6,) Σ w J r of rows in columns points, directions (3, N), residual, weight (N,); J is how
    a left twist (rotation, translation) moves a point along its direction, both turned by T (4, 4)."""
    H, g, J = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    for k in range(residual.shape[0]):
        a, b, c = points[0, k], points[1, k], points[2, k]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        a, b, c = directions[0, k], directions[1, k], directions[2, k]
        n0 = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c
        n1 = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c
        n2 = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c
        J[0], J[1], J[2] = y * n2 - z * n1, z * n0 - x * n2, x * n1 - y * n0
        J[3], J[4], J[5] = n0, n1, n2
        for i in range(6):
            w = weight[k] * J[i]
            g[i] += w * residual[k]
            for j in range(i + 1):
                H[i, j] += w * J[j]
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return H, g
