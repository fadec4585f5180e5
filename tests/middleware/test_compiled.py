"""The compiled end of an event, and the compiled send, do what the Python does."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import traceback
from collections import deque
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rsltrace.compiled import core
from rsltrace.simulation.chance.channel import (
    LinkModel,
    LinkOutage,
    NameRule,
    NetworkPlan,
    OutageRule,
)
from rsltrace.simulation.chance.distribution import Constant, Uniform
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.stop import Stop, stop_after_events, stop_at
from rsltrace.simulation.loop.timer_queue import TimerState, timer_queue
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher, EventEnd, PythonEventEnd
from rsltrace.simulation.middleware.events.observer import EventCall, EventObserver, ObserverOrder
from rsltrace.simulation.middleware.links import Network, fast_send
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
            if not hasattr(self.dispatcher.event, "on_end"):  # something else has been raised first
                self.dispatcher.event.on_end = None
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


class PythonLoop(EventLoop):
    next_arrival = EventLoop.python_next_arrival
    run_arrivals = EventLoop.python_run_arrivals
    run_ready = EventLoop.python_run_ready


class DelayedRun:
    """Two topics with delays; each message is answered by messages of both."""

    def __init__(self, seed: int, *, compiled: bool) -> None:
        self.rng = rng = random.Random(seed)
        start_ns = rng.choice([5, 2**63 - 500])
        self.loop = (EventLoop if compiled else PythonLoop)(
            start_ns=start_ns,
            timers=timer_queue(rng.choice(["creation", "heap"])),
            stop_conditions=(
                stop_at(start_ns + rng.randrange(3000), "the end"),
                stop_after_events(300),
            )[: rng.randrange(3)],
        )
        self.loop.min_step_ns = rng.choice([0, 0, 0, 7])
        self.dispatcher = Dispatcher(self.loop)
        handler: Any = None
        self.node = Participant(self.dispatcher, "node", "/", handler)
        if rng.random() < 0.7:
            self.dispatcher.record(
                Recorder(TraceWriter(None, force=False), keep_payload=lambda topic: True)
            )
        type_: Any = SimpleNamespace(
            name="std_msgs/msg/String", describe=lambda: ("string data", "")
        )
        transport = Transport(self.dispatcher)
        delays = Uniform(0, rng.choice([1, 30])), Constant(0), Constant(10), None
        models = [
            LinkModel(
                rng.choice(delays),
                drop=rng.choice([0.0, 0.0, 0.2]),
                duplicate=rng.choice([0.0, 0.0, 0.2]),
                keep_order=rng.random() < 0.8,
            )
            for _ in range(2)
        ]
        outage = LinkOutage(start_ns + 100, start_ns + 160)
        plan = NetworkPlan(
            topics=tuple(NameRule(f"/{i}", model) for i, model in enumerate(models)),
            outages=(OutageRule("topic", "/0", outage),) if rng.random() < 0.2 else (),
            seed=seed,
            start_ns=start_ns,
        )
        transport.network = Network(self.dispatcher, plan)
        self.publishers = [
            Publisher(transport, self.node, f"/{i}", type_, DEFAULT_QOS) for i in range(2)
        ]
        self.log: list[Any] = []
        self.subscriptions = []
        for topic, publisher in enumerate(self.publishers):
            for number in range(2):
                depth = rng.choice([1, 2, 10])
                subscription = Subscription(
                    self.dispatcher,
                    self.node,
                    f"/{topic}",
                    type_,
                    replace(DEFAULT_QOS, depth=depth),
                    partial(self.got, 2 * topic + number),
                )
                publisher.connect(subscription)
                self.subscriptions.append(subscription)
            for link in publisher.links or ():
                is_compiled = getattr(link.send, "__name__", "") == "send_delayed"
                if is_compiled and not compiled:
                    link.send = fast_send(self.dispatcher, link, link._delay)
        self.send = [one.send if compiled else one.send_any for one in self.publishers]
        self.loop.ready.append(Acting(self))

    def got(self, number: int, data: bytes) -> None:
        self.log.append((self.loop.now_ns, self.loop.events, number, data))
        self.act(len(data))

    def act(self, size: int) -> None:
        """Do some of what a callback may do."""
        rng, loop = self.rng, self.loop
        if loop.events < 300:
            for _ in range(rng.choice([0, 1, 1, 2])):
                self.send[rng.randrange(2)](rng.randbytes(size % 50 + 1))
        what = rng.random()
        if what < 0.02:
            loop.schedule(loop.now_ns + rng.randrange(20), lambda: self.log.append("action"))
        elif what < 0.04:
            loop.schedule(loop.now_ns + 3, lambda: loop.ready.append(Acting(self)))
        elif what < 0.06:
            loop.tasks.append(Acting(self))
        elif what < 0.08:
            timer = TimerState(rng.choice([0, 9]), loop.now_ns, order=loop.events, owner=None)
            timer.owner = Once(self, timer)
            loop.timers.add(timer)
        elif what < 0.1:
            self.dispatcher.event.busy_ns = rng.choice([0, 8])
        elif what < 0.11:
            rng.choice(self.subscriptions).destroy()
        elif what < 0.14:
            one = rng.choice(self.subscriptions)
            one.active = not one.active
        elif what < 0.143:
            loop.stop(Stop("stopped"))
        elif what < 0.146:
            loop.now_ns += 15  # as if it had waited

    def outcome(self) -> Any:
        try:
            stop: Any = self.loop.run()
        except OverflowError as error:  # numbers have 64 bits
            stop = str(error)
        recorder = self.dispatcher.recorder
        return (
            stop,
            self.log,
            (self.loop.now_ns, self.loop.events, self.loop.activity_ns, self.loop.looks_at),
            sorted(self.dispatcher.outcome.drops.values()),
            [release[:3] for release in sorted(self.loop.scheduled)],
            [link.last_ns for one in self.publishers for link in one.links or ()],
            None if recorder is None else recorder.writer._buffer.rows(),
        )


class Acting:
    """Something ready that is no message."""

    def __init__(self, run: DelayedRun) -> None:
        self.run = run

    def dispatch(self) -> None:
        self.run.dispatcher.execute(self, 0, None, 0, self.run.act, (3,), 0, 0, 0)

    def describe(self) -> str:
        return "acting"


class Once(Acting):
    def __init__(self, run: DelayedRun, timer: TimerState) -> None:
        self.run, self.timer = run, timer

    def dispatch(self) -> None:
        self.run.loop.timers.remove(self.timer)
        super().dispatch()


@needs_core
def test_delays_do_the_same_compiled() -> None:
    messages = 0
    for seed in range(150):
        ours, python = (DelayedRun(seed, compiled=it).outcome() for it in (True, False))
        assert ours == python, seed
        messages += len(ours[1])
    assert messages > 3000


@needs_core
def test_a_broken_link_or_loop_is_refused() -> None:
    """Whatever is missing, or replaced while it is used, there is an error and no crash."""
    names = (
        *("subscription", "_loop", "_dispatcher", "last_ns", "send", "_delay", "_arrives"),
        *("tasks", "idle", "scheduled", "timers", "places", "gate", "min_step_ns", "looks_at"),
        *("_until_events", "_quiet_ns", "ready", "now_ns", "events", "_interrupt"),
    )
    for name in names:
        for broken in (None, object(), 3, [1], [()], [(1, 2)], iter(()), "x"):
            for late in (False, True):
                run = DelayedRun(4, compiled=True)  # all its links only delay
                link: Any = (run.publishers[0].links or [])[0]
                assert link.send.__name__ == "send_delayed"
                owner = link if hasattr(link, name) else run.loop

                def break_it(owner: Any = owner, name: str = name, to: Any = broken) -> int:
                    setattr(owner, name, to) if to is not None else delattr(owner, name)
                    return 0

                if late:
                    link._delay = lambda leaves_ns, do=break_it: do()
                else:
                    break_it()
                for publisher in run.publishers:
                    with suppress(Exception):
                        publisher.send(b"1")
                        publisher.send(b"2")
                with suppress(Exception):
                    run.loop._until_events, run.loop._quiet_ns = 1000, 2**63
                for _ in range(5):
                    with suppress(Exception):
                        run.loop.next_arrival()
                    with suppress(Exception):
                        run.loop.run_ready(run.loop.events + 1)
    del run.loop._quiet_ns
    with pytest.raises(AttributeError, match="_quiet_ns"):
        run.loop.next_arrival()
    with pytest.raises(AttributeError, match="_quiet_ns"):
        run.loop.run_ready(9)


@needs_core
def test_an_arrival_that_takes_the_time_away_is_an_error() -> None:
    run = DelayedRun(4, compiled=True)
    loop: Any = run.loop
    loop.scheduled.clear()

    class Ready(deque[Any]):
        def popleft(self) -> Any:
            del loop.now_ns
            return super().popleft()

    def arrives(release: object) -> None:
        loop.ready = Ready([run.subscriptions[0]])

    loop.tasks.clear()
    loop.ready.clear()
    loop._until_events, loop._quiet_ns, loop.min_step_ns = 1000, 2**63, 0
    loop.schedule(loop.now_ns + 1, lambda: None)
    ((at_ns, order, place, *_),) = loop.scheduled
    loop.scheduled[:] = [(at_ns, order, place, arrives)]
    with pytest.raises(AttributeError, match="now_ns"):
        loop.run_arrivals(0)


@pytest.mark.parametrize(
    ("args", "name"), [((), "call_back"), ((1,), "call_back_with"), ((1, 2), "call_back")]
)
@pytest.mark.parametrize("end", [EventEnd, PythonEventEnd])
def test_a_callback_finds_the_same_frame_above_it_compiled_or_not(
    end: Any, args: tuple[int, ...], name: str
) -> None:
    found: list[Any] = []

    def callback(*given: int) -> None:
        found.extend((given, sys._getframe(1).f_code.co_name))

    end.execute(DelayedRun(4, compiled=True).dispatcher, None, 0, None, 0, callback, args, 0, 0, 0)
    assert found == [args, name]


@needs_core
@pytest.mark.parametrize("ties", ["creation", "heap"])
def test_an_arrival_alone_is_not_left_to_python(ties: str) -> None:
    run = DelayedRun(4, compiled=True)
    loop: Any = run.loop
    loop.timers = timer_queue(ties)
    loop.python_next_arrival = lambda: pytest.fail("it is left to Python")
    loop.ready.clear()
    loop._until_events, loop._quiet_ns, loop.min_step_ns = 1000, 2**63, 0
    for link in run.publishers[0].links or ():
        link._delay = lambda leaves_ns: 7
    run.publishers[0].send(b"1")
    assert loop.scheduled
    assert loop.next_arrival() in (*run.subscriptions, None)


@needs_core
def test_what_a_link_raises_comes_out_of_send() -> None:
    run = DelayedRun(4, compiled=True)
    publisher = run.publishers[0]
    publisher.send(b"it opens the channel")
    link: Any = (publisher.links or [])[0]
    link._delay = lambda leaves_ns: 1 // 0
    with pytest.raises(ZeroDivisionError):
        publisher.send(b"1")


class Looking(int):
    """A number that acts when somebody computes with it, or nobody needs it any more."""

    act: Any = None

    def look(self, *_: object) -> Any:
        act, self.act = self.act, None
        if act is not None:
            with suppress(AttributeError):
                act()
        return NotImplemented

    __add__ = __radd__ = __lt__ = __gt__ = __ne__ = __del__ = look
    __hash__ = int.__hash__

    def __bool__(self) -> bool:
        return self.look() is None


@needs_core
def test_a_field_that_goes_while_another_is_looked_at_is_no_crash() -> None:
    code = (
        "from contextlib import suppress\n"
        "from tests.middleware.test_compiled import DelayedRun, Looking\n"
        "def parts_of(seed):\n"
        "    run = DelayedRun(seed, compiled=True)\n"
        "    publisher = run.publishers[0]\n"
        "    publisher.send(b'it opens the channel')\n"
        "    run.loop._until_events, run.loop._quiet_ns = 1000, 2**63\n"
        "    run.loop.ready.clear()\n"
        "    return run.dispatcher.event, run.loop, publisher, run.dispatcher, publisher.links[0]\n"
        "looked_at = list(enumerate(('busy_ns', 'now_ns', '_count', 'unrecorded', 'last_ns')))\n"
        "gone = [\n"
        "    (1, 'scheduled timers now_ns events ready places'),\n"
        "    (2, 'links subscriptions _count entity_id _channel'),\n"
        "    (4, 'subscription _loop _dispatcher last_ns _delay _arrives'),\n"
        "]\n"
        "for seed in (3, 5):\n"
        "    for number, field in looked_at:\n"
        "        for owner, names in gone:\n"
        "            for name in names.split():\n"
        "                parts = parts_of(seed)\n"
        "                looking = Looking(getattr(parts[number], field))\n"
        "                looking.act = lambda: delattr(parts[owner], name)\n"
        "                setattr(parts[number], field, looking)\n"
        "                del looking\n"
        "                with suppress(AttributeError, TypeError, SystemError):\n"
        "                    parts[2].send(b'1')\n"
        "                with suppress(AttributeError, TypeError):\n"
        "                    parts[1].next_arrival()\n"
    )
    subprocess.run([sys.executable, "-X", "dev", "-c", code], cwd=ROOT, check=True)


@needs_core
def test_a_run_leaves_no_memory_behind() -> None:
    code = (
        "import gc, random, weakref\n"
        "from pathlib import Path\n"
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
        "        buffer.clear_rows(), buffer.take_payloads()\n"
        "        run.dispatcher.outcome.drops.clear()\n"
        "    gone = [weakref.ref(one) for one in (run.loop, run.publisher, run.dispatcher)]\n"
        "    del run, buffer\n"
        "    gc.collect()\n"
        "    assert not any(one() for one in gone), 'a cycle stays'\n"
        "    return int(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])\n"
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
