"""Nodes that cannot be made: the error shows the job's line, the user's line, and what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import JobError, NodeError

JOB = "nodes:\n  - node: {node}\n    {more}\nstop: {{duration: 1s}}\n"

NODES = """
class Any(Node):
    def __init__(self, **options):
        super().__init__('any', **options)

class Needy(Node):
    def __init__(self, rate, *, frame='odom'):
        super().__init__('needy')
        self.declare_parameter('gain', 1.0)
"""


def told(record_job: Callable[..., Any], node: str, more: str, error: type = JobError) -> str:
    yaml = JOB.format(node=node, more=more or "name: it")
    if error is not JobError:
        found = record_job(yaml, NODES, output=None).error
        assert isinstance(found, error)
        return str(found)
    with pytest.raises(JobError) as caught:
        record_job(yaml, NODES, output=None)
    return str(caught.value)


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("code", "said", "line"),
    [
        ("x = 1\ndef f(:\n", "SyntaxError: invalid syntax", "def f(:"),
        ("x = 0\ny = 1 / x\n", "ZeroDivisionError: division by zero", "y = 1 / x"),
        ("import sys\nsys.exit(3)\n", "SystemExit: 3; a module should only", "sys.exit(3)"),
        (
            "x = 0\nfrom std_msgs.msg import Nix\n",
            "ImportError: cannot import name 'Nix'",
            "from st",
        ),
        ("x = 0\nraise ValueError\n", "ValueError (", "raise ValueError"),
        ("x = 0\nimport nodes_that_break\n", "ZeroDivisionError: division by zero", "1 / 0"),
    ],
)
def test_a_module_that_raises_when_imported(
    record_job: Callable[..., Any], tmp_path: Path, code: str, said: str, line: str
) -> None:
    (tmp_path / "broken_nodes.py").write_text(code)
    (tmp_path / "nodes_that_break.py").write_text("x = 0\n1 / 0\n")
    message = told(record_job, "broken_nodes:Robot", "")
    first, code_line, job_line, caret = message.splitlines()
    assert "job.yaml:2:11: module 'broken_nodes' cannot be imported: it raised " + said in first
    assert first.endswith(".py:2)")
    assert code_line.strip().startswith(line)
    assert job_line == "    2 |   - node: broken_nodes:Robot"
    assert caret == "      |           ^"


@pytest.mark.parametrize(
    ("node", "more", "line", "message"),
    [
        ("Needy", "arguments: {rat: 5}", 3, "Needy takes no argument 'rat': did you mean 'rate'?"),
        ("Needy", "arguments: {frame: x}", 2, "Needy: missing a required argument: 'rate'; give"),
        ("Talker", "arguments: {size: 5}", 3, "Talker takes no argument 'size': it takes period"),
        ("Listener", "arguments: {size: 5}", 3, "Listener takes no argument 'size': it takes none"),
    ],
)
def test_arguments_that_a_node_does_not_take(
    record_job: Callable[..., Any], node: str, more: str, line: int, message: str
) -> None:
    text = told(record_job, f"nodes_under_test:{node}", more)
    assert f"job.yaml:{line}:" in text.splitlines()[0]
    assert message in text
    assert text.count("^") == 1


def test_arguments_that_a_node_takes(record_job: Callable[..., Any]) -> None:
    for node, more in (
        ("Any", "arguments: {allow_undeclared_parameters: true}"),
        ("Needy", "arguments: {rate: 3, frame: map}"),
    ):
        yaml = JOB.format(node=f"nodes_under_test:{node}", more=more)
        assert record_job(yaml, NODES, output=None).error is None


def test_a_parameter_file_that_rcl_cannot_read(
    record_job: Callable[..., Any], tmp_path: Path
) -> None:
    (tmp_path / "good.yaml").write_text("/**: {ros__parameters: {rate: 3.0}}\n")
    (tmp_path / "bad.yaml").write_text("talker:\n  rate: 3.0\n")
    more = "parameter_files: [good.yaml, bad.yaml]"
    text = told(record_job, "nodes_under_test:Talker", more)
    assert "job.yaml:3:34: bad.yaml is no ROS parameter file: Cannot have a value before" in text
    assert text.splitlines()[1] == f"    3 |     {more}"


def test_an_integer_for_a_parameter_with_a_decimal_point(record_job: Callable[..., Any]) -> None:
    more = "arguments: {rate: 3}\n    parameters: {gain: 2}"
    text = told(record_job, "nodes_under_test:Needy", more, NodeError)
    lines = text.splitlines()
    assert lines[-2] == "  write 2.0: ROS takes no integer for a parameter with a decimal point"
    assert lines[-1].startswith("  the job gives it at ")
    assert lines[-1].endswith("job.yaml:4:24")


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("dta", "/numbers is a UInt64 without the field 'dta': did you mean 'data'?"),
        ("code", "/numbers is a UInt64 without the field 'code': there are data"),
        ("data.x", "/numbers is a UInt64 without the field 'data.x': the part before it is not"),
    ],
)
def test_a_field_that_no_exit_status_can_come_from(
    record_job: Callable[..., Any], field: str, message: str
) -> None:
    stop = f"stop: {{topic: {{name: /numbers, exit_code: {field}}}}}\n"
    result = record_job("nodes: [{node: nodes_under_test:Talker}]\n" + stop, NODES, output=None)
    assert result.exit_code == 3
    assert f"job.yaml:2:43: stop.topic.exit_code: {message}" in str(result.error)


ONCE = """
class Once(Node):
    made = 0

    def __init__(self):
        if Once.made:
            raise ValueError("there is one of it")
        Once.made += 1
        super().__init__("once")
"""


def test_which_of_several_alike_could_not_be_made(record_job: Callable[..., Any]) -> None:
    yaml = "nodes:\n  - node: nodes_under_test:Once\n  - node: nodes_under_test:Once\n"
    error = record_job(yaml, NODES + ONCE, output=None).error
    _, *_, last = str(error).splitlines()
    assert "there is one of it" in str(error)
    assert last.startswith("  the job names it at ")
    assert last.endswith("job.yaml:3:5")
