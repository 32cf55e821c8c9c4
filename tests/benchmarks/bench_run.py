"""Times whole runs as a user starts them: process start to files written, with peak memory; against another version.

    python tests/benchmarks/bench_run.py SCAN [-r RECIPE] [--set section.key=value ...] [--against TREE] [--repeat 3]

`tracking.source=estimate` withholds a recorded trajectory. --against : another version's folder, run in turn with this
one; CPU (user + system) is what a busy machine stretches least. The first run of a version compiles its loops: it is
not counted.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parents[2]


def timed(tree: Path, arguments: list[str]) -> tuple[dict[str, float], str]:
    """Seconds and GiB of one run of a version; what it told."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "thermofusion", "run", *arguments, "-o", f"{folder}/out"]
        start = time.monotonic()
        with Path(folder, "told").open("w+", encoding="utf-8") as told:
            place = os.environ | {"PYTHONPATH": str(tree), "PYTHONSAFEPATH": "1"}
            process = subprocess.Popen(command, env=place, stdout=subprocess.DEVNULL, stderr=told)
            _, status, usage = os.wait4(process.pid, 0)
            told.seek(0)
            text = told.read()
        if os.waitstatus_to_exitcode(status) not in (0, 4):
            sys.exit(text)
    cpu = usage.ru_utime + usage.ru_stime
    return {"wall_s": time.monotonic() - start, "cpu_s": cpu, "GiB": usage.ru_maxrss / 2**20}, text


def main() -> None:
    """Print what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan")
    parser.add_argument("-r", "--recipe", default="torso")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--against", type=Path)
    parser.add_argument("--repeat", type=int, default=1)
    given = parser.parse_args()
    arguments = [str(Path(given.scan).resolve()), "-r", given.recipe]
    arguments += [word for item in given.set for word in ("--set", item)]
    trees = [HERE, *([given.against.resolve()] if given.against else [])]
    for tree in trees:
        print(timed(tree, arguments)[1], end="")
    runs = [[timed(tree, arguments)[0] for tree in trees] for _ in range(given.repeat)]
    found = [{k: statistics.median(run[n][k] for run in runs) for k in runs[0][n]} for n in range(len(trees))]
    for tree, figures in zip(trees, found, strict=True):
        print(f"{tree}: " + ", ".join(f"{k} {v:.2f}" for k, v in figures.items()))
    if given.against:
        print("ratio: " + ", ".join(f"{k} {found[0][k] / found[1][k]:.2f}" for k in found[0]))


if __name__ == "__main__":
    main()
