"""``record:`` of a job: which payloads the trace keeps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, field_validator

from rsltrace.job.parts.part import Part
from rsltrace.job.values.checks import Globs, check, flag, whole
from rsltrace.job.values.problem import Problem
from rsltrace.job.values.target import Target, check_callable_target
from rsltrace.trace.model.event import SEGMENT_EVENTS

# ``hooks:``: functions that are called around the construction of the nodes.


class HooksSpec(Part):
    """What is called before the first and after the last node is constructed."""

    before: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="Function called with the job before the first node is constructed. It may "
        "return nodes of its own (one, or a list).",
        examples=["my_robot.setup:prepare"],
    )
    after: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="Function called with the list of all nodes after the last one is constructed, "
        "before the run starts. It may return more nodes.",
        examples=["my_robot.setup:wire"],
    )

    if TYPE_CHECKING:

        def __init__(
            self, *, before: Target | None = None, after: Target | None = None
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
