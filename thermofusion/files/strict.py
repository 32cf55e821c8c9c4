"""Documents from outside, held against a schema: pydantic at the border, one sentence for the first fault."""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from ..errors import ScanError

Doc = TypeVar("Doc", bound=BaseModel)


class Border(BaseModel):
    """A group of a document: unknown keys are kept, infinities refused."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class ClosedBorder(BaseModel):
    """A group of a document in which an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def first_fault(error: ValidationError) -> str:
    """One sentence on the first fault: the dotted key, and what was expected."""
    fault = error.errors(include_url=False)[0]
    key = ".".join(str(p) for p in fault["loc"]) or "(the whole document)"
    return f"key '{key}': {fault['msg'][0].lower()}{fault['msg'][1:]}"


def validated(model: type[Doc], tree: object, place: object, hint: str | None = None) -> Doc:
    """`tree` (decoded JSON or TOML) as `model`. Raises ScanError that names the first faulty key."""
    try:
        return model.model_validate(tree)
    except ValidationError as e:
        raise ScanError(first_fault(e), place=place, hint=hint) from None
