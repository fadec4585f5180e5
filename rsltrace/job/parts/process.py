"""What only processes have among the entries of a job: surroundings, restarts, components."""

from __future__ import annotations

from typing import Annotated, ClassVar

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.values.checks import attach, check, flag, is_plain, text, whole
from rsltrace.job.values.mappings import check_path
from rsltrace.job.values.problem import JobProblem, ProblemCollector, describe
from rsltrace.job.values.times import parse_time

# ``stdin:`` of an entry: what is typed at its terminal, and when.

_LINE_MAX = 4000
"""A terminal of Linux takes no longer lines (4096 bytes, its end and what was typed before)."""


def _line(value: object) -> str:
    """Check one line; a number stands for its digits."""
    if not is_plain(value):
        raise JobProblem(f"expected a line of text, got {describe(value)}")
    line = str(getattr(value, "text", value))
    if "\n" in line or "\r" in line:
        raise JobProblem("this is more than one line: write each as an entry of its own")
    if len(line.encode()) > _LINE_MAX:
        raise JobProblem(f"a terminal takes lines of at most {_LINE_MAX} bytes")
    return line


attach(_line, schema={"type": ["string", "number"]})


class InputSpec(JobPart):
    """Terminal input: one of ``line``, ``keys``, ``file`` and ``end``. Text alone is a
    ``line``."""

    ONE_OF: ClassVar[tuple[str, ...]] = ("line", "keys", "file", "end")

    at_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="at",
        description="Time since the start. Default: after the input before.",
        examples=["2.5s"],
    )
    line: Annotated[str | None, check(_line, optional=True)] = Field(
        default=None, description="A line with Enter.", examples=["start", 42]
    )
    keys: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None,
        description="Keys without Enter (which is `\\r`): `\\e[A` is the up arrow, `\\x03` is "
        "Ctrl-C.",
        examples=["wwad", "\x1b[A"],
    )
    file: Annotated[str | None, check(check_path, optional=True)] = Field(
        default=None, description="The lines of a text file.", examples=["answers.txt"]
    )
    end: Annotated[bool, check(flag)] = Field(
        default=False,
        description="End of the input (Ctrl-D).",
        examples=[True],
    )

    @after_fields
    def _one(self) -> None:
        given = [key for key in self.ONE_OF if getattr(self, key) not in (None, False)]
        if len(given) != 1:
            raise JobProblem(f"give one of {', '.join(self.ONE_OF)}")
        if self.keys == "":
            raise JobProblem("no key is given", ("keys",))


def _inputs(value: object) -> object:
    """Let the name of a file stand for its lines and the end of the input."""
    if isinstance(value, str):
        return ({"file": value}, {"end": True})
    if not isinstance(value, (list, tuple)):
        raise JobProblem(
            "expected a file whose lines are typed, or a list of what is typed, got "
            f"{describe(value)}"
        )
    return tuple({"line": item} if is_plain(item) else item for item in value)


inputs = check(_inputs, optional=True, entry_shorthand="line", or_text=True)


def check_environment(value: object) -> dict[str, str]:
    """Check a mapping of environment variables to texts."""
    if not isinstance(value, dict):
        raise JobProblem(f"expected a mapping of names to texts, got {describe(value)}")
    problems = ProblemCollector()
    for name, content in value.items():
        with problems.at(str(name), at_key=True):
            if not isinstance(name, str) or not name or "=" in name or "\0" in name:
                raise JobProblem(f"{name!r} cannot be the name of an environment variable")
        with problems.at(str(name)):
            if isinstance(content, bool) or not isinstance(content, (str, int, float)):
                raise JobProblem(f"expected a text, got {describe(content)}")
            if "\0" in str(content):
                raise JobProblem("an environment variable cannot hold a NUL character")
    problems.check()
    return {name: str(getattr(content, "text", content)) for name, content in value.items()}


attach(
    check_environment,
    schema={"type": "object", "additionalProperties": {"type": ["string", "number"]}},
)


class RespawnSpec(JobPart):
    """Restart of a process that has ended. A plain time stands for ``{delay: time}``."""

    MEANT: ClassVar[str] = "delay"

    delay_ns: Annotated[int, check(parse_time)] = Field(
        default=0,
        alias="delay",
        description="Simulated time before the restart.",
        examples=["1s"],
    )
    times: Annotated[int | None, check(whole(1), optional=True)] = Field(
        default=None,
        description="Maximum number of restarts. Default: unlimited.",
        examples=[3],
    )

    @classmethod
    def after(cls, delay_ns: int, times: int | None) -> RespawnSpec:
        """Return the rule by which a process starts again ``delay_ns`` later."""
        return cls(delay=f"{delay_ns}ns", times=times)
