"""The smaller parts of a job: when the run stops, what is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar

from pydantic import Field, field_validator

from rsltrace.job.parts.names import check_field_path, check_glob, check_topic
from rsltrace.job.parts.node import Target, check_callable_target
from rsltrace.job.parts.part import Part, check, flag, items, part, positive_time, text, whole
from rsltrace.job.parts.sizes import parse_size
from rsltrace.job.parts.times import parse_time
from rsltrace.job.reading.problems import Problem
from rsltrace.model.event import SEGMENT_EVENTS

TimeLike = str | int | float
"""A time in Python as in YAML: seconds as a number, or text with a unit."""

Globs = Annotated[tuple[str, ...], check(items(text(check_glob)))]


class TopicStop(Part):
    """A message on topic ``name`` ends the run; its field ``exit_code`` is the exit status."""

    name: Annotated[str, check(text(check_topic))] = Field(
        description="The topic, in full.", examples=["/done"]
    )
    exit_code: Annotated[str | None, check(text(check_field_path), optional=True)] = Field(
        default=None,
        description="Field of the message that is the exit status of `rsltrace record`. Without "
        "it the status is 0.",
        examples=["data"],
    )


class StopSpec(Part):
    """What ends a run. Any of the conditions; times in nanoseconds, ``None`` where not given."""

    MEANT: ClassVar[str] = "duration"
    TIMES: ClassVar[dict[str, str]] = {
        "duration": "duration_ns",
        "time": "time_ns",
        "timeout": "timeout_ns",
        "quiescence": "quiescence_ns",
    }

    duration_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="duration",
        description="After so much simulated time, what is due then included.",
        examples=["60s"],
    )
    time_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None, alias="time", description="At this simulated time.", examples=["110s"]
    )
    timeout_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None,
        alias="timeout",
        description="After so much simulated time, as a failure: with exit status 1.",
        examples=["120s"],
    )
    events: Annotated[int | None, check(whole(1), optional=True)] = Field(
        default=None, description="After so many events.", examples=[100000]
    )
    topic: Annotated[TopicStop | None, part("name")] = Field(
        default=None,
        description="When a message is published on a topic; its name stands for `{name: ...}`.",
        examples=["/done", {"name": "/done", "exit_code": "data"}],
    )
    function: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="When this function, asked between time steps with a `Progress`, returns "
        "`True` or an integer, which is the exit status.",
        examples=["my_robot.checks:finished"],
    )
    quiescence_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None,
        alias="quiescence",
        description="When nothing has been published for so long.",
        examples=["2s"],
    )

    size: Annotated[int | None, check(parse_size, optional=True)] = Field(
        default=None,
        description="When the trace's file has become so large (checked between time steps; what "
        "is still in memory comes on top).",
        examples=["500MiB"],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            duration: TimeLike | None = None,
            duration_ns: int | None = None,
            time: TimeLike | None = None,
            time_ns: int | None = None,
            timeout: TimeLike | None = None,
            timeout_ns: int | None = None,
            events: int | None = None,
            topic: TopicStop | str | None = None,
            function: Target | None = None,
            quiescence: TimeLike | None = None,
            quiescence_ns: int | None = None,
            size: int | str | None = None,
        ) -> None: ...


class RecordSpec(Part):
    """Which payloads the trace keeps. Hashes are kept in any case."""

    payloads: Annotated[bool, check(flag)] = Field(
        default=True,
        description="Whether messages are kept at all; their hashes are in any case.",
        examples=[False],
    )
    topics: Globs = Field(
        default=("*",),
        description="Topics and services whose messages are kept, globs.",
        examples=[["/odom", "/robot1/*"]],
    )
    exclude: Globs = Field(
        default=(),
        description="Topics and services whose messages are not kept, globs.",
        examples=[["/camera/*"]],
    )
    segment_events: Annotated[int, check(whole(1, SEGMENT_EVENTS))] = Field(
        default=SEGMENT_EVENTS,
        description="After how many events they are written to the file; what a killed or crashed "
        "run loses is fewer. 1 is slow, and right for finding out what happened before a crash.",
        examples=[1],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            payloads: bool = True,
            topics: Sequence[str] = ("*",),
            exclude: Sequence[str] = (),
            segment_events: int = SEGMENT_EVENTS,
        ) -> None: ...

    @field_validator("topics")
    @classmethod
    def _not_empty(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not value:
            raise Problem("an empty list would keep no payload: write 'payloads: false' for that")
        return value
