"""The two tie rules, and rcl's timer arithmetic."""

from __future__ import annotations

import heapq

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.simulation.loop.timer_queue import (
    NEVER_NS,
    ZERO_PERIOD_NS,
    CreationOrderQueue,
    HeapOrderQueue,
    TimerState,
    timer_queue,
)

PERIODS = st.integers(min_value=1, max_value=7)


def timer(period: int, order: int, now: int = 0) -> TimerState:
    return TimerState(period, now, order=order, owner=order)


def test_deadlines_stay_on_their_grid_and_missed_periods_are_skipped() -> None:
    state = timer(100, 0)
    state.call(100)
    assert state.deadline_ns == 200
    state.call(455)  # late by two periods and a half
    assert state.deadline_ns == 500
    state.call(500)
    assert state.deadline_ns == 600


def test_an_overdue_timer_fires_once_even_on_a_grid_point() -> None:
    # RSLCPP's nodes are built at 0 and start at 10 s: their next deadline lies after 10 s.
    state = timer(100, 0)
    state.call(1000)
    assert state.deadline_ns == 1100


def test_a_timer_called_before_it_is_due_skips_to_the_deadline_after() -> None:
    state = timer(100, 0)
    state.call(30)
    assert state.deadline_ns == 200


def test_a_timer_without_period_is_due_at_once_and_then_every_millisecond() -> None:
    state = timer(0, 0)
    assert state.deadline_ns == 0
    state.call(5)
    assert state.deadline_ns == ZERO_PERIOD_NS
    state.call(ZERO_PERIOD_NS)
    assert state.deadline_ns == 2 * ZERO_PERIOD_NS
    state.reset(ZERO_PERIOD_NS)  # in its callback: not again at the same instant
    assert state.deadline_ns == 2 * ZERO_PERIOD_NS
    state.reset(9 * ZERO_PERIOD_NS)
    assert state.deadline_ns == 9 * ZERO_PERIOD_NS


def test_a_negative_period_is_refused() -> None:
    with pytest.raises(ValueError, match="negative"):
        timer(-1, 0)


def test_an_unknown_rule_is_refused() -> None:
    with pytest.raises(ValueError, match="fifo"):
        timer_queue("fifo")


def run(queue: CreationOrderQueue | HeapOrderQueue, steps: int) -> list[tuple[int, int]]:
    fired = []
    for _ in range(steps):
        first = queue.head
        assert first is not None
        fired.append((first.deadline_ns, first.order))
        first.call(first.deadline_ns)
        queue.ran(first)
    return fired


@given(st.lists(PERIODS, min_size=1, max_size=12))
def test_creation_order_is_the_order_of_deadline_and_creation(periods: list[int]) -> None:
    queue = CreationOrderQueue()
    for order, period in enumerate(periods):
        queue.add(timer(period, order))
    expected: list[tuple[int, int, int]] = [(p, o, p) for o, p in enumerate(periods)]
    heapq.heapify(expected)
    want = []
    for _ in range(60):
        deadline, order, period = heapq.heappop(expected)
        want.append((deadline, order))
        heapq.heappush(expected, (deadline + period, order, period))
    assert run(queue, 60) == want


@given(st.lists(PERIODS, min_size=1, max_size=12))
def test_heap_order_fires_the_same_timers_at_the_same_times(periods: list[int]) -> None:
    queues = [CreationOrderQueue(), HeapOrderQueue()]
    for queue in queues:
        for order, period in enumerate(periods):
            queue.add(timer(period, order))
    a, b = (run(queue, 60) for queue in queues)
    assert [time for time, _ in a] == [time for time, _ in b]
    last = a[-1][0]  # the last instant may be cut off in the middle
    assert sorted(e for e in a if e[0] < last) == sorted(e for e in b if e[0] < last)


@pytest.mark.parametrize("ties", ["creation", "heap"])
def test_a_callback_may_start_a_timer_that_is_due_before_all_others(ties: str) -> None:
    queue = timer_queue(ties)
    root, *others = (timer(period, order) for order, period in enumerate((50, 53, 55)))
    for each in (root, *others):
        queue.add(each)
    root.call(50)
    queue.add(timer(60, 3, now=-59))
    queue.ran(root)
    assert [order for _, order in run(queue, 4)] == [3, 1, 2, 3]


def test_heap_order_is_that_of_libstdcxx() -> None:
    # Four timers of one period: traced by hand through push_heap, and the push_back, pop_heap,
    # pop_back that rclcpp's TimersManager does when its root has run.
    queue = HeapOrderQueue()
    for order in range(4):
        queue.add(timer(10, order))
    assert [order for _, order in run(queue, 8)] == [0, 2, 1, 3, 0, 3, 2, 1]


@given(
    st.lists(st.tuples(st.sampled_from("arRcm"), st.integers(0, 5), st.integers(1, 9)), max_size=40)
)
@pytest.mark.parametrize("ties", ["creation", "heap"])
def test_first_is_always_a_timer_with_the_smallest_deadline(
    ties: str, operations: list[tuple[str, int, int]]
) -> None:
    queue = timer_queue(ties)
    timers = [timer(order + 1, order) for order in range(6)]
    inside: set[int] = set()
    for operation, index, value in operations:
        state = timers[index]
        if operation == "a":
            queue.add(state)
            inside.add(index)
        elif operation == "c":
            queue.remove(state)
            inside.discard(index)
        elif operation == "m" and index in inside:
            state.deadline_ns += value
            queue.moved(state)
        elif operation in "rR":
            first = queue.head
            if first is not None:
                first.call(first.deadline_ns)
                if operation == "R":  # its callback starts another timer, which is due before it
                    state.deadline_ns = min(state.deadline_ns, first.deadline_ns) - value
                    queue.add(state)
                    inside.add(index)
                queue.ran(first)
        first = queue.head
        assert queue.next_ns == (NEVER_NS if first is None else first.deadline_ns)
        if not inside:
            assert first is None
        else:
            assert first is not None
            assert first.order in inside
            assert first.deadline_ns == min(timers[i].deadline_ns for i in inside)


@given(
    st.lists(st.tuples(st.integers(0, 20), st.integers(0, 3)), max_size=30),
    st.integers(0, 20),
    st.sampled_from(["creation", "heap"]),
)
def test_due_gives_all_that_are_due_in_order_and_the_next(
    entries: list[tuple[int, int]], now_ns: int, ties: str
) -> None:
    queue = timer_queue(ties)
    timers = []
    for order, (deadline_ns, change) in enumerate(entries):
        timer = TimerState(deadline_ns, 0, order=order, owner=None)
        queue.add(timer)
        if change == 1:
            queue.remove(timer)
            continue
        if change == 2:  # leaves a stale entry behind
            timer.reset(5)
            queue.add(timer)
        timers.append(timer)
    due, after = queue.due(now_ns)
    timers.sort(key=lambda timer: (timer.deadline_ns, timer.order))
    assert due == [timer for timer in timers if timer.deadline_ns <= now_ns]
    later = [timer for timer in timers if timer.deadline_ns > now_ns]
    assert after is (later[0] if later else None)
