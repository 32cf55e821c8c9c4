"""How often a region's interval holds the true mean: `python tests/benchmarks/region_coverage.py OUT SCAN`.

OUT : a result of the simulated SCAN, whose truth/ it reads. 500 discs of 5 to 60 mm radius at random measured vertices;
means about the body's common level, in full where a reference set it, and differences of neighbours in that list.

A simulation has some inputs exactly as the recipe states them: their terms cannot show in the error, yet belong into
sigma. "stated inputs drawn" gives them errors of their stated size, each draw one for the whole body, and takes the
mean coverage over the draws: what the intervals are worth where inputs are as uncertain as is said. Then follows the
share of sigma² by part, and the coverage without it.
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
from thermofusion.regions.errors import MeanErrors
from thermofusion.regions.patch import patch_of
from thermofusion.results.folder import load_temperature

REGIONS, RADII_M, SEED = 500, (0.005, 0.06), 7
# Inputs that `simulate` has as stated, unless a scene says otherwise.
STATED, DRAWS = ("gain", "emissivity0", "path", "operator", "scatter"), 400
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


def parts(error_K: np.ndarray, errors: list[MeanErrors]) -> None:
    """What each part of sigma is worth; error_K (N,) about the common level."""
    sigma_K = np.array([e.sigma_K for e in errors])
    budgets = [e.budget_K for e in errors]
    common_K = np.array([e.common_K for e in errors])
    drawn = [k for k, name in enumerate(errors[0].names) if name.split()[0] in STATED]
    z = np.random.default_rng(SEED).standard_normal((DRAWS, len(drawn)))
    inside = np.abs(error_K + z @ common_K[:, drawn].T) < 1.96 * sigma_K
    names = ", ".join(sorted({errors[0].names[k].split()[0] for k in drawn}))
    print(f"stated inputs drawn ({names}): {inside.mean():.1%}")
    for name in sorted({k for b in budgets for k in b}):
        part = np.array([b.get(name, 0.0) for b in budgets])
        without = np.sqrt(np.maximum(sigma_K**2 - part**2, 1e-12))
        share = float(np.mean(part**2 / sigma_K**2))
        print(f"  {name:<13} {share:5.1%} of sigma^2; without it {np.mean(np.abs(error_K) < 1.96 * without):.1%}")


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
    parts(np.array([e - level for e, _ in found]), [s for _, s in found])
    apart = [(a - b) / s.minus(t) for (a, s), (b, t) in pairwise(found)]
    print(f"{len(found)} regions: {share(relative)} about the common level, rms of error/sigma {relative.std():.2f}")
    print(f"differences: {share(np.array(apart))}")
    if mesh.anchored:
        print(f"absolute: {share(np.array([e / s.sigma_absolute_K for e, s in found]))}")


if __name__ == "__main__":
    sys.exit(main())
