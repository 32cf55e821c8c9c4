"""Cameras on umockdev's bus, under the real libusb.

Run as `umockdev-wrapper /usr/bin/python3 umock_camera.py KIND DATA command ...`.
The standard library and the system's UMockdev alone. DATA is a folder with the bytes that the camera streams:
`depth.bin` and `video.bin` (frames one after another) for `kinect`, `stream.bin` for `p3`. A Kinect's frames
come at 30 Hz, all else at once: this proves the protocol and the handling of transfers, not a bus's timing.
"""

from __future__ import annotations

import errno
import os
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402

CAPABILITIES, CLAIM, RELEASE, SET_INTERFACE = 0x8004551A, 0x8004550F, 0x80045510, 0x80085504
SUBMIT, REAP, DISCARD, GET_DRIVER, DISCONNECT = 0x8038550A, 0x4008550D, 0x0000550B, 0x41045508, 0xC0105512
ISO, CONTROL, BULK = 0, 2, 3
RATE_HZ = 30.0  # frames a second: faster, drivers that throw their first frames away would see none
URB = struct.Struct("<BBxxiI4xQiiiiiIQ")  # type, endpoint, status, flags, buffer, length, actual, start, packets ...


def descriptors(vendor, product, bcd, interfaces):
    """interfaces : (number, alternate, [(address, attributes, packet size)])."""
    body = b""
    for number, alternate, endpoints in interfaces:
        body += struct.pack("<9B", 9, 4, number, alternate, len(endpoints), 255, 0, 0, 0)
        for address, attributes, size in endpoints:
            body += struct.pack("<BBBBHB", 7, 5, address, attributes, size, 1)
    device = struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x200, 0, 0, 0, 64, vendor, product, bcd, 0, 0, 0, 1)
    count = len({n for n, _, _ in interfaces})
    return device + struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), count, 1, 0, 0x80, 50) + body


def described(vendor, product, bcd, interfaces, address=5):
    """A device for UMockdev's testbed, at 1:ADDRESS."""
    hexed = descriptors(vendor, product, bcd, interfaces).hex().upper()
    return f"""P: /devices/pci0000:00/0000:00:14.0/usb1/1-{address}
N: bus/usb/001/{address:03d}
E: DEVNAME=/dev/bus/usb/001/{address:03d}
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
A: bConfigurationValue=1\\n
A: busnum=1\\n
A: devnum={address}\\n
A: bNumConfigurations=1\\n
A: speed=480\\n
A: idVendor={vendor:04x}\\n
A: idProduct={product:04x}\\n
H: descriptors={hexed}
"""


class Camera:
    """What all have in common. transfers : of frames, after which it is unplugged; from DATA/unplug."""

    def __init__(self, data):
        unplug = data / "unplug"
        self.transfers = int(unplug.read_text()) if unplug.exists() else sys.maxsize

    def running(self):
        """Whether its start is over: a node that is polled here never says POLLERR, so that a request would hang."""
        return True


class Kinect(Camera):
    """Commands with replies; packets of 1748 and 1908 bytes once depth or video are started."""

    text = described(0x045E, 0x02AE, 267, [(0, 0, [(0x81, 1, 1920), (0x82, 1, 1760)])])

    def __init__(self, data):
        super().__init__(data)
        self.registers, self.reply, self.begun = {}, b"", {}
        self.packets = {
            0x82: self._packets(data / "depth.bin", 422_400, 1748, 0x70),
            0x81: self._packets(data / "video.bin", 307_200, 1908, 0x80),
        }

    @staticmethod
    def _packets(file, size, payload, kind):
        data, sequence, out = file.read_bytes(), 0, deque()
        for k in range(len(data) // size):
            pieces = [data[i : min(i + payload, (k + 1) * size)] for i in range(k * size, (k + 1) * size, payload)]
            for i, piece in enumerate(pieces):
                step = 1 if i == 0 else 5 if i == len(pieces) - 1 else 2
                out.append(struct.pack("<2s6BI", b"RB", 0, kind | step, 0, sequence & 255, 0, 0, 2_000_000 * k) + piece)
                sequence += 1
        return out

    def running(self):
        return 0x47 in self.registers and not self.reply

    def control(self, setup, data):
        if setup[0] == 0x40:
            _, _, number, tag = struct.unpack_from("<2sHHH", data)
            body = b"\0\0"
            if number == 3:
                address, value = struct.unpack("<2H", data[8:12])
                self.registers[address] = value
            elif number == 4:
                body = bytes(94) + struct.pack("<4f", 7.5, 2.3, 120.0, 0.1042) + bytes(212)
            elif number == 0x16:
                asked = struct.unpack_from("<H", data, 8)[0]
                body = {0x00: struct.pack("<2H", 0, 200), 0x40: bytes(118), 0x41: bytes(8)}.get(asked, b"\0\0")
            self.reply = struct.pack("<2sHHH", b"RB", len(body) // 2, number, tag) + body
            return b""
        reply, self.reply = self.reply, b""
        return reply

    def iso(self, endpoint, count):
        """Up to `count` packets; None while it does not stream, or is at its end."""
        on = self.registers.get(0x06) == 2 if endpoint == 0x82 else self.registers.get(0x05) in (1, 3)
        queue = self.packets[endpoint]
        if not on or not queue or 0x47 not in self.registers:  # it streams once its whole start was ordered
            return None
        begun, total = self.begun.setdefault(endpoint, (time.monotonic(), len(queue)))
        due = (time.monotonic() - begun) * RATE_HZ * (242 if endpoint == 0x82 else 162)
        if total - len(queue) > due:
            return None
        return [queue.popleft() if queue else b"" for _ in range(count)]


class Motor(Camera):
    """The motor of a model 1414: level, at rest."""

    text = described(0x045E, 0x02B0, 0x105, [(0, 0, [])], address=4)

    def control(self, setup, data):
        return struct.pack(">2xhhhbB", 0, 819, 0, 0, 0) if setup[0] & 0x80 else b""


class P3(Camera):
    """Commands are taken; bulk bytes once it was started twice."""

    text = described(0x3474, 0x45A2, 0x100, [(0, 0, []), (1, 0, []), (1, 1, [(0x81, 2, 512)])])

    def __init__(self, data):
        super().__init__(data)
        self.left, self.starts = (data / "stream.bin").read_bytes(), 0

    def control(self, setup, data):
        if setup[0] & 0x80:
            return b"\x02"
        self.starts += data[:3] == b"\x01\x2f\x81"
        return b""

    def bulk(self, endpoint, length):
        if self.starts < 2 or not self.left:
            return None
        part, self.left = self.left[:length], self.left[length:]
        return part


class Bus:
    """Answers usbfs: transfers that can be answered are done when they are reaped, others wait until discarded."""

    def __init__(self, camera):
        self.camera, self.waiting, self.done = camera, [], deque()
        self.left = camera.transfers  # until it is unplugged

    def __call__(self, _, client):
        request, arg = client.get_request() & 0xFFFFFFFF, client.get_arg()
        result, error = self.answer(request, arg)
        client.complete(result, error)
        return True

    def answer(self, request, arg):
        if self.left <= 0:
            return -1, errno.ENODEV
        if request == CAPABILITIES:
            arg.resolve(0, 4).update(0, list(struct.pack("<I", 0)))
            return 0, 0
        if request in (CLAIM, RELEASE, SET_INTERFACE):
            return 0, 0
        if request == SUBMIT:
            self.submit(arg)
            return 0, 0
        if request == REAP:
            return self.reap(arg)
        if request == DISCARD:
            return self.discard(struct.unpack("<Q", bytes(arg.retrieve())[:8])[0])
        return -1, errno.ENODATA if request in (GET_DRIVER, DISCONNECT) else errno.ENOTTY

    def submit(self, arg):
        pointer = struct.unpack("<Q", bytes(arg.retrieve())[:8])[0]
        urb = arg.resolve(0, 56)
        fields = URB.unpack(bytes(urb.retrieve()))
        packets, length = 0, fields[5]
        if fields[0] == ISO:  # its packets say how long its buffer is
            packets = fields[8]
            arg.reload()
            arg.update(0, list(struct.pack("<Q", pointer)))  # resolving has put its own in its place
            urb = arg.resolve(0, 56 + 12 * packets)
            tables = bytes(urb.retrieve())[56:]
            length = sum(struct.unpack_from("<I", tables, 12 * i)[0] for i in range(packets))
        buffer = urb.resolve(16, length)
        self.waiting.append((pointer, urb, buffer, fields, packets))

    def reap(self, arg):
        if not self.done:
            self.work()
        if not self.done:
            return -1, errno.EAGAIN
        arg.resolve(0, 8).set_ptr(0, self.done.popleft())
        return 0, 0

    def work(self):
        """The first waiting transfer that can be answered."""
        for row, (_, urb, buffer, fields, packets) in enumerate(self.waiting):
            kind, endpoint, length = fields[0], fields[1], fields[5]
            if kind == CONTROL:
                raw = bytes(buffer.retrieve())
                answer = self.camera.control(raw[:8], raw[8:])[: length - 8]
                buffer.update(8, list(answer)) if answer else None
                actual = len(answer) if raw[0] & 0x80 else length - 8
            elif kind == BULK:
                answer = self.camera.bulk(endpoint, length)
                if answer is None:
                    continue
                buffer.update(0, list(answer))
                actual = len(answer)
            else:
                answer = self.camera.iso(endpoint, packets)
                if answer is None:
                    continue
                actual = self.fill(urb, buffer, answer)
            urb.update(4, list(struct.pack("<i", 0)))
            urb.update(28, list(struct.pack("<i", actual)))
            del self.waiting[row]
            self.done.append(urb)
            self.left -= kind != CONTROL and self.camera.running()
            return

    @staticmethod
    def fill(urb, buffer, packets):
        tables = bytes(urb.retrieve())[56:]
        at = total = 0
        said, data = b"", bytearray()
        for i, packet in enumerate(packets):
            (length,) = struct.unpack_from("<I", tables, 12 * i)
            data += packet.ljust(length, b"\xee")
            said += struct.pack("<3I", length, len(packet), 0)
            at, total = at + length, total + len(packet)
        buffer.update(0, list(data))
        urb.update(56, list(said))
        return total

    def discard(self, pointer):
        for row, (own, urb, *_) in enumerate(self.waiting):
            if own == pointer:
                urb.update(4, list(struct.pack("<i", -errno.ENOENT)))
                del self.waiting[row]
                self.done.append(urb)
                return 0, 0
        return -1, errno.EINVAL


def main(kind, data, *command):
    """Run the command beside the camera; its exit code."""
    bed = UMockdev.Testbed.new()
    devices = {"kinect": lambda: [Kinect(Path(data)), Motor(Path("/nowhere"))], "p3": lambda: [P3(Path(data))]}[kind]()
    handlers = []  # kept: the testbed does not
    for device in devices:
        bed.add_from_string(device.text)
        handlers.append(UMockdev.IoctlBase())
        handlers[-1].connect("handle-ioctl", Bus(device))
        node = device.text.split("DEVNAME=")[1].split()[0]
        bed.attach_ioctl(node, handlers[-1])
    loop, code = GLib.MainLoop(), []

    def run():
        env = {**os.environ, "UMOCKDEV_DIR": bed.get_root_dir()}
        code.append(subprocess.run(command, env=env, check=False).returncode)
        GLib.idle_add(loop.quit)

    threading.Thread(target=run).start()
    loop.run()
    return code[0]


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
