"""What a batch costs, and what killing its workers costs.

    python tests/benchmarks/bench_batch.py efficiency --scans 16
    python tests/benchmarks/bench_batch.py kills --kills 20
    python tests/benchmarks/bench_batch.py cluster --scans 2000
    python tests/benchmarks/bench_batch.py restart

efficiency : the demo scan many times over: `run` one after another, then `batch` with one worker and with two.
(Time of the single runs) / (time of the batch x workers that the cores can feed); processor time beside it.
kills : a batch of small scans, a worker killed (SIGKILL) at a random moment, `--kills` times; all results are compared
with single runs', bit for bit. cluster : Dask's cluster of eight workers on this machine, scans replaced by sleep.
restart : a scheduler with a worker that are both killed in mid-batch and started again.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

from thermofusion.batch.batch import Crew, run_batch
from thermofusion.batch.job import Row
from thermofusion.batch.scans import Source
from thermofusion.recipe import load_recipe

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = [sys.executable, "-m", "thermofusion"]
SLEEP_S = 0.1


def timed(*commands: list[str]) -> tuple[float, float]:
    """(wall, user + system) seconds of commands, one after another."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    for command in commands:
        subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.monotonic() - start, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def efficiency(folder: Path, count: int) -> None:
    """Single runs against batches."""
    scans = folder / "scans"
    for k in range(count):
        shutil.copytree(ROOT / "data" / "demo", scans / f"{k:02d}", ignore=shutil.ignore_patterns("truth"))
    single = timed(*([*PROGRAM, "run", str(s), "-o", str(folder / "single" / s.name)] for s in sorted(scans.iterdir())))
    print(f"{count} single runs: {single[0]:.1f} s, processor {single[1]:.1f} s")
    for workers in (1, 2):
        out = folder / f"batch{workers}"
        wall, cpu = timed([*PROGRAM, "batch", str(scans), "-o", str(out), "--workers", str(workers)])
        rows = json.loads((out / "batch.json").read_text())["scans"]
        same = all(digests(out / r["name"]) == digests(folder / "single" / r["name"]) for r in rows)
        peaks = [r["peak_GiB"] for r in rows]
        print(
            f"batch, {workers} workers: {wall:.1f} s, processor {cpu:.1f} s; wall {single[0] / wall:.2f} x, "
            f"processor {single[1] / cpu:.2f} x of the single runs'; worker's peak {peaks[0]:.2f} GiB at the first, "
            f"{peaks[-1]:.2f} at the last scan; results {'equal bit for bit' if same else 'DIFFER'}"
        )


def digests(result: Path) -> dict[str, str]:
    """SHA-256 of what a result says; result.json without which stages were taken from where."""
    files = {n: (result / n).read_bytes() for n in ("mesh.ply", "mesh.glb", "trajectory.txt") if (result / n).is_file()}
    report = json.loads((result / "result.json").read_text())
    report.pop("stages_reused")
    files["result.json"] = json.dumps(report, sort_keys=True).encode()
    return {name: sha256(data).hexdigest() for name, data in files.items()}


def small_scans(folder: Path, count: int) -> list[str]:
    """Scans of a small sphere; returns the options of a recipe for them."""
    from thermofusion.phantom import load_scene, simulate

    scene = load_scene("sphere")
    walk, depth = replace(scene.walk, depth_frames=12, depth_hz=3.0), replace(scene.depth, scale=0.25)
    thermal = replace(scene.thermal, scale=0.25, every=1)
    for seed in range(count):
        simulate(replace(scene, walk=walk, depth=depth, thermal=thermal, color=None), folder / f"s{seed}", seed=seed)
    keys = ("surface.voxel_mm=10", "tracking.fragment_frames=3", "quality.min_coverage=0", "output.views=false")
    return [word for key in keys for word in ("--set", key)]


def workers_of(pid: int) -> list[int]:
    """Processes that a batch has started for scans."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"spawn_main" in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
    return found


def killed_once(command: list[str], after_s: float, chance: random.Random) -> tuple[int, bool, float]:
    """A batch of which one worker is killed: (exit code, whether there was one to kill, its wall time)."""
    start = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(after_s)
    victims = workers_of(process.pid) if process.poll() is None else []
    if victims:
        os.kill(chance.choice(victims), signal.SIGKILL)
    return process.wait(), bool(victims), time.monotonic() - start


def kills(folder: Path, count: int) -> None:
    """A worker is killed at a random moment of each batch; a batch that was over by then does not count."""
    options = small_scans(folder / "scans", 3)
    names = sorted(p.name for p in (folder / "scans").iterdir())
    for name in names:
        timed([*PROGRAM, "run", str(folder / "scans" / name), *options, "-o", str(folder / "single" / name)])
    expected = {name: digests(folder / "single" / name) for name in names}
    out = folder / "out"
    command = [*PROGRAM, "batch", str(folder / "scans"), *options, "-o", str(out), "--workers", "2"]
    whole, _ = timed(command)
    chance, good, hit, attempts, rounds = random.Random(0), 0, 0, 0, 0
    while hit < count and rounds < 3 * count:
        rounds += 1
        shutil.rmtree(out)
        after_s = chance.uniform(0.1, 0.95) * whole
        code, killed, wall = killed_once(command, after_s, chance)
        whole = whole if killed else wall  # the machine is busier at one time than at another
        if not killed:
            continue
        hit += 1
        rows = json.loads((out / "batch.json").read_text())["scans"]
        again = sum(r["attempts"] for r in rows) - len(rows)
        attempts += again
        same = all(digests(out / name) == expected[name] for name in names)
        good += code == 0 and same
        told = "equal" if same else "DIFFERENT"
        print(f"{hit}/{count}: after {after_s:.1f} s, {again} begun again, exit {code}, {told}", flush=True)
    print(f"{good} of {hit} batches whole and equal bit for bit; {attempts} killed in mid-scan")


def sleeps(job):
    """A scan that takes `SLEEP_S`."""
    time.sleep(SLEEP_S)
    return replace(Row.of(job.source), status="good", exit_code=0, figures={"median_degC": 33.0, "coverage": 0.9})


def cluster(folder: Path, count: int, scheduler: str = "local") -> None:
    """The scheduler's overhead, and its memory."""
    sources = [Source(f"s{k:04d}", f"/nowhere/s{k}", "") for k in range(count)]
    memory, workers = [], 8

    def heard(row, done, total, left_s):
        if done in (count // 4, count // 2, 3 * count // 4, count):
            rss = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20
            memory.append(f"{rss:.0f} MiB after {done}")

    start = time.monotonic()
    rows = run_batch(sources, load_recipe("torso"), str(folder), Crew(workers, 1, scheduler), work=sleeps, tell=heard)
    wall = time.monotonic() - start
    ideal = count * SLEEP_S / workers
    print(
        f"{count} scans of {SLEEP_S} s, {workers} workers ({scheduler or 'processes'}): {wall:.1f} s, "
        f"{1e3 * (wall - ideal) / count:.1f} ms a scan over the ideal {ideal:.1f} s; scheduler {', '.join(memory)}; "
        f"{sum(r.status == 'good' for r in rows)} good"
    )


def restart(folder: Path) -> None:
    """Scheduler and worker are killed in mid-batch and come back at the same address."""
    options = small_scans(folder / "scans", 4)
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}

    def start() -> list[subprocess.Popen]:
        dask = [sys.executable, "-m", "distributed.cli"]
        first = [
            *dask[:2],
            "distributed.cli.dask_scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            str(port),
            "--no-dashboard",
        ]
        second = [*dask[:2], "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
        return [subprocess.Popen(first, **quiet), subprocess.Popen([*second, "--death-timeout", "20"], **quiet)]

    running = start()
    out = folder / "out"
    command = [*PROGRAM, "batch", str(folder / "scans"), *options, "-o", str(out), "--scheduler", address]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        print(line, end="")
        if line.startswith("1/4"):
            break
    for p in running:
        p.kill()
    time.sleep(2)
    running = start()
    print(process.stderr.read(), end="")
    print(f"exit {process.wait()}; {json.loads((out / 'batch.json').read_text())['counts']}")
    for p in running:
        p.terminate()


def main() -> None:
    """One of the measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("efficiency", "kills", "cluster", "restart"))
    parser.add_argument("--scans", type=int, default=16)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--scheduler", default="local")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench-batch-") as place:
        folder = Path(place)
        if asked.what == "efficiency":
            efficiency(folder, asked.scans)
        elif asked.what == "kills":
            kills(folder, asked.kills)
        elif asked.what == "cluster":
            cluster(folder, asked.scans, asked.scheduler)
        else:
            restart(folder)


if __name__ == "__main__":
    main()
