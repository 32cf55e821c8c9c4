"""What a camera is to the recorder: streams, start, read, shutter, stop. A new camera is one file in `devices`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

from ..errors import ResourceError

StreamKind = Literal["depth", "color", "thermal", "infrared", "gravity"]
BYTES_PER_PIXEL = {"mono16": 2, "16UC1": 2, "bayer_grbg8": 1, "mono8": 1, "rgb8": 3, "32FC1": 4, "float64": 8}
POLL_S = 0.1  # the longest that `read` waits: so soon a stop is heard


class UnpluggedError(ResourceError):
    """The device has gone from the bus: what it delivered before stays."""


class EndOfStreamError(ResourceError):
    """The device has delivered all that it has: a replay at its end."""


@dataclass(frozen=True)
class StreamInfo:
    """One stream of a device.

    name : its topic, `kinect/color`. encoding : of the pixels, as sensor_msgs/Image names it (mono16, bayer_grbg8,
    rgb8; `float64` for readings that are no picture). about : what a reader must know beyond the picture (model,
    constants, signal, K), JSON values. tick_hz : of the device's own clock, 0 = it sends none; tick_wrap : where that
    counter wraps.
    """

    name: str
    kind: StreamKind
    width_px: int
    height_px: int
    encoding: str
    rate_hz: float
    about: Mapping[str, object] = field(default_factory=dict)
    tick_hz: float = 0.0
    tick_wrap: int = 2**32

    @property
    def bytes_per_frame(self) -> int:
        """Size of a frame's data."""
        return self.width_px * self.height_px * BYTES_PER_PIXEL[self.encoding]


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame as it came: stream's row, its data, host monotonic ns of its arrival, the device's own ticks.

    lost : frames of this stream that the device made since the last one and that did not arrive whole. shutter : taken
    during or just after a shutter correction. fpa_degC : the sensor's own temperature, NaN unknown.
    """

    stream: int
    data: bytes | memoryview
    host_ns: int
    ticks: int = 0
    lost: int = 0
    shutter: bool = False
    fpa_degC: float = float("nan")


class Device(Protocol):
    """A camera. `streams` holds after `start`; every method may raise ResourceError, `read` UnpluggedError."""

    @property
    def name(self) -> str:
        """What people call it."""

    streams: tuple[StreamInfo, ...]

    def start(self) -> None:
        """Open it and let it stream."""

    def read(self) -> Sequence[Frame]:
        """The frames that arrived; waits for `POLL_S` at most."""

    def shutter(self) -> bool:
        """Begin a shutter correction now; False where the camera has none that can be asked for."""

    def stop(self) -> None:
        """End the stream and leave the camera as it was. Never raises, may be called twice."""
