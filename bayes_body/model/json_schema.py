"""The JSON Schema of a definition, from which an editor completes keys and explains them."""

from typing import Any

from pydantic import BaseModel

from bayes_body.base.registry import Room, find, names
from bayes_body.base.toml.options import json_schema
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.definition import PLACEMENTS, DetectorsTable, FirstTable, definition_names


def definition_schema() -> dict[str, Any]:
    """Return the JSON Schema of a definition: all terms that are registered, those of plugins included."""
    document = _Definitions()
    body: dict[str, Any] = {
        "anyOf": [
            {"type": "object", "properties": {"name": {"type": "string", "examples": list(definition_names("bodies"))}}},
            document.table(BodySchema),
        ]
    }
    body["properties"] = {"placement": {"enum": list(PLACEMENTS), "default": PLACEMENTS[0], "description": "how a state places the body"}}
    potentials = {"type": "array", "items": document.terms("potential")}
    properties = {
        "title": {"type": "string", "description": "one line, shown by `bayes-body models`"},
        "source": {"type": "string", "description": "the publication that the model follows"},
        "body": body,
        "dynamics": document.terms("dynamics"),
        "first": document.table(FirstTable),
        "likelihood": {"type": "array", "minItems": 1, "items": document.terms("likelihood")},
        "constraint": potentials,
        "potential": potentials,
        "unknown": {"type": "array", "items": document.terms("unknown")},
        "kernel": document.terms("kernel"),
        "detectors": document.table(DetectorsTable),
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "A model definition of bayes_body",
        "type": "object",
        "properties": properties,
        "required": ["title", "source", "body", "dynamics", "likelihood", "kernel"],
        "additionalProperties": False,
        "$defs": document.shared,
    }


class _Definitions:
    """Schemas of tables, whose parts lie side by side in `$defs` under names of their own."""

    def __init__(self) -> None:
        self.shared: dict[str, Any] = {}

    def table(self, schema: type[BaseModel], prefix: str = "") -> dict[str, Any]:
        """Return the schema of a table."""
        document = json_schema(schema)
        parts = document.pop("$defs", {})
        renamed = {f"#/$defs/{name}": f"#/$defs/{prefix}{name}" for name in parts}
        self.shared |= {f"{prefix}{name}": _with_references(part, renamed) for name, part in parts.items()}
        return _with_references(document, renamed)

    def terms(self, room: Room) -> dict[str, Any]:
        """Return the schema of a table that is one of the terms of a room."""
        return {"oneOf": [self._term(room, name) for name in names(room)]}

    def _term(self, room: Room, name: str) -> dict[str, Any]:
        table = self.table(find(room, name).options, f"{room}.{name}.")
        table["title"] = name
        properties = {"kind": {"const": name}, **table.get("properties", {})}
        if room == "likelihood" and name in names("observation"):
            properties["observation"] = self.table(find("observation", name).options, f"observation.{name}.")
        return {**table, "properties": properties, "required": ["kind", *table.get("required", [])]}


def _with_references(document: Any, renamed: dict[str, str]) -> Any:
    if isinstance(document, dict):
        return {key: renamed.get(value, value) if key == "$ref" else _with_references(value, renamed) for key, value in document.items()}
    return [_with_references(entry, renamed) for entry in document] if isinstance(document, list) else document
