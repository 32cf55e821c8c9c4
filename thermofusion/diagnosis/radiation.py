"""Light that the model used to leave out: the room's own, and what the lens spreads."""

from __future__ import annotations

from ..temperature.room.map import RoomMap
from ..types import LensScatter
from .words import Diagnosis


def of_lens(scatter: LensScatter | None) -> list[Diagnosis]:
    """Light that the lens spreads, where it was found in the scan, or differs from what was stated of the lens."""
    if scatter is not None and scatter.differs:
        seen = 100 * (scatter.share + scatter.differs)
        text = (
            f"the halo that goes with the subject is {seen:.1f} % of the light, {100 * scatter.share:.1f} % are stated"
        )
        done = "what is stated was taken off; the difference is in sigma"
        size = abs(100 * scatter.differs)
        return [Diagnosis("lens scatters other than stated", text, None, "whole image", done, size=size, unit="%")]
    if scatter is None or scatter.stated or not scatter.share:
        return []
    percent = 100 * scatter.share
    width = sum(g * w for g, w in scatter.parts) / scatter.share
    text = (
        f"a halo of {percent:.1f} % of the light, spread over {width:.0%} of the image's width, goes with the subject"
    )
    done = "taken off every picture; its uncertainty is in sigma"
    return [Diagnosis("lens scatters light", text, None, "whole image", done, size=percent, unit="%")]


def of_room(room: RoomMap | None) -> list[Diagnosis]:
    """A stated reflected temperature that the background contradicts."""
    if room is None or not room.contradicts:
        return []
    off = abs(room.difference_K)
    side = "colder" if room.difference_K < 0 else "warmer"
    text = f"the background reads {off:.1f} K {side} than stated, both together err by {room.difference_sigma_K:.1f} K"
    done = "what the background shows was taken"
    return [Diagnosis("reflected temperature stated wrong", text, None, "everywhere", done, size=off, unit="K")]
