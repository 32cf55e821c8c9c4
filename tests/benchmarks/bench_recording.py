"""The load of a recording, and what crashes cost.

    python tests/benchmarks/bench_recording.py load --seconds 120 --folder /tmp/bench
    python tests/benchmarks/bench_recording.py crash --kills 50

load : a Kinect's depth and colour and one 640x480x16 thermal stream at 30 Hz, played from a recording made here, in
real time. CPU is that of all processes, in cores (1 = one core), measured between the first and the last second.
crash : a recording is killed at random moments; what the device had delivered is compared with what is read back.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from test_recording import killed  # noqa: E402

from thermofusion.files import ros  # noqa: E402
from thermofusion.files.mcap import McapWriter, Message  # noqa: E402
from thermofusion.scans import open_scan  # noqa: E402

RATE_HZ = os.sysconf("SC_CLK_TCK")  # clock ticks a second


def source(folder: Path, seconds: float) -> None:
    """A recording as a Kinect and a thermal camera would leave it, frames as noisy as theirs."""
    folder.mkdir(parents=True)
    writer = McapWriter(folder / "recording.mcap", "ros2", "thermofusion bench")
    writer.metadata("thermofusion", {"start_ns": str(10**18)})
    rng = np.random.default_rng(1)
    depth = (700 + rng.integers(0, 3, (8, 480, 640))).astype("<u2")
    bayer = rng.integers(90, 120, (8, 480, 640)).astype(np.uint8)
    thermal = (19_000 + rng.integers(0, 40, (8, 480, 640))).astype("<u2")
    K = [[580.0, 0, 319.5], [0, 580, 239.5], [0, 0, 1]]
    kinds = [("kinect/disparity", "depth", "mono16", depth), ("kinect/color", "color", "bayer_grbg8", bayer)]
    channels = []
    for topic, kind, encoding, images in [*kinds, ("cam/thermal", "thermal", "mono16", thermal)]:
        said = {"kind": kind, "device": topic.split("/")[0], "width_px": "640", "height_px": "480", "tick_hz": "1e6"}
        said["thermofusion"] = json.dumps({"K": K})
        image = writer.channel(topic, ros.IMAGE, ros.DEFINITIONS[ros.IMAGE], said)
        info = writer.channel(f"{topic}/info", ros.FRAME_INFO, ros.DEFINITIONS[ros.FRAME_INFO], {})
        pack = ros.ImagePacker(topic, 640, 480, encoding, 640 * images.itemsize)
        channels.append((image, info, pack, [i.tobytes() for i in images]))
    for k in range(int(30 * seconds)):
        now = 10**18 + int(k / 30 * 1e9)
        for image, info, pack, images in channels:
            data = images[k % 8]
            said = ros.FrameInfo(now, int(k / 30 * 1e6), k, 0, zlib.crc32(data), False, float("nan")).packed("x")
            writer.write([Message(info, now, k, (said,)), Message(image, now, k, pack.pieces(now, data))])
    writer.close()


def family(pid: int) -> list[int]:
    """A process and its children."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    return [pid, *(p for c in children.read_text().split() for p in family(int(c)))] if children.exists() else [pid]


def used(pid: int) -> tuple[float, float]:
    """(CPU seconds, private memory MiB) of a process and its children so far."""
    cpu = memory = 0.0
    for p in family(pid):
        try:
            fields = Path(f"/proc/{p}/stat").read_text().rpartition(")")[2].split()
            rollup = Path(f"/proc/{p}/smaps_rollup").read_text()
        except OSError:
            continue
        cpu += (int(fields[11]) + int(fields[12])) / RATE_HZ
        memory += sum(int(line.split()[1]) for line in rollup.splitlines() if line.startswith("Pss:")) / 1024
    return cpu, memory


def load(folder: Path, seconds: float) -> None:
    """Prints frames lost, cores used, memory over time."""
    shutil.rmtree(folder, ignore_errors=True)
    source(folder / "source", seconds)
    os.sync()  # the disk is not still busy with it
    command = [sys.executable, "-m", "thermofusion", "record", "--from", str(folder / "source")]
    process = subprocess.Popen([*command, "-o", str(folder / "out"), "--json"], stdout=subprocess.PIPE, text=True)
    rows = []
    while process.poll() is None:
        time.sleep(1)
        if (folder / "out" / "recording.mcap").exists():
            rows.append((time.monotonic(), *used(process.pid)))
    answer = json.loads(process.communicate()[0])
    steady = [
        r for r in rows if rows[0][0] + 12 < r[0] < rows[-1][0] - 6
    ]  # rings have gone round once, no process ends
    cores = (steady[-1][1] - steady[0][1]) / (steady[-1][0] - steady[0][0])
    memory = [r[2] for r in steady]
    print(json.dumps({"streams": answer["streams"], "problems": answer["problems"]}))
    over = steady[-1][0] - steady[0][0]
    print(f"cores {cores:.2f}, memory {min(memory):.0f} to {max(memory):.0f} MiB over {over:.0f} s")
    shutil.rmtree(folder)


def crash(folder: Path, kills: int) -> None:
    """Prints what the kills cost, s of frames."""
    chance, costs, wrong = random.Random(50), [], 0
    for k in range(kills):
        out = folder / f"{k}"
        made_ns = killed(out, chance.uniform(0.3, 2.5))
        scan = open_scan(out)
        wrong += scan.depth.index.tolist() != list(range(len(scan.depth)))
        wrong += not any("breaks off after" in n for n in scan.notes)
        costs.append((made_ns[-1] - made_ns[len(scan.depth) - 1]) * 1e-9)
        shutil.rmtree(out)
    print(f"{kills} kills: lost {np.median(costs):.2f} s (median), {max(costs):.2f} s at most; {wrong} read wrongly")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("load", "crash"))
    parser.add_argument("--seconds", type=float, default=40)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--folder", type=Path, default=Path("/tmp/bench-recording"))
    given = parser.parse_args()
    load(given.folder, given.seconds) if given.what == "load" else crash(given.folder, given.kills)
