"""Names of parameters: a job may give all that a parameter file may."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.node import Node

from rsltrace import NodeSpec
from rsltrace.adapters.rclpy.entry import ros_arguments
from rsltrace.adapters.rclpy.parameter_overrides import ParameterOverrides
from tests.tiers import cases

pytestmark = pytest.mark.ros

VALUES = {
    "walk.axis_mappings.linear-x.axis": 1,  # as joy_teleop's parameter files have it
    "a b.c": [0.5, 2.0],
    "7th": 'quo"ted\\: {text}',
    "größe": True,
    "plain.name": "x",
}


def test_names_that_no_rule_can_have(simulate: Any) -> None:
    seen: dict[str, Any] = {}

    class Reads(Node):
        def __init__(self) -> None:
            super().__init__("reads", automatically_declare_parameters_from_overrides=True)
            seen.update({name: self.get_parameter(name).value for name in VALUES})

    simulate(NodeSpec(node=Reads, parameters=VALUES), duration=0.1)
    assert {name: list(v) if isinstance(VALUES[name], list) else v for name, v in seen.items()} == (
        VALUES
    )


def test_an_empty_list_leaves_a_parameter_unset_as_in_ros(simulate: Any, tmp_path: Path) -> None:
    seen: dict[str, Any] = {}

    class Declares(Node):
        def __init__(self, name: str) -> None:
            super().__init__(name)
            declared = [self.declare_parameter(one, ["default"]) for one in ("a b", "c")]
            seen[name] = [(one.type_.name, one.value) for one in declared]

    (tmp_path / "all.yaml").write_text("/**: {ros__parameters: {a b: [], c: []}}\n")
    for name, parts in [
        ("by_file", {"parameter_files": ["all.yaml"]}),
        ("by_value", {"parameters": {"a b": [], "c": []}}),
    ]:
        simulate(NodeSpec(node=Declares, arguments={"name": name}, **parts), duration=0.1)
    assert seen == dict.fromkeys(["by_file", "by_value"], [("NOT_SET", None)] * 2)


@settings(max_examples=cases(10, 50), deadline=None)
@given(
    st.dictionaries(
        st.text("abz_-7 ü:#\"'", min_size=1).filter(lambda name: name.strip()),
        st.integers(-5, 5),
        max_size=4,
    )
)
def test_any_name_keeps_its_value(parameters: dict[str, int]) -> None:
    lists = ros_arguments(
        name=None,
        namespace=None,
        parameters=parameters,
        parameter_files=(),
        remappings={},
        where="job",
    )
    found: dict[str, Any] = {}
    for one in lists:
        found.update(one.parameters("/node"))
    assert found == parameters


def test_numbers_of_many_digits_are_texts_and_many_names_are_found_at_once(tmp_path: Path) -> None:
    """As ROS reads them; each name was looked for among all before it."""
    names = ", ".join(f"k{n}: {{a: {n}}}" for n in range(2000))
    path = tmp_path / "values.yaml"
    path.write_text(f"node: {{ros__parameters: {{long: {'9' * 5000}, {names}, k7: {{a: -1}}}}}}\n")
    overrides, compared = ParameterOverrides(), 0

    def count(frame: Any, event: str, argument: object) -> Any:
        nonlocal compared
        compared += event == "line"
        return count

    sys.settrace(count)
    try:
        overrides.add_file(str(path))
    finally:
        sys.settrace(None)
    values = overrides.of_node("/node")
    assert values["long"] == "9" * 5000
    assert list(values)[:3] == ["long", "k0.a", "k1.a"]
    assert values["k7.a"] == -1
    assert len(values) == 2001
    assert compared < 2_000_000
