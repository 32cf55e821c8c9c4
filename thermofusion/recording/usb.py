"""The one door to the USB bus: pyusb on the libusb that `libusb-package` brings, and writes that pass an allow-list."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import libusb_package
import usb.core
import usb.util

from ..errors import ResourceError
from .device import UnpluggedError

CONTROL_MS = 1000  # time for a control transfer
UNPLUGGED = (errno.ENODEV, errno.EIO, errno.ESHUTDOWN, errno.ENOENT)  # what libusb reports of a device that has gone
TO_HOST = 0x80  # bit of bmRequestType and of an endpoint's address
UDEV_HINT = "`thermofusion doctor --udev FILE` writes the rule that allows it"


class RefusedWriteError(ResourceError):
    """A write that no rule allows: a fault of the program, never sent."""


@dataclass(frozen=True)
class Allowed:
    """A kind of control transfer that may be sent: request type, request, and what its value, index and data may be."""

    request_type: int
    request: int
    accepts: Callable[[int, int, bytes], bool]


def only(*payloads: bytes, values: tuple[int, ...] = (0,), indices: tuple[int, ...] = (0,)) -> Callable:
    """A judge for `Allowed`: the data is one of the payloads, value and index are among those named."""
    return lambda value, index, data: value in values and index in indices and data in payloads


class Guarded:
    """A USB device whose writes pass an allow-list. Reads are free; standard requests go through pyusb's own calls."""

    def __init__(self, device: Any, allowed: tuple[Allowed, ...], bulk: Callable[[int, bytes], bool] | None = None):
        self.device, self._allowed, self._bulk = device, allowed, bulk
        self.name = f"{device.idVendor:04x}:{device.idProduct:04x} at {device.bus}:{device.address}"
        self._claimed: list[int] = []

    def write(self, request_type: int, request: int, value: int = 0, index: int = 0, data: bytes = b"") -> None:
        """A control transfer to the device. Raises RefusedWriteError for what no rule allows."""
        if request_type & TO_HOST:
            raise RefusedWriteError("a read was given as a write", place=self.name)
        rules = [r for r in self._allowed if (r.request_type, r.request) == (request_type, request)]
        if not any(r.accepts(value, index, data) for r in rules):
            text = f"{request_type:02x}/{request:02x} value {value:04x} index {index:04x} with {len(data)} bytes"
            raise RefusedWriteError(f"a write that is not known to be safe was not sent ({text})", place=self.name)
        self._call(self.device.ctrl_transfer, request_type, request, value, index, data, CONTROL_MS)

    def read(self, request_type: int, request: int, value: int = 0, index: int = 0, length: int = 512) -> bytes:
        """A control transfer from the device; b"" where it did not answer in time."""
        return self._call(self.device.ctrl_transfer, request_type | TO_HOST, request, value, index, length, CONTROL_MS)

    def bulk_write(self, endpoint: int, data: bytes) -> None:
        """A bulk transfer to the device. Raises RefusedWriteError for what the device's own judge refuses."""
        if endpoint & TO_HOST or self._bulk is None or not self._bulk(endpoint, data):
            raise RefusedWriteError(f"a bulk write of {len(data)} bytes was not sent", place=self.name)
        self._call(self.device.write, endpoint, data, CONTROL_MS)

    def bulk_read(self, endpoint: int, length: int, timeout_ms: int) -> bytes:
        """A bulk transfer from the device; b"" where nothing came in time."""
        return self._call(self.device.read, endpoint | TO_HOST, length, timeout_ms)

    def claim(self, *interfaces: int) -> None:
        """Take interfaces over, from the kernel's driver too."""
        for i in interfaces:
            with suppress(NotImplementedError, usb.core.USBError):
                if self.device.is_kernel_driver_active(i):
                    self.device.detach_kernel_driver(i)
            self._call(usb.util.claim_interface, self.device, i)
            self._claimed.append(i)

    def alternate(self, interface: int, setting: int) -> None:
        """Choose an alternate setting of an interface."""
        self._call(self.device.set_interface_altsetting, interface, setting)

    def release(self) -> None:
        """Give everything back. Never raises."""
        for i in self._claimed:
            with suppress(Exception):
                usb.util.release_interface(self.device, i)
            with suppress(Exception):
                self.device.attach_kernel_driver(i)
        self._claimed.clear()
        with suppress(Exception):
            usb.util.dispose_resources(self.device)

    def _call(self, function: Callable, *arguments: Any) -> bytes:
        try:
            answer = function(*arguments)
        except usb.core.USBTimeoutError:
            return b""
        except usb.core.USBError as e:
            raise as_ours(e, self.name) from None
        except (NotImplementedError, ValueError) as e:  # pyusb's own, for what the descriptors do not have
            raise ResourceError(f"it has not what its kind should have ({e})", place=self.name) from None
        return bytes(answer) if answer is not None and not isinstance(answer, int) else b""


def as_ours(e: usb.core.USBError, place: object) -> ResourceError:
    """libusb's error as one of ours, with the next step."""
    if e.errno in UNPLUGGED:
        return UnpluggedError("the device has gone from the bus", place=place, hint="plug it in again")
    if e.errno == errno.EACCES:
        return ResourceError("there is no permission to open it", place=place, hint=UDEV_HINT)
    if e.errno == errno.EBUSY:
        return ResourceError("another program has it open", place=place, hint="close that program")
    return ResourceError(f"the USB transfer failed ({e.strerror or e})", place=place)


def usb_devices(backend: Any = None) -> list[Any]:
    """All devices on the bus. Raises ResourceError where the bus cannot be listed."""
    try:
        found = usb.core.find(find_all=True, backend=backend or libusb_package.get_libusb1_backend())
        return sorted(found or [], key=lambda d: (d.bus or 0, d.address or 0))
    except Exception as e:  # no libusb, no bus, a container without /dev/bus
        raise ResourceError(f"the USB bus cannot be listed ({type(e).__name__}: {e})") from None


def may_open(device: Any) -> bool:
    """Whether this user may open a device: on Linux the rights of its node say so, elsewhere True."""
    node = Path(f"/dev/bus/usb/{device.bus or 0:03d}/{device.address or 0:03d}")
    return not node.exists() or os.access(node, os.R_OK | os.W_OK)
