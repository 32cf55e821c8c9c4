"""Follows a recording while it is written: tracks, paints, says what is missing; as many frames as the machine can."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..recipe import InputSection, SubjectSection, TrackingSection
from ..scans.formats.recorded import Growing
from ..tracking.ahead import Ahead
from ..tracking.frames import TrackingFrame
from ..tracking.odometry import MAX_GAP_FRAMES
from ..types import Float32, Scan
from .model import Model, apparent_degC, seen_by_thermal
from .walk import FASTEST_DEG_S, Placed, Walk

LOOK_S = 0.1  # the file is looked at so often
BURST_S = 0.4  # frames come in bursts: a recording is written to the disk so often
FIRST_FRAMES = 5  # depth frames that must be there to begin
LATE = 0.7  # of the last update's time, which the next one's guess does not fall below
LATE_S = 3.0  # behind the walk frames are left out: the final result tracks again from there
PAIR_S = 0.04  # a thermal frame and a depth frame this far apart show the same
SILENT_S = 10.0  # without a new frame for so long, whoever records has died
MISSING_S = 1.0  # what is missing is worked out so often
DRIFT_K = 0.5  # of the thermal camera's level between views, from which it is said
SHOWN_POINTS = 30_000  # of the model


@dataclass(eq=False)
class Live:
    """How it stands. frames : depth frames that were tracked and painted. waiting : in the file, not yet looked at.
    skipped : not painted. intervals_s : between one update of the model and the next. points : (N, 4) float32, place m
    and apparent °C. ahead : in the end, what the final result goes on from."""

    frames: int = 0
    waiting: int = 0
    skipped: int = 0
    lost_frames: int = 0
    lost: bool = False
    turn_deg_s: float = 0.0
    missing: tuple[str, ...] = ()
    drift_K: float = float("nan")
    shutter: bool = False
    ended: bool = False
    intervals_s: list[float] = field(default_factory=list)
    points: Float32 = field(default_factory=lambda: np.empty((0, 4), np.float32))
    ahead: Ahead | None = None

    @property
    def rate_hz(self) -> float:
        """Updates of the model a second, of late."""
        late = self.intervals_s[-10:]
        return len(late) / sum(late) if late else 0.0

    def advice(self) -> list[str]:
        """What a person who walks must hear now, the most urgent first."""
        said = ["TRACKING LOST: go back to where it was last seen"] if self.lost else []
        said += [f"slower: {self.turn_deg_s:.0f} deg/s"] if self.turn_deg_s > FASTEST_DEG_S else []
        said += ["the thermal camera corrects its shutter: wait"] if self.shutter else []
        said += [f"the thermal level drifts by {self.drift_K:+.1f} K"] if abs(self.drift_K) > DRIFT_K else []
        said += [f"missing: {', '.join(self.missing)}"] if self.missing else []
        return said


@dataclass(frozen=True)
class Sections:
    """The recipe's sections that following needs."""

    input: InputSection
    subject: SubjectSection
    tracking: TrackingSection


def follow(
    path: Path, recipe: Sections, show: Callable[[Live], None], stop: Callable[[], bool] = lambda: False
) -> Live:
    """Follow the recording at `path` until it ends, nobody writes any more, or `stop`. show : called at every update.

    Raises ScanError where the file is no recording, RecipeError.
    """
    growing, live = Growing(path), Live()
    painter = _Painter(recipe)
    next_frame, painted, updated_at, new_at = 0, -1, 0.0, time.monotonic()
    looked_at, took_s = 0.0, 0.0
    while not stop():
        now = time.monotonic()
        if now - looked_at >= LOOK_S:
            looked_at = now
            if growing.look() and growing.scan is not None:
                new_at = now
                painter.grown(growing.scan)
        count = 0 if growing.scan is None else len(growing.scan.depth)
        live.waiting = max(count - next_frame, 0)
        if count < FIRST_FRAMES or next_frame >= count:
            if growing.complete or now - new_at > SILENT_S:
                break
            time.sleep(0.02)
            continue
        i, step = next_frame, 1
        if not growing.complete:  # as many frames of a burst as can be painted before the next one
            step = _step(count - painted - 1, took_s)
            i += step - 1 if _late(growing.scan, i) else 0
        next_frame = i + 1
        if i - painted < step:
            painter.track(i, live)
            continue
        live.skipped += i - painted - 1
        painted = i
        begun = time.monotonic()
        painter.paint(i, live)
        done = time.monotonic()
        took_s = max(done - begun, LATE * took_s)
        if updated_at:
            live.intervals_s.append(done - updated_at)
        updated_at = done
        show(live)
    live.ended, live.ahead = True, painter.ahead
    show(live)
    return live


def _late(scan: Scan | None, i: int) -> bool:
    """Whether frame i is so old that what is shown lags behind the walk."""
    return scan is not None and bool(scan.depth.times_s[-1] - scan.depth.times_s[i] > LATE_S)


def _step(waiting: int, took_s: float) -> int:
    """How many frames on the next one to paint is, of `waiting`: no farther than tracking can jump."""
    affordable = max(1, int(BURST_S / max(took_s, 1e-3)))
    return min(-(-waiting // affordable), MAX_GAP_FRAMES)


class _Painter:
    """From one depth frame to a larger model."""

    def __init__(self, recipe: Sections) -> None:
        self._walk = Walk(recipe.input, recipe.subject, recipe.tracking)
        self._model: Model | None = None
        self._scan: Scan | None = None
        self._degC: Float32 | None = None
        self._missing_at = 0.0
        self._thermal = -1

    def grown(self, scan: Scan) -> None:
        """The scan has more frames now."""
        if len(scan.depth) < FIRST_FRAMES:
            return
        self._scan = scan
        self._walk.grown(scan)
        if self._model is None:
            self._model = Model(scan.depth_up)
            self._degC = None if scan.thermal is None else apparent_degC(scan.thermal.camera.signal)

    def track(self, i: int, live: Live) -> Placed | None:
        """Frame i of the depth stream, where it can be placed."""
        placed = self._walk.take(i)
        live.lost = self._walk.lost
        if placed is None or placed.T_world_depth is not None:
            return placed
        live.lost_frames += 1
        return None

    @property
    def ahead(self) -> Ahead | None:
        """What need not be done again for the final result."""
        return self._walk.ahead

    def paint(self, i: int, live: Live) -> None:
        """Frame i of the depth stream, into the model."""
        placed = self.track(i, live)
        if placed is None or placed.T_world_depth is None or self._model is None:
            return
        live.frames += 1
        live.turn_deg_s = placed.turn_deg_s
        degC = self._temperatures(placed.frame, live)
        drift = self._model.add(placed.frame, self._walk.zoom, placed.T_world_depth, degC)
        live.drift_K = drift if np.isfinite(drift) else live.drift_K
        if time.monotonic() - self._missing_at > MISSING_S:
            self._missing_at = time.monotonic()
            live.missing = self._model.missing() if self._degC is not None else ()
            live.points = self._model.points(SHOWN_POINTS)

    def _temperatures(self, frame: TrackingFrame, live: Live) -> Float32 | None:
        """(H*W,) °C of a depth frame's pixels by the thermal frame of its time; None where there is none."""
        thermal = None if self._scan is None else self._scan.thermal
        if thermal is None or self._degC is None:
            return None
        t = thermal.depth_times_s
        k = int(np.argmin(np.abs(t - frame.time_s)))
        live.shutter = not bool(thermal.usable[k])
        if abs(t[k] - frame.time_s) > PAIR_S or live.shutter or k == self._thermal:
            return None
        self._thermal = k
        image = self._degC[thermal.load(k)]
        return seen_by_thermal(frame, self._walk.zoom, thermal.camera, image)
