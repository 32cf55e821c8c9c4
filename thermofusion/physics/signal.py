"""Stored thermal pixels to apparent in-band radiance, through the camera's curve (docs/radiometry.md)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..types import Bool, Float, Float32, LensScatter, SignalCurve, ThermalCamera
from .band import TABLE_K, ZERO_DEGC_K, Band
from .scatter import without_scatter

MAX_UNUSABLE = 0.01  # share of an image's pixels that may lie off the radiometric curve (dead pixels)


class SignalConverter:
    """Stored thermal pixels to apparent in-band radiance.

    Counts go through a look-up table of all 65,536 values, made once. Values where the camera's curve leaves its
    longest strictly monotone stretch, or 150-1500 K, are off the curve: NaN (dead pixels), an error when more
    than 1 % of an image is. bad_pixels : (H, W) mask of pixels that are NaN whatever they say. scatter : of the lens,
    taken off.

    Raises ScanError when the curve is incomplete or usable nowhere.
    """

    def __init__(
        self, camera: ThermalCamera, bad_pixels: Bool | None = None, scatter: LensScatter | None = None
    ) -> None:
        self.signal, self._bad, self.scatter = camera.signal, bad_pixels, scatter
        self.band = Band(*camera.band_um)
        self._lut: Float32 | None = None
        self.counts_range: tuple[int, int] | None = None
        if self.signal.kind == "counts":
            T_K = counts_to_kelvin(self.signal, np.arange(65536.0))
            lo, hi = _longest_monotone(T_K)
            if hi - lo < 2:
                raise ScanError(
                    "the radiometric curve gives no rising temperature between 150 and 1500 K for any count",
                    place="cameras.thermal.signal.curve",
                    hint="check its coefficients and their order",
                )
            lut = np.full(65536, np.nan)
            lut[lo : hi + 1] = self.band.radiance(T_K[lo : hi + 1])
            self._lut, self.counts_range = lut.astype(np.float32), (lo, hi)

    def radiance(self, image: NDArray, place: object = None) -> Float32:
        """Apparent in-band radiance of an image, same shape, float32, W m-2 sr-1; NaN = no usable signal.

        Raises ScanError naming `place` if the image's type does not fit the signal's kind, or too much of it lies
        off the curve.
        """
        if self._lut is not None:
            if image.dtype.kind not in "iu" or (image.dtype.itemsize > 2 and image.size and image.max() > 65535):
                raise ScanError(f"thermal counts are stored as {image.dtype}, expected 16-bit", place=place)
            if image.dtype.kind == "i" and image.size and image.min() < 0:
                raise ScanError("thermal counts are negative", place=place, hint="store them as unsigned 16-bit")
            out = self._lut[image]
        else:
            if image.dtype.kind != "f":
                raise ScanError(
                    f"thermal pixels are {image.dtype}, expected float {self.signal.kind}",
                    place=place,
                    hint="set signal.kind to counts, or store a float32 TIFF",
                )
            if self.signal.kind == "apparent_degC":
                L = self.band.radiance(image + ZERO_DEGC_K)
            else:
                L = np.where(image > 0, image, np.nan)
            out = L.astype(np.float32)
        # NaN in a float image is the camera's own "no measurement"; only what the curve refuses is counted
        measured = np.isfinite(image) if image.dtype.kind == "f" else True
        lost = np.count_nonzero(np.isnan(out) & measured)
        if lost > MAX_UNUSABLE * max(image.size, 1):
            span = (
                ""
                if self.counts_range is None
                else f" (usable counts are {self.counts_range[0]}-{self.counts_range[1]})"
            )
            raise ScanError(
                f"{lost / image.size:.0%} of the thermal pixels lie off the radiometric curve{span}",
                place=place,
                hint="check cameras.thermal.signal",
            )
        if self._bad is not None:
            out[self._bad] = np.nan
        return out if self.scatter is None else without_scatter(out, self.scatter)


def counts_to_kelvin(signal: SignalCurve, counts: Float) -> Float:
    """Apparent temperature of counts, any shape, through the camera's curve, K (paper Eq. 1).

    NaN where the curve gives none. Raises ScanError for an incomplete or unknown curve.
    """
    p, place = signal.parameters, "cameras.thermal.signal.curve"
    try:
        with np.errstate(all="ignore"):
            if signal.curve == "polynomial":
                return np.asarray(np.polynomial.polynomial.polyval(counts, p["coefficients_degC"]) + ZERO_DEGC_K)
            if signal.curve == "linear_kelvin":
                return np.asarray(p["gain_K"][0] * counts + p["offset_K"][0])
            if signal.curve == "planck":
                R, B, F, O = (p[k][0] for k in "RBFO")  # noqa: E741 - the curve's own letters
                ratio = R / (counts - O) + F
                return np.asarray(np.where((counts > O) & (ratio > 1), B / np.log(ratio), np.nan))
            if signal.curve == "table":
                g, degC = np.asarray(p["counts"], np.float64), np.asarray(p["degC"], np.float64)
                if len(g) < 2 or len(g) != len(degC) or not (np.diff(g) > 0).all():
                    raise ScanError("the table needs equally many rising counts and degC, at least two", place=place)
                return np.asarray(np.interp(counts, g, degC, left=np.nan, right=np.nan) + ZERO_DEGC_K)
    except (KeyError, IndexError) as e:
        raise ScanError(f"the '{signal.curve}' curve lacks its parameter {e}", place=place) from None
    raise ScanError(
        "counts need a radiometric curve", place=place, hint="give polynomial, linear_kelvin, planck or table"
    )


def _longest_monotone(T_K: Float) -> tuple[int, int]:
    """First and last index of the longest stretch on which T is strictly monotone and inside the band's table."""
    with np.errstate(invalid="ignore"):
        good = (TABLE_K[0] <= T_K) & (TABLE_K[1] >= T_K)
        step = np.where(good[1:] & good[:-1], np.sign(np.diff(T_K)), 0)
    edges = np.flatnonzero(np.diff(step)) + 1
    starts, ends = np.r_[0, edges], np.r_[edges, len(step)]
    length = np.where(step[starts] != 0, ends - starts, 0)
    best = int(np.argmax(length))
    return int(starts[best]), int(starts[best] + length[best])
