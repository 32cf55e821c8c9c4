"""Thermal recordings by themselves, named where a depth recording is asked for: there is nothing to put them on."""

from __future__ import annotations

from pathlib import Path

from ...errors import ScanError
from ...types import Scan
from ..stated import NOTHING, Stated
from ..thermal import read_thermal, recognise

__all__ = ["read", "recognise"]


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Always ScanError: there is no depth here, and a scan needs it. `thermal.read_thermal` has the frames."""
    frames = read_thermal(path)
    h, w = frames.shape
    raise ScanError(
        f"a thermal recording alone ({len(frames)} frames of {w} x {h} px), no depth to put it on",
        place=path,
        hint="join it to its depth recording: `thermofusion import DEPTH --thermal THIS --rig rig.json -o SCAN`",
    )
