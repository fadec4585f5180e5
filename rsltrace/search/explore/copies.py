"""What a copy of a worker's process does: it makes one run, answers, and ends."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rsltrace.errors import RsltraceError
from rsltrace.forking import end_process
from rsltrace.search.explore.trial import JobSource

_HIGH = 900
"""Descriptors from here on are not those that nodes get first."""


def take_ends(tell: int, say: int) -> int:
    """Have what is printed go to ``say``; return a high descriptor that answers as ``tell`` does.
    Both stay open."""
    os.dup2(say, 2)
    return fcntl.fcntl(tell, fcntl.F_DUPFD_CLOEXEC, _HIGH)


def answer_and_end(run: Callable[[], dict[str, Any]], tell: int) -> None:
    """Write what a run answers, or what it was in trouble with, and end this process."""
    status = 1
    try:
        try:
            answer = run()
        except RsltraceError as error:
            answer = {"trouble": str(error)}
        except OSError as error:
            of = f": {error.filename}" if error.filename else ""
            answer = {"trouble": f"{error.strerror or error}{of}"}
        data = json.dumps(answer).encode() + b"\n"
        while data:
            data = data[os.write(tell, data) :]
        status = 0
    except BaseException:
        import traceback

        with suppress(BaseException):
            os.write(2, traceback.format_exc().encode())
    finally:
        end_process(status)


def source_of(task: dict[str, Any]) -> JobSource:
    """Return the job that a task is about."""
    job = task["job"]
    return JobSource(**{**job, "overrides": tuple((one, two) for one, two in job["overrides"])})
