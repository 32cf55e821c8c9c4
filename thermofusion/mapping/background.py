"""What the thermal views see past the subject: the room, in blocks of pixels, with the direction each looks into.

A block counts where the surface is not hit, clear of its outline. The subject reaches beyond its mesh (legs below the
cut, a hand that depth did not keep): blocks warm as skin that hang together with it are left out, too. Pictures whose
background was masked show one value there, without noise: no room is seen in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import pixel_rays
from ..geometry.rays import RayScene, rays_from
from ..physics.scatter import WIDTHS, blurred, on_widths
from ..physics.signal import SignalConverter
from ..robust import evenly
from ..types import (
    BlackbodyReference,
    Bool,
    Float,
    Float32,
    Int,
    LensScatter,
    Reference,
    SurfaceMesh,
    ThermalStream,
    ThermalViews,
    brief,
)

BLOCKS_ACROSS = 80  # over the image's width: 8 px of 640
MOST_VIEWS = 80  # that are looked at, evenly over the recording
CLEAR_BLOCKS = 1.5  # from the outline, beyond which a block counts: point spread and misalignment stay inside
WARM_SHARE = 0.3  # of the way from room to skin: blocks beyond it, side by side with the subject, belong to it
SOURCE_BLOCKS = 2  # about a blackbody that are left out
LEAST_NOISE = 0.05  # of NETD: pixels of a block that differ by less were not read from a sensor


@dataclass(frozen=True, eq=False)
class Background:
    """Blocks of pixels that show the room. N rows, sorted by view.

    view : (N,) row of the thermal views. direction : (N, 3) unit, world, from the camera into the room. radiance : (N,)
    mean over a block as the camera reports it, W m-2 sr-1. spread : (N, K) the same of the whole picture blurred with
    one sigma of `WIDTHS` image widths; halo : (N, K) of the picture in which the room itself is even: what the subject
    sheds, and no window sheds on itself. u_px, v_px : (N,) a block's middle. n_views : that were looked at; block_px :
    side of a block, px. span_m : radius of the room about middle_m (3,), from which directions are then seen; inf =
    endless, as the cameras see it.
    """

    view: Int
    direction: Float32
    radiance: Float32
    spread: Float32
    u_px: Float32
    v_px: Float32
    n_views: int
    block_px: int
    halo: Float32 = field(default_factory=lambda: np.zeros((0, len(WIDTHS)), np.float32))
    span_m: float = float("inf")
    middle_m: Float = field(default_factory=lambda: np.zeros(3))

    __repr__ = brief

    def __len__(self) -> int:
        return len(self.view)

    def without(self, scatter: LensScatter) -> Background:
        """With what the lens spread onto it taken off."""
        g = on_widths(scatter).astype(np.float32)
        return replace(self, radiance=self.radiance * (1 + g.sum()) - self.spread @ g)


class BackgroundFinder:
    """A mesh, a camera and its references prepared for asking where a picture shows the room."""

    def __init__(self, stream: ThermalStream, mesh: SurfaceMesh, references: Sequence[Reference]) -> None:
        self._scene = RayScene.of(mesh)
        self._stream, lens = stream, stream.camera.lens
        self._sources = [r for r in references if isinstance(r, BlackbodyReference)]
        self.block_px = max(1, round(lens.width_px / BLOCKS_ACROSS))
        self.shape = lens.height_px // self.block_px, lens.width_px // self.block_px
        v, u = np.mgrid[: self.shape[0], : self.shape[1]] * self.block_px + 0.5 * (self.block_px - 1)
        self.u_px, self.v_px = u.astype(np.float32), v.astype(np.float32)
        self.rays = pixel_rays(lens, u, v).astype(np.float32)
        self._netd_L: float | None = None

    def rows(self, frame: int, T_world_thermal: Float, converter: SignalConverter) -> dict[str, NDArray]:
        """Columns of `Background` that the picture `frame` of the stream, from T_world_thermal (4, 4), adds."""
        image = converter.radiance(self._stream.load(frame), self._stream.places[frame])
        mean, noise = self._blocks(image)
        if self._netd_L is None:
            T_K = converter.band.temperature_K(float(np.nanmedian(mean)))
            self._netd_L = self._stream.camera.netd_K * float(converter.band.d_radiance_dT(T_K))
        direction = self.rays @ T_world_thermal[:3, :3].T.astype(np.float32)
        room = self._free(mean, direction, T_world_thermal[:3, 3]) & ~self._near_sources(frame)
        free = room & (noise > LEAST_NOISE * self._netd_L) & np.isfinite(mean) & np.isfinite(self.rays[..., 0])
        whole = np.where(np.isfinite(mean), mean, np.nanmedian(mean)).astype(np.float32)
        shed = np.where(room, np.median(whole[room]), whole).astype(np.float32) if room.any() else whole
        sigmas_px = [s * self.shape[1] for s in WIDTHS]
        return {
            "direction": direction[free],
            "radiance": mean[free],
            "spread": np.stack([blurred(whole, s)[free] for s in sigmas_px], axis=1),
            "halo": np.stack([blurred(shed, s)[free] for s in sigmas_px], axis=1),
            "u_px": self.u_px[free],
            "v_px": self.v_px[free],
        }

    def _blocks(self, image: Float32) -> tuple[Float32, Float32]:
        """Mean of each block's measured pixels, NaN without, and their spread about it; both (h, w) W m-2 sr-1."""
        h, w = self.shape
        size = self.block_px
        part = image[: h * size, : w * size]
        known = np.isfinite(part)
        middle = np.float32(np.nanmedian(image[:: 4 * size, ::size]))
        if np.isnan(middle):
            return np.full(self.shape, np.nan, np.float32), np.zeros(self.shape, np.float32)
        about = part - middle
        share: NDArray | float = 1.0
        if not known.all():
            about[~known] = 0
            share = cv2.resize(known.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = cv2.resize(about, (w, h), interpolation=cv2.INTER_AREA) / share
            variance = cv2.resize(about * about, (w, h), interpolation=cv2.INTER_AREA) / share - mean**2
        return np.asarray(mean + middle, np.float32), np.sqrt(np.maximum(variance, 0))

    def _free(self, mean: Float32, direction: Float32, eye_m: Float) -> Bool:
        """(h, w) blocks clear of the subject."""
        rays = rays_from(eye_m.astype(np.float32), direction.reshape(-1, 3))
        body = np.isfinite(self._scene.hits(np.nan_to_num(rays)).distance).reshape(self.shape)
        if body.all() or not body.any():
            return ~body
        skin, room = np.nanmedian(mean[body]), np.nanmedian(mean[~body])
        warm = (mean - room) * np.sign(skin - room) > WARM_SHARE * abs(skin - room)
        number, labels = cv2.connectedComponents((warm | body).astype(np.uint8), connectivity=8)
        belongs = np.zeros(number, bool)
        belongs[labels[body]] = True
        subject = belongs[labels] & (warm | body)
        distance = cv2.distanceTransform((~subject).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        return np.asarray(distance > CLEAR_BLOCKS)

    def _near_sources(self, frame: int) -> Bool:
        """(h, w) blocks at or beside a blackbody that stands in this picture."""
        near = np.zeros(self.shape, bool)
        for source in self._sources:
            if int(self._stream.index[frame]) in source.frames:
                lo = np.floor(source.polygon_px.min(0) / self.block_px).astype(int) - SOURCE_BLOCKS
                hi = np.ceil(source.polygon_px.max(0) / self.block_px).astype(int) + SOURCE_BLOCKS
                near[max(lo[1], 0) : max(hi[1] + 1, 0), max(lo[0], 0) : max(hi[0] + 1, 0)] = True
        return near


def find_background(
    stream: ThermalStream,
    mesh: SurfaceMesh,
    views: ThermalViews,
    converter: SignalConverter,
    references: Sequence[Reference] = (),
) -> Background:
    """What up to `MOST_VIEWS` of the views show of the room. Raises ScanError for an image that cannot be read."""
    finder = BackgroundFinder(stream, mesh, references)
    chosen = evenly(len(views), MOST_VIEWS)

    def one(view: int) -> dict[str, NDArray]:
        return finder.rows(int(views.frame[view]), views.T_world_thermal[view], converter)

    with ThreadPoolExecutor(max_workers=3) as pool:
        found = list(pool.map(one, chosen.tolist()))
    columns: dict[str, Any] = {name: np.concatenate([f[name] for f in found]) for name in found[0]}
    view = np.repeat(chosen, [len(f["radiance"]) for f in found]).astype(np.int32)
    return Background(view=view, n_views=len(chosen), block_px=finder.block_px, **columns)
