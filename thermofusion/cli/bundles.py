"""Options in bundles: a dataclass of annotated options stands for all of them in a verb's signature."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from typing import Any, get_type_hints


def bundled(verb: Callable[..., Any]) -> Callable[..., Any]:
    """The verb with the fields of its dataclass parameters as options of their own, for typer to read."""
    hints = get_type_hints(verb, include_extras=True)
    bundles = {name: hint for name, hint in hints.items() if inspect.isclass(hint) and is_dataclass(hint)}

    @wraps(verb)
    def call(**options: Any) -> Any:
        made = {
            name: bundle(**{f.name: options.pop(f.name) for f in fields(bundle)}) for name, bundle in bundles.items()
        }
        return verb(**options, **made)

    parameters = []
    for p in inspect.signature(verb).parameters.values():
        if p.name not in bundles:
            parameters.append(p.replace(annotation=hints[p.name], kind=p.KEYWORD_ONLY))
            continue
        own = get_type_hints(bundles[p.name], include_extras=True)
        for f in fields(bundles[p.name]):
            default = p.empty if f.default is MISSING else f.default
            parameters.append(inspect.Parameter(f.name, p.KEYWORD_ONLY, default=default, annotation=own[f.name]))
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {p.name: p.annotation for p in parameters}
    return call
