"""What an answer of ``why`` says in detail."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.errors import TraceError
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace
from rsltrace.why.answer import why
from rsltrace.why.filters import _spread
from rsltrace.why.question import _said

_TOPICS = st.lists(st.lists(st.integers(0, 50), min_size=1, max_size=4), min_size=2, max_size=3)


@given(_TOPICS)
def test_the_nearest_stamps_are_those_of_all_choices(topics: list[list[int]]) -> None:
    choices: list[list[int]] = [[]]
    for stamps in topics:
        choices = [[*chosen, stamp] for chosen in choices for stamp in stamps]
    assert _spread(topics) == min(max(chosen) - min(chosen) for chosen in choices)


def test_an_exception_of_several_lines_keeps_its_type_and_message() -> None:
    frame = '  File "a.py", line 3, in tick\n    raise ValueError(text)\n    ^^^^^\n'
    text = f"Traceback (most recent call last):\n{frame}ValueError: bad\n second line"
    assert _said(text) == "ValueError: bad second line"


@pytest.mark.ros
def test_a_topic_with_two_callbacks_is_not_answered_for_one_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "twice.py").write_text(
        "from rclpy.node import Node\n"
        "from std_msgs.msg import String\n"
        "class Twice(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('twice')\n"
        "        self.create_subscription(String, '/x', self.one, 1)\n"
        "        self.create_subscription(String, '/x', self.other, 1)\n"
        "    def one(self, m): pass\n"
        "    def other(self, m): pass\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: twice:Twice}]\nstop: {duration: 1s}\n")
    monkeypatch.chdir(tmp_path)
    run(load_job("job.yaml"), "run.mcap")
    with Trace.open("run.mcap") as trace:
        with pytest.raises(TraceError, match=r"several /x; .*Twice\.one.*Twice\.other"):
            why(trace, "/twice", "/x")
        assert why(trace, "/twice", "one") is not None
