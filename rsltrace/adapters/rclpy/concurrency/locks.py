"""Locks of simulated threads: waiting for one takes simulated time.

``threading`` builds conditions, events, semaphores, barriers and queues on two kinds of locks,
which are replaced by these. A free lock costs no more than a flag. Outside of a run, and in real
threads, real locks are made.
"""

from __future__ import annotations

import _thread
import atexit
import os
import sys
import threading
import weakref
from collections import deque
from typing import Any

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.concurrency.blocking_calls import calling_runtime, runtimes, wait
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, Runtime
from rsltrace.errors import UnsupportedError
from rsltrace.trace.model.texts import waiting_ns

_real_rlock = _thread.RLock


_LAST: Any = object()


def _no_stack() -> Any:
    """Replace ``getcurrent`` while Python exits: greenlet is gone by then, but objects of nodes may
    still lock something (``__del__``, handlers of ``logging``)."""
    return _LAST


@atexit.register
def _forget_stacks() -> None:
    global getcurrent
    getcurrent = _no_stack


class SimLock:
    """Stands in for ``threading.Lock``.

    As in CPython, a release wakes the longest waiter, and the running thread may take the lock
    before it does. The waiter then waits on, and is not overtaken a second time.
    """

    __slots__ = ("__weakref__", "_called", "_owner", "_taken", "_waits")

    def __new__(cls) -> Any:
        return _thread.allocate_lock() if calling_runtime() is None else object.__new__(cls)

    def __init__(self) -> None:
        self._taken = False
        self._owner: greenlet | None = None
        self._waits: deque[tuple[BlockedCall, bool]] = deque()
        """The waiters, and whether each was overtaken."""
        self._called: BlockedCall | None = None
        """The waiter that a release has woken and that has not run yet."""

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        if not self._taken:
            self._taken = True
            self._owner = getcurrent()
            return True
        if not blocking:
            if timeout != -1:
                raise ValueError("can't specify a timeout for a non-blocking call")
            return False
        if timeout != -1 and timeout < 0:
            raise ValueError("timeout value must be a non-negative number")
        return self._wait(timeout)

    def _wait(self, timeout: float) -> bool:
        runtime = calling_runtime()
        if runtime is None and getcurrent is _no_stack:
            return True  # no other thread is left
        if runtime is None:
            raise UnsupportedError(
                "a real thread, or code outside of a run, waits for a lock of the simulation"
            )
        in_condition = sys._getframe(2).f_code is threading.Condition.wait.__code__
        now_ns = runtime.loop.now_ns
        until_ns = None if timeout == -1 else now_ns + waiting_ns(timeout)
        overtaken = False
        while True:
            for_ns = None if until_ns is None else until_ns - runtime.loop.now_ns
            what = _LockHolder(runtime, self._owner, for_work=in_condition)
            if not self._turn(runtime, what, for_ns, overtaken=overtaken):
                return False
            if overtaken or not self._taken:  # kept taken for this waiter, or free
                self._taken = True
                self._owner = getcurrent()
                return True
            overtaken = True

    def _turn(
        self, runtime: Runtime, what: _LockHolder, for_ns: int | None, *, overtaken: bool
    ) -> bool:
        """Wait until a release wakes this waiter; return False on a timeout."""
        mine: list[BlockedCall] = []

        def join(blocked: BlockedCall) -> None:
            mine.append(blocked)
            (self._waits.appendleft if overtaken else self._waits.append)((blocked, overtaken))

        came = False
        try:
            came = wait(runtime, what, until=join, for_ns=for_ns, patient=what.is_idle)
        finally:
            called = bool(mine) and self._called is mine[0]
            if called:
                self._called = None
            if not came:
                self._waits = deque(one for one in self._waits if one[0].waiting)
                if called and (overtaken or not self._taken):  # an exception: wake the next one
                    self._taken = True
                    self.release()
        return came

    def release(self) -> None:
        if not self._taken:
            raise RuntimeError("release unlocked lock")
        self._owner = None
        self._taken = False
        while self._waits and self._called is None:
            blocked, overtaken = self._waits.popleft()
            if blocked.waiting:
                self._called = blocked
                self._taken = overtaken
                blocked.wake()

    def locked(self) -> bool:
        return self._taken

    def is_mine(self) -> bool:
        return self._taken and self._owner is getcurrent()

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *exc: object) -> None:
        self.release()

    def _at_fork_reinit(self) -> None:
        self.__init__()  # type: ignore[misc]


class PoolLock:
    """Stands in for the lock that all thread pools share (``concurrent.futures``).

    A pool holds it while it starts a worker, which runs first and may need it, too. Real threads
    use ``real``.
    """

    def __init__(self, real: Any) -> None:
        self._real = real
        self._own: SimLock = object.__new__(SimLock)
        self._own.__init__()  # type: ignore[misc]

    def __enter__(self) -> bool:
        return bool((self._real if calling_runtime() is None else self._own).acquire())

    def __exit__(self, *exc: object) -> None:
        (self._own if self._own.is_mine() else self._real).release()


class SimRLock:
    """Stands in for ``threading.RLock``."""

    __slots__ = ("__weakref__", "_count", "_lock", "_owner")

    def __new__(cls) -> Any:
        return _real_rlock() if calling_runtime() is None else object.__new__(cls)

    def __init__(self) -> None:
        self._lock = SimLock()
        self._owner: greenlet | None = None
        self._count = 0

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        me = getcurrent()
        if self._owner is me:
            self._count += 1
            return True
        if not self._lock.acquire(blocking, timeout):
            return False
        self._owner = me
        self._count = 1
        return True

    def release(self) -> None:
        if self._owner is not getcurrent():
            raise RuntimeError("cannot release un-acquired lock")
        self._count -= 1
        if not self._count:
            self._owner = None
            self._lock.release()

    if hasattr(_real_rlock(), "locked"):  # from Python 3.14 on; Condition asks

        def locked(self) -> bool:
            return self._lock.locked()

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *exc: object) -> None:
        self.release()

    # Methods that Condition uses.

    def _is_owned(self) -> bool:
        return self._owner is getcurrent()

    def _release_save(self) -> tuple[int, greenlet | None]:
        state = self._count, self._owner
        self._count, self._owner = 0, None
        self._lock.release()
        return state

    def _acquire_restore(self, state: tuple[int, greenlet | None]) -> None:
        self._lock.acquire()
        self._count, self._owner = state

    def _recursion_count(self) -> int:
        return self._count if self._is_owned() else 0

    def _at_fork_reinit(self) -> None:
        self.__init__()  # type: ignore[misc]


# -- in a forked process --------------------------------------------------------------------------

_making = _thread.allocate_lock()
_real: weakref.WeakKeyDictionary[SimLock, Any] = weakref.WeakKeyDictionary()


def _real_of(lock: SimLock, *, anew: bool = False) -> Any:
    with _making:
        found = None if anew else _real.get(lock)
        if found is None:
            found = _real[lock] = _thread.allocate_lock()
            if lock._taken and not anew:
                found.acquire()
        return found


def _acquire(self: SimLock, blocking: bool = True, timeout: float = -1) -> bool:
    return bool(_real_of(self).acquire(blocking, timeout))


def _release(self: SimLock) -> None:
    _real_of(self).release()


def _locked(self: SimLock) -> bool:
    return bool(_real_of(self).locked())


def _reinit(self: SimLock) -> None:
    _real_of(self, anew=True)


def _become_real() -> None:
    """Let the locks of the simulation lock real threads: a forked process has no others.

    A condition keeps bound methods of its lock, so their code is replaced.
    """
    if runtimes:
        kind: Any = SimLock
        for name, real in (
            ("acquire", _acquire),
            ("release", _release),
            ("locked", _locked),
            ("_at_fork_reinit", _reinit),
        ):
            getattr(kind, name).__code__ = real.__code__


os.register_at_fork(after_in_child=_become_real)


class _LockHolder:
    """Describes the holder of a lock, for the report of a deadlock."""

    def __init__(self, runtime: Runtime, owner: greenlet | None, *, for_work: bool) -> None:
        self._runtime = runtime
        self._owner = owner
        self._me = getcurrent()
        self._for_work = for_work

    def is_idle(self) -> bool:
        """Return whether a thread waits for work (a queue, an event) that may never come, or a main
        whose threads spin."""
        runtime = self._runtime
        if not self._for_work or runtime.threads.runs_on(self._me):
            return self._for_work
        program = runtime.programs.on_stack(self._me)
        return program is not None and any(
            blocked.quiet and blocked.program is program and blocked.stack is not self._me
            for blocked in runtime.runners.blocked
        )

    def __str__(self) -> str:
        if self._for_work:
            return "an event, a condition, a queue or a future"
        if self._owner is self._me:
            return "a lock that it holds itself"
        for blocked in self._runtime.runners.blocked:
            if blocked.stack is self._owner:
                return f"a lock that is held by {blocked.describe()}"
        return "a lock that no thread will release"
