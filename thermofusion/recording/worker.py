"""A device in a process of its own: it reads, numbers and offers frames, and never waits for whoever writes them down.

A process, not a thread: the queue of isochronous transfers holds 0.13 s, and Python's lock is held longer than that by
a process that converts pictures or draws.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from ..errors import ThermofusionError
from .device import Device, EndOfStreamError, Frame, StreamInfo, UnpluggedError
from .ring import RING_BYTES, Ring

_FRAME = struct.Struct("<cBQIQQQIIBf")  # mark, stream, offset, length, end, host ns, ticks, number, lost, shutter, °C
_IS_FRAME, _IS_WORD = b"F", b"W"
STOP_S = 5.0  # time for a device to stop before its process is ended


@dataclass(frozen=True, eq=False)
class Delivered:
    """A frame as it came to the recorder; number : in its stream, lost ones counted."""

    frame: Frame
    number: int


@dataclass(frozen=True)
class Started:
    """The device streams."""

    name: str
    streams: tuple[StreamInfo, ...]


@dataclass(frozen=True)
class Ended:
    """The device has stopped. problem : why, if nobody asked. numbers : frames of each stream, lost ones counted."""

    problem: str | None
    unplugged: bool
    numbers: tuple[int, ...]


def serve(opener: Callable[[], Device], ring: Ring, pipe: Connection, alone: bool = True) -> None:
    """What runs beside the recorder. alone : in a process of its own, whose Ctrl-C is the recorder's business."""
    if alone:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    device, problem, unplugged = None, None, False
    sender = _Sender(ring, pipe)
    try:
        device = opener()
        device.start()
        sender.word(Started(device.name, device.streams))
        sender.streams(len(device.streams))
        while _goes_on(device, pipe):
            for frame in device.read():
                sender.frame(frame)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the recorder is gone
    except EndOfStreamError:
        pass
    except ThermofusionError as e:
        problem, unplugged = e.sentence(), isinstance(e, UnpluggedError)
    except Exception as e:  # a camera's fault must not end the others
        problem = f"{getattr(device, 'name', 'the device')}: {type(e).__name__}: {e}"
    finally:
        with suppress(Exception):
            if device is not None:
                device.stop()
        with suppress(OSError, ValueError):
            sender.word(Ended(problem, unplugged, tuple(sender.numbers)))
            pipe.close()


def _goes_on(device: Device, pipe: Connection) -> bool:
    while pipe.poll(0):
        word = pipe.recv_bytes()
        if word == b"stop":
            return False
        if word == b"shutter":
            device.shutter()
    return True


class _Sender:
    """Frames into the ring, what is said of them into the pipe; what finds no room is counted into the next one."""

    def __init__(self, ring: Ring, pipe: Connection) -> None:
        self._ring, self._pipe = ring, pipe
        self.numbers: list[int] = []
        self._lost: list[int] = []

    def streams(self, count: int) -> None:
        self.numbers, self._lost = [0] * count, [0] * count

    def word(self, word: object) -> None:
        self._pipe.send_bytes(_IS_WORD + pickle.dumps(word))

    def frame(self, frame: Frame) -> None:
        s, data = frame.stream, memoryview(frame.data).cast("B")
        self.numbers[s] += frame.lost
        self._lost[s] += frame.lost
        place = self._ring.offer(data)
        number = self.numbers[s]
        self.numbers[s] += 1
        if place is None:
            self._lost[s] += 1
            return
        fields = (s, place[0], len(data), place[1], frame.host_ns, frame.ticks, number, self._lost[s])
        self._lost[s] = 0
        self._pipe.send_bytes(_FRAME.pack(_IS_FRAME, *fields, frame.shutter, frame.fpa_degC))


@contextmanager
def _deaf() -> Iterator[None]:
    """A process that is started here is deaf to Ctrl-C from its first moment on."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class Worker:
    """The recorder's end: starts the device, hands out what comes, stops it. own_process : False = a thread."""

    def __init__(self, opener: Callable[[], Device], own_process: bool = True, ring_bytes: int = RING_BYTES) -> None:
        context = multiprocessing.get_context("spawn")
        self._ring = Ring(context, ring_bytes)
        self.pipe, theirs = context.Pipe()
        arguments = (opener, self._ring, theirs, own_process)
        self._runs: Any
        if own_process:
            self._runs = context.Process(target=serve, args=arguments, daemon=True)
            with _deaf():
                self._runs.start()
            theirs.close()
        else:
            self._runs = threading.Thread(target=serve, args=arguments, daemon=True)
            self._runs.start()

    def take(self) -> Delivered | Started | Ended | None:
        """What has come, one after another; None where nothing has. A process that died has ended."""
        try:
            if not self.pipe.poll(0):
                return None
            said = self.pipe.recv_bytes()
        except (EOFError, OSError):
            return Ended("its process has died", False, ())
        if said[:1] == _IS_WORD:
            return pickle.loads(said[1:])
        _, stream, offset, length, end, host_ns, ticks, number, lost, shutter, fpa = _FRAME.unpack(said)
        data = self._ring.take(offset, length, end)
        return Delivered(Frame(stream, data, host_ns, ticks, lost, bool(shutter), fpa), number)

    def ask(self, word: bytes) -> None:
        """`stop` or `shutter`. Never raises."""
        with suppress(OSError, ValueError):
            self.pipe.send_bytes(word)

    def end(self) -> None:
        """Wait until it has stopped, and end it if it does not."""
        self._runs.join(STOP_S)
        if not isinstance(self._runs, threading.Thread) and self._runs.is_alive():
            self._runs.kill()
            self._runs.join()
        with suppress(OSError):
            self.pipe.close()
