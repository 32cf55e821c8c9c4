"""Dead, stuck and blinking pixels, told from the recording itself: no surface, no shutter needed.

But for noise a good pixel lies between its eight neighbours, on edges of the scene and in columns of the sensor, too.
One that stands outside them in frame after frame is left out; bilinear sampling would spread it to every reading that
it touches.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from ..physics.signal import SignalConverter
from ..robust import evenly
from ..types import Bool, ThermalStream

FRAMES = 24  # that are looked at, evenly over the recording
MIN_FRAMES = 8  # fewer tell a pixel from the scene behind it too badly
OUTSIDE_NETD = 4.0  # beyond all neighbours by so much: noise does so once in some ten thousand pixels
SHARE = 0.25  # of the frames: a corner of the scene stays on one pixel in fewer, a blinking pixel is off in half
NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)


def bad_pixels(stream: ThermalStream, frames: NDArray, converter: SignalConverter) -> Bool:
    """(H, W) True where a pixel is dead, stuck or blinking, judged over `frames` (M,), index.

    Raises ScanError for an image that cannot be read.
    """
    chosen = frames[evenly(len(frames), FRAMES)]
    if len(chosen) < MIN_FRAMES:
        return np.zeros(stream.camera.lens.shape, bool)

    reach = OUTSIDE_NETD * stream.camera.netd_K * _slope(stream, converter)

    def outside(frame: int) -> Bool:
        image = converter.radiance(stream.load(frame), stream.places[frame])
        whole = np.where(np.isfinite(image), image, np.nanmedian(image)).astype(np.float32)
        above = whole - cv2.dilate(whole, NEIGHBOURS)
        below = cv2.erode(whole, NEIGHBOURS) - whole
        return np.asarray(np.maximum(above, below) > reach)

    with ThreadPoolExecutor(max_workers=3) as pool:
        found = np.sum(list(pool.map(outside, chosen.tolist())), axis=0)
    return np.asarray(found >= SHARE * len(chosen))


def _slope(stream: ThermalStream, converter: SignalConverter) -> float:
    """dL/dT at the middle of the recording's first frame, W m-2 sr-1 K-1."""
    level = float(np.nanmedian(converter.radiance(stream.load(0), stream.places[0])))
    return float(converter.band.d_radiance_dT(converter.band.temperature_K(level)))
