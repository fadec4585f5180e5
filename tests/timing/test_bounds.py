"""Bounds of response times: numbers that others have published, and what is unbounded."""

from __future__ import annotations

from fractions import Fraction
from itertools import accumulate

import pytest

from rsltrace.native.timing.bounds import bounds
from rsltrace.native.timing.system import (
    PROCESSOR,
    Arrivals,
    CallbackKey,
    ChainTask,
    ExecutorModel,
    ExecutorOrder,
    Supply,
    TaskSystem,
)


def task(
    name: str,
    wcet: int,
    arrivals: Arrivals | None = None,
    parent: int | None = None,
    *,
    executor: str = "e",
    kind: str = "subscription",
    urgency: float = 0,
    place: int = 0,
    count: int = 1,
) -> ChainTask:
    callback = CallbackKey("/n", kind, name)
    return ChainTask(
        callback, executor, wcet, arrivals, parent, 0, count, urgency=urgency, place=(place,)
    )


def found(tasks: list[ChainTask], **executors: ExecutorModel) -> list[int | None]:
    return [one.ns for one in bounds(TaskSystem(tuple(tasks), executors))]


def preemptive(times: list[tuple[int, int]]) -> list[int | None]:
    """Bounds of tasks (execution time, period) on one processor, the first most urgent."""
    tasks = [task(f"t{n}", c, Arrivals(t), executor=f"e{n}") for n, (c, t) in enumerate(times)]
    above = {
        f"e{n}": ExecutorModel(above=frozenset(f"e{m}" for m in range(n)))
        for n in range(len(tasks))
    }
    return found(tasks, **above)


def test_preemptive_priorities_as_in_the_textbook() -> None:
    """Burns and Wellings, Real-Time Systems and Programming Languages: task set C, 3, 6, 20."""
    assert preemptive([(3, 7), (3, 12), (5, 20)]) == [3, 6, 20]
    assert preemptive([(10, 30), (10, 40), (12, 52)]) == [10, 20, 52]


def test_what_takes_longer_than_its_period_delays_the_next_one() -> None:
    """Lehoczky 1990: C = 26, 62; T = 70, 100. The fifth of the seven jobs takes longest: 118."""
    assert preemptive([(26, 70), (62, 100)]) == [26, 118]


def test_non_preemptive_priorities() -> None:
    """Davis, Burns, Bril, Lukkien 2007 (Controller Area Network, table 1): it is the second
    instance of the third message that takes longest, 3.5 ms, as the revised analysis has it."""
    times = [(10, 25), (10, 35), (10, 35)]
    tasks = [task(f"m{n}", c, Arrivals(t), urgency=n) for n, (c, t) in enumerate(times)]
    assert found(tasks, e=ExecutorModel(ExecutorOrder.PRIORITY)) == [20, 30, 35]


POSE, COSTMAP, PLANNER, SENSOR = 2, 20, 180, 2
"""The case study of Casini et al. 2019, section 6, in units of 100 us."""


def move_base(percent: int, jitter: int = 2) -> int | None:
    """Return the bound from /odom to /cmd_vel, event-driven, in two reservations, of which the
    local one has so much of the processor; as the authors' move_base.py makes them (it cuts the
    budget into whole milliseconds)."""
    part = Fraction(percent, 100)
    period = part.denominator * -(-10 // part.numerator)
    supply = Supply(int(part * period), period)
    odom, others = Arrivals(800, jitter), Arrivals(800, 2)
    tasks = [
        task("pose_estimator", POSE, odom),
        task("local_costmap", COSTMAP, parent=0),
        task("local_planner", PLANNER, parent=1),
        task("sensor2mem", SENSOR, others),
        task("sensor2mem", SENSOR, others),
    ]
    return found(tasks, e=ExecutorModel(supply=supply))[2]


def test_the_case_study_of_casini_and_others() -> None:
    """The numbers behind figure 7: what the authors' own code (boschresearch,
    ros2_response_time_analysis, with its errata) gives for budgets and for jitters."""
    budgets = [30, 35, 40, 45, 50, 55, 60, 65, 70, 75, 80, 85, 90, 95, 100]
    assert [move_base(percent) for percent in budgets] == [
        *(738, 622, 536, 492, 426, 386, 358, 325, 302, 282, 263, 248, 232, 218, 206)
    ]
    assert [move_base(percent) for percent in (5, 15, 25)] == [None] * 3
    assert [move_base(45, jitter) for jitter in range(0, 2000, 150)] == [
        *(492, 492, 492, 586, 736, 886, 1006, 1006, 1050, 1200, 1350, 1450, 1450, 1494)
    ]


RESERVED = Supply(3, 5)


def test_the_examples_of_response_time_analysis_rs() -> None:
    """Numbers of the tests of Brandenburg's crate, of the same paper's lemmas: a timer, one that
    may be blocked, one with jitter above it; a polled callback; a chain."""
    timer = [task("own", 1, Arrivals(10), kind="timer", place=2)]
    fast = task("fast", 1, Arrivals(10), kind="timer", place=0)
    slow = task("slow", 3, Arrivals(20), kind="timer", place=1)
    late = task("slow", 3, Arrivals(20, 10), kind="timer", place=1)
    first = ExecutorModel(ExecutorOrder.WAIT_SET, RESERVED)
    assert found([*timer, fast, slow], e=first)[0] == 12
    assert found([*timer, fast, late], e=first)[0] == 17
    anyhow = ExecutorModel(supply=RESERVED)
    polled = [task("own", 1, Arrivals(10)), task("b", 1, Arrivals(10)), task("c", 3, Arrivals(20))]
    assert found(polled, e=anyhow)[0] == 12
    chain = [
        task("a1", 1, Arrivals(25)),
        task("a2", 2, parent=0),
        task("a3", 3, parent=1),
        task("b", 3, Arrivals(20, 25)),
        task("c", 3, Arrivals(20, 25)),
    ]
    assert found(chain, e=anyhow)[2] == 72


def test_priorities_of_chains_save_them_from_what_is_less_urgent() -> None:
    chain = [
        task("a1", 2, Arrivals(20), urgency=1),
        task("a2", 3, parent=0, urgency=1),
        task("slow", 9, Arrivals(100), urgency=2),
        task("slower", 8, Arrivals(100), urgency=3),
    ]
    assert found(chain, e=ExecutorModel())[1] == 22
    assert found(chain, e=ExecutorModel(ExecutorOrder.PRIORITY))[1] == 14


def test_polling_points_bound_a_chain_beside_one_that_comes_in_bursts() -> None:
    """A burst of forty is one callback per polling point to its neighbours: the chain of two meets
    three rounds, not the whole burst."""
    tasks = [
        task("a1", 1, Arrivals(1000), place=0),
        task("a2", 1, parent=0, place=1),
        task("burst", 5, Arrivals(1000), place=2, count=40),
    ]
    anyhow = found(tasks, e=ExecutorModel())
    polled = found(tasks, e=ExecutorModel(ExecutorOrder.WAIT_SET))
    assert (anyhow[1], polled[1]) == (202, 12)


@pytest.mark.parametrize("order", list(ExecutorOrder))
def test_no_bound_where_there_is_more_to_do_than_time(order: ExecutorOrder) -> None:
    tasks = [
        task("a", 6, Arrivals(10), urgency=1, kind="timer", place=0),
        task("b", 5, Arrivals(10), urgency=2, place=1),
        task("c", 1, parent=1, urgency=2, executor="other"),
    ]
    assert found(tasks, e=ExecutorModel(order))[1:] == [None, None]


def test_a_reservation_gives_no_less_than_its_supply_bound_says() -> None:
    """Against the definition: the least that any window of that length gets, when the budget comes
    first in one period and last in the next ones."""
    supply = Supply(3, 5)
    slots = [n < 3 for n in range(5)] + [n >= 2 for _ in range(20) for n in range(5)]
    for work in range(1, 30):
        given = accumulate(slots[3:])
        assert supply.time_for(work) == next(n for n, sum in enumerate(given, 1) if sum == work)
    assert [PROCESSOR.time_for(work) for work in range(3)] == [0, 1, 2]


def test_arrivals_that_come_early_are_those_within_the_interval() -> None:
    for arrivals in (Arrivals(7), Arrivals(20, 45), Arrivals(20, 45, 4)):
        every = {}
        for offset in range(100):
            number = arrivals.within(offset + 1)
            if number > arrivals.within(offset):
                every[offset] = number
        assert dict(arrivals.earliest(100)) == every
