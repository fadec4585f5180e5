"""Waiting for several descriptors: ``select``, ``poll``, ``epoll``, and so ``selectors``, asyncio.

A ready descriptor is recorded by its position among those waited for: a re-run has other numbers.
Nothing is recorded if all of them are the run's own.
"""

from __future__ import annotations

import select
import selectors
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any

from rsltrace.guard.descriptor_table import number_of
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.recorded.descriptors import recording_guard
from rsltrace.guard.redirect import redirect, replace_attribute
from rsltrace.guard.waiting import NOT_YET, wait_recorded, wait_unrecorded, waiting_guard
from rsltrace.trace.model.finding import NondeterminismSource

_RECORDED = (NondeterminismSource.SOCKET, NondeterminismSource.PROCESS, NondeterminismSource.FILE)
_ALL_EVENTS = select.POLLIN | select.POLLPRI | select.POLLOUT
_real_epoll = getattr(select, "epoll", None)  # Linux has it


def _recording(frame: FrameType) -> tuple[Guard, NondeterminismSource] | None:
    for source in _RECORDED:
        guard = recording_guard(source, frame)
        if guard is not None:
            return guard, source
    return None


def _answer(
    guard: Guard,
    source: NondeterminismSource,
    call: str,
    real: Callable[[float | None], list[Any]],
    frame: FrameType,
    timeout_s: float | None,
    number: int,
    step: Callable[[int], object] | None = None,
) -> list[Any]:
    """Return what is ready; a thread lets others run while nothing is."""
    if timeout_s == 0 or (step is None and not guard.context.is_aside()):
        return list(guard.record(source, call, lambda: real(timeout_s), frame, number) or ())

    def look(seconds: float) -> Any:
        return real(seconds) or NOT_YET

    return (
        wait_recorded(
            guard, source, call, look, frame, number=number, timeout_s=timeout_s, step=step
        )
        or []
    )


class RecordedPoll:
    """A ``select.poll`` or ``select.epoll`` object whose answers are recorded."""

    def __init__(
        self, real: Any, source: NondeterminismSource | None, *, seconds: bool, mask: int
    ) -> None:
        self._real = real
        self._source = source
        self._seconds = seconds
        self._mask = mask
        self._registered: dict[int, int] = {}
        self.step: Callable[[int], object] | None = None
        """Lets time pass where an asyncio loop waits; True ends the wait."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def __enter__(self) -> RecordedPoll:
        return self

    def __exit__(self, *error: object) -> None:
        self._real.close()

    def register(self, fd: Any, eventmask: int | None = None) -> None:
        """Add a descriptor."""
        mask = self._mask if eventmask is None else eventmask
        self._real.register(fd, mask)
        self._registered[number_of(fd)] = mask

    def modify(self, fd: Any, eventmask: int) -> None:
        """Change the events of a descriptor."""
        self._real.modify(fd, eventmask)
        self._registered[number_of(fd)] = eventmask

    def unregister(self, fd: Any) -> None:
        """Remove a descriptor."""
        self._registered.pop(number_of(fd), None)
        self._real.unregister(fd)

    def has_outside(self) -> bool:
        """Return whether a descriptor leads outside of the run."""
        guard = engaged()
        if guard is None or self._source is None:
            return False
        return any(map(guard.descriptors.is_outside, self._registered))

    def leads_out(self) -> bool:
        """Return whether something outside may make a descriptor ready, recorded or not."""
        guard = engaged()
        return guard is not None and any(map(guard.descriptors.leads_out, self._registered))

    def poll(self, timeout: float | None = None, maxevents: int = -1) -> list[tuple[int, int]]:
        """Return the ready descriptors with their events."""
        limits = (maxevents,) if self._seconds else ()
        guard = engaged()
        frame = _past_selectors(sys._getframe(1))
        unit = 1 if self._seconds else 1000
        timeout_s = None if timeout is None or timeout < 0 else timeout / unit
        if guard is None or self._source is None or not self.has_outside():
            patient = guard if self.step else waiting_guard(frame)
            if timeout_s == 0:
                patient = None
            if patient is None:
                return self._real.poll(timeout, *limits)  # type: ignore[no-any-return]
            return (
                wait_unrecorded(
                    patient,
                    lambda seconds: self._real.poll(seconds * unit, *limits) or NOT_YET,
                    frame,
                    timeout_s,
                    self.step,
                )
                or []
            )
        places = list(self._registered)

        def real(seconds: float | None) -> list[Any]:
            ready = self._real.poll(None if seconds is None else seconds * unit, *limits)
            return [[places.index(fd), events] for fd, events in ready if fd in places]

        found = _answer(
            guard,
            self._source,
            "select.poll()",
            real,
            frame,
            timeout_s,
            guard.descriptors.number(self),
            self.step,
        )
        return [(places[place], events) for place, events in found if place < len(places)]


def _past_selectors(frame: FrameType) -> FrameType:
    """Return the frame that uses a selector."""
    while frame.f_back is not None and frame.f_globals.get("__name__") == "selectors":
        frame = frame.f_back
    return frame


def _polling(real: Callable[[], Any]) -> Any:
    def poll() -> Any:
        if engaged() is None:
            return real()
        found = _recording(sys._getframe(1))
        source = None if found is None else found[1]
        return RecordedPoll(real(), source, seconds=False, mask=_ALL_EVENTS)

    return poll


def _epolling(sizehint: int = -1, flags: int = 0) -> Any:
    assert _real_epoll is not None
    if engaged() is None:
        return _real_epoll(sizehint, flags)
    found = _recording(sys._getframe(1))
    source = None if found is None else found[1]
    mask = select.EPOLLIN | select.EPOLLPRI | select.EPOLLOUT
    return RecordedPoll(_real_epoll(sizehint, flags), source, seconds=True, mask=mask)


def _selecting(real: Callable[..., Any]) -> Any:
    def ready(reads: Any, writes: Any, others: Any, timeout: float | None = None, /) -> Any:
        guard = engaged()
        if guard is None:
            return real(reads, writes, others, timeout)
        kinds = [list(reads), list(writes), list(others)]
        if timeout is not None and timeout > 0 and not any(kinds):
            time.sleep(timeout)  # it is used like that
            return [], [], []
        frame = sys._getframe(1)
        found = _recording(frame)
        objects = [obj for kind in kinds for obj in kind]
        if found is None or not any(map(guard.descriptors.is_outside, objects)):
            patient = None if timeout == 0 else waiting_guard(frame)
            if patient is None:
                return real(*kinds, timeout)

            def look(seconds: float) -> Any:
                ready = real(*kinds, seconds)
                return ready if any(ready) else NOT_YET

            return wait_unrecorded(patient, look, frame, timeout) or ([], [], [])

        def places(seconds: float | None) -> list[Any]:
            chosen = real(*kinds, seconds)
            one_by_one = [
                [place for place, obj in enumerate(kind) if any(obj is c for c in some)]
                for kind, some in zip(kinds, chosen, strict=True)
            ]
            return one_by_one if any(one_by_one) else []

        number = _number(guard, objects)
        answer = _answer(guard, found[1], "select.select()", places, frame, timeout, number)
        return tuple(
            [kind[place] for place in some if place < len(kind)]
            for kind, some in zip(kinds, answer or ([], [], []), strict=True)
        )

    return ready


def _number(guard: Guard, objects: list[Any]) -> int:
    """Return the number of the first outside descriptor: two threads rarely wait for the same."""
    for obj in objects:
        known = guard.descriptors.find(obj)
        if known is not None:
            return known.number
        if guard.descriptors.is_outside(obj):
            return 0 if isinstance(obj, int) else guard.descriptors.number(obj)
    return 0


@contextmanager
def recorded_polls() -> Iterator[None]:
    """Record which descriptors become ready; in a re-run, return it from the trace."""
    with ExitStack() as stack:
        redirect(stack, select.poll, _polling)
        redirect(stack, select.select, _selecting)
        if _real_epoll is not None:
            replace_attribute(stack, select, "epoll", _epolling)
            selector = selectors.EpollSelector
            replace_attribute(stack, selector, "_selector_cls", staticmethod(_epolling))
        yield
