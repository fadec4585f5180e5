"""``docs/jobs.md``: every key of a job file, written from the models that read it (``make docs``).

A key that is added to a model is documented by its field's description and examples; a test fails
when one has none, or when the file is stale.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from io import StringIO
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from ruamel.yaml import YAML

from rsltrace.job.documents.schema import field_schema, file_default, summary
from rsltrace.job.job import Job
from rsltrace.job.parts.keys import attached, file_fields, models_in
from rsltrace.job.reading.compose import Composition
from rsltrace.job.values.times import TIME_SCHEMA

_HEAD = """\
# Jobs: every key

<!-- Made by `make docs` from the models in rsltrace/job; do not edit. -->

A job file is YAML. It says which nodes run, what plays in, what ends the run and what is kept.
`rsltrace init` writes a first one, `rsltrace check job.yaml` shows what it means without running
it, and a mistake is an error with file, line, column and what was expected. What names a topic,
service, node or parameter that is not there (in a rule, a remapping, a glob without `*` in front, a
row of a delay file) is no error: `check` lists it, and `record` at the end.

- **Times** are a number of seconds (`0.5`) or a number with a unit: `5ms`, `0.2s`, `2min`. Units
  are `ns`, `us` (`µs`), `ms`, `s`, `min` and `h`. They are read exactly, never through a float.
- **Sizes** are a number of bytes or a number with a unit: `500kB`, `4MiB`.
- **Paths** start in the folder of the file they stand in.
- **YAML anchors** (`&name`, `*name`, `<<`) work; keys that begin with `x-` mean nothing and may
  hold what they refer to.
- **Globs** are shell patterns over whole names; `*` matches `/`, too.
- **Editors** complete and check: `rsltrace schema > job.schema.json`, and as the first line of the
  job `# yaml-language-server: $schema=job.schema.json`.
- **The command line** sets any key: `--set stop.duration=10s`,
  `--set nodes.ekf.parameters.rate=20.0` (a node by name, or a list entry by number, from 0),
  `--set bags.+=../bag` (a new entry), `--set stop.events=null` (take a key away). The value is
  YAML; paths in it start in the current folder. Names with a dot go in quotes. Later ones win.
"""


def reference() -> str:
    """Return the text of ``docs/jobs.md``."""
    out = [_HEAD]
    done: set[type[BaseModel]] = set()
    out += _section("The job", None, [*file_fields(Job), *file_fields(Composition)], "")
    queue = list(_parts([*file_fields(Job)], ""))
    while queue:
        path, model = queue.pop(0)
        if model in done:
            continue
        done.add(model)
        fields = list(file_fields(model))
        out += _section(f"`{path}`", model, fields, path)
        queue = [*_parts(fields, path), *queue]
    return "\n".join(out).rstrip() + "\n"


def undocumented() -> list[str]:
    """Return the keys whose fields lack a description or an example."""
    missing, done = [], set()
    queue: list[type[BaseModel]] = [Job, Composition]
    while queue:
        model = queue.pop()
        done.add(model)
        for key, field in file_fields(model):
            if not field.description or not field.examples:
                missing.append(f"{model.__name__}.{key}")
            queue += [inner for inner in models_in(field.annotation) if inner not in done]
    return missing


def _parts(fields: list[tuple[str, FieldInfo]], path: str) -> Iterator[tuple[str, type[BaseModel]]]:
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
    title: str, model: type[BaseModel] | None, fields: list[tuple[str, FieldInfo]], path: str
) -> list[str]:
    out = [f"## {title}", ""]
    if model is not None:
        out += [_wrapped(summary(model).replace("``", "`")), ""]
    for key, field in fields:
        out += _entry(key, field)
    return out


def _entry(key: str, field: FieldInfo) -> list[str]:
    out = [f"### `{key}`", ""]
    description = (field.description or "").strip()
    out += [_wrapped(description), ""]
    facts = [_words(field_schema(field), field)]
    default = file_default(field)
    if field.is_required():
        facts.append("required")
    elif default is not None and default not in ({}, []):
        facts.append(f"default `{flow(default)}`")
    out += [f"*{'; '.join(facts)}*", ""]
    if field.examples:
        out += ["```yaml", *(_example(key, value) for value in field.examples), "```", ""]
    return out


def _wrapped(text: str) -> str:
    return textwrap.fill(text, 100, break_long_words=False, break_on_hyphens=False)


def _words(schema: dict[str, Any], field: FieldInfo | None = None) -> str:
    """Say what a schema accepts, in a few words."""
    if field is not None and attached(field, "schema") is TIME_SCHEMA:
        return "time"
    if schema == TIME_SCHEMA:
        return "time"
    words = schema.get("x-words")
    if isinstance(words, str):
        return words
    if "$ref" in schema:
        return "mapping, see below"
    if "anyOf" in schema:
        options = list(schema["anyOf"])
        if all(time in options for time in TIME_SCHEMA["anyOf"]):  # type: ignore[attr-defined]
            options = [o for o in options if o not in TIME_SCHEMA["anyOf"]]  # type: ignore[operator]
            options.append(TIME_SCHEMA)
        return " or ".join(dict.fromkeys(_words(option) for option in options))
    if "enum" in schema:
        return " or ".join(f"`{flow(choice)}`" for choice in schema["enum"])
    kind = schema.get("type")
    if kind == "array":
        items = schema.get("items") or {}
        return "list of mappings, see below" if "$ref" in items else f"list of {_words(items)}"
    if kind == "object":
        inner = schema.get("additionalProperties")
        is_part = isinstance(inner, dict) and "$ref" in str(inner) and "Parameter" not in str(inner)
        return "mapping of names, see below" if is_part else "mapping"
    if kind in ("integer", "number"):
        least, most = schema.get("minimum"), schema.get("maximum")
        word = "integer" if kind == "integer" else "number"
        open_below = schema.get("exclusiveMinimum")
        if open_below is not None:
            word += f", more than {open_below}"
        if least is not None:
            word += f", at least {least}"
        if most is not None and most < 2**63 - 1:
            word += f", at most {most}"
        return word
    return {"string": "text", "boolean": "true or false"}.get(str(kind), "any value")


def _example(key: str, value: Any) -> str:
    return f"{key}: {flow(value)}"


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
