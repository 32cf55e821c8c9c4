"""What a person says of a recording beside its own files: the rig, the unit, the size, the times, the way round."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import RecipeError, ScanError
from ..files.reading import read_json, read_text
from ..files.strict import validated
from ..types import Camera, Float, Scan, Stream, Trajectory
from .native.schema import RigDoc, camera_of

MIRROR = np.diag([-1.0, 1, 1, 1])  # x turned round: what a mirrored image does to its camera's frame


@dataclass(frozen=True, eq=False)
class Stated:
    """What was said; None = nothing.

    rig, rig_path : the rig.json that was named, or that lies beside the recording. depth_unit_m : metres a step (a
    float recording: metres a unit). size_px : (width, height) of depth images that have no header. mirrored : depth and
    colour are as in a mirror.
    """

    rig: RigDoc | None = None
    rig_path: Path | None = None
    depth_unit_m: float | None = None
    size_px: tuple[int, int] | None = None
    mirrored: bool = False

    def with_rig(self, path: Path) -> Stated:
        """The same with a rig.json. Raises ScanError if it is faulty."""
        return replace(self, rig=validated(RigDoc, read_json(path), path), rig_path=path)

    def unit_m(self, own: float) -> float:
        """Metres a step of depth: as said, as the rig says, else the recording's `own`."""
        depth = None if self.rig is None else self.rig.cameras.depth
        if self.depth_unit_m is not None:
            return self.depth_unit_m
        return depth.depth_unit_m if depth is not None and "depth_unit_m" in depth.model_fields_set else own

    @property
    def names_unit(self) -> bool:
        """Whether somebody named the unit of depth."""
        return self.unit_m(np.nan) == self.unit_m(0.0)

    def camera(self, name: str) -> Camera | None:
        """The rig's camera of that name (`depth`, `color`), if there is one."""
        doc = None if self.rig is None or self.rig_path is None else getattr(self.rig.cameras, name)
        return None if doc is None or self.rig_path is None else camera_of(doc, f"cameras.{name}", self.rig_path)

    def depth_size(self) -> tuple[int, int] | None:
        """(width, height) px of depth images without a header: as said, else the rig's."""
        camera = self.camera("depth")
        return self.size_px or (None if camera is None else (camera.width_px, camera.height_px))


NOTHING = Stated()


def unmirrored(scan: Scan) -> Scan:
    """The scan with depth and colour turned round, left to right; a trajectory that belongs to them with them.

    The cameras are those of the mirrored images: cx and p2 change sides with them. The rig's extrinsics are taken as
    those of the true cameras, and thermal images as not mirrored.
    """
    rig = replace(
        scan.rig, depth=_turned(scan.rig.depth), color=None if scan.rig.color is None else _turned(scan.rig.color)
    )
    poses = scan.trajectory
    return replace(
        scan,
        rig=rig,
        depth=_flipped(scan.depth),
        color=None if scan.color is None else _flipped(scan.color),
        trajectory=None if poses is None else Trajectory(poses.times_s, MIRROR @ poses.T_world_depth @ MIRROR),
        notes=(*scan.notes, "depth and colour were mirrored and have been turned round"),
    )


def _turned(camera: Camera) -> Camera:
    K, distortion = camera.K.copy(), camera.distortion.copy()
    K[0, 2] = camera.width_px - 1 - K[0, 2]
    distortion[3] *= -1
    return Camera(camera.width_px, camera.height_px, K, distortion)


def _flipped(stream: Stream) -> Stream:
    load = stream.load
    return replace(stream, load=lambda i: np.asarray(cv2.flip(load(i), 1)))


# ---------------------------------------------------------------- times


def read_times(path: Path) -> tuple[dict[str, float], list[float]]:
    """A list of times in seconds: by file name (rows `name,time_s`), or plain, in the order of the frames.

    Commas, semicolons, tabs or blanks between; a header and `#` comments are stepped over. Raises ScanError.
    """
    names: dict[str, float] = {}
    plain: list[float] = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not words:
            continue
        values = [_number(w) for w in words]
        if all(v is None for v in values) and not (names or plain):
            continue  # a header
        if len(words) == 1 and values[0] is not None:
            plain.append(values[0])
        elif len(words) == 2 and values[1] is not None:
            names[Path(words[0].replace("\\", "/")).name] = values[1]
        elif len(words) == 2 and values[0] is not None:  # TUM's order
            names[Path(words[1].replace("\\", "/")).name] = values[0]
        else:
            raise ScanError("expected `name,time_s`, or one time a line", place=f"{path}, line {number}")
    if bool(names) == bool(plain):
        raise ScanError("expected rows `name,time_s`, or one time a line, not both", place=path)
    return names, plain


def times_of(path: Path, places: Sequence[str], index: Sequence[int] | NDArray) -> Float:
    """Times (N,) in s of the frames, from a list of times by file name or frame number, or in their order.

    places : (N,) where the frames came from. index : (N,) their numbers. Raises ScanError if one has no time.
    """
    names, plain = read_times(path)
    if plain:
        if len(plain) != len(places):
            raise ScanError(f"{len(plain)} times for {len(places)} frames", place=path)
        return np.array(plain)
    keys = [(Path(p).name, Path(p).stem, str(int(i))) for p, i in zip(places, index, strict=True)]
    found = [next((names[k] for k in three if k in names), None) for three in keys]
    if None in found:
        raise ScanError(f"it names no time for {Path(places[found.index(None)]).name}", place=path)
    return np.array(found, np.float64)


def with_times(scan: Scan, path: Path) -> Scan:
    """The scan with the times of a list; colour and poses move with the depth frames they had the time of.

    Raises ScanError if a depth frame has no time there, or the times do not rise.
    """
    old, new = scan.depth.times_s, times_of(path, scan.depth.places, scan.depth.index)
    if not (np.diff(new) > 0).all():
        raise ScanError("the times of the depth frames do not rise from frame to frame", place=path)

    def moved(t: Float) -> Float:
        inside = np.interp(t, old, new)
        return np.where(t < old[0], new[0] + t - old[0], np.where(t > old[-1], new[-1] + t - old[-1], inside))

    color, poses = scan.color, scan.trajectory
    return replace(
        scan,
        depth=replace(scan.depth, times_s=new),
        color=None if color is None else replace(color, times_s=moved(color.times_s)),
        trajectory=None if poses is None else Trajectory(moved(poses.times_s), poses.T_world_depth),
        times_assumed=False,
        notes=(*(n for n in scan.notes if "30 frames a second" not in n), f"times from {path.name}"),
    )


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def refused(stated: Stated, keys: Mapping[str, str], place: object) -> None:
    """RecipeError for what was said and a format has no use for. keys : field of `Stated` -> why."""
    for key, why in keys.items():
        if getattr(stated, key):
            raise RecipeError(f"{place}: --{key.removesuffix('_px').removesuffix('_m').replace('_', '-')}: {why}")
