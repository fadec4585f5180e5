"""A timer that is reset far more often than it is due (a watchdog) costs no memory."""

from __future__ import annotations

import random

from rsltrace.simulation.loop.timer_queue import CreationOrderQueue, TimerState


def test_a_watchdog_leaves_nothing_behind() -> None:
    queue = CreationOrderQueue()
    watchdog = TimerState(3600 * 10**9, 0, order=0, owner=None)
    others = [TimerState(10**9 + i, 0, order=i, owner=None) for i in range(1, 5)]
    for timer in (watchdog, *others):
        queue.add(timer)
    for now_ns in range(100_000):
        watchdog.reset(now_ns)
        queue.add(watchdog)
        assert queue.head is others[0]
    assert len(queue._heap) < 1000


def test_tidying_keeps_the_order() -> None:
    chance = random.Random(1)
    queue = CreationOrderQueue()
    timers = [TimerState(1000, 0, order=i, owner=None) for i in range(400)]
    for timer in timers:
        queue.add(timer)
    for _ in range(5000):
        timer = chance.choice(timers)
        timer.reset(chance.randrange(1000))
        queue.add(timer)
    for timer in timers[::7]:
        queue.remove(timer)
    left = [timer for i, timer in enumerate(timers) if i % 7]
    met = []
    while (timer := queue.head) is not None:
        met.append((timer.deadline_ns, timer.order))
        queue.remove(timer)
    assert met == sorted((timer.deadline_ns, timer.order) for timer in left)
