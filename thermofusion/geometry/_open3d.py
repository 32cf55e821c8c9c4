"""The one place that imports Open3D.

Open3D's wheel needs `libusb-1.0.so.0`, which servers often lack. `libusb-package` ships one; it must be in the
process, with global symbols, *before* Open3D is loaded.
"""

from __future__ import annotations

import ctypes
import os

import libusb_package

_LIBUSB = libusb_package.get_library_path()
if _LIBUSB is not None:
    ctypes.CDLL(os.fspath(_LIBUSB), mode=ctypes.RTLD_GLOBAL)

import open3d as o3d  # noqa: E402

# Open3D's own warnings would mix with ours on stderr; every failure is reported by our code, with its place.
o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)

__all__ = ["o3d"]
