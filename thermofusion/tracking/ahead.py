"""What was tracked while a recording was still growing: `track` goes on from there instead of starting again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..depth.filter import DepthFrames
from ..recipe import InputSection, SubjectSection, TrackingSection
from ..types import Scan
from .frames import TrackingFrames
from .odometry import Odometry

SAME_TIME_S = 1e-3  # a device's clock is known a little better with every frame: no speed hangs on so little


@dataclass(frozen=True, eq=False)
class Ahead:
    """Frames of a recording that were tracked in order, none left out, by the steps that `track` takes.

    frames : as they were loaded. odometry : of them. subject, tracking : the sections that they were tracked by.
    """

    frames: TrackingFrames
    odometry: Odometry
    subject: SubjectSection
    tracking: TrackingSection

    def depth_frames(self, scan: Scan, input: InputSection) -> DepthFrames | None:
        """All frames of the finished recording, those decoded that were looked at; None where it is another one."""
        depth = self.frames.subject.depth
        return depth.grown(scan) if depth.continued_by(scan, input) else None

    def begun(
        self, frames: TrackingFrames, indices: NDArray[np.intp], subject: SubjectSection, tracking: TrackingSection
    ) -> Odometry | None:
        """What is done of these frames at positions (N,) of the stream; None where the whole recording tells to look
        at them otherwise than its beginning did: nearer, or with colour. It is used up.
        """
        before, n = self.frames, len(self.odometry.taken)
        same = (subject, tracking) == (self.subject, self.tracking)
        same = same and (before.step, before.intrinsics, before.zoom) == (frames.step, frames.intrinsics, frames.zoom)
        same = same and frames.color_of is None and frames.scan.times_assumed == before.scan.times_assumed
        if not same or indices[:n].tolist() != self.odometry.taken:
            return None
        off_s = frames.scan.depth.times_s[indices[:n]] - before.scan.depth.times_s[indices[:n]]
        return self.odometry if np.ptp(off_s) < SAME_TIME_S else None
