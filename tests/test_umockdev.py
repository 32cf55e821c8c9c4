"""Simulated cameras under the real libusb (umockdev), with libfreenect as a referee; skipped where they are missing."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from support import fake_usb

from thermofusion.files.pnm import read_pnm

SYSTEM = Path("/usr/bin/python3")
FRAMES = 30


def has_umockdev():
    code = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    wrapped = shutil.which("umockdev-wrapper") and SYSTEM.exists()
    return bool(wrapped) and subprocess.run([SYSTEM, "-c", code], capture_output=True, check=False).returncode == 0


pytestmark = pytest.mark.skipif(
    not has_umockdev(), reason="umockdev is not installed (apt install umockdev gir1.2-umockdev-1.0 python3-gi)"
)

CLIENT = """
import sys
import time
import numpy as np
from thermofusion.recording.devices import cameras
device = cameras()[0].open()
if hasattr(device, "_wait"):
    device._wait = lambda seconds: None
device.start()
streams = [s.name for s in device.streams]
seen = {name: [] for name in streams}
wanted, lost = int(sys.argv[2]), 0
until = time.monotonic() + 40
while time.monotonic() < until:
    for frame in device.read():
        seen[streams[frame.stream]].append(bytes(frame.data))
        lost += frame.lost
    if all(len(v) >= wanted for k, v in seen.items() if not k.endswith("gravity")):
        break
device.stop()
device.stop()
np.savez(sys.argv[1], lost=lost, **{k.replace("/", "_"): np.array([np.frombuffer(f, np.uint8) for f in v])
                                     for k, v in seen.items()})
"""


def beside(kind, data, *command, timeout_s=60):
    """What a command says that runs with the simulated camera on its bus."""
    simulator = ROOT / "tests" / "support" / "umock_camera.py"
    return subprocess.run(
        ["umockdev-wrapper", SYSTEM, simulator, kind, data, *command],
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


@pytest.fixture(scope="module")
def kinect(tmp_path_factory):
    """The bytes of a simulated Kinect, and what is in them."""
    folder, camera = tmp_path_factory.mktemp("kinect"), fake_usb.SimulatedKinect()
    depth = [camera.disparity(k) for k in range(FRAMES)]
    color = [camera.bayer(k) for k in range(FRAMES)]
    (folder / "depth.bin").write_bytes(b"".join(fake_usb.packed(d, 11) for d in depth))
    (folder / "video.bin").write_bytes(b"".join(c.tobytes() for c in color))
    return folder, np.array(depth), np.array(color)


def test_kinect_frames_come_bit_for_bit_through_libusb(kinect, tmp_path):
    folder, depth, color = kinect
    answer = beside("kinect", folder, sys.executable, "-c", CLIENT, tmp_path / "seen.npz", str(FRAMES))
    assert answer.returncode == 0, answer.stderr[-2000:]
    with np.load(tmp_path / "seen.npz") as seen:
        np.testing.assert_array_equal(seen["kinect_disparity"].view("<u2"), depth)
        np.testing.assert_array_equal(seen["kinect_color"], color)
        assert seen["lost"] == 0
        assert seen["kinect_gravity"].view(np.float64)[0].tolist() == [0, 1, 0]


UNPLUGGED = """
import sys, time
from thermofusion.recording.device import UnpluggedError
from thermofusion.recording.devices import cameras
device = cameras()[0].open()
if hasattr(device, "_wait"):
    device._wait = lambda seconds: None
device.start()
whole, until = 0, time.monotonic() + 20
try:
    while time.monotonic() < until:
        whole += sum(f.stream == 0 for f in device.read())
except UnpluggedError as e:
    begun = time.monotonic()
    device.stop()
    print(whole, round(time.monotonic() - begun, 1), e)
"""


@pytest.mark.parametrize("kind", ["kinect", "p3"])
def test_unplugged_in_mid_frame_is_said_and_ends(kind, kinect, tmp_path):
    for name in ("depth.bin", "video.bin"):
        (tmp_path / name).symlink_to(kinect[0] / name)
    camera = fake_usb.SimulatedP3()
    (tmp_path / "stream.bin").write_bytes(b"".join(camera._bytes() for _ in range(FRAMES)))
    (tmp_path / "unplug").write_text("60")
    answer = beside(kind, tmp_path, sys.executable, "-c", UNPLUGGED)
    whole, stopping_s, said = answer.stdout.split(" ", 2)
    assert "the device has gone from the bus" in said
    assert 0 < int(whole) < FRAMES
    assert float(stopping_s) < 2


def test_libfreenect_sees_the_same_depth(kinect, tmp_path):
    if shutil.which("fakenect-record") is None:
        pytest.skip("fakenect-record is not installed (apt install libfreenect-bin)")
    folder, depth, _ = kinect
    command = ["timeout", "-s", "INT", "3", "fakenect-record", str(tmp_path / "taken")]
    beside("kinect", folder, *command)
    files = sorted((tmp_path / "taken").glob("d-*.pgm"))
    taken = [read_pnm(f.read_bytes(), place=f, byteorder="<").ravel() for f in files]
    assert len(taken) >= 3, len(taken)
    numbers = [next((k for k, d in enumerate(depth) if np.array_equal(d, image)), None) for image in taken]
    assert None not in numbers
    assert numbers == sorted(numbers)


def test_p3_frames_come_bit_for_bit_through_libusb(tmp_path):
    camera = fake_usb.SimulatedP3()
    planes = [camera.frame(k) for k in range(FRAMES)]
    stream = b"".join(camera._bytes() for _ in range(FRAMES))
    (tmp_path / "stream.bin").write_bytes(stream)
    answer = beside("p3", tmp_path, sys.executable, "-c", CLIENT, tmp_path / "seen.npz", str(FRAMES - 1))
    assert answer.returncode == 0, answer.stderr[-2000:]
    with np.load(tmp_path / "seen.npz") as seen:
        np.testing.assert_array_equal(seen["infiray_thermal"].view("<u2"), [p.ravel() for p in planes[:-1]])
