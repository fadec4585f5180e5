"""Every clock that a node can read shows simulated time: ``time``, ``datetime``, wherever bound.

Built-in functions are redirected; ``datetime.now`` and ``utcnow`` are replaced in their type.
Clocks of processor time show simulated time, too: computing takes none of it, and each further read
of a clock takes 1 us.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import datetime, timezone
from functools import partial
from types import BuiltinFunctionType, FrameType
from typing import Any

from rsltrace.guard import frames
from rsltrace.guard.callers import FILE_OWNERS, OURS
from rsltrace.guard.frames import caller, code_of, set_member
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.redirect import Redirected, copy_of, redirect, redirect_reader
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource

_NS = 1_000_000_000
_CLOCK, _VIRTUAL = NondeterminismSource.CLOCK, GuardMode.VIRTUAL

REAL_TIME_MODULES = {
    "hypothesis.internal.conjecture.junkdrawer",  # times the garbage collector, whenever it runs
    "multiprocessing.connection",
    "multiprocessing.popen_fork",
    "multiprocessing.synchronize",
    "selectors",
    "socket",
    "socketserver",
    "subprocess",
}
"""Modules that wait for the operating system in real time: their clocks must go on. Their users get
simulated time."""


_wall_ns = copy_of(time.time_ns)
_REAL_NS = {
    name: copy_of(getattr(time, f"{name}_ns"))
    for name in ("monotonic", "perf_counter", "process_time", "thread_time")
}

_monotonic_ns = _REAL_NS["monotonic"]
_real_gettime_ns = copy_of(time.clock_gettime_ns)


def clock_call(
    guard: Guard,
    frame: FrameType,
    call: str,
    virtual: Callable[[int], Any],
    real: Callable[[], Any],
    real_ns: Callable[[], int] | None = None,
) -> Any:
    """Answer a read of a clock as the job says; ``real_ns`` is read if it is recorded."""
    module = frame.f_globals.get("__name__")
    if module in REAL_TIME_MODULES:
        if (
            module != "subprocess"
            or guard.mode(NondeterminismSource.PROCESS, frame) is not GuardMode.RECORD
        ):
            return real()
        if guard.context.is_aside():
            return virtual(guard.context.now_ns())
        return virtual(
            guard.record(
                NondeterminismSource.PROCESS, f"{call} of subprocess", _monotonic_ns, frame
            )
        )
    mode = guard.mode(_CLOCK, frame)
    if mode is _VIRTUAL:
        kind = FILE_OWNERS[code_of(frame).co_filename]
        return virtual(guard.clock_ns(call, kind, frame.f_globals, frame))
    if mode is GuardMode.ALLOW:
        return real()
    if mode is GuardMode.RECORD:
        if real_ns is None:
            real_ns = next((read for name, read in _REAL_NS.items() if name in call), _wall_ns)
        return virtual(guard.record(NondeterminismSource.CLOCK, call, real_ns, frame))
    value = real()
    guard.report(NondeterminismSource.CLOCK, mode, call, value, frame)
    return value


_READERS = ("time", "monotonic", "perf_counter", "process_time", "thread_time")


def _seconds(now_ns: int) -> float:
    return now_ns / _NS


def _nanoseconds(now_ns: int) -> int:
    return now_ns


def _reading(name: str, real: Callable[[], Any]) -> Callable[[dict[str, Any]], Any]:
    call, in_ns = f"time.{name}()", name.endswith("_ns")
    virtual: Callable[[int], Any] = _nanoseconds if in_ns else _seconds

    def read(names: dict[str, Any]) -> Any:
        guard = engaged()
        if guard is None:
            return real()
        frame = None
        try:
            kind = guard.kinds[names["__file__"]]
        except (KeyError, TypeError):
            frame = caller()
            kind = guard.file_kind(names, frame)
        if kind > OURS or not guard.answers_clocks:
            if frame is None:
                try:
                    frame = frames.next_caller()
                except frames.INTERRUPTED:
                    frame = frames.lost_caller()
            if not guard.answers_clocks or names.get("__name__") in REAL_TIME_MODULES:
                return clock_call(guard, frame, call, virtual, real)
        now_ns = guard.clock_ns(call, kind, names, frame)
        return now_ns if in_ns else now_ns / _NS

    return read


def _clock_gettime(name: str, virtual: Callable[[int], Any], real: Callable[..., Any]) -> Any:
    def read(*arguments: Any) -> Any:
        guard = engaged()
        value = real(*arguments)  # raises for a clock that does not exist
        if guard is None:
            return value
        return clock_call(
            guard,
            caller(),
            f"time.{name}()",
            virtual,
            lambda: value,
            lambda: _real_gettime_ns(*arguments),
        )

    return read


def _broken_down(name: str, real: Callable[..., Any]) -> Any:
    """``localtime()`` and the like: without an argument, or with None, they mean now."""

    def read(*arguments: Any) -> Any:
        guard = engaged() if arguments in ((), (None,)) else None
        if guard is None:
            return real(*arguments)
        return clock_call(
            guard, caller(), f"time.{name}()", lambda now_ns: real(now_ns // _NS), real
        )

    return read


def _formatting(
    name: str, given: int, real: Callable[..., Any], localtime: Callable[..., Any]
) -> Any:
    """``strftime(format)`` and ``asctime()``: without the last argument they mean now."""

    def read(*arguments: Any) -> Any:
        guard = engaged() if len(arguments) == given else None
        if guard is None:
            return real(*arguments)
        return clock_call(
            guard,
            caller(),
            f"time.{name}()",
            lambda now_ns: real(*arguments, localtime(now_ns // _NS)),
            lambda: real(*arguments),
        )

    return read


def _now(real: Any) -> Any:
    def now(cls: type[datetime], tz: Any = None) -> datetime:
        guard, bound = engaged(), real.__get__(None, cls)
        if guard is None:
            return bound(tz)  # type: ignore[no-any-return]
        return _datetime(guard, cls, "now", tz, lambda: bound(tz), caller())

    return now


def _utcnow(real: Any) -> Any:
    def utcnow(cls: type[datetime]) -> datetime:
        guard, bound = engaged(), real.__get__(None, cls)
        if guard is None:
            return bound()  # type: ignore[no-any-return]
        found = _datetime(guard, cls, "utcnow", timezone.utc, bound, caller())
        return found.replace(tzinfo=None)

    return utcnow


def _datetime(
    guard: Guard,
    cls: type[datetime],
    name: str,
    tz: Any,
    real: Callable[[], datetime],
    frame: FrameType,
) -> datetime:
    """Answer a class method of ``datetime`` that was called at ``frame``."""

    def virtual(now_ns: int) -> datetime:
        whole = cls.fromtimestamp(now_ns // _NS, tz)
        return whole.replace(microsecond=now_ns % _NS // 1000)

    return clock_call(guard, frame, f"datetime.{name}()", virtual, real)  # type: ignore[no-any-return]


def numpy_now(function: Any, text: str, *more: Any) -> Any:
    """Answer ``np.datetime64("now")`` in user modules; numpy itself asks the C library."""
    real = function(text, *more)
    guard = engaged()
    if guard is None:
        return real
    return clock_call(
        guard,
        caller(),
        f"datetime64({text!r})",
        lambda now_ns: function(now_ns, "ns").astype(real.dtype),
        lambda: real,
    )


def opencv_clock(stack: ExitStack) -> None:
    """Redirect the clock of OpenCV, which is loaded: its unit is a nanosecond."""

    def reading(real: Callable[[], Any]) -> Any:
        def read() -> Any:
            guard = engaged()
            if guard is None:
                return real()
            return clock_call(guard, caller(), "cv2.getTickCount()", lambda ns: ns, real)

        return read

    redirect(stack, sys.modules["cv2"].getTickCount, reading)


@contextmanager
def virtual_clocks() -> Iterator[None]:
    """Redirect every clock."""
    with ExitStack() as stack:

        def redirect_time(name: str, make: Callable[[Any], Any], how: Any = redirect) -> None:
            function = getattr(time, name, None)
            if isinstance(function, BuiltinFunctionType):
                how(stack, function, make)

        for name in (*_READERS, *(f"{name}_ns" for name in _READERS)):
            redirect_time(name, partial(_reading, name), redirect_reader)
        localtime = copy_of(time.localtime)
        redirect_time(
            "clock_gettime", lambda real: _clock_gettime("clock_gettime", lambda ns: ns / _NS, real)
        )
        redirect_time(
            "clock_gettime_ns", lambda real: _clock_gettime("clock_gettime_ns", lambda ns: ns, real)
        )
        for name in ("localtime", "gmtime", "ctime"):
            redirect_time(name, partial(_broken_down, name))
        redirect_time("strftime", lambda real: _formatting("strftime", 1, real, localtime))
        redirect_time("asctime", lambda real: _formatting("asctime", 0, real, localtime))
        bound_before = _bound_before("now", "utcnow")
        for name, make in (("now", _now), ("utcnow", _utcnow)):
            _replace_method(stack, name, make, bound_before[name])
        yield


def _replace_method(
    stack: ExitStack,
    name: str,
    make: Callable[[Any], Any],
    bound_before: list[BuiltinFunctionType],
) -> None:
    """Replace a class method of ``datetime``, in the type and where it was bound before."""
    real = datetime.__dict__[name]
    ours = make(real)
    for bound in bound_before:
        target = ours.__get__(bound.__self__)
        stack.callback(Redirected(bound, target).restore)
    set_member(datetime, name, classmethod(ours))
    stack.callback(set_member, datetime, name, real)


def _bound_before(*names: str) -> dict[str, list[BuiltinFunctionType]]:
    """Return the bound class methods that code keeps (``now = datetime.now``), by name."""
    found: dict[str, list[BuiltinFunctionType]] = {name: [] for name in names}
    owners = [datetime]
    for owner in owners:
        owners += type.__subclasses__(owner)
    for obj in gc.get_referrers(*owners):
        if type(obj) is BuiltinFunctionType and obj.__name__ in found:
            found[obj.__name__].append(obj)
    return found
