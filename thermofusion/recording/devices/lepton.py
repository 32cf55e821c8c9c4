"""FLIR Lepton on a PureThermal board: 16-bit UVC, telemetry below the picture, radiometry. Never tried on hardware.

Words of telemetry row A (Lepton's data sheet): 1-2 uptime in ms, 3-4 status (bits 4-5 the flat-field correction), 20-21
frame counter, 24 sensor temperature in K/100. Sources disagree on which word of a pair is high: the clock tells.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...errors import ResourceError
from ..device import Frame, StreamInfo, UnpluggedError
from ..usb import RefusedWriteError
from .marks import ShutterMarks
from .v4l2 import Capture, VideoNode, node_of

IDS = (0x1E4E, 0x0100)  # vendor, product
WIDTH_PX, HEIGHT_PX, TELEMETRY_ROWS = 160, 120, 2
RATE_HZ = 8.7  # of new pictures: export rules
SIGNAL = {"kind": "counts", "curve": {"type": "linear_kelvin", "gain_K": 0.01, "offset_K": 0.0}}
OEM, RAD, SYS = 4, 5, 6  # extension units; a command's control is its number's low byte / 4 + 1
RUN_FFC = (SYS, (0x42 >> 2) + 1, b"\x00")
TLINEAR_ON = (RAD, (0xC0 >> 2) + 1, b"\x01\x00\x00\x00")
SAFE = (RUN_FFC, TLINEAR_ON)
MAX_STEP_MS = 60_000  # between two frames: more is no clock
ABSURD_K100 = (20_000, 40_000)  # of the sensor's own temperature
MIN_KELVIN_SHARE = 0.9  # of pixels that must be temperatures of a room if they are kelvin


@dataclass(frozen=True)
class Telemetry:
    """Row A: uptime ms, whether a flat-field correction is wanted, imminent or running, frame count, sensor's °C."""

    uptime_ms: int
    correcting: bool
    frame: int
    fpa_degC: float


class TelemetryReader:
    """Reads row A, frame after frame; finds out which word of a pair is the high one."""

    def __init__(self) -> None:
        self._high: Literal[0, 1] | None = None
        self._before: tuple[int, int] | None = None

    def read(self, row: NDArray[np.uint16]) -> Telemetry | None:
        """row : (N,) 16-bit numbers. None where it is too short, or no telemetry (its sensor temperature is absurd)."""
        if len(row) < 25 or not ABSURD_K100[0] <= int(row[24]) <= ABSURD_K100[1]:
            return None
        both = _pair(row, 1, 0), _pair(row, 1, 1)
        if self._high is None and self._before is not None:
            moves = [0 < now - then < MAX_STEP_MS for now, then in zip(both, self._before, strict=True)]
            if moves[0] != moves[1]:
                self._high = 0 if moves[0] else 1
        self._before = both
        high = self._high if self._high is not None else (0 if both[0] <= both[1] else 1)
        correcting = (_pair(row, 3, high) >> 4 & 3) in (1, 2)
        return Telemetry(both[high], correcting, _pair(row, 20, high), int(row[24]) / 100 - 273.15)


def _pair(row: NDArray[np.uint16], at: int, high: int) -> int:
    return int(row[at + high]) << 16 | int(row[at + 1 - high])


def is_kelvin(image: NDArray[np.uint16]) -> bool:
    """Whether pixels (H, W) are K/100 of a room and a body, not plain counts."""
    return float(np.mean((image > 22_000) & (image < 45_000))) >= MIN_KELVIN_SHARE


class Lepton:
    """A PureThermal board. capture : a source of frames, for tests."""

    name = "PureThermal (FLIR Lepton)"

    def __init__(self, capture: Capture | None = None) -> None:
        about: dict[str, object] = {"model": self.name, "signal": SIGNAL, "band_um": [8.0, 14.0]}
        thermal = StreamInfo("lepton/thermal", "thermal", WIDTH_PX, HEIGHT_PX, "mono16", RATE_HZ, about, 1000.0)
        self.streams: tuple[StreamInfo, ...] = (thermal,)
        self._capture, self._marks, self._telemetry = capture, ShutterMarks(RATE_HZ), TelemetryReader()
        self._frame, self._torn = -1, 0

    def start(self) -> None:
        """Open the video node, ask for kelvin. Raises ResourceError."""
        size = (WIDTH_PX, HEIGHT_PX + TELEMETRY_ROWS, "Y16 ")
        self._capture = self._capture or VideoNode(node_of(*IDS), *size)
        try:
            self._set(TLINEAR_ON)
        except UnpluggedError:
            raise
        except ResourceError:  # boards without radiometry: what comes is judged below, frame by frame
            pass

    def read(self) -> Sequence[Frame]:
        """The frame that arrived. Raises UnpluggedError, and ResourceError for a camera without radiometry."""
        assert self._capture is not None
        raw = self._capture.read()
        if raw is None:
            return []
        now, pixels = time.monotonic_ns(), WIDTH_PX * HEIGHT_PX
        if raw.size not in (2 * pixels, 2 * (pixels + TELEMETRY_ROWS * WIDTH_PX)):
            self._torn += 1
            return []
        words = raw.view("<u2")
        image = words[:pixels]
        row = self._telemetry.read(words[pixels : pixels + WIDTH_PX]) if len(words) > pixels else None
        lost, self._torn = self._torn, 0
        spoiled = self._marks.spoiled(now, image.data) or not is_kelvin(image)
        if row is None:
            return [Frame(0, image.tobytes(), now, 0, lost, spoiled)]
        repeated = row.frame == self._frame  # 27 Hz of transfers, every third a new frame
        self._frame = row.frame
        if repeated:
            return []
        return [Frame(0, image.tobytes(), now, row.uptime_ms, lost, spoiled or row.correcting, row.fpa_degC)]

    def shutter(self) -> bool:
        """Begin a flat-field correction. Raises ResourceError."""
        self._marks.asked(time.monotonic_ns())
        self._set(RUN_FFC)
        return True

    def stop(self) -> None:
        """Give the node back. Never raises."""
        with suppress(Exception):
            if self._capture is not None:
                self._capture.close()
        self._capture = None

    def _set(self, control: tuple[int, int, bytes]) -> None:
        if control not in SAFE:
            raise RefusedWriteError(f"control {control[1]} of unit {control[0]} is not known to be safe")
        if self._capture is not None:
            self._capture.unit(*control)
