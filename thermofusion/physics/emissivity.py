"""How emissivity falls with the viewing angle: ε(θ) of the paper's models, of water, and of tables.

θ is the angle between the surface normal and the pixel's own ray (not the camera axis of the paper's Eq. 28). Models
are small frozen values; `model(cos_theta)` is exact, `AngleTable` serves millions of observations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from scipy.interpolate import PchipInterpolator

from ..compiled import compiled
from ..errors import RecipeError
from ..recipe import EmissivitySection
from ..types import Float
from .band import Band, planck_radiance

COSINE_EPSILON0 = 0.98  # the paper's reference model is 0.98·cosθ
# n, k of the models that take them: the paper's skin, and an effective index of water at 307 K (9e-4 up to 85°)
PRESETS = {"dielectric": (1.33, 0.0), "non-dielectric": (1.33, 0.25), "fitted": (1.2233, 0.1304)}
WATER_T_K = 306.0  # Planck weight of the water model's band average
MIN_BAND_SHARE = 0.75  # share of the band that the water table must cover
LOOKUP_KNOTS = 4097  # linear between them: within 5e-7 for ε of any model

# Hale & Querry, Appl. Opt. 12, 555 (1973): wavelength µm, n, k of water at 25 °C (values CC0 in refractiveindex.info).
HALE_QUERRY_1973 = np.array(
    [
        [7.5, 1.304, 0.0326],
        [8.0, 1.291, 0.0343],
        [8.5, 1.278, 0.03665],
        [9.0, 1.262, 0.0399],
        [9.5, 1.243, 0.04435],
        [10.0, 1.218, 0.0508],
        [10.5, 1.185, 0.0662],
        [11.0, 1.153, 0.0968],
        [11.5, 1.126, 0.142],
        [12.0, 1.111, 0.199],
        [12.5, 1.123, 0.259],
        [13.0, 1.146, 0.305],
        [13.5, 1.177, 0.343],
    ]
)


def fresnel_reflectivity(cos_theta: ArrayLike, m: ArrayLike) -> tuple[Float, Float]:
    """Reflectivity of a smooth surface in air, perpendicular and parallel (|r_s|², |r_p|²).

    cos_theta : cosine of the angle of incidence; m : complex refractive index n + ik; they broadcast. Direct complex
    Fresnel: equals the paper's Eqs. 13-14 (k = 0) and 15-21 without their cancellation at small k.
    """
    c, m = np.asarray(cos_theta, np.float64), np.asarray(m, np.complex128)
    cos_t = np.sqrt(1 - (1 - c * c) / (m * m))
    r_s = (c - m * cos_t) / (c + m * cos_t)
    r_p = (m * c - cos_t) / (m * c + cos_t)
    return np.abs(r_s) ** 2, np.abs(r_p) ** 2


class EmissivityModel:
    """ε(θ). Subclasses give `__call__`."""

    def __call__(self, cos_theta: ArrayLike) -> Float:
        """ε at cosines of the viewing angle in (0, 1]; any shape, exact."""
        raise NotImplementedError

    @property
    def normal(self) -> float:
        """ε(0), seen straight on."""
        return float(self(1.0))

    def relative(self, cos_theta: ArrayLike) -> Float:
        """E(θ) = ε(θ)/ε(0) at cosines of any shape, dimensionless: all that overlapping views can see of ε."""
        return np.asarray(self(cos_theta) / self.normal)

    def derivative(self, theta_rad: ArrayLike) -> Float:
        """dε/dθ in rad-1 at theta_rad of any shape, by central difference (1e-9)."""
        theta, h = np.asarray(theta_rad, np.float64), 1e-5
        return np.asarray((self(np.cos(theta + h)) - self(np.cos(theta - h))) / (2 * h))

    @property
    def hemispherical(self) -> float:
        """∫ ε cosθ dΩ / π: for diffuse exchange between parts of the body."""
        x, w = np.polynomial.legendre.leggauss(64)
        mu = 0.5 * (x + 1)
        return float(np.sum(w * self(mu) * mu))


@dataclass(frozen=True)
class Fresnel(EmissivityModel):
    """A smooth surface of complex refractive index n + ik: the paper's dielectric (k = 0) and non-dielectric models."""

    n: float
    k: float = 0.0

    def __call__(self, cos_theta: ArrayLike) -> Float:
        r_s, r_p = fresnel_reflectivity(cos_theta, complex(self.n, self.k))
        return np.asarray(1 - 0.5 * (r_s + r_p))


@dataclass(frozen=True)
class Cosine(EmissivityModel):
    """The paper's reference model ε = ε0·cosθ."""

    epsilon0: float = COSINE_EPSILON0

    def __call__(self, cos_theta: ArrayLike) -> Float:
        return np.asarray(self.epsilon0 * np.asarray(cos_theta, np.float64))


@dataclass(frozen=True)
class Blackbody(EmissivityModel):
    """ε = 1 at every angle: no correction."""

    def __call__(self, cos_theta: ArrayLike) -> Float:
        return np.ones_like(np.asarray(cos_theta, np.float64))


@dataclass(frozen=True, eq=False)
class Spectral(EmissivityModel):
    """Band average of Fresnel over tabulated n + ik, weights summing to 1."""

    index: NDArray[np.complex128]
    weight: Float

    def __call__(self, cos_theta: ArrayLike) -> Float:
        c = np.asarray(cos_theta, np.float64)
        r_s, r_p = fresnel_reflectivity(c[..., None], self.index)
        return np.asarray(1 - 0.5 * ((r_s + r_p) @ self.weight))


@dataclass(frozen=True, eq=False)
class Tabulated(EmissivityModel):
    """A measured ε(θ): monotone cubic through the table in θ, closed with ε(90°) = 0.

    Raises ValueError unless the angles start at 0 and rise, and 0 < ε <= 1.
    """

    angles_deg: Float
    values: Float

    def __post_init__(self) -> None:
        a, e = np.asarray(self.angles_deg, np.float64), np.asarray(self.values, np.float64)
        if len(a) != len(e) or len(a) < 2 or a[0] != 0 or not (np.diff(a) > 0).all() or a[-1] > 90:
            raise ValueError("angles_deg and values must be equally long, at least 2, rising from 0 to at most 90")
        if not ((e > 0) | (a == 90)).all() or not (e <= 1).all():
            raise ValueError("tabulated emissivities must lie in (0, 1]")
        if a[-1] < 90:
            a, e = np.append(a, 90.0), np.append(e, 0.0)
        object.__setattr__(self, "angles_deg", a)
        object.__setattr__(self, "values", e)
        object.__setattr__(self, "_curve", PchipInterpolator(a, e))

    def __call__(self, cos_theta: ArrayLike) -> Float:
        theta = np.degrees(np.arccos(np.clip(np.asarray(cos_theta, np.float64), 0, 1)))
        curve: PchipInterpolator = self._curve  # type: ignore[attr-defined]
        return np.asarray(curve(theta))


@dataclass(frozen=True)
class Scaled(EmissivityModel):
    """Another model's shape with a given emissivity straight on."""

    model: EmissivityModel
    epsilon0: float

    def __call__(self, cos_theta: ArrayLike) -> Float:
        return np.asarray(self.model(cos_theta) * (self.epsilon0 / self.model.normal))


@dataclass(frozen=True)
class Reshaped(EmissivityModel):
    """A model whose shape was fitted: ε(0)·(E(θ) + s·D(θ)), D = `shape_direction`.

    One parameter carries the skin presets into each other: s = +1 turns n = 1.33 into 1.33 + 0.25i, s ≈ -0.25 into
    water, with 1-2 mK left up to 65° (docs/radiometry.md). E is kept positive and ε at most 1.
    """

    model: EmissivityModel
    s: float
    epsilon0: float

    def __call__(self, cos_theta: ArrayLike) -> Float:
        E = self.model.relative(cos_theta) + self.s * shape_direction(cos_theta)
        return np.asarray(self.epsilon0 * np.clip(E, 1e-3, 1 / self.epsilon0))


def reshaped(model: EmissivityModel, s: float) -> EmissivityModel:
    """A model with a fitted shape s.

    Overlap sees E(θ) = ε(θ)/ε(0) only. For a smooth surface, though, both follow from one n + ik, and ε(0) moves along
    with the shape as it does between the skin presets: by -0.011·s, right to 0.004 for anything from n = 1.2 to water
    to 1.33 + 0.25i. So ε(0) follows where the model is such a surface; where it was declared (`Scaled`, a table), and
    far from skin, it stays.
    """
    if not s:
        return model
    epsilon0 = model.normal
    if follows_shape(model):
        epsilon0 = float(np.clip(epsilon0 + s * (Fresnel(1.33, 0.25).normal - Fresnel(1.33).normal), 0.5, 1.0))
    return Reshaped(model, s, epsilon0)


def follows_shape(model: EmissivityModel) -> bool:
    """Whether ε(0) follows a fitted shape: a smooth surface like skin whose ε(0) was not declared."""
    return isinstance(model, Fresnel | Spectral) and model.normal > 0.9


def shape_direction(cos_theta: ArrayLike) -> Float:
    """D(θ) = E of n = 1.33 + 0.25i less E of n = 1.33, at cosines of any shape, dimensionless.

    The way in which shapes of ε(θ) of skin differ. D(0) = 0.
    """
    return np.asarray(Fresnel(1.33, 0.25).relative(cos_theta) - Fresnel(1.33).relative(cos_theta))


def water(band: Band) -> EmissivityModel:
    """Water: Fresnel with Hale & Querry's n, k averaged over the band, weighted with Planck at 306 K.

    Trapezoid over the table's nodes inside the band and its ends; a band that the table (7.5-13.5 µm) covers for less
    than three quarters is refused with RecipeError.
    """
    lam, n, k = HALE_QUERRY_1973.T
    lo, hi = max(band.lo_um, lam[0]), min(band.hi_um, lam[-1])
    if hi - lo < MIN_BAND_SHARE * (band.hi_um - band.lo_um):
        raise RecipeError(
            f"the water model is tabulated for 7.5-13.5 µm, the camera's band is {band.lo_um:g}-{band.hi_um:g} µm",
            place="emissivity.model",
            hint="use fitted with n and k of this band",
        )
    nodes = np.unique(np.concatenate([[lo, hi], lam[(lam > lo) & (lam < hi)]]))
    step = np.diff(nodes)
    weight = 0.5 * (np.append(step, 0) + np.insert(step, 0, 0)) * planck_radiance(nodes, WATER_T_K)
    index = np.interp(nodes, lam, n) + 1j * np.interp(nodes, lam, k)
    return Spectral(index, weight / weight.sum())


def model_from_recipe(section: EmissivitySection, band: Band) -> EmissivityModel:
    """The recipe's ε(θ) for a camera's band. Raises RecipeError naming the key that does not fit the model."""
    model: EmissivityModel
    if section.model == "tabulated":
        try:
            model = Tabulated(np.array(section.angles_deg), np.array(section.values))
        except ValueError as e:
            raise RecipeError(str(e), place="emissivity.angles_deg") from None
    elif section.model == "water":
        model = water(band)
    elif section.model == "cosine":
        model = Cosine()
    elif section.model == "blackbody":
        model = Blackbody()
    else:
        n, k = PRESETS[section.model]
        if section.model == "dielectric" and section.k:
            raise RecipeError("a dielectric has no extinction", place="emissivity.k", hint="use model = non-dielectric")
        model = Fresnel(section.n or n, k if section.k is None else section.k)
    return model if section.epsilon0 is None else Scaled(model, section.epsilon0)


# ---------------------------------------------------------------- tables for many observations


@dataclass(frozen=True, eq=False)
class AngleTable:
    """A smooth function of cosθ as a table, linear between 4097 knots: within 5e-7 for ε of any model."""

    values: NDArray
    steps: NDArray

    @classmethod
    def of(cls, function: EmissivityModel | NDArray, dtype: DTypeLike = np.float32) -> AngleTable:
        """From a callable of cosines, or its values (K,) at `AngleTable.knots()`; `dtype` is that of the answers."""
        values = function(cls.knots()) if callable(function) else function
        v = np.append(np.asarray(values, np.float64), values[-1])
        return cls(v[:-1].astype(dtype), np.diff(v).astype(dtype))

    @staticmethod
    def knots() -> Float:
        """(K,) cosines 0..1 at which the table is exact."""
        return np.linspace(0, 1, LOOKUP_KNOTS)

    def __call__(self, cos_theta: NDArray) -> NDArray:
        """Values at cosines in [0, 1]; outside the nearest end."""
        cos = np.asarray(cos_theta)
        return np.reshape(_looked_up(self.values, self.steps, np.ravel(cos)), cos.shape)


@compiled
def _looked_up(values: NDArray, steps: NDArray, cos: NDArray) -> NDArray:  # pragma: no cover
    """(N,) of a table's values and steps (K,) at cosines (N,), in the table's type."""
    out = np.empty(cos.size, values.dtype)
    last, zero, one = np.float32(values.size - 1), np.float32(0), np.float32(1)
    for k in range(cos.size):
        x = min(max(np.float32(cos[k]), zero), one) * last
        i = np.uint32(x)
        out[k] = values[i] + steps[i] * (x - np.float32(i))
    return out
