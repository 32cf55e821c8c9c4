"""Where the map's expected error cannot be right to a fifth, and why: halves of the views hide what they share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .maperror import MapError

TOLD_WITHIN = 0.2  # of itself: what the expected error is meant to be good for
TAIL_CARRIES = 0.5  # share of the mean square that the largest hundredth of the errors may carry
# Faults that bend every view alike, or whose remainder does: named ones make the error larger than halves tell.
SHARED_FAULTS = (
    "rows are read one after another",
    "outlines do not fit",
    "readings agree by place in the image",
    "recorded poses do not fit the depth",
    "lens scatters other than stated",
)
LEFT_OUT = "surface that is not skin"


def limits(diagnosis: Sequence[Mapping[str, Any]], error: MapError) -> tuple[str, ...]:
    """Sentences for the user. diagnosis : entries of the result's."""
    named = [d["what"] for d in diagnosis]
    shared, out = [what for what in named if what in SHARED_FAULTS], []
    if shared:
        text = f"the map's error cannot be told to a fifth, it is larger than expected here: {', '.join(shared)}"
        out.append(f"{text}; all views share what that does")
    if error.tail_share > TAIL_CARRIES:
        text = f"the RMSE cannot be told to a fifth: one spot in a hundred carries {error.tail_share:.0%} of it"
        out.append(f"{text}, squared")
    if LEFT_OUT in named:
        out.append("the expected error holds for what is not flagged NOT_SKIN")
    return tuple(out)


def gain_limit(error: MapError, temperature_K: NDArray) -> float:
    """The share by which the camera's gain may be off before the MAE grows by a fifth; temperature_K (V,), NaN = none.

    A wrong gain stretches the whole map about its level, which no half of the views contradicts.
    """
    spread_K = float(np.nanmean(np.abs(temperature_K - np.nanmedian(temperature_K))))
    return TOLD_WITHIN * error.error.mae_K / spread_K if spread_K > 0 else float("inf")
