"""What unit thermal numbers look like: kelvin, Fahrenheit, steps of a kelvin. For refusals that name the way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ROOM_K = (250.0, 330.0)  # the median of a picture of a body in a room lies inside
COLDEST_DEGC = 45.0  # nothing colder in the picture: no room with a body in it
# Steps of a kelvin that cameras store, and who does so.
STEPS_K = {
    0.01: "hundredths of a kelvin (FLIR TLinear, Lepton)",
    0.04: "steps of 0.04 K (FLIR TLinear)",
    1 / 64: "kelvin x 64 (InfiRay, Topdon)",
    1 / 16: "kelvin x 16 (InfiRay)",
    0.1: "tenths of a kelvin",
    1.0: "kelvin",
}
FAHRENHEIT = "--gain 0.5555556 --offset-degC -17.777778"


def looks_like(values: NDArray) -> tuple[str, str] | None:
    """(unit, options of `import` that turn it into °C) that numbers of any shape look like; None = °C, or unknown."""
    finite = values[np.isfinite(values)].astype(np.float64)
    if finite.size == 0:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # damaged numbers look like nothing
        low, median = np.percentile(finite, [1, 50])
    for step_K, name in STEPS_K.items():
        if ROOM_K[0] <= median * step_K <= ROOM_K[1] and low > 0:
            return name, f"--gain {step_K:g} --offset-degC -273.15" if step_K != 1 else "--offset-degC -273.15"
    if low > COLDEST_DEGC and -10 < (median - 32) / 1.8 < 45:
        return "degrees Fahrenheit", FAHRENHEIT
    return None
