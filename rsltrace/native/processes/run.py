"""A native run in which each entry is a process of its own, as ``ros2 launch`` has it."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rsltrace import errors
from rsltrace.adapters.rclpy.boundary.installation import native_extension
from rsltrace.adapters.rclpy.entry import StartRule
from rsltrace.adapters.rclpy.messages.interfaces import get_message_class
from rsltrace.child_processes import how_ended
from rsltrace.errors import JobError, RsltraceError, RunError
from rsltrace.native.callback_observer import EXECUTORS
from rsltrace.native.native_run import ENDS_WITHIN_S, LOOK_EVERY_S, NativeResult, NativeRun
from rsltrace.native.processes.children import ObservedProcess, ProcessStart
from rsltrace.native.processes.plans import start_rules, starts_of
from rsltrace.native.processes.programs import ObservedProgram, variables_of
from rsltrace.native.processes.wire import EntryOrder, Frame, SpanDecoder
from rsltrace.native.span_recorder import CallbackSpan, SentMessage, now_ns
from rsltrace.native.support import Patience, check_loopback, domain
from rsltrace.run.plans.entries import missed_starts
from rsltrace.run.stop_rules import has_stop
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.failure import as_printed
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import NS_PER_S, format_seconds

# When the entries of a native run begin that do not begin with it (``start_after:``).


StartFact = tuple[str, str]
"""What has come true: ``topic``, ``service``, ``node``, ``started`` or ``ended``, and its name."""

_MADE = {EntityKind.NODE: "node", EntityKind.SERVICE: "service"}


class StartQueue:
    """Takes facts from threads, and says which entries begin."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._facts: set[StartFact] = set()
        self._waiting: list[tuple[ObservedProcess, StartRule, int]] = []

    @property
    def waiting(self) -> list[ObservedProcess]:
        """The processes that have not begun."""
        return [child for child, _, _ in self._waiting]

    def add(self, child: ObservedProcess, rule: StartRule) -> None:
        """Let a process begin once its rule is met."""
        self._waiting.append((child, rule, now_ns()))

    def tell(self, what: str, name: str) -> None:
        """Say what has come true."""
        with self._lock:
            self._facts.add((what, name))

    def look_at(self, spans: Iterable[CallbackSpan]) -> None:
        """Find in what was observed what has come true."""
        found: set[StartFact] = set()
        for span in spans:
            for output in span.outputs:
                if isinstance(output, SentMessage) and output.kind == OutputKind.MESSAGE:
                    found.add(("topic", output.entity.name))
                elif isinstance(output, Entity) and output.kind in _MADE:
                    found.add((_MADE[output.kind], output.name))
        with self._lock:
            self._facts |= found

    def due(self) -> Iterator[ObservedProcess]:
        """Yield the processes that are to begin now."""
        now, left = now_ns(), []
        for waiting in self._waiting:
            child, rule, since_ns = waiting
            if self.unmet(rule):
                left.append((child, rule, now))
            elif now - since_ns >= rule.delay_ns:
                yield child
            else:
                left.append(waiting)
        self._waiting = left

    def unmet(self, rule: StartRule) -> list[str]:
        """Return what of a rule has not come true."""
        wanted = [
            (what, getattr(rule, what)) for what in ("topic", "service", "node", "started", "ended")
        ]
        with self._lock:
            return [what for what, name in wanted if name and (what, name) not in self._facts]

    def missed(self) -> list[tuple[str, list[str]]]:
        """Return the keys of the entries that have not begun, and what they waited for."""
        return [(child.what.key, self.unmet(rule)) for child, rule, _ in self._waiting]


# What several processes have done, in the order in which it began.
#
# All have one steady clock. A process says up to when it has sent everything; what began before
# that in all of them is in order for good.

STALLED_NS = 20 * NS_PER_S
"""A process that says nothing for so long (stopped, or in a call that keeps the interpreter) must
not keep all others from the file."""


class ProcessSpans:
    """One process: the spans that it has sent, up to when these are all, and when it has said so:
    on a busy machine that is read long after it."""

    def __init__(self) -> None:
        self.spans: deque[CallbackSpan] = deque()
        self.until_ns = self.advanced_ns = now_ns()
        self.is_being_read = self.is_over = False


class SpanMerger:
    """Takes spans from threads, and gives them in the order of their starts."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sources: list[ProcessSpans] = []
        self._latest_ns = 0
        self.until_ns = 0
        self.late = 0
        """Spans that came too late for their place, and were put after what was written."""

    def source(self) -> ProcessSpans:
        """Return a new source: nothing is in order from now on before it has said so."""
        with self._lock:
            source = ProcessSpans()
            self._sources.append(source)
            return source

    def add(self, source: ProcessSpans, spans: list[CallbackSpan], until_ns: int) -> None:
        """Add spans in the order of their starts; no other one will begin before ``until_ns``."""
        with self._lock:
            source.spans.extend(spans)
            source.is_being_read = False
            if until_ns > source.until_ns:
                source.until_ns, source.advanced_ns = until_ns, now_ns()

    def end(self, source: ProcessSpans) -> None:
        """Take note that nothing more comes from a source."""
        with self._lock:
            source.is_over = True

    def finished(self, patience_ns: int | None) -> list[CallbackSpan]:
        """Take what is in order, everything if ``patience_ns`` is None."""
        with self._lock:
            now, until_ns = now_ns(), self._until(patience_ns)
            self.until_ns = now if until_ns is None else until_ns
            taken = self._taken(until_ns)
        for span in taken:
            if span.start_ns < self._latest_ns:
                self.late += 1
                span.start_ns = self._latest_ns
                span.end_ns = max(span.end_ns, span.start_ns)
            self._latest_ns = span.start_ns
        return taken

    def _until(self, patience_ns: int | None) -> int | None:
        if patience_ns is None:
            return None
        patient_ns = now_ns() - STALLED_NS
        waited = [
            source.until_ns
            for source in self._sources
            if not source.is_over and (source.is_being_read or source.advanced_ns > patient_ns)
        ]
        return min(waited, default=None)

    def _taken(self, until_ns: int | None) -> list[CallbackSpan]:
        taken: list[CallbackSpan] = []
        for source in self._sources:
            spans = source.spans
            while spans and (until_ns is None or spans[0].start_ns < until_ns):
                taken.append(spans.popleft())
        self._sources = [one for one in self._sources if one.spans or not one.is_over]
        taken.sort(key=lambda span: span.start_ns)
        return taken


_KILLED_WITHIN_S = 3.0
"""A process that is stuck ends itself before; this is for one that cannot."""
Counts = tuple[int, int, int, int, int]
"""Of a process: its events, when it was last active (steady), messages that could not be read,
its processor time, and that of telling of it."""
_SHARED_MEMORY = Path("/dev/shm")
_ROOM = 1 << 30
"""As much has to be free there."""
_QUIET_ENDS = ("KeyboardInterrupt", "ExternalShutdownException")


def _memory_folder() -> Path | None:
    """Return where files are memory only, None if there is no room: a disk would be written to all
    the time."""
    with suppress(OSError):
        if shutil.disk_usage(_SHARED_MEMORY).free >= _ROOM and os.access(_SHARED_MEMORY, os.W_OK):
            return _SHARED_MEMORY
    return None


class MultiProcessRun(NativeRun):
    """Each entry of the job in a process of its own; what they tell is merged into one trace."""

    def open(self, stack: ExitStack, output: Path, *, force: bool, echo: bool) -> None:
        """Start the processes up to where they could begin, then create the trace."""
        self.merge = SpanMerger()
        self.starts = StartQueue()
        self.children: list[ObservedProcess] = []
        self._ids, self._threads = count(1), count(1)
        self._told: dict[ObservedProcess, tuple[SpanDecoder, ProcessSpans]] = {}
        self._programs: dict[ObservedProcess, ObservedProgram] = {}
        folder = TemporaryDirectory(prefix="rsltrace-", dir=_memory_folder())
        self._folder = Path(stack.enter_context(folder))
        self._counts: dict[ObservedProcess, Counts] = {}
        self._sources: dict[str, Path] = {}
        self._refusal: RsltraceError | None = None
        self._restarts: list[tuple[int, ProcessStart]] = []
        self._restarted: Counter[str] = Counter()
        self._news = threading.Lock()
        self._on_message: dict[str, Any] = {}
        self._log_type = get_message_class("rcl_interfaces/msg/Log")
        self.prepare(output)
        self._rules = start_rules(self.job)
        if self.job.record.last is not None and any(
            rule.topic or rule.service or rule.node for rule in self._rules.values()
        ):
            raise JobError(
                "a run of which only the last seconds are kept is not looked at while it goes on: "
                "start_after takes only started, ended and delay there"
            )
        if self.options.domain_id is None:
            check_loopback()
        number = stack.enter_context(domain(self.options.domain_id))
        stack.callback(self._kill_all)
        kind = EXECUTORS[self.options.executor]
        like = EntryOrder(self.job, 0, kind, echo, self.options.policy, self.rules)
        starts = starts_of(self.job, like, self.note)
        for start in starts:
            self._start(start)
        self._wait_until_ready()
        described = {
            "middleware": native_extension().rclpy_get_rmw_implementation_identifier(),
            "executor": f"{EXECUTORS[self.options.executor]} per entry of the job",
            "processes": str(len(starts)),
            "domain": str(number),
        }
        mains = [one.name for one in starts if one.is_main and not one.loads]
        if self.options.policy is not None and mains:
            self.note(
                f"--policy has no effect in mains, which spin for themselves: {', '.join(mains)}"
            )
        if unobserved := [
            one.name for one in starts if one.order.command and one.order.environment is None
        ]:
            described["not observed"] = ", ".join(unobserved)
            self.note(
                f"not observed: {', '.join(unobserved)}; what these send is seen where it arrives, "
                "and its cause is unknown"
            )
        self.create(stack, output, self.merge, described, self._sources, self, force=force)
        self.watch_stop_topics(self._on_message)

    def _start(self, start: ProcessStart) -> ObservedProcess:
        order, program = start.order, None
        if order.environment is not None:
            folder = self._folder / str(len(self.children))
            folder.mkdir()
            variables = {**order.environment, **variables_of(self.job, folder)}
            start = replace(start, order=replace(order, environment=variables))
            program = ObservedProgram(start.name, folder, self._ids, self._threads)
        child = ObservedProcess(start, self._hear, self._ended)
        if program is not None:
            program.own = child.number
            self._programs[child] = program
        self.children.append(child)
        return child

    def _wait_until_ready(self) -> None:
        for child in self.children:
            while not child.is_ready.wait(LOOK_EVERY_S * 10):
                pass
        if self._refusal is not None:
            raise self._refusal
        if self.error is not None:
            raise self.error

    # -- what processes tell, in threads of their own -------------------------------------------

    def _hear(self, child: ObservedProcess, frame: Frame) -> None:
        what, *values = frame
        if what == "spans":
            self._hear_spans(child, *values)
        elif what == "look":
            self._look_at(child)
        elif what == "ready":
            self._sources.update({name: Path(path) for name, path in values[0].items()})
            child.is_ready.set()
        elif what == "constructed":
            self.starts.tell("started", child.what.key)
        elif what == "error":
            self._hear_error(child, *values)
        elif what == "raised":
            self._hear_raised(child, *values)
        elif what == "shutdown":
            child.has_failed = True
            self.stop(Stop(f"{child.what.name} has ended: rclpy was shut down"))
        elif what == "forked":
            child.forks += 1
        elif what == "end":
            child.has_told_all = True
        elif what == "exit":
            child.exit_text = values[0]
        elif what == "levels":
            self.levels.update(values[0])
        elif what == "stopping":
            child.has_heard.set()
        elif what == "stuck":
            child.is_stuck, child.stuck_at = True, str(values[0])
        else:
            raise ValueError(f"an unknown frame, {what!r}")

    def _hear_spans(
        self,
        child: ObservedProcess,
        until_ns: int,
        counts: Counts,
        definitions: list[tuple[Any, ...]],
        spans: list[tuple[Any, ...]],
    ) -> None:
        reader, source = self._told[child]
        source.is_being_read = True
        reader.define(definitions)
        found = [reader.span(values) for values in spans]
        self._counts[child] = counts
        self._add(source, found, until_ns)

    def _look_at(self, child: ObservedProcess, *, is_over: bool = False) -> None:
        """Take what a program has done."""
        program = self._programs.get(child)
        if program is None or child not in self._told or self.last is not None:
            return
        self._told[child][1].is_being_read = True
        try:
            found, until_ns = program.read(is_over=is_over)
        except Exception as error:
            del self._programs[child]
            self.merge.end(self._told[child][1])
            self.lacks(f"what {child.what.name} did from {self._at} s on: {error}")
            return
        self._counts[child] = program.counts
        self._add(self._told[child][1], found, until_ns)

    def _add(self, source: ProcessSpans, found: list[CallbackSpan], until_ns: int) -> None:
        if self._rules:
            self.starts.look_at(found)
        if self._on_message:
            self._look_for_end(found)
        self.merge.add(source, found, until_ns)

    def _look_for_end(self, spans: list[CallbackSpan]) -> None:
        for span in spans:
            for output in span.outputs:
                if isinstance(output, SentMessage) and (
                    callback := self._on_message.get(output.entity.name)
                ):
                    type_name = "" if output.entity.sends is None else output.entity.sends.name
                    callback(output.data, get_message_class(type_name))

    def _hear_error(self, child: ObservedProcess, kind: str, said: str) -> None:
        child.has_failed = True
        if child.has_begun:
            self.fail(RunError(said))
            return
        with self._news:
            if self._refusal is None:
                self._refusal = getattr(errors, kind)(said)

    def _hear_raised(
        self, child: ObservedProcess, what: str, node: str, kind: str, said: str, traceback: str
    ) -> None:
        child.has_failed = True
        if child.is_stopping:
            if kind not in _QUIET_ENDS:
                self.notes.append(
                    f"{child.what.name}, told to end, raised {as_printed(kind, said)}"
                )
            return
        self.raised(what, child.what.name, node, kind, said, traceback)

    def _ended(self, child: ObservedProcess, status: int) -> None:
        """Take note of the end of a process."""
        self._look_at(child, is_over=True)
        self._look_for_missing(child, status)
        if child in self._told:
            self.merge.end(self._told[child][1])
        what, how = child.what, how_ended(status)
        if child.exit_text:
            how += f": {child.exit_text}"
        self.starts.tell("ended", what.key)
        if child.is_stopping or child.has_failed:
            if status < 0 and child.has_begun and not (child.is_stuck or status == -signal.SIGINT):
                self.notes.append(f"{what.name}, told to end, {how}")
            return
        if not child.has_begun:
            if self._refusal is None:
                self._refusal = RunError(f"the process of {what.name} {how} before it began")
            return
        if self.last is not None and status:
            self.last.trigger(f"{what.name} {how}")
        if what.respawn is not None and self._restart(what):
            self.notes.append(f"{what.name} {how} at {self._at} s, and was started again")
        elif (status < 0 or (status > 0 and what.order.command)) and not what.may_fail:
            self.fail(RunError(f"{what.name} {how}, {self._at} s after the start of the run"))
        elif not what.is_main and not what.may_fail:
            self.fail(RunError(f"{what.name} {how} in the middle of the run, at {self._at} s"))
        elif status != 0 or not what.loads:
            self.notes.append(f"{what.name} {'ended' if status == 0 else how} at {self._at} s")
        if what.required:
            self.stop(Stop(f"{what.key} has ended, which the run requires"))
        if what.order.plays_bags and not has_stop(self.job):
            self.stop(Stop("end of the bag"))

    def _look_for_missing(self, child: ObservedProcess, status: int) -> None:
        """Take note of what the trace lacks, or may lack, of a process that has ended."""
        what, name, program = child.what, child.what.name, self._programs.get(child)
        if program is not None and program.lost and self.last is None:
            self.lacks(f"{program.lost} records of {name}, for which there was no room")
        if program is not None and self.last is None:
            for text in self._without_file(child, program):
                self.lacks(text)
        if child.forks:
            self.lacks(f"of {name}, what {child.forks} copies did that it forked")
        if child.has_begun and status >= 0 and not (what.order.command or child.has_told_all):
            self.lacks(
                f"of {name}, all after it used os._exit, became another program or closed "
                "rsltrace's file descriptor"
            )
        if child.has_begun and status < 0 and not (status == -signal.SIGINT or child.has_told_all):
            is_late = program is None and not child.has_heard.is_set()
            lost = "the last 50 ms" if is_late else "what each thread was just doing"
            self.lacks(f"of {name}, which {how_ended(status)} at {self._at} s, {lost}")

    def _without_file(self, child: ObservedProcess, program: ObservedProgram) -> Iterator[str]:
        if child.is_over and program.unobserved:
            yield (
                f"{program.unobserved} processes of {child.what.name}, which made no file: killed "
                f"before, or no room in {self._folder}"
            )

    @property
    def _at(self) -> str:
        return format_seconds(max(time.monotonic_ns() - self.begun_ns, 0))

    def _restart(self, what: ProcessStart) -> bool:
        assert what.respawn is not None
        delay_ns, times = what.respawn
        with self._news:
            if times is not None and self._restarted[what.key] >= times:
                return False
            self._restarted[what.key] += 1
            self._restarts.append((time.monotonic_ns() + delay_ns, what))
        return True

    # -- if only the last seconds are kept --------------------------------------------------------

    def look_at_programs(self, since_ns: int) -> Iterator[tuple[int, str]]:
        """Look at the programs (``last_seconds.Programs``)."""
        for child, program in list(self._programs.items()):
            yield from program.look(since_ns)
            if child.is_over and program.is_forgotten:
                del self._programs[child]

    def checked(self) -> list[CallbackSpan]:
        """Return what programs have sent on topics of checks."""
        return [span for program in list(self._programs.values()) for span in program.checked()]

    def last_of_programs(self, since_ns: int) -> tuple[list[CallbackSpan], list[str]]:
        """Return what programs keep, and what is missing of it."""
        spans: list[CallbackSpan] = []
        missing: list[str] = []
        for child, program in list(self._programs.items()):
            try:
                found, lost = program.last(since_ns)
            except Exception as error:
                missing.append(f"what {child.what.name} did: {error}")
            else:
                spans += found
                missing += [*lost, *self._without_file(child, program)]
        return spans, missing

    # -- the run --------------------------------------------------------------------------------

    def go_on(self) -> None:
        """Let the processes begin, as the job says, and wait until the run ends."""
        self.span_writer.start()
        self.begun_ns = time.monotonic_ns()
        for child in list(self.children):
            rule = self._rules.get(child.what.key)
            if rule is None:
                self._go(child)
            else:
                self.starts.add(child, rule)
        for _ in self.wait():
            for child in self.starts.due():
                self._go(child)
            self._start_again()
            counts = list(self._counts.values())
            self.look(sum(one[0] for one in counts), max((one[1] for one in counts), default=0))
            self._look_for_mains()

    def _go(self, child: ObservedProcess) -> None:
        reader = SpanDecoder(self._ids, self._threads, self._log_type)
        self._told[child] = reader, self.merge.source()
        if self.last is not None and child in self._programs:  # nothing comes before its end
            self.merge.end(self._told[child][1])
        child.go()

    def _start_again(self) -> None:
        """Start what has ended and is to come again."""
        now_ns = time.monotonic_ns()
        with self._news:
            due = [what for at_ns, what in self._restarts if at_ns <= now_ns]
            self._restarts = [one for one in self._restarts if one[0] > now_ns]
        for what in due:
            self.starts.add(self._start(what), StartRule())

    def _look_for_mains(self) -> None:
        """End the run once every main has ended, if there is nothing else."""
        over = all(child.is_over and child.what.is_main for child in self.children)
        if over and not (self.starts.waiting or self._restarts):
            self.stop(Stop("every main has ended"))

    def finish(self) -> NativeResult:
        """Stop the processes, close the trace, and say how it went.

        :raises OutputError: if the trace cannot be written.
        """
        ended_after = sum(one[0] for one in self._counts.values())
        going = [child for child in self.children if not child.is_over]
        for child in going:
            child.stop()
        for child in going:
            child.interrupt()
        patience = Patience(ENDS_WITHIN_S)
        for child in self.children:
            if not patience.wait_for_end(child):
                child.terminate()
        patience = Patience(_KILLED_WITHIN_S)
        for child in self.children:
            if not patience.wait_for_end(child):
                child.is_stuck = True
                child.kill()
                child.join()
        if self.merge.late:
            self.notes.append(
                f"{self.merge.late} events came more than {STALLED_NS // NS_PER_S} s late from "
                "processes that stood still, and are later in the trace than they were"
            )
        self.notes += missed_starts(self.job, self.starts.missed())
        stuck = {c.what.name: c.stuck_at for c in self.children if c.is_stuck}
        unreadable, cpu_ns, beside_ns = (
            sum(one[place] for one in self._counts.values()) for place in (2, 3, 4)
        )
        return self.close(
            ended_after,
            stuck,
            unreadable,
            callbacks_ns=cpu_ns - beside_ns,
            beside_ns=beside_ns,
        )

    def _kill_all(self) -> None:
        """Leave no process behind, whatever has happened."""
        for child in self.children:
            if not child.is_over:
                child.kill()
        for child in self.children:
            child.join()
