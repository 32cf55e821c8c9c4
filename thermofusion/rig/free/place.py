"""The stage for a thermal camera that is not on the rig: search, outline by view, then all views jointly.

Nothing is known of where it stood; its clock does not matter, and it may have been there before or after the depth
camera. The subject must stand out of the room, warmer than it, and hold still between the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError, counted
from ...geometry.rigid import invert, rotation_angle_deg, se3_exp, se3_log
from ...physics.signal import SignalConverter
from ...progress import Progress, silent
from ...robust import evenly
from ...types import Camera, Float, Float32, Int, Scan, SurfaceMesh, ThermalStream, ThermalViews, Trajectory, brief
from ..edges import smooth_image
from ..outlines import MIN_STEP_NETD, Contrast
from .joint import Joint, solve_jointly
from .outline import MAX_COST, Images, OutlineFitter, Placed, walk_through
from .pattern import PatternSampler
from .search import Candidates, body_picture, search

MAX_VIEWS = 120  # that enter, evenly chosen: more say nothing new
MIN_VIEWS = 4  # fewer placed are a result only where they are most of the views
UNSURE_COST = 0.1  # a view with more of its outline unexplained is tried from its neighbours' places, too
AMBIGUOUS = 0.01  # share of the outline by which the right side must be better than another, in half of the views
OTHER_SIDE_DEG = 15.0
SWEEPS = 2  # through the views, to start from neighbours
ODD_PATTERN = 3.0  # times the usual residual of the pattern: a view that shows another side of the subject
MAX_SIGMA_MM = 20.0  # of a view's place: one that is known less well says nothing
SHUTTER, NOT_PLACED, NOT_NEEDED = "shutter", "not placed", "more than needed"


@dataclass(frozen=True, eq=False)
class FreeViews:
    """The thermal views that were placed, M of them.

    frame : (M,) position in the thermal stream. T_world_thermal : (M, 4, 4). covariance : (M, 6, 6) of the poses: rad
    and m, a twist of the world in the camera's frame. left_out : thermal frames without a pose, by reason.
    lost : (L,) frames that were tried and not placed.
    """

    frame: Int
    T_world_thermal: Float
    covariance: Float
    left_out: dict[str, int]
    lost: Int

    __repr__ = brief

    def views(self, stream: ThermalStream) -> ThermalViews:
        """As mapping takes them; times are the stream's own."""
        return ThermalViews(self.frame, stream.times_s[self.frame], self.T_world_thermal)

    def pose_px(self, lens: Camera, range_m: Float) -> float:
        """What the poses' errors come to in the image, at the subject's distance (M,): one sigma, px, RMS."""
        error = []
        for cov, z in zip(self.covariance, range_m, strict=True):
            # how a point on the axis, z away, moves sideways when the world turns and shifts
            side = np.zeros((2, 6))
            side[0, [1, 3]], side[1, [0, 4]] = (z, 1), (-z, 1)
            error.append(np.trace(side @ cov @ side.T) / 2 * (lens.focal_px / z) ** 2)
        return float(np.sqrt(np.mean(error)))

    @property
    def sigma_rotation_deg(self) -> Float:
        """(M,) one sigma about the least certain axis."""
        return np.asarray(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[:, :3, :3])[:, -1])))

    @property
    def sigma_translation_mm(self) -> Float:
        """(M,) one sigma of the camera's place along the least certain direction."""
        return np.asarray(1e3 * np.sqrt(np.linalg.eigvalsh(self.covariance[:, 3:, 3:])[:, -1]))


def place_views(
    scan: Scan, mesh: SurfaceMesh, trajectory: Trajectory, progress: Progress = silent
) -> tuple[FreeViews, Joint]:
    """Find where every thermal view of a scan was taken.

    mesh : the fused surface, world frame. trajectory : of the depth camera; only which way is up is taken from it.
    progress : called with ("rig", done, all). Raises ScanError: the subject does not stand out, or hardly any view can
    be placed.
    """
    stream = scan.thermal
    assert stream is not None
    usable = np.flatnonzero(stream.usable)
    chosen = usable[evenly(len(usable), MAX_VIEWS)]
    if not len(chosen):
        raise ScanError("no thermal frame is usable: all are marked as shutter frames", place=scan.root)
    taken = _Taken.of(scan, chosen)
    up = (trajectory.T_world_depth[:, :3, :3] @ np.array(scan.depth_up)).mean(axis=0)
    fitter = OutlineFitter(mesh, stream.camera.lens, taken.images)
    found = search(mesh, stream.camera.lens, up, taken.body)
    placed = _by_outline(fitter, found, progress)
    good = [k for k, p in enumerate(placed) if p.cost < MAX_COST]
    _enough(scan, len(good), len(chosen))
    T = np.stack([placed[k].T_world_thermal for k in good])
    sampler = PatternSampler.of(mesh, stream.camera.lens, taken.room())
    joint = solve_jointly(fitter, sampler, taken.radiance, good, T, taken.netd)
    fits = _fits(joint, [fitter.cost(k, P) for k, P in zip(good, joint.T_world_thermal, strict=True)])
    if not fits.all():
        good = [k for k, fit in zip(good, fits, strict=True) if fit]
        _enough(scan, len(good), len(chosen))
        joint = solve_jointly(fitter, sampler, taken.radiance, good, joint.T_world_thermal[fits], taken.netd)
    left_out = {
        SHUTTER: int((~stream.usable).sum()),
        NOT_PLACED: len(chosen) - len(good),
        NOT_NEEDED: len(usable) - len(chosen),
    }
    frames, lost = chosen[good].astype(np.int32), np.delete(chosen, good).astype(np.int32)
    return FreeViews(frames, joint.T_world_thermal, joint.covariance, left_out, lost), joint


@dataclass(frozen=True, eq=False)
class _Taken:
    """The images: radiance (H, W) each; body (N, h, w) and soft (H, W) each, 1 = subject; netd in radiance."""

    radiance: Sequence[Float32]
    body: Float32
    soft: Sequence[Float32]
    images: Images
    netd: float

    def room(self) -> float:
        """Radiance of what lies past the subject."""
        return float(np.nanmedian(np.concatenate([i[s < 0.1] for i, s in zip(self.radiance, self.soft, strict=True)])))

    @classmethod
    def of(cls, scan: Scan, frames: NDArray[np.intp]) -> _Taken:
        stream = scan.thermal
        assert stream is not None
        converter = SignalConverter(stream.camera)
        radiance = [converter.radiance(stream.load(int(i)), stream.places[i]) for i in frames]
        body = [body_picture(r) for r in radiance]
        soft = [
            np.asarray(cv2.resize(s, r.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
            for s, r in zip(body, radiance, strict=True)
        ]
        steps = [
            np.nanmedian(r[s > 0.9]) - np.nanmedian(r[s < 0.1])
            for r, s in zip(radiance, soft, strict=True)
            if (s > 0.9).any() and (s < 0.1).any()
        ]
        step = float(np.median(steps)) if steps else 0.0
        band = converter.band
        netd = stream.camera.netd_K * float(band.d_radiance_dT(band.temperature_K(np.nanmedian(radiance[0]))))
        if not step > MIN_STEP_NETD * netd:
            raise ScanError(
                "the subject does not stand out of the room in the thermal images, so no view can be placed",
                place=scan.root,
                hint="the subject must be warmer than what is behind it; or record with a calibrated rig",
            )
        images = Images([smooth_image(r) for r in radiance], Contrast(1.0, step))
        return cls(radiance, np.stack(body), soft, images, netd)


def _by_outline(fitter: OutlineFitter, found: Candidates, progress: Progress) -> list[Placed]:
    """Every view by its own outline: the candidates, a walk through them, and where that is unsure, neighbours."""
    candidates = []
    for row, starts in enumerate(found.T_world_thermal):
        candidates.append([fitter.rough(row, T) for T in starts])
        progress("rig", row + 1, len(found.T_world_thermal))
    placed = walk_through(candidates)
    margins = [_margin(p, c) for p, c in zip(placed, candidates, strict=True) if p.cost < MAX_COST]
    if margins and np.median(margins) < AMBIGUOUS:  # of views that fit: who fits nowhere is no one's double
        raise ScanError(
            "the thermal views could have been taken from several sides: the subject's outline fits from each",
            hint="a round or flat subject has no outline to tell by; record with the thermal camera on the depth rig",
        )
    for _ in range(SWEEPS):
        for row, own in enumerate(placed):
            if own.cost > UNSURE_COST:
                tries = [fitter.rough(row, T) for T in _near(placed, row)]
                placed[row] = min([own, *tries], key=lambda p: p.cost)
    return [fitter.fine(row, p.T_world_thermal) if p.cost < MAX_COST else p for row, p in enumerate(placed)]


def _margin(chosen: Placed, candidates: Sequence[Placed]) -> float:
    """How much more of the outline the best pose from another side leaves unexplained; inf where there is none."""
    others = [
        c.cost
        for c in candidates
        if rotation_angle_deg(invert(chosen.T_world_thermal) @ c.T_world_thermal) > OTHER_SIDE_DEG
    ]
    return min(others, default=np.inf) - chosen.cost


def _near(placed: Sequence[Placed], row: int) -> list[Float]:
    """Poses of the nearest views before and after that are placed, and the one between."""
    sure = [k for k, p in enumerate(placed) if p.cost <= UNSURE_COST]
    before, after = [k for k in sure if k < row][-1:], [k for k in sure if k > row][:1]
    poses = [placed[k].T_world_thermal for k in (*before, *after)]
    if len(poses) == 2:
        share = (row - before[0]) / (after[0] - before[0])
        poses.append(se3_exp(share * se3_log(poses[1] @ invert(poses[0]))) @ poses[0])
    return poses


def _fits(joint: Joint, cost: Sequence[float]) -> NDArray[np.bool_]:
    """Which views agree with the others: by outline and pattern, and which are held."""
    usual = np.nanmedian(joint.pattern) if np.isfinite(joint.pattern).any() else np.inf
    odd = np.nan_to_num(joint.pattern) > ODD_PATTERN * usual
    loose = 1e3 * np.sqrt(np.linalg.eigvalsh(joint.covariance[:, 3:, 3:])[:, -1]) > MAX_SIGMA_MM
    return ~odd & ~loose & (np.array(cost) < MAX_COST)


def _enough(scan: Scan, placed: int, tried: int) -> None:
    """Raises ScanError where so few views are placed that they are probably placed wrongly."""
    if placed >= MIN_VIEWS or placed > tried / 2:
        return
    raise ScanError(
        f"only {placed} of {counted(tried, 'thermal view')} can be placed by the subject's outline",
        place=scan.root,
        hint="keep the whole outline in view against a plain, cooler background; the surface must be of the same pose",
    )
