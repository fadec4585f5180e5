"""pygame's clock and waits: it asks SDL in C, and here they take simulated time as Python's do."""

from __future__ import annotations

import operator
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from rsltrace.guard.frames import caller
from rsltrace.guard.guard import engaged
from rsltrace.guard.redirect import replace_attribute
from rsltrace.guard.virtual.clocks import clock_call

_FRAMES = 10
"""After how many frames pygame counts anew how many there are in a second."""


def _ticks_of(real: Callable[[], int]) -> Callable[[], int]:
    def get_ticks() -> int:
        """Return the milliseconds since the run began."""
        guard = engaged()
        if guard is None:
            return real()
        call = "pygame.time.get_ticks()"
        found: int = clock_call(guard, caller(), call, lambda ns: ns // 1_000_000, real)
        return found

    return get_ticks


def _wait_of(real: Callable[[int], int]) -> Callable[[int], int]:
    def wait(milliseconds: int) -> int:
        """Wait in simulated time; return the milliseconds that passed."""
        if engaged() is None:
            return real(milliseconds)
        for_ms = max(operator.index(milliseconds), 0)
        time.sleep(for_ms / 1000)
        return for_ms

    return wait


def _clock_type(ticks: Callable[[], int]) -> type:
    class Clock:
        """Times the frames of a game, as ``pygame.time.Clock`` does."""

        def __init__(self) -> None:
            self._last_ms = ticks()
            self._passed_ms = self._raw_ms = 0
            self._frames, self._since_ms, self._fps = 0, 0, 0.0

        def tick(self, framerate: float = 0) -> int:
            """Wait until it is time for the next frame; return the ms since the last one."""
            self._raw_ms = ticks() - self._last_ms
            if framerate:
                time.sleep(max(int(1000 / framerate) - self._raw_ms, 0) / 1000)
            now_ms = ticks()
            self._passed_ms, self._last_ms = now_ms - self._last_ms, now_ms
            if not framerate:
                self._raw_ms = self._passed_ms
            self._frames += 1
            if not self._since_ms:
                self._frames, self._since_ms = 0, now_ms
            elif self._frames >= _FRAMES and now_ms > self._since_ms:
                self._fps = self._frames * 1000 / (now_ms - self._since_ms)
                self._frames, self._since_ms = 0, now_ms
            return self._passed_ms

        tick_busy_loop = tick

        def get_time(self) -> int:
            """Return the ms between the last two frames."""
            return self._passed_ms

        def get_rawtime(self) -> int:
            """Return the ms that the last frame took without waiting."""
            return self._raw_ms

        def get_fps(self) -> float:
            """Return how many frames there are in a second."""
            return self._fps

    return Clock


def pygame_clock(stack: ExitStack) -> None:
    """Put pygame, which is loaded, on simulated time until ``stack`` ends."""
    pygame: Any = sys.modules["pygame"]
    ticks = _ticks_of(pygame.time.get_ticks)
    replace_attribute(stack, pygame.time, "get_ticks", ticks)
    for name in ("wait", "delay"):
        replace_attribute(stack, pygame.time, name, _wait_of(getattr(pygame.time, name)))
    clock = _clock_type(ticks)
    for owner in (pygame.time, pygame):
        if hasattr(owner, "Clock"):  # pygame-ce has it in both
            replace_attribute(stack, owner, "Clock", clock)


__all__ = ["pygame_clock"]
