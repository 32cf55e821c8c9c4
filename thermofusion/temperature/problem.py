"""The temperature problem: all that is known before it is solved, prepared once, cut by views or vertices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import pixel_rays
from ..geometry.mesh import edge_gradient, fine_structure
from ..mapping.observe import Mapped, clear_of_silhouettes
from ..physics.band import Band
from ..physics.emissivity import EmissivityModel, model_from_recipe
from ..recipe import MappingSection, TemperatureSection
from ..robust import median
from ..types import Bool, Camera, Float, Float32, Int, LensScatter, Observations, Scan, SurfaceMesh, ThermalViews
from .references import ContactReading, ExpectedReading, contact_readings, expected_readings
from .room.changing import Changing
from .room.harmonics import open_transfer
from .room.map import RoomMap, RoomPrior
from .room.operator import operator_effect, operator_excess, without_operator
from .room.stated import ASSUMED_SIGMA_K, Room, room_of
from .room.surroundings import SurroundingsResult, surroundings
from .uncertainty import ErrorModel

BLURRED_BEFORE = 1.5  # what the image's blur took over what the next takes: 1 of smooth skin, 4 of the finest veins
CAMERA_LEVEL_K = 2.0  # of an uncooled camera's own scale: data sheets say 2 K


@dataclass(frozen=True, eq=False)
class ThermalProblem:
    """What the temperature of V vertices is solved from. Radiances in W m-2 sr-1.

    vertices : (V,) their numbers in the mesh. points_m : (V, 3) where they are, world.
    observations : of them, freed of the air path, clear of outlines or the best there is; sorted by (view, vertex).
    clear : (N,) mask of rows that lie clear of outlines: they calibrate. counts : (N,) mask of rows that the map of all
    views is made of: a part of the views must not fall back on worse. n_views : of the whole scan, whatever part is
    left; view_times_s : (n_views,) when; restarts : views that follow a shutter correction that the recording marks.
    L_reflected : (V,) that vertices are lit by. around : what they see of the body; None where that is switched off, or
    vertices are a sample. errors : one-sigma parts of an observation. blackbodies, contacts : what sets the level.
    vertices_per_patch : vertices that share a normal's error. other : (V,) what is not skin, None = not asked.
    room_map : radiance of the room from each direction; None: even, as stated. transfer : (V, 9) how its harmonics
    light a vertex. uneven : (V,) what the room adds to what vertices reflect, beyond its mean. scatter : of the
    lens. effects : (V,) what one sigma of it, or of who stands at the camera, does to readings of a vertex. changing :
    what differed from view to view; its room and air are off the observations.
    hemispherical : (V,) ε of vertices to what is around them; None: all are skin.
    """

    vertices: NDArray[np.intp]
    points_m: Float32
    observations: Observations
    clear: Bool
    counts: Bool
    n_views: int
    view_times_s: Float
    restarts: tuple[int, ...]
    lens: Camera
    band: Band
    emissivity: EmissivityModel
    room: Room
    L_reflected: Float
    around: SurroundingsResult | None
    errors: ErrorModel
    blackbodies: tuple[ExpectedReading, ...]
    contacts: tuple[ContactReading, ...]
    vertices_per_patch: float
    mapping: MappingSection
    settings: TemperatureSection
    other: Bool | None = None
    room_map: RoomMap | None = None
    transfer: Float32 | None = None
    uneven: Float | None = None
    scatter: LensScatter | None = None
    effects: Mapping[str, Float32] = field(default_factory=dict)
    changing: Changing | None = None
    hemispherical: Float | None = None

    @classmethod
    def of(
        cls,
        scan: Scan,
        surface: SurfaceMesh,
        normal_window_m: float,
        mapped: Mapped,
        mapping: MappingSection,
        settings: TemperatureSection,
    ) -> ThermalProblem:
        """Of a whole scan, the body at one temperature for a start.

        normal_window_m : over which the surface's normals are averaged. Raises ScanError, RecipeError.
        """
        assert scan.thermal is not None
        camera = scan.thermal.camera
        band = Band(*camera.band_um)
        changing = Changing.of(scan, mapped.views, settings, band)
        room = room_of(changing.environment, settings)
        L_room = float(band.radiance(room.reflected_K))
        air_K = room.air_K or room.reflected_K
        rows = changing.without_air(mapped.observations, settings.transmission_per_m, air_K, band)
        emissivity = model_from_recipe(settings.emissivity, band)
        around = surroundings(surface) if settings.crosscal.surroundings else None
        transfer = open_transfer(surface.normals).astype(np.float32) if around is None else around.transfer
        rows = changing.in_one_room(rows, transfer[:, 0], emissivity)
        excess = operator_excess(rows, emissivity, band, room.reflected_K)
        rows = without_operator(rows, excess, settings.operator_m2)
        clear, counts = clear_of_silhouettes(rows, len(surface), mapping.silhouette_px)
        rows, clear, excess = rows.select(counts), clear[counts], excess[counts]
        straight = rows.cos_angle >= np.float32(np.cos(np.radians(mapping.max_angle_deg)))
        held = settings.sigma_operator_m2 * operator_effect(rows, excess, straight, len(surface))
        straight_seen = np.bincount(rows.vertex[straight], minlength=len(surface)) > 0
        problem = cls(
            vertices=np.arange(len(surface)),
            points_m=surface.vertices_m,
            observations=rows,
            clear=clear,
            counts=straight | ~straight_seen[rows.vertex],
            n_views=len(mapped.views),
            view_times_s=mapped.views.times_s,
            restarts=_restarts(scan.thermal.usable, mapped.views.frame),
            lens=camera.lens,
            band=band,
            emissivity=emissivity,
            room=room,
            L_reflected=np.full(len(surface), L_room),
            around=around,
            errors=ErrorModel.of(camera, settings).aligned(mapped.outline_px, mapped.depth_scale),
            blackbodies=changing.lit(expected_readings(mapped.blackbodies, scan.references, band, L_room)),
            contacts=contact_readings(scan.references, surface, band, scan.root),
            vertices_per_patch=vertices_per_patch(surface, normal_window_m),
            mapping=mapping,
            settings=settings,
            scatter=mapped.scatter,
            effects={"operator": held} | ({} if mapped.scattered is None else {"scatter": mapped.scattered}),
            room_map=RoomMap.unseen(_room_prior(room, settings, band)),
            transfer=transfer,
            changing=changing,
        )
        return problem.lit_by(np.full(len(surface), median(rows.radiance), np.float32))

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def seen_views(self) -> NDArray[np.intp]:
        """(M,) numbers of the views that see the vertices, in order of time."""
        return np.unique(self.observations.view)

    def lit_by(self, L_skin: NDArray) -> ThermalProblem:
        """With the body's own radiation in what vertices reflect; L_skin : (V,) its radiance, NaN = unmeasured."""
        if self.around is None:
            return self
        L_room = float(self.band.radiance(self.room.reflected_K))
        sends = self.emissivity.hemispherical if self.hemispherical is None else self.hemispherical
        lit = self.around.reflected_radiance(L_room, L_skin, emissivity=sends)
        return replace(self, L_reflected=lit if self.uneven is None else lit + self.uneven)

    @property
    def room_prior(self) -> RoomPrior:
        """What is known of the room beforehand: as stated; on the camera's own scale where no reference sets it."""
        prior = _room_prior(self.room, self.settings, self.band)
        anchored = self.blackbodies or self.contacts
        return prior if anchored else replace(prior, sigma_K=float(np.hypot(prior.sigma_K, CAMERA_LEVEL_K)))

    def in_room(self, found: RoomMap, views: ThermalViews) -> ThermalProblem:
        """In a room as it was seen, and what blackbodies reflect of it. views : all, for their poses."""
        assert self.transfer is not None
        L_room = float(found.coefficients[0])
        uneven = self.transfer[:, 1:].astype(np.float64) @ found.coefficients[1:]
        if self.around is not None:
            uneven += self.around.from_cells(found.cells)
        before = float(self.band.radiance(self.room.reflected_K))
        lit = self.L_reflected + uneven - (0.0 if self.uneven is None else self.uneven)
        lit += self.transfer[:, 0] * (L_room - before)
        room = replace(self.room, reflected_K=float(self.band.temperature_K(L_room)), measured=found.measured)
        return replace(
            self,
            room=room,
            room_map=found,
            uneven=uneven,
            L_reflected=lit,
            blackbodies=tuple(self._lit_source(b, found, views, before) for b in self.blackbodies),
        )

    def _lit_source(
        self, reading: ExpectedReading, found: RoomMap, views: ThermalViews, before: float
    ) -> ExpectedReading:
        """A blackbody turned toward the camera, lit by the room behind it."""
        ray = pixel_rays(self.lens, np.array([reading.u_px]), np.array([reading.v_px]))[0]
        toward_camera = -views.T_world_thermal[reading.view, :3, :3] @ ray
        change = reading.reflectivity * (found.facing(toward_camera) - before)
        return replace(reading, expected=reading.expected + change)

    def room_errors(self, vertices: NDArray) -> Float:
        """(N, R) what one sigma of each error of the room adds to the light that meets some vertices, W m-2 sr-1."""
        if self.room_map is None or self.transfer is None:
            slope = float(self.band.d_radiance_dT(self.room.reflected_K))
            return np.full((len(vertices), 1), self.errors.sigma_reflected_K * slope)
        return np.asarray(self.transfer[vertices].astype(np.float64) @ self.room_map.modes)

    def informed(self, surface: SurfaceMesh, T_K: Float) -> ThermalProblem:
        """With what a first map (V,) K tells: the body's own radiation, the temperature's slope along the skin."""
        vertices, triangles = surface.vertices_m, surface.triangles
        blur_m = self.errors.blur_px * median(self.observations.range_m) / self.lens.focal_px
        blurred = fine_structure(vertices, triangles, T_K, blur_m) * np.float32(BLURRED_BEFORE * blur_m**2)
        errors = self.errors.informed(edge_gradient(vertices, triangles, T_K), blurred)
        return replace(self.lit_by(self.band.radiance(T_K)), errors=errors)

    def part(self, views: Bool, vertices: Bool | None = None) -> ThermalProblem:
        """Seen by the views of a mask (n_views,) alone, and, if given, the vertices of a mask (V,) alone."""
        mine = views[self.observations.view]
        if vertices is not None:
            mine &= vertices[self.observations.vertex]
        return replace(
            self,
            observations=self.observations.select(mine),
            clear=self.clear[mine],
            counts=self.counts[mine],
            blackbodies=tuple(b for b in self.blackbodies if views[b.view]),
        )

    def without(self, vertices: Bool) -> ThermalProblem:
        """The vertices of a mask (V,) are not skin: they take no part in calibration."""
        other = vertices if self.other is None else self.other | vertices
        return replace(self, clear=self.clear & ~vertices[self.observations.vertex], other=other)

    def sample(self, size: int) -> ThermalProblem:
        """An even sample of some `size` of the vertices that were seen, and those under contact thermometers."""
        seen = np.unique(self.observations.vertex)
        touched = np.intersect1d(seen, np.concatenate([c.vertices for c in self.contacts] or [np.zeros(0, np.int32)]))
        chosen = np.union1d(seen[:: max(1, -(-len(seen) // size))], touched)
        number = np.full(len(self), -1, np.int32)
        number[chosen] = np.arange(len(chosen), dtype=np.int32)
        mine = number[self.observations.vertex] >= 0
        rows = self.observations.select(mine)
        contacts = [replace(c, vertices=number[c.vertices][number[c.vertices] >= 0]) for c in self.contacts]
        return replace(
            self,
            vertices=self.vertices[chosen],
            other=None if self.other is None else self.other[chosen],
            points_m=self.points_m[chosen],
            observations=replace(rows, vertex=number[rows.vertex]),
            clear=self.clear[mine],
            counts=self.counts[mine],
            L_reflected=self.L_reflected[chosen],
            transfer=None if self.transfer is None else self.transfer[chosen],
            uneven=None if self.uneven is None else self.uneven[chosen],
            effects={name: effect[chosen] for name, effect in self.effects.items()},
            around=None,
            errors=self.errors.at(chosen, len(self)),
            contacts=tuple(c for c in contacts if len(c.vertices)),
            vertices_per_patch=self.vertices_per_patch * len(chosen) / len(self),
        )


def _room_prior(room: Room, settings: TemperatureSection, band: Band) -> RoomPrior:
    sigma_K = max(settings.sigma_reflected_K, ASSUMED_SIGMA_K) if room.assumed else settings.sigma_reflected_K
    L, slope = float(band.radiance(room.reflected_K)), float(band.d_radiance_dT(room.reflected_K))
    return RoomPrior(L, slope, sigma_K, settings.sigma_room_K)


def _restarts(usable: Bool, frame: Int) -> tuple[int, ...]:
    """Views before which a frame was marked unusable, the mark of a shutter; usable (F,), frame (M,) index."""
    marked = np.insert(np.cumsum(~usable), 0, 0)
    return tuple((np.flatnonzero(np.diff(marked[frame]) > 0) + 1).tolist())


def vertices_per_patch(surface: SurfaceMesh, window_m: float) -> float:
    """Vertices in a disc of the normals' window: they share their normal, and with it their error."""
    a, b, c = (surface.vertices_m[surface.triangles[:, k]] for k in range(3))
    area_m2 = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return float(np.pi * (window_m / 2) ** 2 * len(surface) / area_m2)
