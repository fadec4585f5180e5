"""Sources of nondeterminism, the policy for each, and the findings of a run."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import astuple, field
from enum import Enum

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.texts import printable

# Messages that full queues dropped in a run, as a trace records them.

_DROP_KEPT = 10_000


@dataclass(frozen=True, slots=True)
class QueueDrops:
    """How many messages a full queue of ``depth`` dropped: that of the receiving entity or,
    ``in_outage``, that of a publisher that could not reach it."""

    entity: int
    depth: int
    count: int
    in_outage: bool = False


def encode_drops(drops: Iterable[QueueDrops]) -> dict[str, str]:
    """Return the entry of a run's result for its drops."""
    kept = [astuple(one) for one in drops][:_DROP_KEPT]
    return {"drops": json.dumps(kept)} if kept else {}


def decode_drops(result: Mapping[str, str]) -> list[QueueDrops]:
    """Return the drops of a result; none if another program wrote them."""
    try:
        return [
            QueueDrops(int(entity), int(depth), int(count), bool(in_outage))
            for entity, depth, count, in_outage in json.loads(result.get("drops", "[]"))
        ]
    except (ValueError, TypeError):
        return []


# Topics whose messages did not leave a process, which no trace has, with the name of the process.


def encode_unseen(topics: Mapping[str, str]) -> dict[str, str]:
    """Return the entry of a run's result for such topics."""
    return {"unseen": json.dumps(topics, sort_keys=True)} if topics else {}


def decode_unseen(result: Mapping[str, str]) -> dict[str, str]:
    """Return such topics of a result; none if another program wrote them."""
    try:
        found = json.loads(result.get("unseen", "{}"))
        return {str(topic): str(process) for topic, process in found.items()}
    except (ValueError, AttributeError):
        return {}


def unseen_notes(topics: Mapping[str, str]) -> Iterator[str]:
    """Yield what is said of such topics, process by process."""
    for process in sorted(set(topics.values())):
        yield unseen_text((topic for topic, of in topics.items() if of == process), process)


def unseen_text(topics: Iterable[str], process: str) -> str:
    """Return what is said of such topics, without a full stop."""
    named = ", ".join(printable(topic) for topic in sorted(topics))
    return (
        f"messages on {named} stay in process {printable(process)} and are in no trace: it "
        "publishes them with intra-process communication, switch that off"
    )


# The guard's call counts, as in the metadata ``rsltrace:guard``.


def counts_text(counts: Iterable[GuardCount]) -> str:
    """Return the counts as sorted JSON."""
    rows = [[c.source.value, c.mode.value, c.node, c.call, c.count] for c in counts]
    return json.dumps(sorted(rows), ensure_ascii=False)


def parse_counts(text: str) -> tuple[GuardCount, ...]:
    """Return the counts of ``counts_text``. Raises TraceError for anything else."""
    try:
        return tuple(
            GuardCount(
                NondeterminismSource(source), GuardMode(mode), str(node), str(call), int(count)
            )
            for source, mode, node, call, count in json.loads(text)
        )
    except (ValueError, TypeError, RecursionError) as error:
        raise TraceError(f"the guard's summary in the trace cannot be read: {error}") from error


# Functions of rclpy that no simulation calls, because the loop does their work. Code that replaces
# one (a monitoring library) is never called; ``record`` and ``audit`` report it.

_TAKES = (
    *("_take_timer", "_take_subscription", "_take_client", "_take_service"),
    *("_take_guard_condition", "_take_waitable", "_make_handler", "can_execute"),
    "_wait_for_ready_callbacks",
)
EXECUTOR = "rclpy.executors.Executor"
_GROUP = ("can_execute", "beginning_execution", "ending_execution")

NEVER_CALLED: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(
        (
            EXECUTOR,
            "rclpy.executors.SingleThreadedExecutor",
            "rclpy.executors.MultiThreadedExecutor",
        ),
        _TAKES,
    ),
    "rclpy.callback_groups.MutuallyExclusiveCallbackGroup": _GROUP,
    "rclpy.callback_groups.ReentrantCallbackGroup": _GROUP,
}
"""Method names by class. Subclasses of callback groups are called, and so is an executor's
``wait_for_ready_callbacks``."""


# Calls that waited until the end of a run.

_WAITS_KEPT = 10
_HELD_KEPT = 1000


@dataclass(frozen=True, slots=True)
class EndlessWait:
    """A call that still waited at the end of a run and could not time out: since when (ns), who
    waits for what, and the ids of the entities it ``held`` back."""

    since_ns: int
    text: str
    held: tuple[int, ...] = ()


def encode_waits(waits: Iterable[EndlessWait]) -> dict[str, str]:
    """Return the entry of a run's result for its endless waits."""
    kept = [(one.since_ns, one.text, one.held[:_HELD_KEPT]) for one in waits][:_WAITS_KEPT]
    return {"waits": json.dumps(kept)} if kept else {}


def decode_waits(result: Mapping[str, str]) -> list[EndlessWait]:
    """Return the endless waits of a result, one line each; none if another program wrote them."""
    try:
        return [
            EndlessWait(
                int(since), printable(" ".join(str(text).split())), tuple(int(one) for one in held)
            )
            for since, text, held in json.loads(result.get("waits", "[]"))
        ]
    except (ValueError, TypeError):
        return []


# Exceptions of lifecycle callbacks: rclpy goes to the error state without a word of them.

_EXCEPTIONS_KEPT = 100


@dataclass(frozen=True, slots=True)
class SuppressedException:
    """An exception of ``callback`` in ``event``, raised at ``place`` (``camera.py:14``)."""

    event: int
    node: str
    callback: str
    error: str
    place: str


def encode_suppressed(exceptions: Iterable[SuppressedException]) -> dict[str, str]:
    """Return the entry of a run's result for its suppressed exceptions."""
    kept = [astuple(one) for one in exceptions][:_EXCEPTIONS_KEPT]
    return {"suppressed": json.dumps(kept)} if kept else {}


def decode_suppressed(result: Mapping[str, str]) -> list[SuppressedException]:
    """Return the suppressed exceptions of a result; none if another program wrote them."""
    try:
        return [
            SuppressedException(int(event), *(printable(str(text)) for text in texts))
            for event, *texts in json.loads(result.get("suppressed", "[]"))
        ]
    except (ValueError, TypeError):
        return []


class NondeterminismSource(str, Enum):
    """Sources of nondeterminism: kinds of calls with answers from outside, or random ones."""

    CLOCK = "clock"
    RANDOM = "random"
    DIRECTORY = "directory"
    FILE = "file"
    ENVIRONMENT = "environment"
    PID = "pid"
    THREAD = "thread"
    PROCESS = "process"
    SOCKET = "socket"
    ADDRESS = "address"
    ORDER = "order"


class GuardMode(str, Enum):
    """What the guard does about a source.

    ``virtual``: the run answers; ``record``: the trace keeps the real answer for a re-run;
    ``warn``: the call is a finding; ``error``: it ends the run; ``allow``: nothing.
    """

    VIRTUAL = "virtual"
    RECORD = "record"
    WARN = "warn"
    ERROR = "error"
    ALLOW = "allow"


READ_BY = ", read by "
"""Separates an environment variable and the library that reads it, in the text of a call."""

_ALWAYS = (GuardMode.WARN, GuardMode.ERROR, GuardMode.ALLOW)
MODES: Mapping[NondeterminismSource, tuple[GuardMode, ...]] = {
    NondeterminismSource.CLOCK: (GuardMode.VIRTUAL, GuardMode.RECORD, *_ALWAYS),
    NondeterminismSource.RANDOM: (GuardMode.VIRTUAL, GuardMode.RECORD, *_ALWAYS),
    NondeterminismSource.DIRECTORY: (GuardMode.VIRTUAL, *_ALWAYS),
    NondeterminismSource.FILE: (GuardMode.RECORD, *_ALWAYS),
    NondeterminismSource.ENVIRONMENT: (GuardMode.RECORD, *_ALWAYS),
    NondeterminismSource.PID: (GuardMode.VIRTUAL, GuardMode.RECORD, *_ALWAYS),
    NondeterminismSource.THREAD: _ALWAYS,
    NondeterminismSource.PROCESS: (GuardMode.RECORD, *_ALWAYS),
    NondeterminismSource.SOCKET: (GuardMode.RECORD, *_ALWAYS),
    NondeterminismSource.ADDRESS: _ALWAYS,
    NondeterminismSource.ORDER: (GuardMode.VIRTUAL, *_ALWAYS),
}
"""The possible modes of each source."""

DEFAULT_MODES: Mapping[NondeterminismSource, GuardMode] = {
    source: GuardMode.VIRTUAL if GuardMode.VIRTUAL in modes else GuardMode.WARN
    for source, modes in MODES.items()
}


@dataclass(frozen=True, slots=True)
class GuardPolicy:
    """The mode of each source in the code of one node, and the exempt modules.

    ``allowed`` has globs of module names by source. ``state`` is empty, ``true`` (hashed after each
    callback) or ``record`` (attributes are recorded, too).
    """

    modes: Mapping[NondeterminismSource, GuardMode] = field(default_factory=lambda: DEFAULT_MODES)
    allowed: Mapping[NondeterminismSource, tuple[str, ...]] = field(default_factory=dict)
    state: str = ""


@dataclass(frozen=True, slots=True)
class Finding:
    """A call that could make runs differ.

    ``event`` is the index of its event, ``entity`` what ran. ``call`` is the call
    (``os.environ['HOME']``), ``value`` its answer as text; ``stack`` has the lines of user code
    that led to it, innermost first, one per line.
    """

    event: int
    entity: int
    node: str
    source: NondeterminismSource
    mode: GuardMode
    call: str
    value: str
    stack: str

    @property
    def place(self) -> str:
        """``module.py:16`` of the user's line that made the call, "" if none did."""
        return self.stack.partition("\n")[0].partition(" in ")[0]


@dataclass(frozen=True, slots=True)
class GuardCount:
    """How often a node made one call in a run, and what was done about it."""

    source: NondeterminismSource
    mode: GuardMode
    node: str
    call: str
    count: int

    @property
    def is_finding(self) -> bool:
        """Whether runs may differ because of it: the run did not answer it."""
        return self.mode is not GuardMode.VIRTUAL
