"""The guard of one run: who is calling, what the job says about it, what was seen.

Replaced functions ask ``engaged()`` for the guard that is in charge of the calling thread. There is
one only while a simulation is at work; everywhere else the replaced functions do what they always
did.
"""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Callable
from fnmatch import fnmatchcase
from types import FrameType
from typing import Any, Protocol

from rsltrace.errors import GuardError
from rsltrace.guard.callers import (
    KINDS,
    OURS,
    STANDARD,
    USER,
    in_import,
    module_of,
    stack_of,
    user_frame,
)
from rsltrace.guard.descriptor_table import DescriptorTable
from rsltrace.guard.frames import code_of
from rsltrace.guard.library_imports import present_import
from rsltrace.guard.object_numbers import ObjectNumbers, ShownNumbers
from rsltrace.guard.random_streams import RandomStreams
from rsltrace.guard.real_time import RealTimePace
from rsltrace.guard.recorded_answers import RecordedAnswers, decoded, encoded_answer, finding_value
from rsltrace.guard.redirect import copy_of
from rsltrace.model.finding import DEFAULT_MODES, Finding, Mode, Policy, Source

_thread_id = copy_of(threading.get_ident)  # type: ignore[arg-type]
_process_id = copy_of(os.getpid)  # type: ignore[arg-type]
_here = _process_id()
"""This process; asking the system each time would cost more than all the rest."""

FINDINGS_PER_EVENT = 100
"""An event that looks at the address of a million objects is one problem, not a million."""

# Python takes longer to find a member of an Enum than all else that is asked of it.
_ALLOW, _ERROR, _RANDOM = Mode.ALLOW, Mode.ERROR, Source.RANDOM
_EACH = (Mode.ERROR, Mode.RECORD)
_AT_LEAST = {Mode.VIRTUAL: Mode.WARN, Mode.RECORD: Mode.WARN}
"""What can be neither made virtual nor recorded is at least reported."""

_READS_PER_EVENT = 50_000
_BUSY_NS = 10_000
_LOOK_NS = 1_000
"""What looking at a clock again takes: ``time.time()`` of this century cannot show much less."""
_AHEAD_NS_MAX = 1_000_000
_NEVER = (0, -1 << 63)


def _forked() -> None:
    global _here
    _here = _process_id()


os.register_at_fork(after_in_child=_forked)


class Context(Protocol):
    """What a guard asks of the simulation."""

    def now_ns(self) -> int:
        """Return simulated time."""

    def look(self) -> tuple[int, str, int]:
        """Return the index of the event under way, the node and simulated time."""

    def node(self) -> str:
        """Return the node whose code runs, or an empty text."""

    def process(self) -> int:
        """Return which of the run's processes that is: 0 has the nodes that the job constructs,
        the mains count from 1 in the order of the job."""

    def policy(self) -> Policy | None:
        """Return the policy of that node, or None for the job's."""

    def place(self) -> tuple[int, int]:
        """Return the index of the event under way and the entity that runs."""

    def pass_time(self, for_ns: int) -> None:
        """Let simulated time pass, if whoever runs can wait."""

    def is_aside(self) -> bool:
        """Return whether others can go on while whoever runs waits for what is outside."""

    def can_step(self) -> bool:
        """Return whether whoever runs can wait in simulated time at all."""

    def step(self, for_ns: int) -> None:
        """Let simulated time pass while whoever runs waits for what is outside."""


class Guard:
    """State of one run. ``on_finding`` takes what is worth a line in the trace.

    ``modes`` says what is done about each source if that is the same for all code (``one_policy``,
    and no module is exempt), which spares most calls a question.
    """

    def __init__(
        self,
        context: Context,
        *,
        policy: Policy,
        seed: int = 0,
        packages: frozenset[str] = frozenset(),
        on_finding: Callable[[Finding], None] = lambda finding: None,
        one_policy: bool = False,
    ) -> None:
        self.context = context
        self._look = context.look
        self.packages = packages
        self.on_finding = on_finding
        self._found: Counter[tuple[Source, Mode, str, str]] = Counter()
        self._answered: dict[Source, dict[str, dict[str, int]]] = {source: {} for source in Source}
        self._clock_looks = self._answered[Source.CLOCK]
        self._draws = self._answered[Source.RANDOM]
        self.streams = RandomStreams(seed)
        self.answers = RecordedAnswers()
        self.descriptors = DescriptorTable()
        self.pace = RealTimePace()
        self.numbers = ObjectNumbers()
        self.shown = ShownNumbers()
        self._policy = policy
        self.modes = policy.modes if one_policy and not any(policy.allowed.values()) else None
        self.makes_clocks = self.modes is not None and self.modes[Source.CLOCK] is Mode.VIRTUAL
        self.makes_chance = self.modes is not None and self.modes[Source.RANDOM] is Mode.VIRTUAL
        self.thread = _thread_id()
        self.process = _process_id()
        self._event = -1
        self._in_event = 0
        self._reads = 0
        self._reads_event = -1
        self._passes = 0
        self._shown: dict[str, tuple[int, int]] = {}

    def goes_on_in(self, process: int) -> None:
        """Take note that the present process is a copy, made by the kernel's own ``fork``, which
        is in charge from now on."""
        global _here
        _here = self.process = process

    @property
    def counts(self) -> dict[tuple[Source, Mode, str, str], int]:
        """How often each call was met: by source, mode, node and call."""
        counts: dict[tuple[Source, Mode, str, str], int] = dict(self._found)
        for source, calls in self._answered.items():
            for call, nodes in calls.items():
                for node, count in nodes.items():
                    counts[source, Mode.VIRTUAL, node, call] = count
        return counts

    def mode(self, source: Source, frame: FrameType) -> Mode:
        """Return what the job says about ``source`` in the code of ``frame``."""
        if self.modes is not None:
            return self.modes[source]
        policy = self.context.policy() or self._policy
        allowed = policy.allowed.get(source) if policy.allowed else None
        if allowed:
            user = user_frame(frame, self.packages) or frame
            names = {module_of(frame), module_of(user)}
            if any(fnmatchcase(name, glob) for name in names for glob in allowed):
                return Mode.ALLOW
        return policy.modes.get(source) or DEFAULT_MODES[source]

    def is_virtual(self, source: Source) -> bool:
        """Return whether the run makes the answers of a source, unless a node says otherwise."""
        return self._policy.modes.get(source, DEFAULT_MODES[source]) is Mode.VIRTUAL

    def stream(self, frame: FrameType) -> str:
        """Return the name of the random stream of whoever runs: the node's, or its module's.

        A library that is imported has a stream of its own, even if a node imports it: it may be
        loaded already.
        """
        node = self.context.node()
        is_users = KINDS[code_of(frame).co_filename] == USER
        if node and (is_users or not in_import(frame, self.packages)):
            return node
        return f"module {module_of(user_frame(frame, self.packages) or frame)}"

    def drawn(self, call: str, frame: FrameType) -> str:
        """Count a draw that the run makes; return the name of its stream."""
        node = self.context.node()
        kind = KINDS[code_of(frame).co_filename]
        if kind == OURS and node:  # rclpy, for itself: what the two below would find out
            return node
        if kind != USER:
            self.count(_RANDOM, call, frame)
            return self.stream(frame)
        try:
            self._draws[call][node] += 1
        except KeyError:
            self._draws.setdefault(call, {})[node] = 1
        return node or self.stream(frame)

    def is_user(self, frame: FrameType) -> bool:
        """Return whether a frame is user code itself."""
        is_users = KINDS[code_of(frame).co_filename] == USER
        return is_users or user_frame(frame, self.packages) is frame

    def is_for_user(self, frame: FrameType) -> bool:
        """Return whether user code has led to a frame."""
        kind = KINDS[code_of(frame).co_filename]
        return kind == USER or (kind != OURS and user_frame(frame, self.packages) is not None)

    def count(self, source: Source, call: str, frame: FrameType) -> None:
        """Count a call of user code that the run answers itself."""
        if self.is_for_user(frame):
            node = self.context.node()
            try:
                self._answered[source][call][node] += 1
            except KeyError:
                self._answered[source].setdefault(call, {})[node] = 1

    def answered(
        self, source: Source, call: str, told: Callable[[], str], frame: FrameType
    ) -> None:
        """Let the trace keep what user code was told from outside, in an order that the run makes:
        no finding, but what two runs may differ in."""
        user = user_frame(frame, self.packages) if self.is_for_user(frame) else None
        event, entity = self.context.place()
        if user is None or not self._has_room(event):
            return
        node, stack = self.context.node(), stack_of(user, self.packages)
        self.on_finding(Finding(event, entity, node, source, Mode.VIRTUAL, call, told(), stack))

    def _has_room(self, event: int) -> bool:
        """Count one more of an event, and return whether the trace has room for it."""
        if event != self._event:
            self._event, self._in_event = event, 0
        self._in_event += 1
        return self._in_event <= FINDINGS_PER_EVENT

    def found(
        self,
        source: Source,
        mode: Mode,
        call: str,
        value: object,
        frame: FrameType,
        told: Callable[[Any], str] | None = None,
    ) -> None:
        """Report a call; ``frame`` is where it was made, ``told`` makes a text of its answer.

        :raises GuardError: if the job says that it is an error.
        """
        node = self.context.node()
        self._found[source, mode, node, call] += 1
        event, entity = self.context.place()
        if self._has_room(event) or mode in _EACH:
            user = user_frame(frame, self.packages)
            stack = stack_of(user or frame, self.packages)
            if told is not None:
                text = told(value)
            else:
                text = value if isinstance(value, str) else repr(value)
            self.on_finding(Finding(event, entity, node, source, mode, call, text, stack))
            if mode is _ERROR:
                where = stack.partition("\n")[0] or module_of(frame)
                raise GuardError(
                    f"{call} at {where}: the job says 'guard: {{{source.value}: error}}'; "
                    f"{ADVICE[source]}"
                )

    def recorded(
        self, source: Source, call: str, real: Callable[[], Any], frame: FrameType, of: int = 0
    ) -> Any:
        """Return the answer to a call from outside; the trace keeps it for a re-run.

        ``of`` is the number of the socket or descriptor asked, if it has one.

        :raises OSError: if that is what was answered.
        """
        if self.answers.replays:
            text = self.answers.next_answer(self.context.node(), call, of).text
            assert text is not None or of
            text = text or "null"
        else:
            with engage(None):
                text = encoded_answer(real)
        self.found(source, Mode.RECORD, call, finding_value(of, 0, text) if of else text, frame)
        return decoded(text)

    def watched(
        self,
        source: Source,
        call: str,
        value: object,
        frame: FrameType,
        told: Callable[[Any], str] | None = None,
    ) -> None:
        """Report a call that cannot be virtual, if user code made it and the job wants to know."""
        if not self.is_for_user(frame):
            return
        mode = self.mode(source, frame)
        if mode is _ALLOW:
            return
        self.found(source, _AT_LEAST.get(mode, mode), call, value, frame, told)

    def clock_ns(self, call: str, frame: FrameType, kind: int) -> int:
        """Return what a clock of the node (of the module, where no node runs) shows: now.

        Real clocks never show the same twice, and code that measures durations (to divide by them,
        say) relies on it. So whoever looks again at one instant sees a little more each time;
        not so Python's own modules, which wait by what they see. Whoever looks until time has
        passed makes it pass. A library that is being imported has a clock of its own.
        ``kind`` says whose file the code of ``frame`` is of.
        """
        look = self._look
        event, node, now_ns = look()
        if kind == USER or (kind != OURS and user_frame(frame, self.packages) is not None):
            try:
                self._clock_looks[call][node] += 1
            except KeyError:
                self._clock_looks.setdefault(call, {})[node] = 1
        library = present_import()
        if library is not None:
            return now_ns + library.look()
        if event != self._reads_event:
            self._reads_event, self._reads, self._passes = event, 0, 0
        self._reads += 1
        if self._reads > _READS_PER_EVENT:
            self._passes += 1  # the longer the wait, the longer the steps: about a thousandth
            self.context.pass_time(_BUSY_NS * (1 + self._passes // 100))
            self._reads_event, node, now_ns = look()
        if kind == STANDARD:
            return now_ns
        who = node or module_of(frame)
        before_ns, shown_ns = self._shown.get(who, _NEVER)
        if now_ns > shown_ns or now_ns < before_ns:  # a node's clock may jump backwards
            shown_ns = now_ns
        elif shown_ns - now_ns < _AHEAD_NS_MAX:
            shown_ns += _LOOK_NS
        self._shown[who] = now_ns, shown_ns
        return shown_ns


ADVICE = {
    Source.CLOCK: "use the node's clock: self.get_clock().now()",
    Source.RANDOM: "use a generator with a seed of its own",
    Source.DIRECTORY: "sort what is listed",
    Source.FILE: "read the file before the run, or write 'file: record'",
    Source.ENVIRONMENT: "make it a parameter of the node",
    Source.PID: "name it by a parameter of the node, or write 'pid: virtual'",
    Source.THREAD: "use timers, tasks or callback groups",
    Source.PROCESS: "do it before the run, or write 'process: record'",
    Source.SOCKET: "record what comes from outside into a bag, or write 'socket: record'",
    Source.ADDRESS: "use a name or a number of your own instead of an object's address",
    Source.ORDER: "sort it, or use a dict or a list",
}
"""What to do instead, by source."""

_engaged: list[Guard] = []


def engaged() -> Guard | None:
    """Return the guard in charge of the calling thread (and of no child process), or None."""
    if _engaged:
        guard = _engaged[-1]
        if guard.thread == _thread_id() and guard.process == _here:
            return guard
    return None


class engage:  # noqa: N801  (used like a function)
    """Put ``guard`` in charge of what this thread does within (None: nobody)."""

    __slots__ = ("_before", "_guard")

    def __init__(self, guard: Guard | None) -> None:
        self._guard = guard
        self._before: list[Guard] = []

    def __enter__(self) -> None:
        if self._guard is None:
            self._before = _engaged[:]
            _engaged.clear()
        else:
            _engaged.append(self._guard)

    def __exit__(self, *error: object) -> None:
        if self._guard is None:
            _engaged[:] = self._before
        else:
            _engaged.remove(self._guard)
