"""``--set nodes.ekf.parameters.rate=20.0``: every key of a job from the command line.

An override is YAML with its path written in front, so its mistakes are shown in its own text.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from rsltrace.errors import did_you_mean
from rsltrace.fast_dataclass import dataclass
from rsltrace.job.job import Job
from rsltrace.job.parts.keys import is_list_at, shorthand_at, without_alternatives
from rsltrace.job.reading.yaml_source import (
    SourcePlace,
    TextPosition,
    YamlSource,
    YamlValue,
    parse_yaml,
)
from rsltrace.job.values.checks import is_plain
from rsltrace.job.values.problem import Loc, describe

_STEP = re.compile(r'"([^"]*)"|\'([^\']*)\'|([^.=\'"\[\]]+)|\[([0-9]+|\+)\]')
_APPEND = "+"


@dataclass(frozen=True)
class _PathStep:
    """One part of a path, where it stands, and how it was written."""

    text: str
    place: SourcePlace
    quoted: bool


def apply_override(root: YamlValue, label: str, override: str, *, folder: str) -> YamlValue:
    """Return the job with ``override`` (``path=value``) applied; ``label`` names it in messages.

    The value is YAML; null takes the key away. List entries are given by index, by
    a node's name, or as ``+`` for a new one at the end. Paths start at ``folder``.
    """
    shown = YamlSource(label, override, folder, is_option=True)
    steps, at = _steps(shown)
    if steps[0].text in ("base", "include"):
        raise steps[0].place.error(
            f"{steps[0].text}: is read before the command line is: write it in the job file"
        )
    if not override[at:].strip():
        # A shell variable without a value must not take a stop condition away.
        raise shown.error(
            "there is no value after '=': null takes the key away", TextPosition(1, at)
        )
    source = parse_yaml(override[at:], label, folder=folder, option=override)
    value = source.root or YamlValue(None, steps[-1].place)
    if value.value is None:
        value = YamlValue(None, steps[-1].place)
    return _set(root, steps, value, ())


def as_overlay(overrides: Iterable[tuple[str, str]]) -> tuple[dict[str, Any], list[str]]:
    """Return overrides as what a job file says that extends the job, and those (``--set k=v``) that
    it cannot say: they change an entry of a list, or put a mapping in place of another one."""
    said: dict[str, Any] = {}
    left = []
    for label, override in overrides:
        steps, at = _steps(YamlSource(label, override, is_option=True))
        *outer, last = (step.text for step in steps)
        value = parse_yaml(override[at:], label, option=override).value
        in_list = any(is_list_at(Job, tuple(outer[:count])) for count in range(1, len(outer) + 1))
        inner: Any = said
        for key in () if in_list or isinstance(value, dict) else outer:
            inner = inner.setdefault(key, {}) if isinstance(inner, dict) else None
        if in_list or isinstance(value, dict) or not isinstance(inner, dict):
            left.append(f"{label} {override}")
        else:
            inner[last] = value
    return said, left


def _steps(source: YamlSource) -> tuple[list[_PathStep], int]:
    """Return the path of an override, and where its value begins."""
    text, at = source.text, 0
    steps: list[_PathStep] = []
    while True:
        match = _STEP.match(text, at)
        if match is None:
            break
        quoted = match.group(1) is not None or match.group(2) is not None
        name = next(group for group in match.groups() if group is not None)
        steps.append(_PathStep(name.strip() if not quoted else name, _place(source, at), quoted))
        at = match.end()
        if text[at : at + 1] == ".":
            at += 1
        elif text[at : at + 1] != "[":
            break
    if not steps or text[at : at + 1] != "=" or text[at - 1 : at] == ".":
        example = "--set stop.duration=10s, --set nodes.0.parameters.rate=20.0"
        raise source.error(f"expected key=value, as in {example}", TextPosition(1, at + 1))
    return steps, at + 1


def _place(source: YamlSource, at: int) -> SourcePlace:
    return SourcePlace(source, TextPosition(1, at + 1))


def _set(item: YamlValue | None, steps: list[_PathStep], value: YamlValue, loc: Loc) -> YamlValue:
    """Return ``item`` with the value at the end of the path replaced."""
    if not steps:
        return value
    step = steps[0]
    if item is None or item.value is None:
        starts_list = not step.quoted and step.text == _APPEND
        if not step.quoted and step.text.isdecimal() and is_list_at(Job, loc):
            name = ".".join(map(str, loc))
            raise step.place.error(f"{name} has no entries yet: write {name}.+ for a new one")
        item = YamlValue([] if starts_list else {}, step.place, step.place)
    inner: Any = item.value
    if is_plain(inner) and (key := shorthand_at(Job, loc)) is not None:
        inner = {key: replace(item, key_place=item.place)}
    if isinstance(inner, list):
        return replace(item, value=_set_in_list(inner, steps, value, loc))
    if not isinstance(inner, dict):
        raise step.place.error(
            f"{'.'.join(map(str, loc))} is {describe(inner)}: there is nothing below it to set"
        )
    name, used = _key(inner, steps)
    values = without_alternatives(inner, (name,), Job, loc)
    new = _set(values.get(name), steps[used:], value, (*loc, name))
    if new.value is None and used == len(steps):
        if name not in values:
            raise step.place.error(
                f"no value is given, and {'.'.join(map(str, (*loc, name)))} has none to take away"
            )
        del values[name]
    else:
        values[name] = replace(new, key_place=step.place)
    return replace(item, value=values)


def _key(values: dict[Any, YamlValue], steps: list[_PathStep]) -> tuple[str, int]:
    """Return the key that a path goes on with: parameters may have dots in their names."""
    for used in range(len(steps), 1, -1):
        name = ".".join(step.text for step in steps[:used])
        if name in values:
            return name, used
    return steps[0].text, 1


def _set_in_list(
    items: list[YamlValue], steps: list[_PathStep], value: YamlValue, loc: Loc
) -> list[YamlValue]:
    step, name = steps[0], ".".join(map(str, loc))
    if step.text == _APPEND and not step.quoted:
        return [*items, _set(None, steps[1:], value, (*loc, len(items)))]
    index = _index(items, step, name)
    new = _set(items[index], steps[1:], value, (*loc, index))
    if new.value is None and len(steps) == 1:
        return items[:index] + items[index + 1 :]
    return [*items[:index], new, *items[index + 1 :]]


def _index(items: list[YamlValue], step: _PathStep, name: str) -> int:
    if step.text.isdecimal() and not step.quoted:
        if int(step.text) < len(items):
            return int(step.text)
        there = f"it has 0 to {len(items) - 1}" if items else "it is empty"
        raise step.place.error(f"{name} has no entry {step.text}: {there}, and + is a new one")
    named = [(key, i) for i, item in enumerate(items) for key in _names(item)]
    found = {i for key, i in named if key == step.text}
    found = found or {i for key, i in named if _as_one_word(key) == _as_one_word(step.text)}
    if len(found) == 1:
        return found.pop()
    if found:
        numbers = ", ".join(map(str, sorted(found)))
        raise step.place.error(
            f"{step.text!r} is more than one of {name}: give a number, {numbers}"
        )
    names = [key for key, _ in named]
    or_name = f", or one of {', '.join(dict.fromkeys(names))}" if names else ""
    hint = did_you_mean(step.text, names, f"give a number, counted from 0{or_name}")
    raise step.place.error(f"{name} has no entry {step.text!r}: {hint}")


def _names(item: YamlValue) -> list[str]:
    """Return what an entry may be called: its name, else its class, its program or the end of its
    path.
    """
    if isinstance(item.value, str):
        return [item.value.rstrip("/").rpartition("/")[2]]
    if not isinstance(item.value, dict):
        return []
    for key, separator in _NAMED_BY:
        inner = item.value.get(key)
        if inner is not None and isinstance(inner.value, str):
            text = inner.value.rstrip("/")
            return [text.rpartition(separator)[2].removesuffix(".py") if separator else text]
    return []


_NAMED_BY = (
    *(("name", ""), ("node", ":"), ("path", "/"), ("script", "/"), ("program", "/")),
    *(("executable", "/"), ("main", ":"), ("module", ".")),
)


def _as_one_word(name: str) -> str:
    """Return what a class and its node have in common: TrackMonitor is called track_monitor."""
    return name.replace("_", "").lower()
