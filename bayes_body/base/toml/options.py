"""What options mean: the text below each field of a schema, for the guide's tables, for editors and for `help`."""

import ast
import inspect
import json
import re
import textwrap
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

from pydantic import BaseModel
from pydantic.fields import FieldInfo


class Option(NamedTuple):
    """One key of a table.

    Attributes:
        key: its name in a definition.
        default: as it is written in TOML; `required` or `none` if there is none.
        unit: of a number; empty if it has none.
        text: what it is.
    """

    key: str
    default: str
    unit: str
    text: str


def options_of(schema: type[BaseModel]) -> list[Option]:
    """Return the options of a schema in the order of its fields. The text below a field may begin with a unit in brackets."""
    texts = _texts(schema)
    options = []
    for name, field in schema.model_fields.items():
        written = texts.get(name, "")
        unit = re.match(r"\[([^\]`]*)\] ", written)
        text = written[unit.end() :] if unit else written
        options.append(Option(field.alias or name, _default(field), unit[1] if unit else "", text.removesuffix(".")))
    return options


def options_table(schema: type[BaseModel]) -> str:
    """Return the rows of a Markdown table: key, default, unit, and what it is."""
    return "\n".join(f"| `{key}` | {default} | {unit} | {text} |".replace("|  |", "| |") for key, default, unit, text in options_of(schema))


def json_schema(schema: type[BaseModel]) -> dict[str, Any]:
    """Return the JSON Schema of a table, with the description and unit of each key."""
    document = schema.model_json_schema()
    for option in options_of(schema):
        unit = f" ({option.unit})" if option.unit else ""
        document["properties"][option.key]["description"] = f"{option.text}{unit}".replace("`", "")
    return document


def _texts(schema: type[BaseModel]) -> dict[str, str]:
    """Return the string below each field, from the source of the class and of those that it derives from."""
    texts: dict[str, str] = {}
    for derived in reversed(schema.__mro__):
        if not issubclass(derived, BaseModel) or derived is BaseModel:
            continue
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(derived))).body
        lines = definition.body if isinstance(definition, ast.ClassDef) else []
        for field, below in pairwise(lines):
            match field, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    texts[name] = " ".join(text.split())
    return texts


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None or value == {}:
        return "none"
    if isinstance(value, bool | int | float):
        return _toml(value)
    return f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    if isinstance(value, BaseModel):
        value = value.model_dump(exclude_unset=True)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_toml(entry)}" for key, entry in value.items()) + " }" if value else "{}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, float) and not isinstance(value, bool):
        return f"{value:g}" if value == float(f"{value:g}") else repr(value)
    return json.dumps(value)
