"""``record:`` of a job: which payloads the trace keeps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart
from rsltrace.job.values.checks import (
    Globs,
    Target,
    attach,
    check,
    check_callable_target,
    flag,
    part,
    positive_time,
    whole,
)
from rsltrace.job.values.problem import JobProblem
from rsltrace.job.values.times import TimeLike, parse_size
from rsltrace.trace.model.event import SEGMENT_EVENTS

# ``hooks:``: functions that are called around the construction of the nodes.


class HooksSpec(JobPart):
    """Functions called around the construction of the nodes."""

    before: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="Function of the job, called before the construction. May return nodes.",
        examples=["my_robot.setup:prepare"],
    )
    after: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="Function of the list of nodes, called after the construction. May "
        "return more nodes.",
        examples=["my_robot.setup:wire"],
    )


def _memory(value: object) -> int:
    size = parse_size(value)
    if not 1 << 20 <= size <= 1 << 36:
        raise JobProblem("expected a size from 1MiB to 64GiB")
    return size // 4096 * 4096


attach(_memory, schema=parse_size.schema)  # type: ignore[attr-defined]


class LastSpec(JobPart):
    """What a native run keeps in memory of the last seconds."""

    MEANT: ClassVar[str] = "duration"

    duration_ns: Annotated[int, check(positive_time)] = Field(
        alias="duration", description="Time to keep.", examples=["30s"]
    )
    memory: Annotated[int, check(_memory)] = Field(
        default=64 << 20,
        description="Most memory per process.",
        examples=["64MiB"],
    )
    largest: Annotated[int, check(parse_size)] = Field(
        default=1 << 20,
        description="Of larger messages keep only the hash.",
        examples=["100kB"],
    )
    keep_on: Globs = Field(
        default=(),
        description="Topics and services whose messages write a file, as globs.",
        examples=[["/emergency_stop"]],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            duration: TimeLike | None = None,
            duration_ns: int | None = None,
            memory: int | str = ...,
            largest: int | str = ...,
            keep_on: Sequence[str] = (),
        ) -> None: ...


def _not_empty(value: object, in_file: bool) -> object:
    if not value:
        raise JobProblem("an empty list would keep no payload: write 'payloads: false' for that")
    return value


class RecordSpec(JobPart):
    """Which messages the trace keeps. Hashes are always kept."""

    payloads: Annotated[bool, check(flag)] = Field(
        default=True,
        description="Whether to keep messages.",
        examples=[False],
    )
    topics: Annotated[Globs, _not_empty] = Field(
        default=("*",),
        description="Topics and services to keep, as globs.",
        examples=[["/odom", "/robot1/*"]],
    )
    exclude: Globs = Field(
        default=(),
        description="Topics and services not to keep, as globs.",
        examples=[["/camera/*"]],
    )
    segment_events: Annotated[int, check(whole(1, SEGMENT_EVENTS))] = Field(
        default=SEGMENT_EVENTS,
        description="Events per segment, the most that a killed run loses. 1 is slow.",
        examples=[1],
    )
    last: Annotated[LastSpec | None, part("duration")] = Field(
        default=None,
        description="Keep only the last seconds, in a native run.",
        examples=["30s", {"duration": "30s", "memory": "64MiB", "keep_on": ["/emergency_stop"]}],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            payloads: bool = True,
            topics: Sequence[str] = ("*",),
            exclude: Sequence[str] = (),
            segment_events: int = SEGMENT_EVENTS,
            last: LastSpec | TimeLike | None = None,
        ) -> None: ...
