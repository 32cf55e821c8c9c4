"""The truth beside a simulated scan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def truth_of(scan: Path) -> dict[str, NDArray]:
    """The arrays of its surface, the file closed again."""
    with np.load(scan / "truth" / "surface.npz") as z:
        return dict(z)
