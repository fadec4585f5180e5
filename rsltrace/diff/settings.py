"""What differs outside of the events: the job, the environment, the entities of the graph.

None of it is a divergence by itself, and any of it may be why there is one.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator
from typing import Any

from rsltrace.diff.identity import Identity
from rsltrace.diff.model import Setting
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.reader import Trace

_NOTHING = ("null", "[]", "{}")
_ENTITIES_MAX = 50
_EFFECTIVE = "# The effective job "
_LINES_MAX = 20_000
"""Longer job files are compared as a whole: difflib takes time with the square of the lines."""


def job_settings(a: Trace, b: Trace) -> tuple[Setting, ...]:
    """Return the lines of the job files that differ, and what differs in the jobs as resolved."""
    found = list(_job_lines(a, b))
    resolved_a, resolved_b = _resolved(a), _resolved(b)
    # A job file says what was written, the resolved job what was meant: an override on the command
    # line (--seed) is only there. What the lines show already is not said twice.
    shown = " ".join(f"{setting.a} {setting.b}" for setting in found)
    for path, value_a, value_b in _differences("", resolved_a, resolved_b):
        key = path.rpartition(".")[2].partition("[")[0].removesuffix("_ns")
        if (value_a is None or value_b is None) and not _names_of_users(path):
            # A key that only one version of rsltrace knows is no difference unless it was given.
            value, text = (value_b, b.job_text) if value_a is None else (value_a, a.job_text)
            if value in _NOTHING or (text and key not in text):
                continue
        if key not in shown:
            found.append(Setting(f"job: {path}", value_a, value_b))
    return tuple(found)


def _names_of_users(path: str) -> bool:
    """Whether a key of the job is a name that its author chose, not one that rsltrace knows."""
    parents = path.split(".")[:-1]
    return any(parent in ("arguments", "parameters", "remappings") for parent in parents)


def environment_settings(a: Trace, b: Trace) -> tuple[Setting, ...]:
    """Return the modules of the nodes whose code differs, and the versions that differ."""
    found = []
    for label, record in (("code of module", METADATA_SOURCES), ("environment:", None)):
        of_a = a.environment if record is None else a.metadata(record)
        of_b = b.environment if record is None else b.metadata(record)
        for name in sorted({*of_a, *of_b}):
            if of_a.get(name) != of_b.get(name):
                place = name.replace("file:", "file ") if name[:5] == "file:" else f"{label} {name}"
                found.append(Setting(place, of_a.get(name), of_b.get(name)))
    return tuple(found)


def entity_settings(identity: Identity) -> tuple[Setting, ...]:
    """Return the entities that only one run has; of many, the first ones and how many more."""
    found = [Setting("entity", str(identity.keys[n]), None) for n in identity.only_a]
    found += [Setting("entity", None, str(identity.keys[n])) for n in identity.only_b]
    if len(found) > _ENTITIES_MAX:
        more = found[_ENTITIES_MAX:]
        only_a = sum(setting.b is None for setting in more)
        rest = (f"{n} more" if n else None for n in (only_a, len(more) - only_a))
        found[_ENTITIES_MAX:] = [Setting("entity", *rest)]
    return tuple(found)


def _job_lines(a: Trace, b: Trace) -> Iterator[Setting]:
    if a.job_text == b.job_text:
        return
    name = a.job.get("name") or b.job.get("name") or "job.yaml"
    if a.job_text.startswith(_EFFECTIVE) or b.job_text.startswith(_EFFECTIVE):
        name = f"effective {name}"  # put together from several files: no line of one of them
    (numbers_a, lines_a), (numbers_b, lines_b) = _lines(a), _lines(b)
    if max(len(lines_a), len(lines_b)) > _LINES_MAX:
        yield Setting(name, f"{len(lines_a)} lines", f"{len(lines_b)} lines")
        return
    matcher = difflib.SequenceMatcher(None, lines_a, lines_b, autojunk=False)
    for tag, begin_a, end_a, begin_b, end_b in matcher.get_opcodes():
        if tag == "equal":
            continue
        for nth in range(max(end_a - begin_a, end_b - begin_b)):
            line_a = lines_a[begin_a + nth] if begin_a + nth < end_a else None
            line_b = lines_b[begin_b + nth] if begin_b + nth < end_b else None
            number = numbers_b[begin_b + nth] if line_a is None else numbers_a[begin_a + nth]
            yield Setting(f"{name}:{number}", line_a, line_b)


def _lines(trace: Trace) -> tuple[list[int], list[str]]:
    """Return numbers and text of the lines of a job that are more than space and a comment."""
    numbered = enumerate(trace.job_text.splitlines(), 1)
    lines = [(n, line) for n, line in numbered if line.strip() and line.lstrip()[0] != "#"]
    return [n for n, _ in lines], [line for _, line in lines]


def _resolved(trace: Trace) -> Any:
    try:
        return json.loads(trace.job.get("resolved") or "{}")
    except ValueError:  # of a later version, or damaged: the job file itself was compared
        return {}


def _differences(path: str, a: Any, b: Any) -> Iterator[tuple[str, str | None, str | None]]:
    """Yield (path, value in a, value in b) for the leaves that differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in sorted({*a, *b}):
            inner = f"{path}.{key}" if path else str(key)
            if key not in a or key not in b:
                yield inner, _text(a, key), _text(b, key)
            else:
                yield from _differences(inner, a[key], b[key])
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for position, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from _differences(f"{path}[{position}]", x, y)
    elif a != b or type(a) is not type(b):
        yield path, json.dumps(a, ensure_ascii=False), json.dumps(b, ensure_ascii=False)


def _text(mapping: dict[str, Any], key: str) -> str | None:
    return json.dumps(mapping[key], ensure_ascii=False) if key in mapping else None
