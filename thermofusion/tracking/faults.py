"""What is wrong with recorded poses, for `diagnosis`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import counted
from ..geometry.rigid import interpolate_trajectory, invert, rotation_angle_deg
from ..types import Trajectory

CONVENTION, LOST, TWICE, LOOSE = (
    "recorded poses in another convention",
    "lines of recorded poses missing",
    "lines of recorded poses too many",
    "recorded poses do not fit the depth",
)
A_TURN_DEG = 0.01  # poses that differ by less differ in their unit alone
STOOD_MM = 0.01  # a pose that changed by less is the same, interpolated


@dataclass(frozen=True)
class PoseFault:
    """A fault of recorded poses, as the depth tells it. size : in `unit`."""

    what: str
    evidence: str
    size: float
    unit: str
    where: str
    done: str


def misread(name: str, before: Trajectory, after: Trajectory, misfit_mm: tuple[float, float]) -> PoseFault:
    """Poses that stand in another convention, and as they are read now; misfit_mm : of neighbouring frames, then and
    now."""
    turn_deg = float(np.median(rotation_angle_deg(invert(before.T_world_depth) @ after.T_world_depth)))
    size, unit = (turn_deg, "deg") if turn_deg > A_TURN_DEG else (_larger(before, after), "times")
    evidence = (
        f"neighbouring depth frames miss each other by {misfit_mm[0]:.0f} mm as the poses stand, "
        f"by {misfit_mm[1]:.0f} mm where they are read as {name}"
    )
    return PoseFault(CONVENTION, evidence, size, unit, "all recorded poses", f"read as {name}")


def shifted(before: Trajectory, after: Trajectory, shift: int, frame: int, misfit_mm: tuple[float, float]) -> PoseFault:
    """Poses that stand `shift` frames too early (lines are missing) or late from depth frame number `frame` on.

    misfit_mm : of neighbouring frames at the worst place, then and now.
    """
    T, known = interpolate_trajectory(after, before.times_s)
    off = invert(before.T_world_depth[known]) @ T[known]
    turn, path = rotation_angle_deg(off), 1e3 * np.linalg.norm(off[:, :3, 3], axis=-1)
    moved = path > STOOD_MM
    evidence = (
        f"later poses stand {counted(abs(shift), 'frame')} off, {np.median(turn[moved]):.1f}° and "
        f"{np.median(path[moved]):.0f} mm: neighbouring depth frames missed each other by up to {misfit_mm[0]:.0f} mm, "
        f"with poses at their frames by {misfit_mm[1]:.0f} mm"
    )
    where, done = f"from depth frame {frame} on", "later poses were moved to their frames"
    return PoseFault(LOST if shift > 0 else TWICE, evidence, float(abs(shift)), "frames", where, done)


def loose(misfit_mm: float, where: str) -> PoseFault:
    """Poses that leave misfit_mm between neighbouring depth frames, and nothing known here mends them."""
    evidence = f"neighbouring depth frames miss each other by {misfit_mm:.0f} mm"
    return PoseFault(LOOSE, evidence, misfit_mm, "mm", where, "nothing: the poses are used as they stand")


def refined(faults: tuple[PoseFault, ...]) -> tuple[PoseFault, ...]:
    """The same of poses that were refined afterwards."""
    done = "the poses were refined against the depth"
    return tuple(replace(f, done=done) if f.what == LOOSE else f for f in faults)


def _larger(before: Trajectory, after: Trajectory) -> float:
    """How many times longer the path is than it should be."""
    lengths = [np.linalg.norm(np.diff(t.T_world_depth[:, :3, 3], axis=0), axis=1).sum() for t in (before, after)]
    return float(max(lengths) / max(min(lengths), 1e-12))
