"""Events as rows of the timeline: each in words, at its full length."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.event import (
    EventFlag,
    EventKind,
    EventRecord,
    Output,
    OutputKind,
    RandomDecision,
    decision_duration,
)
from rsltrace.trace.model.operation import PARAMETER_EVENTS
from rsltrace.trace.model.texts import format_seconds, printable, shortened
from rsltrace.trace.words.entities import RUN_NAME, SHORT_KINDS
from rsltrace.trace.words.logs import LEVEL_WARN, log_record
from rsltrace_viewer.model.run import Run

_ROWS_KEPT = 2048
_SUMMARY_MAX = 400
_NODE_WIDTH_MAX = 28


@dataclass(frozen=True, slots=True)
class EventText:
    index: int
    time: str = ""
    node: str = ""
    kind: str = ""
    entity: str = ""
    input_hash: str = ""
    output_hash: str = ""
    outputs: str = ""
    raised: bool = False
    warns: bool = False
    """Whether it logged a warning or worse."""
    delta: str = ""
    """How much later it happened in run b, if not at the same time."""
    short: str = ""
    """Of two runs, what to say instead of ``outputs`` where there is no room for that."""
    numbers: tuple[str, str] = ("", "")
    """Of two runs, its number in a and in b, as far as it stands in the row."""


class EventTexts:
    """Events of a run in words; what was shown last is kept."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self.of = lru_cache(maxsize=_ROWS_KEPT)(self._of)
        self.index_width = max(len(str(max(run.count - 1, 0))), 5)
        ends = (run.start_ns, run.end_ns)
        self.time_width = max(len(format_seconds(at - run.base_ns)) for at in ends)
        names = [run.node_name(e.id) for e in run.entities.values()]
        self.node_width = min(max(map(len, names), default=5), _NODE_WIDTH_MAX)
        entities = (_short(run.entity_name(e.id)) for e in run.entities.values())
        self.names = {"node": set(names), "entity": set(entities)}
        """What may stand in these columns."""

    def _of(self, index: int) -> EventText:
        """Return event ``index`` in words. Raises IndexError; damage is written into the row."""
        try:
            return self._readable(index)
        except TraceError as error:
            why = printable(f"unreadable: {error}")
            return EventText(index, outputs=why, raised=True)

    def _readable(self, index: int) -> EventText:
        run = self._run
        event = run.event(index)
        outputs = run.outputs(index) if event.outputs else []
        logs = [
            log_record(run.trace, output) for output in outputs if output.kind is OutputKind.LOG
        ]
        suspended = EventFlag.SUSPENDED in event.flags
        return EventText(
            index=index,
            time=format_seconds(event.stamp_ns - run.base_ns),
            node=node_of(run, event),
            kind=SHORT_KINDS[event.kind],
            entity=entity_of(run, event),
            input_hash=f"{event.input_hash:016x}"[:6] if event.input_hash else "·",
            output_hash=f"{event.output_hash:016x}"[:6] if event.output_hash else "·",
            outputs=outputs_text(run, outputs) or ("waits" if suspended else ""),
            raised=EventFlag.RAISED in event.flags,
            warns=any(log is not None and log.level >= LEVEL_WARN for log in logs),
        )


def node_of(run: Run, event: EventRecord) -> str:
    """Return the node of an event; the node that a constructor made."""
    outputs = run.outputs(event.index) if event.kind is EventKind.CONSTRUCT else ()
    return run.words.node(event, outputs) or RUN_NAME


def entity_of(run: Run, event: EventRecord) -> str:
    """Return the name of what ran, without what the kind says already."""
    if event.entity == 0:
        return "constructor" if event.kind is EventKind.CONSTRUCT else ""
    return _short(run.entity_name(event.entity))


def _short(name: str) -> str:
    # Timers are named after their callback: `Class._on_timer`. The node says the class.
    return name.rpartition(".")[2] if "." in name and not name.startswith("/") else name


def event_text(run: Run, event: EventRecord) -> str:
    """Return an event in a few words: ``17  /ekf sub /odom``."""
    kind = SHORT_KINDS[event.kind]
    return f"{event.index}  {node_of(run, event)} {kind} {entity_of(run, event)}".rstrip()


def _lateness(run: Run, output: Output) -> int:
    """Return how late an output is said: how long a callback took says least of what it did, and
    each constructor announces its parameters."""
    if output.kind is OutputKind.DRAW:
        return 2 * (decision_duration(output.hash, RandomDecision.EXECUTION) is not None)
    of = run.entities.get(output.entity)
    return int(of is not None and of.name == PARAMETER_EVENTS)


def outputs_text(
    run: Run,
    outputs: Sequence[Output],
    width: int = _SUMMARY_MAX,
    more: Callable[[Output], str] = lambda output: "",
) -> str:
    """Return what an event did as one line; ``more`` gives what else to say of an output."""
    parts: list[str] = []
    length = 0
    ordered = sorted(outputs, key=lambda output: _lateness(run, output))
    for text in run.words.outputs(ordered, more):
        parts.append(text)
        length += len(text)
        if length > width:
            break
    return shortened(", ".join(parts), width)
