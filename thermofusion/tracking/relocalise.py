"""Segments that lost each other are put together again: by time, by place, or by shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .._open3d import o3d
from ..geometry import invert
from ..recipe import TrackingSection
from ..types import Float
from .fragments import Fragment
from .maps import DepthMap
from .registration import Partners, register

COARSE_REACHES_M = (0.3, 0.25, 0.2, 0.16, 0.13, 0.1, 0.08, 0.06, 0.05, 0.04)
FINE_REACHES_M = (0.04, 0.03, 0.03, 0.02, 0.02, 0.02)
FEATURE_VOXEL_M = 0.02  # of the subject's extent it is a few per cent for a person; scaled down for small things
RANSAC_ITERATIONS = 60_000
MAX_HYPOTHESES = 24
MIN_SHARED = 0.35  # of the points sent: a join on less is a guess


@dataclass(frozen=True, eq=False)
class Join:
    """Where a segment belongs. T_main_segment; how it was found; share of points and residual of the check."""

    T_main_segment: Float
    how: str
    fitness: float
    residual_mm: float


def find_join(
    main: Sequence[tuple[Fragment, Float]],
    segment: Sequence[tuple[Fragment, Float]],
    guesses: Sequence[Float],
    gate: TrackingSection,
) -> Join | None:
    """Where a segment's fragments belong among the main ones, or None if nothing convinces.

    main, segment : (fragment, T_main_middle) and (fragment, T_segment_middle). guesses : T_main_segment from
    neighbours in time. Tried in turn: the guesses; every place the camera has been; features of the shape.
    """
    probe, T_segment_probe = segment[len(segment) // 2]
    best: Join | None = None
    places = [T @ invert(T_segment_probe) for _, T in _spread(main, MAX_HYPOTHESES)]
    for how, tries in (("from the frames before and after", list(guesses)), ("at a place seen before", places)):
        for T in tries:
            best = _better(best, _check(main, probe, T @ T_segment_probe, T_segment_probe, how, gate))
        if best is not None:
            return best
    for fragment, T_main in main:
        T_map = _by_features(probe.map, fragment.map)
        if T_map is not None:
            how = "by features of the shape"
            best = _better(best, _check(main, probe, T_main @ T_map, T_segment_probe, how, gate))
    return best


def _better(a: Join | None, b: Join | None) -> Join | None:
    if a is None or b is None:
        return a or b
    return b if b.fitness > a.fitness else a


def _check(
    main: Sequence[tuple[Fragment, Float]],
    probe: Fragment,
    T_main_probe: Float,
    T_segment_probe: Float,
    how: str,
    gate: TrackingSection,
) -> Join | None:
    """Refine a hypothesis against the nearest main fragments, and judge it."""
    near = _nearest(main, T_main_probe, 3)
    targets = [(f.map, T) for f, T in near]
    T, partners = register(probe.map, targets, T_main_probe, COARSE_REACHES_M, stride=4)
    if partners is None or partners.fitness < 0.5 * MIN_SHARED:
        return None
    targets = [(f.map, T_f) for f, T_f in _nearest(main, T, 3)]
    T, partners = register(probe.map, targets, T, FINE_REACHES_M, stride=2)
    if partners is None or not _convincing(partners, gate):
        return None
    return Join(T @ invert(T_segment_probe), how, partners.fitness, partners.residual_mm_at_1m)


def _convincing(partners: Partners, gate: TrackingSection) -> bool:
    """Enough overlap, most of it in agreement, and a surface that fits as well as tracked frames do."""
    agree = partners.share >= max(gate.min_fitness, 0.6)
    return agree and partners.fitness >= MIN_SHARED and partners.residual_mm_at_1m <= 0.5 * gate.max_residual_mm


def _nearest(main: Sequence[tuple[Fragment, Float]], T: Float, count: int) -> list[tuple[Fragment, Float]]:
    """The main fragments whose views resemble the pose most."""
    poses = np.array([p for _, p in main])
    turn = np.arccos(np.clip(poses[:, :3, 2] @ T[:3, 2], -1, 1))
    distance = np.linalg.norm(poses[:, :3, 3] - T[:3, 3], axis=1)
    return [main[k] for k in np.argsort(turn + distance, kind="stable")[:count]]


def _spread(items: Sequence[tuple[Fragment, Float]], count: int) -> list[tuple[Fragment, Float]]:
    pick = np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).astype(int))
    return [items[k] for k in pick]


def _by_features(source: DepthMap, target: DepthMap) -> Float | None:
    """T_target_source from FPFH features and RANSAC (fixed seed), for views too far apart for anything else."""
    r = o3d.pipelines.registration
    voxel = FEATURE_VOXEL_M
    if len(source.sample) and len(target.sample):
        extent = float(np.ptp(target.sample, axis=0).max())
        voxel = min(FEATURE_VOXEL_M, extent / 25)
    clouds = []
    for m in (source, target):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(m.sample))
        cloud.normals = o3d.utility.Vector3dVector(m.sample_normals)
        cloud = cloud.voxel_down_sample(voxel)
        if len(cloud.points) < 50:
            return None
        cloud.normalize_normals()
        clouds.append((cloud, r.compute_fpfh_feature(cloud, o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100))))
    (a, feature_a), (b, feature_b) = clouds
    o3d.utility.random.seed(0)
    result = r.registration_ransac_based_on_feature_matching(
        a,
        b,
        feature_a,
        feature_b,
        True,
        1.5 * voxel,
        r.TransformationEstimationPointToPoint(False),
        3,
        [
            r.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            r.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
        ],
        r.RANSACConvergenceCriteria(RANSAC_ITERATIONS, 0.999),
    )
    T = np.asarray(result.transformation, np.float64)
    return T if result.fitness > 0.1 and np.isfinite(T).all() else None
