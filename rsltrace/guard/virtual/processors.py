"""The processors that user code sees: the same in every run, whatever the machine has.

Pools make as many workers, and programs divide their data by it. Processes of the run
(``rsltrace.adapters.processes``) see the same number. ``rules.RULES`` answers ``os.cpu_count``.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any
from weakref import WeakKeyDictionary

from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.process_ids import real_id
from rsltrace.guard.redirect import copy_of, redirect
from rsltrace.guard.rules import PROCESSOR_NAMES, PROCESSORS
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource

_getpid = copy_of(os.getpid)
_affinities: WeakKeyDictionary[Guard, frozenset[int]] = WeakKeyDictionary()
"""The processors that user code has set."""


def _answering_guard(call: str, frame: FrameType) -> Guard | None:
    """Return the guard if user code calls and the run answers."""
    guard = engaged()
    if guard is None or not guard.is_user_call(frame):
        return None
    if guard.mode(NondeterminismSource.ENVIRONMENT, frame) is GuardMode.ALLOW:
        return None
    guard.count_call(NondeterminismSource.ENVIRONMENT, call, frame)
    return guard


def _configured(real: Callable[[Any], int]) -> Callable[[Any], int]:
    numbers = {os.sysconf_names[name] for name in PROCESSOR_NAMES}

    def sysconf(name: Any, /) -> int:
        if name in PROCESSOR_NAMES or name in numbers:
            guard = _answering_guard("os.sysconf()", sys._getframe(1))
            if guard is not None:
                return PROCESSORS
        return real(name)

    return sysconf


def _is_own(pid: Any) -> bool:
    return pid == 0 or bool(real_id(pid) == _getpid())


def _affinity(real: Callable[[Any], set[int]]) -> Callable[[Any], set[int]]:
    def sched_getaffinity(pid: Any, /) -> set[int]:
        guard = (
            _answering_guard("os.sched_getaffinity()", sys._getframe(1)) if _is_own(pid) else None
        )
        if guard is None:
            return real(real_id(pid))
        return set(_affinities.get(guard, range(PROCESSORS)))

    return sched_getaffinity


def _setting(real: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
    def sched_setaffinity(pid: Any, mask: Iterable[int], /) -> None:
        guard = (
            _answering_guard("os.sched_setaffinity()", sys._getframe(1)) if _is_own(pid) else None
        )
        if guard is None:
            real(real_id(pid), mask)
            return
        chosen = frozenset(mask).intersection(range(PROCESSORS))
        if not chosen:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        _affinities[guard] = chosen

    return sched_setaffinity


@contextmanager
def virtual_processors() -> Iterator[None]:
    """Show user code the same processors on every machine."""
    with ExitStack() as stack:
        for name, make in (
            ("sysconf", _configured),
            ("sched_getaffinity", _affinity),
            ("sched_setaffinity", _setting),
        ):
            if hasattr(os, name):
                redirect(stack, getattr(os, name), make)
        yield


__all__ = ["PROCESSORS", "virtual_processors"]
