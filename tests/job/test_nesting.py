"""Jobs that are nested without end are refused at once."""

from __future__ import annotations

import time

import pytest

from rsltrace.errors import JobError
from rsltrace.job.reading.yaml_source import NESTING_MAX, parse_yaml


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
