"""Interfaces by name: found, or refused with what to install; and their definitions in a trace."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import Imu
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci, NestedMessage
from test_msgs.msg import BoundedSequences, Strings

from rsltrace.adapters.rclpy.messages import interfaces as interface_files
from rsltrace.adapters.rclpy.messages import interfaces as interface_schema
from rsltrace.adapters.rclpy.messages.interfaces import (
    get_message_class,
    get_service_class,
    schema_text,
    type_hash,
    type_name,
)
from rsltrace.errors import SetupError

pytestmark = pytest.mark.ros

RULE = "=" * 80


def installed_messages() -> list[type]:
    """Every message of the packages that the wheels or the distribution bring."""
    packages = [
        "actionlib_msgs",
        "builtin_interfaces",
        "diagnostic_msgs",
        "geometry_msgs",
        "nav_msgs",
        "rcl_interfaces",
        "sensor_msgs",
        "shape_msgs",
        "std_msgs",
        "stereo_msgs",
        "test_msgs",
        "trajectory_msgs",
        "visualization_msgs",
    ]
    modules = [vars(importlib.import_module(f"{package}.msg")) for package in packages]
    classes = (value for module in modules for value in module.values())
    return sorted((c for c in classes if hasattr(c, "SLOT_TYPES")), key=type_name)


# -- names -----------------------------------------------------------------------------------------


def test_a_message_is_found_by_its_name() -> None:
    assert get_message_class("std_msgs/msg/UInt64") is UInt64
    assert type_name(UInt64) == "std_msgs/msg/UInt64"


def test_a_service_is_found_by_its_name() -> None:
    assert get_service_class("std_srvs/srv/Trigger") is Trigger
    assert type_name(Trigger) == "std_srvs/srv/Trigger"


@pytest.mark.parametrize(
    ("cls", "name"),
    [
        (Trigger.Request, "std_srvs/srv/Trigger_Request"),
        (Trigger.Event, "std_srvs/srv/Trigger_Event"),
        (Fibonacci.Goal, "test_msgs/action/Fibonacci_Goal"),
        (Fibonacci.Impl.FeedbackMessage, "test_msgs/action/Fibonacci_FeedbackMessage"),
        (Fibonacci.Impl.SendGoalService.Request, "test_msgs/action/Fibonacci_SendGoal_Request"),
    ],
)
def test_parts_of_services_and_actions_have_names_of_their_own(cls: type, name: str) -> None:
    assert type_name(cls) == name
    assert get_message_class(name) is cls


def test_the_services_of_an_action_are_services() -> None:
    found = get_service_class("test_msgs/action/Fibonacci_SendGoal")
    assert found is Fibonacci.Impl.SendGoalService


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "std_msgs/UInt64",
            "'std_msgs/UInt64' is not the name of an interface; write package/kind/Type, "
            "such as std_msgs/msg/String or std_srvs/srv/Trigger",
        ),
        (
            "no_such_msgs/msg/Thing",
            "no_such_msgs/msg/Thing needs the package no_such_msgs, which this Python cannot "
            "import. There is no wheel of it: put its sources (package.xml, .msg, .srv and "
            ".action files) into a folder of search_path, and its classes are made from them; or "
            "source the ROS 2 workspace that holds it (for one of ROS's own: apt install "
            "ros-jazzy-no-such-msgs, then source /opt/ros/jazzy/setup.bash), and run rsltrace with "
            "the Python that it is built for",
        ),
        (
            "std_msgs/msg/Uint64",
            "package std_msgs has no msg Uint64; did you mean UInt64?",
        ),
        ("std_msgs/msg/Qwertz", "package std_msgs has no msg Qwertz"),
        ("std_msgs/msg/Uint_64", "package std_msgs has no msg Uint_64"),
        (
            "std_msgs/srv/UInt64",
            "std_msgs/srv/UInt64 does not exist: package std_msgs has no srv",
        ),
        (
            "std_srvs/srv/Trigger",
            "std_srvs/srv/Trigger is not a message but a service; its parts are "
            "std_srvs/srv/Trigger_Request and std_srvs/srv/Trigger_Response",
        ),
        (
            "test_msgs/action/Fibonacci",
            "test_msgs/action/Fibonacci is not a message but an action; its parts are "
            "test_msgs/action/Fibonacci_Goal, test_msgs/action/Fibonacci_Result and "
            "test_msgs/action/Fibonacci_Feedback",
        ),
    ],
)
def test_a_message_that_cannot_be_found_says_what_to_do(
    name: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    with pytest.raises(SetupError) as caught:
        get_message_class(name)
    assert str(caught.value).startswith(message)


def test_a_message_is_no_service() -> None:
    with pytest.raises(SetupError, match=r"^std_msgs/msg/UInt64 is not a service but a message$"):
        get_service_class("std_msgs/msg/UInt64")


def test_the_package_to_install_is_that_of_the_distribution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("ROS_DISTRO", "kilted")
    with pytest.raises(SetupError, match="apt install ros-kilted-no-such-msgs"):
        get_service_class("no_such_msgs/srv/Thing")


def test_a_package_that_fails_to_import_is_told_from_a_missing_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "broken_msgs" / "msg"
    package.mkdir(parents=True)
    (tmp_path / "broken_msgs" / "__init__.py").touch()
    (package / "__init__.py").write_text("import no_such_module_of_theirs\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SetupError) as caught:
        get_message_class("broken_msgs/msg/Thing")
    assert str(caught.value) == (
        "broken_msgs/msg/Thing: package broken_msgs is there but cannot be imported: "
        "No module named 'no_such_module_of_theirs'. Is the ROS 2 installation sourced, and built "
        "for this version of Python?"
    )


def test_a_folder_of_sources_is_not_taken_for_a_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = tmp_path / "source_msgs" / "msg"
    sources.mkdir(parents=True)
    (sources / "Thing.msg").write_text("int32 a\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SetupError, match=r"source_msgs.*folder of sources, not a built package"):
        get_message_class("source_msgs/msg/Thing")


def test_a_class_that_rosidl_did_not_make_has_no_name() -> None:
    with pytest.raises(TypeError, match="not a ROS interface"):
        type_name(dict)


def test_importing_the_module_imports_nothing_of_ros() -> None:
    code = (
        "import sys, rsltrace.adapters.rclpy.messages.interfaces; "
        "import rsltrace.adapters.rclpy.messages.codec; "
        "print([m for m in sys.modules if m.split('.')[0] in "
        "('rclpy', 'rosidl_parser', 'std_msgs', 'builtin_interfaces')])"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


# -- definitions -----------------------------------------------------------------------------------


def test_a_schema_is_the_installed_text_and_every_nested_one_once() -> None:
    text = schema_text(Imu)
    own, *nested = text.split(RULE + "\n")
    assert own.startswith("# This is a message to hold data from an IMU")
    assert "std_msgs/Header header\n" in own
    assert [piece.split("\n", 1)[0] for piece in nested] == [
        "MSG: std_msgs/Header",
        "MSG: builtin_interfaces/Time",
        "MSG: geometry_msgs/Quaternion",
        "MSG: geometry_msgs/Vector3",
    ]
    assert text.endswith("\n")


def test_the_parts_of_a_service_have_their_own_section() -> None:
    assert schema_text(Trigger.Request) == ""
    assert schema_text(Trigger.Response) == (
        "bool success   # indicate successful run of triggered service\n"
        "string message # informational, e.g. for error messages\n"
    )


def test_the_parts_of_an_action_have_their_own_section() -> None:
    assert schema_text(Fibonacci.Goal) == "#goal definition\nint32 order\n"
    assert schema_text(Fibonacci.Result) == "#result definition\nint32[] sequence\n"
    assert schema_text(Fibonacci.Feedback) == "#feedback\nint32[] sequence\n"


def test_types_of_the_same_package_are_written_out_in_actions() -> None:
    # rosbags would look for test_msgs/action/Builtins.
    assert "\ntest_msgs/Builtins nested_field_no_pkg\n" in "\n" + schema_text(NestedMessage.Goal)


def test_what_rosidl_makes_itself_is_made_from_the_class() -> None:
    text = schema_text(Fibonacci.Impl.SendGoalService.Event)
    assert text.startswith(
        "service_msgs/ServiceEventInfo info\n"
        "test_msgs/Fibonacci_SendGoal_Request[<=1] request\n"
        "test_msgs/Fibonacci_SendGoal_Response[<=1] response\n" + RULE + "\n"
    )
    assert f"{RULE}\nMSG: test_msgs/Fibonacci_Goal\n#goal definition\nint32 order\n" in text


def parsed(cls: type, text: str) -> dict[str, Any]:
    """The fields of a message and of all in it, as rosbags understands them."""
    from rosbags.typesys import get_types_from_msg

    types = get_types_from_msg(text, type_name(cls))
    return {name: fields for name, (_, fields) in types.items()}


def test_definitions_made_from_classes_mean_the_same_as_installed_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    classes = installed_messages()
    assert len(classes) > 130
    as_installed = [parsed(cls, schema_text(cls)) for cls in classes]
    monkeypatch.setattr(interface_schema, "installed_definition", lambda name: None)
    for cls, expected in zip(classes, as_installed, strict=True):
        made = parsed(cls, schema_text.__wrapped__(cls))
        # .msg files may call a uint8 char.
        assert repr(made) == repr(expected).replace("'char'", "'uint8'")


def test_bounds_are_kept_in_definitions_made_from_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interface_schema, "installed_definition", lambda name: None)
    text = schema_text.__wrapped__(Strings)
    assert "string<=22 bounded_string_value\n" in text
    assert "uint8[<=3] uint8_values\n" in schema_text.__wrapped__(BoundedSequences)


def test_a_definition_of_another_version_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "share" / "std_msgs" / "msg"
    folder.mkdir(parents=True)
    monkeypatch.setattr(interface_files, "_prefixes", lambda package: iter([tmp_path]))

    (folder / "UInt64.msg").write_text("# mine\nuint64 MAX=5 # a constant\nuint64 data\n")
    assert schema_text.__wrapped__(UInt64) == "# mine\nuint64 MAX=5 # a constant\nuint64 data\n"
    (folder / "UInt64.msg").write_text("# newer\nuint64 data\nuint8 added\n")
    assert schema_text.__wrapped__(UInt64) == "uint64 data\n"


def test_definitions_are_found_by_the_prefix_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A package whose classes stand elsewhere than its definitions.
    folder = tmp_path / "overlay" / "share" / "elsewhere_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Thing.msg").write_text("int32 a\n\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path / 'overlay'}")
    assert interface_files.installed_definition("elsewhere_msgs/msg/Thing") == "int32 a"
    assert interface_files.installed_definition("elsewhere_msgs/msg/Other") is None


# -- hashes ----------------------------------------------------------------------------------------


def test_the_type_hash_is_that_of_ros() -> None:
    assert type_hash(UInt64) == (
        "RIHS01_fbdc52018fc13755dce18024d1a671c856aa8b4aaf63adfb095b608f98e8c943"
    )


def test_services_actions_and_their_parts_have_hashes() -> None:
    hashes = {
        type_hash(cls)
        for cls in (Trigger, Trigger.Request, Trigger.Response, Fibonacci, Fibonacci.Goal)
    }
    assert None not in hashes
    assert len(hashes) == 5


def test_the_hashes_are_those_of_the_schemas() -> None:
    # rosbags computes them from the text, ROS from the same definitions when it was built.
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    compared = 0
    for cls in installed_messages():
        name, text = type_name(cls), schema_text(cls)
        if re.search(r"^(char|wstring)\b", text, re.MULTILINE):
            continue  # rosbags does not know that a char is a uint8, nor wstrings
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(text, name))
        assert store.hash_rihs01(name) == type_hash(cls), name
        compared += 1
    assert compared > 120


def test_no_hash_without_a_type_description(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(interface_files, "_prefixes", lambda package: iter([tmp_path]))
    assert type_hash.__wrapped__(UInt64) is None
    folder = tmp_path / "share" / "std_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "UInt64.json").write_text("{}")
    assert type_hash.__wrapped__(UInt64) is None
