"""Which timer is next: two rules for timers with equal deadlines.

``creation`` is ours: a total order, (deadline, creation order). ``heap`` gives the order in which
rclcpp's TimersManager meets equal deadlines, which falls out of how libstdc++ sifts its binary
heap; it exists to compare runs with RSLCPP, and is part of no other promise.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush, heapreplace
from typing import Any

from rsltrace.compiled import TimerQueueFields, TimerStateFields

# A timer's deadlines, with the arithmetic of rcl.
#
# Source of the rules: ``rcl/src/rcl/timer.c`` of rcl 9.2 (ROS 2 Jazzy). Deadlines stay on the grid
# the timer was started on; periods that were missed are skipped, not made up for.

ZERO_PERIOD_NS = 1_000_000
"""How often a timer of period 0 runs, which ROS runs whenever the executor comes to it.
Rejected: again at the same instant, as simulated time would never go on."""


class TimerState(TimerStateFields):
    """Period and deadline of one timer, in nanoseconds of simulated time.

    ``order`` is the creation order, the tie-breaker of equal deadlines. ``owner`` is what the loop
    dispatches when the timer is due. ``ticket`` belongs to the timer queue.
    """

    def __init__(
        self, period_ns: int, now_ns: int, *, order: int, owner: object, canceled: bool = False
    ) -> None:
        if period_ns < 0:
            raise ValueError(f"timer period must not be negative, is {period_ns} ns")
        self.period_ns = period_ns
        self.last_call_ns = now_ns
        self.deadline_ns = now_ns + period_ns
        self.canceled = canceled
        self.order = order
        self.owner = owner
        self.ticket: object = None

    def call(self, now_ns: int) -> None:
        """Move the deadline to its next grid point after a call at ``now_ns``."""
        self.last_call_ns = now_ns
        period_ns = self.period_ns or ZERO_PERIOD_NS
        deadline_ns = self.deadline_ns + period_ns
        if deadline_ns <= now_ns:
            deadline_ns += (1 + (now_ns - deadline_ns) // period_ns) * period_ns
        self.deadline_ns = deadline_ns

    def reset(self, now_ns: int) -> None:
        """Start a new grid at ``now_ns``; a cancelled timer runs again."""
        soonest_ns = max(now_ns, min(self.deadline_ns, now_ns + ZERO_PERIOD_NS))
        self.deadline_ns = now_ns + self.period_ns if self.period_ns else soonest_ns
        self.canceled = False


NEVER_NS = 1 << 64
"""Later than any time that a trace can hold."""

_ROOM = 256


class CreationOrderQueue(TimerQueueFields):
    """The running timers, smallest (deadline, creation order) first. O(log n) for every change.

    The loop reads the first timer far more often than timers change, so it is kept up to date.
    """

    def __init__(self) -> None:
        # An entry is valid while its timer's ticket is that very entry: changes push a new one.
        # The first entry is always valid.
        self._heap: list[tuple[int, int, TimerState]] = []
        self._room = _ROOM
        self.head: TimerState | None = None
        self.next_ns = NEVER_NS

    def add(self, timer: TimerState) -> None:
        """Add a timer, also after a cancel; or note that its deadline has changed (``moved``)."""
        before: Any = timer.ticket
        if before is not None and before[0] == timer.deadline_ns:
            return  # it is in its place
        entry = (timer.deadline_ns, timer.order, timer)
        timer.ticket = entry
        heap = self._heap
        heappush(heap, entry)
        if len(heap) > self._room:
            self._tidy()
        self._find_head()

    def _tidy(self) -> None:
        """Remove outdated entries: a watchdog timer is reset more often than it is due."""
        self._heap = [entry for entry in self._heap if entry[2].ticket is entry]
        heapify(self._heap)
        self._room = _ROOM + 2 * len(self._heap)

    moved = add

    def ran(self, timer: TimerState) -> None:
        """Note that ``timer``, which was ``head``, was called and has a new deadline."""
        heap = self._heap
        first = timer.ticket
        timer.ticket = entry = (timer.deadline_ns, timer.order, timer)
        if heap and heap[0] is first:
            heapreplace(heap, entry)
        else:
            heappush(heap, entry)
        top = heap[0]
        if top[2].ticket is top:
            self.next_ns, _, self.head = top
        else:
            self._find_head()

    def remove(self, timer: TimerState) -> None:
        timer.ticket = None
        if timer is self.head:
            self._find_head()

    def _find_head(self) -> None:
        heap = self._heap
        while heap:
            entry = heap[0]
            if entry[2].ticket is entry:
                self.next_ns, _, self.head = entry
                return
            heappop(heap)
        self.next_ns, self.head = NEVER_NS, None

    def due(self, now_ns: int) -> tuple[list[TimerState], TimerState | None]:
        """Return the due timers in order, and the next one after them."""
        heap = self._heap
        due: list[tuple[int, int, TimerState]] = []
        after: tuple[int, int, TimerState] | None = None
        places = [0]
        while places:
            place = places.pop()
            if place >= len(heap):
                continue
            entry = heap[place]
            valid = entry[2].ticket is entry
            if entry[0] <= now_ns or not valid:
                if valid:
                    due.append(entry)
                places += (2 * place + 1, 2 * place + 2)
            elif after is None or entry[:2] < after[:2]:
                after = entry
        due.sort(key=lambda entry: entry[:2])
        return [entry[2] for entry in due], None if after is None else after[2]


class HeapOrderQueue(TimerQueueFields):
    """Equal deadlines in the order of libstdc++'s heap algorithms, as rclcpp uses them.

    rclcpp sifts up on insertion; after its root timer ran it appends the root again, pops the heap
    and drops the last element; when a timer goes it makes a new heap of the others.
    """

    def __init__(self) -> None:
        self._heap: list[TimerState] = []
        self._find_head()

    def add(self, timer: TimerState) -> None:
        if timer.ticket is self:
            self.moved(timer)
            return
        timer.ticket = self
        self._heap.append(timer)
        self._sift_up(len(self._heap) - 1, 0, timer)
        self._find_head()

    def remove(self, timer: TimerState) -> None:
        if timer.ticket is self:
            timer.ticket = None
            self._heap.remove(timer)
            self._make_heap()

    def moved(self, timer: TimerState) -> None:
        self._make_heap()

    def ran(self, timer: TimerState) -> None:
        heap = self._heap
        if not heap or heap[0] is not timer:
            self._make_heap()  # the callback changed the heap under its own timer
            return
        # push_back(front), pop_heap, pop_back: the copy at the end is what gets sifted in again.
        if len(heap) > 1:
            self._sift_down(0, len(heap), timer)
        self._find_head()

    def _find_head(self) -> None:
        self.head = self._heap[0] if self._heap else None
        self.next_ns = NEVER_NS if self.head is None else self.head.deadline_ns

    def due(self, now_ns: int) -> tuple[list[TimerState], TimerState | None]:
        in_order = sorted(self._heap, key=lambda timer: (timer.deadline_ns, timer.order))
        due = [timer for timer in in_order if timer.deadline_ns <= now_ns]
        return due, in_order[len(due)] if len(due) < len(in_order) else None

    def _sift_up(self, hole: int, top: int, timer: TimerState) -> None:
        heap = self._heap
        parent = (hole - 1) // 2
        while hole > top and heap[parent].deadline_ns > timer.deadline_ns:
            heap[hole] = heap[parent]
            hole = parent
            parent = (hole - 1) // 2
        heap[hole] = timer

    def _sift_down(self, top: int, length: int, timer: TimerState) -> None:
        heap = self._heap
        hole = child = top
        while child < (length - 1) // 2:
            child = 2 * (child + 1)
            if heap[child].deadline_ns > heap[child - 1].deadline_ns:
                child -= 1
            heap[hole] = heap[child]
            hole = child
        if length % 2 == 0 and child == (length - 2) // 2:
            child = 2 * (child + 1)
            heap[hole] = heap[child - 1]
            hole = child - 1
        self._sift_up(hole, top, timer)

    def _make_heap(self) -> None:
        length = len(self._heap)
        for parent in range((length - 2) // 2, -1, -1):
            self._sift_down(parent, length, self._heap[parent])
        self._find_head()


TimerQueue = CreationOrderQueue | HeapOrderQueue


def timer_queue(ties: str) -> TimerQueue:
    """Return a queue for the tie rule ``creation`` or ``heap``.

    :raises ValueError: for any other rule.
    """
    if ties == "creation":
        return CreationOrderQueue()
    if ties == "heap":
        return HeapOrderQueue()
    raise ValueError(f"unknown rule for timer ties: {ties!r} (creation or heap)")
