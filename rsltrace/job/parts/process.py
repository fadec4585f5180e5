"""What only processes have among the entries of a job: surroundings, restarts, components."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from rsltrace.job.parts.part import Part
from rsltrace.job.values.checks import attach, check, whole
from rsltrace.job.values.problem import Collected, Problem, describe
from rsltrace.job.values.times import parse_time


def check_environment(value: object) -> dict[str, str]:
    """Check a mapping of environment variables to texts."""
    if not isinstance(value, dict):
        raise Problem(f"expected a mapping of names to texts, got {describe(value)}")
    problems = Collected()
    for name, content in value.items():
        with problems.at(str(name), at_key=True):
            if not isinstance(name, str) or not name or "=" in name or "\0" in name:
                raise Problem(f"{name!r} cannot be the name of an environment variable")
        with problems.at(str(name)):
            if isinstance(content, bool) or not isinstance(content, (str, int, float)):
                raise Problem(f"expected a text, got {describe(content)}")
            if "\0" in str(content):
                raise Problem("an environment variable cannot hold a NUL character")
    problems.check()
    return {name: str(getattr(content, "text", content)) for name, content in value.items()}


attach(
    check_environment,
    schema={"type": "object", "additionalProperties": {"type": ["string", "number"]}},
)


class RespawnSpec(Part):
    """A process is started again when it has ended, even by a failure. A plain time stands for
    ``{delay: time}``."""

    MEANT: ClassVar[str] = "delay"
    TIMES: ClassVar[dict[str, str]] = {"delay": "delay_ns"}

    delay_ns: Annotated[int, check(parse_time)] = Field(
        default=0,
        alias="delay",
        description="How much simulated time passes before it starts again.",
        examples=["1s"],
    )
    times: Annotated[int | None, check(whole(1), optional=True)] = Field(
        default=None,
        description="How often it is started again at most; without it there is no limit.",
        examples=[3],
    )

    @classmethod
    def after(cls, delay_ns: int, times: int | None) -> RespawnSpec:
        """Return the rule by which a process starts again ``delay_ns`` later."""
        return cls(delay=f"{delay_ns}ns", times=times)  # type: ignore[arg-type]
