"""Devices into recording.mcap: whole frames only, flushed twice a second, whatever happens to devices or disk."""

from __future__ import annotations

import errno
import json
import os
import shutil
import threading
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import wait
from pathlib import Path

from ..errors import ResourceError, ScanError
from ..files import ros
from ..files.json import to_json
from ..files.mcap import McapWriter, Message
from ..files.whole import FULL, probe, write_text
from ..version import __version__
from .device import Device, StreamInfo
from .worker import Delivered, Ended, Started, Worker

FILE = "recording.mcap"
FLUSH_S = 0.4  # what is in memory is written at least so often: with 0.1 s of polling, half a second
RESERVE_BYTES = 32 * 2**20  # of free disk: a recording stops before, while there is room for its end
POLL_S = 0.05  # the longest that keys and the clock wait
FIRST_S = 15.0  # that a device may take until its first frame: the seconds asked for count from there
STOP_S = 4.0  # devices are asked to stop, and their last frames awaited, for so long
SILENT_S = 5.0  # a stream that began and gives nothing for so long is said
RATE_S = 2.0  # over which a rate is taken
MANY = 64  # frames of one device in a row before the others have their turn
Control = Callable[[], str | None]  # "stop", "shutter", "start" or None: asked often
Status = Callable[["Recording"], None]  # shown twice a second


@dataclass(eq=False)
class StreamState:
    """A stream while it is recorded. frames : written. lost : never arrived, or dropped."""

    info: StreamInfo
    device: str
    frames: int = 0
    lost: int = 0
    shutter: bool = False
    live: bool = True  # its device has not ended
    last: bytes | None = None
    arrivals_ns: list[int] = field(default_factory=list)

    @property
    def rate_hz(self) -> float:
        """Frames a second of late."""
        span = self.arrivals_ns[-1] - self.arrivals_ns[0] if len(self.arrivals_ns) > 1 else 0
        return (len(self.arrivals_ns) - 1) / span * 1e9 if span else 0.0


@dataclass(eq=False)
class Recording:
    """How a recording stands, and how it ended: problems are sentences, of devices and of the disk."""

    folder: Path
    started: bool = False
    seconds: float = 0.0
    size_bytes: int = 0
    streams: dict[str, StreamState] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    disk_full: bool = False

    @property
    def lost(self) -> int:
        """Frames of all streams that are not in the file."""
        return sum(s.lost for s in self.streams.values())


@dataclass(frozen=True)
class Until:
    """When a recording ends by itself, and how often a shutter correction is asked for; None = never. seconds : from
    the first frame on. waits : frames are written only from the control's "start" on."""

    seconds: float | None = None
    depth_frames: int | None = None
    shutter_every_s: float | None = None
    waits: bool = False


@dataclass(frozen=True, eq=False)
class Beside:
    """What a person knows. said : goes into the file (`environment`). rig : of a rig.json, written beside it."""

    said: Mapping[str, object] = field(default_factory=dict)
    rig: object = None


NOTHING = Beside()


def record(
    openers: Sequence[Callable[[], Device]],
    out: Path,
    until: Until,
    *,
    control: Control = lambda: None,
    status: Status = lambda r: None,
    beside: Beside = NOTHING,
    own_process: bool = True,
) -> Recording:
    """Record the devices into a new folder until a stop; returns how it went.

    own_process : False runs devices as threads, for tests.
    Raises ScanError where `out` exists, ResourceError where it cannot be made or no device starts.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ScanError("it exists already", place=out, hint="choose a new folder")
    probe(out)
    if beside.rig is not None:
        write_text(out / "rig.json", to_json(beside.rig) + "\n")
    try:
        recorder = _Recorder(out, until, beside.said)
    except OSError as e:
        raise ResourceError(f"it cannot be written ({e.strerror})", place=out / FILE) from None
    try:
        recorder.start([Worker(opener, own_process) for opener in openers])
        recorder.run(control, status)
    except KeyboardInterrupt:
        pass  # Ctrl-C ends a recording as it should end
    finally:
        recorder.finish(status)
    if not any(s.frames for s in recorder.state.streams.values()):
        why = "; ".join(recorder.state.problems) or "no frame came"
        with suppress(OSError):
            (out / FILE).unlink()
            (out / "rig.json").unlink(missing_ok=True)
            out.rmdir()
        raise ResourceError(f"nothing was recorded: {why}")
    return recorder.state


class _Recorder:
    def __init__(self, out: Path, until: Until, said: Mapping[str, object]) -> None:
        self.state = Recording(out, started=not until.waits)
        self._workers: dict[int, Worker] = {}
        self._until = until
        self._sinks: dict[int, list[_Sink]] = {}
        self._epoch_ns = time.time_ns() - time.monotonic_ns()  # taken once: the wall clock may jump afterwards
        self._begin_ns = time.monotonic_ns()
        self._first_ns: int | None = None
        self._writer = McapWriter(out / FILE, "ros2", f"thermofusion {__version__}")
        entries = {"start_ns": str(self._epoch_ns + self._begin_ns), "flush_s": "0.5", "clock": "host monotonic"}
        self._writer.metadata("thermofusion", entries | {k: json.dumps(v) for k, v in said.items()})
        self._disk = _Disk(self._writer.fileno())
        self._flushed_at = self._shown_at = self._checked_at = 0.0
        self._corrected_at = time.monotonic()
        self._silent: set[str] = set()

    def start(self, workers: Sequence[Worker]) -> None:
        """Take over devices that are being started."""
        self._workers = dict(enumerate(workers))

    def run(self, control: Control, status: Status) -> None:
        """Until a stop, or no device is left, or the disk is full."""
        while self._workers and not self.state.disk_full:
            wait([w.pipe for w in self._workers.values()], POLL_S)
            self._take()
            self._now_and_then(status)
            word = control()
            if word == "start" and not self.state.started:
                self.state.started, self._begin_ns = True, time.monotonic_ns()
            if word == "shutter":
                self._ask(b"shutter")
            if word == "stop" or self._enough():
                return

    def finish(self, status: Status) -> None:
        """Stop the devices, take their last frames, end the file. Never raises for a device or a full disk."""
        self._ask(b"stop")
        workers, until = list(self._workers.values()), time.monotonic() + STOP_S
        while self._workers and time.monotonic() < until:
            wait([w.pipe for w in self._workers.values()], POLL_S)
            self._take()
        for worker in workers:
            worker.end()
        self._disk.end()
        try:
            self._writer.close(complete=True)
        except OSError as e:
            self._full(e)
        self.state.size_bytes = self._writer.size
        status(self.state)

    def _take(self) -> None:
        for row, worker in list(self._workers.items()):
            for _ in range(MANY):
                said = worker.take()
                if said is None:
                    break
                if isinstance(said, Delivered):
                    self._frame(row, said)
                elif isinstance(said, Started):
                    self._begun(row, said)
                else:
                    self._ended(row, said)
                    break

    def _begun(self, row: int, said: Started) -> None:
        try:
            self._sinks[row] = [self._sink(said.name, s) for s in said.streams]
        except OSError as e:
            self._full(e)

    def _sink(self, device: str, info: StreamInfo) -> _Sink:
        name, others = info.name, 1
        while name in self.state.streams:  # a second camera of the same kind
            others += 1
            name = f"{info.name}-{others}"
        state = StreamState(replace(info, name=name), device)
        sink = _Sink(self._writer, state, self._epoch_ns)
        self.state.streams[name] = state
        return sink

    def _frame(self, row: int, said: Delivered) -> None:
        if not self.state.started or self.state.disk_full:
            return
        if self._first_ns is None:
            self._first_ns = time.monotonic_ns()
        try:
            self._sinks[row][said.frame.stream].write(said)
        except OSError as e:
            self._full(e)

    def _ended(self, row: int, said: Ended) -> None:
        del self._workers[row]
        for k, sink in enumerate(self._sinks.get(row, [])):
            sink.ended(said.numbers[k] if k < len(said.numbers) else 0)
        if said.problem is not None:
            self.state.problems.append(said.problem)

    def _full(self, e: OSError) -> None:
        for sink in [s for own in self._sinks.values() for s in own]:
            sink.refused()
        if not self.state.disk_full:
            what = "the disk is full" if e.errno in FULL else f"the disk fails ({e.strerror})"
            self.state.problems.append(f"{self.state.folder}: {what}; what was written before is whole")
        self.state.disk_full = True

    def _now_and_then(self, status: Status) -> None:
        now = time.monotonic()
        if now - self._flushed_at >= FLUSH_S:
            self._flushed_at = now
            try:
                self._writer.flush()
            except OSError as e:
                self._full(e)
            self._disk.flush()
        if now - self._checked_at >= 1.0:
            self._checked_at = now
            if shutil.disk_usage(self.state.folder).free < RESERVE_BYTES:
                self._full(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        self._listen(time.monotonic_ns())
        every = self._until.shutter_every_s
        if every is not None and now - self._corrected_at >= every:
            self._corrected_at = now
            self._ask(b"shutter")
        if now - self._shown_at >= 0.5:
            self._shown_at = now
            self.state.size_bytes = self._writer.size + self._writer.waiting
            self.state.seconds = (time.monotonic_ns() - self._begin_ns) * 1e-9 if self.state.started else 0.0
            status(self.state)

    def _listen(self, now_ns: int) -> None:
        """Say once of a stream that it has been silent for long; its device may hang."""
        for name, stream in self.state.streams.items():
            silent = stream.arrivals_ns and now_ns - stream.arrivals_ns[-1] > SILENT_S * 1e9
            if silent and name not in self._silent and stream.live:
                self._silent.add(name)
                self.state.problems.append(f"{name}: no frame for {SILENT_S:g} s")

    def _enough(self) -> bool:
        depth = [s.frames + s.lost for s in self.state.streams.values() if s.info.kind == "depth"]
        if self._until.depth_frames is not None and max(depth, default=0) >= self._until.depth_frames:
            return True
        if self._until.seconds is None or not self.state.started:
            return False
        now_ns, wanted_ns = time.monotonic_ns(), self._until.seconds * 1e9
        if self._first_ns is None:
            return now_ns - self._begin_ns >= wanted_ns + FIRST_S * 1e9
        return now_ns - self._first_ns >= wanted_ns

    def _ask(self, word: bytes) -> None:
        for worker in self._workers.values():
            worker.ask(word)


class _Sink:
    """A stream's way into the file: its channels, and two messages a frame."""

    def __init__(self, writer: McapWriter, state: StreamState, epoch_ns: int) -> None:
        info, self._frame = state.info, state.info.name.replace("/", "_")
        self._writer, self._state, self._epoch_ns = writer, state, epoch_ns
        self._first: int | None = None
        self._next = 0
        if info.kind == "gravity":
            self._reading = writer.channel(info.name, ros.VECTOR, ros.DEFINITIONS[ros.VECTOR], {"device": state.device})
            return
        step = info.bytes_per_frame // info.height_px
        self._pack = ros.ImagePacker(self._frame, info.width_px, info.height_px, info.encoding, step)
        said = {"kind": info.kind, "device": state.device, "width_px": str(info.width_px)}
        said |= {"height_px": str(info.height_px), "tick_hz": repr(info.tick_hz), "tick_wrap": str(info.tick_wrap)}
        said |= {"thermofusion": json.dumps(dict(info.about))}
        self._image = writer.channel(info.name, ros.IMAGE, ros.DEFINITIONS[ros.IMAGE], said)
        self._info = writer.channel(f"{info.name}/info", ros.FRAME_INFO, ros.DEFINITIONS[ros.FRAME_INFO], {})
        if "K" in info.about:
            self._camera()

    def _camera(self) -> None:
        info = self._state.info
        channel = self._writer.channel(
            f"{info.name}/camera_info", ros.CAMERA_INFO, ros.DEFINITIONS[ros.CAMERA_INFO], {}
        )
        K = [float(x) for row in info.about["K"] for x in row]  # type: ignore[attr-defined]
        now = self._epoch_ns + time.monotonic_ns()
        data = ros.camera_info(now, self._frame, (info.width_px, info.height_px), K)
        self._writer.write([Message(channel, now, 0, (data,))])

    def write(self, said: Delivered) -> None:
        """A frame. Raises OSError."""
        frame, state, now = said.frame, self._state, self._epoch_ns + said.frame.host_ns
        if self._first is None:
            self._first = said.number
        number = said.number - self._first
        if state.info.kind == "gravity":
            data = ros.vector(now, self._frame, memoryview(frame.data).cast("B").cast("d").tolist())
            self._writer.write([Message(self._reading, now, number, (data,))])
        else:
            lost, crc = number - self._next, zlib.crc32(frame.data)
            info = ros.FrameInfo(now, frame.ticks, number, lost, crc, frame.shutter, frame.fpa_degC)
            picture = self._pack.pieces(now, frame.data)
            messages = [Message(self._info, now, number, (info.packed(self._frame),))]
            self._writer.write([*messages, Message(self._image, now, number, picture)])
        state.lost += number - self._next
        self._next = number + 1
        state.frames += 1
        state.shutter, state.last = frame.shutter, bytes(frame.data)
        state.arrivals_ns.append(frame.host_ns)
        while state.arrivals_ns[-1] - state.arrivals_ns[0] > RATE_S * 1e9:
            del state.arrivals_ns[0]

    def refused(self) -> None:
        """Count as lost what the disk did not take."""
        count = self._writer.refused(self._reading if self._state.info.kind == "gravity" else self._image)
        self._state.frames -= count
        self._state.lost += count

    def ended(self, number: int) -> None:
        """The stream has ended with so many frames: what was lost behind the last one."""
        self._state.live = False
        if self._first is not None:
            self._state.lost += max(number - self._first - self._next, 0)


class _Disk:
    """Waits for the disk in a thread of its own, so that nobody else does."""

    def __init__(self, file: int) -> None:
        self._file, self._wanted, self._ends = file, threading.Event(), False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def flush(self) -> None:
        """What was written goes to the disk, soon."""
        self._wanted.set()

    def end(self) -> None:
        """Wait for the last of it."""
        self._ends = True
        self._wanted.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ends:
            self._wanted.wait()
            self._wanted.clear()
            with suppress(OSError):  # file systems that cannot; a disk that fails is told by the next write
                getattr(os, "fdatasync", os.fsync)(self._file)
