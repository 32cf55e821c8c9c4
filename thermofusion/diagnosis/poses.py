"""Where the cameras stood: recorded poses that the depth contradicts, a thermal camera that was knocked."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..rig.knock import Knocks
from ..tracking.faults import PoseFault
from .words import Diagnosis


def of_poses(faults: Iterable[PoseFault]) -> tuple[Diagnosis, ...]:
    """Each fault as an entry; what it does to readings is not known once it is mended."""
    return tuple(Diagnosis(f.what, f.evidence, None, f.where, f.done, size=f.size, unit=f.unit) for f in faults)


def of_knocks(knocks: Knocks | None, index: NDArray[np.int64]) -> list[Diagnosis]:
    """A thermal camera that did not stay where it was; index : (F,) the frames' own numbers."""
    if knocks is None:
        return []
    deg, mm = knocks.sizes()
    text = (
        f"outlines of all views fit one rig to {knocks.before_px:.2f} px, and to {knocks.after_px:.2f} px where the "
        f"camera may have turned by up to {deg:.2f}° and moved by {mm:.1f} mm"
    )
    where = "from thermal frame " + " and from ".join(str(int(index[f])) for f in knocks.frame) + " on"
    what, done = "thermal camera was knocked", "a rig of its own was solved for on either side"
    return [Diagnosis(what, text, None, where, done, size=deg, unit="deg")]
