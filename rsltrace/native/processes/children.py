"""The processes of a native run, as the run sees them: started, listened to, and ended."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rsltrace.child_processes import kill_group, start_connected
from rsltrace.errors import JobError
from rsltrace.native.processes.wire import EntryOrder, Frame, Link
from rsltrace.native.support import Patience

_MAIN = "rsltrace.native.processes.child"
_LOOK_S = 0.2
_LOOK_AT_PROGRAMS_S = 0.05
_HEARS_WITHIN_S = 1.0
"""One that is another program by now, or keeps the interpreter, does not."""
_REAPED_WITHIN_S = 10.0
"""A process that was killed, or has closed its socket, is gone after a moment."""


@dataclass(frozen=True, slots=True)
class ProcessStart:
    """What to start as a process: whose it is, what it does there, and its surroundings.

    ``respawn`` is how much later (ns) it starts again, and how often (None: always); ``may_fail``
    says that the run goes on if it is killed; ``required`` that the run ends with it; ``loads``
    that it has a container load a component.
    """

    name: str
    key: str
    order: EntryOrder
    environment: Mapping[str, str]
    folder: Path | None
    is_main: bool
    respawn: tuple[int, int | None] | None = None
    may_fail: bool = False
    required: bool = False
    loads: bool = False


class ObservedProcess(threading.Thread):
    """One process, and the thread that listens to it.

    ``told`` gets its frames, ``ended`` its exit status (negative: the signal that killed it).
    """

    def __init__(
        self,
        start: ProcessStart,
        told: Callable[[ObservedProcess, Frame], None],
        ended: Callable[[ObservedProcess, int], None],
    ) -> None:
        super().__init__(name=f"rsltrace {start.name}", daemon=True)
        self.what = start
        self.is_ready = threading.Event()
        """It could begin, or it has ended."""
        self.is_over = False
        self.has_begun = False
        self.has_failed = False
        """Whether it has said itself what went wrong."""
        self.has_told_all = False
        self.forks = 0
        self.is_stopping = False
        self.has_heard = threading.Event()
        """It tells all at once, as it is about to end, or has ended."""
        self.is_stuck, self.stuck_at = False, ""
        self.exit_text = ""
        self._told = told
        self._ended = ended
        try:
            self._process, here = start_connected(
                _MAIN, env=dict(start.environment), cwd=start.folder, start_new_session=True
            )
        except OSError as error:
            raise JobError(f"{start.name} cannot be started: {error.strerror}") from error
        self.number = self._process.pid
        self._link = Link(here)
        try:
            with suppress(BrokenPipeError, ConnectionResetError):  # has ended: that is noticed
                self._link.send(start.order)
        except Exception as error:
            self.kill()
            self._process.wait()
            here.close()
            raise JobError(
                f"the job cannot be given to the process of {start.name} ({error}): name functions "
                "and classes of modules in it"
            ) from error
        here.settimeout(_LOOK_S)
        self.start()

    def run(self) -> None:
        has_ended = False
        while True:
            try:
                frame = self._link.receive()
                if frame is None:
                    break
                self._told(self, frame)
            except TimeoutError:
                if has_ended:  # what it has started holds the socket
                    break
                has_ended = self._process.poll() is not None
            except Exception as error:
                self.exit_text = f"what it sent cannot be read: {error}"
                self.kill()
                break
        status = self._status()
        self.kill()  # what it has left behind
        self.is_over = True
        self._ended(self, status)
        self.has_heard.set()
        self.is_ready.set()
        self._link.close()

    def _status(self) -> int:
        if self.what.order.command or (self.has_begun and not self.has_told_all):
            # it has let go of the socket: to become something else, or with all that it had open
            while (status := self._process.poll()) is None:
                self._told(self, ("look",))
                time.sleep(_LOOK_AT_PROGRAMS_S)
            return status

        def wait(seconds: float) -> None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(seconds)

        if not Patience(_REAPED_WITHIN_S).wait(wait, lambda: self._process.poll() is not None):
            self.kill()
        return self._process.wait()

    def go(self) -> None:
        """Let it begin."""
        self.has_begun = True
        with suppress(OSError):  # has ended
            self._link.send("go")

    def stop(self) -> None:
        """Tell it to end. ``interrupt`` has to follow."""
        self.is_stopping = True
        if not self.is_ready.is_set():  # it is being started again
            self.has_begun = False
            self.kill()
            return
        with suppress(OSError):
            self._link.send("stop")

    def interrupt(self) -> None:
        """Tell it to end as ``ros2 launch`` does, if it is a main: once it tells all at once."""
        if not (self.what.is_main and self.has_begun):
            return
        if self.what.order.command:
            self._signal_all(signal.SIGINT)
        else:
            Patience(_HEARS_WITHIN_S).wait(self.has_heard.wait, self.has_heard.is_set)
            self._process.send_signal(signal.SIGINT)

    def terminate(self) -> None:
        """Tell a program that has not ended once more."""
        if self.what.order.command:
            self._signal_all(signal.SIGTERM)

    def _signal_all(self, number: int) -> None:
        """Send a signal to the process and all that it has started, as a terminal does."""
        with suppress(ProcessLookupError):
            os.killpg(self.number, number)

    def kill(self) -> None:
        kill_group(self._process.pid)
