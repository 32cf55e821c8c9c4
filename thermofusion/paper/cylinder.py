"""The paper's heated cylinder: outline in the picture, profile over the angle, correction, what is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..physics.band import ZERO_DEGC_K, Band
from ..physics.equation import paper_chain
from ..types import Float
from .laboratory import SHAPE
from .models import ALUMINIUM, by_radiance_degC

BAND = Band(3.0, 5.0)  # the camera is mid-wave
ROOM_DEGC = 22.63  # the recording's; the paper's text says 23
L_ROOM = float(BAND.radiance(ROOM_DEGC + ZERO_DEGC_K))  # W m-2 sr-1
ROWS = slice(75, 176)  # clear of the clamp and the table
SMOOTH_COLUMNS = 7  # px; 2.7° in the middle of the cylinder
FACING_DEG = 1.5  # what counts as straight on: 8 columns
LIMIT_DEG = 60.0  # the paper's range for uniformity
EDGE_COLUMNS = 24  # of each side of the image, for the outline
_FINE = 8  # samples per column in the outline's model


@dataclass(frozen=True)
class Outline:
    """The cylinder in the image, columns: axis, radius, point spread (sigma), and the fit's rms in W m-2 sr-1."""

    axis_px: float
    radius_px: float
    psf_sigma_px: float
    rms: float

    def angle_deg(self, column: NDArray) -> Float:
        """Viewing angle of columns (N,) px, negative on the left; NaN outside the cylinder."""
        u = (np.asarray(column, np.float64) - self.axis_px) / self.radius_px
        return np.degrees(np.arcsin(np.where(np.abs(u) <= 1, u, np.nan)))


NOMINAL = Outline(160.0, 152.0, float("nan"), float("nan"))  # columns 8..312, as read off by eye


def fit_outline(profile: Float) -> Outline:
    """Axis and radius from the picture's own edges.

    profile : (320,) apparent in-band radiance of the columns, W m-2 sr-1. The model is the Fresnel decay to the limb,
    the room beside it, blurred with a Gaussian; the amplitude and the room are free on each side, so that neither a
    lopsided cylinder nor a lopsided room moves the axis by a tenth of a pixel.
    """
    columns = np.r_[:EDGE_COLUMNS, SHAPE[1] - EDGE_COLUMNS - 2 : SHAPE[1]]
    fine = (np.arange(SHAPE[1] * _FINE) + 0.5) / _FINE - 0.5

    def rendered(p: Float) -> Float:
        axis, radius, sigma, *sides = p
        u = (fine - axis) / radius
        cos = np.sqrt(np.maximum(1 - u * u, 1e-12))
        left, right = (np.where(np.abs(u) < 1, L_ROOM + ALUMINIUM.relative(cos) * (a - L_ROOM), b) for a, b in
                       (sides[:2], sides[2:]))  # fmt: skip
        reach = np.arange(-int(6 * sigma * _FINE) - 1, int(6 * sigma * _FINE) + 2) / _FINE
        kernel = np.exp(-0.5 * (reach / sigma) ** 2)
        padded = np.pad(np.where(u < 0, left, right), len(kernel), mode="edge")
        blurred = np.convolve(padded, kernel / kernel.sum(), "same")[len(kernel) : -len(kernel)]
        return np.asarray(blurred.reshape(SHAPE[1], _FINE).mean(1))

    start = [159.0, 151.0, 1.2, profile[30], profile[0], profile[290], profile[-1]]
    scale = [1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.1]
    fit = least_squares(lambda p: (rendered(p) - profile)[columns], start, x_scale=scale)
    axis, radius, sigma = (float(v) for v in fit.x[:3])
    return Outline(axis, radius, sigma, float(np.sqrt((fit.fun**2).mean())))


@dataclass(frozen=True, eq=False)
class Profile:
    """Apparent temperature over the viewing angle: means of the clean rows, smoothed over 7 columns.

    angle_deg : (N,) rising, negative on the left. apparent_degC, radiance : (N,). facing_degC : straight on.
    """

    angle_deg: Float
    apparent_degC: Float
    radiance: Float
    facing_degC: float

    @classmethod
    def of(cls, degC: Float, outline: Outline) -> Profile:
        """From a temperature image (256, 320)."""
        mean = degC[ROWS].mean(0)
        smooth = np.convolve(mean, np.full(SMOOTH_COLUMNS, 1 / SMOOTH_COLUMNS), "same")
        angle = outline.angle_deg(np.arange(SHAPE[1]))
        half = SMOOTH_COLUMNS // 2
        inside = np.flatnonzero(np.isfinite(angle) & (np.abs(np.arange(SHAPE[1]) - 159.5) < 159.5 - half))
        angle, smooth = angle[inside], smooth[inside]
        facing_degC = float(smooth[np.abs(angle) <= FACING_DEG].mean())
        return cls(angle, smooth, BAND.radiance(smooth + ZERO_DEGC_K), facing_degC)

    @property
    def cos(self) -> Float:
        """(N,) cosine of the viewing angle."""
        return np.cos(np.radians(self.angle_deg))

    def decay(self) -> Float:
        """(N,) (T(θ) - Ta)/(T(0) - Ta), dimensionless, as the paper's Eq. 22 normalises it, in temperature."""
        return (self.apparent_degC - ROOM_DEGC) / (self.facing_degC - ROOM_DEGC)

    def decay_radiance(self) -> Float:
        """(N,) the same in radiance: for a uniform room this is ε(θ)/ε(0) itself."""
        return (self.radiance - L_ROOM) / (BAND.radiance(self.facing_degC + ZERO_DEGC_K) - L_ROOM)

    def paper_scale(self) -> float:
        """S of Eq. 26, from temperatures in degrees Celsius straight on."""
        return self.facing_degC / float(paper_chain(self.facing_degC, ALUMINIUM.normal, ROOM_DEGC)[0])

    def paper_degC(self) -> Float:
        """Eqs. 24-27 in degrees Celsius, (N,)."""
        return paper_chain(self.apparent_degC, ALUMINIUM(self.cos), ROOM_DEGC, S=self.paper_scale())[1]

    def radiance_degC(self, extra: Float | float = 0.0) -> Float:
        """The radiance method, normal-equivalent, (N,) °C. extra : measured reflection above the uniform room, (N,)."""
        return by_radiance_degC(self.radiance - extra, self.cos, ALUMINIUM, L_ROOM, BAND)

    def extra_radiance(self) -> Float:
        """(N,) radiance above what a uniform cylinder in a uniform room shows: what the room adds by reflection."""
        E = ALUMINIUM.relative(self.cos)
        return self.radiance - L_ROOM - E * (BAND.radiance(self.facing_degC + ZERO_DEGC_K) - L_ROOM)


@dataclass(frozen=True)
class Uniformity:
    """Peak to peak within ±60°, K: of all, of the even part (mean of both sides), and of either side alone."""

    all_K: float
    symmetric_K: float
    left_K: float
    right_K: float

    @classmethod
    def of(cls, angle_deg: Float, degC: Float) -> Uniformity:
        """From a profile: degC (N,) over rising angle_deg (N,)."""
        grid = np.linspace(0, LIMIT_DEG, 121)
        right, left = np.interp(grid, angle_deg, degC), np.interp(-grid, angle_deg, degC)
        inside = degC[np.abs(angle_deg) <= LIMIT_DEG]
        return cls(*(float(np.ptp(v)) for v in (inside, (left + right) / 2, left, right)))


def corrected_degC(degC: Float, outline: Outline, paper_scale: float | None = None) -> Float:
    """A whole image degC (256, 320) corrected with the angle of its columns; NaN beyond 80° and outside the cylinder.

    By radiance, or with the paper's Eqs. 24-27 where their S is given.
    """
    angle = outline.angle_deg(np.arange(SHAPE[1]))
    inside = np.flatnonzero(np.abs(angle) <= 80)
    cos, seen = np.cos(np.radians(angle[inside])), degC[:, inside]
    image = np.full(SHAPE, np.nan)
    if paper_scale is not None:
        image[:, inside] = paper_chain(seen, ALUMINIUM(cos), ROOM_DEGC, S=paper_scale)[1]
    else:
        image[:, inside] = by_radiance_degC(BAND.radiance(seen + ZERO_DEGC_K), cos, ALUMINIUM, L_ROOM, BAND)
    return image


def reflection_from(others: Sequence[Profile], angle_deg: Float) -> Float:
    """(N,) W m-2 sr-1: what the room adds at angle_deg (N,), measured at other temperatures of the cylinder.

    A reflection is the same radiance whatever the cylinder's temperature; a cylinder that is warmer on one side is not.
    """
    return np.asarray(np.mean([np.interp(angle_deg, p.angle_deg, p.extra_radiance()) for p in others], axis=0))


def two_sided(profile: Profile, values: Float, angle_deg: Float) -> Float:
    """(M,) mean of both sides at angle_deg (M,) of values (N,) along a profile, in the values' own unit."""
    return 0.5 * (np.interp(angle_deg, profile.angle_deg, values) + np.interp(-angle_deg, profile.angle_deg, values))
