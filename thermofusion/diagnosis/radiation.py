"""What the room's light says against what was stated of it."""

from __future__ import annotations

from ..temperature.room.map import RoomMap
from .words import Diagnosis


def of_room(room: RoomMap | None) -> list[Diagnosis]:
    """A stated reflected temperature that the background contradicts."""
    if room is None or not room.contradicts:
        return []
    off = abs(room.difference_K)
    side = "colder" if room.difference_K < 0 else "warmer"
    text = f"the background reads {off:.1f} K {side} than stated, both together err by {room.difference_sigma_K:.1f} K"
    done = "what the background shows was taken"
    return [Diagnosis("reflected temperature stated wrong", text, None, "everywhere", done, size=off, unit="K")]
