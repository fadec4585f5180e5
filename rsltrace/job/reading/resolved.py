"""A job from its resolved form, as a trace keeps it: nothing is looked up, nothing is read.

Substitutions, bases, overrides and launch files have become values there, so the job is the one
that ran, whatever has become of the files that it was made of.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rsltrace.job.job import Job
from rsltrace.job.parts.keys import models_in
from rsltrace.job.parts.part import JobPart
from rsltrace.job.values.times import Nanoseconds

_NOT_FINITE = {".nan": float("nan"), ".inf": float("inf"), "-.inf": float("-inf")}
_STATES = {"false": False, "true": True}


def job_from_resolved(
    resolved: Mapping[str, Any], *, name: str, text: str, folder: str | os.PathLike[str]
) -> Job:
    """Return the job of ``Job.resolved()``; its paths start at ``folder``.

    ``name`` and ``text`` are those of the job file, so that errors show its lines.

    :raises JobError: if it is no job of this version.
    """
    values = {key: value for key, value in resolved.items() if key in Job.fields}
    unknown = {key: value for key, value in resolved.items() if key not in values}
    guard = _guard(values.get("guard"))
    nodes = [
        {**node, "guard": _of_node(node["guard"], guard)} if _has_guard(node) else node
        for node in values.get("nodes") or ()
    ]
    given = _given(Job, {**values, "guard": guard, "nodes": nodes})
    assert isinstance(given, dict)
    if text:
        given["source_text"] = text
    return Job(**given, **unknown, base_dir=Path(folder), source_name=name or "<python>")


def _given(part: type[JobPart], value: Any) -> Any:
    """Return a part's values by the keys of its constructor, times marked as nanoseconds."""
    if not isinstance(value, dict):
        return value
    found: dict[str, Any] = {}
    for name, inner in value.items():
        field = part.fields.get(name)
        if field is None or inner is None:
            if inner is not None:
                found[name] = inner  # unknown here: the models say so
            continue
        key = field.alias or name
        models = [model for model in models_in(field.annotation) if issubclass(model, JobPart)]
        if part.counts_ns(name):
            found[key] = _counted(inner)
        elif models and models[0] is not JobPart:
            found[key] = _parts(models, inner)
        else:
            found[key] = _finite_or_not(inner)
    return found


def _parts(models: list[type[JobPart]], value: Any) -> Any:
    """Return parts wherever they are in a value: itself, in a list, or in a mapping of names."""
    if isinstance(value, list):
        return [_parts(models, item) for item in value]
    if not isinstance(value, dict):
        return value
    for model in models:
        if set(value) <= set(model.fields):
            return _given(model, value)
    return {key: _parts(models, item) for key, item in value.items()}


def _counted(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_counted(item) for item in value)
    return Nanoseconds(value) if type(value) is int else value


def _finite_or_not(value: Any) -> Any:
    """Return what JSON has no numbers for."""
    if isinstance(value, dict):
        return {key: _finite_or_not(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite_or_not(item) for item in value]
    return _NOT_FINITE.get(value, value) if isinstance(value, str) else value


def _has_guard(node: Any) -> bool:
    return isinstance(node, dict) and isinstance(node.get("guard"), dict)


def _guard(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    state = value.get("state")
    return {**value, "state": _STATES.get(state, state) if isinstance(state, str) else state}


def _of_node(value: dict[str, Any], of_job: Any) -> dict[str, Any]:
    """Return a node's own guard: what is resolved has the job's in it."""
    own = dict(_guard(value))
    own.pop("pin", None)
    for source, spec in own.items():
        outer = of_job.get(source) if isinstance(of_job, dict) else None
        if isinstance(spec, dict) and isinstance(outer, dict):
            allowed = outer.get("allow") or []
            own[source] = {**spec, "allow": (spec.get("allow") or [])[len(allowed) :]}
    return own
