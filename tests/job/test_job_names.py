"""The naming rules are ROS's own: where rclpy is installed, both must agree on any text."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.job.values.names import (
    check_field_path,
    check_glob,
    check_namespace,
    check_node_name,
    check_remap_from,
    check_remap_to,
    check_target,
    check_topic,
)


def accepts(check: Callable[[str], None], text: str) -> bool:
    try:
        check(text)
    except ValueError:
        return False
    return True


NODE_NAMES = {
    "talker": True,
    "_a": True,
    "a__b": True,
    "A1": True,
    "a" * 255: True,
    "a" * 256: False,
}
NODE_NAMES |= dict.fromkeys(["", "1a", "a b", "a/b", "é", "a-b", "a\n"], False)
NAMESPACES = {"/": True, "/a": True, "/_a/b__c": True, "/" + "a" * 244: True}
NAMESPACES |= dict.fromkeys(
    ["", "a", "//", "/a/", "/a//b", "/1", "/a/~b", "/{ns}", "/a\n", "/" + "a" * 245], False
)
# What rcl's command line does with -r FROM:=TO, as tried on the Jazzy wheels.
REMAP_FROM = dict.fromkeys(
    ["a", "/a/b", "~/a", "a_", "_a", "node:a", "node:/a", "rostopic://a", "rosservice:///a"], True
)
REMAP_FROM |= dict.fromkeys(
    ["", "1a", "__x", "a__b", "/**/a", "a/*", "a/", "a//b", "/", "~", "a b", "__ns", "__node"],
    False,
)
REMAP_TO = dict.fromkeys(["a", "/a/b", "~/b", "_a"], True)
REMAP_TO |= dict.fromkeys(
    ["", "/b/", "b/\\1", "{node}/x", "rostopic://b", "__b", "a__b", "/", "node:a"], False
)


@pytest.mark.parametrize(("name", "good"), NODE_NAMES.items())
def test_node_names(name: str, good: bool) -> None:
    assert accepts(check_node_name, name) == good


@pytest.mark.parametrize(("namespace", "good"), NAMESPACES.items())
def test_namespaces(namespace: str, good: bool) -> None:
    assert accepts(check_namespace, namespace) == good


@pytest.mark.parametrize(("name", "good"), REMAP_FROM.items())
def test_left_sides_of_remappings(name: str, good: bool) -> None:
    assert accepts(check_remap_from, name) == good


@pytest.mark.parametrize(("name", "good"), REMAP_TO.items())
def test_right_sides_of_remappings(name: str, good: bool) -> None:
    assert accepts(check_remap_to, name) == good


@pytest.mark.parametrize(
    ("check", "good", "bad"),
    [
        (check_topic, ["/a", "/a/b_1"], ["", "a", "/", "/a/", "/1", "/a b", "~/a"]),
        (check_field_path, ["data", "status.code", "a1.b_2"], ["", ".a", "a.", "a..b", "a[0]"]),
        (check_target, ["m:N", "a.b:C.d", "_m:_f"], ["", "m", "m:", ":N", "m:N:O", "m.:N", "1:N"]),
        (check_glob, ["/a", "*", "*a", "?a", "[/]a"], ["", "a", "imu/*"]),
    ],
)
def test_other_names(check: Callable[[str], None], good: list[str], bad: list[str]) -> None:
    assert [text for text in good if not accepts(check, text)] == []
    assert [text for text in bad if accepts(check, text)] == []


@pytest.mark.parametrize(
    ("target", "advice"),
    [
        ("nodes/ekf.py", "a module is named with dots: nodes.ekf:Class"),
        ("/robot/ekf.py:Ekf", "add /robot to search_path and write ekf:Ekf"),
        ("my-robot/ekf.py:Ekf", "add my-robot to search_path and write ekf:Ekf"),
        ("nodes/my-ekf.py:Ekf", "'my-ekf' cannot be a module's name: rename the file"),
        ("my-ekf:Ekf", "'my-ekf' cannot be a module's name: rename the file"),
    ],
)
def test_the_advice_on_a_target_is_one_that_can_be_followed(target: str, advice: str) -> None:
    with pytest.raises(ValueError, match=re.escape(advice)):
        check_target(target)


@pytest.mark.ros
@given(st.text(st.sampled_from("aZ_09/~ .-"), max_size=8))
def test_names_are_judged_as_rclpy_judges_them(text: str) -> None:
    validate_node_name = pytest.importorskip("rclpy.validate_node_name").validate_node_name
    validate_namespace = pytest.importorskip("rclpy.validate_namespace").validate_namespace
    for ours, theirs in (
        (check_node_name, validate_node_name),
        (check_namespace, validate_namespace),
    ):
        try:
            good = theirs(text)
        except Exception:
            good = False
        assert accepts(ours, text) == good


REMAP_CODE = """
import sys
import rclpy
for rule in sys.stdin.read().splitlines():
    context = rclpy.Context()
    try:
        rclpy.init(args=["--ros-args", "--disable-external-lib-logs", "-r", rule], context=context)
        print("good")
    except Exception:
        print("bad")
    context.try_shutdown()
"""


@pytest.mark.ros
def test_remappings_are_judged_as_rcl_judges_them() -> None:
    pytest.importorskip("rclpy")
    rules = {f"{name}:=x": good for name, good in REMAP_FROM.items() if not name.startswith("__")}
    rules |= {f"x:={name}": good for name, good in REMAP_TO.items()}
    result = subprocess.run(
        [sys.executable, "-c", REMAP_CODE],
        input="\n".join(rules),
        capture_output=True,
        text=True,
        check=True,
    )
    verdicts = [line == "good" for line in result.stdout.split()]
    assert dict(zip(rules, verdicts, strict=True)) == rules
