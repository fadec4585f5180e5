"""Entries of a job, ready to be constructed, and their ROS arguments."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rsltrace.adapters.rclpy.arguments import InvalidArgumentsError, RosArguments
from rsltrace.errors import JobError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.finding import GuardPolicy


@dataclass(frozen=True, slots=True)
class StartRule:
    """Starts an entry ``delay_ns`` after all other conditions are met. ``started`` and ``ended``
    are keys of other entries."""

    delay_ns: int = 0
    topic: str | None = None
    service: str | None = None
    node: str | None = None
    started: str | None = None
    ended: str | None = None


TypedInput = tuple[int | None, bytes | None]
"""When something is typed (ns since the start of the run; None: when it is read), and the bytes
(None: the end of the input)."""


@dataclass(frozen=True, slots=True)
class JobEntry:
    """One entry of a job, ready to be constructed.

    ``make`` returns a node or a list of nodes. ``arguments`` are those of ``ros2 run``, in lists of
    which later ones override parameters. ``key`` is unique among the entries.
    """

    name: str
    make: Callable[[], Any]
    arguments: list[RosArguments]
    log_exceptions: bool = False
    """Whether exceptions of callbacks are logged instead of ending the run."""
    key: str = ""
    policy: GuardPolicy | None = None
    argv: list[str] | None = None
    """The command line, if ``make`` is a main."""
    start_after: StartRule | None = None
    """None: it starts with the run."""
    stdin: Sequence[TypedInput] | None = None
    """The input of its terminal, None if it has none."""
    program: object | None = None
    """The executable of a real process, for ``World.start_process``."""
    is_component: bool = False
    """Whether ``make`` requests a container to load it."""
    respawn: tuple[int, int | None] | None = None
    """How much later (ns) a process starts again that has ended, and how often (None: always)."""
    required: bool = False
    """Whether the run ends when it has ended."""


_PART = "[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*"
_FITS_A_RULE = re.compile(rf"{_PART}([./]{_PART})*").fullmatch
"""Whether a parameter's name is one that rcl's grammar of ``-p name:=value`` knows."""


def ros_arguments(
    *,
    name: str | None,
    namespace: str | None,
    parameters: dict[str, Any],
    parameter_files: Sequence[Path],
    remappings: dict[str, str],
    where: str,
    for_all: Sequence[str] = (),
) -> list[RosArguments]:
    """Return the arguments of ``ros2 run`` for a node of a job, as lists.

    The job's own parameters are a separate list, as rcl prefers a file's entry for one node to a
    parameter for all. ``for_all`` are the job's arguments for all nodes: their names come first
    (the first rule counts), their parameters last.

    :raises JobError: if rcl refuses them (a broken parameter file) or would truncate a text.
    """
    arguments = list(for_all)
    if name is not None:
        arguments += ["-r", f"__node:={name}"]
    if namespace is not None:
        arguments += ["-r", f"__ns:={namespace}"]
    for old, new in remappings.items():
        arguments += ["-r", f"{old}:={new}"]
    for path in parameter_files:
        arguments += ["--params-file", str(path)]
    own: list[str] = []
    odd: dict[str, str] = {}
    for key, value in parameters.items():
        text = _yaml_value(value, where)
        if _FITS_A_RULE(key):
            own += ["-p", f"{key}:={text}"]
        else:
            odd[key] = text
    try:
        with _parameter_file(odd, where) as file:
            own += file
            lists = (arguments, own, for_all) if for_all else (arguments, own)
            return [RosArguments(["--ros-args", *part]) for part in lists]
    except InvalidArgumentsError as error:
        raise JobError(str(error), where=where) from error


@contextmanager
def _parameter_file(parameters: dict[str, str], where: str) -> Iterator[list[str]]:
    """Yield ``--params-file`` arguments for parameters whose names ``-p`` does not allow; rcl reads
    the file at once."""
    if not parameters:
        yield []
        return
    lines = [f"    {_yaml_value(key, where)}: {text}" for key, text in parameters.items()]
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", encoding="utf-8") as file:
        file.write("\n".join(("/**:", "  ros__parameters:", *lines, "")))
        file.flush()
        yield ["--params-file", file.name]


def _yaml_value(value: Any, where: str) -> str:
    """Write a parameter so that rcl's YAML parser reads the same value and type."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, float):
        return {"inf": ".inf", "-inf": "-.inf", "nan": ".nan"}.get(
            repr(float(value)), _float(value)
        )
    if isinstance(value, str):
        if "\0" in value:
            raise JobError(
                f"the parameter {value!r} has a NUL character, where ROS ends a text: remove it",
                where=where,
            )
        return '"' + "".join(map(_escaped, value)) + '"'
    return "[" + ", ".join(_yaml_value(item, where) for item in value) + "]"


def _escaped(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    return character if character.isprintable() else f"\\U{ord(character):08x}"


def _float(value: float) -> str:
    text = repr(float(value))
    mantissa, _, exponent = text.partition("e")
    if "." not in mantissa:
        mantissa += ".0"
    return mantissa + (f"e{exponent}" if exponent else "")
