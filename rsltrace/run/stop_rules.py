"""What ends a run: a class for each key of ``stop:``, in the table ``STOP_RULES``.

To add a stop condition, add its key to ``StopSpec`` (``rsltrace/job/parts/stop.py``), a class here,
and a row in the table. Simulated and native runs both use the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

from rsltrace.errors import JobError, RunError, nearest
from rsltrace.fast_dataclass import dataclass
from rsltrace.job import Job, locate, showing_line
from rsltrace.job.parts.stop import TopicStop
from rsltrace.job.values.times import TimeInRun, format_size
from rsltrace.run.plans.scheduling import load_target
from rsltrace.simulation.loop.stop import Progress, Stop, StopCondition, stop_at
from rsltrace.trace.model.texts import format_seconds


@dataclass(frozen=True, slots=True)
class StopInputs:
    """The run that stop rules end. ``trace_size`` is the size of its file in bytes; code of the
    user is called within ``outside_events()``."""

    job: Job
    start_ns: int
    trace_size: Callable[[], int] = lambda: 0
    outside_events: Callable[[], AbstractContextManager[None]] = nullcontext


class StopRule:
    """A key of ``stop:`` with its ``value`` in the job.

    Override ``check`` to be asked after each time step, or ``topic`` and ``on_message`` to see the
    messages of a topic.
    """

    prevents_forks: ClassVar[str] = ""
    """Why no other run can be forked from a run with this rule."""

    def __init__(self, value: Any, run: StopInputs) -> None:
        self.value = value

    @classmethod
    def end_ns(cls, value: Any, start_ns: int) -> int | None:
        """Return the simulated time at which the run ends at the latest, if it is known before."""
        return None

    @classmethod
    def topic(cls, value: Any) -> str | None:
        """Return the topic whose messages the rule sees."""
        return None

    def check(self, progress: Progress) -> Stop | None:
        """Return why to stop after a time step, or None to go on."""
        return None

    def on_message(self, message: Callable[[], Any]) -> Stop | None:
        """Return why to stop after the time step of a message; ``message()`` decodes it."""
        return None

    def condition(self) -> StopCondition | None:
        """Return what the loop asks after each time step, None if the rule has no ``check``."""
        return None if type(self).check is StopRule.check else self.check


class _TimeRule(StopRule):
    """Ends the run at a simulated time, which the loop need not ask for before."""

    def __init__(self, value: int, run: StopInputs) -> None:
        super().__init__(value, run)
        end_ns = self.end_ns(value, run.start_ns)
        assert end_ns is not None
        self._end_ns = end_ns

    def _stop(self) -> Stop:
        raise NotImplementedError

    def condition(self) -> StopCondition:
        stop = self._stop()
        return stop_at(self._end_ns, stop.reason, stop.exit_code)


class DurationRule(_TimeRule):
    """``duration``: after so much simulated time."""

    @classmethod
    def end_ns(cls, value: int, start_ns: int) -> int:
        """Count from the start; a simulated time is an error, as everywhere."""
        return TimeInRun(value).stamp_ns(start_ns)

    def _stop(self) -> Stop:
        return Stop(f"duration of {format_seconds(self.value)} s")


class TimeoutRule(DurationRule):
    """``timeout``: after so much simulated time, as a failure."""

    def _stop(self) -> Stop:
        return Stop(f"timeout of {format_seconds(self.value)} s", 1)


class TimeRule(_TimeRule):
    """``time``: at a simulated time."""

    @classmethod
    def end_ns(cls, value: int, start_ns: int) -> int:
        return value

    def _stop(self) -> Stop:
        return Stop(f"time {format_seconds(self.value)} s")


class EventsRule(StopRule):
    """``events``: after so many events."""

    def check(self, progress: Progress) -> Stop | None:
        return Stop(f"{self.value} events") if progress.events >= self.value else None


class QuiescenceRule(StopRule):
    """``quiescence``: when nothing was published, called or answered for so long."""

    def check(self, progress: Progress) -> Stop | None:
        """Compare the time of the next step with that of the last activity."""
        quiet_since = max(progress.activity_ns, progress.start_ns)
        next_ns = progress.now_ns if progress.next_ns is None else progress.next_ns
        if next_ns - quiet_since <= self.value:
            return None
        return Stop(f"quiet for {format_seconds(self.value)} s")


class SizeRule(StopRule):
    """``size``: when the file of the trace is so large."""

    prevents_forks = "the size of the trace ends the run (stop.size)"

    def __init__(self, value: int, run: StopInputs) -> None:
        super().__init__(value, run)
        self._trace_size = run.trace_size

    def check(self, progress: Progress) -> Stop | None:
        if self._trace_size() < self.value:
            return None
        return Stop(f"a trace of {format_size(self.value)}")


class FunctionRule(StopRule):
    """``function``: when a function of the user says so.

    ``True`` stops with exit status 0, an integer with that status; ``None`` and ``False`` go on.
    """

    def __init__(self, value: Any, run: StopInputs) -> None:
        super().__init__(value, run)
        self._outside_events = run.outside_events
        if isinstance(value, str):
            self._name, loc = value, ("stop", "function")
            with showing_line(run.job, loc):
                self._function = load_target(value, where=locate(run.job, loc))
        else:
            self._name, self._function = f"{value.__module__}:{value.__qualname__}", value

    def check(self, progress: Progress) -> Stop | None:
        """Call the function.

        :raises RunError: it raises an exception, or returns anything else.
        """
        try:
            with self._outside_events():
                answer = self._function(progress)
        except SystemExit as error:
            answer = 0 if error.code is None else error.code
            if not isinstance(answer, int):
                return Stop(f"function {self._name} raised SystemExit: {answer}", 1)
        except Exception as error:
            raise RunError(
                f"the stop function {self._name} raised {type(error).__qualname__}: {error}"
            ) from error
        else:
            if answer is None or answer is False:
                return None
        code = 0 if answer is True else answer
        if not isinstance(code, int):
            raise RunError(
                f"the stop function {self._name} returned {answer!r}; "
                "expected None, a bool or an integer exit status"
            )
        return Stop(f"function {self._name}", code)


class TopicRule(StopRule):
    """``topic``: at a message, whose field may be the exit status."""

    def __init__(self, value: TopicStop, run: StopInputs) -> None:
        super().__init__(value, run)
        self._where = locate(run.job, ("stop", "topic", "exit_code"))

    @classmethod
    def topic(cls, value: TopicStop) -> str:
        return value.name

    def on_message(self, message: Callable[[], Any]) -> Stop | None:
        """Stop with the status in the message.

        :raises JobError: the message has no such field, or it is not an integer.
        """
        path = self.value.exit_code
        code = 0 if path is None else self._exit_code(message(), path)
        return Stop(f"message on {self.value.name}", code)

    def _exit_code(self, message: Any, path: str) -> int:
        value = message
        for name in path.split("."):
            fields: dict[str, str] = getattr(value, "get_fields_and_field_types", dict)()
            if name not in fields:
                near = nearest(name, fields)
                hint = f"did you mean {near!r}?" if near else f"there are {', '.join(fields)}"
                hint = hint if fields else "the part before it is not a message"
                raise JobError(
                    f"stop.topic.exit_code: {self.value.name} is a {type(message).__qualname__} "
                    f"without the field {path!r}: {hint}",
                    where=self._where,
                )
            value = getattr(value, name)
        if not isinstance(value, int):
            raise JobError(
                f"stop.topic.exit_code: {path!r} of {self.value.name} is {value!r}, not an integer",
                where=self._where,
            )
        return int(value)


STOP_RULES: Mapping[str, type[StopRule]] = {
    "duration_ns": DurationRule,
    "timeout_ns": TimeoutRule,
    "time_ns": TimeRule,
    "events": EventsRule,
    "quiescence_ns": QuiescenceRule,
    "function": FunctionRule,
    "topic": TopicRule,
    "size": SizeRule,
}
"""By the field of ``StopSpec``. If several rules hold after one time step, the first one counts."""


def given_rules(job: Job) -> Iterator[tuple[str, Any, type[StopRule]]]:
    """Yield key, value and class of each stop rule of a job."""
    for key, rule in STOP_RULES.items():
        value = getattr(job.stop, key)
        if value is not None:
            yield key, value, rule


def stop_rules(run: StopInputs) -> list[StopRule]:
    """Return the stop rules of a run.

    :raises JobError: the stop function cannot be imported.
    """
    return [rule(value, run) for _, value, rule in given_rules(run.job)]


def conditions_of(rules: Sequence[StopRule]) -> tuple[StopCondition, ...]:
    """Return what the loop asks after each time step."""
    conditions = (rule.condition() for rule in rules)
    return tuple(condition for condition in conditions if condition is not None)


def watch_messages(
    rules: Sequence[StopRule],
    watch: Callable[[str, Callable[[Any, bytes], None]], None],
    stop: Callable[[Stop], None],
) -> None:
    """Let rules see the messages of their topics: ``watch(topic, watcher)`` calls the watcher with
    publisher and bytes of each message."""
    for rule in rules:
        topic = rule.topic(rule.value)
        if topic is not None:
            watch(topic, _watcher(rule, stop))


def _watcher(rule: StopRule, stop: Callable[[Stop], None]) -> Callable[[Any, bytes], None]:
    from rsltrace.adapters.rclpy.messages.codec import codec_for
    from rsltrace.adapters.rclpy.messages.interfaces import class_of

    def watcher(publisher: Any, data: bytes) -> None:
        found = rule.on_message(lambda: codec_for(class_of(publisher)).deserialize(data))
        if found is not None:
            stop(found)

    return watcher


def end_ns_of(job: Job, start_ns: int) -> int | None:
    """Return the latest simulated time the run can reach, or None if time does not end it."""
    ends = (rule.end_ns(value, start_ns) for _, value, rule in given_rules(job))
    return min((end_ns for end_ns in ends if end_ns is not None), default=None)


def has_stop(job: Job) -> bool:
    """Return whether the job says itself when it ends; otherwise its bags do."""
    return any(True for _ in given_rules(job))
