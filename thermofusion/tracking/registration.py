"""Point to plane between depth images: projective partners, robust weights, colour as help where there is any.

A point of view i finds its partner in view j by projection, not by search: a few thousand points cost a millisecond.
Residuals are distances along the partner's normal, weighted by depth noise (∝ z²) and a robust kernel; with texture
also differences of intensity. Deterministic: plain sums in a fixed order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.rigid import invert, se3_exp
from ..robust import mad_sigma
from ..types import Float
from .loops import NEAREST_M, SEEN_FROM_M, Found, Image, Limits, Sent, add_up, match
from .maps import DepthMap

COS_FACING = float(np.cos(np.radians(45.0)))  # partners must face alike
MIN_PARTNERS = 150  # a twentieth of a frame's points: fewer fix no pose
NOISE_FLOOR_M = 3e-4  # at 1 m: no spread of residuals is believed to be smaller
RANGE_BIAS_1_M = 0.01  # a depth camera's own error, as z², here at 1 m: what two views share of it cancels
UNSHIFTED_TAN = 0.07  # points that move less than this in the image (tangents) carry nearly one camera error in both
REACH_M = 0.05  # of the partners that judge a motion
INTENSITY_FLOOR = 0.05  # of the normalised intensity, whose local spread is about 1


@dataclass(frozen=True, eq=False)
class Rows:
    """Linear equations direction·(motion of point) = -residual. points, directions : (3, N); residual : (N,).

    range_bias : (N,) m, what views from unlike distances may differ by, however often they say it; 0 for intensities.
    """

    points: Float
    directions: Float
    residual: Float
    range_bias: Float | float = 0.0


@dataclass(frozen=True, eq=False)
class Partners:
    """Points of one view with their partners in another, in the other's frame.

    shape : distance along the partner's normal, m. color : difference of intensity along the image slope, or None.
    share : of the points that project into the other image, how many found a partner. sent : points sent.
    """

    shape: Rows
    color: Rows | None
    share: float
    sent: int

    def __len__(self) -> int:
        return len(self.shape.residual)

    @property
    def fitness(self) -> float:
        """Share of all points sent that found a partner."""
        return len(self) / max(self.sent, 1)

    @property
    def residual_mm_at_1m(self) -> float:
        """Median distance, mm, with the growth of depth noise (z²) taken out."""
        if not len(self):
            return float("nan")
        return float(np.median(np.abs(self.shape.residual) / np.maximum(self.shape.points[2], 0.5) ** 2) * 1e3)


def find_partners(
    source: DepthMap, target: DepthMap, T_target_source: Float, reach_m: float, stride: int = 1
) -> Partners:
    """Partners of the source's sample in the target image, within `reach_m` along and thrice that across.

    T_target_source : (4, 4). stride : only every so many points.
    """
    found, inside, _ = _matched(source, target, T_target_source, reach_m, stride)
    color = None
    if target.texture is not None and source.sample_intensity is not None:
        texture = np.array(target.texture.take(found.pixel, axis=0).T, np.float64, order="C")
        texture[0] += texture[1] * found.off_px[0] + texture[2] * found.off_px[1]
        own = source.sample_intensity[::stride].take(found.sent)
        color = _color_rows(found.points, own, texture, *target.intrinsics[:2])
    shape = Rows(found.points, found.directions, found.residual, found.bias)
    return Partners(shape, color, len(found.residual) / max(inside, 1), -(-len(source.sample) // stride))


def _matched(
    source: DepthMap, target: DepthMap, T_target_source: Float, reach_m: float, stride: int
) -> tuple[Found, int, int]:
    """(partners, points that project into the target, points that contradict it), see `loops.match`."""
    room = Found.of(-(-len(source.sample) // stride))
    sent = Sent(source.sample, source.sample_normals, stride)
    image = Image(target.surface, target.shape, target.intrinsics)
    inside, n, conflicts = match(sent, image, T_target_source, Limits(reach_m, COS_FACING, RANGE_BIAS_1_M), room)
    return room.first(n), inside, conflicts


@dataclass(frozen=True)
class Seen:
    """How one view's points look from another: agree with its surface; stand where it saw through, or saw nothing;
    the rest is hidden behind its surface or outside its image. sent : all."""

    agree: int
    conflict: int
    sent: int


def seen_from(source: DepthMap, target: DepthMap, T_target_source: Float, reach_m: float, stride: int = 1) -> Seen:
    """Whether the target, from where it is, could have taken its image of the source's points.

    T_target_source : (4, 4). reach_m, stride : of `find_partners`.
    """
    found, _, conflicts = _matched(source, target, T_target_source, reach_m, stride)
    return Seen(len(found.residual), conflicts, -(-len(source.sample) // stride))


def agreement(a: DepthMap, b: DepthMap, T_b_a: Float, stride: int = 1) -> float:
    """Share of what both views see that agrees, outlines included, at T_b_a (4, 4); 0 where they share nothing."""
    one, other = seen_from(a, b, T_b_a, REACH_M, stride), seen_from(b, a, invert(T_b_a), REACH_M, stride)
    agree = one.agree + other.agree
    return agree / max(agree + one.conflict + other.conflict, 1)


def pixels_of(target: DepthMap, p: Float) -> tuple[NDArray[np.intp], NDArray[np.intp], Float]:
    """Flat pixel of each point of the target's frame that falls inside its image; which points those are; and how far
    each falls from the pixel's centre, (N, 2)."""
    fx, fy, cx, cy = target.intrinsics
    h, w = target.shape
    x, y, z = np.ascontiguousarray(p.T)
    near = np.maximum(z, NEAREST_M)
    u, v = x / near * fx + cx, y / near * fy + cy
    column, row = np.rint(u), np.rint(v)
    inside = np.flatnonzero((z > SEEN_FROM_M) & (column >= 0) & (row >= 0) & (column < w) & (row < h))
    pixel = (row * w + column).take(inside).astype(np.intp)
    return pixel, inside, np.stack([(u - column).take(inside), (v - row).take(inside)], axis=1)


def _color_rows(p: Float, intensity: Float, texture: Float, fx: float, fy: float) -> Rows:
    """Intensity of the target at the projected point, texture (3, N) with its slopes, minus the source's own."""
    residual = texture[0] - intensity
    good = np.flatnonzero(np.isfinite(residual))
    p, gu, gv = p.take(good, axis=1), fx * texture[1].take(good), fy * texture[2].take(good)
    z = p[2]
    direction = np.stack([gu / z, gv / z, -(gu * p[0] + gv * p[1]) / z**2])
    return Rows(p, direction, residual.take(good))


def shape_weights(rows: Rows) -> Float:
    """Weights (N,), m-2: 1/z⁴ for depth noise, less where ranges differ, times a Cauchy factor at twice the spread."""
    noise = rows.points[2] ** 2
    return _robust(rows.residual / noise, NOISE_FLOOR_M, rows.range_bias / noise) / noise**2


def _robust(r: Float, floor: float, bias: Float | float = 0.0) -> Float:
    """1/σ² times the Cauchy factor, σ from the residuals' own median, and from a bias where they have one."""
    variance = max(mad_sigma(r), floor) ** 2 + np.square(bias)
    return np.asarray(1 / (variance + r * r / 4))


def normal_equations(partners: Partners, T_world_target: Float) -> tuple[Float, Float]:
    """(6, 6) H and (6,) g of Σ w r² for a left twist (rotation, translation) of the source in the world."""
    H, g = _summed(partners.shape, shape_weights(partners.shape), T_world_target)
    if partners.color is not None and len(partners.color.residual) >= MIN_PARTNERS:
        h, b = _summed(partners.color, _robust(partners.color.residual, INTENSITY_FLOOR), T_world_target)
        H, g = H + h, g + b
    return H, g


def _summed(rows: Rows, weight: Float, T_world_target: Float) -> tuple[Float, Float]:
    H, g = add_up(rows.points, rows.directions, rows.residual, weight, T_world_target)
    return H, g


def image_shift(points: Float, T_target_source: Float) -> float:
    """How far the image of points (3, N) of the target's frame moves between two views: rms, in tangents; 0 of none."""
    if not points.size:
        return 0.0
    there = T_target_source[:3, :3].T @ (points - T_target_source[:3, 3:])
    dx, dy = there[0] / there[2] - points[0] / points[2], there[1] / there[2] - points[1] / points[2]
    return float(np.sqrt((dx @ dx + dy @ dy) / points.shape[1]))


def trust(shift_tan: float) -> float:
    """Share of a pair's information that counts, by how far its points move in the image.

    A depth camera errs smoothly over its image (lens, pattern), and thousands of points together have less noise than
    that. Two views whose points hardly move in the image share the error; what they differ by grows with the move.
    """
    return 1 / (1 + (shift_tan / UNSHIFTED_TAN) ** 2)


def register_view(
    source: DepthMap,
    targets: Sequence[tuple[DepthMap, Float]],
    T_world_source: Float,
    reaches_m: Sequence[float],
    *,
    stride: int = 1,
    tolerance: float = 1e-6,
) -> tuple[Float, Partners | None]:
    """Gauss-Newton of one view against fixed others: (T_world_source, partners in the best target at the end).

    targets : maps with their T_world_target (4, 4). T_world_source : (4, 4), the start. reaches_m : one iteration
    each, from far to near; ends early when a step at the last reach is below `tolerance` rad and m. None for the
    partners if no target has enough.
    """
    T = T_world_source
    last: Partners | None = None
    for reach in reaches_m:
        H, g, last = np.zeros((6, 6)), np.zeros(6), None
        for target, T_world_target in targets:
            partners = find_partners(source, target, invert(T_world_target) @ T, reach, stride)
            if len(partners) < MIN_PARTNERS // stride:
                continue
            h, b = normal_equations(partners, T_world_target)
            H, g = H + h, g + b
            if last is None or partners.fitness > last.fitness:
                last = partners
        if last is None:
            return T, None
        step = np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), -g)
        T = se3_exp(step) @ T
        if reach == reaches_m[-1] and np.abs(step).max() < tolerance:
            break
    return T, last
