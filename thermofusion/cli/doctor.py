"""What works on this machine: versions, the C library, memory, cameras on the bus and the right to open them."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from dataclasses import dataclass
from typing import Literal

from ..errors import ResourceError

PACKAGES = (
    "open3d",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "pillow",
    "pyusb",
    "libusb-package",
    "pydantic",
)
MIN_MEMORY_GIB = 4.0


@dataclass(frozen=True)
class Examined:
    """One line of the examination."""

    subject: str
    status: Literal["ok", "warning", "problem"]
    text: str


def examine() -> list[Examined]:
    """All findings, cheapest first. Never raises: what cannot be examined is itself a finding."""
    return [_python(), _libc(), *_packages(), _open3d(), _memory(), *_usb()]


def _python() -> Examined:
    ok = sys.version_info >= (3, 11)
    return Examined("python", "ok" if ok else "problem", f"{platform.python_version()} on {platform.platform()}")


def _libc() -> Examined:
    if platform.system() != "Linux":
        return Examined("libc", "ok", f"{platform.system()}: wheels bring their own; not tested here by the developers")
    name, version = platform.libc_ver()
    return Examined(
        "libc", "ok" if name else "warning", f"{name} {version}" if name else "not glibc: wheels may not fit"
    )


def _packages() -> list[Examined]:
    found = []
    for name in PACKAGES:
        try:
            found.append(Examined(name, "ok", importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            found.append(Examined(name, "problem", f"not installed; run `pip install {name}`"))
    return found


def _open3d() -> Examined:
    try:
        from ..geometry._open3d import o3d
    except Exception as e:  # a wheel that does not load raises OSError, ImportError and others
        return Examined("open3d loads", "problem", f"{type(e).__name__}: {e}")
    return Examined(
        "open3d loads", "ok", f"CPU; CUDA {'available' if o3d.core.cuda.is_available() else 'not available'}"
    )


def _memory() -> Examined:
    try:
        gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf, macOS not every name
        return Examined("memory", "ok", f"size unknown on this system, {os.cpu_count()} cores; 4 GiB are wanted")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return Examined("memory", "ok" if gib >= MIN_MEMORY_GIB else "warning", f"{gib:.1f} GiB, {cores} cores")


def _usb() -> list[Examined]:
    from ..recording.devices import KNOWN
    from ..recording.usb import may_open, usb_devices

    try:
        devices = usb_devices()
    except ResourceError as e:
        return [Examined("usb", "warning", f"{e.cause}; recording will not work")]
    found = []
    for device in devices:
        name = KNOWN.get((device.idVendor, device.idProduct))
        if name is None:
            continue
        allowed = may_open(device)
        hint = "" if allowed else "; no permission to open it: `thermofusion doctor --udev FILE` writes the rule"
        found.append(Examined("usb", "ok" if allowed else "problem", f"{name} at {device.bus}:{device.address}{hint}"))
    return found or [Examined("usb", "ok", f"{len(devices)} devices on the bus, no camera known to thermofusion")]
