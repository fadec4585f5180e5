"""``record:`` of a job: which payloads the trace keeps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, field_validator

from rsltrace.job.parts.part import JobPart
from rsltrace.job.values.checks import Globs, check, flag, whole
from rsltrace.job.values.problem import JobProblem
from rsltrace.job.values.target import Target, check_callable_target
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


class RecordSpec(JobPart):
    """Which messages the trace keeps. Hashes are always kept."""

    payloads: Annotated[bool, check(flag)] = Field(
        default=True,
        description="Whether to keep messages.",
        examples=[False],
    )
    topics: Globs = Field(
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
            raise JobProblem(
                "an empty list would keep no payload: write 'payloads: false' for that"
            )
        return value
