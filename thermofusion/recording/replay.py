"""Any scan as devices: every later part can be tried without hardware, in real time or faster.

A recording of our own and a fakenect folder play what they hold, bit for bit; other scans play their images as decoded.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..files.pnm import read_pnm
from ..files.reading import read_bytes
from ..scans import open_scan
from ..scans.formats.fakenect import TICK_HZ, TICK_WRAP
from ..scans.formats.recorded import RawStream, raw_streams
from ..scans.native.write import scan_json
from ..types import Camera, Scan, Stream
from .device import POLL_S, Device, EndOfStreamError, Frame, StreamInfo, StreamKind

TICKS_HZ = 1e6  # of the clock that a scan's times are replayed as
START_S = 3.0  # from the start of a recording until replayed frames come: devices are processes, which take a while
BEFORE_S = 1000.0  # on the replayed clock when depth begins: thermal may begin before
FRAMES_AHEAD = 4  # frames that are due at once are handed over together


@dataclass(frozen=True, eq=False)
class _Track:
    """A stream that is played: its description, each frame's time s, and how frame i is fetched."""

    info: StreamInfo
    times_s: NDArray[np.float64]
    ticks: NDArray[np.uint64]
    spoiled: NDArray[np.bool_]
    load: Callable[[int], bytes]


class Replay:
    """A part of a scan as a device. begin_ns : host monotonic time at which the scan's first frame is due. speed : 2 =
    twice as fast; the frames' host times are then the scan's own, so that what is recorded is the same scan."""

    def __init__(self, name: str, tracks: Sequence[_Track], first_s: float, begin_ns: int, speed: float) -> None:
        self.name = name
        self.streams = tuple(t.info for t in tracks)
        self._tracks, self._first_s, self._begin_ns, self._speed = tracks, first_s, begin_ns, speed
        order = sorted((float(t), s, i) for s, track in enumerate(tracks) for i, t in enumerate(track.times_s))
        self._order, self._next = order, 0

    def start(self) -> None:
        """Nothing to be done."""

    def read(self) -> Sequence[Frame]:
        """The frames that are due. Raises ScanError for one that cannot be read, EndOfStreamError behind the last."""
        frames: list[Frame] = []
        until = time.monotonic_ns() + int(POLL_S * 1e9)
        while len(frames) < FRAMES_AHEAD:
            if self._next >= len(self._order):
                if frames:
                    return frames
                raise EndOfStreamError("the scan is at its end")
            t, s, i = self._order[self._next]
            due = self._begin_ns + int((t - self._first_s) * 1e9 / self._speed)
            now = time.monotonic_ns()
            if due > now:
                if frames or due > until:
                    time.sleep(0 if frames else max(until - now, 0) * 1e-9)
                    return frames
                time.sleep((due - now) * 1e-9)
            track = self._tracks[s]
            data = track.load(i)
            stamp = time.monotonic_ns() if self._speed == 1 else self._begin_ns + int((t - self._first_s) * 1e9)
            frames.append(Frame(s, data, stamp, int(track.ticks[i]), 0, bool(track.spoiled[i])))
            self._next += 1
        return frames

    def shutter(self) -> bool:
        """What was recorded has its own."""
        return False

    def stop(self) -> None:
        """Nothing to be done."""


@dataclass(frozen=True)
class Playing:
    """What `record --from` needs: an opener for each device, what stands in the file besides, a rig.json's content."""

    openers: tuple[Callable[[], Device], ...]
    said: dict[str, object]
    rig: dict[str, object] | None
    frames: dict[str, int]


def playing(path: Path, speed: float = 1.0, format: str | None = None) -> Playing:
    """A scan as devices: one for depth and colour, one for thermal. Raises ScanError, RecipeError."""
    scan = open_scan(path, format=format)
    begin_ns = time.monotonic_ns() + int(START_S * 1e9)
    kinds_there = {r.kind for r in raw_streams(path)} if scan.format == "recording" else set()
    thermal = scan.thermal is not None or "thermal" in kinds_there
    groups = [("depth", "color"), ("thermal",)] if thermal else [("depth", "color")]
    openers = tuple(partial(open_replay, path, kinds, begin_ns, speed, format) for kinds in groups)
    document = scan_json(scan)
    rig = {k: document[k] for k in ("cameras", "extrinsics")} if scan.format != "recording" else _rig_beside(path)
    streams = {kind: getattr(scan, kind) for kind in ("depth", "color", "thermal")}
    counts = {kind: len(s) for kind, s in streams.items() if s is not None}
    said = {"environment": document["environment"], "references": _references(scan, document["references"])}
    return Playing(openers, said, rig, counts)


def _references(scan: Scan, rows: list[dict]) -> list[dict]:
    """Blackbodies, their frames as numbers in the stream; points on the skin stand in a world that is not recorded."""
    index = [] if scan.thermal is None else scan.thermal.index.tolist()
    place = {number: k for k, number in enumerate(index)}
    known = [r for r in rows if r["kind"] == "blackbody"]
    return [r | {"frames": [place[n] for n in r["frames"] if n in place]} for r in known]


def _rig_beside(path: Path) -> dict[str, object] | None:
    from ..files.reading import read_json

    beside = (path if path.is_dir() else path.parent) / "rig.json"
    with suppress(ScanError):
        return read_json(beside)
    return None


def open_replay(path: Path, kinds: tuple[str, ...], begin_ns: int, speed: float, format: str | None) -> Replay:
    """The device that plays some of a scan's streams."""
    scan = open_scan(path, format=format)
    if scan.format == "recording":
        raw = raw_streams(scan.root)
        firsts, tracks = [r.times_s[0] for r in raw], [_raw_track(r) for r in raw if r.kind in kinds]
    else:
        firsts = [s.times_s[0] for kind in ("depth", "color", "thermal") if (s := getattr(scan, kind)) is not None]
        tracks = _tracks(scan, kinds)
    return Replay(f"replay of {scan.name} ({', '.join(kinds)})", tracks, min(firsts), begin_ns, speed)


def _tracks(scan: Scan, kinds: tuple[str, ...]) -> list[_Track]:
    found = []
    for kind in kinds:
        stream: Stream | None = getattr(scan, kind)
        if stream is not None:
            make = _kinect_track if (scan.format, kind) == ("fakenect", "depth") else _decoded_track
            found.append(make(scan, stream, kind))  # type: ignore[arg-type]
    return found


def _rate(times_s: NDArray) -> float:
    return float(1 / np.median(np.diff(times_s))) if len(times_s) > 1 else 1.0


def _raw_track(raw: RawStream) -> _Track:
    """A stream of a recording of our own: its bytes as they are."""
    rate = _rate(raw.times_s)
    info = StreamInfo(raw.topic, raw.kind, raw.width_px, raw.height_px, raw.encoding, rate, raw.about, raw.tick_hz)  # type: ignore[arg-type]
    return _Track(info, raw.times_s, raw.ticks, raw.spoiled, raw.load)


def _kinect_track(scan: Scan, stream: Stream, kind: StreamKind) -> _Track:
    """fakenect's raw disparity as a Kinect sends it, its ticks wrapping."""
    lens = scan.rig.depth
    about: dict[str, object] = {"model": "Kinect v1 (fakenect)", "K": lens.K.tolist(), "K_nominal": True}
    info = StreamInfo(
        "kinect/disparity", kind, lens.width_px, lens.height_px, "mono16", _rate(stream.times_s), about, TICK_HZ
    )
    ticks = np.rint(stream.times_s * TICK_HZ).astype(np.int64) % TICK_WRAP

    def load(i: int) -> bytes:
        place = stream.places[i]
        return read_pnm(read_bytes(place, "depth"), place=place, byteorder="<").tobytes()

    return _Track(info, stream.times_s, ticks.astype(np.uint64), ~stream.usable, load)


def _decoded_track(scan: Scan, stream: Stream, kind: StreamKind) -> _Track:
    """Images as the scan decodes them: depth in its own unit, colour, thermal as stored."""
    lens: Camera | None = scan.rig.depth if kind == "depth" else scan.rig.color
    about: dict[str, object] = {}
    if kind == "thermal" and scan.thermal is not None:
        lens = scan.thermal.camera.lens
    if lens is None:
        raise ScanError(f"the {kind} stream has no camera", place=scan.root)
    about |= {"K": lens.K.tolist(), "distortion": lens.distortion.tolist()}
    if kind == "depth":
        about["depth_unit_m"] = scan.depth_unit_m
    first = stream.load(0)
    encoding = {"depth": "16UC1", "color": "rgb8"}.get(kind, "32FC1" if first.dtype == np.float32 else "mono16")
    info = StreamInfo(
        f"replay/{kind}", kind, lens.width_px, lens.height_px, encoding, _rate(stream.times_s), about, TICKS_HZ, 2**63
    )

    def load(i: int) -> bytes:
        image = stream.load(i)
        if kind == "depth":
            image = np.rint(np.nan_to_num(image) / np.float32(scan.depth_unit_m)).astype(np.uint16)
        return np.ascontiguousarray(image).tobytes()

    ticks = np.rint((stream.times_s - scan.depth.times_s[0] + BEFORE_S) * TICKS_HZ).astype(np.uint64)
    return _Track(info, stream.times_s, ticks, ~stream.usable, load)
