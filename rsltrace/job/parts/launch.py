"""One entry of ``launch:``: a launch file whose nodes are part of the job."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.values.checks import attach, check, flag, text
from rsltrace.job.values.mappings import check_path
from rsltrace.job.values.names import check_topic
from rsltrace.job.values.problem import JobProblem, describe
from rsltrace.job.values.times import parse_time

# ``start_after:`` of an entry: it starts later than the run does, as a launch file's timers and
# event handlers would have it.


def _check_entry(value: object) -> str | int:
    """Check what names an entry of ``nodes:``: text, or its number in the list."""
    if isinstance(value, bool) or not isinstance(value, (str, int)) or value == "":
        raise JobProblem(
            "expected an entry of nodes: its name, what it runs, or its number in the list "
            f"(from 0), got {describe(value)}"
        )
    if isinstance(value, int):
        if value < 0:
            raise JobProblem(f"entries of nodes are counted from 0, got {value}")
        return int(value)
    return str(value)


attach(_check_entry, schema={"anyOf": [{"type": "string"}, {"type": "integer", "minimum": 0}]})

FullName = Annotated[str | None, check(text(check_topic), optional=True)]
EntryName = Annotated[str | int | None, check(_check_entry, optional=True)]


class StartAfterSpec(JobPart):
    """When an entry starts: ``delay`` after all conditions are true. A plain
    time stands for ``{delay: time}``. Entries are named by
    ``name``, by what they run, or by number."""

    MEANT: ClassVar[str] = "delay"
    CONDITIONS: ClassVar[tuple[str, ...]] = ("topic", "service", "node", "started", "ended")

    delay_ns: Annotated[int, check(parse_time)] = Field(
        default=0,
        alias="delay",
        description="Delay after the start, or after the other conditions.",
        examples=["2s"],
    )
    topic: FullName = Field(
        default=None,
        description="After the first message on a topic.",
        examples=["/map"],
    )
    service: FullName = Field(
        default=None,
        description="After a service has a server.",
        examples=["/set_mode"],
    )
    node: FullName = Field(
        default=None, description="After a node exists.", examples=["/robot/driver"]
    )
    started: EntryName = Field(
        default=None,
        description="After another entry has started: its constructor returned, or its main waits.",
        examples=["driver", 0],
    )
    ended: EntryName = Field(
        default=None,
        description="After another entry, not a `node`, has ended.",
        examples=["my_robot/calibrate", 0],
    )

    @classmethod
    def after(cls, delay_ns: int) -> StartAfterSpec:
        """Return the rule of an entry that starts ``delay_ns`` after the run."""
        return cls(delay=f"{delay_ns}ns")

    @after_fields
    def _says_something(self) -> None:
        if not self.given_fields:
            raise JobProblem(f"give one of delay, {', '.join(self.CONDITIONS)}")


def _check_arguments(value: object) -> dict[str, str]:
    if not isinstance(value, dict):
        raise JobProblem(f"expected a mapping of launch arguments to values, got {describe(value)}")
    found: dict[str, str] = {}
    for name, given in value.items():
        if not isinstance(given, (str, int, float)):
            raise JobProblem(f"expected text or a number, got {describe(given)}", (str(name),))
        text = str(given).lower() if isinstance(given, bool) else str(getattr(given, "text", given))
        found[str(name)] = text
    return found


attach(
    _check_arguments,
    schema={"type": "object", "additionalProperties": {"type": ["string", "number", "boolean"]}},
)


class LaunchSpec(JobPart):
    """A launch file; a path stands for ``{file: ...}``."""

    file: Annotated[str, check(check_path)] = Field(
        description="Launch file in XML, YAML or Python.",
        examples=["launch/robot.launch.xml"],
    )
    arguments: Annotated[dict[str, str], check(_check_arguments)] = Field(
        default_factory=dict,
        description="Launch arguments.",
        examples=[{"robot": "husky", "use_lidar": True}],
    )
    skip_unsupported: Annotated[bool, check(flag)] = Field(
        default=False,
        description="Skip what cannot be simulated instead of refusing the file.",
        examples=[True],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            file: str | os.PathLike[str],
            arguments: dict[str, Any] = ...,
            skip_unsupported: bool = False,
        ) -> None: ...
