"""The guard of one run: who is calling, what the job says about it, what was seen.

Replaced functions ask ``engaged()`` for the guard that is in charge of the calling thread. There is
one only while a simulation is at work; everywhere else the replaced functions do what they always
did.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from fnmatch import fnmatchcase
from types import FrameType
from typing import Any
from weakref import WeakKeyDictionary

from rsltrace.errors import GuardError
from rsltrace.guard import engagement
from rsltrace.guard.callers import (
    KINDS,
    OURS,
    STANDARD,
    USER,
    in_import,
    is_in,
    module_of,
    user_frame,
    user_stack,
)
from rsltrace.guard.context import RandomStreams, RealTimePace, SimulationContext
from rsltrace.guard.descriptor_table import DescriptorTable
from rsltrace.guard.frames import code_of
from rsltrace.guard.libraries import present_import
from rsltrace.guard.object_numbers import ObjectNumbers, TextNumbers
from rsltrace.guard.recorded_answers import (
    AHEAD_NS_MAX,
    LOOK_NS,
    ClockFunction,
    RandomFunction,
    RecordedAnswers,
    ShownTime,
    decoded,
    encoded_answer,
    finding_value,
)
from rsltrace.guard.redirect import copy_of
from rsltrace.trace.model.finding import DEFAULT_MODES, Finding, Mode, Policy, Source

_process_id = copy_of(os.getpid)  # type: ignore[arg-type]
_guards: WeakKeyDictionary[Guard, None] = WeakKeyDictionary()  # no set: a run puts those in order

FINDINGS_PER_EVENT = 100
"""An event that looks at the address of a million objects is one problem, not a million."""

# Python takes longer to find a member of an Enum than all else that is asked of it.
_ALLOW, _ERROR, _RANDOM = Mode.ALLOW, Mode.ERROR, Source.RANDOM
_EACH = (Mode.ERROR, Mode.RECORD)
_ALWAYS = (Mode.WARN, Mode.ERROR, Mode.ALLOW)

_READS_PER_EVENT = 50_000
_BUSY_NS = 10_000


def _disengage_in_child() -> None:
    for guard in _guards:
        guard.thread = 0  # in charge of no thread of a child


os.register_at_fork(after_in_child=_disengage_in_child)


def reporting_mode(mode: Mode) -> Mode:
    """Return what is done where the run can make no answer and record none: it is reported."""
    return mode if mode in _ALWAYS else Mode.WARN


class Guard:
    """State of one run. ``on_finding`` takes what is worth a line in the trace.

    ``modes`` says what is done about each source if that is the same for all code (``one_policy``,
    and no module is exempt), which spares most calls a question.
    """

    __slots__ = (
        "__weakref__",
        "_answered",
        "_clocks",
        "_draws",
        "_event",
        "_found",
        "_in_event",
        "_look",
        "_loop",
        "_passes",
        "_policy",
        "_reads",
        "_reads_event",
        "_running",
        "_shown",
        "answers",
        "context",
        "descriptors",
        "kinds",
        "makes_chance",
        "makes_clocks",
        "modes",
        "numbers",
        "on_finding",
        "pace",
        "packages",
        "process",
        "shown",
        "streams",
        "thread",
    )

    def __init__(
        self,
        context: SimulationContext,
        *,
        policy: Policy,
        seed: int = 0,
        packages: frozenset[str] = frozenset(),
        on_finding: Callable[[Finding], None] = lambda finding: None,
        one_policy: bool = False,
    ) -> None:
        self.context = context
        self._look = context.look
        self._loop: Any
        self._running: Any
        self._loop, self._running = context.direct or (None, None)
        self.packages = packages
        self.kinds: dict[str, int] = {}
        """Whose the modules are that read clocks and draw, by ``__file__`` (see ``whose``)."""
        self.on_finding = on_finding
        self._found: dict[tuple[Source, Mode, str, str], int] = {}
        self._answered: dict[Source, dict[str, dict[str, int]]] = {source: {} for source in Source}
        self._draws: dict[str, dict[str, RandomFunction]] = {}
        self.streams = RandomStreams(seed)
        self.answers = RecordedAnswers()
        self.descriptors = DescriptorTable()
        self.pace = RealTimePace()
        self.numbers = ObjectNumbers()
        self.shown = TextNumbers()
        self._policy = policy
        self.modes = policy.modes if one_policy and not any(policy.allowed.values()) else None
        self.makes_clocks = self.modes is not None and self.modes[Source.CLOCK] is Mode.VIRTUAL
        self.makes_chance = self.modes is not None and self.modes[Source.RANDOM] is Mode.VIRTUAL
        self.thread = engagement.thread_id()
        self.process = _process_id()
        _guards[self] = None
        self._event = -1
        self._in_event = 0
        self._reads = 0
        self._reads_event = -1
        self._passes = 0
        self._clocks: dict[str, dict[str, ClockFunction]] = {}
        self._shown: dict[str, ShownTime] = {}

    def continue_in(self, process: int) -> None:
        """Take note that the present process is a copy, made by the kernel's own ``fork``, which
        is in charge from now on."""
        self.process = process

    @property
    def counts(self) -> dict[tuple[Source, Mode, str, str], int]:
        """How often each call was met: by source, mode, node and call."""
        counts: dict[tuple[Source, Mode, str, str], int] = dict(self._found)
        for call, clocks in self._clocks.items():
            for node, clock in clocks.items():
                if clock.looks:
                    counts[Source.CLOCK, Mode.VIRTUAL, node, call] = clock.looks
        for call, draws in self._draws.items():
            for node, draw in draws.items():
                if draw.count:
                    counts[_RANDOM, Mode.VIRTUAL, node, call] = draw.count
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

    def known_random_function(self, call: str, kind: int) -> Callable[..., Any] | None:
        """Count a draw of the user's or rclpy's code; return what draws for the node that runs, or
        None if none runs or it is its first."""
        try:
            draw = self._draws[call][self._running.node.key]
        except (KeyError, AttributeError):
            return None
        if kind == USER:
            draw.count += 1
        return draw.function

    def random_function(
        self, call: str, virtual: Callable[[Guard, str], Callable[..., Any]], frame: FrameType
    ) -> Callable[..., Any]:
        """Count a draw that the run makes; return what draws from the stream of whoever runs."""
        node = self.context.node()
        kind = KINDS[code_of(frame).co_filename]
        if node and (kind <= OURS or user_frame(frame, self.packages) is not None):
            try:
                draw = self._draws[call][node]
            except KeyError:
                draw = self._draws.setdefault(call, {})[node] = RandomFunction(virtual(self, node))
            if kind != OURS:
                draw.count += 1
            return draw.function
        self.count_call(_RANDOM, call, frame)
        return virtual(self, self.stream(frame))

    def is_user(self, frame: FrameType) -> bool:
        """Return whether a frame is user code itself."""
        is_users = KINDS[code_of(frame).co_filename] == USER
        return is_users or user_frame(frame, self.packages) is frame

    def is_user_call(self, frame: FrameType) -> bool:
        """Return whether user code has led to a frame."""
        kind = KINDS[code_of(frame).co_filename]
        return kind == USER or (kind != OURS and user_frame(frame, self.packages) is not None)

    def user_frame_of(self, frame: FrameType) -> FrameType | None:
        """Return the frame of user code that has led to a frame, if any has."""
        kind = KINDS[code_of(frame).co_filename]
        if kind <= OURS:
            return frame if kind == USER else None
        return user_frame(frame, self.packages)

    def count_call(self, source: Source, call: str, frame: FrameType) -> None:
        """Count a call of user code that the run answers itself."""
        if self.user_frame_of(frame) is not None:
            running = self._running
            present = running.node if running is not None else None
            node = present.key if present is not None else self.context.node()
            try:
                self._answered[source][call][node] += 1
            except KeyError:
                self._answered[source].setdefault(call, {})[node] = 1

    def note_answer(
        self, source: Source, call: str, told: Callable[[], str], frame: FrameType
    ) -> None:
        """Let the trace keep what user code was told from outside, in an order that the run makes:
        no finding, but what two runs may differ in."""
        user = user_frame(frame, self.packages) if self.is_user_call(frame) else None
        event, entity = self.context.place()
        if user is None or not self._has_room(event):
            return
        node, stack = self.context.node(), user_stack(user, self.packages)
        self.on_finding(Finding(event, entity, node, source, Mode.VIRTUAL, call, told(), stack))

    def _has_room(self, event: int) -> bool:
        """Count one more of an event, and return whether the trace has room for it."""
        if event != self._event:
            self._event, self._in_event = event, 0
        self._in_event += 1
        return self._in_event <= FINDINGS_PER_EVENT

    def report(
        self,
        source: Source,
        mode: Mode,
        call: str,
        value: object,
        frame: FrameType,
        told: Callable[[Any], str] | None = None,
        user: FrameType | None = None,
    ) -> None:
        """Report a call; ``frame`` is where it was made, ``told`` makes a text of its answer.
        ``user`` is the frame of user code that led to it, for those who know.

        :raises GuardError: if the job says that it is an error.
        """
        node = self.context.node()
        key = (source, mode, node, call)
        self._found[key] = self._found.get(key, 0) + 1
        event, entity = self.context.place()
        if self._has_room(event) or mode in _EACH:
            user = user or user_frame(frame, self.packages)
            stack = user_stack(user or frame, self.packages)
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

    def record(
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
        self.report(source, Mode.RECORD, call, finding_value(of, 0, text) if of else text, frame)
        return decoded(text)

    def report_user_call(
        self,
        source: Source,
        call: str,
        value: object,
        frame: FrameType,
        told: Callable[[Any], str] | None = None,
    ) -> None:
        """Report a call that cannot be virtual, if user code made it and the job wants to know."""
        if not self.is_user_call(frame):
            return
        mode = self.mode(source, frame)
        if mode is _ALLOW:
            return
        self.report(source, reporting_mode(mode), call, value, frame, told)

    def file_kind(self, names: dict[str, Any], frame: FrameType) -> int:
        """Return whose the code of a frame is, be it in a package of the nodes; remember it of its
        module, whose ``names`` these are."""
        file = code_of(frame).co_filename
        kind = KINDS[file]
        if kind > STANDARD and self.packages and is_in(frame, self.packages):
            kind = USER
        # What a decorator has made of a text is of no file, and a program may be a module, too.
        if names.get("__file__") == file and names.get("__name__") != "__main__":
            self.kinds[file] = kind
        return kind

    def clock_ns(self, call: str, kind: int, names: dict[str, Any], frame: Any = None) -> int:
        """Return what a clock of the node (of the module, where no node runs) shows: now.

        Real clocks never show the same twice, and code that measures durations (to divide by them,
        say) relies on it. So whoever looks again at one instant sees a little more each time;
        not so Python's own modules, which wait by what they see. Whoever looks until time has
        passed makes it pass. A library that is being imported has a clock of its own.
        ``kind`` says whose the code is that asks, with ``names`` in its module; ``frame`` is its
        frame, if it is neither the user's nor rclpy's.
        """
        look, running = self._look, self._running
        present = running.node if running is not None else None
        if present is None:
            event, node, now_ns = look()
        else:
            loop = self._loop
            event, node, now_ns = loop.events, present.key, loop.now_ns
        try:
            clock = self._clocks[call][node]
        except KeyError:
            clock = self._new_clock(call, node)
        if kind == USER or (kind != OURS and user_frame(frame, self.packages) is not None):
            clock.looks += 1
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
        shown = clock.shown if node else self._shown_by(f"module {names.get('__name__', '')}")
        if now_ns is not shown.now_ns:
            shown.see(now_ns)
        elif shown.ahead_ns < AHEAD_NS_MAX:
            shown.ahead_ns += LOOK_NS
        return now_ns + shown.ahead_ns

    def _shown_by(self, who: str) -> ShownTime:
        shown = self._shown[who] = self._shown.get(who) or ShownTime()
        return shown

    def _new_clock(self, call: str, node: str) -> ClockFunction:
        clock = ClockFunction(self._shown_by(node))
        self._clocks.setdefault(call, {})[node] = clock
        return clock


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

engaged: Callable[[], Guard | None] = engagement.engaged
engage = engagement.engage
