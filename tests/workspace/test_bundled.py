"""Interfaces that no wheel has: their definitions come with rsltrace."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from rsltrace.adapters.workspace import cache
from rsltrace.adapters.workspace.bundled import BUNDLED, bundled_packages
from rsltrace.adapters.workspace.imports import unbuilt_packages
from rsltrace.errors import SetupError
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
pytest.importorskip("rosidl_adapter", reason="needs ROS's rosidl")
if find_spec("tf2_msgs") is not None:
    pytest.skip("tf2_msgs is installed", allow_module_level=True)

_NODE = """
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

class Frames(Node):
    def __init__(self):
        super().__init__("frames")
        self.sender = self.create_publisher(TFMessage, "/tf", 10)
        self.create_subscription(TFMessage, "/tf", self.on_tf, 10)
        self.create_timer(0.5, lambda: self.sender.publish(TFMessage(transforms=[self.found()])))

    def found(self):
        transform = TransformStamped(child_frame_id="base")
        transform.header.frame_id = "odom"
        return transform

    def on_tf(self, message):
        self.get_logger().info(f"{message.transforms[0].child_frame_id}")
"""
_JOB = "nodes: [{node: 'frames:Frames'}]\nstop: {time: 1s}\n"
_TF_MESSAGE = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
"""The type hash that a built tf2_msgs has for TFMessage."""


@pytest.fixture(scope="module")
def caches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.delenv("AMENT_PREFIX_PATH", raising=False)
        cache._root.cache_clear()
        yield folder
    cache._root.cache_clear()


def test_a_job_of_transforms_needs_nothing_but_wheels(
    tmp_path: Path, caches: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    digests = []
    for name in "ab":
        folder = tmp_path / name
        folder.mkdir()
        (folder / "frames.py").write_text(_NODE)
        (folder / "job.yaml").write_text(_JOB)
        result = run(load_job(folder / "job.yaml"), folder / "run.mcap")
        assert result.error is None, result.error
        digests.append(result.digest)
    assert digests[0] == digests[1]
    assert "definitions of ROS 2 Jazzy: tf2_msgs 0.36.4\n" in capfd.readouterr().err
    with Trace.open(folder / "run.mcap") as trace:
        (channel,) = [one for one in trace.channels.values() if one.topic == "/tf"]
        assert channel.schema_text.startswith("geometry_msgs/TransformStamped[] transforms\n")
        assert channel.metadata["topic_type_hash"] == _TF_MESSAGE
    made = (caches / "rsltrace" / "interfaces").glob("*/site-packages/*/*/_[a-z]*.py")
    assert [path.name for path in made] == ["_tf_message.py"]


def test_the_workspace_comes_first_and_may_use_what_is_bundled(
    tmp_path: Path, caches: Path
) -> None:
    for name, text in (("tf2_msgs", "int32 own\n"), ("my_msgs", "geographic_msgs/GeoPoint at\n")):
        (tmp_path / name / "msg").mkdir(parents=True)
        (tmp_path / name / "package.xml").write_text(f"<package><name>{name}</name></package>")
        (tmp_path / name / "msg" / "TFMessage.msg").write_text(text)
    with unbuilt_packages([tmp_path]):
        assert import_module("tf2_msgs.msg").TFMessage().own == 0
        assert import_module("my_msgs.msg").TFMessage().at.latitude == 0.0


def test_what_is_sourced_without_python_comes_before_what_is_bundled(
    tmp_path: Path, caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    for name, text in (("tf2_msgs", "int32 own\n"), ("cpp_msgs", "tf2_msgs/TFMessage tree\n")):
        share = tmp_path / "share" / name
        (share / "msg").mkdir(parents=True)
        (share / "msg" / "TFMessage.msg").write_text(text)
    with unbuilt_packages([]):
        assert import_module("tf2_msgs.msg").TFMessage().own == 0
        assert import_module("cpp_msgs.msg").TFMessage().tree.own == 0


def test_natively_they_are_refused_by_name(caches: Path) -> None:
    from rclpy.type_support import check_for_type_support

    with unbuilt_packages([], native=True):
        message = import_module("tf2_msgs.msg").TFMessage
        message.__class__._TYPE_SUPPORT = None
        with pytest.raises(SetupError, match=r"tf2_msgs is not installed: .* without --native"):
            check_for_type_support(message)


def test_the_files_are_understood_and_have_no_comments() -> None:
    from rosidl_adapter.parser import parse_action_file, parse_message_file, parse_service_file

    parse = {".msg": parse_message_file, ".srv": parse_service_file, ".action": parse_action_file}
    packages = bundled_packages()
    assert {path.name for path in packages["tf2_msgs"].folder.parent.iterdir()} == set(BUNDLED)
    for name, package in packages.items():
        assert package.interfaces
        for file in package.interfaces:
            parse[file.suffix](name, str(package.folder / file))
            assert "#" not in (package.folder / file).read_text()
