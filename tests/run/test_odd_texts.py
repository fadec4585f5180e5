"""Texts of nodes and bags that a terminal, a message or ROS cannot take as they are."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

_RAW = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_NODE = """
class Odd(Listener):
    def __init__(self):
        super().__init__()
        self.get_logger().warn("\\x1b]0;owned\\x07 \\x9b31m \\r \\u202e a\\0b")
        self.get_logger().warn("lone \\ud800 and \\udc80")
        self.get_logger().warn("two\\nlines é")
"""


def test_log_records_are_shown_escaped_and_kept(rsltrace: Any, job_file: Any) -> None:
    """A lone surrogate is in no message, so its escape is; natively it is logged, too."""
    job_file("nodes: [{node: nodes_under_test:Odd}]\nstop: {duration: 1s}\n", _NODE)
    done = rsltrace("record", "job.yaml", "-o", "x.mcap")
    assert done.returncode == 0, done.stderr
    assert _RAW.search(done.stderr) is None, done.stderr
    assert "\\x1b]0;owned\\x07 \\x9b31m \\r \\u202e a\\x00b" in done.stderr
    assert "lone \\ud800 and \\udc80" in done.stderr
    assert "two\nlines é" in done.stderr
    checked = rsltrace("info", "x.mcap", "--check")
    assert checked.returncode == 0, checked.stderr


def test_the_traceback_of_a_node_is_shown_escaped(rsltrace: Any, job_file: Any) -> None:
    code = _NODE + '        raise RuntimeError("\\x1b[2J\\x9bred")\n'
    job_file("nodes: [{node: nodes_under_test:Odd}]\nstop: {duration: 1s}\n", code)
    done = rsltrace("record", "job.yaml", "-o", "x.mcap")
    assert done.returncode == 3
    assert _RAW.search(done.stderr) is None, done.stderr
    assert "RuntimeError: \\x1b[2J\\x9bred\n" in done.stderr


@pytest.mark.parametrize("topic", ["/🚀", "/a b", "/1x", "/a\x1b[2J"])
def test_a_topic_that_ros_has_no_name_for_is_refused_before_the_run(
    rsltrace: Any, job_file: Any, tmp_path: Path, topic: str
) -> None:
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel(topic, "cdr", schema, {})
        data = b"\0\1\0\0\2\0\0\0x\0"
        writer.add_message(channel, 1, data, 1)
        writer.finish()
    job_file("nodes: []\nbags: [bag.mcap]\n", "")
    done = rsltrace("record", "job.yaml", "-o", "x.mcap")
    assert done.returncode == 2, done.stderr
    assert "bag.mcap: a topic cannot be played: " in done.stderr
    assert "exclude" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "x.mcap").exists()
