"""A thermal camera that was knocked in mid-scan: from one frame on it stands elsewhere on the rig.

One rig for all views would be an average that fits none. Each view's outline asks for a small turn of the camera; a
knock is a step in their sequence. It is believed where it is abrupt, where two rigs leave clearly less of the outline
than one does, and where they differ by more than the outline's own errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..geometry.rigid import invert, rotation_angle_deg
from ..robust import SIGMA_PER_MAD, TUKEY, mad_sigma, tukey_weight
from ..types import Float
from .estimate import REACH_DEG, RIG, ROTATION, TWIST, Measured, OutlineSet, State, solve
from .outlines import MIN_SCALE_PX, reach_px, search_shift

MIN_VIEWS = 4  # on each side: fewer do not carry a rig of their own
MIN_POINTS = 20  # of a view's outline
LOST_SHARE = 0.6  # of the outline points that the best views show: views that show fewer have lost the outline
TURN_PRIOR_DEG = 2.0  # of a view's own turn, against directions that its outline does not show
STEP_SIGMAS = 5.0  # of the views' scatter about the two levels, over root of views
LEAST_TURN = 1e-5  # rad, of the scatter
ABRUPT = 0.6  # share of the step that lies between the views next to it; a drift would show less
NEAR_VIEWS = 3  # that are next to it
MIN_GAIN = 0.3  # share by which the outline must come nearer with two rigs
MIN_TURN_DEG = 0.08  # a smaller step is what unsteady poses make
DIFFER_CHI2 = 33.0  # beyond any chance of chi-square with 6 degrees of freedom
MOST = 3  # knocks in a scan: with more, nothing holds the camera


@dataclass(frozen=True, eq=False)
class Knocks:
    """The thermal camera's stands on the rig.

    frame : (K,) the first frame of each new stand. motion : (K, 4, 4) each stand's T_thermal_depth times the inverse
    of the first one's. before_px, after_px : robust rms distance of outlines with one rig, and with all stands.
    """

    frame: NDArray[np.intp]
    motion: Float
    before_px: float
    after_px: float

    def of(self, frames: NDArray[np.intp]) -> Float:
        """(N, 4, 4) motion of the camera since the first stand, at frames (N,)."""
        stand = np.searchsorted(self.frame, frames, side="right")
        return np.concatenate([np.eye(4)[None], self.motion])[stand]

    def sizes(self) -> tuple[float, float]:
        """The largest turn, deg, and the largest shift, mm, from one stand to the next."""
        steps = self.motion @ invert(np.concatenate([np.eye(4)[None], self.motion[:-1]]))
        shift_m = np.linalg.norm(steps[:, :3, 3], axis=1)
        return float(rotation_angle_deg(steps).max()), float(1e3 * shift_m.max())


def find_knocks(outlines: OutlineSet, start: State, frames: NDArray[np.intp]) -> Knocks | None:
    """The knocks that outlines show, None where the camera stayed where it is.

    start : the rig that fits all views best. frames : (N,) the views' numbers in the stream; a new stand begins at
    one of them.
    """
    cuts = _cuts(outlines, start, MOST)
    if not cuts:
        return None
    stands = [_stand(side, start) for side in _sides(outlines, cuts)]
    states = [stand[0] for stand in stands if stand is not None]
    if len(states) < len(stands):
        return None
    T = np.array([state.T_thermal_depth for state in states])
    found = Knocks(frames[cuts], T[1:] @ invert(T[0]), outlines.residual_px(start), 0.0)
    return replace(found, after_px=outlines.knocked(found.of(frames)).residual_px(states[0]))


def settled(knocks: Knocks, around: OutlineSet, start: State, frames: NDArray[np.intp]) -> Knocks:
    """The first frame of each stand, told by the outlines of frames (N,) around the steps; start : the first stand.

    Of all frames at which it could begin, the one that leaves the outlines least distant.
    """
    reach = reach_px(around.lens, REACH_DEG[0])
    far = np.full(len(frames), reach)
    stands = [np.broadcast_to(T, (len(frames), 4, 4)) for T in (np.eye(4), *knocks.motion)]
    misfit = [np.minimum(_misfit(around.knocked(T).measure(start, reach), len(frames)), far) for T in stands]
    first = knocks.frame.copy()
    for k in range(len(first)):
        mine = np.ones(len(frames), bool)
        if k:
            mine &= frames > knocks.frame[k - 1]
        if k + 1 < len(first):
            mine &= frames < knocks.frame[k + 1]
        begins = frames[mine]
        cost = [misfit[k][mine & (frames < f)].sum() + misfit[k + 1][mine & (frames >= f)].sum() for f in begins]
        if cost:
            first[k] = begins[int(np.argmin(cost))]
    return replace(knocks, frame=first)


def _cuts(outlines: OutlineSet, start: State, most: int, first: int = 0) -> list[int]:
    """Views at which new stands begin, by number, the first view being number `first`."""
    n = len(outlines.views)
    m = outlines.measure(start, reach_px(outlines.lens, REACH_DEG[0]))
    lost = _lost(outlines, m)
    if lost is not None and most:
        sides = _sides(outlines, [lost])
        stands = [_stand(side, start) for side in sides]
        if stands[0] is None or stands[1] is None or not _differ(start, sides, stands):
            return []
        before = _cuts(sides[0], stands[0][0], most - 1, first)
        return [*before, first + lost, *_cuts(sides[1], stands[1][0], most - 1 - len(before), first + lost)]
    cuts = _steps(_turns(m, n), most)
    while cuts:
        sides = _sides(outlines, cuts)
        stands = [_stand(side, start) for side in sides]
        sure = [_differ(start, sides[k : k + 2], stands[k : k + 2]) for k in range(len(cuts))]
        if all(sure):
            break
        cuts = [cut for cut, good in zip(cuts, sure, strict=True) if good]
    return [first + cut for cut in cuts]


def _sides(outlines: OutlineSet, cuts: Sequence[int]) -> list[OutlineSet]:
    """The views up to the first cut, from there to the next, and so on."""
    return [outlines.part(np.arange(a, b)) for a, b in pairwise([0, *cuts, len(outlines.views)])]


def _lost(outlines: OutlineSet, m: Measured) -> int | None:
    """The view from which on, or up to which, outlines are lost; None where they are not."""
    n = len(outlines.views)
    shown = np.bincount(m.view, minlength=n) / [len(v.contour) for v in outlines.views]
    lost = (shown < LOST_SHARE * np.quantile(shown, 0.9)).astype(np.float64)
    cuts = range(MIN_VIEWS, n - MIN_VIEWS + 1)
    step = [abs(lost[:k].mean() - lost[k:].mean()) for k in cuts]
    return cuts[int(np.argmax(step))] if step and max(step) > ABRUPT else None


def _steps(turn: Float, most: int, first: int = 0) -> list[int]:
    """Where the turns (N, 3) that views ask for take abrupt steps: the clearest one, and those on either side of it."""
    n, best, at = len(turn), np.inf, None
    known = np.isfinite(turn[:, 0])
    for k in range(MIN_VIEWS, n - MIN_VIEWS + 1) if most else ():
        a, b = turn[:k][known[:k]], turn[k:][known[k:]]
        if min(len(a), len(b)) < MIN_VIEWS:
            continue
        level = np.median(a, axis=0), np.median(b, axis=0)
        off = np.abs(np.concatenate([a - level[0], b - level[1]]))
        sigma = np.maximum(SIGMA_PER_MAD * np.median(off, axis=0), LEAST_TURN) * np.sqrt(1 / len(a) + 1 / len(b))
        step = level[1] - level[0]
        c = int(np.argmax(np.abs(step) / sigma))
        sigma[c] = max(sigma[c], np.radians(MIN_TURN_DEG) / STEP_SIGMAS)
        near = np.median(b[:NEAR_VIEWS, c]) - np.median(a[-NEAR_VIEWS:, c])
        if off.sum() < best and abs(step[c]) > STEP_SIGMAS * sigma[c] and near / step[c] > ABRUPT:
            best, at = float(off.sum()), k
    if at is None:
        return []
    before = _steps(turn[:at], most - 1, first)
    return [*before, first + at, *_steps(turn[at:], most - 1 - len(before), first + at)]


def _turns(m: Measured, n: int) -> Float:
    """(N, 3) rotation of the camera that each of n views asks for, rad; NaN where too little outline shows."""
    out = np.full((n, 3), np.nan)
    residual = m.residual_px - np.median(m.residual_px)
    for k in range(n):
        r, J = residual[m.view == k], m.jacobian[m.view == k][:, ROTATION]
        if len(r) < MIN_POINTS:
            continue
        turn = np.zeros(3)
        for _ in range(4):
            e = r - J @ turn
            scale = max(mad_sigma(e), MIN_SCALE_PX)
            w = tukey_weight(e / (TUKEY * scale)) / scale**2
            normal = J.T @ (w[:, None] * J) + np.eye(3) / np.radians(TURN_PRIOR_DEG) ** 2
            turn = np.linalg.solve(normal, J.T @ (w * r))
        out[k] = turn
    return out


def _stand(side: OutlineSet, start: State) -> tuple[State, Float] | None:
    """The rig of some views by themselves with its covariance (6, 6), looked for farther off where it is not near."""
    solved = solve(side, start)
    if solved is None or not solved.converged:
        views = [replace(v, row=i) for i, v in enumerate(side.views)]
        shift = search_shift(side.lens, views, side.poses(start))
        if shift is None:
            return None
        turn = shift[::-1] / side.lens.focal_px * [-1, 1]
        solved = solve(side, start.moved(np.concatenate([turn, np.zeros(6)])))
        if solved is not None:  # the shift was coarse, and knew nothing of a roll
            solved = solve(side, solved.state)
    if solved is None or not solved.converged:
        return None
    return solved.state, solved.covariance[TWIST, TWIST] + side.shared_error()[TWIST, TWIST]


def _differ(
    start: State,
    sides: Sequence[OutlineSet],
    stands: Sequence[tuple[State, Float] | None],
) -> bool:
    """Two rigs differ beyond their errors, and leave clearly less of the outline than one."""
    if stands[0] is None or stands[1] is None:
        return False
    (a, cov_a), (b, cov_b) = stands[0], stands[1]
    step = b.distance(a)[RIG][TWIST]
    if np.degrees(np.linalg.norm(step[ROTATION])) < MIN_TURN_DEG:
        return False
    if step @ np.linalg.solve(cov_a + cov_b, step) < DIFFER_CHI2:
        return False
    reach = reach_px(sides[0].lens, REACH_DEG[0])
    apart = np.concatenate([_centred(s.measure(t, reach)) for s, t in zip(sides, (a, b), strict=True)])
    together = np.concatenate([_centred(s.measure(start, reach)) for s in sides])
    nearer = mad_sigma(apart) < (1 - MIN_GAIN) * mad_sigma(together)
    return bool(nearer or len(apart) > (1 + MIN_GAIN) * len(together))


def _centred(m: Measured) -> Float:
    return m.residual_px - np.median(m.residual_px)


def _misfit(m: Measured, n: int) -> Float:
    """(N,) median distance of each of n views' outline, px; infinite where too little shows."""
    r = np.abs(_centred(m))
    return np.array([np.median(r[m.view == k]) if (m.view == k).sum() >= MIN_POINTS else np.inf for k in range(n)])
