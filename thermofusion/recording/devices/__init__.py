"""The table of cameras that can be recorded: by USB vendor and product, and what opens each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from ...errors import ResourceError
from ..device import Device, UnpluggedError
from ..usb import usb_devices
from . import infiray, kinect, lepton, p2pro, seek

OTHER_PARTS = {kinect.MOTOR: "Kinect v1 motor", kinect.AUDIO: "Kinect v1 audio"}
KNOWN: dict[tuple[int, int], str] = {
    **kinect.CAMERAS,
    **OTHER_PARTS,
    **{ids: row[0] for ids, row in infiray.MODELS.items()},
    p2pro.IDS: p2pro.P2Pro.name,
    lepton.IDS: lepton.Lepton.name,
    **{ids: model.name for ids, model in seek.MODELS.items()},
}


@dataclass(frozen=True, eq=False)
class Found:
    """A camera on the bus. parts : the other USB devices that belong to it (a Kinect's motor)."""

    name: str
    ids: tuple[int, int]
    bus: int
    address: int
    usb: Any
    parts: tuple[Any, ...] = ()

    def open(self, video: Literal["color", "infrared"] = "color") -> Device:
        """The camera, not yet started."""
        if self.ids in kinect.CAMERAS:
            return kinect.Kinect(self.usb, self.parts[0] if self.parts else None, video)
        if self.ids in infiray.MODELS:
            return infiray.InfirayP(self.usb)
        if self.ids in seek.MODELS:
            return seek.Seek(self.usb)
        if self.ids == p2pro.IDS:
            return p2pro.P2Pro()
        return lepton.Lepton()


def cameras(devices: Sequence[Any] | None = None) -> list[Found]:
    """The cameras on the bus. devices : of pyusb, for tests. Raises ResourceError where the bus cannot be listed."""
    devices = usb_devices() if devices is None else devices
    found = []
    for device in devices:
        ids = (device.idVendor, device.idProduct)
        if ids not in KNOWN or ids in OTHER_PARTS:
            continue
        parts = _motor_of(device, devices) if ids in kinect.CAMERAS else ()
        found.append(Found(KNOWN[ids], ids, device.bus or 0, device.address or 0, device, parts))
    return found


def open_camera(ids: tuple[int, int], bus: int, address: int, video: Literal["color", "infrared"] = "color") -> Device:
    """A camera by its place on the bus, in whatever process asks. Raises UnpluggedError if it is not there."""
    for found in cameras():
        if (found.ids, found.bus, found.address) == (ids, bus, address):
            return found.open(video)
    raise UnpluggedError(f"{KNOWN.get(ids, 'the camera')} is not at {bus}:{address} any more", hint="plug it in again")


def _motor_of(camera: Any, devices: Sequence[Any]) -> tuple[Any, ...]:
    """The motor of a Kinect's own hub: the separate device of a model 1414, else the audio device."""
    first = kinect.MOTOR if camera.bcdDevice == kinect.MODEL_1414 else kinect.AUDIO
    return tuple(d for d in devices if (d.idVendor, d.idProduct) == first and d.bus == camera.bus)[:1]


def chosen(names: Sequence[str], found: Sequence[Found]) -> list[Found]:
    """The cameras whose name contains one of the words, all for none. Raises ResourceError for a word without one."""
    if not names:
        return list(found)
    picked = []
    for word in names:
        match = [f for f in found if word.casefold() in f.name.casefold()]
        if not match:
            there = ", ".join(f.name for f in found) or "none"
            raise ResourceError(f"no camera is called '{word}'; on the bus: {there}", hint="see `thermofusion devices`")
        picked += [f for f in match if f not in picked]
    return picked
