"""The verb that makes recordings: devices, or a scan played as devices, into a folder."""

from __future__ import annotations

import select
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ..errors import RecipeError, ResourceError, counted
from .console import emit, named, note
from .options import Json, spelled_out

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..recording.device import Device
    from ..recording.record import Recording, StreamState

LINE_EVERY_S = 5.0  # without a terminal, a line of state so often
KEYS = "keys: q stops, c corrects the shutter, space starts"


@dataclass(frozen=True)
class Sources:
    """What is recorded."""

    from_: Annotated[
        Path | None, typer.Option("--from", help="Play this scan as devices instead of opening cameras.")
    ] = None
    speed: Annotated[float, typer.Option(min=0.01, max=1000, help="With --from: 2 = twice as fast.")] = 1.0
    format: Annotated[str | None, typer.Option(help="With --from: format of the scan; recognised by default.")] = None
    device: Annotated[
        list[str] | None, typer.Option(help="A word of a camera's name; repeatable; all cameras by default.")
    ] = None
    infrared: Annotated[bool, typer.Option("--infrared", help="The Kinect's infrared in place of its colour.")] = False


@dataclass(frozen=True)
class Ends:
    """When a recording begins and ends."""

    seconds: Annotated[float | None, typer.Option(min=0.1, help="Stop after so many seconds.")] = None
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many depth frames.")] = None
    wait: Annotated[bool, typer.Option("--wait", help="Begin when the space bar is pressed.")] = False
    shutter_every: Annotated[
        float | None, typer.Option(min=5, help="Ask thermal cameras for a shutter correction so often, s.")
    ] = None


@dataclass(frozen=True)
class Room:
    """What a person knows of the room and the rig."""

    rig: Annotated[Path | None, typer.Option(help="rig.json of the cameras, copied into the recording.")] = None
    reflected_degC: Annotated[float | None, typer.Option("--reflected-degC", help="Of the walls around.")] = None
    air_degC: Annotated[float | None, typer.Option("--air-degC", help="Of the air.")] = None
    humidity_pct: Annotated[float | None, typer.Option("--humidity-pct", help="Relative humidity.")] = None

    def environment(self) -> dict[str, float]:
        """What was said, as scan.json names it."""
        said = {"reflected_degC": self.reflected_degC, "air_degC": self.air_degC}
        said["relative_humidity_pct"] = self.humidity_pct
        return {k: v for k, v in said.items() if v is not None}


def register(app: typer.Typer) -> None:
    """Add this module's verb."""
    app.command()(spelled_out(record))


def record(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the recording; must be new.")],
    sources: Sources,
    ends: Ends,
    room: Room,
    json: Json = False,
) -> int:
    """Record depth and thermal cameras, or play a scan as if it were some; what is recorded survives a crash."""
    from ..recording.record import Beside, Until
    from ..recording.record import record as into

    named(out)
    for word in ("SIGTERM", "SIGHUP"):  # a shutdown, a terminal that is closed: they end it as Ctrl-C does
        if hasattr(signal, word):
            signal.signal(getattr(signal, word), signal.default_int_handler)
    openers, said, rig = _opened(sources, room)
    shown = _Shown(json)
    with _keys(ends.wait) as control:
        until = Until(ends.seconds, ends.frames, ends.shutter_every, ends.wait)
        result = into(openers, out, until, control=control, status=shown, beside=Beside(said, rig))
    shown.done()
    streams = {n: {"frames": s.frames, "lost": s.lost} for n, s in result.streams.items()}
    size = f"{result.size_bytes / 2**20:.1f} MiB"
    lines = [f"wrote {out}: {size} in {result.seconds:.1f} s"]
    lines += [f"  {n}: {counted(s.frames, 'frame')}, {s.lost} lost" for n, s in result.streams.items()]
    document = {"scan": out, "streams": streams, "seconds": result.seconds, "problems": result.problems}
    emit(document, "\n".join(lines), json)
    for problem in result.problems:
        note(f"problem: {problem}")
    return 5 if result.problems else 0


def _opened(sources: Sources, room: Room) -> tuple[list[Callable[[], Device]], dict[str, object], object]:
    """Openers of devices, what stands in the file besides, a rig.json's content."""
    environment: dict[str, object] = {**room.environment()}
    rig: Any = None
    if room.rig is not None:
        from ..files.reading import read_json
        from ..scans import Stated

        Stated().with_rig(room.rig)  # faults are said before anything is recorded
        rig = read_json(room.rig)
    if sources.from_ is None:
        from ..recording.devices import cameras, chosen, open_camera

        found = chosen(sources.device or [], cameras())
        if not found:
            hint = "plug one in, or give --from SCAN; `thermofusion doctor` says what the bus shows"
            raise ResourceError("no camera known to thermofusion is on the USB bus", hint=hint)
        video: Literal["color", "infrared"] = "infrared" if sources.infrared else "color"
        return [partial(open_camera, f.ids, f.bus, f.address, video) for f in found], {"environment": environment}, rig
    from ..recording.replay import playing

    played = playing(sources.from_, sources.speed, sources.format)
    known = played.said.get("environment")
    environment = {**(known if isinstance(known, dict) else {}), **environment}
    return list(played.openers), played.said | {"environment": environment}, played.rig if rig is None else rig


# ---------------------------------------------------------------- the terminal


@contextmanager
def _keys(waits: bool) -> Iterator[Callable[[], str | None]]:
    """A control by single keys, where there is a keyboard."""
    words = {"q": "stop", "c": "shutter", " ": "start"}
    if sys.platform == "win32" or sys.stdin is None or not sys.stdin.isatty():
        if waits:
            raise RecipeError("--wait needs a keyboard, and there is none here")
        yield lambda: None
        return
    import termios
    import tty

    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)
    note(KEYS)
    tty.setcbreak(handle)

    def pressed() -> str | None:
        if not select.select([handle], [], [], 0)[0]:
            return None
        return words.get(sys.stdin.read(1))

    try:
        yield pressed
    finally:
        with suppress(OSError):
            termios.tcsetattr(handle, termios.TCSADRAIN, before)


class _Shown:
    """The state of a recording: a table that is drawn anew on a terminal, a line now and then elsewhere."""

    def __init__(self, quiet: bool) -> None:
        self._quiet, self._line_at = quiet, time.monotonic()
        self._live: Any = None
        if not quiet and sys.stderr is not None and sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), auto_refresh=False)
            self._live.start()

    def __call__(self, state: Recording) -> None:
        if self._live is not None:
            self._live.update("\n".join(state_lines(state)), refresh=True)
        elif not self._quiet and time.monotonic() - self._line_at >= LINE_EVERY_S:
            self._line_at = time.monotonic()
            note("; ".join(state_lines(state)))

    def done(self) -> None:
        """Leave the terminal as it was."""
        if self._live is not None:
            self._live.stop()


def state_lines(state: Recording) -> list[str]:
    """What a person who records must see: time, disk, and of each stream rate, losses, temperature, tilt, shutter."""
    import shutil

    free = shutil.disk_usage(state.folder).free / 2**30
    begun = f"{state.seconds:.0f} s" if state.started else "waiting for the space bar"
    lines = [f"{begun}, {state.size_bytes / 2**20:.0f} MiB written, {free:.0f} GiB free"]
    for name, stream in state.streams.items():
        text = f"{name}: {stream.rate_hz:.1f} Hz, {counted(stream.frames, 'frame')}, {stream.lost} lost"
        lines.append(text + _reading(stream) + (", SHUTTER" if stream.shutter else ""))
    return [*lines, *(f"problem: {p}" for p in state.problems)]


def _reading(stream: StreamState) -> str:
    """The middle of the thermal picture in °C, or the tilt in degrees."""
    import numpy as np

    signal: Any = stream.info.about.get("signal")
    if stream.last is None:
        return ""
    if stream.info.kind == "gravity":
        x, y, z = np.frombuffer(stream.last, np.float64)
        return f", tilt {np.degrees(np.arctan2(z, np.hypot(x, y))):.0f}°"
    if stream.info.kind != "thermal" or stream.info.encoding != "mono16" or not isinstance(signal, dict):
        return ""
    curve = signal.get("curve", {})
    image = np.frombuffer(stream.last, "<u2").reshape(stream.info.height_px, stream.info.width_px)
    h, w = image.shape
    middle = float(np.median(image[h // 2 - 4 : h // 2 + 4, w // 2 - 4 : w // 2 + 4]))
    return f", middle {middle * curve.get('gain_K', 0) + curve.get('offset_K', 0) - 273.15:.1f} °C"


__all__ = ["record", "register", "state_lines"]
