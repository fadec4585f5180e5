"""``stop:`` of a job: what ends the run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart
from rsltrace.job.values.checks import (
    Target,
    check,
    check_callable_target,
    part,
    positive_time,
    text,
    whole,
)
from rsltrace.job.values.names import check_field_path, check_topic
from rsltrace.job.values.times import TimeLike, parse_size, parse_time


class TopicStop(JobPart):
    """A message that ends the run."""

    name: Annotated[str, check(text(check_topic))] = Field(
        description="Full name of the topic.", examples=["/done"]
    )
    exit_code: Annotated[str | None, check(text(check_field_path), optional=True)] = Field(
        default=None,
        description="Field that is the exit status. Default: status 0.",
        examples=["data"],
    )


class StopSpec(JobPart):
    """What ends a run: the first of these conditions."""

    MEANT: ClassVar[str] = "duration"

    duration_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="duration",
        description="After this much simulated time, inclusive.",
        examples=["60s"],
    )
    time_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None, alias="time", description="At this simulated time.", examples=["110s"]
    )
    timeout_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None,
        alias="timeout",
        description="After this much simulated time, with exit status 1.",
        examples=["120s"],
    )
    events: Annotated[int | None, check(whole(1), optional=True)] = Field(
        default=None, description="After this many events.", examples=[100000]
    )
    topic: Annotated[TopicStop | None, part("name")] = Field(
        default=None,
        description="After a message on a topic.",
        examples=["/done", {"name": "/done", "exit_code": "data"}],
    )
    function: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="When this function of a `Progress` returns `True` or an exit status, "
        "between time steps.",
        examples=["my_robot.checks:finished"],
    )
    quiescence_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None,
        alias="quiescence",
        description="After this much time without a message.",
        examples=["2s"],
    )

    size: Annotated[int | None, check(parse_size, optional=True)] = Field(
        default=None,
        description="When the trace file reaches this size.",
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
