"""What differs in the jobs of two runs, key by key, and in which line of the job file.

Compared is what was meant: the resolved jobs, in which every key has a value, so that another
layout of the file, another unit or an override on the command line show as what they
are. Keys are written as ``--set`` takes them. Traces without a resolved job (it is damaged, or
another program wrote the trace) are compared by the lines of the job files.
"""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from rsltrace.diff.causes.job_entries import TARGETS
from rsltrace.diff.causes.record_command import is_effective, is_of_file, job_file
from rsltrace.diff.causes.relevance import resolved_job
from rsltrace.diff.facts.evidence import Setting, SettingKind
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.operation import nested_too_deep
from rsltrace.trace.model.texts import contrasting, format_duration
from rsltrace.trace.reader import Trace

_LINES_MAX = 20_000
"""Longer job files are compared as a whole: difflib takes time with the square of the lines."""

_KEY_WEIGHT = 1000
_ENTRIES_MAX = 100
"""Longer lists are compared entry by entry, in order."""

_BYTES_MAX = 1 << 20
_NANOSECONDS = "_ns"
_PATHS = frozenset(("parameter_files", "path", "file", "script", "program"))
_NOTHING: tuple[object, ...] = (None, [], {})
_NO_VALUES = tuple((nothing,) for nothing in _NOTHING)

KeyPath = tuple["str | int", ...]


def job_settings(a: Trace, b: Trace) -> tuple[Setting, ...]:
    """Return what differs in the jobs, in the order of the job file; keys without a line last, and
    behind them what may be one file as seen from two folders."""
    resolved_a, resolved_b = resolved_job(a), resolved_job(b)
    if not resolved_a or not resolved_b:
        return tuple(_differing_lines(a, b))
    text_a, text_b = _JobText(a), _JobText(b)
    found = []
    for change in _changes((), (), resolved_a, resolved_b):
        if change.is_of_another_version(text_a.text, text_b.text):
            continue
        depth, line = text_a.place(change.path_a, change.a)
        of_b = text_b.place(change.path_b, change.b)
        name = text_a.name or text_b.name or "job.yaml"
        if of_b[0] > depth:
            (depth, line), name = of_b, text_b.name or name
        key = _shared_key(change, resolved_a, resolved_b)
        order = (change.may_be_one_file, line or _LINES_MAX)
        setting = Setting(SettingKind.JOB, name, *change.shown(), key, line if depth else 0)
        found.append((order, setting))
    return tuple(setting for _, setting in sorted(found, key=lambda item: item[0]))


@dataclass(frozen=True, slots=True)
class _Change:
    """A leaf that differs: where each side has it (or would), and the values, each in a tuple."""

    path_a: KeyPath
    path_b: KeyPath
    a: tuple[Any] | None
    b: tuple[Any] | None

    def is_of_another_version(self, text_a: str, text_b: str) -> bool:
        """Whether only one version of rsltrace knows the key, and it was not given."""
        if None not in (self.a, self.b) or _is_named_by_users(self.path_a):
            return False
        text = text_b if self.a is None else text_a
        unset = (self.a or self.b) in _NO_VALUES
        return unset or (bool(text) and _written(self.path_a[-1]) not in text)

    @property
    def may_be_one_file(self) -> bool:
        """Whether both are relative paths (``../config/p.yaml``, ``src/bot/config/p.yaml``) that
        lead to one file if the jobs lie in folders that fit."""
        if self.path_a[0] == "search_path":
            return True
        a, b = (leaf and leaf[0] for leaf in (self.a, self.b))
        if not (isinstance(a, str) and isinstance(b, str)) or _PATHS.isdisjoint(self.path_a):
            return False
        parts = [[part for part in text.split("/") if part not in ("..", ".")] for text in (a, b)]
        short, long = sorted(parts, key=len)
        return len(short) > 0 and long[-len(short) :] == short

    def shown(self) -> tuple[str | None, str | None]:
        """Return both values on a line each: times with a unit; parts without unset keys."""
        if (self.a and self.a[0]) is None and (self.b and self.b[0]) is None:
            return (None if self.a is None else "null"), (None if self.b is None else "null")
        text = partial(_text, key=self.path_a[-1])
        a, b = contrasting(self.a and self.a[0], self.b and self.b[0], text)
        if a == b and a is not None:
            a, b = (json.dumps(leaf[0]) for leaf in (self.a, self.b) if leaf is not None)
        return a, b


class _JobText:
    """The job file of a trace, to find the lines of its keys in."""

    def __init__(self, trace: Trace) -> None:
        self.text: str = trace.job_text
        self._trace = trace
        self._is_put_together = is_effective(trace)
        """From files and options: the lines of its text are of none."""

    @cached_property
    def name(self) -> str:
        """The file's path if it is below the working directory, else its name."""
        name = str(self._trace.job.get("name") or "")
        path, is_recorded = job_file(self._trace, name)
        is_below = is_recorded and not os.path.isabs(path) and ".." not in Path(path).parts
        return Path(path).as_posix() if is_below else name

    @cached_property
    def _root(self) -> Any:
        if not self.text or not is_of_file(self._trace):
            return None
        return _composed(self._file_here() if self._is_put_together else self.text)

    def _file_here(self) -> str:
        """Return the text of the job file as it is here now, "" if it is not."""
        path, _ = job_file(self._trace, self._trace.job["name"])
        try:
            with open(path, encoding="utf-8") as file:
                return file.read(_BYTES_MAX)
        except (OSError, ValueError):
            return ""

    def place(self, path: KeyPath, leaf: tuple[Any] | None) -> tuple[int, int]:
        """Return how much of a path the file has, and the line (from 1) where that is, or 0, 0.

        Where the leaf is not there, neither is the last step: what the file has at an entry's
        number is another entry. A file that is here has only what it gives the same value.
        """
        node: Any = self._root
        path = path if leaf is not None else path[:-1]
        line = 0
        for depth, step in enumerate(path):
            found = _child(node, step)
            if found is None and path[0] == "nodes" and depth < 2 and not self._is_put_together:
                found = _child(self._root, "launch")  # whose nodes come after those of the job
                return (1, found[0].start_mark.line + 1) if found else (depth, line)
            if found is None:
                return (0, 0) if self._is_put_together else (depth, line)
            place, node = found
            line = place.start_mark.line + 1
        if self._is_put_together and (leaf is None or not _says(node, leaf[0])):
            return 0, 0
        return len(path), line


def _says(node: Any, value: Any) -> bool:
    """Whether the text of a YAML node is a value's."""
    from ruamel.yaml.nodes import ScalarNode

    if not isinstance(node, ScalarNode):
        return False
    return bool(node.value == (value if isinstance(value, str) else json.dumps(value)))


def _composed(text: str) -> Any:
    """Return the YAML nodes of a job file, or None if it cannot be read."""
    if nested_too_deep(text) >= 0:
        return None
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        return YAML().compose(text)
    except (YAMLError, ValueError, RecursionError):
        return None


def _child(node: Any, step: str | int) -> tuple[Any, Any] | None:
    """Return the node that is the place of a key or an entry, and the node of its value."""
    from ruamel.yaml.nodes import MappingNode, SequenceNode

    if isinstance(step, int):
        if not isinstance(node, SequenceNode) or step >= len(node.value):
            return None
        return node.value[step], node.value[step]
    if not isinstance(node, MappingNode):
        return None
    return next(((k, v) for k, v in node.value if k.value == _written(step)), None)


def _written(step: str | int) -> str:
    return str(step).removesuffix(_NANOSECONDS)


def _key(path: KeyPath, value: Any) -> str:
    """Return a path as ``--set`` takes it: nodes by their names where they have one."""
    steps: list[str] = []
    for step in path:
        value = _inner(value, step)
        name = value.get("name") if isinstance(value, dict) and steps == ["nodes"] else None
        steps.append(name if isinstance(name, str) and name else _written(step))
    return ".".join(steps)


def _shared_key(change: _Change, job_a: Any, job_b: Any) -> str:
    """Return the key of a change; of a node that goes by another name in each run, by number."""
    if change.a is None or change.b is None:
        key = _key(change.path_b, job_b) if change.a is None else _key(change.path_a, job_a)
        return _numbered(change.path_a) if change.path_a[-1] == "name" else key
    keys = _key(change.path_a, job_a), _key(change.path_b, job_b)
    return keys[0] if keys[0] == keys[1] else _numbered(change.path_a)


def _numbered(path: KeyPath) -> str:
    return ".".join(_written(step) for step in path)


def _inner(value: Any, step: str | int) -> Any:
    return value.get(step) if isinstance(value, dict) else value[step]


def _is_named_by_users(path: KeyPath) -> bool:
    """Whether a key of the job is a name that its author chose, not one that rsltrace knows."""
    parents = ("arguments", "parameters", "remappings", "topics", "services")
    return isinstance(path[-1], int) or any(parent in parents for parent in path[:-1])


def _changes(path_a: KeyPath, path_b: KeyPath, a: Any, b: Any) -> Iterator[_Change]:
    """Yield the leaves that differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in sorted({*a, *b}):
            inner_a, inner_b = (*path_a, key), (*path_b, key)
            if key in a and key in b:
                yield from _changes(inner_a, inner_b, a[key], b[key])
            else:
                of_a, of_b = ((side[key],) if key in side else None for side in (a, b))
                yield _Change(inner_a, inner_b, of_a, of_b)
    elif isinstance(a, list) and isinstance(b, list) and _holds_parts(a, b):
        yield from _changed_entries(path_a, path_b, a, b)
    elif repr(a) != repr(b):  # 1 is not true, nor 0.0 -0.0; a NaN is no other one
        yield _Change(path_a, path_b, (a,), (b,))


def _holds_parts(a: list[Any], b: list[Any]) -> bool:
    """Whether lists are of parts with keys (or as long as each other), not just of values."""
    return len(a) == len(b) or all(isinstance(item, dict) for item in (*a, *b))


def _changed_entries(
    path_a: KeyPath, path_b: KeyPath, a: list[Any], b: list[Any]
) -> Iterator[_Change]:
    names_a, names_b = ([_entry_name(item) for item in side] for side in (a, b))
    if names_a != names_b and sorted(names_a) == sorted(names_b) == sorted({*names_a}):
        moved = [n for n, (x, y) in enumerate(zip(names_a, names_b, strict=True)) if x != y]
        orders = (", ".join(side[n] for n in moved) for side in (names_a, names_b))
        yield _Change(path_a, path_b, *((order,) for order in orders))
        for at_a, name in enumerate(names_a):
            at_b = names_b.index(name)
            yield from _changes((*path_a, at_a), (*path_b, at_b), a[at_a], b[at_b])
        return
    if len(a) == len(b):
        changes = [(0, len(a), 0, len(b))]
    else:
        text_a, text_b = ([json.dumps(item, sort_keys=True) for item in side] for side in (a, b))
        matcher = difflib.SequenceMatcher(None, text_a, text_b, autojunk=False)
        changes = [code[1:] for code in matcher.get_opcodes() if code[0] != "equal"]
    for begin_a, end_a, begin_b, end_b in changes:
        pairs = _most_alike(a[begin_a:end_a], b[begin_b:end_b])
        for at_a, at_b in pairs:
            at_a, at_b = begin_a + at_a, begin_b + at_b
            yield from _changes((*path_a, at_a), (*path_b, at_b), a[at_a], b[at_b])
        for at_a in sorted({*range(begin_a, end_a)} - {begin_a + at for at, _ in pairs}):
            yield _Change((*path_a, at_a), (*path_b, at_a), (a[at_a],), None)
        for at_b in sorted({*range(begin_b, end_b)} - {begin_b + at for _, at in pairs}):
            yield _Change((*path_a, at_b), (*path_b, at_b), None, (b[at_b],))


def _entry_name(entry: Any) -> str:
    """Return what tells an entry of a list from the others: its name, what it runs or reads."""
    if not isinstance(entry, dict):
        return json.dumps(entry)
    return next((str(entry[key]) for key in ("name", *TARGETS, "path") if entry.get(key)), "")


def _most_alike(a: list[Any], b: list[Any]) -> list[tuple[int, int]]:
    """Pair the entries of the shorter list with those of the longer one, in order: so that as much
    as possible of the pairs is the same, and the rest has been added or removed."""
    if len(a) > len(b):
        return [(at_a, at_b) for at_b, at_a in _most_alike(b, a)]
    if len(a) == len(b) or len(b) > _ENTRIES_MAX:
        return [(at, at) for at in range(len(a))]
    spare = len(b) - len(a)
    best: list[list[tuple[int, int]]] = [[(0, 0)] * (spare + 1)]
    """By entries of a paired and entries of b left out: what is alike, and the last gap."""
    for at, entry in enumerate(a):
        row: list[tuple[int, int]] = []
        for left_out in range(spare + 1):
            alike, gap = best[-1][left_out][0] + _alike(entry, b[at + left_out]), left_out
            if row and row[-1][0] >= alike:
                alike, gap = row[-1]
            row.append((alike, gap))
        best.append(row)
    pairs, gap = [], spare
    for at in range(len(a) - 1, -1, -1):
        gap = best[at + 1][gap][1]
        pairs.append((at, at + gap))
    return pairs[::-1]


def _alike(a: dict[str, Any], b: dict[str, Any]) -> int:
    """Return how much is the same in two entries: names and the like count more than
    what is within a key."""
    alike = 0
    for x, y in ((a[key], b[key]) for key in a.keys() & b.keys()):
        if isinstance(x, dict) and isinstance(y, dict):
            alike += sum(x[key] == y[key] for key in x.keys() & y.keys())
        elif x == y:
            alike += _KEY_WEIGHT
    return alike


def _text(value: Any, digits: int, key: str | int) -> str | None:
    if value is None:
        return None
    plain = _plain(value, key, digits)
    text = json.dumps(plain, ensure_ascii=False)
    return plain if isinstance(plain, str) and not _has_two_meanings(plain) else text


def _has_two_meanings(text: str) -> bool:
    """Whether a text without its quotes looks like a number, a list or nothing."""
    try:
        json.loads(text or "null")
    except ValueError:
        return text != text.strip() or not text.isprintable()
    return True


def _plain(value: Any, key: str | int, digits: int) -> Any:
    if isinstance(value, dict):
        kept = {name: item for name, item in value.items() if item not in _NOTHING}
        return {_written(name): _plain(item, name, digits) for name, item in kept.items()}
    if isinstance(value, list):
        return [_plain(item, key, digits) for item in value]
    return format_duration(value, digits) if _is_time(value, key) else value


def _is_time(value: Any, key: str | int) -> bool:
    return type(value) is int and str(key).endswith(_NANOSECONDS)


def _differing_lines(a: Trace, b: Trace) -> Iterator[Setting]:
    if a.job_text == b.job_text:
        return
    name = _JobText(a).name or _JobText(b).name or "job.yaml"
    if is_effective(a) or is_effective(b):
        name = f"effective {name}"  # put together from several files: no line of one of them
    (numbers_a, lines_a), (numbers_b, lines_b) = _lines(a), _lines(b)
    if max(len(lines_a), len(lines_b)) > _LINES_MAX:
        yield Setting(SettingKind.JOB, name, f"{len(lines_a)} lines", f"{len(lines_b)} lines")
        return
    matcher = difflib.SequenceMatcher(None, lines_a, lines_b, autojunk=False)
    for tag, begin_a, end_a, begin_b, end_b in matcher.get_opcodes():
        if tag == "equal":
            continue
        for nth in range(max(end_a - begin_a, end_b - begin_b)):
            line_a = lines_a[begin_a + nth] if begin_a + nth < end_a else None
            line_b = lines_b[begin_b + nth] if begin_b + nth < end_b else None
            number = numbers_b[begin_b + nth] if line_a is None else numbers_a[begin_a + nth]
            yield Setting(SettingKind.JOB, name, line_a, line_b, line=number)


def _lines(trace: Trace) -> tuple[list[int], list[str]]:
    """Return numbers and text of the lines of a job that are more than space and a comment."""
    numbered = enumerate(trace.job_text.splitlines(), 1)
    lines = [(n, line) for n, line in numbered if line.strip() and line.lstrip()[0] != "#"]
    return [n for n, _ in lines], [line for _, line in lines]
