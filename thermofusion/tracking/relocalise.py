"""Segments that lost each other are put together again: by time, by a walk round the subject, by place, or by shape.

Many places are tried; one counts when what both sides see agrees, and when no other place does as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..geometry.rigid import invert, pose, rotation_angle_deg
from ..recipe import TrackingSection
from ..types import Float
from .fragments import Fragment
from .maps import DepthMap
from .registration import REACH_M, register_view, seen_from

# Reach of partners, one iteration each.
COARSE_REACHES_M = (0.2, 0.16, 0.13, 0.1, 0.08, 0.06, 0.05, 0.04)
FINE_REACHES_M = (0.04, 0.03, 0.03, 0.02, 0.02, 0.02)
# Walks round the subject that are tried, both ways, near ones first.
TURNS_DEG = (15, -15, 30, -30, 45, -45, 60, -60, 75, -75, 90, -90, 110, -110, 130, -130, 150, -150, 170, -170)
MAX_PLACES = 24  # tried, evenly spread over the fragments: every 15 degrees of a walk round
FEATURE_VOXELS = 25  # over the subject's extent: a few per cent of it
RANSAC_ITERATIONS = 60_000  # at most: it ends earlier once 0.999 sure
TARGETS = 3  # fragments that a hypothesis is aligned with
SHORTLIST = 6  # hypotheses that are aligned finely
MIN_SHARED = 0.2  # of the points sent: a join on less is a guess
MIN_AGREEMENT = 0.85  # right places up to 50 degrees apart have 0.86 to 1, the best wrong ones up to 0.82
MARGIN = 0.05  # by which another place must agree less
SAME_PLACE_M, SAME_PLACE_DEG = 0.06, 8.0  # hypotheses nearer to each other than this are one

Placed = tuple[Fragment, Float]  # and the pose of its middle frame


@dataclass(frozen=True, eq=False)
class Join:
    """Where a segment belongs, and how well that is known.

    T_main_segment. how : what led there. agreement : share of the points seen from both sides that agree. shared :
    share of all points that both sides see. ambiguous : another place agrees as well.
    """

    T_main_segment: Float
    how: str
    agreement: float
    shared: float
    ambiguous: bool = False


def find_join(
    main: Sequence[Placed],
    probe: Fragment,
    T_segment_probe: Float,
    guesses: Sequence[Float],
    tracking: TrackingSection,
) -> Join | None:
    """Where a segment's fragments belong among the main ones, or None if nothing convinces.

    main, probe, T_segment_probe : placed fragments; a fragment of the segment and its pose in it. guesses :
    T_main_segment from neighbours in time, (4, 4) each. An ambiguous join is returned as such; it is for the caller to
    leave it.
    """
    nearby = [(how, T @ T_segment_probe) for how, T in _near(guesses, probe, T_segment_probe)]
    near = _shortlist(main, probe, nearby)
    far = [("at a place seen before", T) for _, T in _spread(main, MAX_PLACES)]
    found = near + _shortlist(main, probe, far)
    if not any(c.agreement >= MIN_AGREEMENT for c in found):
        found += _shortlist(main, probe, list(_by_shape(main, probe)))
    joins = [j for c in found if (j := _settled(main, probe, c, tracking)) is not None]
    if not joins:
        return None
    best = max(joins, key=lambda j: j.agreement * min(j.shared, 0.5))
    rivals = [j for j in joins if j.agreement > best.agreement - MARGIN and not _same_place(j, best)]
    return replace(best, T_main_segment=best.T_main_segment @ invert(T_segment_probe), ambiguous=bool(rivals))


def _near(guesses: Sequence[Float], probe: Fragment, T_segment_probe: Float) -> Iterable[tuple[str, Float]]:
    """The guesses themselves, and walks round the subject, about the probe's `up`, from there."""
    yield from (("from the frames before or after", T) for T in guesses)
    centre = np.median(probe.map.sample, axis=0) if len(probe.map.sample) else np.zeros(3)
    for T in guesses:
        for turn in TURNS_DEG:
            R = Rotation.from_rotvec(np.radians(turn) * probe.up).as_matrix()
            T_turn = pose(R, centre - R @ centre)  # of the camera, about an upright axis through the subject
            yield f"round the subject by about {abs(turn)}°", T @ T_segment_probe @ T_turn @ invert(T_segment_probe)


def _shortlist(main: Sequence[Placed], probe: Fragment, tries: Sequence[tuple[str, Float]]) -> list[Join]:
    """The hypotheses (how, T_main_probe), roughly aligned, that agree best; T_main_segment is T_main_probe here."""
    found: list[Join] = []
    for how, T in tries:
        T, _ = register_view(probe.map, _targets(main, T), T, COARSE_REACHES_M, stride=4)
        join = _judged(main, probe, T, how, stride=4)
        if join is not None and not any(_same_place(join, other) for other in found):
            found.append(join)
    return sorted(found, key=lambda j: -j.agreement * min(j.shared, 0.5))[:SHORTLIST]


def _settled(main: Sequence[Placed], probe: Fragment, join: Join, tracking: TrackingSection) -> Join | None:
    """A hypothesis aligned finely, if it still convinces."""
    T, partners = register_view(probe.map, _targets(main, join.T_main_segment), join.T_main_segment, FINE_REACHES_M)
    fine = _judged(main, probe, T, join.how)
    if partners is None or fine is None or fine.agreement < max(MIN_AGREEMENT, tracking.min_fitness):
        return None
    return fine if partners.residual_mm_at_1m <= 0.5 * tracking.max_residual_mm else None


def _judged(main: Sequence[Placed], probe: Fragment, T: Float, how: str, stride: int = 1) -> Join | None:
    """What probe and nearest fragments see of each other, both ways; None where they share too little."""
    agree = conflict = sent = best = 0
    for fragment_map, T_map in _targets(main, T):
        ways = ((probe.map, fragment_map, invert(T_map) @ T), (fragment_map, probe.map, invert(T) @ T_map))
        for source, target, T_target_source in ways:
            seen = seen_from(source, target, T_target_source, REACH_M, stride)
            agree, conflict, sent = agree + seen.agree, conflict + seen.conflict, sent + seen.sent
            best = max(best, round(1000 * seen.agree / max(seen.sent, 1)))
    if best < 1000 * MIN_SHARED:
        return None
    return Join(T, how, agree / (agree + conflict), best / 1000)


def _same_place(a: Join, b: Join) -> bool:
    between = invert(a.T_main_segment) @ b.T_main_segment
    near = np.linalg.norm(between[:3, 3]) < SAME_PLACE_M
    return bool(near and rotation_angle_deg(between) < SAME_PLACE_DEG)


def _targets(main: Sequence[Placed], T: Float) -> list[tuple[DepthMap, Float]]:
    """The main fragments whose views resemble the pose most."""
    poses = np.array([p for _, p in main])
    turn = np.arccos(np.clip(poses[:, :3, 2] @ T[:3, 2], -1, 1))
    distance = np.linalg.norm(poses[:, :3, 3] - T[:3, 3], axis=1)
    nearest = np.argsort(turn + distance, kind="stable")[:TARGETS]
    return [(main[k][0].map, main[k][1]) for k in nearest]


def _spread(items: Sequence[Placed], count: int) -> list[Placed]:
    pick = np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).astype(int))
    return [items[k] for k in pick]


def _by_shape(main: Sequence[Placed], probe: Fragment) -> Iterable[tuple[str, Float]]:
    for fragment, T_main in _spread(main, MAX_PLACES):
        T_map = _by_features(probe.map, fragment.map)
        if T_map is not None:
            yield "by features of the shape", T_main @ T_map


def _by_features(source: DepthMap, target: DepthMap) -> Float | None:
    """T_target_source from FPFH features and RANSAC (fixed seed), for views too far apart for anything else."""
    from ..geometry._open3d import o3d

    r = o3d.pipelines.registration
    if not len(source.sample) or not len(target.sample):
        return None
    voxel = float(np.ptp(target.sample, axis=0).max()) / FEATURE_VOXELS
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
