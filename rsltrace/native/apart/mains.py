"""A main, a script or a module as a process of its own has it, observed."""

from __future__ import annotations

import builtins
import signal
import sys
import time
from collections.abc import Callable
from functools import wraps
from types import ModuleType
from typing import Any

from rsltrace.adapters.rclpy.entry import Entry
from rsltrace.native.apart.observers import Observers
from rsltrace.native.executors import failure_of
from rsltrace.native.ledger import Callback
from rsltrace.native.things import Thing
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind


class RunningMain:
    """Runs the main of an entry. What it does between its callbacks is its own events."""

    def __init__(self, entry: Entry, observers: Observers, *, echo: bool) -> None:
        self._entry = entry
        self._observers = observers
        self._words = [word for part in entry.arguments[:1] for word in part.arguments]
        if not echo:
            self._words += ["--ros-args", "--disable-stdout-logs"]
        self._callback: Callback | None = None
        self._is_over = False

    def is_constructed(self) -> bool:
        """Return whether it has waited or spun for the first time, or has ended."""
        callback = self._callback
        return self._is_over or (callback is not None and callback.span is None)

    def run(self) -> None:
        """Run it to its end; what it raises comes out. SIGINT interrupts it from now on."""
        ledger, things, entry = self._observers.ledger, self._observers.things, self._entry
        self._callback = callback = ledger.begin(int(EventKind.CONSTRUCT), None)
        thing = things.add((), None, EntityKind.MAIN, entry.name, runs=entry.make)
        callback.thing = thing
        if callback.span is not None:
            callback.span.thing = thing
        self._become_main(thing)
        failure = None
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            status = entry.make()
            if status is not None:  # a console script is sys.exit(main())
                raise SystemExit(status)
        except (SystemExit, KeyboardInterrupt):
            raise
        except BaseException as error:
            failure = failure_of(error)
            raise
        finally:
            ledger.end(failure)
            self._is_over = True

    def _become_main(self, thing: Thing) -> None:
        """Have this process be what ``ros2 run`` would have started."""
        import rclpy.clock
        import rclpy.context
        import rclpy.timer

        main = ModuleType("__main__")
        vars(main).update(__builtins__=builtins, __annotations__={})
        sys.modules["__main__"] = main
        sys.argv = list(self._entry.argv or [self._entry.name])
        self._observers.nodes.main = self._entry
        context: Any = rclpy.context.Context
        context.init = self._with_words(context.init)
        for owner, name in (
            (time, "sleep"),
            (rclpy.timer.Rate, "sleep"),
            (rclpy.clock.Clock, "sleep_until"),
        ):
            setattr(owner, name, self._pausing(getattr(owner, name), thing))

    def _with_words(self, original: Callable[..., None]) -> Callable[..., None]:
        """Add the ROS arguments of the entry to those of ``rclpy.init``."""

        @wraps(original)
        def init(context: Any, args: Any = None, **more: Any) -> None:
            given = sys.argv if args is None else args
            original(context, [*given, *self._words], **more)

        return init

    def _pausing(self, original: Callable[..., Any], thing: Thing) -> Callable[..., Any]:
        """Let an event of the main end where it sleeps."""

        @wraps(original)
        def sleep(*words: Any, **more: Any) -> Any:
            self._observers.ledger.pause(thing)
            return original(*words, **more)

        return sleep
