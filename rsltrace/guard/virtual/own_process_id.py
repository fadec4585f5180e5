"""``os.getpid`` in user code: names, seeds and files made of it are the same in every run."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from rsltrace.guard.callers import is_nobodys, module_of
from rsltrace.guard.frames import caller
from rsltrace.guard.guard import engaged
from rsltrace.guard.process_ids import meant_id, meant_path, virtual_id
from rsltrace.guard.redirect import redirect
from rsltrace.trace.model.finding import Mode, Source

_CALL = "os.getpid()"
_LOGGING = "logging"
_TAKE_IDS = (
    *("getpgid", "getsid", "getpriority", "setpriority", "pidfd_open"),
    *("sched_getparam", "sched_setparam", "sched_getscheduler", "sched_setscheduler"),
    "sched_rr_get_interval",
)
"""Functions of ``os`` that are given the id of a process; ``os.kill`` is the door's."""

_TAKE_PATHS = ("readlink", "access")
"""Functions of ``os`` that are given a path and that nobody else redirects."""


def _getpid(real: Callable[[], int]) -> Callable[[], int]:
    def getpid() -> int:
        guard = engaged()
        if guard is None:
            return real()
        frame = caller()
        if is_nobodys(frame):
            return real()
        mode = guard.mode(Source.PID, frame)
        shown = module_of(frame) == _LOGGING  # which notes it in every record, whoever logs
        if mode is Mode.VIRTUAL and (shown or guard.is_user(frame)):
            if not shown:
                guard.count(Source.PID, _CALL, frame)
            return virtual_id(guard)
        if shown:
            return real()
        if mode is Mode.RECORD and guard.is_for_user(frame):
            return int(guard.recorded(Source.PID, _CALL, real, frame))
        value = real()
        guard.watched(Source.PID, _CALL, value, frame)
        return value

    return getpid


def _taking(meant: Callable[[Any], Any], real: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: Any, **options: Any) -> Any:
        options = {name: meant(value) for name, value in options.items()}
        return real(*map(meant, arguments), **options)

    return call


@contextmanager
def own_process_ids() -> Iterator[None]:
    """Give each main a process id of its own, and take it back where one is asked for."""
    with ExitStack() as stack:
        redirect(stack, os.getpid, _getpid)
        for name in _TAKE_IDS:
            if hasattr(os, name):
                redirect(stack, getattr(os, name), partial(_taking, meant_id))
        redirect(stack, resource.prlimit, partial(_taking, meant_id))
        for name in _TAKE_PATHS:
            redirect(stack, getattr(os, name), partial(_taking, meant_path))
        yield
