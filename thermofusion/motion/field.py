"""A motion over time: rigid nodes at knots in time, linear in between, blended over the surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..types import Float, Float32, brief
from .graph import Binding

Slots = tuple[int, int, float]


@dataclass(frozen=True, eq=False)
class MotionField:
    """How the nodes move: at knot f node k turns by a rotation vector about itself, and shifts.

    node_m : (K, 3) m, at rest. knot_s : (F,) s, increasing. twist : (F, K, 6) rotation vector [rad] and shift [m], in
    the world.
    """

    node_m: Float
    knot_s: Float
    twist: Float

    __repr__ = brief

    @classmethod
    def at_rest(cls, node_m: Float, knot_s: Float) -> MotionField:
        """Nodes node_m (K, 3) that do not move at any of the knots knot_s (F,)."""
        return cls(node_m, knot_s, np.zeros((len(knot_s), len(node_m), 6)))

    def moved(self, twist: Float) -> MotionField:
        """The same nodes and knots with other twists (F, K, 6), rad and m."""
        return replace(self, twist=twist)

    def slot(self, time_s: float) -> Slots:
        """(f, f + 1, share of the way from knot f to the next); before the first and after the last knot: theirs."""
        if len(self.knot_s) == 1:
            return 0, 0, 0.0
        f = int(np.clip(np.searchsorted(self.knot_s, time_s, side="right") - 1, 0, len(self.knot_s) - 2))
        s = (time_s - self.knot_s[f]) / (self.knot_s[f + 1] - self.knot_s[f])
        return f, f + 1, float(np.clip(s, 0.0, 1.0))

    def at(self, time_s: float) -> Float:
        """(K, 6) the nodes' twists at a time."""
        a, b, s = self.slot(time_s)
        return (1 - s) * self.twist[a] + s * self.twist[b]


def rotations(vectors: Float) -> Float:
    """(..., 3, 3) rotations of rotation vectors (..., 3) [rad], by Rodrigues' formula."""
    angle2 = (vectors**2).sum(-1)[..., None, None]
    angle = np.sqrt(np.maximum(angle2, 1e-16))
    W = np.zeros((*vectors.shape, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -vectors[..., 2], vectors[..., 1], -vectors[..., 0]
    W = W - np.swapaxes(W, -1, -2)
    return np.eye(3) + np.sin(angle) / angle * W + (1 - np.cos(angle)) / angle**2 * (W @ W)


@dataclass(frozen=True, eq=False)
class BoundPoints:
    """Points of the surface and the nodes that carry them.

    at_m : (P, 3) float32 m, at rest. normal : (P, 3) float32, unit, outward. binding : of the points.
    """

    at_m: Float32
    normal: Float32
    binding: Binding

    def __len__(self) -> int:
        return len(self.at_m)


def affine(node_m: Float, twist: Float, binding: Binding) -> Float32:
    """(P, 3, 4) float32: the blended motion of every point, p -> A p + b, of nodes node_m (K, 3) with a twist (K, 6).

    Linear blending: Σ w_k [R_k (p - g_k) + g_k + t_k] = (Σ w_k R_k) p + Σ w_k (g_k + t_k - R_k g_k).
    """
    R = rotations(twist[:, :3])
    shift = node_m + twist[:, 3:] - np.einsum("kij,kj->ki", R, node_m)
    whole = np.concatenate([R, shift[:, :, None]], axis=2).reshape(-1, 12).astype(np.float32)
    groups = np.einsum("gn,gnc->gc", binding.weight, whole[binding.node])
    return np.take(groups, binding.group, axis=0).reshape(-1, 3, 4)


def displacement(points_m: NDArray, binding: Binding, node_m: Float, twist: Float) -> Float32:
    """(P, 3) m, how far points_m (P, 3) move by a twist (K, 6) of the nodes at node_m (K, 3)."""
    M = affine(node_m, twist, binding)
    return np.einsum("pij,pj->pi", M[:, :, :3], points_m.astype(np.float32)) + M[:, :, 3] - points_m


def carried(points: BoundPoints, M: Float32) -> BoundPoints:
    """The points moved by affine motions M (P, 3, 4) in metres, normals turned with them."""
    at = np.einsum("pij,pj->pi", M[:, :, :3], points.at_m) + M[:, :, 3]
    normal = np.einsum("pij,pj->pi", M[:, :, :3], points.normal)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-9))
    return replace(points, at_m=at, normal=normal)
