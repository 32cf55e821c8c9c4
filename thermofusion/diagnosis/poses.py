"""Recorded poses that the depth contradicts."""

from __future__ import annotations

from collections.abc import Iterable

from ..tracking.faults import PoseFault
from .words import VOCABULARY, Diagnosis


def of_poses(faults: Iterable[PoseFault]) -> tuple[Diagnosis, ...]:
    """Each fault as an entry; what it does to readings is not known once it is mended."""
    return tuple(
        Diagnosis(f.what, f.evidence, None, f.where, f.done, VOCABULARY[f.what], size=f.size, unit=f.unit)
        for f in faults
    )
