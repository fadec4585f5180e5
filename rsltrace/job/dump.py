"""A job as plain values again: as YAML for people and for the trace, or complete as JSON values."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from io import StringIO
from typing import Any

from rsltrace.job.fields import JobFields
from rsltrace.job.parts.guard import resolved_guard
from rsltrace.job.parts.node import NodeSpec
from rsltrace.job.parts.part import JobPart
from rsltrace.job.values.checks import target_text
from rsltrace.job.values.times import format_time


def job_yaml(job: JobFields) -> str:
    """Return a job file with every key that differs from its default."""
    from ruamel.yaml import YAML

    yaml = YAML()
    yaml.width = 2**20  # Folding long text would make it hard to read and to search.
    yaml.indent(mapping=2, sequence=4, offset=2)
    stream = StringIO()
    yaml.dump(_quoted(plain_part(job)), stream)
    return stream.getvalue()


def _quoted(value: Any) -> Any:
    """Ask for quotes around text with invisible characters; ruamel would change some of them."""
    from ruamel.yaml.scalarstring import DoubleQuotedScalarString

    if isinstance(value, dict):
        return {_quoted(key): _quoted(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_quoted(item) for item in value]
    if isinstance(value, str):
        value = value.replace("$(", "\\$(")  # it is to stay as it is, not to be replaced
        return value if value.isprintable() else DoubleQuotedScalarString(value)
    return value


def job_resolved(job: JobFields) -> dict[str, Any]:
    """Return the complete job as JSON-compatible values, the same on every machine."""
    values = _complete(job)
    values["search_path"] = [_relative(job, path) for path in job.search_path]
    for node, spec in zip(values["nodes"], job.nodes, strict=True):
        node["parameter_files"] = [_relative(job, path) for path in spec.parameter_files]
    for launch, launch_spec in zip(values["launch"], job.launch, strict=True):
        launch["file"] = _relative(job, launch_spec.file)
    for bag, bag_spec in zip(values["bags"], job.bags, strict=True):
        bag["path"] = _relative(job, bag_spec.path)
    values["guard"] = resolved_guard(job.guard)
    for node, spec in zip(values["nodes"], job.nodes, strict=True):
        if spec.guard is not None:
            node["guard"] = resolved_guard(job.guard, spec.guard)
    return values


def _relative(job: JobFields, path: str) -> str:
    return os.path.relpath(job.resolve(path), job.base_dir).replace(os.sep, "/")


def plain_part(part: JobPart) -> dict[str, Any]:
    """Return a part of a job as a job file has it: every key that differs from its default."""
    values: dict[str, Any] = {}
    for name, field in type(part).fields.items():
        value = getattr(part, name)
        if field.exclude or value == field.get_default():
            continue
        key = field.alias or name
        values[key] = _times(value) if part.counts_ns(name) else plain_value(value, plain_part)
    return values


def _times(value: Any) -> Any:
    """Return nanoseconds, or tuples of them, as a job file says them."""
    if isinstance(value, tuple):
        return [_times(item) for item in value]
    return f"-{format_time(-value)}" if value < 0 else format_time(value)


def _complete(part: JobPart) -> dict[str, Any]:
    values: dict[str, Any] = {}
    absent = part.absent if isinstance(part, NodeSpec) else ()
    for name, field in type(part).fields.items():
        if not field.exclude and name not in absent:
            values[name] = _json(plain_value(getattr(part, name), _complete))
    return values


def plain_value(value: Any, part_values: Callable[[JobPart], Any]) -> Any:
    """Return a value of a job as JSON has it, parts in it as ``part_values`` says."""
    if isinstance(value, JobPart):
        return part_values(value)
    if isinstance(value, dict):
        return {str(key): plain_value(item, part_values) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_value(item, part_values) for item in value]
    # Subclasses (numpy's float64, an enum of integers) are written as what they are.
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    if value is None:
        return None
    return target_text(value)


def _json(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _json(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_json(item) for item in value]
    # JSON has no such numbers; YAML's spelling is kept as text.
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    return value
