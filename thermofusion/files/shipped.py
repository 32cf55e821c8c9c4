"""Where the shipped recipes and data lie: inside an installed wheel, or at the top of a source checkout."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def _find(inside: str, beside: str) -> Path:
    packed = _PACKAGE / inside
    return packed if packed.is_dir() else _PACKAGE.parent / beside


def recipes_dir() -> Path:
    """Folder of the shipped recipes."""
    return _find("_recipes", "recipes")


def data_dir() -> Path:
    """Folder of the shipped data: demo scan, reference tables, registry.toml."""
    return _find("_data", "data")
