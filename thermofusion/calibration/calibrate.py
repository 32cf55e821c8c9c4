"""`calibrate`: a folder of board pictures in, a rig out, with the points found, the report and what to record next."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError, counted
from ..progress import Progress, silent
from ..types import Float, UInt8
from .board.board import Board
from .board.picks import interpolated, read_picks_csv, read_picks_mat
from .board.views import BoardPoints, BoardView, CalibrationSet
from .detect.blobs import detect_blobs
from .detect.color import detect_color
from .detect.pictures import draw_points, to_grey
from .detect.thermal import is_saturated
from .fit.coverage import advice, coverage
from .fit.rig import Calibration, calibrate_views
from .fit.rounds import detect_thermal_set
from .folder import CalibrationFolder, open_folder

MIN_SHARE_FOUND = 0.3  # of the pictures; below this the board described is not the one in view
MAX_INTERPOLATED = 0.3  # of picked points; more says that nobody looked at most of them
PICTURES_CHECKED = 3  # for a second board, and for a board of another size


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The result. rejected_px : camera -> view -> (N, 2) places of board points that were looked for and not taken.

    found : camera -> number of views with the board. advice : what to record next."""

    folder: CalibrationFolder
    calibration: Calibration
    rejected_px: dict[str, dict[str, Float]] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)
    advice: tuple[str, ...] = ()

    def has_picture(self, camera: str, name: str) -> bool:
        """False for a view of picks whose picture is not in the folder."""
        return name in self.folder.files.get("infrared" if camera == "depth" else camera, {})

    def picture(self, camera: str, name: str) -> UInt8:
        """(H, W, 3) RGB: the view's picture with accepted points as green rings, rejected ones as red crosses."""
        image = getattr(self.folder, "infrared" if camera == "depth" else camera)(name)
        view = next((v for v in self.calibration.data.views if v.name == name), None)
        points = view.points.get(camera) if view is not None else None
        accepted = np.zeros((0, 2)) if points is None else points.px
        return draw_points(image, accepted, self.rejected_px.get(camera, {}).get(name))


def calibrate(
    root: Path | str,
    *,
    config: Mapping[str, Any] | None = None,
    board: Board | None = None,
    picks: Path | None = None,
    free_spacing: bool | None = None,
    group: int | None = None,
    progress: Progress = silent,
) -> Calibrated:
    """Calibrate from a folder (see `folder`). picks : CSV or picks.mat used instead of detection where it has points.

    Raises ScanError with the next step: no board found, board of another size, parallel views, mirrored or saturated
    pictures.
    """
    folder = open_folder(Path(root), config=config, board=board)
    source = picks or folder.picks
    rejected: dict[str, dict[str, Float]] = {}
    if source is not None:
        data = _from_picks(folder, source)
    else:
        data, rejected = _detect(folder, progress)
        if "infrared" in folder.files:
            data = _with_infrared(folder, data, progress)
    named = {v.name for v in data.views}
    depth = {n: partial(folder.depth, n) for n in folder.files.get("depth", {}) if n in named}
    progress("adjust", 0, 1)
    result = calibrate_views(
        data,
        depth_images=depth or None,
        depth_camera=folder.depth_camera,
        depth_kind=folder.depth_kind,
        depth_lens_known=folder.depth_lens_known,
        T_depth_hub=folder.T_depth_color,
        free_spacing=folder.free_spacing if free_spacing is None else free_spacing,
        group=group,
    )
    progress("adjust", 1, 1)
    found = {c: len(data.seen_by(c)) for c in data.cameras}
    return Calibrated(folder, result, rejected, found, _next_steps(folder, result, data if source else None))


def _next_steps(folder: CalibrationFolder, result: Calibration, picked: CalibrationSet | None) -> tuple[str, ...]:
    """What to record, or pick, next; the gravest first."""
    next_steps = tuple(s for c in result.single for s in advice(coverage(result, c)))
    burnt = [n for n in folder.files.get("thermal", {}) if n in result.views_used() and is_saturated(folder.thermal(n))]
    if burnt:
        text = (
            f"saturated: {counted(len(burnt), 'thermal picture')} ({', '.join(burnt[:5])}): widen the temperature range"
        )
        next_steps = (text, *next_steps)
    return next_steps if picked is None else (*_interpolated_picks(picked), *next_steps)


def _from_picks(folder: CalibrationFolder, path: Path) -> CalibrationSet:
    if path.suffix == ".mat":
        board, sizes, views = read_picks_mat(path, folder.board.spacing_m)
        if (board.columns, board.rows) != (folder.board.columns, folder.board.rows):
            raise ScanError(
                f"the picks are of a board of {board.columns} x {board.rows} points, the folder's has "
                f"{folder.board.columns} x {folder.board.rows}",
                place=path,
            )
        return CalibrationSet(board, sizes, tuple(views))
    views = read_picks_csv(path, folder.board)
    sizes = {}
    for camera, files in (("color", "color"), ("thermal", "thermal"), ("depth", "infrared")):
        if folder.files.get(files):
            image = getattr(folder, files)(next(iter(folder.files[files])))
            sizes[camera] = (image.shape[1], image.shape[0])
    return CalibrationSet(folder.board, sizes, tuple(sorted(views, key=lambda v: v.name)))


def _interpolated_picks(data: CalibrationSet) -> list[str]:
    """A sentence for every camera whose picks are mostly no observations."""
    out = []
    for camera in data.cameras:
        found = [interpolated(v.points[camera], data.board) for v in data.seen_by(camera)]
        marks = [m for m in found if m is not None]
        share = float(np.concatenate(marks).mean()) if marks else 0.0
        if share > MAX_INTERPOLATED:
            out.append(
                f"{100 * share:.0f} % of the {camera} picks lie exactly on the perspective grid of their four corners: "
                "they were interpolated, not seen, and hide the lens's distortion; let the detector find the points"
            )
    return out


def _detect(folder: CalibrationFolder, progress: Progress) -> tuple[CalibrationSet, dict[str, dict[str, Float]]]:
    """Points of both cameras: patches directly; pins in the thermal camera from the colour camera's boards."""
    views = {n: BoardView(n) for n in folder.names}
    sizes: dict[str, tuple[int, int]] = {}
    by_patch = folder.board.kind in ("mask", "circles", "asymmetric-circles", "lamps")
    if "color" in folder.files:
        found, sizes["color"] = _find(folder, "color", detect_patches if by_patch else detect_color, progress)
        views = {n: v.with_points("color", found.get(n)) for n, v in views.items()}
    rejected: dict[str, dict[str, Float]] = {}
    if "thermal" not in folder.files:
        return CalibrationSet(folder.board, sizes, tuple(views.values())), rejected
    if by_patch or "color" not in folder.files:
        found, sizes["thermal"] = _find(folder, "thermal", detect_patches, progress)
        views = {n: v.with_points("thermal", found.get(n)) for n, v in views.items()}
        return CalibrationSet(folder.board, sizes, tuple(views.values())), rejected
    images = {n: folder.thermal(n) for n in folder.files["thermal"]}
    data, detections = detect_thermal_set(CalibrationSet(folder.board, sizes, tuple(views.values())), images, progress)
    rejected["thermal"] = {n: d.tried[~d.accepted] for n, d in detections.items()}
    return data, rejected


def _with_infrared(folder: CalibrationFolder, data: CalibrationSet, progress: Progress) -> CalibrationSet:
    """The set with the depth camera's points, from its own pictures."""
    found, size = _find(folder, "infrared", detect_patches, progress)
    views = tuple(v.with_points("depth", found.get(v.name)) for v in data.views)
    return replace(data, image_size={**data.image_size, "depth": size}, views=views)


def detect_patches(image: NDArray, board: Board) -> BoardPoints | None:
    """Circles, holes and lamps in any picture (H, W), px; checkerboards under a lamp by the colour detector on the grey
    values."""
    if board.kind in ("mask", "circles", "lamps"):
        return detect_blobs(image, board)
    lo, hi = np.percentile(image, [0.5, 99.5])
    grey = np.clip((image.astype(np.float32) - lo) * (255 / max(hi - lo, 1e-6)), 0, 255).astype(np.uint8)
    return detect_color(grey, board) or detect_color(255 - grey, board)


def _without_board(image: NDArray, points: BoardPoints) -> NDArray:
    """The picture with the board found covered by its own mean."""
    out = image.copy()
    hull = cv2.convexHull(points.px.astype(np.float32))[:, 0]
    center = hull.mean(0)
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.round(center + 1.35 * (hull - center)).astype(np.int32), 1)
    out[mask > 0] = image[mask > 0].mean()
    return out


def _other_size(folder: CalibrationFolder, camera: str) -> tuple[int, int] | None:
    """Inner corners of the checkerboard that really is in the first pictures, if there is one."""
    if folder.board.kind not in ("checkerboard", "pins"):
        return None
    for name in list(folder.files[camera])[:PICTURES_CHECKED]:
        grey = to_grey(getattr(folder, camera)(name))
        flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
        if found:
            rim = 2 if folder.board.kind == "pins" else 0
            return int(meta.shape[1]) + rim, int(meta.shape[0]) + rim
    return None


def _find(
    folder: CalibrationFolder, camera: str, detector: Callable[[NDArray, Board], BoardPoints | None], progress: Progress
) -> tuple[dict[str, BoardPoints], tuple[int, int]]:
    """The board in every picture of a camera by view, and the pictures' size. Raises ScanError: two boards, too few."""
    found: dict[str, BoardPoints] = {}
    shapes, saturated = set(), 0
    count = len(folder.files[camera])
    for i, name in enumerate(folder.files[camera]):
        progress(f"{camera} boards", i, count)
        image = getattr(folder, camera)(name)
        shapes.add(image.shape[:2])
        saturated += camera == "thermal" and is_saturated(image)
        points = detector(image, folder.board)
        if points is None:
            continue
        if len(found) < PICTURES_CHECKED and detector(_without_board(image, points), folder.board) is not None:
            raise ScanError(
                f"two boards are in view in {camera} picture {name}",
                place=folder.root,
                hint="leave one board in the room, or cover the other",
            )
        found[name] = points
    if len(shapes) != 1:
        raise ScanError(f"the {camera} pictures differ in size", place=folder.root, hint="keep one camera to a folder")
    if len(found) < max(3, MIN_SHARE_FOUND * count):
        raise _too_few(folder, camera, len(found), saturated)
    progress(f"{camera} boards", count, count)
    h, w = shapes.pop()
    return found, (int(w), int(h))


def _too_few(folder: CalibrationFolder, camera: str, found: int, saturated: int) -> ScanError:
    """Why the board was found in so few pictures, and what to do."""
    board, count = folder.board, len(folder.files[camera])
    if saturated > count / 2:
        cause = f"{saturated} of {count} thermal pictures are saturated"
        return ScanError(cause, place=folder.root, hint="widen the temperature range")
    what = f"a {board.kind} of {board.columns} x {board.rows} points"
    cause = f"{what} was found in {found} of {count} {camera} pictures"
    actual = _other_size(folder, camera)
    cause += "" if actual is None else f", but one of {actual[0]} x {actual[1]}"
    hint = "check columns and rows (inner corners), and that the whole board, and only one, is in view"
    return ScanError(cause, place=folder.root, hint=hint)
