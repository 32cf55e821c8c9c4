"""A result against another one, against its own mirror image, against a truth, or against contact thermometers.

Differences are described as Bland and Altman (1986) do: bias, standard deviation, and the limits of agreement
bias ± 1.96 SD, between which 95 % of normal differences lie. Over a surface every vertex counts by its area.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import RecipeError, ScanError, counted
from ..export import read_mesh
from ..export.columns import result_from, surface_from
from ..files.npz import read_npz
from ..files.reading import is_named
from ..files.tum import MAX_POSITION_M
from ..geometry.mesh import vertex_areas
from ..geometry.rays import RayScene
from ..robust import NORMAL_95, weighted_quantile
from ..temperature.references import CONTACT_FAR_M, under_sensor
from ..types import Float, Float32, ThermalMesh
from ..version import __version__
from .contacts import SkinReading, read_contacts
from .register import Registration, as_they_are, mirrored, register

if TYPE_CHECKING:
    from ..report.plot import Mark

TRUTH_ARRAYS = ("vertices_m", "triangles", "temperature_degC")
MAX_DISTANCE_M = 0.010  # between partners on the two surfaces
FACING = 0.5  # cosine between normals of partners
LOADING_NOTE = (
    "a contact sensor changes what it measures: its lead conducts heat and it covers skin that would radiate and "
    "evaporate. A bias common to all sensors may be theirs; the spread about it is what tests the map"
)


@dataclass(frozen=True)
class Agreement:
    """Bland and Altman's description of differences first - second, K. n : values.

    lower_K, upper_K : limits of agreement, bias ± 1.96 SD. median_K and p2_5_K, p97_5_K : the same without assuming a
    normal distribution. mae_K : mean absolute difference. slope : of the difference with the mean temperature, K/K.
    within_95 : share of differences inside ±1.96 of their combined stated sigma (NaN without one).
    """

    n: int
    bias_K: float
    sd_K: float
    lower_K: float
    upper_K: float
    median_K: float
    p2_5_K: float
    p97_5_K: float
    mae_K: float
    slope: float
    within_95: float

    @classmethod
    def of(
        cls, first: NDArray, second: NDArray, *, weight: NDArray | None = None, sigma_K: NDArray | None = None
    ) -> Agreement:
        """Of paired temperatures (N,), all finite. Raises ScanError with fewer than two."""
        if len(first) < 2:
            raise ScanError(f"{counted(len(first), 'pair')} of temperatures: too few to compare")
        d, mean = np.asarray(first, np.float64) - second, (np.asarray(first, np.float64) + second) / 2
        w = np.ones(len(d)) if weight is None else np.asarray(weight, np.float64)
        w = w / w.sum()
        bias = float(w @ d)
        freedom = 1 - float(w @ w)  # n/(n-1) for equal weights
        sd = float(np.sqrt(w @ (d - bias) ** 2 / freedom))
        spread = w @ (mean - w @ mean) ** 2
        slope = float(w @ ((d - bias) * (mean - w @ mean)) / spread) if spread > 0 else 0.0
        low, middle, high = (weighted_quantile(d, w, q) for q in (0.025, 0.5, 0.975))
        inside = float("nan")
        if sigma_K is not None and np.isfinite(sigma_K).any():
            known = np.isfinite(sigma_K)
            inside = float(w[known] @ (np.abs(d[known]) <= NORMAL_95 * sigma_K[known]) / w[known].sum())
        limits = (bias - NORMAL_95 * sd, bias + NORMAL_95 * sd)
        return cls(len(d), bias, sd, *limits, middle, low, high, float(w @ np.abs(d)), slope, inside)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two temperatures at the same places. first, second : (N,) °C; difference_K : (V,) on the first mesh, NaN where
    there is no partner, or None (contact readings). places : names of single readings.
    """

    kind: str
    agreement: Agreement
    first_degC: Float
    second_degC: Float
    compared: float
    registration: Registration | None = None
    mesh: ThermalMesh | None = None
    difference_K: Float32 | None = None
    places: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()

    def report(self) -> dict[str, object]:
        """The content of `comparison.json`."""
        r = self.registration
        moved = None if r is None else {**vars(r)}
        rows = [
            {"place": name, "map_degC": a, "contact_degC": b, "difference_K": a - b}
            for name, a, b in zip(self.places, self.first_degC, self.second_degC, strict=False)
        ]
        return {
            "software": f"thermofusion {__version__}",
            "kind": self.kind,
            "agreement": self.agreement,
            "compared_fraction": self.compared,
            "registration": moved,
            "readings": rows,
            "messages": self.messages,
        }

    def text(self) -> str:
        """For people."""
        a, lines = self.agreement, []
        if self.registration is not None:
            r = self.registration
            lines.append(
                f"surfaces     {r.residual_mm:.1f} mm apart (median), {r.overlap:.0%} overlap; {self.compared:.0%} of "
                "the first's measured surface compared"
            )
        lines += [
            f"{name:<12} {x:.2f} °C on the map, {y:.2f} °C by contact, {x - y:+.2f} K"
            for name, x, y in zip(self.places, self.first_degC, self.second_degC, strict=False)
        ]
        lines += [
            f"difference   bias {a.bias_K:+.3f} K, SD {a.sd_K:.3f} K, {a.n:,} values ({self.kind})",
            f"agreement    95 % limits {a.lower_K:+.3f} to {a.upper_K:+.3f} K (bias ± 1.96 SD); without "
            f"assuming a normal distribution {a.p2_5_K:+.3f} to {a.p97_5_K:+.3f} K",
            f"             mean absolute difference {a.mae_K:.3f} K; slope {a.slope:+.3f} K per K",
        ]
        if np.isfinite(a.within_95):
            lines.append(f"             {a.within_95:.1%} inside ±1.96 of the two stated sigmas together")
        return "\n".join([*lines, *(f"note         {m}" for m in self.messages)])


def compare(
    first: Path | str,
    second: Path | str,
    *,
    mirror: bool = False,
    moved: bool = True,
    max_distance_m: float = MAX_DISTANCE_M,
) -> Comparison:
    """Compare a result with another, a truth mesh, or contact readings.

    Parameters
    ----------
    first : a result folder or mesh file (.ply, .glb, .vtp). second : the same, a truth (.npz with vertices_m, triangles
    and temperature_degC, or a simulated scan's folder), or contact readings (.csv, .json).
    mirror : the second is mirrored first, left for right. moved : surfaces are registered; False: one frame already.

    Raises ScanError where an input cannot be read or nothing can be compared, RecipeError for options that do not fit.
    """
    mesh, path = load_temperatures(first), Path(second)
    if path.suffix.lower() in (".csv", ".json"):
        if mirror:
            raise RecipeError("contact readings cannot be mirrored")
        return compare_contacts(mesh, read_contacts(path))
    other = load_temperatures(path)
    return compare_meshes(mesh, mirrored(other) if mirror else other, moved=moved, max_distance_m=max_distance_m)


def load_temperatures(path: Path | str) -> ThermalMesh:
    """A mesh with temperatures from a result, a mesh file, a truth archive, or a simulated scan's truth."""
    path = Path(path)
    truth = path / "truth" / "surface.npz"
    if path.suffix.lower() == ".npz" or is_named(truth):
        mesh = _truth(path if path.suffix.lower() == ".npz" else truth)
    elif is_named(path):
        mesh = read_mesh(path)
    else:
        raise ScanError("there is nothing here", place=path, hint="name a result folder, a mesh, a truth or readings")
    if not len(mesh.surface.triangles):
        raise ScanError("the mesh has no triangles", place=path)
    if np.abs(mesh.surface.vertices_m).max() > MAX_POSITION_M:
        text = f"a vertex lies more than {MAX_POSITION_M:.0f} m from the origin, expected metres"
        raise ScanError(text, place=path)
    return mesh


def _truth(path: Path) -> ThermalMesh:
    hint = "a truth holds vertices_m (V, 3), triangles (F, 3) and temperature_degC (V,)"
    vertices, triangles, temperature = read_npz(path, "truth", TRUTH_ARRAYS, hint=hint)
    if triangles.dtype.kind not in "iu" or triangles.shape[1:] != (3,) or vertices.shape[1:] != (3,):
        raise ScanError("the truth's arrays are of other kinds or shapes", place=path, hint=hint)
    surface = surface_from(vertices, triangles, None, None, path)
    return result_from(surface, {"temperature_degC": temperature}, {}, {}, path)


def compare_meshes(
    a: ThermalMesh, b: ThermalMesh, *, moved: bool = True, max_distance_m: float = MAX_DISTANCE_M
) -> Comparison:
    """Temperature differences a - b at the vertices of a, each with the nearest place of b."""
    registration = register(a, b) if moved else as_they_are(a, b)
    other, sigma_b = _at(a, b, registration.T_b_a, max_distance_m)
    difference = a.temperature_degC - other
    good = np.isfinite(difference)
    area = vertex_areas(a.surface.vertices_m, a.surface.triangles)
    pairs = good & (area > 0)
    if pairs.sum() < 2:
        hint = "are they the same subject? try a larger --max-distance-mm"
        raise ScanError("the two surfaces share no measured skin", hint=hint)
    sigma = np.hypot(a.uncertainty_K, np.where(np.isfinite(sigma_b), sigma_b, 0)).astype(np.float64)
    agreement = Agreement.of(a.temperature_degC[pairs], other[pairs], weight=area[pairs], sigma_K=sigma[pairs])
    share = float(area[pairs].sum() / max(area[a.measured].sum(), 1e-12))
    return Comparison(
        "surface against surface, by area",
        agreement,
        a.temperature_degC[pairs].astype(np.float64),
        other[pairs].astype(np.float64),
        share,
        registration,
        a,
        difference.astype(np.float32),
        messages=_remarks(a, b, registration),
    )


def _remarks(a: ThermalMesh, b: ThermalMesh, registration: Registration) -> tuple[str, ...]:
    out = []
    if not registration.converged:
        out.append("the surfaces did not come to rest on each other: the differences may be of different places")
    if a.mode != b.mode:
        out.append(f"the first is {a.mode}, the second {b.mode}: they are different quantities")
    if not (a.anchored and b.anchored):
        out.append("no reference set the level of one of them: the bias says nothing, the SD does")
    return tuple(out)


def _at(a: ThermalMesh, b: ThermalMesh, T_b_a: Float, max_distance_m: float) -> tuple[Float32, Float32]:
    """Temperature and sigma (V_a,) of b at the vertices of a; NaN where b has nothing near that faces alike."""
    R, t = T_b_a[:3, :3].astype(np.float32), T_b_a[:3, 3].astype(np.float32)
    points, normals = a.surface.vertices_m @ R.T + t, a.surface.normals @ R.T
    closest = RayScene(b.surface.vertices_m, b.surface.triangles).closest(points)
    corners, weights = b.surface.triangles[closest.triangle], closest.weights
    near = (closest.distance <= max_distance_m) & ((closest.normal * normals).sum(1) > FACING)

    def interpolated(values: Float32) -> Float32:
        return np.where(near, (values[corners] * weights).sum(1), np.nan).astype(np.float32)

    return interpolated(b.temperature_degC), interpolated(b.uncertainty_K)


def compare_contacts(mesh: ThermalMesh, readings: tuple[SkinReading, ...]) -> Comparison:
    """The map under each contact sensor against its reading. Raises ScanError for a sensor off the surface."""
    map_degC, sigma_K = np.empty(len(readings)), np.empty(len(readings))
    for i, reading in enumerate(readings):
        under, off_m = under_sensor(mesh.surface, reading.p_world_m)
        if off_m > CONTACT_FAR_M:
            raise ScanError(
                f"the contact reading '{reading.name}' is {off_m * 100:.0f} cm off the surface",
                hint="its point is in metres, in the mesh's frame; of the recording's world: see --frame",
            )
        under = under[mesh.measured[under]]
        map_degC[i] = np.mean(mesh.temperature_degC[under]) if len(under) else np.nan
        # errors of neighbouring vertices are not independent: their sigma is not divided by their number
        sigma_K[i] = np.hypot(np.mean(mesh.uncertainty_K[under]), reading.uncertainty_K) if len(under) else np.nan
    contact_degC = np.array([r.degC for r in readings])
    good = np.isfinite(map_degC)
    agreement = Agreement.of(map_degC[good], contact_degC[good], sigma_K=sigma_K[good])
    lost = [r.name for r, ok in zip(readings, good, strict=True) if not ok]
    notes = [f"unmeasured skin under: {', '.join(lost)}"] if lost else []
    if not mesh.anchored:
        notes.append("no reference set the level of the map: the bias says nothing, the SD does")
    return Comparison(
        "map against contact sensors",
        agreement,
        map_degC[good],
        contact_degC[good],
        float(good.mean()),
        places=tuple(r.name for r, ok in zip(readings, good, strict=True) if ok),
        messages=(*notes, LOADING_NOTE),
    )


# ---------------------------------------------------------------- files


PLOT_POINTS = 1500  # a plot of more dots is a cloud


def bland_altman_svg(comparison: Comparison) -> str:
    """Differences over means with bias and limits of agreement, as an SVG document."""
    from ..report.plot import BLUE, DASHED, ORANGE, Axis, Plot, Points, Rule, page

    c, a = comparison, comparison.agreement
    pick = slice(None, None, max(1, len(c.first_degC) // PLOT_POINTS))
    mean, d = (c.first_degC[pick] + c.second_degC[pick]) / 2, (c.first_degC - c.second_degC)[pick]
    reach = max(float(np.percentile(np.abs(d), 99.5)), abs(a.lower_K), abs(a.upper_K)) * 1.15 + 1e-3
    x = Axis.spanning("mean of both, °C", float(mean.min()) - 0.1, float(mean.max()) + 0.1)
    y = Axis.spanning("first minus second, K", -reach, reach)
    marks: list[Mark] = [
        Points(mean, d, BLUE, radius=1.4 if len(d) > 100 else 3.0),
        Rule(a.bias_K, color=ORANGE, dash=""),
        Rule(a.lower_K, color=ORANGE, dash=DASHED),
        Rule(a.upper_K, color=ORANGE, dash=DASHED),
    ]
    caption = f"bias {a.bias_K:+.3f} K, 95 % limits of agreement {a.lower_K:+.3f} to {a.upper_K:+.3f} K; {a.n} values"
    return page([Plot("Bland-Altman", x, y, marks)], caption=caption, columns=1, panel_px=(640.0, 420.0))


def write_comparison(comparison: Comparison, folder: Path) -> list[Path]:
    """`comparison.json`, `bland-altman.svg` and, for surfaces, pictures of the difference; each whole or not at all."""
    from ..files.json import to_json
    from ..files.whole import write_text
    from ..report.pictures import difference_scale, render_scalar, write_png

    write_text(folder / "bland-altman.svg", bland_altman_svg(comparison))
    written = [folder / "bland-altman.svg"]
    if comparison.mesh is not None and comparison.difference_K is not None:
        scale = difference_scale(comparison.difference_K, "Difference", "K")
        pictures = render_scalar(comparison.mesh, comparison.difference_K, scale)
        written.append(write_png(folder / "difference.png", pictures["overview"]))
    write_text(folder / "comparison.json", to_json(comparison.report()))
    return [*written, folder / "comparison.json"]
