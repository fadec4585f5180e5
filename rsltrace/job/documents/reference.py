"""``docs/jobs.md``: every key of a job file, written from the models that read it (``make docs``).

A key that is added to a model is documented by its field's description and examples; a test fails
when one has none, or when the file is stale.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from io import StringIO
from typing import Any

from ruamel.yaml import YAML

from rsltrace.job.documents.schema import field_schema, file_default, summary
from rsltrace.job.job import Job
from rsltrace.job.parts.field import FrozenFields, PartField
from rsltrace.job.parts.keys import attached, file_fields, models_in
from rsltrace.job.reading.compose import CompositionKeys
from rsltrace.job.values.times import TIME_SCHEMA

_BOOLEAN = "true or false"
_LARGE = 10_000
"""Bounds of numbers beyond this are not shown: they do not matter to a reader."""

_HEAD = """\
# Jobs: every key

<!-- Made by `make docs` from the models in rsltrace/job; do not edit. -->

`rsltrace init` writes a first job, `rsltrace check job.yaml` checks it without running it. A rule
for a topic, service, node or parameter that does not exist is a note.

- **Times** are seconds (`0.5`), or a number with a unit: `ns`, `us`, `ms`, `s`, `min` or `h`.
- **Sizes** are bytes, or a number with a unit: `500kB`, `4MiB`.
- **Paths** are relative to their file. **Globs** match whole names; `*` also matches `/`.
- **YAML anchors** work. Keys that begin with `x-` are ignored and may hold them.
- **Editors** complete and check job files: run `rsltrace schema > job.schema.json`, and begin the
  job with `# yaml-language-server: $schema=job.schema.json`.
- **The command line** overrides any key: `--set stop.duration=10s`,
  `--set nodes.ekf.parameters.rate=20.0` (a node by name, an entry by number from 0),
  `--set bags.+=../bag` (a new entry), `--set stop.events=null` (no such key). The value is YAML.
  Quote names with a dot. Later ones win.

Types, and keys of short mappings, are named only where the example does not show them.
"""


def reference() -> str:
    """Return the text of ``docs/jobs.md``."""
    out = [_HEAD]
    done: dict[type[FrozenFields], str] = {}
    out += _section("The job", None, [*file_fields(Job), *file_fields(CompositionKeys)], done)
    queue = list(_parts([*file_fields(Job)], ""))
    while queue:
        path, model = queue.pop(0)
        if model in done:
            continue
        fields = list(file_fields(model))
        if all(field.is_required() for _, field in fields):
            continue  # the example of its key shows all that it has
        out += _section(f"`{path}`", model, fields, done)
        done[model] = path
        queue = [*_parts(fields, path), *queue]
    return "\n".join(out).rstrip() + "\n"


def _parts(
    fields: list[tuple[str, PartField]], path: str
) -> Iterator[tuple[str, type[FrozenFields]]]:
    for key, field in fields:
        inner = f"{path}.{key}" if path else key
        kind = field_schema(field).get("type")
        if kind == "array":
            inner += "[]"
        elif kind == "object":
            inner += ".NAME"
        for model in models_in(field.annotation):
            yield inner, model


def _section(
    title: str,
    model: type[FrozenFields] | None,
    fields: list[tuple[str, PartField]],
    done: dict[type[FrozenFields], str],
) -> list[str]:
    """Return a section. Keys of a base class that has a section, in ``done``, are not repeated."""
    out = [f"## {title}", ""]
    if model is not None:
        out += [_wrapped(summary(model).replace("``", "`")), ""]
        base = next((one for one in done if _extends(model, one)), None)
        if base is not None:
            known = dict(file_fields(base))
            fields = [(key, field) for key, field in fields if key not in known]
            keys = ", ".join(f"`{key}`" for key, _ in file_fields(model))
            same = f"It has the keys of `{done[base]}`, and:"
            out += [_wrapped(same if fields else f"Keys as in `{done[base]}`: {keys}."), ""]
    for key, field in fields:
        out += _entry(key, field)
    return [*out, ""] if fields else out


def _extends(model: type[FrozenFields], other: type[FrozenFields]) -> bool:
    """Whether a model has all keys of another, or only such keys."""
    return issubclass(model, other) or issubclass(other, model)


def _entry(key: str, field: PartField) -> list[str]:
    kind = _words(field_schema(field), field)
    values = [value for value in field.examples or () if not isinstance(value, (bool, int, float))]
    values = [value for value in values if f"`{flow(value)}`" not in kind]
    default = file_default(field)
    facts = [] if values and not re.search(r"[`\d]", kind) else [kind]
    if field.is_required():
        facts.append("required")
    elif default is not None and default not in ({}, []):
        facts = facts if kind != _BOOLEAN else []
        facts.append(f"default `{flow(default)}`")
    brackets = f" ({'; '.join(facts)})" if facts else ""
    text = f"- **`{key}`**{brackets}: {(field.description or '').strip()}"
    examples = "  " + ", ".join(f"`{flow(value)}`" for value in values)
    return [*_wrapped(text, "  ").splitlines(), *[examples] * bool(values)]


def _wrapped(text: str, indent: str = "") -> str:
    return textwrap.fill(
        text, 100, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


def _words(schema: dict[str, Any], field: PartField | None = None) -> str:
    """Return what a schema accepts, in a few words."""
    if field is not None and attached(field, "schema") is TIME_SCHEMA:
        return "time"
    if schema == TIME_SCHEMA:
        return "time"
    words = schema.get("x-words")
    if isinstance(words, str):
        return words
    if "$ref" in schema:
        return "mapping"
    if "anyOf" in schema:
        options = list(schema["anyOf"])
        if all(time in options for time in TIME_SCHEMA["anyOf"]):  # type: ignore[attr-defined]
            options = [o for o in options if o not in TIME_SCHEMA["anyOf"]]  # type: ignore[operator]
            options.append(TIME_SCHEMA)
        return ", ".join(dict.fromkeys(_words(option) for option in options))
    if "enum" in schema:
        return ", ".join(f"`{flow(choice)}`" for choice in schema["enum"])
    kind = schema.get("type")
    if kind == "array":
        items = schema.get("items") or {}
        return "list of mappings" if "$ref" in items else f"list of {_words(items)}"
    if kind == "object":
        inner = schema.get("additionalProperties")
        is_part = isinstance(inner, dict) and "$ref" in str(inner) and "Parameter" not in str(inner)
        return "mapping of names" if is_part else "mapping"
    if kind in ("integer", "number"):
        least, most = schema.get("minimum"), schema.get("maximum")
        word = "integer" if kind == "integer" else "number"
        open_below = schema.get("exclusiveMinimum")
        least = least if least is not None and least > -_LARGE else None
        most = most if most is not None and most < _LARGE else None
        if least is not None and most is not None:
            return f"{word} {least} to {most}"
        if open_below is not None:
            word += f" > {open_below}"
        if least is not None:
            word += f" ≥ {least}"
        if most is not None:
            word += f" ≤ {most}"
        return word
    return {"string": "text", "boolean": _BOOLEAN}.get(str(kind), "any value")


def flow(value: Any) -> str:
    """Return a value as YAML on one line."""
    yaml = YAML()
    yaml.default_flow_style = True
    yaml.width = 2**20
    stream = StringIO()
    yaml.dump(value, stream)
    text = stream.getvalue().strip()
    return text.removesuffix("...").strip()


if __name__ == "__main__":
    print(reference(), end="")
