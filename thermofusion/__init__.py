"""thermofusion: 3D models of the human body whose every point carries its true skin temperature.

>>> import thermofusion as tf
>>> result = tf.fuse(tf.open_scan("my-scan"), tf.load_recipe("torso"))
>>> result.mesh.temperature_degC, result.mesh.uncertainty_K      # NumPy, one value a vertex
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .version import __version__

if TYPE_CHECKING:
    from .errors import ThermofusionError
    from .export import read_mesh
    from .pipeline import Result, fuse
    from .recipe import Recipe, load_recipe
    from .scans import open_scan
    from .types import Scan, ThermalMesh, VertexFlag

# Public name -> its module. Loaded on first use: Open3D takes a second, and most commands do not need it.
_PUBLIC = {
    "Recipe": "recipe",
    "Result": "pipeline",
    "Scan": "types",
    "ThermalMesh": "types",
    "ThermofusionError": "errors",
    "VertexFlag": "types",
    "fuse": "pipeline",
    "load_recipe": "recipe",
    "open_scan": "scans",
    "read_mesh": "export",
}


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    raise AttributeError(f"module 'thermofusion' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *_PUBLIC])


__all__ = [
    "Recipe",
    "Result",
    "Scan",
    "ThermalMesh",
    "ThermofusionError",
    "VertexFlag",
    "__version__",
    "fuse",
    "load_recipe",
    "open_scan",
    "read_mesh",
]
