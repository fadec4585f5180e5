"""The order in which the loop runs things, against a model that states it naively."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.errors import LivelockError
from rsltrace.simulation.loop.loop import ORDER_BAG, EventLoop
from rsltrace.simulation.loop.ordered import OrderedLoop, ReadyItem
from rsltrace.simulation.loop.policy import Candidate
from rsltrace.simulation.loop.stop import Progress, Stop, stop_after_events, stop_at
from rsltrace.simulation.loop.timer_queue import CreationOrderQueue, TimerState
from tests.tiers import cases


class Item:
    """Something to dispatch: appends its name to a log, then does ``then``."""

    def __init__(
        self, loop: EventLoop, log: list[object], name: str, then: Callable[[], None] | None = None
    ) -> None:
        self.loop, self.log, self.name, self.then = loop, log, name, then

    def dispatch(self) -> None:
        self.loop.events += 1
        self.log.append((self.loop.now_ns, self.name))
        if self.then is not None:
            self.then()

    def describe(self) -> str:
        return self.name


class Tick(Item):
    """A periodic timer's owner."""

    def __init__(
        self,
        loop: EventLoop,
        log: list[object],
        name: str,
        period: int,
        order: int,
        then: Callable[[], None] | None = None,
    ) -> None:
        super().__init__(loop, log, name, then)
        self.state = TimerState(period, loop.now_ns, order=order, owner=self)
        loop.timers.add(self.state)

    def dispatch(self) -> None:
        self.state.call(self.loop.now_ns)
        super().dispatch()
        self.loop.timers.ran(self.state)


def make_loop(**options: object) -> EventLoop:
    return EventLoop(start_ns=0, timers=CreationOrderQueue(), **options)  # type: ignore[arg-type]


def test_tasks_go_before_ready_events_and_both_before_the_next_timer() -> None:
    loop = make_loop(stop_conditions=(stop_at(10, "end"),))
    log: list[object] = []

    def work() -> None:
        loop.ready.append(Item(loop, log, "ready"))
        loop.tasks.append(Item(loop, log, "task 1"))
        loop.tasks.append(Item(loop, log, "task 2"))

    Tick(loop, log, "first", 10, 0, work)
    Tick(loop, log, "second", 10, 1)
    assert loop.run() == Stop("end")
    assert log == [(10, n) for n in ("first", "task 1", "task 2", "ready", "second")]


def test_releases_come_before_timers_and_bag_messages_before_other_releases() -> None:
    loop = make_loop(stop_conditions=(stop_at(10, "end"),))
    log: list[object] = []
    Tick(loop, log, "timer", 10, 0)
    for name, order in (("late", 1), ("bag", ORDER_BAG), ("later", 1)):
        item = Item(loop, log, name)
        loop.schedule(10, lambda item=item: loop.ready.append(item), order=order)  # type: ignore[misc]
    loop.run()
    assert [name for _, name in log] == ["bag", "late", "later", "timer"]  # type: ignore[misc]


def test_the_stop_condition_is_asked_between_steps_only() -> None:
    asked: list[Progress] = []

    def condition(progress: Progress) -> Stop | None:
        asked.append(progress)
        return Stop("enough") if progress.events >= 2 else None

    loop = make_loop(stop_conditions=(condition,))
    log: list[object] = []
    for order in range(3):
        Tick(loop, log, f"t{order}", 5, order)
    loop.run()
    assert [entry[0] for entry in log] == [5, 5, 5]  # type: ignore[index]
    assert [(p.now_ns, p.next_ns, p.events) for p in asked] == [(0, 5, 0), (5, 10, 3)]


def test_stop_ends_at_once_and_stop_after_step_does_not() -> None:
    for method, count in (("stop", 1), ("stop_after_step", 3)):
        loop = make_loop()
        log: list[object] = []
        end = getattr(loop, method)
        Tick(loop, log, "a", 5, 0, lambda end=end: end(Stop("said so")))  # type: ignore[misc]
        Tick(loop, log, "b", 5, 1)
        Tick(loop, log, "c", 5, 2)
        assert loop.run() == Stop("said so")
        assert len(log) == count


def test_what_is_due_after_the_end_of_time_never_is() -> None:
    log: list[str] = []
    conditions: list[object] = [(), (lambda progress: None,), (stop_at(2**64, "end"),)]
    for stop_conditions in conditions:
        for pause_events in (0, 1000):
            loop = make_loop(stop_conditions=stop_conditions, between_steps=lambda: pause_events)  # noqa: B023
            loop.schedule(1, lambda: log.append("first"))
            loop.schedule(2**63 - 1, lambda: log.append("last"))
            loop.schedule(2**63, lambda: log.append("too late"))
            assert loop.run() == Stop("what is due next is beyond 2**63 ns, where ROS's time ends")
            assert loop.now_ns == 2**63 - 1
    assert log == ["first", "last"] * 6


def test_a_gate_or_least_step_that_a_callback_sets_counts_at_once() -> None:
    log: list[object] = []
    loop = make_loop(between_steps=lambda: 1000)

    def gate(next_ns: int | None) -> bool:
        log.append(next_ns)
        return False

    def shut() -> None:
        loop.gate = gate

    def step() -> None:
        loop.gate, loop.min_step_ns = None, 10

    for time_ns, action in ((1, lambda: None), (2, shut), (3, step), (4, lambda: None)):
        loop.schedule(time_ns, action)
        loop.schedule(time_ns, lambda: log.append(loop.now_ns))
    loop.schedule(4, lambda: None)
    loop.run()
    assert log == [1, 2, 3, 3, 13]


def test_the_step_at_the_stop_time_runs_whatever_else_is_asked() -> None:
    loop = make_loop(stop_conditions=(stop_after_events(1000), stop_at(10, "end")))
    log: list[object] = []
    Tick(loop, log, "a", 5, 0)
    assert loop.run() == Stop("end")
    assert log == [(5, "a"), (10, "a")]


@pytest.mark.parametrize("ordered", [False, True])
def test_those_who_poll_look_again_until_nothing_comes_of_it(ordered: bool) -> None:
    loop = ordered_loop() if ordered else make_loop()
    log: list[object] = []

    def poll() -> bool:
        log.append("look")
        if log.count("look") <= 2:
            loop.ready.append(Item(loop, log, "came"))
            return True
        return False

    loop.idle.append(poll)
    loop.idle.append(lambda: bool(log.append("and")))
    loop.schedule(7, lambda: loop.ready.append(Item(loop, log, "first")))
    loop.schedule(9, lambda: loop.idle.clear())
    assert loop.run() == Stop("nothing left to do")
    at_start = ["look", "and", (0, "came"), "look", "and", (0, "came"), "look", "and"]
    assert log == [*at_start, (7, "first"), "look", "and"]


def ordered_loop() -> OrderedLoop:
    loop = OrderedLoop(start_ns=0, timers=CreationOrderQueue())
    loop.place = lambda item: ReadyItem(Candidate("/n", "e", "task", 1, None, (), item), None, None)
    return loop


def test_nothing_left_to_do() -> None:
    assert make_loop().run() == Stop("nothing left to do")


def test_a_livelock_names_those_who_keep_it_going() -> None:
    loop = make_loop(livelock_limit=50)
    log: list[object] = []
    ping = Item(loop, log, "ping", lambda: loop.ready.append(pong))
    pong = Item(loop, log, "pong", lambda: loop.ready.append(ping))
    loop.schedule(7, lambda: loop.ready.append(ping))
    with pytest.raises(
        LivelockError, match=r"0\.000000007 s after 50 events.*(ping; pong|pong; ping)"
    ):
        loop.run()


def test_a_long_but_finite_instant_is_no_livelock() -> None:
    loop = make_loop(livelock_limit=50)
    log: list[object] = []
    loop.ready.extend(Item(loop, log, str(i)) for i in range(49))
    loop.run()
    assert len(log) == 49


@st.composite
def worlds(draw: st.DrawFn) -> tuple[list[tuple[int, list[int]]], list[tuple[int, int]]]:
    """Timers with a period each and delays of what they publish; releases from outside."""
    timers = draw(
        st.lists(st.tuples(st.integers(1, 9), st.lists(st.integers(0, 6), max_size=3)), max_size=5)
    )
    outside = draw(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 1)), max_size=8))
    return timers, outside


@settings(max_examples=cases(30, 200))
@given(worlds())
def test_the_loop_runs_what_the_specification_says(
    world: tuple[list[tuple[int, list[int]]], list[tuple[int, int]]],
) -> None:
    timers, outside = world
    end = 40
    loop = make_loop(stop_conditions=(stop_at(end, "end"),))
    log: list[object] = []

    def publish(name: str, delays: list[int]) -> None:
        for number, delay in enumerate(delays):
            item = Item(loop, log, f"{name}.{number}")
            if delay == 0:
                loop.ready.append(item)
            else:
                loop.schedule(loop.now_ns + delay, lambda item=item: loop.ready.append(item))  # type: ignore[misc]

    for order, (period, delays) in enumerate(timers):
        name = f"t{order}"
        Tick(loop, log, name, period, order, lambda n=name, d=delays: publish(n, d))  # type: ignore[misc]
    for number, (time, order) in enumerate(outside):
        item = Item(loop, log, f"o{number}")
        loop.schedule(time, lambda item=item: loop.ready.append(item), order=order)  # type: ignore[misc]
    loop.run()
    assert log == reference(timers, outside, end)


def reference(
    timers: list[tuple[int, list[int]]], outside: list[tuple[int, int]], end: int
) -> list[tuple[int, str]]:
    """The specification, written as slowly and plainly as possible: one nanosecond at a time."""
    log: list[tuple[int, str]] = []
    releases = [(t, order, n, f"o{n}") for n, (t, order) in enumerate(outside)]
    count = len(outside)
    deadlines = [period for period, _ in timers]
    for now in range(end + 1):
        ready: list[str] = []
        due = sorted(r for r in releases if r[0] == now)
        releases = [r for r in releases if r[0] != now]
        ready += [name for *_, name in due]
        while True:
            if ready:
                log.append((now, ready.pop(0)))
                continue
            fire = [i for i, d in enumerate(deadlines) if d == now]
            if not fire:
                break
            first = fire[0]
            period, delays = timers[first]
            deadlines[first] += period
            log.append((now, f"t{first}"))
            for number, delay in enumerate(delays):
                if delay == 0:
                    ready.append(f"t{first}.{number}")
                else:
                    count += 1
                    releases.append((now + delay, 1, count, f"t{first}.{number}"))
    return log


def test_events_are_counted_for_the_stop_condition() -> None:
    loop = make_loop(stop_conditions=(stop_after_events(4),))
    log: list[object] = []
    Tick(loop, log, "t", 3, 0)
    assert loop.run() == Stop("4 events")
    assert loop.now_ns == 12
