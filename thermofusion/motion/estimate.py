"""How a subject moved while it was recorded, from depth frames against its own surface.

The surface of a rigid fusion is cut into nodes 15 cm apart; each turns and shifts a little at every knot in time, half
a second apart, and all are solved together with the surface's own shape: what all frames say of a point in common is
shape, what changes over time is motion. Neighbouring nodes are held together, and each to itself from knot to knot.
What the trunk does is the camera's motion, and the mean over time is rest.

A subject who stood still is told beforehand by what is left of the rigid fusion, and costs one look at the frames.
Motion is kept only if it predicts frames that it was not fitted to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.rigid import invert, se3_exp, se3_log
from ..types import Float, Float32, Int, SurfaceMesh
from .field import BoundPoints, MotionField, affine, carried, displacement
from .gauge import common_motion, poses_without, unsteady, without
from .graph import Binding, NodeGraph, bind, build_graph, cells
from .rest import unrest
from .rows import CORRELATED, CoarseFrames, LeftOver, Normal, gather, jacobian, left_over
from .solve import Steps, edge_matrix, held_matrix, solve_motion

SPACING_M = 0.15  # of nodes: rigid pieces of this size leave 0.34 mm of a body's sway, breath and drifting arms
POINTS_M, LOOK_M = 0.02, 0.025  # of the points that are compared with frames, and of those that tell whether to
KNOT_FRAMES, KNOT_S = 10, 0.65  # between knots: linear in between, 0.16 mm of such motion is left
# Where measurements are looked for, and from where on they count less, by iteration: against the smeared surface of the
# rigid fusion, then against one that was fused at rest.
SMEARED_M = ((0.06, 0.02), (0.06, 0.015), (0.04, 0.01), (0.03, 0.007))
SHARP_M = ((0.03, 0.007), (0.02, 0.005), (0.02, 0.004))
LEFT_OUT = 4  # every fourth frame judges
STILL = 0.5  # `unrest` below it: noise
MIN_GAIN = 0.02  # share by which the left-out residual must fall: of all points, most of which hardly move
MIN_FRAMES, MIN_VERTICES = 30, 1000
MAX_SHIFT_M = 0.01  # of a point along its normal, at once


@dataclass(frozen=True, eq=False)
class Solution:
    """A motion. field : of the nodes. surface : that it was found on, at rest, and the binding of its vertices.
    correction : (N, 6) left twists of the frames' poses. before, after : what frames left out leave (rms, in sigmas).
    point_m : (P, 3) points at rest that `after` speaks of."""

    field: MotionField
    surface: SurfaceMesh
    binding: Binding
    correction: Float
    before: float
    after: LeftOver
    point_m: Float32

    def poses(self, kept_s: Float, times_s: Float, T_world_depth: Float) -> Float:
        """T_world_depth (N, 4, 4) at times_s (N,), corrected as those of the frames at kept_s (M,) were."""
        x = np.stack([np.interp(times_s, kept_s, c) for c in self.correction.T], axis=1)
        return se3_exp(x) @ T_world_depth


def estimate(
    mesh: SurfaceMesh, frames: CoarseFrames, noise_m_at_1m: float, fused: Callable[[Solution], SurfaceMesh]
) -> Solution | None:
    """The motion of the subject whose rigid fusion is `mesh`; None where it is not told from rest.

    fused : the surface that some of the frames make, brought to rest by a motion.
    """
    if len(frames) < MIN_FRAMES or len(mesh) < MIN_VERTICES:
        return None
    knots = _knots(frames.times_s)
    if unrest(frames, mesh, look_points(mesh, LOOK_M), knots, noise_m_at_1m) < STILL:
        return None
    graph = build_graph(mesh.vertices_m, mesh.triangles, SPACING_M)
    state = _State.of(mesh, graph, MotionField.at_rest(graph.at_m, knots), frames)
    held_out = range(LEFT_OUT - 1, len(frames), LEFT_OUT)
    rows = [i for i in range(len(frames)) if i not in held_out]
    before = left_over(frames, held_out, state.points, state.field, noise_m_at_1m).rms
    for reach, kernel in SMEARED_M:
        state = state.improved(rows, reach, kernel, noise_m_at_1m)
    after = left_over(state.frames, held_out, state.points, state.field, noise_m_at_1m)
    if not after.rms < (1 - MIN_GAIN) * before:
        return None
    sharp = fused(state.solution(frames, before, after))
    graph = replace(graph, at_m=state.field.node_m, binding=bind(sharp.vertices_m, sharp.triangles, state.field.node_m))
    state = _State.of(sharp, graph, state.field, state.frames)
    for reach, kernel in SHARP_M:
        state = state.improved(rows, reach, kernel, noise_m_at_1m)
    after = left_over(state.frames, held_out, state.points, state.field, noise_m_at_1m)
    return state.solution(frames, before, after)


def _knots(times_s: Float) -> Float:
    """Times of the knots, even over the recording."""
    span = float(times_s[-1] - times_s[0])
    count = round(min(span / KNOT_S, len(times_s) / KNOT_FRAMES))
    return np.linspace(times_s[0], times_s[-1], max(count, 2) + 1)


def look_points(mesh: SurfaceMesh, spacing_m: float) -> Int:
    """(P,) vertices, about one in a cell of `spacing_m`."""
    return np.unique(cells(mesh.vertices_m, spacing_m), return_index=True)[1].astype(np.int32)


@dataclass(frozen=True, eq=False)
class _State:
    """Where the solution stands. moved : (K, 6) what of the nodes' motion has become rest. area : (K,) points. normal :
    of the points' rows, once there were some."""

    mesh: SurfaceMesh
    graph: NodeGraph
    points: BoundPoints
    field: MotionField
    frames: CoarseFrames
    moved: Float
    area: Float
    normal: Normal | None = None

    @classmethod
    def of(cls, mesh: SurfaceMesh, graph: NodeGraph, field: MotionField, frames: CoarseFrames) -> _State:
        pick = look_points(mesh, POINTS_M)
        points = BoundPoints(mesh.vertices_m[pick], mesh.normals[pick], graph.binding.take(pick))
        group = points.binding.group
        carried_by, share = points.binding.node[group].ravel(), points.binding.weight[group].ravel()
        area: Float = np.bincount(carried_by, share, len(graph)).astype(np.float64)
        return cls(mesh, graph, points, field, frames, np.zeros((len(graph), 6)), area)

    def solution(self, start: CoarseFrames, before: float, after: LeftOver) -> Solution:
        """As it stands; `start` holds the poses that it began with."""
        graph = self.graph
        rest = self.mesh.vertices_m + displacement(self.mesh.vertices_m, graph.binding, graph.at_m, self.moved)
        surface = replace(self.mesh, vertices_m=rest.astype(np.float32))
        correction = se3_log(self.frames.T_world_depth @ invert(start.T_world_depth))
        return Solution(self.field, surface, graph.binding, correction, before, after, self.points.at_m)

    def improved(self, rows: Sequence[int], reach_m: float, kernel_m: float, noise_m_at_1m: float) -> _State:
        """After one Gauss-Newton step of motion, shape, and jitter of the poses; both gauges settled."""
        field, frames, points = self.field, self.frames, self.points
        sums, steps = gather(frames, rows, points, field, reach_m, noise_m_at_1m, kernel_m)
        J = jacobian(points, field.node_m)
        rest = replace(self.graph, at_m=field.node_m)
        held = held_matrix(rest, edge_matrix(rest))
        slow = Steps.of(rest, field.knot_s, field.twist)
        normal = Normal.of(J) if self.normal is None else self.normal.again(J)
        solved = solve_motion(sums, normal, J, field.twist, held, slow, 1 / CORRELATED)
        shift = np.clip(solved.shape_m, -MAX_SHIFT_M, MAX_SHIFT_M).astype(np.float32)
        points = replace(points, at_m=points.at_m + shift[:, None] * points.normal)
        T = se3_exp(unsteady(field, frames.times_s, steps)) @ frames.T_world_depth
        field = field.moved(solved.twist)
        common = common_motion(field, self.area)
        field, T = without(field, common), poses_without(field, common, frames.times_s, T)
        mean = field.twist.mean(0)
        points = carried(points, affine(field.node_m, mean, points.binding))
        field = replace(field, node_m=field.node_m + mean[:, 3:], twist=field.twist - mean)
        frames, moved = replace(frames, T_world_depth=T), self.moved + mean
        return replace(self, points=points, field=field, frames=frames, moved=moved, normal=normal)
