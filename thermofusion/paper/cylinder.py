"""The paper's heated cylinder from its real raw frames: decode, outline, profile over angle, correction, what is left.

Frames: Merlin camera, 3-5 µm, 240 bytes of header, then 256 x 320 big-endian counts. Beside each lies the authors' own
mean temperature image; it gives the curve counts -> °C, which nobody recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.optimize import least_squares

from ..errors import ScanError
from ..physics.band import ZERO_DEGC_K, Band
from ..physics.emissivity import EmissivityModel, Fresnel
from ..physics.equation import normal_equivalent, paper_chain
from ..types import Float

SHAPE, HEADER_BYTES = (256, 320), 240
BAND = Band(3.0, 5.0)  # the camera is mid-wave
ROOM_DEGC = 22.63  # the recording's; the paper's text says 23
ALUMINIUM = Fresnel(2.84)  # anodised, ε(0) = 0.770
ROWS = slice(75, 176)  # clear of the clamp and the table
SMOOTH_COLUMNS = 7
FACING_DEG = 1.5  # what counts as straight on: 8 columns
LIMIT_DEG = 60.0  # the paper's range for uniformity
CURVE_DEGREE = 4  # of counts -> °C, as in the paper's Eq. 1
EDGE_COLUMNS = 24  # of each side of the image, for the outline
_FINE = 8  # samples per column in the outline's model


@dataclass(frozen=True, eq=False)
class Frame:
    """One temperature of the phantom.

    water_degC : of the water inside. counts : (256, 320). authors_degC : their mean image. degC : (256, 320) from the
    counts through the fitted curve. curve_rms_K : how well the curve reproduces the authors' image.
    """

    water_degC: int
    counts: NDArray[np.uint16]
    authors_degC: Float
    degC: Float
    curve_rms_K: float


def read_frame(folder: Path, water_degC: int) -> Frame:
    """`TT.raw` with `Aver_ImT_TT.mat`. Raises ScanError if one is missing or has another size."""
    raw, mat = folder / f"{water_degC}.raw", folder / f"Aver_ImT_{water_degC}.mat"
    try:
        data, variables = raw.read_bytes(), loadmat(mat)
    except (OSError, ValueError) as e:
        raise ScanError(f"a frame of the phantom cannot be read ({e})", place=raw) from None
    pixels = SHAPE[0] * SHAPE[1]
    if len(data) < HEADER_BYTES + 2 * pixels:
        raise ScanError(f"expected {HEADER_BYTES} bytes and {pixels} counts, got {len(data)} bytes", place=raw)
    counts = np.frombuffer(data, ">u2", pixels, HEADER_BYTES).reshape(SHAPE).astype(np.uint16)
    images = [np.asarray(v, np.float64) for k, v in variables.items() if not k.startswith("_")]
    if len(images) != 1 or images[0].shape != SHAPE:
        raise ScanError(f"expected one image of {SHAPE[1]} x {SHAPE[0]}", place=mat)
    x = (counts.astype(np.float64) - 45_000) / 10_000
    degC = np.asarray(np.polyval(np.polyfit(x.ravel(), images[0].ravel(), CURVE_DEGREE), x), np.float64)
    return Frame(water_degC, counts, images[0], degC, float(np.sqrt(((degC - images[0]) ** 2).mean())))


@dataclass(frozen=True)
class Outline:
    """The cylinder in the image, columns: axis, radius, point spread (sigma), and the fit's rms in W m-2 sr-1."""

    axis_px: float
    radius_px: float
    psf_sigma_px: float
    rms: float

    def angle_deg(self, column: NDArray) -> Float:
        """Viewing angle of columns, negative on the left; NaN outside the cylinder."""
        u = (np.asarray(column, np.float64) - self.axis_px) / self.radius_px
        return np.degrees(np.arcsin(np.where(np.abs(u) <= 1, u, np.nan)))


NOMINAL = Outline(160.0, 152.0, float("nan"), float("nan"))  # columns 8..312, as read off by eye


def fit_outline(profile: Float, model: EmissivityModel = ALUMINIUM) -> Outline:
    """Axis and radius from the picture's own edges.

    profile : (320,) apparent in-band radiance of the columns. The model is the Fresnel decay to the limb, the room
    beside it, blurred with a Gaussian; the amplitude and the room are free on each side, so that neither a
    lopsided cylinder nor a lopsided room moves the axis by a tenth of a pixel.
    """
    L_room = float(BAND.radiance(ROOM_DEGC + ZERO_DEGC_K))
    columns = np.r_[:EDGE_COLUMNS, SHAPE[1] - EDGE_COLUMNS - 2 : SHAPE[1]]
    fine = (np.arange(SHAPE[1] * _FINE) + 0.5) / _FINE - 0.5

    def rendered(p: Float) -> Float:
        axis, radius, sigma, *sides = p
        u = (fine - axis) / radius
        cos = np.sqrt(np.maximum(1 - u * u, 1e-12))
        left, right = (np.where(np.abs(u) < 1, L_room + model.relative(cos) * (a - L_room), b) for a, b in
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
        return cls(
            angle,
            smooth,
            BAND.radiance(smooth + ZERO_DEGC_K),
            float(smooth[np.abs(angle) <= FACING_DEG].mean()),
        )

    def decay(self, T_room_degC: float = ROOM_DEGC) -> Float:
        """(T(θ) - Ta)/(T(0) - Ta), as the paper's Eq. 22 normalises it, in temperature."""
        return (self.apparent_degC - T_room_degC) / (self.facing_degC - T_room_degC)

    def decay_radiance(self, T_room_degC: float = ROOM_DEGC) -> Float:
        """The same in radiance: for a uniform room this is ε(θ)/ε(0) itself."""
        L_room = BAND.radiance(T_room_degC + ZERO_DEGC_K)
        return (self.radiance - L_room) / (BAND.radiance(self.facing_degC + ZERO_DEGC_K) - L_room)

    def paper_scale(self, model: EmissivityModel = ALUMINIUM) -> float:
        """S of Eq. 26, from temperatures in degrees Celsius straight on."""
        return self.facing_degC / float(paper_chain(self.facing_degC, model.normal, ROOM_DEGC)[0])

    def paper_degC(self, model: EmissivityModel = ALUMINIUM) -> Float:
        """Eqs. 24-27 in degrees Celsius."""
        cos = np.cos(np.radians(self.angle_deg))
        return paper_chain(self.apparent_degC, model(cos), ROOM_DEGC, S=self.paper_scale(model))[1]

    def radiance_degC(self, model: EmissivityModel = ALUMINIUM, extra: Float | float = 0.0) -> Float:
        """The radiance method, normal-equivalent. extra : measured reflection above the uniform room, (N,)."""
        L_room = BAND.radiance(ROOM_DEGC + ZERO_DEGC_K)
        E = model.relative(np.cos(np.radians(self.angle_deg)))
        return BAND.temperature_K(normal_equivalent(self.radiance - extra, E, L_room)) - ZERO_DEGC_K

    def extra_radiance(self, model: EmissivityModel = ALUMINIUM) -> Float:
        """(N,) radiance above what a uniform cylinder in a uniform room shows: what the room adds by reflection."""
        L_room = BAND.radiance(ROOM_DEGC + ZERO_DEGC_K)
        E = model.relative(np.cos(np.radians(self.angle_deg)))
        return self.radiance - L_room - E * (BAND.radiance(self.facing_degC + ZERO_DEGC_K) - L_room)


@dataclass(frozen=True)
class Uniformity:
    """Peak to peak within ±60°, K: of all, of the even part (mean of both sides), and of either side alone."""

    all_K: float
    symmetric_K: float
    left_K: float
    right_K: float

    @classmethod
    def of(cls, angle_deg: Float, degC: Float) -> Uniformity:
        """From a profile (N,) over rising angles."""
        grid = np.linspace(0, LIMIT_DEG, 121)
        right, left = np.interp(grid, angle_deg, degC), np.interp(-grid, angle_deg, degC)
        inside = degC[np.abs(angle_deg) <= LIMIT_DEG]
        return cls(*(float(np.ptp(v)) for v in (inside, (left + right) / 2, left, right)))


def reflection_from(others: Sequence[Profile], angle_deg: Float) -> Float:
    """(N,) what the room adds at these angles, measured at other temperatures of the cylinder.

    A reflection is the same radiance whatever the cylinder's temperature; a cylinder that is warmer on one side is not.
    """
    return np.asarray(np.mean([np.interp(angle_deg, p.angle_deg, p.extra_radiance()) for p in others], axis=0))


def both_sides(profile: Profile, values: Float, angle_deg: float) -> tuple[float, float]:
    """Values at an angle, left and right of the axis."""
    left, right = np.interp([-angle_deg, angle_deg], profile.angle_deg, values)
    return float(left), float(right)
