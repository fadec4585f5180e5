"""From a job file to a ``Job``: every mistake becomes an error with file, line and column."""

from __future__ import annotations

import codecs
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from rsltrace.errors import JobError, nearest
from rsltrace.job.job import Job
from rsltrace.job.parts.keys import file_fields, keys_with, models_in
from rsltrace.job.parts.part import JobPart
from rsltrace.job.reading.compose import CompositionKeys, compose
from rsltrace.job.reading.yaml_source import (
    SourcePlace,
    TextPosition,
    YamlSource,
    YamlValue,
    parse_yaml,
)
from rsltrace.job.values.mappings import TextWithFolder
from rsltrace.job.values.problem import JobProblem, Loc, format_loc, unknown_key
from rsltrace.job.values.times import Nanoseconds
from rsltrace.trace.model.regular_file import read_regular

# The values of job files as a tree in which every value knows the file and line it came from.
#
# A job may be put together from several files and from the command line; whatever is found wrong
# with the result must be shown where it was written.


def item_at(root: YamlValue, loc: Loc) -> tuple[YamlValue, int]:
    """Return the item at ``loc`` or the nearest one around it, and how many steps it is away."""
    item = root
    for depth, part in enumerate(loc):
        inner = _child(item, part)
        if inner is None:
            return item, len(loc) - depth
        item = inner
    return item, 0


def place_at(root: YamlValue, loc: Loc, *, at_key: bool = False) -> SourcePlace:
    """Return where the value (or the key) at ``loc`` stands, or the nearest value around it."""
    item, missing = item_at(root, loc)
    if at_key and not missing and item.key_place is not None:
        return item.key_place
    return item.place


def plain(item: YamlValue, base_dir: str) -> object:
    """Return the values alone; text from other folders than ``base_dir`` remembers its own."""
    value = item.value
    if isinstance(value, dict):
        return {key: plain(inner, base_dir) for key, inner in value.items()}
    if isinstance(value, list):
        return [plain(inner, base_dir) for inner in value]
    if isinstance(value, str):
        folder = item.place.source.folder
        if folder is not None and folder != base_dir:
            return TextWithFolder(value, os.path.relpath(folder, base_dir))
    return value


def _child(item: YamlValue, part: str | int) -> YamlValue | None:
    value = item.value
    if isinstance(value, list):
        found = value[part : part + 1] if isinstance(part, int) and part >= 0 else []
    elif isinstance(value, dict):
        found = [inner for key, inner in value.items() if key == part or str(key) == part]
    else:
        found = []
    return found[0] if found else None


Overrides = Sequence["str | tuple[str, str]"]

FREE_PREFIX = "x-"
"""Keys of a job that begin so mean nothing: a place for YAML anchors, as in other formats."""

SIZE_MAX = 1 << 20
LINE_MAX = 256 << 10
"""Bytes of a file, and of one line: parsing takes 6 µs for each, and longer in very long lines."""
"""A job file of more bytes is something else."""


def load_job(
    path: str | os.PathLike[str],
    *,
    overrides: Overrides = (),
    given_in: str | os.PathLike[str] = "",
) -> Job:
    """Return the job in the YAML file ``path``; relative paths in it start at its folder, those of
    ``overrides`` at ``given_in`` (default: the working directory).

    ``overrides`` are ``key=value`` texts as of ``--set``, or pairs of what messages call one and
    the text. Imports neither rclpy nor user code.
    Raises ``JobError`` with ``file:line:column``, the line itself and what is expected; several
    mistakes are reported together, in the order of the file.
    """
    name = os.fspath(path)
    return _load(name, os.path.dirname(os.path.abspath(name)), _parse, overrides, (), given_in)


def job_from_text(
    text: str,
    name: str,
    folder: str | os.PathLike[str],
    *,
    overrides: Overrides = (),
    only: Collection[str] = (),
    given_in: str | os.PathLike[str] = "",
) -> Job:
    """Do ``load_job`` with the text of a job, not a file; its paths start at ``folder``, those
    of ``overrides`` at ``given_in``.

    With ``only``, other keys than these are passed over: what they name need not be here.
    """
    base_dir = os.path.abspath(folder)

    def read(other: str) -> YamlSource:
        return parse_yaml(text, name, folder=base_dir) if other == name else _parse(other)

    return _load(name, base_dir, read, overrides, only, given_in)


def _load(
    name: str,
    base_dir: str,
    read: Callable[[str], YamlSource],
    overrides: Overrides,
    only: Collection[str] = (),
    given_in: str | os.PathLike[str] = "",
) -> Job:
    labelled = [("--set", text) if isinstance(text, str) else text for text in overrides]
    composed = compose(name, read, labelled, os.path.abspath(given_in))
    given = plain(composed.root, base_dir)
    assert isinstance(given, dict)

    job_keys = [key for key, _ in file_fields(Job)]
    composing = {key for key, _ in file_fields(CompositionKeys)}
    problems: list[JobProblem] = []
    keys = {key: given[key] for key in given if key in composing}
    CompositionKeys.made(keys, problems, in_file=True)
    values: dict[str, object] = {}
    for key, value in given.items():
        if only and key not in only:
            continue
        if key in job_keys:
            values[key] = value
        elif key not in composing and not str(key).startswith(FREE_PREFIX):
            below = keys_with(Job, str(key))
            problems.append(unknown_key(key, [*job_keys, *sorted(composing)], (), below=below))
    values["base_dir"] = base_dir
    values["source_name"] = name
    if composed.is_plain:
        values["source_text"] = composed.source.text
    else:
        values["composed"] = composed
    job = Job.made(values, problems, in_file=True)
    if job is None or problems:
        raise _job_error(composed.root, problems)
    return job


def _parse(name: str) -> YamlSource:
    folder = os.path.dirname(os.path.abspath(name))
    return parse_yaml(_read(Path(name)), name, folder=folder)


def _not_there(path: Path) -> str:
    """Say that a file is missing, and which one of its folder was probably meant."""
    is_trace = path.suffix == ".mcap"  # for a command that takes traces and jobs
    kind = "trace" if is_trace else "job file"
    suffixes = (".mcap",) if is_trace else (".yaml", ".yml", ".json")
    files = {}
    with suppress(OSError):
        files = {f.stem: f.name for f in sorted(path.parent.iterdir()) if f.suffix in suffixes}
    near = nearest(path.stem, files)
    meant = f"; did you mean {str(path.with_name(files[near]))!r}?" if near else ""
    return f"there is no such {kind}{meant}"


def _read(path: Path) -> str:
    name = str(path)
    try:
        data = read_regular(path, SIZE_MAX + 1)
    except FileNotFoundError:
        raise JobError(_not_there(path), where=name) from None
    except IsADirectoryError:
        inside = path / "job.yaml"
        advice = f"name the job file in it: {inside}" if inside.is_file() else "name a job file"
        raise JobError(f"this is a folder; {advice}", where=name) from None
    except OSError as error:
        raise JobError(f"cannot read the job file: {error.strerror}", where=name) from None
    if name.endswith(".py"):
        raise JobError(
            f"this is Python, not a job file; `rsltrace init --from {name}` writes one", where=name
        )
    if data.startswith(b"\x89MCAP"):
        raise JobError(
            "this is a recording, not a job file (rsltrace info, view and diff read traces)",
            where=name,
        )
    if len(data) > SIZE_MAX:
        raise JobError(f"larger than {SIZE_MAX >> 20} MiB: this is not a job file", where=name)
    for number, line in enumerate(data.splitlines(), 1):
        if len(line) > LINE_MAX:
            raise JobError(
                f"a line of more than {LINE_MAX >> 10} KiB: this is not a job file",
                where=f"{name}:{number}",
            )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise JobError("this is UTF-16; save the file as UTF-8 text", where=name) from None
        good = data[: error.start].decode("utf-8-sig", "replace")
        mark = TextPosition(good.count("\n") + 1, len(good) - good.rfind("\n"))
        raise YamlSource(name, data.decode("utf-8-sig", "replace")).error(
            f"not UTF-8: byte 0x{data[error.start]:02x}; save the file as UTF-8 text", mark
        ) from None


def _job_error(root: YamlValue, problems: list[JobProblem]) -> JobError:
    """Return one error that tells all problems: the first file's first, each in its order."""
    found = [(place_at(root, p.loc, at_key=p.at_key), p.message) for p in problems]
    names = list(
        dict.fromkeys([root.place.source.name, *(place.source.name for place, _ in found)])
    )

    def order(entry: tuple[SourcePlace, str]) -> tuple[int, int, int]:
        place = entry[0]
        return names.index(place.source.name), place.mark.line, place.mark.column

    texts: list[str] = []
    for place, message in sorted(found, key=order):
        source = place.source
        head = f"{source.where(place.mark)}: " if texts else ""
        texts.append(f"{head}{message}{source.excerpt(place.mark)}")
    first = min(found, key=order)[0]
    return JobError("\n".join(texts), where=first.source.where(first.mark))


def locate(job: Job, loc: tuple[str | int, ...]) -> str:
    """Return where in its file a part of a job stands: ``job.yaml:3:11``.

    For mistakes that show only when the run begins. A job built in Python has no lines; its parts
    are named instead: ``<python>: nodes[0].node``.
    """
    place = _place(job, loc)
    if place is None:
        return f"{job.source_name}: {format_loc(loc)}"
    return place.source.where(place.mark)


def message_at(job: Job, loc: tuple[str | int, ...], message: str) -> str:
    """Return a message on the part at ``loc``, between where that stands and its line."""
    place = _place(job, loc)
    line = "" if place is None else place.source.excerpt(place.mark)
    return f"{locate(job, loc)}: {message}{line}"


@contextmanager
def showing_line(job: Job, loc: tuple[str | int, ...]) -> Iterator[None]:
    """Add the line of the job to a ``JobError`` that is raised about the part at ``loc``."""
    try:
        yield
    except JobError as error:
        place = _place(job, loc)
        if place is None or error.where != place.source.where(place.mark):
            raise
        message = str(error).removeprefix(f"{error.where}: ")
        raise place.error(message) from error.__cause__


def _place(job: Job, loc: tuple[str | int, ...]) -> SourcePlace | None:
    if job.composed is not None:
        return place_at(job.composed.root, loc)
    if job.given_text is None:
        return None
    return place_at(_root_of(job.given_text, job.source_name), loc)


@lru_cache(maxsize=1)
def _root_of(text: str, name: str) -> YamlValue:
    """Return the values of a job's text; every entry of a job asks for its place in it."""
    root = parse_yaml(text, name).root
    assert root is not None, "the text has been a job"
    return root


# A job from its resolved form, as a trace keeps it: nothing is looked up, nothing is read.
#
# Substitutions, bases, overrides and launch files have become values there, so the job is the one
# that ran, whatever has become of the files that it was made of.

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
