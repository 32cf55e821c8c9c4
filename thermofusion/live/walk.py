"""Tracking while the recording grows: `tracking`'s steps, frame by frame; lost at once, found again where one was.

The frames go in order through the odometry that the final result begins with: it goes on from there (`ahead`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..depth.filter import KEPT_BYTES, DepthFrames
from ..geometry.rigid import invert, rotation_angle_deg
from ..recipe import InputSection, SubjectSection, TrackingSection
from ..tracking.ahead import Ahead
from ..tracking.frames import TrackingFrame, TrackingFrames
from ..tracking.maps import DepthMap
from ..tracking.odometry import RESCUE_REACHES_M, STEP_TOLERANCE, Odometry
from ..tracking.registration import REACH_M, agreement, find_partners, register_view
from ..types import Float, Scan

KEY_DEG, KEY_M = 10.0, 0.15  # a view that differs so much from the last kept one is kept, to be found again at
MOST_KEYS = 60  # kept views: two megabytes each
FOUND_AGREEMENT = 0.9  # of what a found view and the kept one both see: other sides of a body reach 0.78
FOUND_RESIDUAL = 2.0  # of a found view, in residuals of ordinary steps: other sides of a body have four to seven
TRIED_KEYS = 4  # a lost frame is tried at so many of the latest, and at as many others in turn
FASTEST_DEG_S = 45.0  # a walk round a person in 8 s: faster blurs, and leaves few thermal views


@dataclass(frozen=True, eq=False)
class Placed:
    """A frame with its pose T_world_depth (4, 4); None = tracking is lost. turn_deg_s : how fast the camera turns."""

    frame: TrackingFrame
    T_world_depth: Float | None
    turn_deg_s: float


class Walk:
    """Tracks the frames of a growing scan. The world is the first frame's camera."""

    def __init__(self, input: InputSection, subject: SubjectSection, tracking: TrackingSection) -> None:
        self._input, self._tracking = input, tracking
        # what stands still is told from the whole recording: a turning subject is followed without that
        self._subject = subject.model_copy(update={"motion": "camera"}) if subject.motion == "subject" else subject
        self._frames: TrackingFrames | None = None
        self._odometry: Odometry | None = None
        self._apart: Ahead | None = None  # what was tracked before the first frame that was left out
        self._T_world_segment: Float | None = np.eye(4)  # of the odometry's last segment; None = it is lost
        self._keys: list[tuple[DepthMap, Float]] = []
        self._last: tuple[TrackingFrame, Float] | None = None
        self._residual_mm, self._turn = float("nan"), 0

    @property
    def lost(self) -> bool:
        """Whether it is not known where the last frame is."""
        return self._T_world_segment is None

    def grown(self, scan: Scan) -> None:
        """The scan has more frames now. Raises ScanError."""
        if self._frames is None or not self._frames.subject.depth.continued_by(scan, self._input):
            self._leave()  # what came before was seen by another camera, if there was something
            depth = DepthFrames(scan, self._input, keep_bytes=KEPT_BYTES)
            frames = TrackingFrames.of(
                scan, input=self._input, subject=self._subject, tracking=self._tracking, depth=depth
            )
            self._frames = replace(frames, color_of=None)
        self._frames = replace(self._frames, scan=scan, subject=self._frames.subject.grown(scan))

    def take(self, i: int) -> Placed | None:
        """Frame i of the depth stream; None for one that shows nothing. Raises ScanError.

        Frames that are taken in order, none left out, need not be tracked again for the final result.
        """
        assert self._frames is not None
        if self._apart is None and self._odometry is not None and i != self._next():
            self._leave()
        frame = self._frames.load(i)
        if self._odometry is None:
            self._odometry = Odometry(
                self._frames.intrinsics, self._tracking, timed=not self._frames.scan.times_assumed
            )
            if self._last is not None:  # frames were left out: on from the last one
                self._odometry.take(self._last[0])
                self._T_world_segment = self._last[1]
        continued = self._odometry.take(frame)
        if frame.empty:
            return None
        T = self._located(frame, continued or self._last is None)
        turn = 0.0
        if T is not None:
            if self._last is not None and frame.time_s > self._last[0].time_s:
                dt_s = frame.time_s - self._last[0].time_s
                turn = float(rotation_angle_deg(invert(self._last[1]) @ T)) / dt_s
            self._last = frame, T
            self._keep(frame, T)
        return Placed(frame, None if T is None else self._metric(T), turn)

    @property
    def ahead(self) -> Ahead | None:
        """What need not be done again for the final result; None where nothing was tracked."""
        if self._apart is not None or self._frames is None or self._odometry is None:
            return self._apart
        return Ahead(self._frames, self._odometry, self._subject, self._tracking)

    def _next(self) -> int:
        """The frame that is next in order."""
        assert self._frames is not None
        assert self._odometry is not None
        after = self._odometry.taken[-1] + 1
        usable = self._frames.scan.depth.usable[after:]
        return after + int(np.argmax(usable)) if usable.any() else after

    def _leave(self) -> None:
        """Frames are left out from here on: the order ends."""
        self._apart, self._odometry = self.ahead, None

    def _located(self, frame: TrackingFrame, continued: bool) -> Float | None:
        """Pose of the odometry's last frame in the world, its zoom included. continued : its step was believed."""
        assert self._odometry is not None
        if continued and self._T_world_segment is not None:
            self._residual_mm = self._odometry.residual_mm
            return self._T_world_segment @ self._odometry.pose
        self._T_world_segment = None
        for key, T_world_key in self._tried():
            T, partners = register_view(
                frame.map, [(key, np.eye(4))], np.eye(4), RESCUE_REACHES_M, tolerance=STEP_TOLERANCE
            )
            if partners is not None and self._same_place(frame, key, T):
                self._T_world_segment = T_world_key @ T @ invert(self._odometry.pose)
                return T_world_key @ T
        return None

    def _tried(self) -> list[tuple[DepthMap, Float]]:
        """Kept views that a lost frame is tried at: the latest, and others in turn."""
        latest, others = self._keys[-TRIED_KEYS:], self._keys[:-TRIED_KEYS]
        self._turn += 1
        start = self._turn * TRIED_KEYS % max(len(others), 1)
        return [*latest[::-1], *others[start : start + TRIED_KEYS]]

    def _same_place(self, frame: TrackingFrame, key: DepthMap, T: Float) -> bool:
        """Whether a lost frame is where it fits best: a back fits a chest, but not to the noise (4 mm for 1 mm)."""
        partners = find_partners(frame.map, key, T, REACH_M)
        fits = len(partners) > 0 and partners.residual_mm_at_1m <= FOUND_RESIDUAL * self._residual_mm
        return fits and agreement(frame.map, key, T, stride=2) >= FOUND_AGREEMENT

    def _keep(self, frame: TrackingFrame, T: Float) -> None:
        if self._keys:
            step = invert(self._keys[-1][1]) @ T
            if rotation_angle_deg(step) < KEY_DEG and np.linalg.norm(step[:3, 3]) < KEY_M:
                return
        self._keys = [*self._keys[-MOST_KEYS + 1 :], (frame.map, T)]

    @property
    def zoom(self) -> float:
        """What the frames' depth is multiplied by."""
        return 1.0 if self._frames is None else self._frames.zoom

    def _metric(self, T: Float) -> Float:
        out = T.copy()
        out[:3, 3] /= self.zoom
        return out
