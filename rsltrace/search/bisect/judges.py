"""When a revision is good: by its digest, by an expression, a function or a command."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rsltrace.child_processes import Processes
from rsltrace.conditions.run_expression import RunExpression
from rsltrace.errors import BisectError, ConditionError
from rsltrace.terminal import tell
from rsltrace.trace.reader import Trace

Judge = Callable[[Path, Path], bool]
"""Takes a run's trace and the folder that it ran in. Raises BisectError for no answer."""

_TARGET = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_SKIP = 125
"""The exit status with which ``git bisect run`` skips a revision."""


@dataclass(frozen=True, slots=True)
class Check:
    """What a run is judged by, and its words."""

    words: str
    judge: Judge


def check_of(text: str) -> Check:
    """Return the check of ``--check``: an expression, or ``module:function`` of a ``Trace``.

    :raises BisectError: it is neither.
    :raises JobError: there is no such function.
    """
    if not _TARGET.fullmatch(text.strip()):
        try:
            expression = RunExpression(text)
        except ConditionError as error:
            raise BisectError(f"--check: {error}") from None

        def judge(path: Path, folder: Path) -> bool:
            with Trace.open(path) as trace:
                try:
                    return bool(expression.value(trace))
                except ConditionError as error:
                    raise BisectError(f"--check {text!r}: {error.message}") from None

        return Check(expression.text, judge)
    from rsltrace.run.plans.target import load_target

    sys.path.insert(0, str(Path.cwd()))
    function = load_target(text.strip(), where="--check")

    def call(path: Path, folder: Path) -> bool:
        with Trace.open(path) as trace:
            try:
                return bool(function(trace))
            except Exception as error:
                said = f"{type(error).__name__}: {error}"
                raise BisectError(f"--check {text} has no answer there: {said}") from error

    return Check(text.strip(), call)


def command(words: str, processes: Processes) -> Check:
    """Return the check of ``--run``: a shell command, judged as ``git bisect run`` does.

    It runs where the run did, with the path of the run's trace in ``RSLTRACE_TRACE``.
    """

    def judge(path: Path, folder: Path) -> bool:
        env = {**os.environ, "RSLTRACE_TRACE": str(path)}
        done = processes.run(["/bin/sh", "-c", words], cwd=folder, env=env)
        tell(done.output + done.errors, end="")
        if not 0 <= done.exit_code < 128 or done.exit_code == _SKIP:
            raise BisectError(f"--run {words!r} ended with exit status {done.exit_code}")
        return done.exit_code == 0

    return Check(words, judge)
