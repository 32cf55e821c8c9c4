"""What a mean of temperature images tells of the frames behind it, when counts come in whole levels.

If an image is the mean over N frames of f(level), its values are no continuum: they sit on a ladder whose rungs are the
sums s of the N levels (f'/N apart), each rung split by the spread q of the levels (f''/N apart, a thousand times
finer). Climbing the ladder gives f, and then s and q of every pixel, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray

from thermofusion.types import Float

DEGREE = 4  # of the curve (paper Eq. 1)
WINDOW_K = 0.1  # pixels looked at together
MOST_STEP_K = 0.3  # that the ladder is climbed at once
RUNG_K = 3e-4  # rungs lie further apart than this, and the curve fits them better


@dataclass(frozen=True, eq=False)
class Decoded:
    """curve : level -> degC. total (N,) : sum of a pixel's levels over the frames. spread (N,) : sum of their squared
    distances from their mean. degC (N,) : mean over the frames of the curve, for that sum and spread."""

    curve: Chebyshev
    frames: int
    total: Float
    spread: Float
    degC: Float

    def may_hold(self, level: Float) -> NDArray[np.bool_]:
        """(N,) whether a frame of that level can be one of the frames: the others must be whole numbers as well."""
        others, rest = self.frames - 1, self.total - level
        spread = self.spread + self.total**2 / self.frames - level**2 - rest**2 / others
        return spread > _least_spread(rest, others) - 1e-6


def decode(degC: Float, level: Float, frames: int) -> Decoded:
    """From values (N,) of mean images, and the levels (N,) of one of their frames, which only say on which level the
    ladder stands: by itself it is known but for multiples of `frames` rungs."""
    values, which = np.unique(degC, return_inverse=True)
    s = _climb(values)[which]
    s = s + max(range(frames), key=lambda shift: _clarity(degC, s + shift, frames))
    s = s + frames * np.round(np.median(level - s / frames))
    curve = _straighten(degC, s, frames)
    for _ in range(2):
        q = s + 2 * np.round(_excess(curve, degC, s, frames) / 2) - s**2 / frames
        q = q - np.min(q - _least_spread(s, frames))
        curve = _fit(degC, s, q, frames)
    return Decoded(curve, frames, s, q, _columns(s, q, frames, curve.domain) @ curve.coef)


def _climb(T: Float) -> Float:
    """Rungs of the values (M,), sorted, but for a constant: from the clearest window outwards, each step predicted
    by the polynomial through those before it."""
    edges = np.arange(T[0], T[-1] + WINDOW_K, WINDOW_K)
    count = np.histogram(T, edges)[0]
    starts = edges[:-1][count > 300]
    lo, hi, s = max((_start(T, e) for e in starts), key=lambda found: found[0])[1]
    while hi - lo < len(T):
        span = T[hi - 1] - T[lo]
        degree = 1 + int(np.searchsorted([0.12, 0.4, 1.5], span))
        p = Chebyshev.fit(s, T[lo:hi], degree)
        p = Chebyshev.fit(s, T[lo:hi], degree, w=np.abs(T[lo:hi] - p(s)) < RUNG_K / 2)
        step = min(0.05 + 0.03 * span, MOST_STEP_K)
        lo, hi = np.searchsorted(T, [T[lo] - step, T[hi - 1] + step])
        reach = 2 * step / p.deriv()(s[[0, -1]])
        grid = np.arange(np.floor(s[0] - reach[0]), s[-1] + reach[1])
        s = np.round(np.interp(T[lo:hi], np.maximum.accumulate(p(grid)), grid))
    return s


def _start(T: Float, start: float) -> tuple[float, tuple[int, int, Float]]:
    """How clear an even ladder is in the window from `start` on, and the window's range and rungs."""
    lo, hi = np.searchsorted(T, [start, start + WINDOW_K])
    per_K = np.arange(300.0, 1500.0)
    wave = np.exp(2j * np.pi * np.outer(per_K, T[lo : hi : (hi - lo) // 300 + 1] - start)).mean(axis=1)
    clear = np.abs(wave)
    best = np.flatnonzero(clear > 0.95 * clear.max())[0]  # its harmonics are as clear
    best += np.argmax(clear[best : best + 8])
    s = np.round(per_K[best] * (T[lo:hi] - start) - np.angle(wave[best]) / (2 * np.pi))
    return float(clear[best]), (int(lo), int(hi), s)


def _excess(curve: Chebyshev, degC: Float, s: Float, frames: int) -> Float:
    """Sum of squared levels less their sum, by the curve: an even number, as n² - n is."""
    k = s / frames
    return (degC - curve(k)) / (curve.deriv(2)(k) / (2 * frames)) + s**2 / frames - s


def _windows(curve: Chebyshev, degC: Float, s: Float, frames: int) -> tuple[Float, NDArray[np.complex128], Float]:
    """Mean level, mean exp(iπ excess) and number of pixels of every window."""
    _, b, n = np.unique(np.floor(degC / WINDOW_K), return_inverse=True, return_counts=True)
    z = np.exp(1j * np.pi * _excess(curve, degC, s, frames))
    mean = (np.bincount(b, z.real) + 1j * np.bincount(b, z.imag)) / n
    level = np.bincount(b, s / frames) / n
    return level[n > 40], mean[n > 40], n[n > 40].astype(float)


def _clarity(degC: Float, s: Float, frames: int) -> float:
    """1 if every pixel's excess is even after all, 0 if the sums are off by a constant."""
    _, z, n = _windows(_rough(degC, s, frames), degC, s, frames)
    return float(np.average(np.abs(z), weights=n))


def _rough(degC: Float, s: Float, frames: int) -> Chebyshev:
    return _fit(degC, s, np.full(len(s), frames - 2.0), frames)


def _straighten(degC: Float, s: Float, frames: int) -> Chebyshev:
    """The curve for which the excess is even everywhere; the rough one's drifts slowly with the level."""
    curve = _rough(degC, s, frames)
    level, z, n = _windows(curve, degC, s, frames)
    error = np.unwrap(np.angle(z)) / np.pi * curve.deriv(2)(level) / (2 * frames)
    return curve + Chebyshev.fit(level, error, DEGREE, domain=curve.domain, w=np.sqrt(n) * np.abs(z))


def _fit(degC: Float, s: Float, q: Float, frames: int) -> Chebyshev:
    domain = [s.min() / frames, s.max() / frames]
    return Chebyshev(np.linalg.lstsq(_columns(s, q, frames, domain), degC, rcond=None)[0], domain)


def _columns(s: Float, q: Float, frames: int, domain: object) -> Float:
    """Mean over the frames of each basis polynomial b: b + b'' q / 2N (b''' of this curve moves nothing by 1e-6 K)."""
    basis = [Chebyshev.basis(j, domain) for j in range(DEGREE + 1)]  # type: ignore[arg-type]
    return np.column_stack([b(s / frames) + b.deriv(2)(s / frames) * q / (2 * frames) for b in basis])


def _least_spread(total: Float, n: int) -> Float:
    """Of n whole numbers of that sum."""
    r = np.mod(total, n)
    return r * (n - r) / n
