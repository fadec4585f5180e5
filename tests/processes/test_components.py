"""Components: a container is asked to load them, one after the other."""

from __future__ import annotations

from pathlib import Path

import pytest

from rsltrace.errors import JobError, RunError
from rsltrace.job import job_from_text, load_job
from rsltrace.run import RunResult, run
from rsltrace.run.provenance import source_files
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

PACKAGE = """<package format="3"><name>composition_interfaces</name><version>1.0.0</version>
<description>x</description><maintainer email="a@b.c">a</maintainer><license>x</license></package>
"""
SERVICE = """string package_name
string plugin_name
string node_name
string node_namespace
uint8 log_level
string[] remap_rules
rcl_interfaces/Parameter[] parameters
rcl_interfaces/Parameter[] extra_arguments
---
bool success
string error_message
string full_node_name
uint64 unique_id
"""
CONTAINER = """
import rclpy
from composition_interfaces.srv import LoadNode
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python


class Container(Node):
    def __init__(self):
        super().__init__("container")
        self.create_service(LoadNode, "~/_container/load_node", self.load)

    def load(self, asked, answer):
        def values(parameters):
            return {one.name: parameter_value_to_python(one.value) for one in parameters}

        self.get_logger().info(repr((
            asked.package_name, asked.plugin_name, asked.node_name, asked.node_namespace,
            list(asked.remap_rules), values(asked.parameters), values(asked.extra_arguments))))
        answer.success = "Broken" not in asked.plugin_name
        answer.error_message = "" if answer.success else "no such class"
        return answer


rclpy.init()
rclpy.spin(Container())
"""
JOB = """
search_path: [.]
nodes:
  - component: demo/demo::First
    container: /cam/container
    name: first
    namespace: /cam
    parameters: {{gain: 3, names: [a, b]}}
    parameter_files: [p.yaml]
    remappings: {{in: out}}
    extra_arguments: {{use_intra_process_comms: true}}
  - component: demo/demo::{second}
    container: /cam/container
    on_exception: {on_exception}
  - script: container.py
    namespace: /cam
stop: {{duration: 2s}}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a container, and the interface by which it is asked."""
    package = tmp_path / "composition_interfaces"
    (package / "srv").mkdir(parents=True)
    (package / "package.xml").write_text(PACKAGE)
    (package / "srv" / "LoadNode.srv").write_text(SERVICE)
    (tmp_path / "container.py").write_text(CONTAINER)
    parameters = "/**: {ros__parameters: {gain: 1, rate: 2.5}}\n/other: {ros__parameters: {x: 1}}\n"
    (tmp_path / "p.yaml").write_text(parameters)
    return tmp_path


def _run(
    folder: Path, second: str, on_exception: str = "stop", more: str = ""
) -> tuple[RunResult, list[str]]:
    text = JOB.format(second=second, on_exception=on_exception) + more
    (folder / "job.yaml").write_text(text)
    result = run(load_job(folder / "job.yaml"), folder / "t.mcap", force=True)
    with Trace.open(folder / "t.mcap") as trace:
        said = [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]
    return result, said


def test_a_container_loads_components_in_order_with_all_that_the_job_says(folder: Path) -> None:
    result, said = _run(folder, "Second", more="ros_arguments: [-r, odom:=odometry, -p, gain:=4]\n")
    assert result.error is None
    assert [note for note in result.notes if "'in'" in note] == []
    assert said == [
        "('demo', 'demo::First', 'first', '/cam', ['odom:=odometry', 'in:=out'], "
        "{'gain': 4, 'names': ['a', 'b'], 'rate': 2.5}, {'use_intra_process_comms': True})",
        "('demo', 'demo::Second', '', '', ['odom:=odometry'], {'gain': 4}, {})",
    ]


def test_what_a_container_cannot_load_ends_the_run_or_is_logged(folder: Path) -> None:
    result, _ = _run(folder, "Broken")
    assert isinstance(result.error, RunError)
    wrong = "/cam/container cannot load demo/demo::Broken: no such class"
    assert wrong in str(result.error)
    result, said = _run(folder, "Broken", "log")
    assert result.error is None
    assert said[-1] == wrong


def test_a_component_whose_container_is_not_there_is_named(folder: Path) -> None:
    text = JOB.format(second="Second", on_exception="stop").replace(
        "container: /cam/c", "container: /c"
    )
    (folder / "job.yaml").write_text(text)
    job = load_job(folder / "job.yaml")
    notes = run(job, None).notes
    assert "demo/demo::First has not started: it waited for service /container/" in notes[0]


def test_without_the_interface_the_error_says_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)  # which may have it, too
    (folder / "composition_interfaces" / "package.xml").unlink()
    (folder / "job.yaml").write_text(JOB.format(second="Second", on_exception="stop"))
    with pytest.raises(JobError, match=r"job\.yaml:4:16: composition_interfaces/srv/LoadNode"):
        run(load_job(folder / "job.yaml"), None)


def test_the_library_of_a_component_is_part_of_the_code_of_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index = tmp_path / "share/ament_index/resource_index/rclcpp_components"
    index.mkdir(parents=True)
    (index / "robot").write_text("robot::Eye;lib/libeye.so\nrobot::Arm;lib/libarm.so\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'none'}:{tmp_path}")
    entries = [f"{{component: 'robot/robot::{name}', container: /c}}" for name in ("Arm", "Lost")]
    text = f"nodes: [{{program: /bin/true, name: c}}, {', '.join(entries)}]"
    job = job_from_text(text, "job.yaml", tmp_path)
    found = {name: path for name, path in source_files(job).items() if name.startswith("file:lib")}
    assert found == {"file:libarm.so": tmp_path / "lib/libarm.so"}
