"""Launch files evaluated by ROS's own launch, where it is installed; and that the reader which
needs no ROS means the same by them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rsltrace.adapters.launch import ros_launch
from rsltrace.adapters.launch.model import LaunchResult
from rsltrace.adapters.launch.reader import read_launch_file
from rsltrace.adapters.launch.specs import node_specs
from rsltrace.errors import JobError
from rsltrace.job.parts.launch import StartAfterSpec

pytest.importorskip("launch_ros", reason="needs ROS's launch and launch_ros")

FILES = Path(__file__).parent / "files"
XML = (FILES / "everything.launch.xml").read_text(encoding="utf-8")
YAML = (FILES / "everything.launch.yaml").read_text(encoding="utf-8")

PYTHON = (FILES / "everything.launch.py").read_text(encoding="utf-8")

SUB = "<launch><arg name='who'/><node pkg='demo' exec='talker' name='sub_$(var who)'/></launch>"


def _why_not(package: str, name: str) -> str | None:
    return "it is not installed" if package == "rclcpp_components" else None


@pytest.fixture
def evaluate(write: Callable[..., Path], prefix: Path) -> Callable[..., LaunchResult]:
    def go(text: str, name: str, **arguments: str) -> LaunchResult:
        write(SUB, "sub.launch.xml")
        path = write(text, name)
        assert ros_launch.can_read(path)
        return ros_launch.read_launch_file(path, arguments)

    return go


def test_a_python_launch_file(evaluate: Any) -> None:
    launched = evaluate(PYTHON, "a.launch.py", robot="jackal")
    assert "RSLTRACE_T" not in os.environ
    assert "environment variable RSLTRACE_T" in launched.ignored[0]
    specs = node_specs(launched, skip_unsupported=True, why_not=_why_not)
    names = [(spec.target, spec.namespace, spec.name) for spec in specs]
    assert names == [
        ("demo/talker", "/jackal", "talk"),
        ("demo/listener", "/abs", None),
        ("demo/talker", "/jackal/life", "cycle"),
        ("demo/listener", None, "opaque_jackal"),
        ("demo.nodes:Filter", None, "f"),
        ("demo/talker", None, "sub_jackal"),
        ("demo/talker", "/jackal", "talk"),
        ("demo/talker", "/jackal", "talk"),
    ]
    assert specs[6].start_after == StartAfterSpec.after(1_000_000_000)
    assert specs[7].start_after == StartAfterSpec(ended=0)
    talk, component = specs[0], specs[4]
    # The file gives rate once more, after the values.
    assert talk.parameters == {
        "shared": 7,
        "nested.list": (1, 2),
        "text": "jackal",
        "number": "12",
    }
    assert [Path(file).name for file in talk.parameter_files] == ["demo.yaml"]
    assert talk.arguments == ("--loud", "jackal")
    assert talk.remappings == {"tf": "/tf_all", "chatter": "/chat"}
    assert (component.parameters, component.remappings) == ({"shared": 7, "gain": 3}, {"in": "out"})
    assert {item.what for item in launched.unsupported} == {
        "process 'echo jackal'",
        "demo/demo::Fast",
        "rclcpp_components/component_container (c)",
    }
    assert list(launched.arguments) == ["robot", "camera", "who"]


@pytest.mark.parametrize(
    ("text", "name"), [(XML, "a.launch.xml"), (YAML, "a.launch.yaml"), (SUB, "s.launch.xml")]
)
@pytest.mark.parametrize("robot", ["husky", "jackal"])
def test_both_readers_agree(
    evaluate: Any, write: Any, text: str, name: str, robot: str, tmp_path: Path
) -> None:
    write("/**: {ros__parameters: {z: 1}}", "extra.yaml")
    arguments = {"robot": robot, "who": robot, "use_camera": "true"}
    ros = evaluate(text, name, **arguments)
    own = read_launch_file(tmp_path / name, arguments)

    def specs(launched: LaunchResult) -> list[Any]:
        nodes = [replace(node, where="") for node in launched.nodes]
        return node_specs(replace(launched, nodes=nodes), skip_unsupported=True, why_not=_why_not)

    assert specs(ros) == specs(own)
    assert set(ros.arguments) == set(own.arguments)


def test_mistakes_name_the_file(evaluate: Any) -> None:
    with pytest.raises(JobError, match=r"a\.launch\.py: .*not valid"):
        evaluate(PYTHON, "a.launch.py", robot="tank")
    with pytest.raises(JobError, match="ZeroDivisionError"):
        evaluate("def generate_launch_description():\n    1 / 0\n", "b.launch.py")
