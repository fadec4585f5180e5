"""Whatever is in a launch file: it is read, or the mistake is told with its place. Nothing else."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rsltrace.adapters.launch.reader import read_launch_file
from rsltrace.adapters.launch.specs import node_specs
from rsltrace.errors import JobError
from tests.tiers import cases

FILES = Path(__file__).parent / "files"
PIECES = ["<", ">", "'", '"', "$(", ")", "\n", "- ", ": ", "{", "}", "[", "]", "&", "\0", "\\", "é",
          "$(var robot)", "$(eval ", "if", "-1", "1e999", "null", "<group>",
          "</group>"]  # fmt: skip


def mistake_in(path: Path) -> str | None:
    try:
        launched = read_launch_file(path, {"robot": "jackal"})
        node_specs(launched, skip_unsupported=True, why_not=lambda package, executable: None)
    except JobError as error:
        return str(error)
    return None


@settings(
    max_examples=cases(40, 250),
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    name=st.sampled_from(["everything.launch.xml", "everything.launch.yaml"]),
    cuts=st.lists(
        st.tuples(st.floats(0, 1), st.integers(0, 12), st.sampled_from(["", *PIECES])),
        min_size=1,
        max_size=4,
    ),
)
def test_broken_files(
    tmp_path: Path, write: Callable[..., Path], name: str, cuts: list[tuple[float, int, str]]
) -> None:
    write("/**: {ros__parameters: {a: 1}}", "extra.yaml")
    text = (FILES / name).read_text(encoding="utf-8")
    for at, length, piece in cuts:
        place = int(at * len(text))
        text = text[:place] + piece + text[place + length :]
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    said = mistake_in(path)
    assert said is None or re.match(rf"[^\n]*({name}|extra.yaml)", said), said


@given(st.binary(max_size=60))
@settings(
    max_examples=cases(15, 100),
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_any_bytes(tmp_path: Path, data: bytes) -> None:
    for suffix in (".launch.xml", ".launch.yaml"):
        path = tmp_path / f"x{suffix}"
        path.write_bytes(data)
        with pytest.raises(JobError):
            read_launch_file(path, {})
