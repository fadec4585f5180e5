"""``metrics:`` of a job: numbers that say how a run went, found out from its trace."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar

from pydantic import Field, model_validator

from rsltrace.job.parts.part import Part
from rsltrace.job.values.checks import check, text
from rsltrace.job.values.problem import Problem, describe
from rsltrace.job.values.target import Target, check_callable_target


def check_metric_name(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` can be the name of a metric: one line of text."""
    if not name.strip() or not name.isprintable():
        raise ValueError(f"{describe(name)} is no name: use a word, as in distance")


check_metric_name.pattern = r"\S"  # type: ignore[attr-defined]


class MetricSpec(Part):
    """One number. Exactly one of ``expression`` and ``function``; a text alone is an
    ``expression``."""

    ONE_OF: ClassVar[tuple[str, ...]] = ("expression", "function")

    expression: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None,
        description="What it is worth for a finished run, as in `rsltrace bisect --check`: "
        '`last("/odom").pose.pose.position.x`, `count("/stop")`, '
        '`max(m.data for m in messages("/error"))`, `end`.',
        examples=['last("/odom").pose.pose.position.x'],
    )
    function: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="Function that gets the finished trace (`rsltrace.Trace`) and returns the "
        "number, or `None` if there is none.",
        examples=["my_robot.metrics:energy"],
    )
    unit: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None, description="Unit of the number, to be shown beside it.", examples=["m"]
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            expression: str | None = None,
            function: Target | None = None,
            unit: str | None = None,
        ) -> None: ...

    @model_validator(mode="after")
    def _says_one_thing(self) -> MetricSpec:
        if (self.expression is None) == (self.function is None):
            raise Problem("give expression or function")
        return self
