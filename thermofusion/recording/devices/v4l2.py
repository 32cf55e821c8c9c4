"""Video nodes of USB cameras: found by vendor and product; raw pixels through OpenCV, vendor units through ioctl."""

from __future__ import annotations

import ctypes
import errno
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...errors import ResourceError
from ..device import UnpluggedError

NODES = Path("/sys/class/video4linux")
XU_QUERY = 0xC0107521  # UVCIOC_CTRL_QUERY of a 64-bit kernel: _IOWR('u', 0x21, struct uvc_xu_control_query)
SET_CUR, GET_CUR = 0x01, 0x81
NOTHING_S = 2.0  # a node that gives no frame for so long has lost its camera


class Capture(Protocol):
    """Where raw frames come from: a video node, or a simulated camera in tests."""

    def read(self) -> NDArray[np.uint8] | None:
        """The next frame's bytes (N,); None if there was none in time. Raises UnpluggedError."""

    def unit(self, unit: int, selector: int, data: bytes) -> None:
        """Set a control of an extension unit. Raises ResourceError."""

    def close(self) -> None:
        """Give the node back."""


def node_of(vendor: int, product: int, sysfs: Path = NODES) -> Path:
    """The first video node of a USB camera. Raises ResourceError where there is none."""
    for node in sorted(sysfs.glob("video*"), key=lambda p: (len(p.name), p.name)):
        with suppress(OSError, ValueError):
            usb = (node / "device").resolve().parent
            ids = tuple(int((usb / name).read_text(), 16) for name in ("idVendor", "idProduct"))
            if ids == (vendor, product) and (node / "index").read_text().strip() == "0":
                return Path("/dev") / node.name
    hint = "the kernel's uvcvideo driver makes it; look for it with `v4l2-ctl --list-devices`"
    raise ResourceError(f"the camera {vendor:04x}:{product:04x} has no video node", place=sysfs, hint=hint)


class _Query(ctypes.Structure):
    _fields_ = (
        ("unit", ctypes.c_uint8),
        ("selector", ctypes.c_uint8),
        ("query", ctypes.c_uint8),
        ("size", ctypes.c_uint16),
        ("data", ctypes.c_void_p),
    )


class VideoNode:
    """A video node, raw: width_px, height_px and fourcc as the camera names them."""

    def __init__(self, path: Path, width_px: int, height_px: int, fourcc: str) -> None:
        import cv2

        self._path, self._silent_since = path, time.monotonic()
        self._video: Any = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
        if not self._video.isOpened():
            raise ResourceError("the video node cannot be opened", place=path, hint="another program may have it open")
        code = cv2.VideoWriter_fourcc(*fourcc)  # type: ignore[attr-defined]
        wanted = {cv2.CAP_PROP_FOURCC: code, cv2.CAP_PROP_FRAME_WIDTH: width_px, cv2.CAP_PROP_FRAME_HEIGHT: height_px}
        wanted |= {cv2.CAP_PROP_CONVERT_RGB: 0, cv2.CAP_PROP_BUFFERSIZE: 1}
        for key, value in wanted.items():
            self._video.set(key, value)

    def read(self) -> NDArray[np.uint8] | None:
        """The next frame's bytes (N,). Raises UnpluggedError."""
        good, frame = self._video.read()
        if good and frame is not None:
            self._silent_since = time.monotonic()
            return np.ascontiguousarray(frame).view(np.uint8).ravel()
        if not self._path.exists() or time.monotonic() - self._silent_since > NOTHING_S:
            raise UnpluggedError("the video node gives no frames any more", place=self._path, hint="plug it in again")
        time.sleep(0.01)
        return None

    def unit(self, unit: int, selector: int, data: bytes) -> None:
        """Set a control of an extension unit. Raises ResourceError, UnpluggedError."""
        import fcntl

        buffer = ctypes.create_string_buffer(data, len(data))
        query = _Query(unit, selector, SET_CUR, len(data), ctypes.addressof(buffer))
        try:
            handle = os.open(self._path, os.O_RDWR | os.O_NONBLOCK)
            try:
                fcntl.ioctl(handle, XU_QUERY, query)
            finally:
                os.close(handle)
        except OSError as e:
            kind = UnpluggedError if e.errno == errno.ENODEV else ResourceError
            raise kind(f"unit {unit}, control {selector} cannot be set ({e.strerror})", place=self._path) from None

    def close(self) -> None:
        """Give the node back."""
        self._video.release()
