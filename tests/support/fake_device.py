"""A device that is simple enough to be sure of: frame k of a stream has the number k in every pixel's value."""

from __future__ import annotations

import time

import numpy as np

from thermofusion.recording.device import EndOfStreamError, Frame, StreamInfo, UnpluggedError

K = [[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]


def pixels(k, shape=(48, 64)):
    """Frame k."""
    return ((np.arange(shape[0] * shape[1]) + 37 * k) % 4000 + 500).astype("<u2").reshape(shape)


class Steady:
    """`frames` frames at rate_hz; from start on at fixed host times. lose : numbers that never arrive. ticks from
    first_ticks on, at 1 MHz times 1 + drift, modulo 2^32. unplug_at : the frame before which it goes."""

    def __init__(self, name="steady", kind="depth", rate_hz=200.0, frames=60, **faults):
        self.name, self._faults = name, faults
        about = {"K": K, "depth_unit_m": 0.001} if kind == "depth" else {"signal": faults.get("signal")}
        encoding = "16UC1" if kind == "depth" else "mono16"
        self.streams = (StreamInfo(f"{name}/{kind}", kind, 64, 48, encoding, rate_hz, about, 1e6),)
        self._period, self._frames, self._next = 1 / rate_hz, frames, 0
        self.corrections, self.stopped = 0, False

    def start(self):
        self._begin = time.monotonic()

    def read(self):
        k = self._next
        if k >= self._frames:
            raise EndOfStreamError("done")
        due = self._begin + k * self._period
        if (wait := due - time.monotonic()) > 0:
            time.sleep(min(wait, 0.05))
            if wait > 0.05:
                return []
        self._next += 1
        if k == self._faults.get("unplug_at"):
            raise UnpluggedError("the device has gone from the bus", place=self.name)
        if k == self._faults.get("break_at"):
            raise ZeroDivisionError("a fault of a driver")
        if k in self._faults.get("lose", ()):
            return []
        lost = 0
        while k - lost - 1 in self._faults.get("lose", ()):
            lost += 1
        passed = int(k * self._period * 1e6 * (1 + self._faults.get("drift", 0)))
        ticks = (self._faults.get("first_ticks", 5) + passed) % 2**32
        return [Frame(0, pixels(k).tobytes(), time.monotonic_ns(), ticks, lost, self.corrections > 0)]

    def shutter(self):
        self.corrections += 1
        return True

    def stop(self):
        self.stopped = True
