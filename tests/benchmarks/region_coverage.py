"""How often a region's interval holds the true mean: `python tests/benchmarks/region_coverage.py OUT SCAN`.

OUT : a result of the simulated SCAN, whose truth/ it reads. 500 discs of 5 to 60 mm radius at random measured vertices;
means about the body's common level, in full where a reference set it, and differences of neighbours in that list.
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from thermofusion.files.tum import read_trajectory
from thermofusion.geometry.rays import RayScene
from thermofusion.geometry.rigid import rigid_alignment, transform_points
from thermofusion.regions import Brush, Measurer
from thermofusion.regions.patch import patch_of
from thermofusion.results.folder import load_temperature

REGIONS, RADII_M, SEED = 500, (0.005, 0.06), 7
ROUNDS, FAR_M = 12, 0.02  # of the fit to the true surface; what is farther from it is no body


def truth_on(out: Path, scan: Path, vertices_m: np.ndarray) -> np.ndarray:
    """The true temperature (V,), degC, at the surface nearest to each of vertices_m (V, 3), result fitted to truth."""
    with np.load(scan / "truth" / "surface.npz") as z:
        true = dict(z)
    ours, theirs = (read_trajectory(p / "trajectory.txt") for p in (out, scan / "truth"))
    j = np.abs(ours.times_s[:, None] - theirs.times_s).argmin(axis=1)
    T = rigid_alignment(ours.T_world_depth[:, :3, 3], theirs.T_world_depth[j, :3, 3])
    scene, points = RayScene(true["vertices_m"], true["triangles"]), transform_points(T, vertices_m)
    for k in range(ROUNDS):
        near = scene.closest(points)
        good = np.flatnonzero(near.distance < (0.03 if k < 4 else 0.012))[::7]
        points = transform_points(rigid_alignment(points[good], near.point_m[good]), points)
    near = scene.closest(points)
    value = (near.weights * true["temperature_degC"][true["triangles"][near.triangle]]).sum(axis=1)
    return np.where(near.distance < FAR_M, value, np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--seed", type=int, default=SEED)
    given = parser.parse_args()
    temperature = load_temperature(given.out)
    mesh, measurer = temperature.mesh, Measurer(temperature.mesh, temperature.shared)
    error = mesh.temperature_degC - truth_on(given.out, given.scan, mesh.surface.vertices_m.astype(np.float64))
    level, known = np.nanmedian(error), mesh.measured & np.isfinite(error)
    rng, body, found = np.random.default_rng(given.seed), measurer.body, []
    for vertex in rng.choice(np.flatnonzero(known), REGIONS):
        disc = Brush(points_m=[tuple(body.vertices_m[vertex])], normals=[tuple(body.normals[vertex])],
                     radius_m=rng.uniform(*RADII_M))  # fmt: skip
        patch = patch_of(disc, body, known)
        if len(patch.vertex):
            errors = measurer.errors.of_area(patch, float(patch.weight.sum()))
            found.append((float(patch.mean(np.nan_to_num(error))), errors))
    share = lambda z: f"{np.mean(np.abs(z) < 1.96):.1%}"  # noqa: E731
    relative = np.array([(e - level) / s.sigma_K for e, s in found])
    apart = [(a - b) / s.minus(t) for (a, s), (b, t) in pairwise(found)]
    print(f"{len(found)} regions: {share(relative)} about the common level, rms of error/sigma {relative.std():.2f}")
    print(f"differences: {share(np.array(apart))}")
    if mesh.anchored:
        print(f"absolute: {share(np.array([e / s.sigma_absolute_K for e, s in found]))}")


if __name__ == "__main__":
    sys.exit(main())
