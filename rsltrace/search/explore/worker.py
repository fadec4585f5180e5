"""The program of a worker: it loads what a run needs once, and makes each run in a copy of itself.

``python -m rsltrace.search.explore.worker SOCKET [--no-pin]``, started by ``workers``. The worker
itself never runs user code, so every copy begins as the one before did; what a run leaves behind,
leaks or breaks is gone with its process, and so is what it has started.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import time
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

from rsltrace.child_processes import kill_group, signal_name
from rsltrace.errors import RsltraceError
from rsltrace.forking import die_with_parent, other_threads
from rsltrace.guard.libraries import is_library
from rsltrace.guard.pin import pin
from rsltrace.line_protocol import Lines
from rsltrace.search.explore.prefix import (
    Prefixes,
    answer_and_end,
    lead_nowhere,
    source_of,
    take_ends,
)
from rsltrace.search.explore.trial import CRASH, TIMEOUT, Failure, Trial, TrialResult

_PIECE_BYTES = 1 << 16
_OUTPUT_MAX = 2000


def main(words: list[str]) -> None:
    """Serve whoever has started this process until they close the socket."""
    if "--no-pin" not in words:
        pin()
    from rsltrace.adapters.rclpy.boundary.installation import check_no_simulation
    from rsltrace.adapters.rclpy.world import World  # noqa: F401  # with all that a run loads
    from rsltrace.search.explore import outcome  # noqa: F401

    with suppress(RsltraceError):  # a run says so, if it needs rclpy
        check_no_simulation()
        importlib.import_module("rclpy")
    idle = other_threads()  # of rclpy's, which does nothing in a simulation

    lines = Lines(socket.socket(fileno=int(words[0])))
    lines.move_high()  # the descriptors that nodes get are those of any run
    for number in (0, 1):
        lead_nowhere(number)
    is_warm = "--cold" in words
    gc.collect()
    gc.freeze()
    prefixes = Prefixes()
    while True:
        task = lines.receive()
        if task is None:
            return
        answer = _run(task, prefixes if is_warm else None)
        libraries = answer.pop("libraries", None)
        lines.send(answer)
        if libraries is not None:
            is_warm = True
            _warm_up(task, libraries)
            if other_threads() - idle:  # which no copy would have
                _begin_again(lines.fileno(), words)


def _warm_up(task: dict[str, Any], libraries: list[str]) -> None:
    """Import the libraries that a run has imported, so that the next one need not.

    That is no part of a run (``rsltrace.guard.libraries``); user code is not imported.
    """
    with suppress(RsltraceError):
        source_of(task).job()
    for name in libraries:
        with suppress(Exception):
            importlib.import_module(name)
    gc.collect()
    gc.freeze()


def _begin_again(number: int, words: list[str]) -> None:
    """Start this process once more without libraries, which have begun threads here."""
    os.set_inheritable(number, True)
    before = sys.orig_argv[1 : len(sys.orig_argv) - len(words)]
    command = [sys.executable, *before, str(number), *words[1:], "--cold"]
    os.execv(sys.executable, command)


def _libraries(before: frozenset[str]) -> list[str]:
    """Return the libraries, and modules of Python's, that were not loaded ``before``."""
    found = []
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        is_python = name.partition(".")[0] in sys.stdlib_module_names
        if name not in before and isinstance(file, str) and (is_python or is_library(file)):
            found.append(name)
    return found


def _run(task: dict[str, Any], prefixes: Prefixes | None) -> dict[str, Any]:
    """Run a trial in a copy of this process, or in one of those that stand at the end of a common
    prefix; return what came of it. Without ``prefixes``, also which libraries it has imported."""
    began = time.perf_counter()
    why = ""
    if prefixes is not None and task["wants"]["fork_ns"] >= 0:
        ends = (*os.pipe(), *os.pipe())
        child, why = prefixes.fork(task, ends[1], ends[3])
        if child is None:
            for end in ends:
                os.close(end)
        else:
            answer = _answer(task, child, ends, began)
            if "why" not in answer:
                return answer
            why = answer["why"]
    ends = (*os.pipe(), *os.pipe())
    answer = _answer(task, _forked(task, ends, tells=prefixes is None), ends, began)
    if why and "result" in answer:
        answer["result"]["why_not_forked"] = why
    return answer


def _forked(task: dict[str, Any], ends: tuple[int, ...], *, tells: bool) -> int:
    """Begin a trial in a copy of this process; return which one."""
    pid = os.getpid()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the threads beside do nothing
        child = os.fork()
    if child == 0:
        os.setsid()
        die_with_parent(pid)
        answer_at = take_ends(ends[1], ends[3])
        for end in ends:
            os.close(end)
        _make(task, answer_at, tells=tells)
    return child


def _answer(
    task: dict[str, Any], child: int, ends: tuple[int, ...], began: float
) -> dict[str, Any]:
    """Wait for what a copy answers; it is gone afterwards."""
    told, tell, said, say = ends
    os.close(tell)
    os.close(say)
    answer, output, in_time = _hear(told, said, task.get("timeout_s"))
    kill_group(child)
    os.kill(child, signal.SIGKILL)  # it may not have a group of its own yet
    _, status = os.waitpid(child, 0)
    for end in (told, said):
        os.close(end)
    if answer.endswith(b"\n"):
        return dict(json.loads(answer))
    trial = Trial(**task["trial"])
    wall_s = round(time.perf_counter() - began, 6)
    failure = _crash(status, output) if in_time else _timeout(task["timeout_s"])
    kept = Path(task["trace"])
    found = TrialResult(
        trial,
        failure=failure,
        wall_s=wall_s,
        trace=str(kept) if kept.is_file() else None,
    )
    return {"result": found.as_values()}


def _hear(told: int, said: int, timeout_s: float | None) -> tuple[bytes, str, bool]:
    """Return what a copy has answered, the end of what it has printed, and whether it was in
    time."""
    end_s = None if timeout_s is None else time.monotonic() + timeout_s
    poll = select.poll()
    poll.register(told, select.POLLIN)
    poll.register(said, select.POLLIN)
    answer, output = bytearray(), b""
    while not answer.endswith(b"\n"):
        left_ms = None if end_s is None else max(end_s - time.monotonic(), 0) * 1000
        ready = poll.poll(left_ms)
        if not ready:
            return bytes(answer), _text(output), False
        for number, _ in ready:
            piece = os.read(number, _PIECE_BYTES)
            if number == said:
                output = (output + piece)[-_OUTPUT_MAX:]
                if not piece:
                    poll.unregister(said)
            elif piece:
                answer += piece
            else:
                return bytes(answer), _text(output), True
    return bytes(answer), _text(output), True


def _text(output: bytes) -> str:
    return output.decode("utf-8", "replace").strip()


def _crash(status: int, output: str) -> Failure:
    code = os.waitstatus_to_exitcode(status)
    how = f"exit status {code}" if code >= 0 else signal_name(-code)
    last = f": {output.splitlines()[-1]}" if output else ""
    return Failure(CRASH, f"its process ended with {how}{last}", f"crash: {how}")


def _timeout(timeout_s: float) -> Failure:
    return Failure(TIMEOUT, f"it was killed after {timeout_s:g} s of real time", "timeout")


def _make(task: dict[str, Any], tell: int, *, tells: bool) -> None:
    """Run the trial here, from its beginning, and end this process. Never returns."""
    before = frozenset(sys.modules)
    from rsltrace.run.process import skip_final_collection
    from rsltrace.search.explore.outcome import TrialOptions, run_trial

    def run() -> dict[str, Any]:
        skip_final_collection()
        trial, wants = Trial(**task["trial"]), TrialOptions(**task["wants"])
        result = run_trial(source_of(task), trial, Path(task["trace"]), wants)
        answer: dict[str, Any] = {"result": result.as_values()}
        if tells:
            answer["libraries"] = _libraries(before)
        return answer

    answer_and_end(run, tell)


if __name__ == "__main__":
    main(sys.argv[1:])
