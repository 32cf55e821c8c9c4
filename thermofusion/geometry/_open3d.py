"""The one place that imports Open3D.

Open3D's wheel needs `libusb-1.0.so.0`, which servers often lack. `libusb-package` ships one; it must be in the
process, with global symbols, *before* Open3D is loaded.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any

import libusb_package

_LIBUSB = libusb_package.get_library_path()
if _LIBUSB is not None:
    ctypes.CDLL(os.fspath(_LIBUSB), mode=ctypes.RTLD_GLOBAL)

VIEWER = ("dash", "plotly", "plotly.graph_objects")  # of `draw_plotly`: half the time that importing Open3D takes


class _Later:
    """A name of a module that is imported when the name is first used."""

    def __init__(self, module: str, name: str) -> None:
        self._module, self._name = module, name

    def __getattr__(self, name: str) -> Any:
        return getattr(getattr(import_module(self._module), self._name), name)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return getattr(import_module(self._module), self._name)(*args, **kwargs)


def _placeholder(module: str) -> ModuleType:
    def later(name: str) -> _Later:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Later(module, name)

    stand_in = ModuleType(module)
    stand_in.__dict__["__getattr__"] = later
    return stand_in


@contextmanager
def _without_viewer() -> Iterator[None]:
    """Meanwhile the modules of Open3D's viewer in the browser are not imported; who opens it, imports them then."""
    placed = {} if VIEWER[0] in sys.modules or VIEWER[1] in sys.modules else {m: _placeholder(m) for m in VIEWER}
    sys.modules.update(placed)
    try:
        yield
    finally:
        for name in placed:
            sys.modules.pop(name, None)


with _without_viewer():
    import open3d as o3d

# Open3D's own warnings would mix with ours on stderr; every failure is reported by our code, with its place.
o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)

__all__ = ["o3d"]
