"""Fig. 7 and Table 1: how the emissivity of skin falls with the viewing angle, and what water says about it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..files.shipped import data_dir
from ..physics.band import Band
from ..physics.emissivity import COSINE_EPSILON0, HALE_QUERRY_1973, Fresnel, fresnel_reflectivity, water
from ..report.plot import DASHED, GREEN, INK, Area, Axis, Line, Plot, Points, Polar
from ..types import Float
from .models import SKIN, STYLE
from .prepared import Prepared
from .report import Figure, Number

BAND = Band(7.5, 13.5)  # of the paper's camera
NALLI = "nalli2022_water_nk_307_311.csv"
PUBLISHED_WATER = Path("tables", "water_emissivity_vs_incidence.csv")
LABEL = {
    "dielectric": "dielectric, n = 1.33",
    "non-dielectric": "non-dielectric, 1.33 + 0.25i",
    "cosine": "cosine, 0.98 cos θ",
}
EPSILON0_STATED = (0.97, 0.99)  # the paper's 0.98 ± 0.01


def nalli_water(T_K: int) -> tuple[Float, Float, Float]:
    """Wavelength [µm], n, k, each (N,), of water at 307 or 311 K inside 7.5-13.5 µm (Nalli et al. 2022), rising."""
    table = np.loadtxt(data_dir() / "tables" / NALLI, delimiter=",", comments="#")
    wavelength_um, column = 1e4 / table[:, 0], {307: 1, 311: 3}[T_K]
    inside = np.flatnonzero((wavelength_um >= BAND.lo_um) & (wavelength_um <= BAND.hi_um))[::-1]
    return wavelength_um[inside], table[inside, column], table[inside, column + 1]


def spectral_emissivity(cos_theta: Float, n: Float, k: Float) -> Float:
    """ε (W, A), dimensionless, of water at each tabulated wavelength (paper section 2.6.3).

    cos_theta : (A,) cosine of the viewing angle. n, k : (W,) complex index n + ik.
    """
    r_s, r_p = fresnel_reflectivity(cos_theta[None], (n + 1j * k)[:, None])
    return np.asarray(1 - 0.5 * (r_s + r_p))


def figure7(prepared: Prepared) -> list[Figure]:
    """Polar and Cartesian plots of the three models over the band of water's curves; Table 1's own ε(0)."""
    theta = np.linspace(0, 90, 361)
    theta[-1] = 89.999
    cos = np.cos(np.radians(theta))
    models = {name: model(cos) for name, model in SKIN.items()}
    _, n25, k25 = HALE_QUERRY_1973.T
    hale = spectral_emissivity(cos, n25, k25)
    nalli = {T: spectral_emissivity(cos, *nalli_water(T)[1:]) for T in (307, 311)}
    mean = water(BAND)(cos)
    published = _published(prepared.data)
    columns = {"theta_deg": theta, **{m.replace("-", "_"): y for m, y in models.items()}}
    columns |= {"water_mean_306K": mean, "water_hale_querry_min": hale.min(0), "water_hale_querry_max": hale.max(0)}
    for T, e in nalli.items():
        columns |= {f"water_{T}K_min": e.min(0), f"water_{T}K_max": e.max(0)}

    curves = [Line(theta, y, STYLE[m][0], LABEL[m], STYLE[m][1]) for m, y in models.items()]
    green = Area(theta, hale.min(0), hale.max(0), GREEN, "water, 7.5-13.5 µm, each wavelength")
    white = Line(theta, mean, GREEN, "water, band mean (306 K)", width=1.5)
    extra = [] if published is None else [Points(*published, INK, "water, published table", radius=2.4, hollow=True)]
    dashes = {307: "4 2", 311: "1 2"}
    close = [Line(theta, nalli[T].min(0), GREEN, dash=dash, width=1) for T, dash in dashes.items()]
    close += [Line(theta, nalli[T].max(0), GREEN, dash=dash, width=1) for T, dash in dashes.items()]
    x, near = Axis("viewing angle θ [°]", 0, 90, 15), Axis("viewing angle θ [°]", 0, 75, 15)
    unit, top = Axis("emissivity ε(θ)", 0, 1, 0.2), Axis("emissivity ε(θ)", 0.8, 1.0, 0.05)
    panels: list[Polar | Plot] = [
        Polar("(a) polar", Axis("ε(θ)", 0, 1, 0.25), [green, *curves]),
        Plot("(b) Cartesian", x, unit, [green, white, *curves, *extra], "sw"),
        Plot("the same, enlarged", near, top, [green, white, *curves, *close, *extra], "sw"),
        Plot("reflectivity 1 − ε at 60° over the band", *_over_wavelength()),
    ]
    return [
        Figure(
            "fig7",
            "Directional emissivity of skin, Table 1",
            panels,
            {"": columns, "-table1": _table1()},
            _numbers(published),
            _NOTES,
            "Fig. 7  Directional emissivity of skin",
            "Water: Hale & Querry 1973 (25 °C, green area); Nalli et al. 2022 at 307 K (dashed) and 311 K "
            "(dotted) from 7.94 µm on.",
        )
    ]


_NOTES = (
    "Table 1 contradicts the paper's own ε(0) = 0.98 ± 0.01: its non-dielectric n = 1.33, k = 0.25 gives 0.9688. "
    "k = 0.166 would give 0.975, k = 0.236 the lowest value stated.",
    "The cosine model is not within the band of water's curves anywhere beyond 10°.",
)


def _published(data: Path | None) -> tuple[Float, Float] | None:
    path = None if data is None else data / PUBLISHED_WATER
    if path is None or not path.is_file():
        return None
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    return table[:, 0], table[:, 1]


def _over_wavelength() -> tuple[Axis, Axis, list[Line]]:
    cos = np.array([0.5])
    lam, n, k = HALE_QUERRY_1973.T
    lines = [Line(lam, 1 - spectral_emissivity(cos, n, k)[:, 0], GREEN, "water 298 K")]
    for T, dash in ((307, DASHED), (311, "2 3")):
        x, n, k = nalli_water(T)
        lines.append(Line(x, 1 - spectral_emissivity(cos, n, k)[:, 0], INK, f"water {T} K", dash, 1.5))
    for name in ("dielectric", "non-dielectric"):
        lines.append(Line([7.5, 13.5], [1 - float(SKIN[name](0.5))] * 2, STYLE[name][0], name, STYLE[name][1]))
    return Axis("wavelength [µm]", 7.5, 13.5, 1), Axis("reflectivity at 60°", 0, 0.16, 0.04), lines


def _table1() -> dict[str, list[float] | list[str]]:
    rows = [(1.33, 0.0), (1.33, 0.25), (1.33, 0.166), (1.33, 0.236)]
    names = ["dielectric (Table 1)", "non-dielectric (Table 1)", "k for ε(0) = 0.975", "k for ε(0) = 0.970"]
    return {
        "model": [*names, "cosine (Table 1)"],
        "n": [n for n, _ in rows] + [float("nan")],
        "k": [k for _, k in rows] + [float("nan")],
        "epsilon0": [Fresnel(n, k).normal for n, k in rows] + [COSINE_EPSILON0],
    }


def _numbers(published: tuple[Float, Float] | None) -> list[Number]:
    low, high = EPSILON0_STATED
    cos60 = np.cos(np.radians(np.linspace(0, 60, 61)))
    wet = water(BAND)(cos60)
    at60 = {name: float(model(0.5)) for name, model in SKIN.items()}
    numbers = [
        Number("ε(0) dielectric, n = 1.33", SKIN["dielectric"].normal, "", "0.98 ± 0.01", low, high),
        # no bar: that it lies outside the paper's range is the finding
        Number("ε(0) non-dielectric, 1.33 + 0.25i", SKIN["non-dielectric"].normal, "", "0.98 ± 0.01"),
        Number("ε(60°) dielectric (golden value 0.94087440)", at60["dielectric"], "", None, 0.940874, 0.940875),
        Number("ε(60°) non-dielectric (golden 0.91732224)", at60["non-dielectric"], "", None, 0.917322, 0.917323),
        Number("ε(60°) water, band mean (golden 0.95016)", float(water(BAND)(0.5)), "", None, 0.95015, 0.95017),
    ]
    for name, model in SKIN.items():
        worst = float(np.abs(model(cos60) - wet).max())
        said = "differs" if name == "cosine" else "agrees well with water"
        numbers.append(Number(f"largest |ε − ε water| up to 60°, {name}", worst, "", said))
    if published is not None:
        theta, e = published
        off = float(np.abs(water(BAND)(np.cos(np.radians(theta))) - e).max())
        numbers.append(Number("largest |ε water − published table|, 0-75°", off))
    return numbers
