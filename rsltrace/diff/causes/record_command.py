"""The command that records a trace's job once more, with what the command line said of it.

A job that was put together (``--set``, ``--seed``, a launch file, …) begins, in the trace, with
comments that say of what. Without them the command would record another run.
"""

from __future__ import annotations

import json
import shlex
from pathlib import Path

from rsltrace.trace.reader import Trace

_EFFECTIVE = "# The effective job "
_WITH = "#   with --"
_LAUNCH = "launch.+="


def is_effective(trace: Trace) -> bool:
    """Whether the job was put together, so that its text is not that of a file."""
    return trace.job_text.startswith(_EFFECTIVE)


def is_of_file(trace: Trace) -> bool:
    """Whether the job was read from a file, not made in Python: that has no name for it."""
    return trace.job.get("name", "") not in ("", "<python>")


def record_command(trace: Trace) -> str:
    """Return ``rsltrace record …`` for the job of ``trace``, "" if it came from no file."""
    if not is_of_file(trace):
        return ""
    words = ["rsltrace", "record", _job_file(trace)]
    if is_effective(trace):
        for line in trace.job_text.splitlines()[1:]:
            if not line.startswith("#"):
                break
            if line.startswith(_WITH):
                words = _with(words, line[len(_WITH) :])
    return " ".join(shlex.quote(word) for word in words)


def _job_file(trace: Trace) -> str:
    """Return the job file: a trace knows its name, and often lies beside it."""
    name = trace.job["name"]
    beside = Path(trace.name).parent / name
    return str(beside) if not Path(name).exists() and beside.is_file() else name


def _with(words: list[str], override: str) -> list[str]:
    option, _, change = override.partition(" ")
    if option == "until":  # the report has a time of its own
        return words
    if change.startswith(_LAUNCH):
        return _with_launch_file(words, change[len(_LAUNCH) :])
    return [*words, "--set", change]


def _with_launch_file(words: list[str], spec: str) -> list[str]:
    """Take ``{file: …, arguments: …}`` apart, as ``--launch`` has put it together."""
    try:
        launch = json.loads(spec)
        arguments = [f"{name}:={value}" for name, value in launch.get("arguments", {}).items()]
        file = str(launch["file"])
    except (ValueError, KeyError, AttributeError, TypeError):  # written by hand, as --set
        return [*words, "--set", f"{_LAUNCH}{spec}"]
    rest = words[2:]
    if rest and rest[0].rpartition("/")[2] == file.rpartition("/")[2]:
        rest = rest[1:]  # the launch file alone was the job
    skip = ["--skip-unsupported"] if launch.get("skip_unsupported") else []
    return ["rsltrace", "record", *rest, "--launch", file, *skip, *arguments]
