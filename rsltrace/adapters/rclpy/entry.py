"""What is constructed in a world, and the arguments that ``ros2 run`` would give it."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsltrace.adapters.rclpy.arguments import InvalidArgumentsError, RosArguments
from rsltrace.errors import JobError
from rsltrace.trace.model.finding import Policy


@dataclass(frozen=True, slots=True)
class StartRule:
    """When an entry starts that does not start with the run: ``delay_ns`` after all of the others
    have come true. ``started`` and ``ended`` are keys of other entries."""

    delay_ns: int = 0
    topic: str | None = None
    service: str | None = None
    node: str | None = None
    started: str | None = None
    ended: str | None = None


Typed = tuple[int | None, bytes | None]
"""What is typed at once, None for the end of the input, and when (ns since the start of the run),
None for when it is asked for."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry of a job, ready to be constructed.

    ``make`` returns a node or a list of nodes; ``arguments`` are what ``ros2 run`` would give
    them, in lists of which later ones have the last word on parameters. ``key`` is a name of its
    own among the entries, whatever other entries there are.
    """

    name: str
    make: Callable[[], Any]
    arguments: list[RosArguments]
    log_exceptions: bool = False
    """Whether a callback of its nodes that raises is logged instead of ending the run."""
    key: str = ""
    policy: Policy | None = None
    argv: list[str] | None = None
    """The command line, if ``make`` is a main to be run in a program of its own."""
    start_after: StartRule | None = None
    """When it starts, None for those that start with the run."""
    stdin: Sequence[Typed] | None = None
    """What is typed at its terminal, None if it has none."""
    program: object | None = None
    """What runs as a process of its own, if it does: ``World.start_process`` knows how."""
    is_component: bool = False
    """Whether ``make`` asks a container to load it."""
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
    """Return what ``ros2 run`` would be given for a node of a job, as lists of arguments.

    The job's own parameters are a list of their own: rcl would let a file's entry for one node
    win over a parameter given for all. ``for_all`` are the job's arguments for all nodes: their
    names go before the node's own (the first rule counts), their parameters after.

    :raises JobError: if rcl refuses them (a broken parameter file) or would cut a text off; it
        begins with ``where``.
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
    """Yield the words for parameters that ``-p`` has no way to name, as ``ros2 launch`` gives all.

    rcl reads the file at once.
    """
    if not parameters:
        yield []
        return
    lines = [f"    {_yaml_value(key, where)}: {text}" for key, text in parameters.items()]
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", encoding="utf-8") as file:
        file.write("\n".join(("/**:", "  ros__parameters:", *lines, "")))
        file.flush()
        yield ["--params-file", file.name]


def _yaml_value(value: Any, where: str) -> str:
    """Write a parameter so that rcl's YAML parser reads the same value and type again."""
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
                f"the parameter {value!r} has a NUL character, where ROS ends a text: leave it out",
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
