"""What an entry of ``nodes:`` maps to what: remappings, arguments."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rsltrace.errors import nearest
from rsltrace.job.values.checks import attach, text
from rsltrace.job.values.names import check_remap_from, check_remap_to
from rsltrace.job.values.problem import JobProblem, JobProblems, ProblemCollector, describe
from rsltrace.job.values.times import ExactFloat

# Telling a program's own words from the ROS arguments on one command line.


def split_ros_arguments(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a program's own words, and those between each ``--ros-args`` and ``--`` (or the end).

    A ``--`` that ends no ROS arguments stays.
    """
    own: list[str] = []
    ros: list[str] = []
    inside = False
    for word in words:
        if word == "--ros-args":
            inside = True
        elif word == "--" and inside:
            inside = False
        else:
            (ros if inside else own).append(word)
    return own, ros


# Paths in a job: they start at the folder of the file they are written in.


class TextWithFolder(str):
    """Text from a file of another folder than the job's: a path in it starts at ``folder``."""

    folder: str

    def __new__(cls, value: str, folder: str) -> TextWithFolder:
        self = super().__new__(cls, value)
        self.folder = folder
        return self


def check_path(value: object) -> str:
    """Check a path given as text or (in Python) as a path object; return it as the job's folder
    sees it, whichever file it was written in."""
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, str) and not value:
        raise JobProblem("a path cannot be empty")
    path = text()(value)
    if not isinstance(value, TextWithFolder) or os.path.isabs(path):
        return path
    return os.path.normpath(os.path.join(value.folder, path)).replace(os.sep, "/")


attach(check_path, schema={"type": "string", "minLength": 1})


def near_path(full: Path, path: str, *, but: str = "") -> str:
    """Return what there is instead of ``path`` (absolute: ``full``), to follow "no such file".

    ``but`` is a file that cannot be meant.
    """
    if path.startswith("~"):
        return "; '~' is not known here: write $(env HOME)"
    if path.startswith("$"):
        return "; variables of the environment are written $(env NAME)"
    if full.exists():
        return ""
    folder, _ = os.path.split(path)
    if not full.parent.is_dir():
        return f" (there is no folder {folder!r} either)"
    names = sorted(entry.name for entry in full.parent.iterdir() if entry.name != but)
    near = nearest(full.name, names)
    return f"; did you mean {os.path.join(folder, near)!r}?" if near else ""


def names_to_names(
    value: object, rule_from: Callable[[str], None], rule_to: Callable[[str], None]
) -> dict[str, str]:
    """Check a mapping of names to names, each side by a rule of its own."""
    if not isinstance(value, dict):
        raise JobProblem(f"expected a mapping of names to names (from: to), got {describe(value)}")
    problems = ProblemCollector()
    for name, to in value.items():
        with problems.at(str(name), at_key=True):
            text(rule_from)(name)
        with problems.at(str(name)):
            text(rule_to)(to)
    problems.check()
    return {str(name): str(to) for name, to in value.items()}


def check_remappings(value: object) -> dict[str, str]:
    """Check remappings: what is written in code, and what it stands for."""
    return names_to_names(value, check_remap_from, check_remap_to)


_NAME = {"pattern": check_remap_from.pattern}  # type: ignore[attr-defined]
attach(
    check_remappings,
    schema={
        "type": "object",
        "propertyNames": _NAME,
        "additionalProperties": {"type": "string", "pattern": check_remap_to.pattern},  # type: ignore[attr-defined]
    },
)


def check_arguments(value: object) -> dict[str, Any] | tuple[str, ...]:
    """Check what an entry is given: keyword arguments, or words of a command line."""
    if isinstance(value, (list, tuple)):
        return _check_words(value)
    if not isinstance(value, dict):
        raise JobProblem(
            "expected a mapping of argument names to values (node:) or a list of command-line "
            f"words (main:, executable:, script:, module:), got {describe(value)}"
        )
    for name in value:
        if not isinstance(name, str) or not name.isidentifier():
            raise JobProblem(
                f"{name!r} cannot be the name of an argument", (str(name),), at_key=True
            )
    return {name: _plain_floats(item) for name, item in value.items()}


def _check_words(values: list[object] | tuple[object, ...]) -> tuple[str, ...]:
    """Check command-line words; a number stands for its digits, as on a command line."""
    problems = [
        JobProblem(f"expected a word of a command line, got {describe(value)}", (index,))
        for index, value in enumerate(values)
        if isinstance(value, bool) or not isinstance(value, (str, int, float))
    ]
    if problems:
        raise JobProblems(problems)
    return tuple(str(getattr(value, "text", value)) for value in values)


attach(
    check_arguments,
    schema={
        "anyOf": [
            {"type": "object"},
            {"type": "array", "items": {"type": ["string", "number"]}},
        ]
    },
)


def _plain_floats(value: object) -> object:
    # What user code gets must not carry types of ours.
    if isinstance(value, ExactFloat):
        return float(value)
    if isinstance(value, TextWithFolder):
        return str(value)
    if type(value) is dict:
        return {key: _plain_floats(item) for key, item in value.items()}
    if type(value) is list:
        return [_plain_floats(item) for item in value]
    return value
