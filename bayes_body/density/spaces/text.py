"""Spaces as text, stored beside a variable's draws: JSON with the name of the class as `kind`, and its fields."""

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

from bayes_body.density.spaces.compound import Plate, Product
from bayes_body.density.spaces.flat import Flat
from bayes_body.density.spaces.groups import SE3, SO3
from bayes_body.density.spaces.space import Space

KINDS: Mapping[str, Any] = {kind.__name__: kind for kind in (Flat, SO3, SE3, Product, Plate)}


def space_to_text(space: Space) -> str:
    """Return the text from which `space_from_text` makes an equal space."""
    return json.dumps(_encoded(space), allow_nan=False)


def space_from_text(text: str) -> Space:
    """Return the space that `space_to_text` wrote.

    Raises:
        ValueError: the text is not that of a space.
    """
    try:
        return _decoded(json.loads(text))
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"not a space: {text[:80]}") from error


def _encoded(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_encoded(entry) for entry in value]
    # JSON has no infinity; a missing limit is null.
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if not dataclasses.is_dataclass(value):
        return value
    fields = {field.name: _encoded(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return {"kind": type(value).__name__, **fields}


def _decoded(value: Any) -> Any:
    fields = {name: _entry(name, field) for name, field in value.items() if name != "kind"}
    return KINDS[value["kind"]](**fields)


def _entry(name: str, value: Any) -> Any:
    if isinstance(value, dict):
        return _decoded(value)
    if isinstance(value, list):
        missing = {"low": -math.inf, "high": math.inf}
        return tuple(missing[name] if entry is None else _entry(name, entry) for entry in value)
    return value
