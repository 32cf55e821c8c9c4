"""How much light a lens spreads widely, from pictures of something hot before an even background.

    y = room_p + φ(u, v) + Σ g_k (K_k∗y - y),      g_k >= 0

beside the hot thing, where the room of each picture p is even but for a field φ of order 2 that all pictures share.
The kernels are those of `physics.scatter`, which takes them off again. What stands beyond the picture is not seen: once
its border is taken to go on, once the room is; half of the difference is in sigma. Light that falls farther than that,
or beside the edge itself, is not told from the level and the point spread: other kernels are known to an eighth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import read_json
from ...files.strict import validated
from ...physics.band import ZERO_DEGC_K, Band
from ...physics.scatter import WIDTHS, HaloNormal, blurred, reduced
from ...robust import MAD_PER_SIGMA, TUKEY, tukey_weight
from ...scans.native.schema import ScatterDoc
from ...scans.native.write import scatter_document as scatter_group
from ...types import Bool, Float, Float32, LensScatter

SCHEMA = "thermofusion-scatter/1"
LEAST_CONTRAST_K = 5.0  # of the hot thing against the room
LEAST_BACKGROUND = 0.1  # of the picture must show it
CLEAR_BLOCKS = 2.5  # of the reduced picture, from the hot thing: point spread and its own blocks stay inside
FIELD_K = 0.2  # one sigma of each pattern of the field: vignetting, an uneven background
ROOM_K = 20.0  # one sigma of a picture's level
SECTORS = 8  # about the hot thing, that are left out in turn
ROUNDS = 4  # of reweighting
LEAST_NOISE_K = 0.002  # of a block's mean over many frames
SHAPE_SHARE, SHAPE_SIGMA = 0.12, 0.0005  # one sigma: kernels are no sums of these Gaussians; what point spread leaves
BEYOND_PX = (10.0, 30.0, 100.0)  # radii that are told


@dataclass(frozen=True)
class ScatterFound:
    """scatter : kernel and sigma of its whole share. unseen : of that sigma, what stands beyond the pictures. noise :
    of it, what sectors left out in turn say. contrast_K : of the hot thing. pictures : how many. beyond : share of the
    light that falls beyond each radius of `BEYOND_PX`, px."""

    scatter: LensScatter
    unseen: float
    noise: float
    contrast_K: float
    pictures: int
    beyond: dict[str, float]


@dataclass(frozen=True, eq=False)
class _Rows:
    """Blocks of background, R of them: y (R,), halos of both guesses (2, R, K), picture, sector (R,), place (R, 2)."""

    y: Float
    halo: Float
    picture: NDArray[np.intp]
    sector: NDArray[np.intp]
    place: Float


def measure_scatter(pictures_degC: Sequence[NDArray], band: Band) -> ScatterFound:
    """From pictures (H, W) in apparent °C, each of something hot; the more places and sizes of it, the better.

    Raises ScanError: pictures of different sizes, nothing hot, or hardly any background beside it.
    """
    if len({np.shape(p) for p in pictures_degC}) != 1:
        raise ScanError("the pictures differ in size")
    w = np.shape(pictures_degC[0])[1]
    parts, contrasts = [], []
    for number, degC in enumerate(pictures_degC):
        rows, levels_L = _rows(band.radiance(np.asarray(degC, np.float64) + ZERO_DEGC_K).astype(np.float32), number)
        hot_K, room_K = (band.temperature_K(level) for level in levels_L)
        slope_L = float(band.d_radiance_dT(room_K))
        contrasts.append(float(hot_K - room_K))
        parts.append(rows)
    if min(contrasts) < LEAST_CONTRAST_K:
        text = f"nothing in the picture is {LEAST_CONTRAST_K:g} K warmer than the rest"
        raise ScanError(text, hint="show a hot plate, 20 K or more above an even wall, in up to half of the picture")
    joined = [np.concatenate([getattr(p, n) for p in parts]) for n in ("y", "picture", "sector", "place")]
    rows = _Rows(joined[0], np.concatenate([p.halo for p in parts], axis=1), *joined[1:])
    (goes_on, left_out), (room, _) = (_solve(rows, guess, slope_L) for guess in (0, 1))
    noise = float(np.sqrt((SECTORS - 1) / SECTORS * ((left_out - left_out.mean()) ** 2).sum()))
    shares = (goes_on + room) / 2
    unseen = float(abs(goes_on.sum() - room.sum()) / 2)
    share = float(shares.sum())
    sigma = float(np.sqrt(noise**2 + unseen**2 + SHAPE_SIGMA**2 + (SHAPE_SHARE * share) ** 2))
    found = tuple((float(g), width) for g, width in zip(shares, WIDTHS, strict=True) if g > 0) or ((0.0, WIDTHS[3]),)
    scatter = LensScatter(found, sigma, stated=True)
    return ScatterFound(scatter, unseen, noise, float(np.median(contrasts)), len(parts), _beyond(scatter, w))


def scatter_document(found: ScatterFound) -> dict[str, Any]:
    """scatter.json: `scatter` as scan.json and rig.json take it, and how it was found."""
    how = {k: v for k, v in vars(found).items() if k != "scatter"}
    return {"schema": SCHEMA, "scatter": scatter_group(found.scatter), **how}


def read_scatter(path: Path) -> LensScatter:
    """Of a scatter.json. Raises ScanError naming the key."""
    tree = read_json(path)
    if not isinstance(tree, dict) or tree.get("schema") != SCHEMA or "scatter" not in tree:
        hint = "`thermofusion thermal scatter HOT_PLATE` writes one"
        raise ScanError("this is no file of a lens's scatter", place=path, hint=hint)
    return validated(ScatterDoc, tree["scatter"], path).lens_scatter()


def _beyond(scatter: LensScatter, width_px: int) -> dict[str, float]:
    """Share of all light that falls beyond each radius."""
    return {
        f"{r:g}": float(sum(g * np.exp(-0.5 * (r / (s * width_px)) ** 2) for g, s in scatter.parts)) for r in BEYOND_PX
    }


def _rows(L: Float32, number: int) -> tuple[_Rows, tuple[float, float]]:
    """Background of one picture, and the radiance of the hot thing and of the room; W m-2 sr-1."""
    coarse = reduced(L)
    hot = _hot(coarse)
    room = np.float32(np.median(coarse[~hot]))
    clear = cv2.distanceTransform((~hot).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) > CLEAR_BLOCKS
    if clear.mean() < LEAST_BACKGROUND:
        raise ScanError("hardly anything of the picture lies beside the hot thing", hint="leave half of it to the wall")
    sigmas = [width * coarse.shape[1] for width in WIDTHS]
    goes_on = np.stack([blurred(coarse, s)[clear] for s in sigmas], axis=1)
    reach = max(coarse.shape)
    wide = np.pad(coarse, reach, constant_values=room)
    inner = slice(reach, reach + coarse.shape[0]), slice(reach, reach + coarse.shape[1])
    beyond = np.stack([blurred(wide, s)[inner][clear] for s in sigmas], axis=1)
    v, u = np.nonzero(clear)
    middle = np.argwhere(hot).mean(axis=0)
    angle = np.arctan2(v - middle[0], u - middle[1])
    rank = np.argsort(np.argsort(angle, kind="stable"), kind="stable")  # alike in number: an edge has half a turn
    place = np.column_stack([2 * u / coarse.shape[1] - 1, 2 * v / coarse.shape[0] - 1])
    y = coarse[clear].astype(np.float64)
    halo = np.stack([goes_on, beyond]) - y[None, :, None]
    count = np.full(len(y), number)
    return _Rows(y, halo, count, rank * SECTORS // len(y), place), (float(np.median(coarse[hot])), float(room))


def _hot(image: Float32) -> Bool:
    """Mask of what is nearer to the warm than to the cold mean (Ridler and Calvard 1978)."""
    cut = float(image.min() + image.max()) / 2
    for _ in range(20):
        warm = image > cut
        if warm.all() or not warm.any():
            raise ScanError("the picture shows one temperature: nothing hot stands out")
        cut = float(image[warm].mean() + image[~warm].mean()) / 2
    return np.asarray(image > cut)


def _solve(rows: _Rows, guess: int, slope_L: float) -> tuple[Float, Float]:
    """Shares (K,), and their sum (SECTORS,) with each sector left out."""
    x, y = rows.place.T
    level = (rows.picture[:, None] == np.arange(rows.picture.max() + 1)).astype(float)
    A = np.column_stack([rows.halo[guess], x, y, x * x, x * y, y * y, level])
    K = len(WIDTHS)
    prior = (np.r_[np.full(5, FIELD_K), np.full(level.shape[1], ROOM_K)] * slope_L) ** -2
    prior = np.concatenate([np.zeros(K), prior])
    data = rows.y - np.median(rows.y)
    robust, sigma, each = np.ones(len(data)), 10 * LEAST_NOISE_K * slope_L, np.eye(K)
    for _ in range(ROUNDS):
        w = robust / sigma**2
        whole = HaloNormal(A.T @ (w[:, None] * A), A.T @ (w * data))
        g = whole.shares(prior, each)
        rest = data - A[:, :K] @ g
        B = A[:, K:]
        r = np.abs(rest - B @ np.linalg.solve(B.T @ (w[:, None] * B) + np.diag(prior[K:]), B.T @ (w * rest)))
        sigma = max(float(np.median(r)) / MAD_PER_SIGMA, LEAST_NOISE_K * slope_L)
        robust = tukey_weight(r / (TUKEY * sigma))
    out = []
    for sector in range(SECTORS):
        mine = rows.sector == sector
        part = HaloNormal(A[mine].T @ (w[mine, None] * A[mine]), A[mine].T @ (w[mine] * data[mine]))
        out.append(float(whole.less(part).shares(prior, each).sum()))
    return g, np.array(out)
