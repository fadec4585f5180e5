"""curses reads keys in C: who waits for one waits in simulated time before that."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from rsltrace.adapters.rclpy.terminals.no_terminal import refuse
from rsltrace.adapters.rclpy.terminals.terminal import Terminal
from rsltrace.guard.extension_types import exchange
from rsltrace.guard.redirect import redirect

_READS = ("getch", "getkey", "get_wch", "getstr")
_NS_PER_MS = 1_000_000
_FOR_EVER = -1
_NO_KEY = -1

Asking = Callable[[], "Terminal | None"]
"""Returns the terminal of the main whose code runs."""


Showing = Callable[[Terminal, bool], None]
"""Makes a terminal the main's standard output, or no longer."""


@contextmanager
def simulated_curses(asking: Asking, show: Showing) -> Iterator[None]:
    """Let windows of curses wait in simulated time within the ``with`` block."""
    try:
        import _curses
    except ImportError:  # Python can be built without it
        yield
        return
    limits_ms: dict[int, int] = {}
    all_ms = [_FOR_EVER]
    limit = _curses.window.timeout
    with ExitStack() as stack:
        for name in _READS:
            making = partial(_reading, asking, limits_ms, all_ms, limit)
            exchange(stack, _curses.window, name, making)
        exchange(stack, _curses.window, "refresh", partial(_drained, asking))
        exchange(stack, _curses.window, "nodelay", partial(_limiting, limits_ms, _of_nodelay))
        exchange(stack, _curses.window, "timeout", partial(_limiting, limits_ms, int))
        redirect(stack, _curses.doupdate, partial(_drained, asking))
        redirect(stack, _curses.halfdelay, partial(_halving, all_ms))
        for function in (_curses.setupterm, _curses.initscr):
            redirect(stack, function, partial(_beginning, asking, show))
        redirect(stack, _curses.endwin, partial(_ending, asking, show))
        yield


def _beginning(asking: Asking, show: Showing, real: Callable[..., Any]) -> Callable[..., Any]:
    def begin(*arguments: Any, **options: Any) -> Any:
        terminal = asking()
        if terminal is None:
            refuse(f"curses.{real.__name__}()")
        else:
            show(terminal, True)
        return real(*arguments, **options)

    return begin


def _ending(asking: Asking, show: Showing, real: Callable[[], Any]) -> Callable[[], Any]:
    def end() -> Any:
        try:
            return real()
        finally:
            terminal = asking()
            if terminal is not None:
                terminal.drain()
                show(terminal, False)

    return end


def _drained(asking: Asking, real: Any) -> Any:
    """Let something be shown, which is for nobody to see."""

    def shown(*arguments: Any) -> Any:
        terminal = asking()
        if terminal is not None:
            terminal.drain()
        return real(*arguments)

    return shown


def _reading(
    asking: Asking, limits_ms: dict[int, int], all_ms: list[int], limit: Any, real: Any
) -> Any:
    name = real.__name__

    def read(self: Any, *arguments: Any) -> Any:
        terminal = asking()
        if terminal is None:
            refuse(f"curses: {name}()")
            return real(self, *arguments)
        terminal.drain()
        limit_ms = limits_ms.get(id(self), all_ms[0])
        if name != "getstr" and not terminal.offer():
            limit(self, 0)
            found = _taken_already(partial(real, self, *arguments))
            limit(self, limit_ms)
            if found is not None:
                return found
        if limit_ms == 0:
            terminal.look()
        else:
            terminal.await_input(None if limit_ms < 0 else limit_ms * _NS_PER_MS)
        return real(self, *arguments)

    return read


def _taken_already(get: Callable[[], Any]) -> Any:
    """Return a key that curses has read before (of an escape sequence that means nothing to it),
    or None."""
    import _curses

    try:
        found = get()
    except _curses.error:
        return None
    return None if found == _NO_KEY else found


def _limiting(limits_ms: dict[int, int], to_ms: Callable[[Any], int], real: Any) -> Any:
    def limit(self: Any, value: Any) -> Any:
        limits_ms[id(self)] = to_ms(value)
        return real(self, value)

    return limit


def _of_nodelay(flag: Any) -> int:
    return 0 if flag else _FOR_EVER


def _halving(all_ms: list[int], real: Callable[[int], Any]) -> Callable[[int], Any]:
    def halfdelay(tenths: int, /) -> Any:
        all_ms[0] = tenths * 100
        return real(tenths)

    return halfdelay
