"""The compiled end of an event, and the compiled send, do what the Python does."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import traceback
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rsltrace.compiled import core
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.timer_queue import timer_queue
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher, PythonEventEnd
from rsltrace.simulation.middleware.events.observer import (
    EventCall,
    EventObserver,
    ObserverOrder,
)
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.simulation.middleware.publisher import Publisher, Transport
from rsltrace.simulation.middleware.qos.policies import DEFAULT_QOS, History
from rsltrace.simulation.middleware.subscription import Subscription
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

ROOT = Path(__file__).resolve().parents[2]
needs_core = pytest.mark.skipif(core is None, reason="no compiler has built rsltrace._core")


class Breaking(EventObserver):
    """Raises after an event, and as the state of a node, when it is told to."""

    order = ObserverOrder.CENSUS
    breaks = ""

    def after_event(self) -> None:
        if self.breaks == "observer":
            raise RuntimeError("the observer breaks")

    def state_hash(self) -> int:
        if self.breaks == "state":
            raise RuntimeError("the state breaks")
        return 7


class Asking(EventObserver):
    """Rejects every third event."""

    order = ObserverOrder.EDITS
    asked = 0

    def before_event(self, call: EventCall) -> bool:
        self.asked += 1
        return self.asked % 3 > 0


class Handler:
    """Notes what callbacks raise, and what Python says is being handled meanwhile."""

    def __init__(self) -> None:
        self.log: list[Any] = []

    def raised(self, error: BaseException, handle: Any) -> None:
        assert sys.exc_info()[1] is error
        places = [frame.name for frame in traceback.extract_tb(error.__traceback__)]
        of_python = [place for place in places if place not in ("execute", "end_event")]
        self.log.append((type(error), handle, type(error.__context__), of_python))
        if isinstance(error, LookupError):
            raise error


class OtherQueue(deque[Any]):
    """As a wait set puts in place of a queue."""


class Run:
    """A publisher with subscriptions that keep one message, three, and all."""

    def __init__(self, *, compiled: bool, recorded: bool) -> None:
        self.compiled = compiled
        self.loop = EventLoop(start_ns=5, timers=timer_queue("creation"))
        self.dispatcher = Dispatcher(self.loop)
        self.handler: Any = Handler()
        self.dispatcher.exception_handler = self.handler
        self.node = Participant(self.dispatcher, "node", "/", self.handler)
        self.asking = Asking()
        self.observer = Breaking()
        self.dispatcher.add_observer(self.observer)
        type_: Any = SimpleNamespace(
            name="std_msgs/msg/String", describe=lambda: ("string data", "")
        )
        transport = Transport(self.dispatcher)
        if recorded:
            self.dispatcher.record(
                Recorder(TraceWriter(None, force=False), keep_payload=lambda topic: True)
            )
        self.publisher = Publisher(transport, self.node, "/topic", type_, DEFAULT_QOS)
        self.subscriptions = [
            Subscription(self.dispatcher, self.node, "/topic", type_, qos)
            for qos in (
                replace(DEFAULT_QOS, depth=1),
                replace(DEFAULT_QOS, depth=3),
                replace(DEFAULT_QOS, history=History.KEEP_ALL),
            )
        ]
        self.subscriptions[2].queue = OtherQueue()
        for subscription in self.subscriptions:
            self.publisher.connect(subscription)

    def execute(self, *call: Any) -> None:
        if self.compiled:
            self.dispatcher.execute(*call)
        else:
            PythonEventEnd.execute(self.dispatcher, *call)

    def run_event(self, rng: random.Random) -> None:
        """Run a callback that may raise, run another event, or leave something for the end."""
        what = rng.choice(["", "", "raise", "nest", "end", "steal"])
        error = rng.choice([ValueError, KeyError, SystemExit, KeyboardInterrupt, StopIteration])
        data, log = rng.randbytes(9), self.handler.log
        nested = (None, 0, None, 2, lambda *args: log.append(args), (1, 2), 0, 0, 5)

        def callback(*args: Any) -> None:
            log.append(args)
            self.publisher.send(data)
            if what == "raise":
                try:
                    raise OSError
                except OSError:
                    raise error("it breaks")  # noqa: B904
            elif what == "nest":
                self.execute(*nested)
            elif what == "end":
                self.dispatcher.event.on_end = lambda: log.append("end")
            elif what == "steal":
                del self.dispatcher.event.on_end

        is_steered = rng.random() < 0.3
        if is_steered:
            self.dispatcher.add_observer(self.asking)
        args = rng.choice([(), (1,), (1, "2")])
        decided = rng.choice([(), (), (True,), (0,)])
        try:
            self.execute("handle", 3, self.node, 3, callback, args, 1, 2, 7, *decided)
        except (AttributeError, LookupError) as error_:
            log.append((type(error_), str(error_).split("'")[-2:][0][:6]))
            self.dispatcher.event.on_end = None
        finally:
            if is_steered:
                self.dispatcher.remove_observer(self.asking)

    def step(self, rng: random.Random) -> Any:
        """Do something; return its outcome and the state of everything."""
        self.loop.now_ns += rng.randrange(3)
        for subscription in self.subscriptions:
            subscription.active = rng.random() < 0.8
        self.observer.breaks = rng.choice(["", "", "", "observer", "state"])
        state: Any = SimpleNamespace(after_event=self.observer.state_hash)
        self.node.state = rng.choice([None, state])
        event = self.dispatcher.event
        event.node = rng.choice([None, self.node])
        event.flags, event.quiet = rng.choice([(0, False), (1, True)])
        data, given = rng.randbytes(rng.randrange(300)), rng.choice([(), (None,), (1 << 63,)])
        outcome: Any = None
        try:
            if rng.random() < 0.4:
                self.run_event(rng)
            elif rng.random() < 0.5:
                (self.publisher.send if self.compiled else self.publisher.send_any)(data, *given)
            elif self.compiled:
                self.dispatcher.end_event()
            else:
                PythonEventEnd.end_event(self.dispatcher)
        except RuntimeError as error:
            outcome = str(error)
        if rng.random() < 0.1:
            self.subscriptions[2].queue.clear()
        recorder = self.dispatcher.recorder
        return (
            outcome,
            [list(subscription.queue) for subscription in self.subscriptions],
            [self.subscriptions.index(ready) for ready in self.loop.ready],  # type: ignore[arg-type]
            {
                (self.subscriptions.index(receiver), held): count
                for (receiver, held), count in self.dispatcher.outcome.drops.items()
            },
            (self.loop.events, self.loop.activity_ns, self.dispatcher.unrecorded),
            (event.flags, event.quiet, self.publisher._count),
            (event.handle, event.entity, event.kind, event.cause_event, event.cause_output),
            (event.input_hash, event.on_end is None, list(self.handler.log), self.asking.asked),
            None if recorder is None else (recorder.index, recorder.chain_hash, recorder.outputs),
            None if recorder is None else recorder.writer._buffer.rows(),
        )


@needs_core
@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_a_run_does_the_same_compiled(seed: int, recorded: bool) -> None:
    ours, python = (Run(compiled=it, recorded=recorded) for it in (True, False))
    dice = random.Random(seed), random.Random(seed)
    for _ in range(300):
        assert ours.step(dice[0]) == python.step(dice[1])


@needs_core
def test_what_is_no_part_of_a_run_is_refused() -> None:
    run = Run(compiled=True, recorded=False)
    del run.publisher._count
    with pytest.raises(AttributeError, match="_count"):
        run.publisher.send(b"")
    run.dispatcher.loop = None  # type: ignore[assignment]
    with pytest.raises(TypeError, match="a part of the run"):
        run.dispatcher.end_event()


@needs_core
def test_a_run_leaves_no_memory_behind() -> None:
    code = (
        "import gc, random, resource, weakref\n"
        "from tests.middleware.test_compiled import Run\n"
        "def go(times):\n"
        "    run = Run(compiled=True, recorded=True)\n"
        "    dice = random.Random(1)\n"
        "    for number in range(times):\n"
        "        run.step(dice) if number % 50 == 0 else run.publisher.send(bytes(9))\n"
        "        run.observer.breaks = ''\n"
        "        run.dispatcher.end_event()\n"
        "        run.dispatcher.execute('handle', 1, None, 3, len, ('x',), 0, 0, 0)\n"
        "        run.subscriptions[2].queue.clear()\n"
        "        run.loop.ready.clear()\n"
        "        buffer = run.dispatcher.recorder.writer._buffer\n"
        "        buffer.clear_rows(), buffer.payloads.clear()\n"
        "        run.dispatcher.outcome.drops.clear()\n"
        "    gone = [weakref.ref(one) for one in (run.loop, run.publisher, run.dispatcher)]\n"
        "    del run, buffer\n"
        "    gc.collect()\n"
        "    assert not any(one() for one in gone), 'a cycle stays'\n"
        "    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "first = go(3000)\n"
        "assert go(30000) - first < 500, 'KiB'\n"
    )
    subprocess.run([sys.executable, "-X", "dev", "-c", code], cwd=ROOT, check=True)


@needs_core
def test_garbage_that_publishes_while_a_message_is_sent_is_harmless() -> None:
    code = (
        "import gc\n"
        "from tests.middleware.test_compiled import Run\n"
        "run = Run(compiled=True, recorded=False)\n"
        "run.publisher._count = 10**6\n"
        "class Garbage:\n"
        "    def __init__(self):\n"
        "        self.itself = self\n"
        "    def __del__(self):\n"
        "        run.publisher.send(b'')\n"
        "kept = []\n"
        "gc.set_threshold(1)\n"
        "for _ in range(500):\n"
        "    Garbage()\n"
        "    run.publisher.send(b'')\n"
        "    kept += run.subscriptions[2].queue\n"
        "    run.subscriptions[2].queue.clear()\n"
        "gc.collect()\n"
        "kept += run.subscriptions[2].queue\n"
        "assert len(kept) == 1000\n"
        "assert all(10**6 < delivery[-1] <= 10**6 + 1000 for delivery in kept)\n"
    )
    subprocess.run([sys.executable, "-X", "dev", "-c", code], cwd=ROOT, check=True)


@needs_core
@pytest.mark.parametrize("compiled", ["1", "0"])
def test_what_rclpy_would_not_copy_is_not_copied(compiled: str) -> None:
    code = (
        "import copy\n"
        "from tests.middleware.test_compiled import Run\n"
        "run = Run(compiled=False, recorded=False)\n"
        "for entity in (run.publisher, run.node, run.subscriptions[0]):\n"
        "    try:\n"
        "        print(copy.copy(entity))\n"
        "    except TypeError as error:\n"
        "        print(error)\n"
    )
    environment = {**os.environ, "RSLTRACE_COMPILED": compiled}
    words = [sys.executable, "-c", code]
    said = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True).stdout
    assert said.splitlines() == [
        f"cannot pickle '{name}' object" for name in ("Publisher", "Participant", "Subscription")
    ]
