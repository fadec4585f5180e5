"""One entry of ``launch:``: a launch file whose nodes are part of the job."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from rsltrace.job.parts.part import Part
from rsltrace.job.values.checks import attach, check, flag
from rsltrace.job.values.paths import check_path
from rsltrace.job.values.problem import Problem, describe


def _check_arguments(value: object) -> dict[str, str]:
    if not isinstance(value, dict):
        raise Problem(f"expected a mapping of launch arguments to values, got {describe(value)}")
    found: dict[str, str] = {}
    for name, given in value.items():
        if not isinstance(given, (str, int, float)):
            raise Problem(f"expected text or a number, got {describe(given)}", (str(name),))
        text = str(given).lower() if isinstance(given, bool) else str(getattr(given, "text", given))
        found[str(name)] = text
    return found


attach(
    _check_arguments,
    schema={"type": "object", "additionalProperties": {"type": ["string", "number", "boolean"]}},
)


class LaunchSpec(Part):
    """A launch file; a path stands for ``{file: ...}``."""

    file: Annotated[str, check(check_path)] = Field(
        description="Launch file (XML, YAML, or Python, which is run in a process of its own).",
        examples=["launch/robot.launch.xml"],
    )
    arguments: Annotated[dict[str, str], check(_check_arguments)] = Field(
        default_factory=dict,
        description="Launch arguments by name, as `name:=value` on a command line.",
        examples=[{"robot": "husky", "use_lidar": True}],
    )
    skip_unsupported: Annotated[bool, check(flag)] = Field(
        default=False,
        description="Leave out what cannot be simulated (compiled executables, other processes) "
        "instead of refusing the launch file.",
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
