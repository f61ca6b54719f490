"""Convert Pydantic's errors to sentences for the author of the file: `where: key = value; expected ...; remedy.`

A table of an array is identified by its `name`, as in `camera 'CAM2'.focal_px #1`. Entries without a name are counted from one.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, NamedTuple, TypeAliasType, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from bayes_body.base.errors import escaped, input_error, nearest

# Longer values are cut, since the sentence is about the key.
LONGEST_VALUE = 60
# A file with more faults than this is another kind of file.
MOST_FAULTS = 100

TABLE = ("a table", "write it as a header in brackets, then lines key = value")
LIST = ("a list", "write its entries in brackets, with commas between")
NUMBER = ("a number", "write it without quotes, such as 0.5")
WHOLE = ("a whole number", "write it without quotes, such as 5")
# For each of pydantic's error types: what was expected (empty if pydantic's own words are clear to a user), and the remedy.
PLAIN_WORDS = {
    "finite_number": ("a finite number", "write a number such as 0.5"),
    "float_type": NUMBER,
    "float_parsing": NUMBER,
    "int_type": WHOLE,
    "int_parsing": WHOLE,
    "int_from_float": WHOLE,
    "string_type": ("a string", "put it in double quotes"),
    "bool_type": ("true or false", "write it without quotes"),
    "bool_parsing": ("true or false", "write it without quotes"),
    "greater_than": ("", "write a larger number"),
    "greater_than_equal": ("", "write a larger number"),
    "less_than": ("", "write a smaller number"),
    "less_than_equal": ("", "write a smaller number"),
    "model_type": TABLE,
    "model_attributes_type": TABLE,
    "dict_type": TABLE,
    "tuple_type": LIST,
    "list_type": LIST,
    "too_short": ("", "add what is missing"),
    "too_long": ("", "remove the surplus entries"),
}


class _Fault(NamedTuple):
    """An error of pydantic, the path of keys as the user wrote them (without pydantic's labels), and the annotation at the end of the path."""

    path: tuple[str | int, ...]
    annotation: Any
    parent: Any
    error: ErrorDetails


def sentences(schema: type[BaseModel], data: Mapping[str, Any], file: str, errors: Sequence[ErrorDetails]) -> list[str]:
    """Return one sentence for each fault, as a user would count them.

    Args:
        schema: the model that the data were validated with.
        data: the tables as read.
        file: the name of the file in the sentences.
        errors: the result of `ValidationError.errors()`.
    """
    faults: dict[tuple[str | int, ...], list[_Fault]] = {}
    for error in errors[:MOST_FAULTS]:
        if _is_echo(error):
            continue
        fault = _locate(schema, error)
        # Pydantic reports a separate error for each missing entry of a tuple, and for each member of a union. To the user it is one error.
        path = fault.path[:-1] if _is_short_tuple(fault) else fault.path
        faults.setdefault(path, []).append(fault)
    lines = list(dict.fromkeys(sentence for path, group in faults.items() for sentence in _describe(file, data, path, group)))
    return [*lines, f"{file}: further faults, {len(errors)} in all; correct these first."] if len(errors) > MOST_FAULTS else lines


def _is_echo(error: ErrorDetails) -> bool:
    """Whether a list is too short only because pydantic counts its valid entries. The faults of the other entries are reported separately."""
    return error["type"] == "too_short" and len(error["input"]) >= error.get("ctx", {})["min_length"]


def _is_short_tuple(fault: _Fault) -> bool:
    return fault.error["type"] == "missing" and isinstance(fault.path[-1], int)


def _describe(file: str, data: Mapping[str, Any], path: tuple[str | int, ...], group: list[_Fault]) -> Iterator[str]:
    name = _name(data, path)
    subject = f"{file}: {name}" if name else file
    fault, error = group[0], group[0].error
    kind = error["type"]
    if kind in ("value_error", "assertion_error"):
        for alternative in group:
            message = alternative.error["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
            yield from (f"{subject}: {line}" for line in message.splitlines())
    elif kind == "extra_forbidden":
        yield f"{subject}: unknown key; {nearest(str(path[-1]), _keys(fault.parent))}"
    elif _is_short_tuple(fault):
        value, wanted = _value(data, path), len(get_args(fault.parent))
        yield str(input_error(file, f"{name} = {shown(value)}", f"{wanted} entries, not {len(value)}", PLAIN_WORDS["too_short"][1]))
    elif kind == "missing":
        yield str(input_error(subject, "missing", _kind_of(fault.annotation), "add it" + (f" to {_name(data, path[:-1])}" if path[:-1] else "")))
    elif kind == "literal_error" and isinstance(error["input"], str) and len(group) == 1:
        choices = [str(value) for value in get_args(_plain(fault.annotation))]
        yield f"{file}: {name} = {shown(error['input'])}: no such choice; {nearest(error['input'], choices)}"
    elif kind == "union_tag_invalid":
        context = error.get("ctx", {})
        tag, choices = context["tag"], context["expected_tags"].replace("'", "").split(", ")
        yield f"{subject}.{_discriminator(error)} = {shown(tag)}: no such choice; {nearest(tag, choices)}"
    elif kind == "union_tag_not_found":
        yield str(input_error(f"{subject}.{_discriminator(error)}", "missing", "the name of a kind", "add it"))
    elif kind in ("tuple_type", "list_type") and isinstance(error["input"], Mapping):
        yield str(input_error(subject, "one table", "a list of tables", f"write its header with two brackets on each side, [[{name}]]"))
    else:
        expected = " or ".join(dict.fromkeys(_expectation(alternative.error) for alternative in group))
        yield str(input_error(file, f"{name} = {shown(error['input'])}", expected, PLAIN_WORDS.get(kind, ("", "correct the value"))[1]))


def _expectation(error: ErrorDetails) -> str:
    kind, context = error["type"], error.get("ctx", {})
    if kind == "too_short":
        return f"at least {context['min_length']} entries, not {context['actual_length']}"
    if kind == "too_long":
        return f"at most {context['max_length']} entries, not {context['actual_length']}"
    if kind.startswith("greater_than") or kind.startswith("less_than"):
        return f"a number {error['msg'].removeprefix('Input should be ')}"
    return PLAIN_WORDS.get(kind, ("",))[0] or re.sub("^Input should (be|have) |valid ", "", error["msg"])


def _name(data: Any, path: tuple[str | int, ...]) -> str:
    text = ""
    for step in path:
        data = _child(data, step)
        if isinstance(step, str):
            text += f".{_short(step)}" if text else _short(step)
        elif isinstance(data, Mapping) and isinstance(data.get("name"), str):
            text += f" '{_short(data['name'])}'"
        else:
            text += f" #{step + 1}"
    return escaped(text)


def _value(data: Any, path: tuple[str | int, ...]) -> Any:
    for step in path:
        data = _child(data, step)
    return data


def _child(data: Any, step: str | int) -> Any:
    try:
        return data[step]
    except (KeyError, IndexError, TypeError):
        return None


def shown(value: Any) -> str:
    """Return a value as in the file, shortened if it is long."""
    text = f'"{value}"' if isinstance(value, str) else "a table" if isinstance(value, Mapping) else str(value)
    return _short(text)


def _short(text: str) -> str:
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."


def _locate(schema: type[BaseModel], error: ErrorDetails) -> _Fault:
    """Follow pydantic's location through the annotations. Within a union, its next step is a label of the member, which is not in the user's file."""
    path: list[str | int] = []
    parent, annotation = None, schema
    for step in error["loc"]:
        annotation = _plain(annotation)
        if _is_union(annotation):
            annotation = _member(annotation, step)
        elif step != "[key]":
            path.append(step)
            parent, annotation = annotation, _inside(annotation, step)
    return _Fault(tuple(path), annotation, parent, error)


def _discriminator(error: ErrorDetails) -> str:
    return error.get("ctx", {})["discriminator"].strip("'")


def _plain(annotation: Any) -> Any:
    """Return the annotation without metadata, without `type` aliases, and without `| None`."""
    while True:
        if isinstance(annotation, TypeAliasType):
            annotation = annotation.__value__
        elif get_origin(annotation) is Annotated:
            annotation = get_args(annotation)[0]
        elif get_origin(annotation) in (Union, UnionType) and len(members := [a for a in get_args(annotation) if a is not type(None)]) == 1:
            annotation = members[0]
        else:
            return annotation


def _is_union(annotation: Any) -> bool:
    return get_origin(annotation) in (Union, UnionType)


def _member(union: Any, label: str | int) -> Any:
    members = [_plain(member) for member in get_args(union)]
    models = [member for member in members if isinstance(member, type) and issubclass(member, BaseModel)]
    for model in models:
        # The label is the model's name, or in a discriminated union the value of the field that tells the members apart.
        if model.__name__ == label or any(label in get_args(_plain(field.annotation)) for field in model.model_fields.values()):
            return model
    other_members = [member for member in members if member not in models and str(getattr(member, "__name__", member)) in str(label)]
    return other_members[0] if other_members else Any


def _inside(annotation: Any, step: str | int) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for name, field in annotation.model_fields.items():
            if step in (name, field.alias):
                return field.annotation
    arguments = get_args(annotation)
    if isinstance(step, int) and len(arguments) > step and Ellipsis not in arguments and get_origin(annotation) is tuple:
        return arguments[step]
    if not arguments:
        return Any
    return arguments[0] if isinstance(step, int) else arguments[-1]


def _keys(annotation: Any) -> list[str]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [field.alias or name for name, field in annotation.model_fields.items()]
    return []


def _kind_of(annotation: Any) -> str:
    annotation = _plain(annotation)
    if get_origin(annotation) in (tuple, list):
        return "a list"
    return {str: "a string", float: "a number", int: "a whole number", bool: "true or false"}.get(annotation, "a value")
