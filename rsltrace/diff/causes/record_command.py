"""The command that records a trace's job again, with its command line options.

A job that was put together (``--set``, ``--seed``, a launch file, …) begins, in the trace, with
comments that say of what. Without them the command would record another run. A trace may come from
anyone and the command is meant for pasting, so it uses only what is harmless: a
job or launch file that is here, and options of a fixed list with numbers, times and names.
"""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import field
from pathlib import Path

from rsltrace.diff.facts.remarks import JobChanged, NoRecordCommand, Remark
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.reader import Trace

_EFFECTIVE = "# The effective job "
_WITH = "#   with --"
_LAUNCH = "launch.+="
_ROS = "ros_arguments.+="

# Patterns, compiled at their first use: few traces come to it.
_JOB_NAME = r"\w[\w .+-]{0,200}\.(?:ya?ml|json)"
_LAUNCH_NAME = r"\w[\w .+-]{0,200}\.(?:ya?ml|xml|py)"
_FILE_BYTES_MAX = 4 << 20
_TEXT_MAX = 200
_CHANGE_MAX = 1000
_OPTIONS_MAX = 50

_NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?(?:ns|us|µs|ms|s|min|h|%)?|true|false|null"
_NAME = r"[~/]?[A-Za-z_][\w/*]*"
_WORD = r"[A-Za-z_]\w*"
_KEY = r"[\w/~*-]+"


def _of_values(leaf: str) -> str:
    """Return the pattern of a leaf, or a list or a mapping of such."""
    leaf = rf"(?:{leaf}|\"(?:{leaf})\")"
    pair = rf"{_KEY}: {leaf}"
    items, pairs = (rf"(?:{one}(?:, ?{one})*)?" for one in (leaf, pair))
    return rf"{leaf}|\[{items}\]|\{{{pairs}\}}"


_NUMBERS = _of_values(_NUMBER)
_NUMBERS_AND_WORDS = _of_values(f"{_NUMBER}|{_WORD}")
_NUMBERS_AND_NAMES = _of_values(f"{_NUMBER}|{_NAME}")
_SETTINGS = (
    (r"seed|min_time_step", _NUMBERS),
    (rf"(?:delay|execution|clocks)(?:\.{_KEY})*", _NUMBERS),
    (rf"nodes\.{_KEY}\.(?:parameters|arguments)(?:\.{_KEY})+", _NUMBERS_AND_WORDS),
    (rf"(?:stop|record|policy)(?:\.{_KEY})*", _NUMBERS_AND_NAMES),
)
"""Keys that ``--set`` is offered for, and their values: nothing here names code or a file. Few
traces have such settings, and compiling the patterns takes milliseconds."""

_ARGUMENT = rf"({_KEY}):=({_NUMBER}|{_NAME})"
_REMAPPING = r"[\w/~:]+:=[\w/~]+"
_PARAMETER = rf"[\w/~.:]+:=(?:{_NUMBER})"
_ROS_OPTIONS = {"-r": _REMAPPING, "--remap": _REMAPPING, "-p": _PARAMETER, "--param": _PARAMETER}


@dataclass(frozen=True, slots=True)
class RecordAgain:
    """How a trace's job is recorded again: a command that is safe to paste, or "".

    ``warnings`` say why there is none, or what to know of it.
    """

    command: str = ""
    warnings: tuple[Remark, ...] = ()


@dataclass(slots=True)
class _Words:
    """What the command is made of."""

    job: list[str]
    launch: list[str] = field(default_factory=list)
    settings: list[str] = field(default_factory=list)
    ros: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)
    """What is not taken over from the trace."""

    def command(self) -> str:
        ros = ["--ros-args", *self.ros, "--"] if self.ros else []
        words = ["rsltrace", "record", *self.job, *self.settings, *self.launch, *ros]
        return " ".join(shlex.quote(word) for word in words)


def is_effective(trace: Trace) -> bool:
    """Whether the job was put together, so that its text is not that of a file."""
    return trace.job_text.startswith(_EFFECTIVE)


def is_of_file(trace: Trace) -> bool:
    """Whether the job was read from a file, not made in Python or of a command line."""
    return trace.job.get("name", "")[:1] not in ("", "<")


def options_of(trace: Trace) -> Iterator[tuple[str, str]]:
    """Yield what the command line said of a trace's job: ``--set`` and ``key=value``."""
    for line in trace.job_text.splitlines()[1:] if is_effective(trace) else ():
        if not line.startswith("#"):
            return
        if line.startswith(_WITH):
            option, _, change = line.removeprefix(_WITH).partition(" ")
            yield f"--{option}", change


def is_harmless(change: str) -> bool:
    """Whether ``key=value`` of a trace names neither code nor a file."""
    key, _, value = change.partition("=")
    fits = (
        re.fullmatch(k, key, re.ASCII) and re.fullmatch(v, value, re.ASCII) for k, v in _SETTINGS
    )
    return len(change) <= _CHANGE_MAX and any(fits)


def record_again(trace: Trace) -> RecordAgain:
    """Return ``rsltrace record …`` for the job of ``trace``; nothing if it came from no file."""
    if not is_of_file(trace):
        return RecordAgain()
    name = trace.job["name"]
    path, is_same = job_file(trace, name)
    words = _Words([path])
    for option, change in options_of(trace):
        _take(words, option, change, name)
    if words.foreign:
        return RecordAgain("", (NoRecordCommand(trace.name, options=tuple(words.foreign)),))
    if words.job and not path:
        return RecordAgain("", (NoRecordCommand(trace.name, job=name),))
    changed = words.job and not is_same
    return RecordAgain(words.command(), (JobChanged(trace.name, path),) if changed else ())


def job_file(trace: Trace, name: str) -> tuple[str, bool]:
    """Return the job file, "" if there is none, and whether it is the one that was recorded.

    A trace knows its name, and often lies beside it.
    """
    if not re.fullmatch(_JOB_NAME, name):
        return "", False
    places = (Path(name), Path(trace.name).parent / name)
    found = [place for place in places if _is_file(place)]
    if is_effective(trace):  # its text is that of no file
        return (str(found[0]), True) if found else ("", False)
    same = next((place for place in found if _reads(place, trace.job_text)), None)
    if same is not None:
        return str(same), True
    return (str(found[0]), False) if found else ("", False)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False


def _reads(path: Path, text: str) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(_FILE_BYTES_MAX).decode("utf-8-sig", "replace") == text
    except OSError:
        return False


def _take(words: _Words, option: str, change: str, name: str) -> None:
    """Add what the job was put together with: ``--set`` and ``key=value``, as the trace says it."""
    if option == "--until":  # the report has a time of its own
        return
    too_much = len(change) > _CHANGE_MAX or len(words.settings) > _OPTIONS_MAX
    if too_much or option not in ("--set", "--seed", "--ros-args") or "=" not in change:
        words.foreign.append(f"{option} {change}")
    elif change.startswith(_LAUNCH):
        _take_launch_file(words, change[len(_LAUNCH) :], name)
    elif change.startswith(_ROS):
        _take_ros_argument(words, change[len(_ROS) :])
    elif is_harmless(change):
        words.settings += ["--set", change]
    else:
        words.foreign.append(f"--set {change}")


def _take_launch_file(words: _Words, spec: str, name: str) -> None:
    """Split ``{file: …, arguments: …}``, as ``--launch`` has written it."""
    try:
        launch = json.loads(spec)
        arguments = [f"{key}:={value}" for key, value in launch.get("arguments", {}).items()]
        file = str(launch["file"])
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError):
        words.foreign.append(f"--set {_LAUNCH}{spec}")  # written by hand
        return
    fits = all(re.fullmatch(_ARGUMENT, argument, re.ASCII) for argument in arguments)
    if words.launch or not fits or not _is_below_here(file):
        words.foreign.append(f"--launch {file} {' '.join(arguments)}".rstrip())
        return
    if os.path.basename(file) == name:
        words.job = []  # the launch file alone was the job
    skip = ["--skip-unsupported"] if launch.get("skip_unsupported") is True else []
    words.launch = ["--launch", file, *skip, *arguments]


def _is_below_here(file: str) -> bool:
    """Whether a path leads to a file in the working directory or below, and is written so."""
    path = Path(file)
    if path.is_absolute() or ".." in path.parts or not re.fullmatch(_LAUNCH_NAME, path.name):
        return False
    if len(file) > _TEXT_MAX or file.startswith("-") or not file.isprintable():
        return False
    return _is_file(path) and path.resolve().is_relative_to(Path.cwd().resolve())


def _take_ros_argument(words: _Words, text: str) -> None:
    """Take over remappings, and parameters that are numbers; options come before their values."""
    try:
        word = json.loads(text)
    except (ValueError, RecursionError):
        word = None
    before = words.ros[-1] if len(words.ros) % 2 else ""
    fits = isinstance(word, str) and (
        bool(re.fullmatch(_ROS_OPTIONS[before], word, re.ASCII)) if before else word in _ROS_OPTIONS
    )
    if fits:
        words.ros.append(word)
    else:
        words.foreign.append(f"--ros-args {text}")
