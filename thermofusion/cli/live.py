"""What `run --follow` does before the result: follow a recording that is still being written."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from .console import note

if TYPE_CHECKING:
    from ..live.follow import Live
    from ..recipe import Recipe
    from ..tracking.ahead import Ahead

LINE_EVERY_S = 2.0
APPEARS_S = 60.0  # time for the recording to appear


def followed(path: Path, recipe: Recipe) -> Ahead | None:
    """Follow the recording at `path` to its end, in the terminal and the browser. Ctrl-C ends the following alone.

    Returns what was done meanwhile of the final result.
    """
    from ..export.palettes import table
    from ..live.follow import Sections, follow
    from ..live.page import Page
    from ..pipeline import ready

    threading.Thread(target=ready, daemon=True).start()
    page = Page([f"#{r:02x}{g:02x}{b:02x}" for r, g, b in table("inferno").tolist()])
    note(f"the growing model: {page.address}")
    told_at, begun = 0.0, time.monotonic()

    def show(live: Live) -> None:
        nonlocal told_at
        page.show(live)
        if live.lost or live.ended or time.monotonic() - told_at > LINE_EVERY_S:
            told_at = time.monotonic()
            head = f"{live.frames} frames, {live.rate_hz:.1f} a second"
            note("; ".join([head, *live.advice()]))

    sections = Sections(recipe.input, recipe.subject, recipe.tracking)
    try:
        while not path.exists() and time.monotonic() - begun < APPEARS_S:
            time.sleep(0.1)
        return follow(path, sections, show).ahead
    except KeyboardInterrupt:
        note("not followed any further; the result is made of what is there")
        return None
    finally:
        page.close()
