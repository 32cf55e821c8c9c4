"""Which parts of the pictures, tilts and distances the views cover, and what to record next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import counted
from ...types import Float
from .rig import Calibration

GRID = 3  # parts of a picture each way
ROWS, COLUMNS = ("upper", "middle", "lower"), ("left", "centre", "right")
MIN_TILT_DEG = 12.0  # to each side: boards more upright leave focal length and distance interchangeable
ENOUGH_VIEWS = 15  # docs/calibration.md asks for 15 to 30
MIN_DISTANCE_RATIO = 1.4  # farthest to nearest board: a depth error that grows with range shows over some range only


@dataclass(frozen=True, eq=False)
class Coverage:
    """counts : (3, 3) points by part of the picture. tilts_deg : (V, 2) by which the board's face looks to the
    right and up, as seen in the picture.
    distances_m : (V,) to the board's middle."""

    camera: str
    counts: np.ndarray
    tilts_deg: Float
    distances_m: Float


def coverage(calibration: Calibration, camera: str) -> Coverage:
    """Of one point camera, over the views used."""
    fit = calibration.fit
    width, height = fit.problem.sizes[camera]
    px = np.concatenate([v.points[camera].px for v in calibration.data.seen_by(camera)])
    i = np.clip((px[:, 0] * GRID / width).astype(int), 0, GRID - 1)
    j = np.clip((px[:, 1] * GRID / height).astype(int), 0, GRID - 1)
    counts = np.bincount(j * GRID + i, minlength=GRID * GRID).reshape(GRID, GRID)
    poses = calibration.single[camera].poses()
    T = np.stack(list(poses.values()))
    n = T[:, :3, 2]
    tilts = np.degrees(np.stack([np.arctan2(-n[:, 0], n[:, 2]), np.arctan2(n[:, 1], n[:, 2])], axis=1))
    middle = calibration.data.board.points_m.mean(0)
    return Coverage(camera, counts, tilts, np.linalg.norm(T[:, :3, :3] @ middle + T[:, :3, 3], axis=1))


def advice(c: Coverage) -> list[str]:
    """Sentences on what is missing, most useful first; empty if nothing is."""
    out = []
    low = 0.2 * c.counts.mean()
    names = {(1, 1): "centre"} | {
        (j, i): f"{ROWS[j]} {COLUMNS[i]}" for j in range(GRID) for i in range(GRID) if (j, i) != (1, 1)
    }
    for (j, i), name in names.items():
        if c.counts[j, i] == 0:
            out.append(f"no board in the {name} ninth of the {c.camera} picture: hold it there")
    thin = [n for (j, i), n in names.items() if 0 < c.counts[j, i] < low]
    if thin:
        out.append(f"few points in the {', '.join(thin)} of the {c.camera} picture")
    for axis, words in enumerate((("left", "right"), ("down", "up"))):
        for sign, word in zip((-1, 1), words, strict=True):
            if (sign * c.tilts_deg[:, axis]).max() < MIN_TILT_DEG:
                out.append(
                    f"no board whose face looks {word} by more than {MIN_TILT_DEG:.0f} deg before the {c.camera} camera"
                )
    if c.distances_m.max() < MIN_DISTANCE_RATIO * c.distances_m.min():
        out.append(
            f"all boards stand {c.distances_m.min():.2f} to {c.distances_m.max():.2f} m from the {c.camera} camera: "
            "record some nearer and farther, over the distances you will scan at"
        )
    if len(c.tilts_deg) < ENOUGH_VIEWS:
        seen = counted(len(c.tilts_deg), "view")
        out.append(f"{seen} by the {c.camera} camera: {ENOUGH_VIEWS} to 30 make the numbers sure")
    return out
