"""What all native runs have in common: when they end, what goes wrong, and the trace of it."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from queue import Empty, SimpleQueue
from types import SimpleNamespace
from typing import Any

from rsltrace.errors import JobError, NodeError, RsltraceError, RunError, SetupError
from rsltrace.job import Job, locate
from rsltrace.native import support
from rsltrace.native.last_seconds import LastSeconds, LiveChecks, Programs
from rsltrace.native.priorities import order, real_time_class
from rsltrace.native.span_writer import ClockPair, SpanSource, SpanWriter
from rsltrace.run.inputs import check_output
from rsltrace.run.process import RunCallbacks
from rsltrace.run.provenance import (
    SourceHashes,
    environment,
    payload_filter,
    source_files,
    write_job,
)
from rsltrace.run.stop_rules import StopInputs, conditions_of, end_ns_of, stop_rules, watch_messages
from rsltrace.simulation.loop.policy import PriorityRule
from rsltrace.simulation.loop.stop import Progress, Stop
from rsltrace.simulation.middleware.events.failure import as_printed, exception_text
from rsltrace.trace.format import METADATA_ENVIRONMENT, METADATA_NATIVE
from rsltrace.trace.mcap.sink import unfinished_path
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

LOOK_EVERY_S = 0.01
ENDS_WITHIN_S = 5.0
_LOOK_FOR_LAST_S = 0.05
"""Of a run that goes on for days: it is to cost little."""
_TIMES = {"duration_ns", "time_ns", "timeout_ns"}


@dataclass(frozen=True, slots=True)
class NativeResult:
    """How a native run went. ``duration_ns`` is real time, from when the nodes began to spin.

    ``observer_ns`` is the median of what observing a callback took in its thread, ``pen_ns`` the
    processor time of writing it down beside it; ``callback_ns`` is that of a callback, with
    all of rclpy and the middleware. ``stuck`` are entries with a callback that did not come back at
    the end.
    """

    path: Path
    events: int
    duration_ns: int
    stop_reason: str
    exit_code: int
    observer_ns: int
    pen_ns: int
    callback_ns: int
    error: RunError | None = None
    stuck: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    kept: str = ""
    failed_checks: Mapping[str, int] = field(default_factory=dict)
    """How often checks failed while only the last seconds were kept."""


@dataclass(frozen=True, slots=True)
class NativeOptions:
    """``executor`` is that of each entry, ``single`` or ``multi`` (threaded). With ``processes``
    each entry is a process of its own, as it is anyway if one of them is a program. Without a
    ``domain_id`` the nodes are alone in a free domain of this machine. ``policy`` gives callbacks
    and threads priorities: ``rate_monotonic``, or ``priority``, that of the job."""

    executor: str = "single"
    processes: bool = False
    domain_id: int | None = None
    policy: str | None = None


@dataclass
class NativeRun:
    """A native run. Only its own thread calls it, but for ``stop`` and ``fail``.

    ``rules`` are those of its policy, None if it goes by rate; ``levels`` are the real-time
    priorities that threads had.
    """

    job: Job
    observer: RunCallbacks
    options: NativeOptions
    rules: tuple[PriorityRule, ...] | None = None
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.error: RunError | None = None
        self.ending: Stop | None = None
        # A signal handler calls ``stop``, in the middle of whatever the main thread does: an Event
        # or a Lock, which a thread may take only once, could wait for itself.
        self._wake_up: SimpleQueue[None] = SimpleQueue()
        self._lock = threading.RLock()
        self.levels: dict[str, int] = {}
        self.last: LastSeconds | None = None
        self._missing: list[tuple[int, str]] = []
        """Since when (steady) the trace lacks something, or may lack it."""
        self.begun_ns = 0
        self.ended_ns = 0
        self._start_ns = self.job.start_ns or 0

    def note(self, text: str) -> None:
        """Tell whoever watches, before the run begins."""
        if self.observer.note is not None:
            self.observer.note(text)

    def prepare(self, output: Path) -> None:
        """Find what can be known to be wrong before anything is started."""
        inputs = StopInputs(self.job, self._start_ns, trace_size=lambda: self.writer.size)
        self._stop_rules = stop_rules(inputs)
        self._conditions = conditions_of(self._stop_rules)
        if self.options.policy is not None and (refused := real_time_class()):
            self.note(f"{refused}; executors go by priorities all the same")
        self._check_last()
        if without := support.ignored(self.job, self.options.policy):
            self.note(
                f"a native run is not steered; without effect in the job: {', '.join(without)}"
            )
        for place in (output, unfinished_path(output)):
            check_output(self.job, place, None)

    def _check_last(self) -> None:
        """Raise ``JobError`` if the run cannot keep its last seconds only."""
        seen = self.job.stop.given_fields - _TIMES
        if self.job.record.last is not None and seen:
            raise JobError(
                "a run of which only the last seconds are kept is not looked at while it goes on: "
                "end it by a time (duration, time, timeout) or Ctrl-C",
                where=locate(self.job, ("stop", seen.pop())),
            )

    def create(
        self,
        stack: ExitStack,
        output: Path,
        spans: SpanSource,
        described: Mapping[str, str],
        sources: Mapping[str, Path] | None = None,
        programs: Programs | None = None,
        *,
        force: bool,
    ) -> None:
        """Create the trace, which ``spans`` come to. ``sources`` are the files of the user's code,
        None if they are loaded here; ``programs`` keep their last seconds themselves."""
        self._output = output
        self._described = described, sources
        if self.observer.interrupt is not None:
            self.observer.interrupt(self.stop)
        self.clocks = ClockPair.now()
        if self.job.record.last is not None:
            spans = self._keep_last(stack, spans, programs)
        self.writer = stack.enter_context(self._new_trace(output, force=force))
        self.span_writer = self._span_writer(self.writer, spans)

    def _new_trace(self, path: Path, *, force: bool) -> TraceWriter:
        job, policy = self.job, self.options.policy
        described, sources = self._described
        discovery = "this machine" if self.options.domain_id is None else "as the environment says"
        writer = TraceWriter(path, force=force, events_per_segment=job.record.segment_events)
        write_job(writer, job)
        writer.add_metadata(METADATA_ENVIRONMENT, environment(job))
        SourceHashes(writer, source_files(job) if sources is None else sources)
        writer.add_metadata(
            METADATA_NATIVE,
            {
                "mode": "native",
                **described,
                "discovery": discovery,
                "wall_ns": str(self.clocks.wall_ns),
                "steady_ns": str(self.clocks.steady_ns),
                "ignored": ", ".join(support.ignored(job, policy)),
                **({} if policy is None else {"policy": policy, "priorities": order()}),
            },
        )
        return writer

    def _span_writer(self, writer: TraceWriter, spans: SpanSource) -> SpanWriter:
        recorder = Recorder(writer, keep_payload=payload_filter(self.job))
        look = None if self.last is None else self.last.look
        return SpanWriter(spans, recorder, self.clocks, self.job.base_dir, look)

    # -- only the last seconds ------------------------------------------------------------------

    def _keep_last(
        self, stack: ExitStack, spans: SpanSource, programs: Programs | None
    ) -> LastSeconds:
        spec = self.job.record.last
        assert spec is not None
        self.last = last = LastSeconds(
            spec, spans, programs, payload_filter(self.job), self._keep_file
        )
        last.checks = LiveChecks(
            self.job,
            self.clocks.stamp,
            lambda name, reason: last.trigger(reason, kind=f"check {name}"),
            self._not_judged,
        )
        if last.checks.later:
            self.note(f"judged only at the end: {'; '.join(last.checks.later)}")
        if threading.current_thread() is threading.main_thread():
            before = signal.signal(signal.SIGUSR1, lambda *_: last.trigger("SIGUSR1", at_once=True))
            stack.callback(signal.signal, signal.SIGUSR1, before)
        self.note(
            f"the last {format_seconds(spec.duration_ns)} s are kept: kill -USR1 {os.getpid()} "
            "writes them to a file"
        )
        return last

    def _not_judged(self, text: str) -> None:
        self.note(text)
        self.lacks(text)

    def _keep_file(self, reason: str) -> None:
        """Write the last seconds to a file of their own; the run goes on."""
        if self.ending is not None:  # the end of the run is a file, too
            return
        assert self.last is not None
        numbers = (self._output.with_stem(f"{self._output.stem}-{n}") for n in count(1))
        path = next(path for path in numbers if not path.exists())
        try:
            with self._new_trace(path, force=False) as writer:
                written = self._span_writer(writer, self.last)
                written.write(None)
                self._close_trace(writer, written, f"kept: {reason}", 0, 0)
        except RsltraceError as error:
            self.note(f"the last seconds are not kept: {error}")
        else:
            self.note(f"wrote {path}: {reason}")

    def _close_trace(
        self,
        writer: TraceWriter,
        written: SpanWriter,
        reason: str,
        exit_code: int,
        ended_after: int,
        more: Mapping[str, str] | None = None,
    ) -> None:
        now_ns, start_ns = time.monotonic_ns(), self.clocks.steady_ns
        if self.last is not None:  # writing it takes time
            since_ns, now_ns = self.last.span_ns
            start_ns = max(start_ns, since_ns)
        missing = [text for at_ns, text in self._missing if at_ns >= start_ns]
        missing += [] if self.last is None else self.last.missing
        writer.close(
            result={
                "start_time": str(self.clocks.stamp(start_ns)),
                "end_time": str(self.clocks.stamp(now_ns)),
                "stop_reason": reason,
                "exit_code": str(exit_code),
                "ended_after": str(ended_after or written.count),
                "observer_ns": str(written.observer_ns),
                "unknown_causes": str(written.causes.unknown),
                **(more or {}),
                **({"missing": "; ".join(missing)} if missing else {}),
            },
            replace=self.begun_ns > 0 or exit_code == 0,
        )

    def watch_stop_topics(self, on_message: dict[str, Any]) -> None:
        """Let messages end the run: ``on_message`` gets a function of bytes and class by topic."""

        def watch(topic: str, watcher: Callable[[Any, bytes], None]) -> None:
            others = on_message.get(topic)

            def received(data: bytes, type: Any) -> None:
                if others is not None:
                    others(data, type)
                try:
                    watcher(SimpleNamespace(msg_type=type), data)
                except RsltraceError as error:
                    self.fail(RunError(str(error)))

            on_message[topic] = received

        watch_messages(self._stop_rules, watch, self.stop)

    def wait(self) -> Iterator[None]:
        """Yield again and again until the run is over. ``begun_ns`` says since when it lasts."""
        every_s = LOOK_EVERY_S if self.last is None else _LOOK_FOR_LAST_S
        while self.ending is None and self.span_writer.error is None:
            try:
                self._wake_up.get(timeout=every_s)
            except Empty:
                yield
        self.ended_ns = time.monotonic_ns()
        if self.last is not None:
            self.last.ended_ns = self.ended_ns

    def lacks(self, text: str) -> None:
        """Take note of what the trace lacks, or may lack."""
        self._missing.append((time.monotonic_ns(), text))

    def look(self, events: int, activity_ns: int) -> None:
        """End the run if it is time. ``activity_ns`` is when something was last sent, steady."""
        now_ns = time.monotonic_ns() - self.begun_ns + self._start_ns
        last_ns = max(activity_ns - self.begun_ns, 0) + self._start_ns
        progress = Progress(now_ns, None, self._start_ns, events, last_ns)
        for condition in self._conditions:
            stop = condition(progress)
            if stop is not None:
                self.stop(stop)
                return
        if self.observer.progress is not None:
            self.observer.progress(now_ns, end_ns_of(self.job, self._start_ns), events)

    def stop(self, stop: Stop) -> None:
        """End the run, from any thread; the first reason counts."""
        with self._lock:
            if self.ending is None:
                self.ending = stop
        self._wake_up.put(None)

    def fail(self, error: RunError, reason: str = "") -> None:
        """End the run because of an error, from any thread."""
        with self._lock:
            if self.error is None and self.ending is None:
                self.error = error
        self.stop(Stop(reason or str(error).splitlines()[0], error.exit_code))

    def raised(
        self, what: str, entry: str, node: str, kind: str, said: str, traceback: str
    ) -> None:
        """End the run because code of the user raised an exception."""
        reason = f"{what} raised {kind}"
        stamp_ns = self.clocks.stamp(time.monotonic_ns())
        error = NodeError(
            f"{what} raised {as_printed(kind, said)}",
            node=node,
            entity=entry,
            stamp_ns=stamp_ns,
            traceback_text=traceback,
        )
        self.fail(error, reason)

    def close(
        self,
        ended_after: int,
        stuck: Mapping[str, str],
        unreadable: int,
        *,
        callbacks_ns: int,
        beside_ns: int = 0,
    ) -> NativeResult:
        """Write what is left, close the trace, and say how it went. Processor time: that of
        callbacks with rclpy and the middleware (and what observes them in their threads), and that
        of reporting it beside them. ``stuck`` are entries, and where their callbacks are.

        :raises OutputError: if the trace cannot be written.
        """
        self.span_writer.finish()
        events = self.span_writer.count
        stop = self.ending or Stop("nothing is left")
        exit_code = self.error.exit_code if self.error is not None else stop.exit_code
        observer_ns = self.span_writer.observer_ns
        pen_ns = (self.span_writer.cpu_ns + beside_ns) // max(events, 1)
        callback_ns = callbacks_ns // max(events, 1)
        more = {"pen_ns": str(pen_ns), "callback_ns": str(callback_ns), **self._levels()}
        self._close_trace(self.writer, self.span_writer, stop.reason, exit_code, ended_after, more)
        checks = None if self.last is None else self.last.checks
        return NativeResult(
            path=self.writer.place,
            events=events,
            duration_ns=self.ended_ns - self.begun_ns,
            stop_reason=stop.reason,
            exit_code=exit_code,
            observer_ns=observer_ns,
            pen_ns=pen_ns,
            callback_ns=callback_ns,
            error=self.error,
            stuck=tuple(stuck),
            notes=(*self.notes, *_said(stuck, unreadable)),
            kept=self.writer.kept,
            failed_checks={} if checks is None else checks.failed,
        )

    def _levels(self) -> dict[str, str]:
        if self.options.policy is None:
            return {}
        levels = sorted(self.levels.items(), key=lambda one: (-one[1], one[0]))
        return {"thread_priorities": ", ".join(f"{name} {level}" for name, level in levels)}


def _said(stuck: Mapping[str, str], unreadable: int) -> Iterator[str]:
    for name, place in stuck.items():
        yield f"a callback of {name} did not return within {ENDS_WITHIN_S:g} s of the end{place}"
    if unreadable:
        yield f"{unreadable} messages could not be read as bytes: no hash of them"


@contextmanager
def rclpy_running(*, echo: bool) -> Iterator[None]:
    """Initialize rclpy, and shut it down afterwards.

    :raises SetupError: if the middleware cannot be started.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    quiet = [] if echo else ["--ros-args", "--disable-stdout-logs"]
    try:
        rclpy.init(args=quiet, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:
        raise SetupError(
            f"ROS's middleware cannot be started: {exception_text(error)}; "
            "see RMW_IMPLEMENTATION, and "
            "whether the loopback network is up (ip link)"
        ) from error
    try:
        yield
    finally:
        rclpy.try_shutdown()
