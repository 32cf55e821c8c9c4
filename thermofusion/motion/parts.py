"""Parts of a standing body by place: which vertices are head, trunk, arms and legs, and on which side.

Five extremities stand out along the surface: the point farthest from all others, again and again. The highest is the
head; of the others those that end near the floor are legs. What is nearer to an extremity than its limb is long is
that limb, divided by shares of the limb's length. Shares are those of an adult's body (Drillis & Contini 1966: upper
arm .186, forearm .146, hand .108 of the stature; thigh .245, shin .246; foot .152 long). A scan that shows no whole
body (a torso, a head, a hand) is not divided: it is the trunk.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from ..types import Float, Float32, SurfaceMesh
from .graph import Coarse, thinned

COARSE_M = 0.015
HEAD_FROM, CHEST_FROM, BELLY_FROM, PELVIS_FROM = 0.84, 0.70, 0.585, 0.47  # of the stature: neck, ribs, navel, crotch
HAND, FOREARM, ARM = 0.108, 0.254, 0.44  # of the stature, from the fingertips along the arm
FOOT_BELOW, SHIN_BELOW = 0.05, 0.285  # of the stature: ankle and knee
TOES_FROM_M = 0.05
TALLEST_M, SHORTEST_M = 2.3, 0.7  # of a body that is seen whole
EXTREMITIES = 5


def name_parts(mesh: SurfaceMesh, up: Float) -> tuple[tuple[str, ...], NDArray[np.intp]]:
    """Names of the parts and which one each vertex belongs to, (V,), -1 = none. up : (3,) unit."""
    height = mesh.vertices_m @ up.astype(np.float32)
    low, stature = float(height.min()), float(np.ptp(height))
    coarse = thinned(mesh.vertices_m, mesh.triangles, COARSE_M)
    whole = _limbs(coarse, up) if SHORTEST_M < stature < TALLEST_M else None
    if whole is None:
        return ("body",), np.zeros(len(mesh), np.intp)
    from_hand, hands, toes = whole
    h = (coarse.at_m @ up.astype(np.float32) - low) / stature
    right = _right(coarse, h, up, toes)
    side = np.where(coarse.at_m @ right - np.median(coarse.at_m @ right) > 0, 1, 0)  # 0 left, 1 right
    names = ("head", "chest", "belly", "pelvis", *(f"{s} {p}" for s in ("left", "right") for p in LIMB_PARTS))
    part = np.select([h > HEAD_FROM, h > CHEST_FROM, h > BELLY_FROM, h > PELVIS_FROM], [0, 1, 2, 3], -1)
    first = np.where(side == 1, 4 + len(LIMB_PARTS), 4)
    leg = np.select([h < FOOT_BELOW, h < SHIN_BELOW], [5, 4], 3)
    part = np.where(part < 0, first + leg, part)
    for tip in range(len(hands)):
        d = from_hand[tip] / stature
        own = np.argmin(from_hand, axis=0) == tip
        at = 4 + len(LIMB_PARTS) * int(coarse.at_m[hands[tip]] @ right > np.median(coarse.at_m @ right))
        arm = own & (d < ARM) & (h < HEAD_FROM)
        part = np.where(arm, at + np.select([d < HAND, d < FOREARM], [0, 1], 2), part)
    return names, part[coarse.of_vertex]


LIMB_PARTS = ("hand", "forearm", "upper arm", "thigh", "shin", "foot")


def _limbs(coarse: Coarse, up: Float) -> tuple[Float, list[int], list[int]] | None:
    """Distances (2, C) along the surface from both hands, the fingertips, the feet's ends; None: no whole body."""
    h = coarse.at_m @ up.astype(np.float32)
    start = int(np.argmax(h))
    tips, rows = [start], [np.asarray(dijkstra(coarse.graph, indices=start))]
    for _ in range(EXTREMITIES - 1):
        nearest = np.min(rows, axis=0)
        tip = int(np.argmax(np.where(np.isfinite(nearest), nearest, -1)))
        tips.append(tip)
        rows.append(np.asarray(dijkstra(coarse.graph, indices=tip)))
    span = float(np.ptp(h))
    level = (h[tips] - h.min()) / span
    feet = [k for k in range(1, EXTREMITIES) if level[k] < 0.15]
    hands = [k for k in range(1, EXTREMITIES) if level[k] >= 0.15]
    if len(feet) != 2 or len(hands) != 2:
        return None
    return np.array([rows[k] for k in hands]), [tips[k] for k in hands], [tips[k] for k in feet]


def _right(coarse: Coarse, h: Float32, up: Float, toes: list[int]) -> Float32:
    """(3,) unit, to the subject's own right: the toes say where the front is."""
    foot, ankle = coarse.at_m[h < FOOT_BELOW], coarse.at_m[(h > 0.08) & (h < 0.14)]
    front = (foot.mean(0) - ankle.mean(0)).astype(np.float64)
    front -= (front @ up) * up
    right = np.cross(front, up)
    return (right / np.linalg.norm(right)).astype(np.float32)


__all__ = ["name_parts"]
