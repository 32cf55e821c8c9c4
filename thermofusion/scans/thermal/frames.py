"""Frames of a thermal camera by itself, whatever wrote them, and what a person says of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...physics.band import ZERO_DEGC_K
from ...physics.signal import counts_to_kelvin
from ...types import Environment, Float, Float32, FrameConditions, SignalCurve

APPARENT = SignalCurve("apparent_degC")


@dataclass(frozen=True, eq=False)
class ThermalSaid:
    """What a person says of thermal files. gain, offset_degC : °C = gain * stored + offset_degC. curve : of counts."""

    gain: float | None = None
    offset_degC: float | None = None
    curve: SignalCurve | None = None

    @property
    def linear(self) -> tuple[float, float] | None:
        """(gain, offset in °C), if either was said."""
        if self.gain is None and self.offset_degC is None:
            return None
        return (1.0 if self.gain is None else self.gain), self.offset_degC or 0.0


@dataclass(frozen=True, eq=False)
class ThermalFrames:
    """A recording of a thermal camera alone; images are decoded when asked for.

    shape : (H, W). load : i -> (H, W) as stored (uint16 counts or float32). times_s : (N,) the camera's own clock, s,
    NaN = not stated. places : where each came from. signal : how a stored value becomes an apparent blackbody
    temperature; None = the files do not say. object_degC : i -> (H, W) float32, by the file's own emissivity, distance
    and room; for comparison only. environment : what the camera was told of the room, with the first frame;
    conditions : with each. notes : what had to be assumed.
    """

    shape: tuple[int, int]
    load: Callable[[int], NDArray]
    times_s: NDArray[np.float64]
    places: tuple[str, ...]
    signal: SignalCurve | None
    object_degC: Callable[[int], Float32] | None = None
    environment: Environment = field(default_factory=Environment)
    notes: tuple[str, ...] = ()
    conditions: FrameConditions | None = None

    def __len__(self) -> int:
        return len(self.places)

    @cached_property
    def images(self) -> NDArray:
        """(N, H, W) all frames as stored: of short recordings."""
        return np.stack([self.load(i) for i in range(len(self))])

    @property
    def degC(self) -> Float32 | None:
        """(N, H, W) all of `object_degC`, °C: of short recordings."""
        return None if self.object_degC is None else np.stack([self.object_degC(i) for i in range(len(self))])

    def part(self, kept: NDArray) -> ThermalFrames:
        """The frames at the positions kept (M,)."""
        rows, object_degC = kept.tolist(), self.object_degC
        return replace(
            self,
            load=lambda i: self.load(rows[i]),
            times_s=self.times_s[kept],
            places=tuple(self.places[k] for k in rows),
            object_degC=None if object_degC is None else lambda i: object_degC(rows[i]),
            conditions=None if self.conditions is None else self.conditions.take(kept),
        )

    def apparent_degC(self, i: int) -> Float:
        """(H, W) °C of a blackbody that would give frame i. Raises ScanError where the files name no signal."""
        return to_degC(self.load(i), self.signal, self.places[i])


def to_degC(stored: NDArray, signal: SignalCurve | None, place: object) -> Float:
    """Apparent °C (H, W) of stored values (H, W) by a curve of counts, or as they stand. Raises ScanError without."""
    if signal is None or signal.kind == "radiance":
        raise ScanError("the values have no curve to temperature", place=place)
    if signal.kind == "apparent_degC":
        with np.errstate(invalid="ignore"):  # a damaged NaN warns when it is widened
            return stored.astype(np.float64)
    return counts_to_kelvin(signal, stored.astype(np.float64)) - ZERO_DEGC_K


def one_frame(image: NDArray, place: object, signal: SignalCurve | None = APPARENT, **more: object) -> ThermalFrames:
    """A file of one frame that has been decoded, (H, W); more : further fields of `ThermalFrames`."""
    time = np.array([more.pop("time_s", np.nan)], np.float64)
    return ThermalFrames(image.shape[:2], lambda i: image, time, (str(place),), signal, **more)  # type: ignore[arg-type]


def joined(parts: Sequence[ThermalFrames]) -> ThermalFrames:
    """Recordings of one camera in a row: by their clock where all state a time, else as they stand.

    Where the curves differ (another range; an offset that moves from picture to picture) every frame is turned into
    apparent °C by its own. Raises ScanError where sizes differ.
    """
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    for p in parts:
        if p.shape != first.shape:
            (h, w), (h0, w0) = p.shape, first.shape
            raise ScanError(f"the frames differ in size: {w} x {h} px, others {w0} x {h0}", place=p.places[0])
    rows = [(k, i) for k, p in enumerate(parts) for i in range(len(p))]
    times = np.concatenate([p.times_s for p in parts])
    order = np.argsort(times, kind="stable") if np.isfinite(times).all() else np.arange(len(times))
    rows = [rows[n] for n in order]
    same = all(_curve(p.signal) == _curve(first.signal) for p in parts)
    objects = all(p.object_degC is not None for p in parts)

    def load(n: int) -> NDArray:
        k, i = rows[n]
        stored = parts[k].load(i)
        return stored if same else to_degC(stored, parts[k].signal, parts[k].places[i]).astype(np.float32)

    def object_degC(n: int) -> Float32:
        k, i = rows[n]
        one = parts[k].object_degC
        assert one is not None
        return one(i)

    notes = dict.fromkeys(n for p in parts for n in p.notes)
    if not same:
        notes["the files differ in their curve: every frame is turned into apparent degC by its own"] = None
    return replace(
        first,
        load=load,
        times_s=times[order],
        places=tuple(parts[k].places[i] for k, i in rows),
        signal=first.signal if same else APPARENT,
        object_degC=object_degC if objects else None,
        notes=tuple(notes),
        conditions=_conditions(parts, order),
    )


def _conditions(parts: Sequence[ThermalFrames], order: NDArray[np.intp]) -> FrameConditions | None:
    """Of all frames of some recordings (N,), put in an order (N,)."""
    columns = {}
    for name in (f.name for f in fields(FrameConditions)):
        own = [np.full(len(p), np.nan) if p.conditions is None else getattr(p.conditions, name) for p in parts]
        columns[name] = np.concatenate(own)[order]
    return FrameConditions.of(len(order), columns)


def _curve(signal: SignalCurve | None) -> object:
    return None if signal is None else (signal.kind, signal.curve, signal.parameters)
