"""Inner loops as machine code (Numba): where whole arrays would pass through memory many times over."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from threading import Lock
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def compiled(loop: F) -> F:
    """The function compiled when it is first called, and kept on disk for the next program; `__wrapped__` is the loop.

    It runs without Python's lock, so frames can be worked on side by side; sums keep their order: same input, same
    output. Numba is imported when it is needed. It compiles a second per loop, once, where its cache can be written.
    """
    made: list[Callable[..., Any]] = []
    lock = Lock()

    @wraps(loop)
    def call(*args: Any) -> Any:
        if not made:
            with lock:
                if not made:
                    made.append(_made(loop))
        return made[0](*args)

    return call  # type: ignore[return-value]


def _made(loop: Callable[..., Any]) -> Callable[..., Any]:
    import numba

    try:
        return numba.njit(loop, cache=True, nogil=True, error_model="numpy")
    except RuntimeError:  # neither beside the code nor in the user's own folder can anything be kept
        return numba.njit(loop, nogil=True, error_model="numpy")
