"""Two builds of one program are compared as one program, wherever their files lie."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rsltrace.diff import diff_files
from rsltrace.diff.facts.causes import Verdict
from rsltrace.job import load_job
from rsltrace.run import record

pytestmark = pytest.mark.ros

CODE = """
import rclpy
from std_msgs.msg import Int64

rclpy.init()
node = rclpy.create_node('{name}')
publisher = node.create_publisher(Int64, '{name}', 10)
count = 0

def tick():
    global count
    count += 1
    publisher.publish(Int64(data={value}))

node.create_timer(0.1, tick)
rclpy.spin(node)
"""


@pytest.fixture
def compared(tmp_path: Path) -> Any:
    """Record a job of scripts in each of two folders and compare the traces."""

    def compare(*scripts: dict[str, tuple[str, str]]) -> Any:
        paths = []
        for number, files in enumerate(scripts):
            entries = []
            for file, (name, value) in files.items():
                path = tmp_path / file
                path.parent.mkdir(exist_ok=True)
                path.write_text(CODE.format(name=name, value=value))
                entries.append(f"{{script: {file}}}")
            job = tmp_path / f"job{number}.yaml"
            job.write_text(f"nodes: [{', '.join(entries)}]\nstop: {{duration: 1s}}\n")
            record(load_job(job), tmp_path / f"{number}.mcap", force=True)
            paths.append(tmp_path / f"{number}.mcap")
        return diff_files(*paths)

    return compare


@pytest.mark.few(1)
@pytest.mark.parametrize("second", ["new/talk.py", "talk_v2.py"])
def test_the_difference_is_that_of_the_programs(compared: Any, second: str) -> None:
    old = {"old/talk.py": ("talk", "count"), "other.py": ("other", "0")}
    new = {second: ("talk", "count // 3 * 3 + count % 3"), "other.py": ("other", "0")}
    same = compared(old, new)
    assert same.identical
    assert same.sentence.startswith("the two runs are identical except for program names: ")
    assert same.notes == (f"{Path('old/talk.py')} in a is compared with {second} in b",)
    new[second] = ("talk", "count if count < 5 else -count")
    found = compared(old, new)
    assert found.verdict is Verdict.SAME_INPUT_DIFFERENT_OUTPUT
    assert found.agreeing > 8
    assert "/talk" in found.sentence


def test_another_program_is_another_one(compared: Any) -> None:
    found = compared(
        {"a.py": ("a", "1"), "c.py": ("c", "1")}, {"b.py": ("b", "1"), "c.py": ("c", "1")}
    )
    assert found.verdict is Verdict.GRAPH
    assert "the graphs differ: /a in a is renamed to /b in b" in found.sentence


def test_a_node_of_another_class_is_the_node_of_its_name(tmp_path: Path) -> None:
    for module, value in (("talk", "self.count"), ("talk_v2", "self.count + (self.count > 5)")):
        (tmp_path / f"{module}.py").write_text(
            "from rclpy.node import Node\n"
            "from std_msgs.msg import Int64\n"
            "class Talk(Node):\n"
            "    def __init__(self):\n"
            "        super().__init__('talk')\n"
            "        self.count = 0\n"
            "        self.out = self.create_publisher(Int64, 'x', 10)\n"
            "        self.create_timer(0.1, self.tick)\n"
            "    def tick(self):\n"
            "        self.count += 1\n"
            f"        self.out.publish(Int64(data={value}))\n"
        )
        job = tmp_path / f"{module}.yaml"
        job.write_text(f"nodes: [{{node: '{module}:Talk'}}]\nstop: {{duration: 1s}}\n")
        record(load_job(job), tmp_path / f"{module}.mcap")
    diff = diff_files(tmp_path / "talk.mcap", tmp_path / "talk_v2.mcap")
    assert "talk:Talk → talk_v2:Talk" in diff.sentence
    assert "first effect: /talk published a different data on /x at 0.6 s" in diff.sentence
