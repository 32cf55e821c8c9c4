"""Documents from outside, held against a schema: pydantic at the border, one sentence for the first fault."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from ..errors import ScanError, visible

Doc = TypeVar("Doc", bound=BaseModel)

UNITS = {
    "_per_m": "per metre", "_mm": "mm", "_ms": "ms", "_px": "px", "_deg": "°", "_degC": "°C", "_cm2": "cm²",
    "_um": "µm", "_gib": "GiB", "_voxels": "voxels", "_pct": "%", "_m": "m", "_K": "K", "_s": "s",
}  # fmt: skip
OFF_BOUNDS = ("greater_than", "greater_than_equal", "less_than", "less_than_equal", "float_type", "int_type")
LONGEST = 60  # characters of a user's text in a sentence


class Border(BaseModel):
    """A group of a document: unknown keys are kept, infinities refused."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class ClosedBorder(BaseModel):
    """A group of a document in which an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def validated(model: type[Doc], tree: object, place: object, hint: str | None = None) -> Doc:
    """`tree` (decoded JSON or TOML) as `model`. Raises ScanError that names the first faulty key."""
    try:
        return model.model_validate(tree)
    except ValidationError as e:
        raise ScanError(first_fault(model, e)[1], place=place, hint=hint) from None


def first_fault(model: type[BaseModel], error: ValidationError) -> tuple[tuple[str, ...], str]:
    """The first faulty key's path, and one sentence: the key, what it must be with its unit, and what it is."""
    faults = error.errors(include_url=False)
    path, field = _field_at(model, faults[0]["loc"])
    fault = [f for f in faults if _field_at(model, f["loc"])[0] == path][-1]  # the last branch of a union says most
    key = shortened(".".join(path)) or "(the whole document)"
    if fault["type"] == "extra_forbidden":
        owner, _ = _field_at(model, fault["loc"][:-1])
        return path, f"unknown key '{key}'{nearest(path[-1][:LONGEST], _known_keys(model, owner))}"
    got = "" if fault["type"] == "missing" else f", got {shortened(repr(fault['input']))}"
    low, high = _bounds(field)
    if fault["type"] in OFF_BOUNDS and (low is not None or high is not None):
        span = f"at least {low}" if high is None else f"at most {high}" if low is None else f"{low:g} to {high:g}"
        name = next((part for part in reversed(path) if not part.isdigit()), "")  # not an item's number in a list
        unit = next((u for suffix, u in UNITS.items() if f"_{name}".endswith(suffix)), "")
        return path, f"key '{key}': " + f"expected {span} {unit}".rstrip() + got
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "model_type":
        message = "expected a table of keys"
    return path, f"key '{key}': {message[:1].lower()}{message[1:]}{got}"


def nearest(word: str, known: Sequence[str]) -> str:
    """` (did you mean '…'?)`, or nothing where no known word is near."""
    match = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f" (did you mean '{match[0]}'?)" if match else ""


def shortened(text: str) -> str:
    """A user's text as it may stand in a sentence: escapes visible, no longer than a line."""
    shown = visible(text)
    return shown if len(shown) <= LONGEST else f"{shown[: LONGEST - 3]}..."


def _field_at(model: type[BaseModel], loc: Sequence[str | int]) -> tuple[tuple[str, ...], Any]:
    """The path of a fault without the names of a union's branches, and the field (or annotation) that it leads to."""
    path: list[str] = []
    node: Any = model
    for i, part in enumerate(loc):
        fields = {f.alias or n: f for m in _models(node) for n, f in m.model_fields.items()}
        if isinstance(part, int):
            path.append(str(part))
        elif part in fields:
            path.append(part)
            node = fields[part]
        elif fields and i == len(loc) - 1:  # a key that is not known, or missing
            path.append(part)
    return tuple(path), node


def _known_keys(model: type[BaseModel], path: Sequence[str]) -> list[str]:
    return [n for m in _models(_field_at(model, path)[1]) for n in m.model_fields]


def _models(node: Any) -> Iterator[type[BaseModel]]:
    """Models in a field, an annotation, or a branch of one."""
    if isinstance(node, FieldInfo):
        node = node.annotation
    if isinstance(node, type) and issubclass(node, BaseModel):
        yield node
    for part in get_args(node):
        yield from _models(part)


def _bounds(node: Any) -> tuple[float | None, float | None]:
    """Lowest and highest value of a field, also where they stand in a branch of its annotation."""
    low = high = None
    extra = [node.annotation, *node.metadata] if isinstance(node, FieldInfo) else []
    for part in (*extra, *getattr(node, "__metadata__", ()), *get_args(node)):
        low = next((getattr(part, k) for k in ("gt", "ge") if hasattr(part, k)), low)
        high = next((getattr(part, k) for k in ("lt", "le") if hasattr(part, k)), high)
        inner = _bounds(part)
        low, high = (a if b is None else b for a, b in zip((low, high), inner, strict=True))
    return low, high
