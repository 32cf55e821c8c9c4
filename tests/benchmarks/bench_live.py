"""How long after the last frame the result of a recording that is followed stands, and whether it is the offline one.

    python tests/benchmarks/bench_live.py SCAN -r full-body --seconds 30 --folder /tmp/bench [--against TREE]

SCAN is played in real time by `record --from` and followed by `run --follow`. Prints seconds and CPU of `run` from the
last frame to its end, and how far the result is from the one that `run` makes of the finished recording: of surface
(mm, to the nearest vertex) and temperature (K), 95 of 100 vertices. --against : another version's folder, which follows
the same scan afterwards.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

HERE = Path(__file__).resolve().parents[2]
TICKS = os.sysconf("SC_CLK_TCK")


def started(tree: Path, *args: object) -> subprocess.Popen[bytes]:
    """The command of a version."""
    command = [sys.executable, "-m", "thermofusion", *map(str, args)]
    return subprocess.Popen(
        command, env=os.environ | {"PYTHONPATH": str(tree), "PYTHONSAFEPATH": "1"}, stderr=subprocess.DEVNULL
    )


def cpu_s(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def finished(process: subprocess.Popen[bytes]) -> float:
    """CPU of a process, once it has ended."""
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) not in (0, 4):
        raise SystemExit("a command failed")
    return usage.ru_utime + usage.ru_stime


def followed(tree: Path, scan: Path, recipe: str, seconds: float, folder: Path) -> dict[str, float]:
    """A scan played and followed by a version."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    recording, out = folder / "recording", folder / "followed"
    record = started(HERE, "record", "-o", recording, "--from", scan, "--seconds", seconds, "--json")
    run = started(tree, "run", "--follow", recording, "-r", recipe, "-o", out, "--json")
    finished(record)
    last, before = time.monotonic(), cpu_s(run.pid)
    whole = finished(run)
    figures = {"seconds": time.monotonic() - last, "cpu_s": whole - before, "cpu_while_recording_s": before}
    offline = started(tree, "run", recording, "-r", recipe, "-o", folder / "offline", "--json")
    return {**figures, "cpu_offline_s": finished(offline)} | apart(out, folder / "offline")


def apart(one: Path, other: Path) -> dict[str, float]:
    """How far two results are from each other."""
    sys.path.insert(0, str(HERE))
    from thermofusion.pipeline import load_mesh

    a, b = load_mesh(one), load_mesh(other)
    off_m, nearest = cKDTree(b.surface.vertices_m).query(a.surface.vertices_m)
    off_K = np.abs(a.temperature_degC - b.temperature_degC[nearest])
    known = np.isfinite(off_K)
    return {"p95_mm": 1e3 * float(np.percentile(off_m, 95)), "p95_K": float(np.percentile(off_K[known], 95))}


def main() -> None:
    """Print what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("-r", "--recipe", default="torso")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--against", type=Path)
    given = parser.parse_args()
    for tree in [HERE, *([given.against] if given.against else [])]:
        figures = followed(tree, given.scan, given.recipe, given.seconds, given.folder)
        print(json.dumps({"tree": str(tree), **{k: round(v, 3) for k, v in figures.items()}}), flush=True)


if __name__ == "__main__":
    main()
