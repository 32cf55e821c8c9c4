"""Thermal pictures of any program: 16-bit or float TIFF (many pages, BigTIFF), PNG, PGM, NPY, headerless .raw."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import COPY_AGAIN, MAX_PIXELS, decode_image, read_bytes
from ...files.tiff import TiffPage, decode_strips, is_tiff, tiff_pages, upright
from ...types import SignalCurve
from ..formats.images import read_npy
from .frames import APPARENT, ThermalFrames, ThermalSaid, one_frame
from .units import looks_like

SUFFIXES = (".tif", ".tiff", ".png", ".npy", ".pgm")
FLOATS = 0.9  # share of numbers of a sensible size in a picture of floats; pairs of counts make huge or tiny ones
PLAUSIBLE_DEGC = (-60.0, 200.0)  # the median of a picture
USB_SHAPE = (192, 256)  # (H, W) of InfiRay's and Topdon's USB frames: a picture above, kelvin x 64 below


def recognise(path: Path) -> bool:
    """A picture by its name."""
    return path.suffix.lower() in SUFFIXES


def read(path: Path, said: ThermalSaid) -> ThermalFrames:
    """Frames of one picture file; its values are what was said, or °C where they look like nothing else.

    Raises ScanError for 8-bit pictures, and for values whose unit somebody must say.
    """
    stack, notes = _stack(path)
    if stack.dtype.kind not in "fu" or stack.dtype == np.uint8 or stack.ndim != 3:
        raise ScanError(
            f"thermal is {stack.dtype} with {stack.ndim - 1} axes, expected 16-bit counts or float, one channel",
            place=path,
            hint="8-bit and coloured pictures have lost their temperatures: export float TIFF or CSV in degC",
        )
    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are no temperatures
        images, signal = as_said(stack, said, path)
    places = tuple(f"{path}, frame {i}" if len(images) > 1 else str(path) for i in range(len(images)))
    shape = (images.shape[1], images.shape[2])
    return ThermalFrames(shape, lambda i: images[i], np.full(len(images), np.nan), places, signal, notes=notes)


def as_said(stack: NDArray, said: ThermalSaid, place: object) -> tuple[NDArray, SignalCurve | None]:
    """Frames (N, H, W) as a scan stores them, and their signal; None for counts whose curve the rig must tell.

    Raises ScanError where the values look like another unit than °C and nobody said so.
    """
    if said.curve is not None and stack.dtype == np.uint16:
        return stack, said.curve
    if said.linear is not None:
        gain, offset = said.linear
        if stack.dtype == np.uint16:
            return stack, SignalCurve("counts", "linear_kelvin", {"gain_K": (gain,), "offset_K": (offset + 273.15,)})
        return (stack.astype(np.float64) * gain + offset).astype(np.float32), APPARENT
    unit = looks_like(stack)
    if unit is not None:
        text = f"the values (median {np.nanmedian(stack):.6g}) look like {unit[0]}"
        raise ScanError(text, place=place, hint=f"give {unit[1]}, or what else they are")
    if stack.dtype != np.uint16:
        _plausible(stack, place)
    return (stack, None) if stack.dtype == np.uint16 else (stack.astype(np.float32), APPARENT)


def _plausible(stack: NDArray, place: object) -> None:
    """Raises ScanError where the middle of what should be °C is no temperature of a body in a room."""
    finite = stack[np.isfinite(stack)]
    median = float(np.median(finite)) if finite.size else 0.0
    if not PLAUSIBLE_DEGC[0] < median < PLAUSIBLE_DEGC[1]:
        text = f"the values (median {median:.6g}) are no temperatures in degC"
        raise ScanError(
            text, place=place, hint="say what they are: --gain K_PER_UNIT --offset-degC DEGC_AT_0, or --curve"
        )


def _stack(path: Path) -> tuple[NDArray, tuple[str, ...]]:
    """All pages of a file (N, H, W), in native byte order, and notes."""
    data = read_bytes(path, "thermal")
    if data[:6] == b"\x93NUMPY":
        array = read_npy(data, path)
        if array.ndim > 2 and array.shape[-1] == 1:  # one channel, said by an axis of its own
            array = array[..., 0]
        return (array if array.ndim == 3 else array[None]), ()
    if is_tiff(data):
        return _tiff(data, path)
    return decode_image(data, shape=None, kind="thermal", place=path)[None], ()


def _tiff(data: bytes, path: Path) -> tuple[NDArray, tuple[str, ...]]:
    pages = tiff_pages(data)
    if not pages:
        raise ScanError("the thermal TIFF is truncated or damaged", place=path, hint=COPY_AGAIN)
    sizes = {(p.width_px, p.height_px) for p in pages}
    if len(sizes) > 1 or sum(p.width_px * p.height_px for p in pages) > 64 * MAX_PIXELS or pages[0].width_px == 0:
        text = f"the pages of the TIFF differ in size or are too many ({len(pages)})"
        raise ScanError(text, place=path, hint="write its frames alone, without a small picture of them, or one a file")
    own = [decode_strips(data, p) for p in pages]
    if all(a is not None for a in own):
        images = [upright(a, p.orientation) for a, p in zip(own, pages, strict=True) if a is not None]
    else:
        images = _by_opencv(data, pages, path)
    turned = pages[0].orientation != 1
    notes = (f"turned upright as the TIFF says (orientation {pages[0].orientation})",) if turned else ()
    return np.stack(images), notes


def _by_opencv(data: bytes, pages: list[TiffPage], path: Path) -> list[NDArray]:
    """Compressed pages; OpenCV turns them upright by itself."""
    log = logging.getLogger(__name__)
    try:
        ok, images = cv2.imdecodemulti(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as e:
        log.debug("OpenCV: %s", e)
        ok, images = False, ()
    if not ok or len(images) != len(pages):
        raise ScanError(
            f"the thermal TIFF is coded in a way that is not read ({pages[0].bits} bits, "
            f"compression {pages[0].compression}), or it is damaged",
            place=path,
            hint="write it without compression, 16-bit or float",
        )
    return [np.asarray(i) for i in images]


def read_raw(path: Path, said: ThermalSaid, shape: tuple[int, int] | None) -> ThermalFrames:
    """Headerless frames, little-endian: 16-bit, or float32 °C as DJI's kit writes; shape : (H, W) by the rig.

    USB frames hold kelvin x 64 below a picture.

    Raises ScanError where the bytes are no frame of that size.
    """
    values = np.frombuffer(read_bytes(path, "thermal"), np.uint8)
    for h, w in (shape, USB_SHAPE) if shape is not None else (USB_SHAPE,):
        pixels = 2 * h * w
        if (h, w) == shape and len(values) == 2 * pixels:
            order = max(("<f4", ">f4"), key=lambda o: _of_a_size(values.view(o)))
            if _of_a_size(values.view(order)) > FLOATS:
                stack = values.view(order).reshape(1, h, w).astype(np.float32)
                images, signal = as_said(stack, said, path)
                return one_frame(images[0], path, signal)
        usb = len(values) == 2 * pixels and _is_kelvin64(values[pixels:])
        if usb or ((h, w) == shape and len(values) == pixels):
            stack = values[-pixels:].view("<u2").reshape(1, h, w).astype(np.uint16)
            images, signal = as_said(stack, ThermalSaid(1 / 64, -273.15) if usb else said, path)
            return one_frame(images[0], path, signal)
    text = f"{len(values)} bytes without a header are no frame of 16-bit counts or float32 of a size that is known"
    raise ScanError(text, place=path, hint="give the thermal camera's size in --rig, or write PNG, TIFF or NPY")


def _of_a_size(x: NDArray) -> float:
    """Share of numbers that are neither tiny nor huge, as floats in the wrong byte order are."""
    return float(np.mean((np.abs(x) > 1e-3) & (np.abs(x) < 1e4)))


def _is_kelvin64(half: NDArray) -> bool:
    unit = looks_like(half.view("<u2"))
    return unit is not None and unit[0].startswith("kelvin x 64")
