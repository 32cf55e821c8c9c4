"""Tracks a scan with its poses withheld and prints error and time.

    python tests/benchmarks/bench_tracking.py SCAN [--recipe torso] [--set key=value] [--frames N] [--every N]

Truth is SCAN/truth/trajectory.txt, else the recording's own poses; ATE after rigid alignment of positions.
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermofusion.files.tum import read_trajectory
from thermofusion.geometry import rigid as geometry
from thermofusion.recipe import load_recipe
from thermofusion.scans import open_scan
from thermofusion.tracking.track import track
from thermofusion.types import Stream, Trajectory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scan", type=Path)
    parser.add_argument("--recipe", default="torso")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE")
    parser.add_argument("--frames", type=int, help="only the first so many depth frames")
    parser.add_argument("--every", type=int, default=1, help="every so many frames of them, as a slower camera")
    parser.add_argument("--repeat", action="store_true", help="track twice and compare the poses")
    o = parser.parse_args()
    scan = open_scan(o.scan)
    truth_file = o.scan / "truth" / "trajectory.txt"
    truth = read_trajectory(truth_file) if truth_file.is_file() else scan.trajectory
    scan = replace(scan, trajectory=None, depth=some(scan.depth, o.frames, o.every))
    recipe = load_recipe(o.recipe, o.overrides)

    wall, cpu = time.perf_counter(), time.process_time()
    sections = {name: getattr(recipe, name) for name in ("input", "subject", "tracking")}
    result = track(scan, **sections)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    n = len(scan.depth)
    print(f"tracked      {int(result.tracked.sum())} of {n} frames, lost: {list(result.lost) or 'none'}")
    print(f"graph        {result.loop_closures} loop closures, converged: {result.converged}")
    if truth is not None:
        print(f"ATE          {1e3 * ate_m(result.trajectory, truth):.2f} mm rms")
    print(
        f"time         {wall:.2f} s ({1e3 * wall / n:.1f} ms a frame), CPU {cpu:.2f} s ({1e3 * cpu / n:.1f} ms a frame)"
    )
    print(f"peak memory  {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    for message in result.messages:
        print(f"message      {message}")
    if o.repeat:
        again = track(scan, **sections).trajectory.T_world_depth
        print(f"repeat       largest difference {np.abs(again - result.trajectory.T_world_depth).max():.1e}")


def some(stream: Stream, count: int | None, every: int) -> Stream:
    """The first frames of a stream, every so many of them."""
    pick = slice(0, count, every)
    at = range(len(stream))[pick]
    return Stream(
        stream.times_s[pick], lambda i: stream.load(at[i]), stream.places[pick], stream.index[pick], stream.usable[pick]
    )


def ate_m(estimate: Trajectory, truth: Trajectory) -> float:
    """RMS distance of positions after the best rigid alignment, over poses within 1 ms of each other."""
    j = np.abs(estimate.times_s[:, None] - truth.times_s[None]).argmin(1)
    near = np.abs(estimate.times_s - truth.times_s[j]) < 1e-3
    p, q = estimate.T_world_depth[near, :3, 3], truth.T_world_depth[j[near], :3, 3]
    T = geometry.rigid_alignment(p, q)
    return float(np.sqrt((((p @ T[:3, :3].T + T[:3, 3]) - q) ** 2).sum(1).mean()))


if __name__ == "__main__":
    main()
