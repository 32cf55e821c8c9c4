"""Recordings are read, never written into: what a verb writes goes elsewhere, by whatever way a path leads there."""

from __future__ import annotations

from pathlib import Path

from ..errors import RecipeError
from . import FORMATS
from .native.read import is_native

PICTURES = ("flir",)  # any folder of JPEG files is taken for one: that alone makes no recording


def apart(out: Path) -> Path:
    """The same path. Raises RecipeError where it is a recording's own folder, or lies in a native one."""
    try:
        place = out.resolve()
    except (OSError, RuntimeError):
        return out  # whoever writes will say what is the matter
    home = next((folder for folder in (place, *place.parents) if is_native(folder)), None)
    if home is None and place.is_dir():
        known = (f for f in FORMATS if f.name not in PICTURES and f.recognise(place))
        home = place if next(known, None) is not None else None
    if home is not None:
        where = "is" if home == place else "lies inside"
        raise RecipeError(f"what is written here {where} a recording", place=out, hint="name another place with -o")
    return out
