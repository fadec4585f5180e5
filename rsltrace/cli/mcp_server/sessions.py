"""Debugging sessions of traces: kept between calls, since going back in one is quick."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from rsltrace.cli.mcp_server.access import Access, RefusedError
from rsltrace.debug.client import DebugSession
from rsltrace.errors import RsltraceError

_SESSIONS_MAX = 2
_PAUSE_S = 0.1

_T = TypeVar("_T")
_Key = tuple[Path, int, int]


class Sessions:
    """The sessions of a server. Only with trust: a session runs nodes."""

    def __init__(self, access: Access) -> None:
        self._access = access
        self._open: dict[_Key, DebugSession] = {}
        self._busy = threading.Lock()
        self._current: threading.Event | None = None
        """Set when the call that has the lock is given up."""

    async def use(self, trace: Path, do: Callable[[DebugSession], _T]) -> _T:
        """Return what ``do`` returns of the session of a trace; it runs in a thread.

        If the call is cancelled or takes too long, the run pauses, and the session stays.

        :raises RefusedError: without trust, or if it takes too long.
        """
        self._access.require_trust()

        given_up = threading.Event()

        def work() -> _T:
            with self._busy:
                if given_up.is_set():
                    raise RefusedError("this was given up before its turn")
                self._current = given_up
                try:
                    return do(self._session(trace))
                finally:
                    self._current = None

        try:
            return await asyncio.wait_for(_in_thread(work), self._access.limit_s)
        except asyncio.TimeoutError:
            self._give_up(given_up)
            raise RefusedError(
                f"this takes more than {self._access.limit_s:g} s and was ended. Go to an earlier "
                "event, or have the server started with a greater --limit."
            ) from None
        except asyncio.CancelledError:
            self._give_up(given_up)
            raise

    def close(self) -> None:
        """End all sessions with their processes."""
        for key in list(self._open):
            self._open.pop(key).close()

    def _session(self, trace: Path) -> DebugSession:
        found = trace.stat()
        key = (trace, found.st_mtime_ns, found.st_size)
        session = self._open.pop(key, None)
        if session is not None:
            try:
                _ = session.position
            except RsltraceError:  # its processes have ended
                session.close()
                session = None
        while session is None and len(self._open) >= _SESSIONS_MAX:
            self._open.pop(next(iter(self._open))).close()
        self._open[key] = session or DebugSession(trace, trust=True)
        return self._open[key]

    def _give_up(self, given_up: threading.Event) -> None:
        """End a call: if it is its turn, pause its run, and whatever it runs after that."""
        given_up.set()

        def pause() -> None:
            while self._current is given_up:
                for session in list(self._open.values()):
                    with suppress(RsltraceError):
                        session.pause()
                time.sleep(_PAUSE_S)

        threading.Thread(target=pause, name="rsltrace pause", daemon=True).start()


def _in_thread(work: Callable[[], _T]) -> asyncio.Future[_T]:
    """Run ``work`` in a thread that does not keep the server from ending, as a pool's would."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[_T] = loop.create_future()

    def settle(result: _T | None, error: BaseException | None) -> None:
        if future.done():
            return
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result, failed = None, None
        try:
            result = work()
        except BaseException as error:
            failed = error
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(settle, result, failed)

    threading.Thread(target=run, name="rsltrace session", daemon=True).start()
    return future
