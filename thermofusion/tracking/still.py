"""A camera that is said to have stood still, held against pictures that changed.

Things on a turntable that fill little of the picture leave a large even rest (the disc, a floor, a wall) that fits
itself in place: the estimated poses then barely move, and views from all sides would be fused on top of each other.
"""

from __future__ import annotations

import cv2
import numpy as np

from ..errors import QualityError
from ..geometry.rigid import invert, rotation_angle_deg, transform_points
from ..robust import evenly, mad_sigma
from ..scans.pairing import nearest_in_time
from ..types import Bool, Float, ThermalStream
from .frames import TrackingFrames
from .maps import DepthMap
from .registration import pixels_of

STILL_DEG, STILL_M = 4.0, 0.05  # a path that stays within these, at 1 m, barely moves: nobody walks round a thing so
FRAMES = 12  # of the path, evenly spread, that are held against the first
CHANGED_M = 0.02  # at 1 m, grows with range²: several times noise, and what a centimetre of pose leaves on a slope
CHANGED = 0.02  # share of what both see: up to 0.014 of what stands still, 0.03-0.06 of three real turntables
CHANGED_ALONE = 0.25  # likewise where the subject alone is tracked: arms move, and a body's motion is solved later
THERMAL_CHANGED = 0.05  # share of the thermal picture likewise: the same turntables show 0.10-0.28
CONTRAST = 0.1  # of a thermal picture's own range: a pixel that differs by more has changed,
NOISES = 3.0  # and by more than so many sigmas of its noise
BLUR_PX = 5  # over which thermal pictures are averaged before
FEW = 200  # points that two frames must both see


def held_against_pictures(frames: TrackingFrames, T: Float, tracked: Bool, *, alone: bool) -> None:
    """Raises QualityError where estimated poses barely move, though depth and thermal pictures change.

    T : (K, 4, 4) T_world_depth of the K depth frames that are tracked (N,), m. alone : nothing but the subject was
    tracked. Of a scan without thermal frames the depth alone speaks.
    """
    known, scan = np.flatnonzero(tracked), frames.scan
    if len(known) < 2:
        return
    moved = invert(T[0]) @ T
    moved[:, :3, 3] *= frames.zoom
    shift_m = float(np.linalg.norm(moved[:, :3, 3], axis=1).max())
    if rotation_angle_deg(moved).max() > STILL_DEG or shift_m > STILL_M:
        return
    picked = evenly(len(known), FRAMES)
    first = frames.load(int(known[0])).map
    depth = [changed_share(first, frames.load(int(known[k])).map, invert(moved[k])) for k in picked[1:]]
    if np.median(depth) < (CHANGED_ALONE if alone else CHANGED):
        return
    t = scan.depth.times_s[known[picked]]
    if scan.thermal is not None and len(scan.thermal):
        thermal = [changed_picture_share(scan.thermal, float(t[0]), float(later)) for later in t[1:]]
        if np.median(thermal) < THERMAL_CHANGED:
            return
    raise QualityError(
        f"the depth camera is estimated to have stood still, but {np.median(depth):.0%} of what it sees has changed: "
        "a turned or moved subject was fitted by what stands around it",
        place=scan.root,
        hint="record the poses (trajectory.txt), or let only the turned subject be seen (subject.motion = subject, "
        "background and floor removed)",
    )


def changed_share(seen: DepthMap, now: DepthMap, T_now_seen: Float) -> float:
    """Share of one view's points that lie off the other's surface, of those that both see; 0 where these are few.

    T_now_seen : (4, 4).
    """
    p = transform_points(T_now_seen, seen.sample)
    pixel, inside, _ = pixels_of(now, p)
    p, there = p[inside], now.surface[pixel].astype(np.float64)
    off_m = np.abs(np.einsum("ij,ij->i", p - there[:, :3], there[:, 3:]))
    both = np.isfinite(off_m)
    if both.sum() < FEW:
        return 0.0
    return float((off_m[both] > CHANGED_M * np.maximum(p[both, 2], 1) ** 2).mean())


def changed_picture_share(stream: ThermalStream, before_s: float, after_s: float) -> float:
    """Share of the thermal picture that differs between the frames nearest to two times, their offset removed."""
    nearest, _ = nearest_in_time(np.array([before_s, after_s]), stream.times_s)
    a, b = (stream.load(int(frame)).astype(np.float32) for frame in nearest)
    window = (BLUR_PX, BLUR_PX)
    smooth, later = cv2.blur(a, window), cv2.blur(b, window)
    low, high = np.nanpercentile(smooth, (2, 98))
    noise = float(mad_sigma((a - smooth)[np.isfinite(a - smooth)]))
    d = later - smooth
    return float((np.abs(d - np.nanmedian(d)) > max(CONTRAST * float(high - low), NOISES * noise)).mean())
