"""Jobs that are nested without end are refused at once."""

from __future__ import annotations

import time

import pytest

from rsltrace.errors import JobError
from rsltrace.job.reading.yaml_source import REPEATED_MAX, parse_yaml
from rsltrace.trace.model.operation import NESTING_MAX


@pytest.mark.parametrize(
    "text", ["[" * 5000 + "]" * 5000, "{a: " * 5000 + "}" * 5000, "[" * 1_000_000, "[{" * 50_000]
)
def test_brackets_without_end_are_refused_at_once(text: str) -> None:
    begin = time.process_time()
    with pytest.raises(JobError, match=r"job\.yaml:2: brackets are nested more than 100 deep"):
        parse_yaml(f"seed: 1\nnodes: {text}", "job.yaml")
    assert time.process_time() - begin < 1


def test_what_is_closed_again_is_not_nested() -> None:
    text = "nodes: [" + ", ".join("[[a]]" for _ in range(NESTING_MAX)) + "]"
    assert len(parse_yaml(text, "job.yaml").root.value["nodes"].value) == NESTING_MAX


def _laughs(kind: str, depth: int, width: int) -> str:
    """A small job whose aliases mean an enormous one."""
    lines = ["x-0: &a0 " + ("[lol]" if kind == "list" else "{k: lol}")]
    for i in range(1, depth):
        aliases = ", ".join([f"*a{i - 1}"] * width)
        lines.append(
            f"x-{i}: &a{i} "
            + {
                "list": f"[{aliases}]",
                "map": "{" + ", ".join(f"k{j}: *a{i - 1}" for j in range(width)) + "}",
                "merge": f"{{<<: [{aliases}], k{i}: *a{i - 1}}}",
            }[kind]
        )
    return "\n".join([*lines, f"nodes: *a{depth - 1}"])


@pytest.mark.parametrize("shape", [(9, 9), (30, 2), (5, 50)])
@pytest.mark.parametrize("kind", ["list", "map", "merge"])
def test_aliases_without_end_are_refused_at_once(kind: str, shape: tuple[int, int]) -> None:
    begin = time.process_time()
    with pytest.raises(JobError, match=r"job\.yaml:\d+:\d+: aliases and '<<' repeat more than"):
        parse_yaml(_laughs(kind, *shape), "job.yaml")
    assert time.process_time() - begin < 1


def test_aliases_within_reason_are_followed() -> None:
    text = "x: &x {a: 1}\nnodes: [" + ", ".join(["*x"] * (REPEATED_MAX // 3)) + "]"
    assert len(parse_yaml(text, "job.yaml").root.value["nodes"].value) == REPEATED_MAX // 3
