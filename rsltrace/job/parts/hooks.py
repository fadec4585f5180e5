"""``hooks:``: functions that are called around the construction of the nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from rsltrace.job.parts.part import Part
from rsltrace.job.values.checks import check
from rsltrace.job.values.target import Target, check_callable_target


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
