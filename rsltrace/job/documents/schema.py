"""The JSON Schema of a job file, made from the models alone: editors complete and check with it.

It accepts what the loader accepts, as far as a schema can say; what it cannot say (files that must
exist, times in order) the loader still checks. A file with ``base:`` or ``include:`` may leave out
what the others give, and take keys away with null: it has looser definitions of its own.
"""

from __future__ import annotations

import inspect
import types
from collections.abc import Sequence
from itertools import combinations
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from rsltrace.job.job import Job
from rsltrace.job.parts.field import FrozenFields, PartField
from rsltrace.job.parts.keys import attached, file_fields, model_of
from rsltrace.job.parts.part import JobPart
from rsltrace.job.reading.compose import CompositionKeys
from rsltrace.job.values.times import TIME_SCHEMA, format_time

Schema = dict[str, Any]

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_SUBSTITUTION: Schema = {"$ref": "#/$defs/Substitution"}
FREE = "Means nothing: a place for YAML anchors."
_NULL: Schema = {"type": "null"}
_SCALARS: dict[Any, Schema] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string"},
}


def job_schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of a job file."""
    definitions: Schema = {
        "Substitution": {
            "description": "Text with $(env NAME default), $(var NAME), $(find-pkg-share PACKAGE) "
            "or $(dirname) in it",
            "type": "string",
            "pattern": r"\$\(.+\)",
        },
        "Parameter": _parameter(),
    }
    root = {}
    for partial in (False, True):
        maker = _Maker(definitions, partial=partial)
        root[partial] = maker.reference(Job)
    return {
        "$schema": DIALECT,
        "title": "A job of rsltrace",
        "type": "object",
        "if": {"anyOf": [{"required": ["base"]}, {"required": ["include"]}]},
        "then": root[True],
        "else": root[False],
        "$defs": dict(sorted(definitions.items())),
    }


def field_schema(field: PartField) -> Schema:
    """Return what a field accepts, with references to the definitions of its parts."""
    return _Maker({}, partial=False).field(field, bare=True)


def file_default(field: PartField) -> Any:
    """Return the default of a field as a job file would say it, or None."""
    if field.is_required():
        return None
    value = field.get_default()
    if type(value) is int and attached(field, "schema") is TIME_SCHEMA:
        return format_time(value)
    return _plain(value)


def _plain(value: Any) -> Any:
    if isinstance(value, JobPart):
        return None  # its own keys tell
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value if isinstance(value, (bool, int, float, str, dict)) else None


class _Maker:
    """Makes definitions of parts; ``partial`` ones require nothing and allow null."""

    def __init__(self, definitions: Schema, *, partial: bool) -> None:
        self._definitions = definitions
        self._partial = partial

    def reference(self, model: type[FrozenFields]) -> Schema:
        """Return a reference to a part's definition, which is made if need be."""
        name = model.__name__.removesuffix("Spec") + ("Change" if self._partial else "")
        if name not in self._definitions:
            self._definitions[name] = {}  # a part may contain itself
            self._definitions[name] = self._definition(model)
        return {"$ref": f"#/$defs/{name}"}

    def _definition(self, model: type[FrozenFields]) -> Schema:
        fields = dict(file_fields(model))
        if model is Job:
            fields = {**dict(file_fields(CompositionKeys)), **fields}
        definition: Schema = {
            "description": summary(model),
            "type": "object",
            "properties": {key: self.field(field) for key, field in fields.items()},
            "additionalProperties": False,
        }
        required = [key for key, field in fields.items() if field.is_required()]
        if required and not self._partial:
            definition["required"] = required
        one_of, alternatives = getattr(model, "ONE_OF", ()), getattr(model, "ALTERNATIVES", ())
        if one_of and not alternatives and not self._partial:
            definition["oneOf"] = [{"required": [key]} for key in one_of]
        if alternatives:
            pairs = [(a[0], b[0]) for a, b in combinations(alternatives, 2)]
            definition["not"] = {"anyOf": [{"required": list(pair)} for pair in pairs]}
        if model is Job:
            definition["patternProperties"] = {"^x-": {"description": FREE}}
        if model is Job and not self._partial:
            needed = ("nodes", "launch", "bags")
            definition["anyOf"] = [{"required": [key]} for key in needed]
        return definition

    def field(self, field: PartField, *, bare: bool = False) -> Schema:
        """Return the schema of a key's value; ``bare`` without what only a file may say."""
        schema = self._of(field.annotation, field.checks)
        if bare:
            return schema
        whole = _substitutable(schema)
        if self._partial:
            whole = {"anyOf": [*_options(whole), _NULL]}
        annotated: Schema = {}
        if field.description:
            annotated["description"] = field.description
        default = file_default(field)
        if default is not None and default not in ({}, []):
            annotated["default"] = default
        if field.examples:
            annotated["examples"] = list(field.examples)
        return {**annotated, **whole}

    def _of(self, annotation: Any, metadata: Sequence[Any]) -> Schema:
        """Return the schema of a type with the checks in its metadata."""
        origin = get_origin(annotation)
        if origin is Annotated:
            annotation, *more = get_args(annotation)
            return self._of(annotation, [*metadata, *more])
        facts: Schema = {}
        for item in metadata:
            for name in (
                "schema",
                "shorthand",
                "entry_shorthand",
                "value_shorthand",
                "words",
                "or_text",
                "or_entry",
                "names",
            ):
                value = getattr(item, name, None)
                if value is not None:
                    facts[name] = value
        if "schema" in facts:
            return dict(facts["schema"])
        schema = self._by_type(annotation, facts)
        if "words" in facts:  # that stand for a whole list
            return {"anyOf": [{"enum": list(facts["words"])}, schema]}
        if "or_entry" in facts:
            return {"anyOf": [schema["items"], schema]}
        if "or_text" in facts:
            return {"anyOf": [{"type": "string"}, schema]}
        return schema

    def _by_type(self, annotation: Any, facts: Schema) -> Schema:
        origin, arguments = get_origin(annotation), get_args(annotation)
        if origin in (Union, types.UnionType):
            options = [self._of(a, []) for a in arguments if a is not type(None)]
            if len(options) == 1:
                inner = next(a for a in arguments if a is not type(None))
                return self._by_type(inner, facts)
            return {"anyOf": options}
        if origin is Literal:
            return {"enum": list(arguments)}
        if origin is tuple:
            items = self._short(arguments[0], facts.get("entry_shorthand"))
            return {"type": "array", "items": items}
        if origin is dict:
            value = self._short(arguments[1], facts.get("value_shorthand"))
            names = {"propertyNames": facts["names"]} if "names" in facts else {}
            return {"type": "object", **names, "additionalProperties": value}
        if model_of(annotation) is not None:
            return self._short(annotation, facts.get("shorthand"))
        return dict(_SCALARS.get(annotation, {}))

    def _short(self, annotation: Any, shorthand: str | None) -> Schema:
        """Return the schema of a part, or of the value of one key that may stand for it."""
        model = model_of(annotation)
        if model is None:
            return self._of(annotation, [])
        reference = self.reference(model)
        if shorthand is None:
            return reference
        field = next(field for key, field in file_fields(model) if key == shorthand)
        short = self._of(field.annotation, field.checks)
        return {"anyOf": [reference, *_options(short)]}


def summary(model: type[FrozenFields]) -> str:
    """Return the first paragraph of a model's docstring."""
    return " ".join(inspect.cleandoc(model.__doc__ or "").split("\n\n")[0].split())


def _options(schema: Schema) -> list[Schema]:
    return list(schema["anyOf"]) if list(schema) == ["anyOf"] else [schema]


def _substitutable(schema: Schema) -> Schema:
    """Return a schema that accepts ``$(...)`` wherever it asks for a scalar, however deep."""
    if schema.get("type") == "array":
        return {**schema, "items": _substitutable(schema.get("items", {}))}
    if schema.get("type") == "object":
        inner = schema.get("additionalProperties")
        if not isinstance(inner, dict):
            return schema
        return {**schema, "additionalProperties": _substitutable(inner)}
    options = [
        _substitutable(option) if option.get("type") in ("array", "object") else option
        for option in _options(schema)
    ]
    scalars = [option for option in options if "enum" in option or _is_scalar(option)]
    free = any(option == {"type": "string"} for option in options) or options == [{}]
    if scalars and not free:
        options.append(_SUBSTITUTION)
    return options[0] if len(options) == 1 else {"anyOf": options}


def _is_scalar(schema: Schema) -> bool:
    kinds = schema.get("type", ())
    return bool(
        {"string", "number", "integer", "boolean"}
        & set([kinds] if isinstance(kinds, str) else kinds)
    )


def _parameter() -> Schema:
    """Return the schema of a ROS parameter's value, or of parameters below a common name."""
    scalars: list[Schema] = [{"type": "boolean"}, {"type": "number"}, {"type": "string"}]
    below = {
        "type": "object",
        "propertyNames": {"not": {"const": "ros__parameters"}},
        "additionalProperties": {"$ref": "#/$defs/Parameter"},
    }
    arrays = [{"type": "array", "minItems": 1, "items": item} for item in scalars]
    return {"description": "A ROS parameter", "anyOf": [*scalars, *arrays, below]}
