"""Cameras that are not there: a pyusb backend with simulated devices, a Kinect's isochronous packets, video nodes.

Written from the protocols' descriptions alone: nothing of the recorder's parsers is used, so the two can disagree.
"""

from __future__ import annotations

import errno
import struct
import time
from collections import deque
from types import SimpleNamespace

import numpy as np
import usb.backend
import usb.core

from thermofusion.recording.device import UnpluggedError
from thermofusion.recording.iso import Packet

BULK, ISOCHRONOUS = 2, 1


def gone():
    return usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)


class Simulated:
    """A device on the fake bus; subclasses answer. endpoints : {(interface, alternate): [(address, kind)]}."""

    ids, bcd, endpoints = (0, 0), 0x100, {(0, 0): []}

    def __init__(self, bus=1, address=7):
        self.bus, self.address = bus, address
        self.plugged, self.alternates, self.claimed, self.written = True, {}, set(), []

    def control_out(self, request_type, request, value, index, data):
        raise usb.core.USBError("stall", -9, errno.EPIPE)

    def control_in(self, request_type, request, value, index, length):
        raise usb.core.USBError("stall", -9, errno.EPIPE)

    def bulk_out(self, endpoint, data):
        raise usb.core.USBError("stall", -9, errno.EPIPE)

    def bulk_in(self, endpoint, length):
        return b""


class FakeBackend(usb.backend.IBackend):
    """pyusb's backend over simulated devices."""

    def __init__(self, *devices):
        self.devices = devices

    def enumerate_devices(self):
        return iter(self.devices)

    def get_device_descriptor(self, dev):
        names = "bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol iManufacturer iProduct iSerialNumber speed"
        fields = dict.fromkeys(names.split(), 0) | {"bLength": 18, "bDescriptorType": 1, "bMaxPacketSize0": 64}
        fields |= {"idVendor": dev.ids[0], "idProduct": dev.ids[1], "bcdDevice": dev.bcd, "bNumConfigurations": 1}
        return SimpleNamespace(**fields, bus=dev.bus, address=dev.address, port_number=1, port_numbers=(1,))

    def get_configuration_descriptor(self, dev, config):
        if config:
            raise IndexError
        fields = {"bLength": 9, "bDescriptorType": 2, "wTotalLength": 0, "bConfigurationValue": 1, "iConfiguration": 0}
        interfaces = len({i for i, _ in dev.endpoints})
        return SimpleNamespace(**fields, bNumInterfaces=interfaces, bmAttributes=0, bMaxPower=0, extra_descriptors=[])

    def get_interface_descriptor(self, dev, intf, alt, config):
        if (intf, alt) not in dev.endpoints:
            raise IndexError
        names = "bInterfaceClass bInterfaceSubClass bInterfaceProtocol iInterface"
        fields = dict.fromkeys(names.split(), 0) | {"bLength": 9, "bDescriptorType": 4, "extra_descriptors": []}
        count = len(dev.endpoints[intf, alt])
        return SimpleNamespace(**fields, bInterfaceNumber=intf, bAlternateSetting=alt, bNumEndpoints=count)

    def get_endpoint_descriptor(self, dev, ep, intf, alt, config):
        address, kind = dev.endpoints[intf, alt][ep]
        fields = {"bLength": 7, "bDescriptorType": 5, "wMaxPacketSize": 512, "bInterval": 1, "extra_descriptors": []}
        return SimpleNamespace(**fields, bEndpointAddress=address, bmAttributes=kind, bRefresh=0, bSynchAddress=0)

    def open_device(self, dev):
        self._there(dev)
        return dev

    def close_device(self, handle):
        pass

    def get_configuration(self, handle):
        return 1

    def set_configuration(self, handle, value):
        raise AssertionError("nobody needs that")

    def set_interface_altsetting(self, handle, intf, alt):
        self._there(handle)
        handle.alternates[intf] = alt

    def claim_interface(self, handle, intf):
        self._there(handle)
        handle.claimed.add(intf)

    def release_interface(self, handle, intf):
        handle.claimed.discard(intf)

    def is_kernel_driver_active(self, handle, intf):
        return False

    def ctrl_transfer(self, handle, request_type, request, value, index, data, timeout):
        self._there(handle)
        if request_type & 0x80:
            answer = handle.control_in(request_type, request, value, index, len(data))
            data[: len(answer)] = type(data)("B", answer)
            return len(answer)
        handle.written.append((request_type, request, value, index, bytes(data)))
        handle.control_out(request_type, request, value, index, bytes(data))
        return len(data)

    def bulk_write(self, handle, ep, intf, data, timeout):
        self._there(handle)
        handle.written.append((ep, bytes(data)))
        handle.bulk_out(ep, bytes(data))
        return len(data)

    def bulk_read(self, handle, ep, intf, buff, timeout):
        self._there(handle)
        data = handle.bulk_in(ep, len(buff))
        if not data:
            time.sleep(min(timeout, 5) / 1000)
            raise usb.core.USBTimeoutError("timeout", -7, errno.ETIMEDOUT)
        buff[: len(data)] = type(buff)("B", data)
        return len(data)

    @staticmethod
    def _there(dev):
        if not dev.plugged:
            raise gone()


def on_bus(*devices):
    """pyusb's devices of a fake bus."""
    backend = FakeBackend(*devices)
    return [usb.core.Device(d, backend) for d in devices]


# ---------------------------------------------------------------- InfiRay P3


def crc16(data):
    """CRC-16/XMODEM, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


class SimulatedP3(Simulated):
    """A P3 or P1; `frame(k)` is its k-th temperature plane. It streams only after the whole order of its start."""

    def __init__(self, ids=(0x3474, 0x45A2), size=(256, 192), **place):
        super().__init__(**place)
        self.endpoints = {(0, 0): [], (1, 0): [], (1, 1): [(0x81, BULK)]}
        self.ids, (self.w, self.h) = ids, size
        self.steps, self.shutters, self.made, self.skip = [], 0, 0, 0
        self._stream = b""

    def frame(self, k):
        return (19000 + 3 * k + np.arange(self.w * self.h) % 977).astype("<u2").reshape(self.h, self.w)

    def _bytes(self):
        k = self.made + self.skip
        self.made += 1
        head = struct.pack("<BBIIH", 12, 0x8C + k % 2, k, 1000 * k, 40 * k % 2048)
        tail = struct.pack("<BBIIH", 12, 0x8E + k % 2, k, 1000 * k + 1, 40 * k % 2048)
        picture = np.full((self.h + 2, self.w), 0x0C8C, "<u2")  # looks like a marker all over
        return head + picture.tobytes() + self.frame(k).tobytes() + tail

    def control_out(self, request_type, request, value, index, data):
        if (request_type, request) == (0x41, 0x20):
            assert len(data) == 18
            assert crc16(data[:16]) == struct.unpack("<H", data[16:])[0]
            if data[:3] == b"\x01\x2f\x81":
                self.steps.append("start")
            elif data[:3] == b"\x01\x36\x43":
                self.shutters += 1
            return
        assert (request_type, request, index) == (0x40, 0xEE, 1)
        self.steps.append("ee" if self.alternates.get(1) == 1 else "ee too early")

    def control_in(self, request_type, request, value, index, length):
        return b"\x02"[:length]

    def bulk_in(self, endpoint, length):
        if self.steps != ["start", "ee", "start"]:
            return b""
        if not self._stream:
            self._stream = self._bytes()
        part, self._stream = self._stream[:length], self._stream[length:]
        return part


# ---------------------------------------------------------------- Seek


class SimulatedSeek(Simulated):
    """A Seek Compact: a first frame, a shutter, three pictures, a shutter ... picture k = shutter + k at pixel k."""

    ids, endpoints = (0x289D, 0x0010), {(0, 0): [(0x81, BULK)]}

    def __init__(self, **place):
        super().__init__(**place)
        self.running, self.made, self._left, self.idle, self.cut = False, 0, b"", 0, False

    def control_out(self, request_type, request, value, index, data):
        assert request_type == 0x41
        if request == 60:
            self.running, self.idle = data == b"\x01\x00", self.idle + (data == b"\x00\x00")
        elif request == 83:
            assert struct.unpack("<I", data)[0] == 208 * 156
            self._left = self._frame()[: 20_000 if self.cut else None]

    def control_in(self, request_type, request, value, index, length):
        return bytes(length)

    def _frame(self):
        kind = 4 if self.made == 0 else 1 if self.made % 4 == 1 else 3
        words = np.full(208 * 156, 8000, "<u2")
        words[10] = kind
        if kind == 3:
            words[100] += self.made
        self.made += 1
        return words.tobytes()

    def bulk_in(self, endpoint, length):
        part, self._left = self._left[:length], self._left[length:]
        return part if self.running else b""


# ---------------------------------------------------------------- Kinect


def packed(values, bits):
    """Numbers (N,) packed most significant bit first, by way of single bits."""
    table = (values[:, None] >> np.arange(bits - 1, -1, -1)) & 1
    return np.packbits(table.astype(np.uint8).ravel()).tobytes()


class SimulatedKinect(Simulated):
    """A Kinect v1's camera: commands with replies, and `packets`, its isochronous stream."""

    ids, bcd, endpoints = (0x045E, 0x02AE), 267, {(0, 0): [(0x81, ISOCHRONOUS), (0x82, ISOCHRONOUS)]}
    CONSTANTS = (7.5, 2.3, 120.0, 0.1042)

    def __init__(self, **place):
        super().__init__(**place)
        self.registers, self._reply, self.silent = {}, deque(), False

    def control_out(self, request_type, request, value, index, data):
        assert (request_type, request) == (0x40, 0)
        magic, words, number, tag = struct.unpack_from("<2sHHH", data)
        assert magic == b"GM"
        assert len(data) == 8 + 2 * words
        body = b"\0\0"
        if number == 3:
            address, setting = struct.unpack("<2H", data[8:])
            self.registers[address] = setting
        elif number == 4:
            body = bytes(94) + struct.pack("<4f", *self.CONSTANTS) + bytes(212)
        elif number == 0x16:
            body = struct.pack("<2H", 0, 200)
        if not self.silent:
            self._reply.append(b"")  # not ready yet
            self._reply.append(struct.pack("<2sHHH", b"RB", len(body) // 2, number, tag) + body)

    def control_in(self, request_type, request, value, index, length):
        return self._reply.popleft()[:length] if self._reply else b""

    def disparity(self, k):
        return ((np.arange(480 * 640) * 7 + 13 * k) % 2048).astype(np.uint16)

    def bayer(self, k):
        return ((np.arange(480 * 640) * 5 + 11 * k) % 256).astype(np.uint8)


def iso_packets(data, payload, kind, ticks, sequence=0):
    """A frame's packets as they come over the bus."""
    pieces = [data[i : i + payload] for i in range(0, len(data), payload)]
    flags = [1, *[2] * (len(pieces) - 2), 5]
    return [
        struct.pack("<2sBBBBBBI", b"RB", 0, kind | f, 0, (sequence + i) & 255, 0, 0, ticks & 0xFFFFFFFF) + piece
        for i, (f, piece) in enumerate(zip(flags, pieces, strict=True))
    ]


class SimulatedStream:
    """The packets of a Kinect: frame after frame, both endpoints; `lose` names (frame, packet) of depth that vanish."""

    def __init__(self, kinect, frames, lose=(), first_ticks=2**32 - 3_000_000, unplug_at=None):
        self.kinect, self.started, self.stopped = kinect, False, False
        self._frames, self._lose, self._ticks, self._unplug = frames, set(lose), first_ticks, unplug_at
        self._next = self._depth_sequence = self._video_sequence = 0

    def start(self):
        assert 0x06 not in self.kinect.registers  # queued before depth is started
        self.started = True

    def take(self, timeout_s):
        if not self.kinect.plugged:
            raise UnpluggedError("the device has gone from the bus")
        if self._next >= self._frames or self.kinect.registers.get(0x06) != 2:
            return []
        k, ticks = self._next, self._ticks + 2_000_000 * self._next
        self._next += 1
        depth = iso_packets(packed(self.kinect.disparity(k), 11), 1748, 0x70, ticks, self._depth_sequence)
        video = iso_packets(self.kinect.bayer(k).tobytes(), 1908, 0x80, ticks + 500, self._video_sequence)
        assert (len(depth), len(video)) == (242, 162)
        self._depth_sequence += len(depth)
        self._video_sequence += len(video)
        now = time.monotonic_ns()
        found = [Packet(0x82, p, now) for i, p in enumerate(depth) if (k, i) not in self._lose]
        if k == self._unplug:  # in mid-frame
            self.kinect.plugged = False
            return found[:100]
        return [*found, Packet(0x82, b"", now), *(Packet(0x81, p, now) for p in video)]

    def stop(self):
        self.stopped = True


class SimulatedMotor(Simulated):
    """The motor device of a model 1414, level: 819 counts of gravity along y."""

    ids = (0x045E, 0x02B0)

    def control_out(self, request_type, request, value, index, data):
        assert (request_type, request) in ((0x40, 0x31), (0x40, 0x06))

    def control_in(self, request_type, request, value, index, length):
        assert request == 0x32
        return struct.pack(">2xhhhbB", 0, 819, -41, -10, 4)


class SimulatedAudio(Simulated):
    """The audio device of later models: bulk commands, acknowledged."""

    ids, endpoints = (0x045E, 0x02AD), {(0, 0): [(0x01, BULK), (0x81, BULK)]}

    def __init__(self, **place):
        super().__init__(**place)
        self._answers = deque()

    def bulk_out(self, endpoint, data):
        magic, tag, length, number, _ = struct.unpack("<5I", data)
        assert magic == 0x06022009
        if number == 0x8032:
            self._answers.append(bytes(16) + struct.pack("<4i", 0, 819, 0, 7) + bytes(length - 32))
        self._answers.append(struct.pack("<3I", 0x0A6FE000, tag, 0))

    def bulk_in(self, endpoint, length):
        return self._answers.popleft() if self._answers else b""


# ---------------------------------------------------------------- video nodes


class FakeCapture:
    """A video node that gives what it was given; None = nothing in time, an exception is raised."""

    def __init__(self, frames):
        self.frames, self.units, self.closed = deque(frames), [], False

    def read(self):
        if not self.frames:
            return None
        frame = self.frames.popleft()
        if isinstance(frame, Exception):
            raise frame
        return None if frame is None else np.frombuffer(frame, np.uint8)

    def unit(self, unit, selector, data):
        self.units.append((unit, selector, data))

    def close(self):
        self.closed = True


def lepton_frame(k, correcting=False, high_first=True):
    """A Y16 frame with telemetry: kelvin x 100, uptime beyond 2^16 ms, counter k."""
    image = (29_500 + (np.arange(160 * 120) * 3 + k) % 800).astype("<u2")
    row = np.zeros(320, "<u2")

    def put(at, value):
        halves = (value >> 16, value & 0xFFFF)
        row[at : at + 2] = halves if high_first else halves[::-1]

    put(1, 200_000 + 115 * k)
    put(3, 0x20 if correcting else 0x30)
    put(20, 70_000 + k)
    row[24] = 30_515
    return image.tobytes() + row.tobytes()
