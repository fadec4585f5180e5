"""Whatever is written into a job or an override, the answer is a job or a ``JobError``."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from rsltrace.errors import JobError
from rsltrace.job import Job, load_job
from tests.tiers import cases

GOOD = (Path(__file__).parent / "golden" / "good.yaml").read_text("utf-8")
PIECES = [
    "{",
    "}",
    "[",
    "]",
    ":",
    ": ",
    "- ",
    "\n",
    " ",
    "'",
    '"',
    "$(",
    ")",
    "&a ",
    "*a",
    "<<: *a",
]
PIECES += ["null", "!", "#", "\t", "|", "> ", "base: job.yaml", "include: [x, 3]", "\u2028", "\\"]


@pytest.fixture(scope="module", autouse=True)
def folder() -> Iterator[None]:
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        for inner in ("src", "bag"):
            Path(inner).mkdir()
        Path("ekf.yaml").touch()
        yield
        os.chdir(before)


def check(load: Callable[[], Job]) -> None:
    """A job means the same when it is written down and read again; an error says where it is."""
    told = ""
    try:
        job = load()
    except JobError as error:
        told = str(error)
    if told:
        assert told.startswith(("job.yaml", "--set")), told
        return
    text = job.to_yaml()
    Path("again.yaml").write_text(text, encoding="utf-8")
    assert load_job("again.yaml").resolved() == job.resolved(), text


edits = st.lists(
    st.tuples(st.integers(0, len(GOOD)), st.integers(0, 12), st.sampled_from(["", *PIECES])),
    min_size=1,
    max_size=4,
)


@given(edits)
@settings(max_examples=cases(25, 150), deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_any_change_of_a_job(changes: list[tuple[int, int, str]]) -> None:
    text = GOOD
    for at, drop, new in changes:
        text = text[:at] + new + text[at + drop :]
    Path("job.yaml").write_text(text, encoding="utf-8")
    check(lambda: load_job("job.yaml"))


keys = st.sampled_from(
    ["nodes", "bags", "stop", "delay", "vars", "base", "include", "parameters", "0", "9", "+", "x"]
)
paths = st.lists(keys | st.text(max_size=4), max_size=5).map(".".join)
values = st.sampled_from(["", "1", "[", "{a: 1}", "null", "$(var x)", "~", "a: b", "!t x", "\n"])


@pytest.mark.long
@given(paths, st.sampled_from(["=", "", "==", ".="]), values | st.text(max_size=6))
@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@example("", "=", "")
@example("nodes.+.node", "=", "m:N")
@example("nodes[+]", "=", "{node: m:N}")
def test_any_override(path: str, separator: str, value: str) -> None:
    Path("job.yaml").write_text(GOOD, encoding="utf-8")
    check(lambda: load_job("job.yaml", overrides=[f"{path}{separator}{value}"]))
