"""A device's clock against the host's: counters that wrap, and the straight line below which no frame ever arrives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Float

MAX_DRIFT = 1e-3  # of a device's clock against its nominal rate: crystals are within 1e-4, firmware rounds
FEWEST, SHORTEST_S = 30, 2.0  # frames, and span, from which a drift can be told
PROMPT_S, PROMPT_SHARE = 0.02, 0.2  # without a drift, so many frames must lie so near above the line
JUMP_S = 0.5  # device and host part by so much between two frames: the counter began anew


def unwrapped_s(host_s: NDArray, ticks: NDArray, tick_hz: float, wrap: int) -> Float:
    """Seconds since the first entry by a device's counter, unwrapped with the host's time as the coarse hand.

    host_s, ticks : (N,). tick_hz : counts a second. wrap : where the counter begins anew. Right as long as the host's
    time is good to half a wrap, over gaps of any length.
    """
    ticks = np.asarray(ticks).astype(np.float64)
    expected = ticks[0] + (host_s - host_s[0]) * tick_hz
    turns = np.rint((expected - ticks) / wrap)
    return (ticks + turns * wrap - ticks[0]) / tick_hz


@dataclass(frozen=True, eq=False)
class ClockFit:
    """A device's clock on the host's. times_s : (N,) host time of each frame by the device's clock. drift : of the
    device's clock, 1. delay_s : median time by which frames arrived later than the quickest. jumps : how often the
    counter began anew. used : False where the device's clock could not be believed and times_s are the arrivals."""

    times_s: Float
    drift: float
    delay_s: float
    jumps: int
    used: bool = True


def fit_clock(host_s: NDArray, ticks: NDArray, tick_hz: float, wrap: int) -> ClockFit:
    """host_s : (N,) arrivals, rising, s. ticks : (N,) of the device, at tick_hz, modulo wrap.

    A frame arrives after it was taken, by a delay that is never negative and mostly small: the line host = a + b device
    that lies below all arrivals, and nearest to them in the mean, is an edge of their lower convex hull (the one above
    the mean device time; Moon, Skelly, Towsley 1999 solve the same linear programme). A counter that begins anew
    splits the recording; each part has its own line.
    """
    host = np.asarray(host_s, np.float64)
    if len(host) == 0:
        return ClockFit(host, 0.0, 0.0, 0, False)
    device = unwrapped_s(host, ticks, tick_hz, wrap)
    late = np.diff(host) - np.diff(device)
    cuts = np.flatnonzero(np.abs(late - np.median(late) if len(late) else late) > JUMP_S) + 1
    times, lines, parts = np.empty_like(host), [], np.split(np.arange(len(host)), cuts)
    for part in parts:
        slope, offset = _below(device[part], host[part])
        if abs(slope - 1) > MAX_DRIFT:  # much came late, or it is no clock of that rate
            slope, offset = 1.0, float(np.min(host[part] - device[part]))
            prompt = np.mean(host[part] - device[part] - offset < PROMPT_S)
            if prompt < PROMPT_SHARE:
                return ClockFit(host, 0.0, 0.0, len(cuts), False)
        times[part] = offset + slope * device[part]
        lines.append((slope, offset))
    longest = int(np.argmax([len(p) for p in parts]))
    if len(cuts) * FEWEST > len(host):
        return ClockFit(host, 0.0, 0.0, len(cuts), False)
    # a host that stood still cuts too, but the lines before and after are one
    apart = [abs((b[0] - a[0]) * device[k] + b[1] - a[1]) for a, b, k in zip(lines, lines[1:], cuts, strict=False)]
    jumps = sum(d > JUMP_S / 10 for d in apart)
    return ClockFit(times, lines[longest][0] - 1, float(np.median(host - times)), jumps)


def _below(device: Float, host: Float) -> tuple[float, float]:
    """(slope, offset) of the line below all points, nearest to them in the mean; slope 1 where too few tell it."""
    if len(device) < FEWEST or device[-1] - device[0] < SHORTEST_S:
        return 1.0, float(np.min(host - device))
    hull: list[int] = []
    for i in np.argsort(device, kind="stable").tolist():
        while len(hull) > 1 and _turns_up(device, host, hull[-2], hull[-1], i) <= 0:
            hull.pop()
        if hull and device[hull[-1]] == device[i]:
            continue
        hull.append(i)
    x = device[hull]
    k = int(np.clip(np.searchsorted(x, device.mean()) - 1, 0, len(hull) - 2))
    slope = float((host[hull[k + 1]] - host[hull[k]]) / (x[k + 1] - x[k]))
    return slope, float(host[hull[k]] - slope * x[k])


def _turns_up(x: Float, y: Float, a: int, b: int, c: int) -> float:
    return float((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))
