"""Is a thermal camera fit for skin: figures of one or two blackbodies, in the terms of screening thermographs.

Terms after IEC 80601-2-59 and ISO/TR 13154: laboratory accuracy, stability and drift, uniformity, repeatability,
minimum resolvable temperature difference; beside them the response to the shutter. The methods are ours, written below;
no limit of a standard is applied and no conformity is claimed. In particular the resolvable difference is the one that
the numbers resolve in one frame, not the one that observers see of a bar target.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...robust import mad_sigma
from ...types import Bool, Float
from .noise import still_noise

RESOLVED = 1.96 * np.sqrt(2)  # sigmas of one area that two must differ by, at 95 %
AREAS_PX = (1, 3, 5, 11)  # sides of the areas that are told apart
ALIKE_K = 0.1  # temperatures of the source that count as the same
JUMP_SIGMAS = 6.0  # of the image mean from frame to frame, beyond which the shutter has closed between
GAP_STEPS = 1.5  # usual steps of time, likewise
FIRST_S = 1.0  # after the shutter, set against the rest of its stretch
LEAST_STRETCH = 4  # frames between two shutters, below which they tell nothing


@dataclass(frozen=True, eq=False)
class ShutterResponse:
    """events : how often it closed. jump_K : rms of the step of the mean across it; largest_K : the largest; first_K :
    mean of the first second after it, less the rest of its stretch; between_K_per_min : rms slope of the mean between
    two. NaN = it never closed."""

    events: int
    jump_K: float
    largest_K: float
    first_K: float
    between_K_per_min: float


@dataclass(frozen=True, eq=False)
class SourceFigures:
    """What one recording of a source at degC says; all K, one sigma unless told.

    error_K : mean reading less the source. drift_K_per_min : slope of the mean over time, and its one sigma.
    stability_K : of the frames' means about that slope; span_K : highest less lowest. netd_K : noise of a pixel.
    uniformity_K : of the pixels' means over time, noise taken off; range_K : between their 0.5 and 99.5 percentiles.
    resolvable_K : smallest difference that two areas of so many pixels a side show in one frame, at 95 %.
    times_s, means_K, map_K : frames' means less degC (N,), pixels' means over time less their own mean (h, w).
    """

    name: str
    degC: float
    frames: int
    duration_s: float
    error_K: float
    drift_K_per_min: float
    drift_sigma_K_per_min: float
    stability_K: float
    span_K: float
    netd_K: float
    uniformity_K: float
    range_K: float
    resolvable_K: dict[str, float]
    shutter: ShutterResponse
    times_s: Float
    means_K: Float
    map_K: Float


@dataclass(frozen=True)
class PairFigures:
    """Two sources in one recording. true_K : second less first; error_K : shown less true; noise_K : of the means'
    difference from frame to frame; resolvable_K : what it must be to be told from none in one frame, at 95 %."""

    first: str
    second: str
    true_K: float
    error_K: float
    noise_K: float
    resolvable_K: float


@dataclass(frozen=True)
class Qualification:
    """accuracy_K : largest error of a source, and accuracy_sigma_K the sources' own uncertainty. repeatability_K : of
    recordings of the same temperature, pooled, with its degrees of freedom; NaN with none. The rest: the worst of all
    sources."""

    sources: tuple[SourceFigures, ...]
    pairs: tuple[PairFigures, ...]
    accuracy_K: float
    accuracy_sigma_K: float
    repeatability_K: float
    repeatability_freedom: int
    drift_K_per_min: float
    stability_K: float
    uniformity_K: float
    netd_K: float
    resolvable_K: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Shown:
    """A source as it is to be looked at: name, its temperature, frames (h, w) in °C of its part of the picture one
    after the other, their times (N,) s, and before which of them (N,) the recording itself marks the shutter."""

    name: str
    degC: float
    frames: Iterator[NDArray]
    times_s: Float
    shutter: Bool


class _Watched:
    """Frames that pass by, added up."""

    def __init__(self, frames: Iterator[NDArray]) -> None:
        self._frames = frames
        self.total: Float | float = 0.0
        self.means: list[float] = []
        self.squares = np.zeros(len(AREAS_PX))

    def __iter__(self) -> Iterator[NDArray]:
        for frame in self._frames:
            x = np.asarray(frame, np.float64)
            mean = float(np.nanmean(x))
            self.total = self.total + x
            self.means.append(mean)
            self.squares += [np.nanvar(_areas(x, side)) for side in AREAS_PX]
            yield x


def figures_of(shown: Shown) -> SourceFigures:
    """Raises ScanError: fewer than eight frames, times that do not rise, a part of fewer than 11 px a side."""
    watched, t = _Watched(shown.frames), np.asarray(shown.times_s, np.float64)
    noise = still_noise(watched, t)
    means, n = np.array(watched.means), len(watched.means)
    map_K = np.asarray(watched.total) / n
    if min(map_K.shape) < AREAS_PX[-1]:
        text = f"the source covers {map_K.shape[1]} x {map_K.shape[0]} px, {AREAS_PX[-1]} a side are needed"
        raise ScanError(text, place=shown.name)
    minutes = (t - t.mean()) / 60
    slope = float(minutes @ means / (minutes @ minutes))
    rest = means - means.mean() - slope * minutes
    stability = float(np.sqrt(rest @ rest / (n - 2)))
    variance = max(float(np.nanvar(map_K)) - noise.netd_K**2 / n, 0.0)
    low, high = np.nanpercentile(map_K, [0.5, 99.5])
    sides = np.sqrt(watched.squares / n)
    return SourceFigures(
        shown.name,
        shown.degC,
        n,
        float(t[-1] - t[0]),
        float(means.mean() - shown.degC),
        slope,
        stability / float(np.sqrt(minutes @ minutes)),
        stability,
        float(np.ptp(means)),
        noise.netd_K,
        float(np.sqrt(variance)),
        float(high - low),
        {str(side): float(RESOLVED * s) for side, s in zip(AREAS_PX, sides, strict=True)},
        _shutter(means, t, shown.shutter),
        t - t[0],
        means - shown.degC,
        map_K - np.nanmean(map_K),
    )


def _areas(x: Float, side: int) -> Float:
    """Means of areas of side x side px, (N,)."""
    h, w = (n // side for n in x.shape)
    return x[: h * side, : w * side].reshape(h, side, w, side).mean(axis=(1, 3)).ravel()


def _shutter(means: Float, t: Float, marked: Bool) -> ShutterResponse:
    """From the image means (N,) K at t (N,) s: marked, a gap in time, or a jump of the mean."""
    step, dt = np.diff(means), np.diff(t)
    jump = np.abs(step - np.median(step)) > JUMP_SIGMAS * max(mad_sigma(step), 1e-6)
    at = 1 + np.flatnonzero(jump | marked[1:] | (dt > GAP_STEPS * np.median(dt)))
    at = at[np.diff(t[at], prepend=-np.inf) > 2 * FIRST_S]  # what settles after it is no other one
    stretches = [slice(a, b) for a, b in pairwise([0, *at.tolist(), len(means)]) if b - a >= LEAST_STRETCH]
    slopes = [float(np.polyfit((t[s] - t[s].mean()) / 60, means[s], 1)[0]) for s in stretches]
    between = float(np.sqrt(np.mean(np.square(slopes)))) if slopes else float("nan")
    if len(at) == 0:
        return ShutterResponse(0, float("nan"), float("nan"), float("nan"), between)
    jumps = np.array([_level(means, t, i, 1) - _level(means, t, i, -1) for i in at.tolist()])
    first = []
    for s in stretches:
        early = t[s] - t[s][0] < FIRST_S
        if s.start > 0 and early.any() and not early.all():
            first.append(float(means[s][early].mean() - means[s][~early].mean()))
    largest = float(jumps[np.argmax(np.abs(jumps))])
    rms = float(np.sqrt(np.mean(jumps**2)))
    return ShutterResponse(len(at), rms, largest, float(np.mean(first)) if first else float("nan"), between)


def _level(means: Float, t: Float, at: int, side: int) -> float:
    """Mean of up to a second of frames before (side -1) or from (1) a frame on."""
    near = (t >= t[at]) & (t < t[at] + FIRST_S) if side > 0 else (t < t[at]) & (t >= t[at - 1] - FIRST_S)
    return float(means[near].mean())


def _pair(first: SourceFigures, second: SourceFigures) -> PairFigures:
    """Of two sources in the same frames."""
    off = (second.means_K + second.degC) - (first.means_K + first.degC)
    true, noise = second.degC - first.degC, float(np.std(off, ddof=1))
    return PairFigures(first.name, second.name, true, float(off.mean() - true), noise, float(1.96 * noise))


def qualify(groups: Sequence[Sequence[Shown]], sigma_K: float) -> Qualification:
    """From recordings, each a group of the sources in it; sigma_K : of the sources' temperature, one sigma.

    Raises what `figures_of` raises.
    """
    found = [[figures_of(shown) for shown in group] for group in groups]
    pairs = [_pair(a, b) for group in found for k, a in enumerate(group) for b in group[k + 1 :]]
    every = [s for group in found for s in group]
    squares, freedom = _repeated([group[0] for group in found])
    errors = np.array([s.error_K for s in every])
    worst = lambda name: max((getattr(s, name) for s in every), key=abs)  # noqa: E731
    return Qualification(
        tuple(every),
        tuple(pairs),
        float(errors[np.argmax(np.abs(errors))]),
        sigma_K,
        float(np.sqrt(squares / freedom)) if freedom else float("nan"),
        freedom,
        worst("drift_K_per_min"),
        worst("stability_K"),
        worst("uniformity_K"),
        worst("netd_K"),
        {side: max(s.resolvable_K[side] for s in every) for side in every[0].resolvable_K},
    )


def _repeated(each: Sequence[SourceFigures]) -> tuple[float, int]:
    """Sum of squares, K², of the errors of recordings at one temperature about their mean; degrees of freedom."""
    order = sorted(each, key=lambda s: s.degC)
    squares, freedom = 0.0, 0
    while order:
        same = [s for s in order if s.degC - order[0].degC < ALIKE_K]
        order = order[len(same) :]
        errors = np.array([s.error_K for s in same])
        squares += float(((errors - errors.mean()) ** 2).sum())
        freedom += len(same) - 1
    return squares, freedom
