"""The guard of one run: who calls, what the job says about the call, and what is reported.

Replaced functions call ``engaged()`` for the guard of the calling thread. There is one only while a
simulation runs; otherwise the replaced functions do what they always did.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from fnmatch import fnmatchcase
from types import FrameType
from typing import Any, NoReturn
from weakref import WeakKeyDictionary

from rsltrace.errors import GuardError
from rsltrace.guard.callers import (
    FILE_OWNERS,
    OURS,
    STANDARD,
    USER,
    in_import,
    is_in,
    module_of,
    user_frame,
    user_stack,
)
from rsltrace.guard.context import RandomStreams, RealTimePace, SimulationContext, thread_id
from rsltrace.guard.context import engage as engage
from rsltrace.guard.context import engaged as _engaged
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
from rsltrace.trace.model.finding import (
    DEFAULT_MODES,
    Finding,
    GuardMode,
    GuardPolicy,
    NondeterminismSource,
)

_process_id = copy_of(os.getpid)
_guards: WeakKeyDictionary[Guard, None] = WeakKeyDictionary()  # no set: a run puts those in order

FINDINGS_PER_EVENT = 100
"""An event that reads the address of a million objects is one problem, not a million."""

# Local names: the lookup of an Enum member takes longer than the rest of the call.
_ALLOW, _ERROR, _RANDOM = GuardMode.ALLOW, GuardMode.ERROR, NondeterminismSource.RANDOM
_EACH = (GuardMode.ERROR, GuardMode.RECORD)
_ALWAYS = (GuardMode.WARN, GuardMode.ERROR, GuardMode.ALLOW)

_READS_PER_EVENT = 50_000
_BUSY_NS = 10_000


def _disengage_in_child() -> None:
    for guard in _guards:
        guard.thread = 0  # in charge of no thread of a child


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_disengage_in_child)


def reporting_mode(mode: GuardMode) -> GuardMode:
    """Return the mode of a call that can neither be answered nor recorded: at least a warning."""
    return mode if mode in _ALWAYS else GuardMode.WARN


class Guard:
    """The state of one run. ``on_finding`` takes what the trace keeps.

    ``modes`` says what is done about each source, if that is the same for all code (``one_policy``,
    and no module is exempt). Most calls then need no lookup.
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
        "answers_clocks",
        "answers_random",
        "context",
        "descriptors",
        "kinds",
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
        policy: GuardPolicy,
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
        """The owners of modules that read clocks and draw, by ``__file__`` (see ``file_kind``)."""
        self.on_finding = on_finding
        self._found: dict[tuple[NondeterminismSource, GuardMode, str, str], int] = {}
        self._answered: dict[NondeterminismSource, dict[str, dict[str, int]]] = {
            source: {} for source in NondeterminismSource
        }
        self._draws: dict[str, dict[str, RandomFunction]] = {}
        self.streams = RandomStreams(seed)
        self.answers = RecordedAnswers()
        self.descriptors = DescriptorTable()
        self.pace = RealTimePace()
        self.numbers = ObjectNumbers()
        self.shown = TextNumbers()
        self._policy = policy
        self.modes = policy.modes if one_policy and not any(policy.allowed.values()) else None
        self.answers_clocks = (
            self.modes is not None and self.modes[NondeterminismSource.CLOCK] is GuardMode.VIRTUAL
        )
        self.answers_random = (
            self.modes is not None and self.modes[NondeterminismSource.RANDOM] is GuardMode.VIRTUAL
        )
        self.thread = thread_id()
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
        """Note that this process continues the run as a copy, made by the kernel's ``fork``."""
        self.process = process

    @property
    def counts(self) -> dict[tuple[NondeterminismSource, GuardMode, str, str], int]:
        """How often each call was made: by source, mode, node and call."""
        counts: dict[tuple[NondeterminismSource, GuardMode, str, str], int] = dict(self._found)
        for call, clocks in self._clocks.items():
            for node, clock in clocks.items():
                if clock.looks:
                    counts[NondeterminismSource.CLOCK, GuardMode.VIRTUAL, node, call] = clock.looks
        for call, draws in self._draws.items():
            for node, draw in draws.items():
                if draw.count:
                    counts[_RANDOM, GuardMode.VIRTUAL, node, call] = draw.count
        for source, calls in self._answered.items():
            for call, nodes in calls.items():
                for node, count in nodes.items():
                    counts[source, GuardMode.VIRTUAL, node, call] = count
        return counts

    def mode(self, source: NondeterminismSource, frame: FrameType) -> GuardMode:
        """Return what the job says about ``source`` in the code of ``frame``."""
        if self.modes is not None:
            return self.modes[source]
        policy = self.context.policy() or self._policy
        allowed = policy.allowed.get(source) if policy.allowed else None
        if allowed:
            user = user_frame(frame, self.packages) or frame
            names = {module_of(frame), module_of(user)}
            if any(fnmatchcase(name, glob) for name in names for glob in allowed):
                return GuardMode.ALLOW
        return policy.modes.get(source) or DEFAULT_MODES[source]

    def is_virtual(self, source: NondeterminismSource) -> bool:
        """Return whether the run answers calls of a source, unless a node says otherwise."""
        return self._policy.modes.get(source, DEFAULT_MODES[source]) is GuardMode.VIRTUAL

    def stream(self, frame: FrameType) -> str:
        """Return the name of the random stream for the running code: the node's or its module's.

        A library has a stream of its own while it is imported, even by a node: it may be loaded
        already.
        """
        node = self.context.node()
        is_users = FILE_OWNERS[code_of(frame).co_filename] == USER
        if node and (is_users or not in_import(frame, self.packages)):
            return node
        return f"module {module_of(user_frame(frame, self.packages) or frame)}"

    def known_random_function(self, call: str, kind: int) -> Callable[..., Any] | None:
        """Count a draw and return the running node's function, None for its first draw."""
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
        """Count a draw and return the function that draws from the stream of the running code."""
        node = self.context.node()
        kind = FILE_OWNERS[code_of(frame).co_filename]
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
        is_users = FILE_OWNERS[code_of(frame).co_filename] == USER
        return is_users or user_frame(frame, self.packages) is frame

    def is_user_call(self, frame: FrameType) -> bool:
        """Return whether user code led to a frame."""
        kind = FILE_OWNERS[code_of(frame).co_filename]
        return kind == USER or (kind != OURS and user_frame(frame, self.packages) is not None)

    def user_frame_of(self, frame: FrameType) -> FrameType | None:
        """Return the frame of user code that led to a frame, if any."""
        kind = FILE_OWNERS[code_of(frame).co_filename]
        if kind <= OURS:
            return frame if kind == USER else None
        return user_frame(frame, self.packages)

    def count_call(self, source: NondeterminismSource, call: str, frame: FrameType) -> None:
        """Count a call of user code that the run answers."""
        if self.user_frame_of(frame) is not None:
            running = self._running
            present = running.node if running is not None else None
            node = present.key if present is not None else self.context.node()
            try:
                self._answered[source][call][node] += 1
            except KeyError:
                self._answered[source].setdefault(call, {})[node] = 1

    def note_answer(
        self, source: NondeterminismSource, call: str, describe: Callable[[], str], frame: FrameType
    ) -> None:
        """Keep in the trace what user code received from outside, in an order that the run makes.

        It is no finding, but two runs may differ in it.
        """
        user = user_frame(frame, self.packages) if self.is_user_call(frame) else None
        event, entity = self.context.place()
        if user is None or not self._has_room(event):
            return
        node, stack = self.context.node(), user_stack(user, self.packages)
        self.on_finding(
            Finding(event, entity, node, source, GuardMode.VIRTUAL, call, describe(), stack)
        )

    def note_process_answer(
        self,
        source: NondeterminismSource,
        call: str,
        answer: str,
        stack: str,
        node: str,
        calls: int,
    ) -> None:
        """Keep in the trace what compiled code drew or read, the last of so many ``calls``. Process
        ids are a finding, variables are none, and the run answers the rest.

        :raises GuardError: if the job says that it is an error.
        """
        mode = self._policy.modes.get(source, DEFAULT_MODES[source])
        if mode is _ALLOW and source is NondeterminismSource.ENVIRONMENT:
            return
        if source is not NondeterminismSource.PID:
            mode = GuardMode.VIRTUAL
            counts = self._answered[source].setdefault(call, {})
            counts[node] = counts.get(node, 0) + calls
        elif mode is _ALLOW:
            return
        else:
            mode = reporting_mode(mode)
            key = (source, mode, node, call)
            self._found[key] = self._found.get(key, 0) + calls
        event, entity = self.context.place()
        if self._has_room(event):
            self.on_finding(Finding(event, entity, node, source, mode, call, answer, stack))
        if mode is _ERROR:
            _refuse(source, call, stack.partition("\n")[0])

    def _has_room(self, event: int) -> bool:
        """Count one more finding of an event; return whether the trace takes it."""
        if event != self._event:
            self._event, self._in_event = event, 0
        self._in_event += 1
        return self._in_event <= FINDINGS_PER_EVENT

    def report(
        self,
        source: NondeterminismSource,
        mode: GuardMode,
        call: str,
        value: object,
        frame: FrameType,
        describe: Callable[[Any], str] | None = None,
        user: FrameType | None = None,
    ) -> None:
        """Report a call made at ``frame``; ``describe`` makes a text of its answer.

        ``user`` is the frame of user code that led to it, if the caller knows it.

        :raises GuardError: if the job says that it is an error.
        """
        node = self.context.node()
        key = (source, mode, node, call)
        self._found[key] = self._found.get(key, 0) + 1
        event, entity = self.context.place()
        if self._has_room(event) or mode in _EACH:
            user = user or user_frame(frame, self.packages)
            stack = user_stack(user or frame, self.packages)
            if describe is not None:
                text = describe(value)
            else:
                text = value if isinstance(value, str) else repr(value)
            self.on_finding(Finding(event, entity, node, source, mode, call, text, stack))
            if mode is _ERROR:
                _refuse(source, call, stack.partition("\n")[0] or module_of(frame))

    def record(
        self,
        source: NondeterminismSource,
        call: str,
        real: Callable[[], Any],
        frame: FrameType,
        number: int = 0,
    ) -> Any:
        """Return the answer to a call from outside, and keep it in the trace for a re-run.

        ``number`` is that of the socket or descriptor that is asked, if it has one.

        :raises OSError: if that is the answer.
        """
        if self.answers.replays:
            text = self.answers.next_answer(self.context.node(), call, number).text
            assert text is not None or number
            text = text or "null"
        else:
            with engage(None):
                text = encoded_answer(real)
        self.report(
            source,
            GuardMode.RECORD,
            call,
            finding_value(number, 0, text) if number else text,
            frame,
        )
        return decoded(text)

    def report_user_call(
        self,
        source: NondeterminismSource,
        call: str,
        value: object,
        frame: FrameType,
        describe: Callable[[Any], str] | None = None,
    ) -> None:
        """Report a call that the run cannot answer, if user code made it and the job does not allow
        it."""
        if not self.is_user_call(frame):
            return
        mode = self.mode(source, frame)
        if mode is _ALLOW:
            return
        self.report(source, reporting_mode(mode), call, value, frame, describe)

    def file_kind(self, names: dict[str, Any], frame: FrameType) -> int:
        """Return who owns the code of a frame, and remember it for its module with globals
        ``names``."""
        file = code_of(frame).co_filename
        kind = FILE_OWNERS[file]
        if kind > STANDARD and self.packages and is_in(frame, self.packages):
            kind = USER
        # Code compiled from a text has no file, and a program may be imported as a module, too.
        if names.get("__file__") == file and names.get("__name__") != "__main__":
            self.kinds[file] = kind
        return kind

    def clock_ns(self, call: str, kind: int, names: dict[str, Any], frame: Any = None) -> int:
        """Return what a clock of the running node (or of the module, without a node) shows now.

        A real clock never shows the same time twice, and code divides by durations. So each further
        read at one instant shows a little more; not for Python's own modules, which wait by it.
        Code that reads until time has passed makes it pass. A library that is being imported has
        its own clock. ``kind`` is the owner of the calling code, ``names`` its globals; ``frame``
        is needed unless the user or rclpy owns it.
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
    NondeterminismSource.CLOCK: "use the node's clock: self.get_clock().now()",
    NondeterminismSource.RANDOM: "use a generator with a seed of its own",
    NondeterminismSource.DIRECTORY: "sort what is listed",
    NondeterminismSource.FILE: "read the file before the run, or write 'file: record'",
    NondeterminismSource.ENVIRONMENT: "make it a parameter of the node",
    NondeterminismSource.PID: "name it by a parameter of the node, or write 'pid: virtual'",
    NondeterminismSource.THREAD: "use timers, tasks or callback groups",
    NondeterminismSource.PROCESS: "do it before the run, or write 'process: record'",
    NondeterminismSource.SOCKET: "record that data into a bag, or write 'socket: record'",
    NondeterminismSource.ADDRESS: "use a name or a number of your own, not an object's address",
    NondeterminismSource.ORDER: "sort it, or use a dict or a list",
}
"""What to do instead, by source."""


def _refuse(source: NondeterminismSource, call: str, where: str) -> NoReturn:
    raise GuardError(
        f"{call} at {where}: the job says 'guard: {{{source.value}: error}}'; {ADVICE[source]}"
    )


engaged: Callable[[], Guard | None] = _engaged
