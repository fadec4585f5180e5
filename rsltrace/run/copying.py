"""A function that runs in a copy of this process, and what comes back of it."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NoReturn

from rsltrace.errors import RunError
from rsltrace.forking import Pairs, end_process, fork_below


def in_copy(function: Callable[[int], Any], pairs: Pairs) -> Any:
    """Call ``function`` in a copy of this process, which ends with it; return what it returns,
    pickled on the way. It is given the descriptor of ours that the copy answers at; ``pairs`` as
    for ``fork_below``.

    :raises Exception: what it raises, as it is if that can be pickled.
    :raises RunError: there can be no copy, or it dies, or the value cannot be pickled.
    """
    for stream in filter(None, (sys.stdout, sys.stderr)):  # who has closed one has None there
        stream.flush()  # or both would write what waits there
    told, tell = os.pipe()
    pid = fork_below(pairs)
    if pid == 0:
        os.close(told)
        _answer(function, tell)
    os.close(tell)
    status: int | None = None
    try:
        with open(told, "rb") as answers:
            data = answers.read()
    except BaseException:
        os.kill(pid, signal.SIGKILL)
        raise
    finally:
        with suppress(ChildProcessError):  # who ignores the ends of its children has no status
            status = os.waitpid(pid, 0)[1]
    if not data:
        raise RunError(f"the copy of the simulation has died{_of(status)}")
    kind, value = pickle.loads(data)
    if kind == "raised":
        raise value
    return value


def _of(status: int | None) -> str:
    if status is None:
        return ""
    code = os.waitstatus_to_exitcode(status)
    return f" of {signal.Signals(-code).name}" if code < 0 else f", with exit status {code}"


def _answer(function: Callable[[int], Any], tell: int) -> NoReturn:
    """Call the function, write what comes of it to ``tell``, and end this process."""
    status = 1
    try:
        try:
            answer = _pickled("returned", function(tell))
        except BaseException as error:
            answer = _pickled("raised", error)
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        while answer:
            answer = answer[os.write(tell, answer) :]
        status = 0
    finally:
        end_process(status)
    raise AssertionError("it has ended")


def _pickled(kind: str, value: Any) -> bytes:
    try:
        data = pickle.dumps((kind, value))
        pickle.loads(data)
        return data
    except Exception as error:
        if kind == "raised":
            other = RunError(f"{type(value).__qualname__}: {value}")
        else:
            other = RunError(f"what the function returns cannot leave the copy: {error}")
        return pickle.dumps(("raised", other))
