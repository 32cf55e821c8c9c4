"""What scan and recipe say of the room."""

from __future__ import annotations

from dataclasses import dataclass

from ...physics.band import ZERO_DEGC_K
from ...recipe import TemperatureSection
from ...types import Environment

DEFAULT_ROOM_DEGC = 23.0  # taken, and said, where neither scan nor recipe knows the reflected temperature
ASSUMED_SIGMA_K = 2.0  # of a reflected temperature that nobody stated


@dataclass(frozen=True)
class Room:
    """Temperatures of what surrounds the subject, K, and what had to be assumed of them; air None: not budgeted.

    measured : reflected_K is what the background of the views says.
    """

    reflected_K: float
    air_K: float | None
    assumed: tuple[str, ...] = ()
    measured: bool = False

    def text(self) -> str:
        """In a few words, for pictures."""
        reflected = f"room {self.reflected_K - ZERO_DEGC_K:.1f} °C reflected{self._how}"
        return reflected if self.air_K is None else f"{reflected}, air {self.air_K - ZERO_DEGC_K:.1f} °C"

    @property
    def _how(self) -> str:
        return " (as measured)" if self.measured else " (assumed)" if self.assumed else ""


def room_of(environment: Environment, settings: TemperatureSection) -> Room:
    """Recipe over scan over the default; what had to be assumed is said."""
    assumed = []
    reflected = environment.reflected_degC if settings.reflected_degC is None else settings.reflected_degC
    air = environment.air_degC if settings.air_degC is None else settings.air_degC
    if reflected is None:
        reflected = DEFAULT_ROOM_DEGC if air is None else air
        assumed.append(
            f"the reflected temperature is not known: {reflected:.1f} °C assumed (an error of 1 K costs 20 mK straight "
            "on, 63 mK at 60°); measure it with crumpled foil"
        )
    return Room(reflected + ZERO_DEGC_K, (reflected if air is None else air) + ZERO_DEGC_K, tuple(assumed))
