"""How a standing person moves: sway about the ankles, breath, drifting arms, a nodding head, a foot that is set aside.

A model of its own, by joints and not by nodes, so that whoever solves for motion does not meet his own assumptions.
Amounts: quiet standing sways in 0.05-0.5 Hz (posturography), the ribs move 3-5 mm and the belly forward in quiet breath
(De Groote 1997), arms drift by a degree or two about the shoulders.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..types import Float, Float32
from .scene import MotionConfig, ShapeConfig
from .shapes import ELBOW, HIP, NECK_Z, SHOULDER, WRIST, Mesh, graph_laplacian, limb_weight

ANKLE_Z, CHEST_Z, BELLY_Z = 0.08, 1.25, 1.05  # m, of a body of 1.75 m
WAVES = 5  # sines of every drift
SPAN = 5.5  # of a drift from end to end, in its rms
STEP_S = 1.0  # in which a foot is set aside, in the middle of the recording
TRUNK_Z = (0.85, 1.40)  # m, what the trunk's rigid motion is fitted to
TRUNK_OWN = 1e-3  # of the weights of moving parts: breath is no motion of the trunk
MIDLINE_M = 0.13  # half a trunk's width
PART_FROM_Z = (1.50, 1.22, 1.02, 0.83)  # m: where head, chest, belly and pelvis begin
LEG_FROM_Z = (0.50, 0.09)  # m: where thigh and shin begin
LIMB_PARTS = ("hand", "forearm", "upper arm", "thigh", "shin", "foot")


@dataclass(frozen=True)
class Standing:
    """Amounts of a way to stand: sway at the chest, mm rms; chest and belly, mm from end to end; arms and head, degrees
    from end to end; how much faster than quiet standing."""

    sway_mm: float
    chest_mm: float
    belly_mm: float
    arms_deg: float
    head_deg: float
    faster: float = 1.0


STANDING = MappingProxyType(
    {
        "quiet": Standing(6.0, 6.0, 8.0, 2.5, 1.0),
        "tired": Standing(10.0, 8.0, 10.0, 4.0, 3.0, 0.7),
        "restless": Standing(9.0, 6.0, 8.0, 6.0, 5.0, 1.5),
        "child": Standing(8.0, 4.0, 8.0, 5.0, 4.0, 1.6),
        "breath-held": Standing(6.0, 0.0, 0.0, 2.5, 1.0),
    }
)


@dataclass(frozen=True, eq=False)
class Posture:
    """The body's shape at any time, in the frame of the floor it stands on.

    rest_m : (V, 3). weights : (V,) of each moving part. angles, of (T, ...) at times_s (T,): ankle (2,) and head (1,),
    arms (2 sides, 2 axes), rad; breath (1,), -1..1; step (1,), 0..1.
    """

    rest_m: Float
    normals: Float
    weights: dict[str, Float]
    scale: Float
    standing: Standing
    step_rad: float
    times_s: Float
    angles: dict[str, Float]

    @classmethod
    def of(
        cls, mesh: Mesh, shape: ShapeConfig, motion: MotionConfig, times_s: Float, rng: np.random.Generator
    ) -> Posture:
        """Of a phantom's body; every drift has its mean over times_s at rest."""
        chosen = STANDING["quiet"] if motion.standing == "still" else STANDING[motion.standing]
        k = motion.standing_amount if motion.standing != "still" else 0.0
        scale = shape.height_scale * np.array([shape.girth_scale, shape.girth_scale, 1.0])
        p = mesh.vertices_m.astype(np.float64) / scale
        band = np.array([0.05, 0.4]) * chosen.faster
        drift = lambda n, size: size * _drift(times_s, n, band, rng)  # noqa: E731
        breath = np.sin(2 * np.pi * motion.breaths_per_min / 60 * times_s)[:, None]
        middle = times_s[0] + (times_s[-1] - times_s[0]) / 2
        step = np.clip((times_s - middle) / STEP_S + 0.5, 0, 1)[:, None]
        angles = {
            "ankle": drift(2, k * chosen.sway_mm / 1e3 / ((CHEST_Z - ANKLE_Z) * shape.height_scale) / np.sqrt(2)),
            "head": drift(1, k * np.radians(chosen.head_deg) / SPAN),
            "arms": drift(4, k * np.radians(chosen.arms_deg) / (np.sqrt(2) * SPAN)),
            "breath": k * breath,
            "step": step,
        }
        angles = {name: a - a.mean(0) for name, a in angles.items()}
        step_rad = motion.step_mm / 1e3 / (HIP[2] * shape.height_scale)
        weights = _weights(p, mesh)
        normals = mesh.normals.astype(np.float64)
        return cls(mesh.vertices_m.astype(np.float64), normals, weights, scale, chosen, step_rad, times_s, angles)

    def at(self, time_s: float) -> Float32:
        """(V, 3) where the body's vertices are."""
        now = {n: np.array([np.interp(time_s, self.times_s, c) for c in a.T]) for n, a in self.angles.items()}
        v, w = self.rest_m, self.weights
        out = v + (now["breath"][0] / 2e3) * (
            self.standing.chest_mm * w["chest"][:, None] * self.normals
            + self.standing.belly_mm * w["belly"][:, None] * np.array([0.0, -1.0, 0.0])
        )
        for side, sign in enumerate((1.0, -1.0)):
            joint = SHOULDER * np.array([sign, 1, 1]) * self.scale
            turn = Rotation.from_euler("xy", now["arms"][2 * side : 2 * side + 2])
            out = _turned(out, w[f"arm{side}"], joint, turn)
        out = _turned(
            out, w["head"], np.array([0, 0.02, NECK_Z]) * self.scale, Rotation.from_euler("x", now["head"][0])
        )
        leg = Rotation.from_euler("y", -self.step_rad * now["step"][0])
        out = _turned(out, w["leg"], HIP * self.scale, leg)
        ankle = Rotation.from_euler("xy", now["ankle"])
        return _turned(out, w["ankle"], np.array([0, 0, ANKLE_Z]) * self.scale, ankle).astype(np.float32)

    def truth(self, times_s: Float) -> dict[str, Any]:
        """What is written down: T_world_trunk (N, 4, 4), rest to frame; of parts and vertices, motion against it."""
        names, part = parts_of(self.rest_m / self.scale, self.weights)
        size = np.maximum(np.bincount(part, minlength=len(names)), 1)
        mean = lambda x: np.stack([np.bincount(part, c, len(names)) for c in x.T], axis=1) / size[:, None]  # noqa: E731
        poses, room, own, squares = [], [], [], np.zeros(len(part))
        for t in times_s:
            now = self.at(float(t)).astype(np.float64)
            T = self.trunk(now)
            moved = (now - T[:3, 3]) @ T[:3, :3] - self.rest_m
            squares += (moved**2).sum(1)
            poses.append(T)
            own.append(mean(moved))
            room.append(mean(now - self.rest_m))
        far = 1e3 * np.linalg.norm(np.array(own) - np.mean(own, axis=0), axis=2)
        return {
            "times_s": times_s,
            "T_world_trunk": np.array(poses),
            "vertex_motion_rms_mm": (1e3 * np.sqrt(squares / len(times_s))).astype(np.float32),
            "vertex_part": part,
            "part_names": np.array(names),
            "part_centre_m": mean(self.rest_m),
            "part_displacement_m": np.array(room, np.float32),
            "part_motion_rms_mm": np.sqrt((far**2).mean(0)),
        }

    def trunk(self, vertices_m: Float) -> Float:
        """(4, 4) the rigid motion of the trunk from rest to vertices_m (V, 3)."""
        rows = self.weights["trunk"] > 0
        a, b = self.rest_m[rows], vertices_m[rows].astype(np.float64)
        U, _, Vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
        T = np.eye(4)
        T[:3, :3] = Vt.T @ np.diag([1, 1, np.sign(np.linalg.det(Vt.T @ U.T))]) @ U.T
        T[:3, 3] = b.mean(0) - T[:3, :3] @ a.mean(0)
        return T


def parts_of(p: Float, weights: dict[str, Float]) -> tuple[tuple[str, ...], Float]:
    """Names of the parts of a body of 1.75 m, and which one each vertex p (V, 3) belongs to, (V,) int8."""
    names = ["head", "chest", "belly", "pelvis"]
    names += [f"{side} {k}" for side in ("left", "right") for k in LIMB_PARTS]
    part = np.select([p[:, 2] > z for z in PART_FROM_Z], [0, 1, 2, 3], -1)
    leg = 4 + len(LIMB_PARTS) * (p[:, 0] < 0) + np.select([p[:, 2] > LEG_FROM_Z[0], p[:, 2] > LEG_FROM_Z[1]], [3, 4], 5)
    part = np.where(part < 0, leg, part)
    for side, sign in enumerate((1.0, -1.0)):
        q = p * np.array([sign, 1, 1])
        along = (WRIST - ELBOW) / np.linalg.norm(WRIST - ELBOW)
        arm = np.select([(q - WRIST) @ along > 0, (q - ELBOW) @ along > 0], [0, 1], 2)
        part = np.where(weights[f"arm{side}"] > 0.5, 4 + len(LIMB_PARTS) * side + arm, part)
    return tuple(names), part.astype(np.int8)


def _drift(times_s: Float, count: int, band_hz: Float, rng: np.random.Generator) -> Float:
    """(T, count) sums of slow sines, each of rms 1; the slower the larger."""
    hz = np.exp(rng.uniform(np.log(band_hz[0]), np.log(band_hz[1]), (count, WAVES)))
    size = (1 / hz) / np.linalg.norm(1 / hz, axis=1, keepdims=True) * np.sqrt(2)
    phase = rng.uniform(0, 2 * np.pi, (count, WAVES))
    return (size * np.sin(2 * np.pi * hz * times_s[:, None, None] + phase)).sum(2)


def _turned(v: Float, weight: Float, joint: Float, rotation: Rotation) -> Float:
    return v + weight[:, None] * (rotation.apply(v - joint) + joint - v)


def _weights(p: Float, mesh: Mesh) -> dict[str, Float]:
    """How much each vertex p (V, 3), of a body of 1.75 m, follows each moving part."""
    laplacian = graph_laplacian(len(p), mesh.triangles)
    mirror = np.array([-1.0, 1, 1])
    out = {
        f"arm{side}": limb_weight(laplacian, q, SHOULDER, ELBOW - SHOULDER, (-0.04, 0.10), 0.11)
        for side, q in enumerate((p, p * mirror))
    }
    arms = np.maximum(out["arm0"], out["arm1"])
    front = np.clip(-p[:, 1] / 0.06, 0, 1) * (1 - arms)
    bump = lambda z: np.exp(-0.5 * ((p[:, 0] / 0.13) ** 2 + ((p[:, 2] - z) / 0.12) ** 2))  # noqa: E731
    out["chest"], out["belly"] = front * bump(CHEST_Z), front * bump(BELLY_Z)
    out["head"] = np.clip((p[:, 2] - NECK_Z) / 0.08 + 0.5, 0, 1)
    out["ankle"] = np.clip((p[:, 2] - ANKLE_Z) / 0.06 + 0.5, 0, 1)
    side = np.clip((p[:, 0] - 0.02) / 0.04, 0, 1)
    out["leg"] = side * np.clip((0.92 - p[:, 2]) / 0.15, 0, 1) * (arms < 0.5)
    own = np.max([arms, out["chest"], out["belly"], out["leg"], out["head"]], axis=0)
    inside = (np.abs(p[:, 0]) < MIDLINE_M) & (p[:, 2] > TRUNK_Z[0]) & (p[:, 2] < TRUNK_Z[1])
    out["trunk"] = (inside & (own < TRUNK_OWN)).astype(np.float64)
    return out
