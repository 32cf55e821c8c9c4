"""Times a whole run as a user starts it: process start to files written, split by stage, with peak memory.

    python tests/benchmarks/bench_run.py SCAN [-r RECIPE] [--set section.key=value ...]

`tracking.source=estimate` withholds a recorded trajectory.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("scan")
parser.add_argument("-r", "--recipe", default="torso")
parser.add_argument("--set", action="append", default=[])
options = parser.parse_args()

with tempfile.TemporaryDirectory() as out:
    command = [sys.executable, "-m", "thermofusion", "run", options.scan, "-r", options.recipe, "-o", out]
    for item in options.set:
        command += ["--set", item]
    start = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall_s = time.monotonic() - start
if done.returncode not in (0, 4):
    sys.exit(done.stderr)
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
for line in done.stderr.splitlines():
    print(line)
print(f"wall {wall_s:.1f} s, user {usage.ru_utime:.1f} s, system {usage.ru_stime:.1f} s")
print(f"peak memory {usage.ru_maxrss / 2**20:.2f} GiB")
