"""Phantoms: scenes with known truth, recorded as native scans (docs/simulate.md).

The renderer shares no radiometry with the code that processes scans.
"""

from __future__ import annotations

from .scene import SceneConfig, load_scene, scene_from_mapping, scenes_dir, shipped_scenes
from .simulate import Phantom, Studio, build_phantom, simulate

__all__ = [
    "Phantom",
    "SceneConfig",
    "Studio",
    "build_phantom",
    "load_scene",
    "scene_from_mapping",
    "scenes_dir",
    "shipped_scenes",
    "simulate",
]
