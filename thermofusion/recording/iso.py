"""Isochronous transfers, many in flight at a time, on the handle that pyusb opened.

pyusb's own `iso_read` keeps one transfer in flight and loses the packets' lengths, so that a stream has gaps and no
packet can be told from the next. Here libusb is called through the prototypes that pyusb has set up. To be run in a
process of its own: what delays Python for more than the queued time (64 packets x 16 transfers, 0.13 s) loses packets.
"""

from __future__ import annotations

import ctypes
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import usb.core

from .device import UnpluggedError
from .usb import as_ours

PACKETS = 64  # of a transfer: 8 ms of microframes
TRANSFERS = 16  # in flight on each endpoint
MAX_WAITING = 20_000  # packets that wait to be taken, about 1 s: more are dropped and counted
NO_DEVICE, CANCELLED = 5, 3  # libusb_transfer_status
ISOCHRONOUS = 1  # libusb_transfer_type
STOP_S = 1.0  # time for cancelled transfers to come back


@dataclass(frozen=True, eq=False)
class Packet:
    """A packet as it came: endpoint, bytes, host monotonic ns."""

    endpoint: int
    data: bytes
    host_ns: int


class PacketSource(Protocol):
    """Where isochronous packets come from: `IsoQueue`, or a simulated camera in tests."""

    def start(self) -> None:
        """Queue the transfers."""

    def take(self, timeout_s: float) -> list[Packet]:
        """What has arrived, waiting for at most timeout_s. Raises UnpluggedError."""

    def stop(self) -> None:
        """Cancel and free everything. Never raises."""


class _Timeval(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("microseconds", ctypes.c_long))


class IsoQueue:
    """Transfers in flight on some endpoints of a device that pyusb has open. device : usb.core.Device."""

    def __init__(self, device: Any, endpoints: tuple[int, ...], packets: int = PACKETS, transfers: int = TRANSFERS):
        from usb.backend import libusb1

        self._usb, self._lib = libusb1, libusb1._lib
        device._ctx.managed_open()
        self._handle, self._context = device._ctx.handle, device._ctx.backend.ctx
        self._endpoints, self._packets, self._count = endpoints, packets, transfers
        self._callback = libusb1._libusb_transfer_cb_fn_p(self._arrived)  # kept: libusb calls it for as long as we live
        self._transfers: list[Any] = []
        self._buffers: list[Any] = []
        self._flying, self._stopping, self._gone = 0, False, False
        self._waiting: deque[Packet] = deque()
        self.dropped = 0  # packets that nobody took in time
        self._lib.libusb_handle_events_timeout.argtypes = (ctypes.c_void_p, ctypes.POINTER(_Timeval))
        self._lib.libusb_cancel_transfer.argtypes = (ctypes.c_void_p,)

    def start(self) -> None:
        """Queue the transfers. Raises ResourceError."""
        for endpoint in self._endpoints:
            size = self._lib.libusb_get_max_iso_packet_size(self._handle.devid, endpoint)
            if size <= 0:
                raise as_ours(usb.core.USBError("the endpoint carries no isochronous packets"), f"{endpoint:#04x}")
            for _ in range(self._count):
                self._submit(endpoint, size)

    def _submit(self, endpoint: int, size: int) -> None:
        transfer = self._lib.libusb_alloc_transfer(self._packets)
        buffer = ctypes.create_string_buffer(self._packets * size)
        self._transfers.append(transfer)
        self._buffers.append(buffer)
        t = transfer.contents
        t.dev_handle, t.endpoint, t.type, t.timeout = self._handle.handle, endpoint, ISOCHRONOUS, 0
        t.buffer = ctypes.addressof(buffer)
        t.length, t.num_iso_packets, t.callback = len(buffer), self._packets, self._callback
        for packet in self._usb._get_iso_packet_list(t):
            packet.length = size
        if self._lib.libusb_submit_transfer(transfer):
            raise UnpluggedError("the device does not take isochronous transfers")
        self._flying += 1

    def _arrived(self, transfer: Any) -> None:
        """libusb's callback. An exception that left it would end the process, so none does."""
        try:
            self._flying -= 1
            t, now = transfer.contents, time.monotonic_ns()
            if t.status == NO_DEVICE:
                self._gone = True
            if t.status == CANCELLED or self._stopping or self._gone:
                return
            self._keep(t, now)
            if self._lib.libusb_submit_transfer(transfer) == 0:
                self._flying += 1
            else:
                self._gone = True
        except Exception:
            self._gone = True

    def _keep(self, t: Any, now: int) -> None:
        address = t.buffer
        for packet in self._usb._get_iso_packet_list(t):
            if packet.status == 0 and packet.actual_length:
                if len(self._waiting) >= MAX_WAITING:
                    self._waiting.popleft()
                    self.dropped += 1
                self._waiting.append(Packet(t.endpoint, ctypes.string_at(address, packet.actual_length), now))
            address += packet.length

    def take(self, timeout_s: float) -> list[Packet]:
        """What has arrived, waiting for at most timeout_s. Raises UnpluggedError."""
        wait = _Timeval(int(timeout_s), int(timeout_s % 1 * 1e6))
        self._lib.libusb_handle_events_timeout(self._context, ctypes.byref(wait))
        found = [self._waiting.popleft() for _ in range(len(self._waiting))]
        if self._gone and not found:
            raise UnpluggedError("the device has gone from the bus", hint="plug it in again")
        return found

    def stop(self) -> None:
        """Cancel and free everything. Never raises."""
        self._stopping = True
        with suppress(Exception):
            for transfer in self._transfers:
                self._lib.libusb_cancel_transfer(transfer)
            until, wait = time.monotonic() + STOP_S, _Timeval(0, 50_000)
            while self._flying > 0 and time.monotonic() < until:
                self._lib.libusb_handle_events_timeout(self._context, ctypes.byref(wait))
            if self._flying <= 0:  # else libusb still writes to them: they are left to the end of the process
                for transfer in self._transfers:
                    self._lib.libusb_free_transfer(transfer)
        self._transfers = []
