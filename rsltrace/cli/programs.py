"""Programs on a command line, as ``ros2 run``, ``ros2 launch`` and ``python3`` start them."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from rsltrace.adapters.launch.specs import RosWords, launch_file
from rsltrace.job.values.mappings import split_ros_arguments

Entry = tuple[str, dict[str, Any]]
"""The key of a job (``nodes`` or ``launch``), and what is added to its list."""

_PYTEST = ("pytest", "py.test")
_RUN_PYTEST = {"main": "rsltrace.testing.plugin:run_pytest"}
"""Pytest as a main whose failure is that of the test; alone it ends with an exit status."""

_PYTHON = re.compile(r"python(3(\.\d+)?)?$")
_FORMS = (
    "write 'ros2 run PACKAGE EXECUTABLE', 'ros2 launch PACKAGE FILE', 'python3 FILE', or the path "
    "of a program"
)


def program_entries(programs: Sequence[Sequence[str]]) -> list[Entry]:
    """Return the entries of a job that runs commands. It ends with pytest, if that is one of them.

    :raises click.UsageError: they are no command that a job can run.
    :raises JobError: there is no such launch file or parameter file.
    """
    entries = [_entry(words) for words in programs]
    for _, values in entries if len(entries) > 1 else ():
        values.update({"required": True} if "main" in values else {})
    return entries


def _entry(words: Sequence[str]) -> Entry:
    if not words:
        raise click.UsageError(f"there is no program after '--': {_FORMS}")
    if words[:2] == ["ros2", "launch"]:
        return "launch", _launch(words[2:])
    target, rest = _target(words)
    own, ros = split_ros_arguments(rest)
    given = RosWords(ros, shlex.join(words))
    own += ["--ros-args", *given.others] if given.others else []
    return "nodes", {**target, **given.values(), **({"arguments": own} if own else {})}


def program_name(entry: Entry) -> str:
    """Return the name of an entry's program, for the files of its run."""
    (kind, target), *_ = entry[1].items()
    if kind == "main":
        words = filter(_is_python_file, entry[1].get("arguments", ()))
        target = next(words, _PYTEST[0]).partition("::")[0]
    name = str(target).rpartition("/")[2]
    return name if entry[0] == "launch" else name.removesuffix(".py")


def _launch(words: Sequence[str]) -> dict[str, Any]:
    options = [word for word in words if word.startswith("-")]
    if options:
        raise click.UsageError(f"ros2 launch {options[0]}: leave out the options of ros2 launch")
    files = [word for word in words if ":=" not in word]
    arguments = dict(word.split(":=", 1) for word in words if ":=" in word)
    if not files:
        raise click.UsageError("ros2 launch: name a launch file, or a package and its launch file")
    path, left = launch_file(Path(files[0]), files[1:])
    if left:
        raise click.UsageError(f"ros2 launch: give one launch file, not {path} and {left[0]}")
    return {"file": str(path), **({"arguments": arguments} if arguments else {})}


def _target(words: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Return what a command runs, as a key of an entry, and the words for it."""
    first, *rest = words
    if first == "ros2":
        if rest[:1] != ["run"] or len(rest) < 3 or any(word.startswith("-") for word in rest[1:3]):
            raise click.UsageError(f"{shlex.join(words)}: {_FORMS}")
        return {"executable": f"{rest[1]}/{rest[2]}"}, rest[3:]
    if _PYTHON.match(Path(first).name):
        if rest[:1] == ["-m"] and len(rest) > 1:
            return _target(rest[1:]) if rest[1] in _PYTEST else ({"module": rest[1]}, rest[2:])
        if not rest or rest[0].startswith("-"):
            raise click.UsageError(
                f"{shlex.join(words)}: write 'python3 FILE' or 'python3 -m MODULE'"
            )
        return {"script": _file(rest[0])}, rest[1:]
    if Path(first).suffix in (".yaml", ".yml"):
        raise click.UsageError(f"{first} is a job, not a program: leave out the '--' before it")
    if first == "launch_test" or any(map(_is_launch_test, words)):
        raise click.UsageError(
            f"{shlex.join(words)}: a launch_testing file cannot run in simulated time; name its "
            "nodes and a pytest file with its tests: -- ros2 launch PACKAGE FILE -- pytest FILE"
        )
    if first in _PYTEST:
        for word in filter(_is_python_file, rest):
            _file(word.partition("::")[0])
        return _RUN_PYTEST, rest
    if "/" not in first and (package := _console_script(first)):
        return {"executable": f"{package}/{first}"}, rest
    found = first if "/" in first or Path(first).is_file() else shutil.which(first)
    if found is None:
        raise click.UsageError(
            f"there is no program {first!r}: it is no file, no console script of this Python, and "
            f"not in PATH; {_FORMS}"
        )
    path = _file(found)
    from rsltrace.adapters.processes.build import is_python

    return {"script" if path.endswith(".py") or is_python(Path(path)) else "program": path}, rest


def _is_python_file(word: str) -> bool:
    return word.partition("::")[0].endswith(".py")


def _is_launch_test(word: str) -> bool:
    path = Path(word.partition("::")[0])
    is_there = _is_python_file(word) and path.is_file()
    return is_there and b"def generate_test_description" in path.read_bytes()


def _file(path: str) -> str:
    if not Path(path).is_file():
        raise click.UsageError(f"there is no file {path}")
    return path


def _console_script(name: str) -> str | None:
    """Return the distribution that has a console script, None if there is none."""
    from importlib import metadata

    for entry in metadata.entry_points(group="console_scripts", name=name):
        if entry.dist is not None:
            return entry.dist.name
    return None
