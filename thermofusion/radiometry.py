"""Signal, in-band radiance, temperature: the measurement equation, forwards and backwards.

Inside the method everything is linear in in-band radiance L [W m-2 sr-1]; a temperature is computed once, at the end.
Formulas, their sources and the golden values stand in docs/radiometry.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import ScanError
from .types import Float, Float32, SignalCurve, ThermalSensor

ZERO_DEGC_K = 273.15
_H, _C, _K = 6.62607015e-34, 299792458.0, 1.380649e-23  # CODATA 2018, exact: J s, m/s, J/K
_C1 = 2 * _H * _C**2  # W m2 sr-1
_C2 = _H * _C / _K  # m K

TABLE_K = (150.0, 1500.0)  # temperatures a band's table covers; NaN outside
_STEP_K = 0.5
_KNOTS = 4096
_NODES = 64  # Gauss-Legendre: exact to rounding for any thermal band
MAX_UNUSABLE = 0.01  # share of an image's pixels that may lie off the radiometric curve (dead pixels)


def planck_radiance(wavelength_um: ArrayLike, T_K: ArrayLike) -> Float:
    """Spectral radiance of a blackbody, W m-2 sr-1 µm-1 (Planck, CODATA 2018 constants)."""
    lam = np.asarray(wavelength_um, np.float64) * 1e-6
    return 1e-6 * _C1 / lam**5 / np.expm1(_C2 / (lam * np.asarray(T_K, np.float64)))


@dataclass(frozen=True)
class Band:
    """A thermal camera's spectral band with a flat response between two wavelengths, in µm.

    Raises ValueError unless 0 < lo_um < hi_um.
    """

    lo_um: float = 7.5
    hi_um: float = 13.5

    def __post_init__(self) -> None:
        if not (0 < self.lo_um < self.hi_um < np.inf):
            raise ValueError(f"a band from {self.lo_um} to {self.hi_um} µm is none")

    def integrate(self, T_K: ArrayLike) -> Float:
        """In-band radiance by Gauss-Legendre quadrature, W m-2 sr-1, to rounding; `radiance` is fast."""
        lam, w = self._quadrature
        T = np.asarray(T_K, np.float64)
        return np.asarray(planck_radiance(lam, T[..., None]) @ w)

    def radiance(self, T_K: ArrayLike) -> Float:
        """In-band radiance L(T) = ∫ Planck, W m-2 sr-1; any shape. 1e-7 relative; NaN outside 150-1500 K."""
        return _hermite(np.asarray(T_K, np.float64), *self._forward)

    def d_radiance_dT(self, T_K: ArrayLike) -> Float:
        """dL/dT, W m-2 sr-1 K-1; any shape, 1e-7 relative; NaN outside 150-1500 K."""
        return _hermite(np.asarray(T_K, np.float64), *self._slope)

    def temperature_K(self, L: ArrayLike) -> Float:
        """Inverse of `radiance`: blackbody temperature, K, to 1e-6 K; NaN outside 150-1500 K."""
        L = np.asarray(L, np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            x = np.log(np.where(L > 0, L, np.nan))
        return _hermite(x, *self._inverse)

    @cached_property
    def _quadrature(self) -> tuple[Float, Float]:
        x, w = np.polynomial.legendre.leggauss(_NODES)
        half = 0.5 * (self.hi_um - self.lo_um)
        return self.lo_um + half * (x + 1), half * w

    def _derivatives(self, T_K: Float) -> tuple[Float, Float, Float]:
        """L, L', L'' by quadrature. With x = c2/(λT): d/dT Planck = Planck·x/(T(1-e^-x))."""
        lam, w = self._quadrature
        T = T_K[..., None]
        B, x = planck_radiance(lam, T), _C2 / (lam * 1e-6 * T)
        g = x / -np.expm1(-x)
        first = B * g / T
        second = first * (g * (1 + np.exp(-x)) - 2) / T
        return B @ w, first @ w, second @ w

    @cached_property
    def _forward(self) -> tuple[float, float, Float]:
        T = np.arange(TABLE_K[0], TABLE_K[1] + _STEP_K / 2, _STEP_K)
        L, dL, _ = self._derivatives(T)
        return float(T[0]), _STEP_K, _cubics(L, dL, _STEP_K)

    @cached_property
    def _slope(self) -> tuple[float, float, Float]:
        T = np.arange(TABLE_K[0], TABLE_K[1] + _STEP_K / 2, _STEP_K)
        _, dL, d2L = self._derivatives(T)
        return float(T[0]), _STEP_K, _cubics(dL, d2L, _STEP_K)

    @cached_property
    def _inverse(self) -> tuple[float, float, Float]:
        """T over ln L, which is nearly straight in 1/T: knots by Newton's method on the quadrature."""
        ends = np.log(self.integrate(np.array(TABLE_K)))
        x = np.linspace(ends[0], ends[1], _KNOTS)
        coarse = np.linspace(*TABLE_K, _KNOTS)
        T = np.interp(x, np.log(self.integrate(coarse)), coarse)
        for _ in range(4):
            L, dL, _ = self._derivatives(T)
            T = T - (np.log(L) - x) * L / dL
        L, dL, _ = self._derivatives(T)
        step = float(x[1] - x[0])
        return float(x[0]), step, _cubics(T, L / dL, step)


def _cubics(y: Float, dy: Float, step: float) -> Float:
    """(4, n-1) coefficients of the cubic Hermite interpolant in t = 0..1 of each interval."""
    y0, y1, m0, m1 = y[:-1], y[1:], dy[:-1] * step, dy[1:] * step
    return np.stack([y0, m0, 3 * (y1 - y0) - 2 * m0 - m1, 2 * (y0 - y1) + m0 + m1])


def _hermite(x: Float, x0: float, step: float, cubics: Float) -> Float:
    """Evaluate a uniform cubic table; NaN outside it."""
    n = cubics.shape[1]
    s = (x - x0) / step
    inside = (s >= -1e-9) & (s <= n + 1e-9)
    i = np.clip(np.where(inside, s, 0), 0, n - 1).astype(np.intp)
    t = s - i
    c0, c1, c2, c3 = (np.take(c, i) for c in cubics)
    return np.asarray(np.where(inside, c0 + t * (c1 + t * (c2 + t * c3)), np.nan))


# ---------------------------------------------------------------- from stored pixels to radiance


class SignalConverter:
    """Stored thermal pixels to apparent in-band radiance.

    Counts go through a look-up table of all 65,536 values, made once. Values where the sensor's curve leaves its
    longest strictly monotone stretch, or 150-1500 K, are off the curve: NaN (dead pixels), an error when more
    than 1 % of an image is.

    Raises ScanError when the curve is incomplete or usable nowhere.
    """

    def __init__(self, sensor: ThermalSensor) -> None:
        self.signal = sensor.signal
        self.band = Band(*sensor.band_um)
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
        return out


def counts_to_kelvin(signal: SignalCurve, counts: Float) -> Float:
    """Apparent temperature of counts through the sensor's curve, K; NaN where the curve gives none (paper Eq. 1)."""
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


# ---------------------------------------------------------------- the measurement equation


def apparent_radiance(
    L_surface: ArrayLike,
    epsilon: ArrayLike,
    L_reflected: ArrayLike,
    *,
    transmission: ArrayLike = 1.0,
    L_air: ArrayLike = 0.0,
    offset: ArrayLike = 0.0,
) -> Float:
    """What the camera reports: τ[ε L_s + (1-ε) L_r] + (1-τ) L_air + b, all W m-2 sr-1; arguments broadcast."""
    eps, tau = np.asarray(epsilon), np.asarray(transmission)
    leaving = eps * np.asarray(L_surface) + (1 - eps) * np.asarray(L_reflected)
    return np.asarray(tau * leaving + (1 - tau) * np.asarray(L_air) + np.asarray(offset))


def leaving_radiance(
    L_apparent: ArrayLike, *, transmission: ArrayLike = 1.0, L_air: ArrayLike = 0.0, offset: ArrayLike = 0.0
) -> Float:
    """Radiance that left the surface towards the camera: offset and air path removed."""
    tau = np.asarray(transmission)
    return np.asarray((np.asarray(L_apparent) - np.asarray(offset) - (1 - tau) * np.asarray(L_air)) / tau)


def normal_equivalent(L_leaving: ArrayLike, relative_epsilon: ArrayLike, L_reflected: ArrayLike) -> Float:
    """What the camera would report looking straight on: L0 = L_r + (L - L_r)/E with E = ε(θ)/ε(0).

    Independent of ε(0); the radiance form of the paper's S step (Eqs. 26-27).
    """
    L_r = np.asarray(L_reflected)
    return np.asarray(L_r + (np.asarray(L_leaving) - L_r) / np.asarray(relative_epsilon))


def absolute(L_normal: ArrayLike, epsilon0: ArrayLike, L_reflected: ArrayLike) -> Float:
    """Radiance of a blackbody at the surface's temperature: L_s = L_r + (L0 - L_r)/ε(0)."""
    L_r = np.asarray(L_reflected)
    return np.asarray(L_r + (np.asarray(L_normal) - L_r) / np.asarray(epsilon0))


def paper_chain(
    T_apparent_degC: ArrayLike, epsilon: ArrayLike, T_ambient_degC: ArrayLike, *, S: ArrayLike = 1.0
) -> tuple[Float, Float]:
    """The paper's own linear correction as printed, in degrees Celsius: (T_c, S·T_c).

    Eq. 25: T_c = (T - (1-ε) T_a)/ε. Eqs. 26-27 scale the Celsius value by S = T(0)/T_c(0), the ratio of measured to
    corrected temperature where the surface faces the camera. Linear in temperature and dependent on the unit
    (docs/radiometry.md, errata): kept for comparison.
    """
    eps = np.asarray(epsilon)
    T_c = (np.asarray(T_apparent_degC) - (1 - eps) * np.asarray(T_ambient_degC)) / eps
    return np.asarray(T_c), np.asarray(np.asarray(S) * T_c)
