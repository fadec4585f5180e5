"""Python launch files without ROS's launch: rsltrace's own part of it, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rsltrace import Trace
from rsltrace.adapters.launch import ros_launch
from rsltrace.adapters.launch.expand import read_in_child_process
from rsltrace.adapters.launch.model import LaunchResult
from rsltrace.adapters.launch.python_file import read_launch_file
from rsltrace.adapters.launch.specs import node_specs
from rsltrace.errors import JobError
from rsltrace.job.parts.launch import StartAfterSpec

FILES = Path(__file__).parent / "files"
SUB = "<launch><arg name='who'/><node pkg='demo' exec='talker' name='sub_$(var who)'/></launch>"
HEAD = """
import os, sys
import launch, launch_ros.actions
from launch import LaunchDescription
from launch.actions import *
from launch.actions import (
    DeclareLaunchArgument, EmitEvent, ExecuteProcess, GroupAction, IncludeLaunchDescription,
    LogInfo, OpaqueFunction, RegisterEventHandler, SetEnvironmentVariable, Shutdown, TimerAction)
from launch.conditions import IfCondition, LaunchConfigurationEquals
from launch.event_handlers import OnProcessExit, OnProcessStart, OnShutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import *
from launch.substitutions import (
    Command, EnvironmentVariable, EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution,
    PythonExpression, ThisLaunchFileDir)
from launch_ros.actions import ComposableNodeContainer, LifecycleNode, Node, SetParameter
from launch_ros.descriptions import ComposableNode
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

def generate_launch_description():
"""

ROOTS = ("launch", "launch_ros", "nav2_common")

pytestmark = pytest.mark.skipif(
    ros_launch.can_read(Path("a.launch.py")), reason="ROS's own launch is installed"
)


@pytest.fixture
def read(
    write: Callable[..., Path], prefix: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., LaunchResult]]:
    """Read the body of a ``generate_launch_description``, next to ``sub.launch.xml``: here."""
    write(SUB, "sub.launch.xml")
    environment = dict(os.environ)

    def go(body: str, **arguments: str) -> LaunchResult:
        return read_launch_file(write_body(write, body), arguments)

    yield go
    os.environ.clear()
    os.environ.update(environment)
    for name in [name for name in sys.modules if name.partition(".")[0] in ROOTS]:
        del sys.modules[name]


def write_body(write: Callable[..., Path], body: str) -> Path:
    lines = "".join(f"    {line}\n" for line in body.strip().splitlines())
    return write(HEAD + lines, "a.launch.py")


def specs_of(launched: LaunchResult) -> list[Any]:
    def why_not(package: str, name: str) -> str | None:
        return "it is not installed" if package == "rclcpp_components" else None

    return node_specs(launched, skip_unsupported=True, why_not=why_not)


def parameters(launched: LaunchResult) -> dict[str, Any]:
    (spec,) = specs_of(launched)
    return dict(spec.parameters)


BODY = len(HEAD.splitlines()) + 1
"""The line that a body begins in."""


@pytest.mark.long
def test_everything(write: Callable[..., Path], prefix: Path) -> None:
    write(SUB, "sub.launch.xml")
    path = write((FILES / "everything.launch.py").read_text(), "a.launch.py")
    launched = read_in_child_process(path, {"robot": "jackal"}, [])
    specs = specs_of(launched)
    assert "RSLTRACE_T" not in os.environ
    assert [(spec.target, spec.namespace, spec.name) for spec in specs] == [
        ("demo/talker", "/jackal", "talk"),
        ("demo/listener", "/abs", None),
        ("demo/talker", "/jackal/life", "cycle"),
        ("demo/listener", None, "opaque_jackal"),
        ("demo.nodes:Filter", None, "f"),
        ("demo/talker", None, "sub_jackal"),
        ("demo/talker", "/jackal", "talk"),
        ("demo/talker", "/jackal", "talk"),
    ]
    talk, component = specs[0], specs[4]
    assert talk.parameters == {
        "shared": 7,
        "nested.list": (1, 2),
        "text": "jackal",
        "number": "12",
    }
    assert [Path(file).name for file in talk.parameter_files] == ["demo.yaml"]
    assert talk.arguments == ("--loud", "jackal", "--ros-args", "--log-level", "warn")
    assert talk.remappings == {"tf": "/tf_all", "chatter": "/chat"}
    assert (component.parameters, component.remappings) == ({"shared": 7, "gain": 3}, {"in": "out"})
    assert specs[6].start_after == StartAfterSpec.after(1_000_000_000)
    assert specs[7].start_after == StartAfterSpec(ended=0)
    lines = path.read_text().splitlines()
    container_line = next(n for n, text in enumerate(lines, 1) if "NodeContainer(" in text)
    component_line = next(n for n, text in enumerate(lines, 1) if "demo::Fast" in text)
    process_line = next(n for n, text in enumerate(lines, 1) if "ExecuteProcess(cmd" in text)
    assert [str(item) for item in launched.unsupported] == [
        f"a.launch.py:{container_line}: rclcpp_components/component_container (c): it is not "
        "installed",
        f"a.launch.py:{component_line}: demo/demo::Fast: it is a C++ component, and its container "
        "/c is not there",
        f"a.launch.py:{process_line}: process 'echo jackal': other programs do not run in a "
        "simulation",
    ]
    assert [str(argument) for argument in launched.arguments.values()] == [
        "robot (default 'husky', which one)",
        "camera (default 'true')",
        "who (required)",
    ]


@pytest.mark.few(30)
@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("1", 1),
        ("'1'", "1"),
        ("'1e-3'", 0.001),
        ("EqualsSubstitution('1', 'true')", True),
        ("[1, 2.5]", (1.0, 2.5)),
        ("['a', 'b']", ("a", "b")),
        ("LaunchConfiguration('number')", 12),
        ("[LaunchConfiguration('number'), '.5']", 12.5),
        ("[[LaunchConfiguration('number')], ['7']]", (12, 7)),
        ("ParameterValue(LaunchConfiguration('number'), value_type=str)", "12"),
        ("ParameterValue('3', value_type=int)", 3),
        ("PythonExpression(['2 * ', LaunchConfiguration('number'), ' + math.floor(0.5)'])", 24),
        ("Command('echo [1, 2]')", (1, 2)),
        ("EnvironmentVariable('NOBODY_SETS_THIS', default_value='d')", "d"),
    ],
)
def test_a_value_is_what_ros_makes_of_it(read: Any, written: str, value: object) -> None:
    launched = read(
        f"n = Node(package='demo', executable='talker', parameters=[{{'p': {written}}}])\n"
        "return LaunchDescription([DeclareLaunchArgument('number', default_value='12'), n])"
    )
    assert parameters(launched) == {"p": value}


def test_a_parameter_file_of_the_launch_files_own_may_have_an_empty_list(read: Any) -> None:
    launched = read(
        """
import tempfile
with tempfile.NamedTemporaryFile("w", suffix=".yaml", delete=False) as file:
    file.write("/**: {ros__parameters: {stops: [], rate: 2.0}}")
return LaunchDescription([Node(package='demo', executable='talker', parameters=[file.name])])
"""
    )
    assert parameters(launched) == {"stops": (), "rate": 2.0}


def test_groups_includes_and_conditions(read: Any, write: Any) -> None:
    write(
        HEAD + "    return LaunchDescription([DeclareLaunchArgument('who'), Node(package='demo', "
        "executable='talker', name=['inner_', LaunchConfiguration('who')])])\n",
        "sub/inner.launch.py",
    )
    write("<launch><include file='inner.launch.py'/></launch>", "sub/outer.launch.xml")
    launched = read(
        """
inner = PythonLaunchDescriptionSource([ThisLaunchFileDir(), '/sub/inner.launch.py'])
outer = launch.launch_description_sources.AnyLaunchDescriptionSource(
    PathJoinSubstitution([ThisLaunchFileDir(), 'sub', 'outer.launch.xml']))
a = GroupAction([
    launch_ros.actions.PushRosNamespace(''), launch_ros.actions.PushRosNamespace('n'),
    launch_ros.actions.SetRemap('a', 'b'),
    SetParameter('p', LaunchConfiguration('v', default='1')),
    IncludeLaunchDescription(inner, launch_arguments={'who': 'one'}.items())])
b = IncludeLaunchDescription(outer, launch_arguments=[('who', 'two')],
                             condition=IfCondition('true'))
c = GroupAction([IncludeLaunchDescription(inner)],
                condition=LaunchConfigurationEquals('who', 'three'))
return LaunchDescription([a, b, c])
"""
    )
    one, two = specs_of(launched)
    assert (one.name, one.namespace, one.parameters, one.remappings) == (
        *("inner_one", "/n"),
        *({"p": 1}, {"a": "b"}),
    )
    assert (two.name, two.namespace, two.parameters, two.remappings) == ("inner_two", None, {}, {})
    assert one.origin.startswith(str(Path("sub", "inner.launch.py")))


def test_event_handlers_start_nodes_later(read: Any) -> None:
    launched = read(
        """
a = Node(package='demo', executable='talker', name='a')
b, c, d, e = (Node(package='demo', executable='listener', name=n) for n in 'bcde')
gone = ExecuteProcess(cmd=['gzserver'])
return LaunchDescription([
    RegisterEventHandler(OnProcessStart(target_action=a, on_start=[TimerAction(
        period=0.5, actions=[b])])),
    RegisterEventHandler(OnProcessExit(target_action=b, on_exit=c)),
    RegisterEventHandler(OnProcessExit(target_action=gone, on_exit=[d])),
    RegisterEventHandler(OnProcessExit(target_action=d, on_exit=[e])),
    RegisterEventHandler(OnProcessExit(target_action=a, on_exit=[EmitEvent(
        event=launch.events.Shutdown())])),
    RegisterEventHandler(OnProcessExit(target_action=a, on_exit=lambda event, context: [e])),
    RegisterEventHandler(OnShutdown(on_shutdown=[LogInfo(msg='bye')])),
    a, gone, Node(package='demo', executable='talker', namespace='',
                  on_exit=LaunchConfiguration('z'))])
"""
    )
    a, root, b, c = specs_of(launched)
    assert [one.required for one in (a, root, b, c)] == [True, False, False, False]
    assert (a.name, a.start_after, a.namespace, root.namespace) == ("a", None, None, "/")
    assert (b.name, b.start_after) == ("b", StartAfterSpec(started=0, delay="500ms"))  # type: ignore[arg-type]
    assert (c.name, c.start_after) == ("c", StartAfterSpec(ended=2))
    left_out = [str(item) for item in launched.unsupported]
    assert sum("it starts when something has ended that is left out itself" in t for t in left_out)
    assert sum("it is a function that is called with the event" in text for text in left_out) == 1
    assert len(left_out) == 4
    assert [text.partition(": ")[2].partition(":")[0] for text in launched.ignored] == [
        "OnShutdown",
        "what follows when the Node of a.launch.py",
    ]


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return LaunchDescription([DeclareLaunchArgument('x')])", "'x' is required: give x:=…"),
        (
            "return LaunchDescription([DeclareLaunchArgument('x', default_value='c', "
            "choices=['a', 'b'])])",
            "'x' is 'c', which is none of 'a', 'b'",
        ),
        (
            "return LaunchDescription([Node(package='a', executable=LaunchConfiguration('x'))])",
            "there is no launch argument 'x'",
        ),
        (
            "return LaunchDescription([Node(package='a', node_executable='x', executable='y')])",
            "Node has no argument 'node_executable'; it is 'executable' since Galactic",
        ),
        ("import launch.actions.bogus", "launch.actions.bogus: this module of ROS's launch is not"),
        (
            "launch.actions.ForEach('a', function=print)",
            "launch.actions.ForEach: this part of ROS's launch is not among what rsltrace knows",
        ),
        (
            "from launch_ros.actions import Nod",
            "there is no launch_ros.actions.Nod; did you mean 'Node'?",
        ),
        ("from launch_ros import actoins", "did you mean 'launch_ros.actions'?"),
        ("launch.actions.Node()", "did you mean 'launch_ros.actions.Node'?"),
        (
            "launch.actions.TimerActoin()",
            "there is no launch.actions.TimerActoin; did you mean 'TimerAction'?",
        ),
        ("return 3", "generate_launch_description() returned int, not a LaunchDescription"),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("sys.exit(3)", "the launch file ends Python (3)"),
        ("import not_installed_at_all", "imports the Python module 'not_installed_at_all'"),
        (
            "return LaunchDescription([IncludeLaunchDescription('/no/file.launch.py')])",
            "there is no launch file /no/file.launch.py",
        ),
        ("return LaunchDescription(['x'])", "a launch description holds actions, and here is str"),
    ],
)
def test_mistakes_name_file_and_line(read: Any, body: str, message: str) -> None:
    with pytest.raises(JobError) as info:
        read(body)
    where, _, said = str(info.value).partition(": ")
    assert message in said
    whole_file = message.startswith(("generate_launch", "the launch file ends", "a launch desc"))
    assert where == ("a.launch.py" if whole_file else f"a.launch.py:{BODY}")


@pytest.mark.long
def test_the_process_that_reads_is_another(
    write: Any, prefix: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(JobError, match=r"ended the process that read it \(exit status 7\)"):
        read_in_child_process(
            write_body(write, "print('\\x1b[2J'); sys.stdout.flush(); os._exit(7)"), {}, []
        )
    assert capsys.readouterr().err == "\\x1b[2J\n"
    body = """
os.chdir('/'); os.environ['RSLTRACE_T'] = '1'
import threading, time
threading.Thread(target=time.sleep, args=(1000,)).start()
return LaunchDescription([])
"""
    read_in_child_process(write_body(write, body), {}, [])
    assert "launch" not in sys.modules
    assert (Path.cwd(), os.environ.get("RSLTRACE_T")) == (tmp_path, None)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("raise GeneratorExit", f"a.launch.py:{BODY}: GeneratorExit"),
        (
            "class E(Exception):\n    def __str__(self): 1 / 0\nraise E",
            f"a.launch.py:{BODY + 2}: E: (its text could not be made)",
        ),
        (
            "class Q(int): pass\n"
            "return LaunchDescription([Node(package='a', executable='b', "
            "parameters=[{'q': Q(4)}])])",
            "a.launch.py: something that the launch file gives a node is no plain value: ",
        ),
        (
            "import pickle\npickle.dumps = lambda value: b'junk'\nreturn LaunchDescription([])",
            "a.launch.py: the launch file has changed Python or rsltrace",
        ),
    ],
)
def test_what_a_launch_file_does_to_its_process_is_no_traceback_of_ours(
    write: Any, body: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(JobError) as info:
        read_in_child_process(write_body(write, body), {}, [])
    assert message in str(info.value)
    assert capsys.readouterr().err == ""


@pytest.mark.long
def test_a_launch_file_that_hangs_does_not_outlive_who_reads_it(tmp_path: Path) -> None:
    (tmp_path / "a.launch.py").write_text(
        "import os, pathlib, time\n"
        "pathlib.Path('new').write_text(str(os.getpid()))\n"
        "os.rename('new', 'pid')\n"
        "time.sleep(1000)\n"
    )
    command = [sys.executable, "-m", "rsltrace", "record", "--launch", "a.launch.py"]
    deadline = time.monotonic() + 600
    with subprocess.Popen(command, cwd=tmp_path) as started:
        while not (tmp_path / "pid").exists():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        started.kill()
    pid = int((tmp_path / "pid").read_text())
    while Path(f"/proc/{pid}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_packages_that_are_not_there(read: Any) -> None:
    """Only what wants something of them is left out, or wrong; who asks for them is told."""
    launched = read(
        """
from ament_index_python.packages import get_package_share_directory
share = get_package_share_directory('gazebo_ros')
ok = Node(package='demo', executable='talker', name='ok')
rviz = Node(package='rviz2', executable='rviz2', arguments=['-d', share + '/x.rviz'],
            parameters=[FindPackageShare('nav2_bringup')])
return LaunchDescription([
    IncludeLaunchDescription(PythonLaunchDescriptionSource(os.path.join(share, 'g.launch.py'))),
    ok, rviz])
"""
    )
    why = {"talker": None, "rviz2": "compiled"}
    (ok,) = node_specs(launched, skip_unsupported=True, why_not=lambda _, name: why[name])
    assert ok.name == "ok"
    left_out = {item.what for item in launched.unsupported}
    assert left_out == {"include of g.launch.py", "rviz2/rviz2"}
    assert f"a.launch.py:{BODY + 1}: there is no package 'gazebo_ros'" in launched.ignored[0]
    with pytest.raises(JobError, match=r"a\.launch\.py:\d+: there is no package 'nav2_bringup'"):
        specs_of(launched)


def test_a_file_of_a_package_that_is_not_there(read: Any) -> None:
    text = """
from ament_index_python.packages import get_package_share_directory
open(os.path.join(get_package_share_directory('arm'), 'arm.urdf'))
"""
    with pytest.raises(JobError) as caught:
        read(text)
    assert str(caught.value) == (
        f"a.launch.py:{BODY + 1}: there is no package 'arm': it is neither installed nor among the "
        "sources here"
    )


def test_a_package_that_may_be_missing(read: Any) -> None:
    launched = read(
        """
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
globals()['PackageNotFoundError'] = PackageNotFoundError
try:
    get_package_share_directory('gazebo_ros')
except PackageNotFoundError:
    return LaunchDescription([Node(package='demo', executable='talker')])
"""
    )
    assert len(launched.nodes) == 1


CALIBRATE = """#!/usr/bin/env python3
import rclpy
rclpy.init()
node = rclpy.create_node('calibrate')
node.declare_parameter('seconds', 0.0)
end = node.get_clock().now().nanoseconds + int(1e9 * node.get_parameter('seconds').value)
while node.get_clock().now().nanoseconds < end:
    rclpy.spin_once(node, timeout_sec=0.1)
"""

TICK = """#!/usr/bin/env python3
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node('tick')
publisher = node.create_publisher(String, 'tick', 10)
node.create_timer(0.5, lambda: publisher.publish(String(data=node.get_name())))
rclpy.spin(node)
"""


@pytest.mark.long
@pytest.mark.ros
def test_a_run_of_a_python_launch_file(
    write: Any, prefix: Path, command: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    for name, text in (("calibrate", CALIBRATE), ("tick", TICK)):
        (prefix / "lib" / "demo" / name).write_text(text)
        (prefix / "lib" / "demo" / name).chmod(0o755)
    write(
        HEAD
        + """    print('read')
    calibrate = Node(package='demo', executable='calibrate', parameters=[{'seconds': 2.0}])
    tick = Node(package='demo', executable='tick', name=LaunchConfiguration('name'), namespace='n')
    return LaunchDescription([
        DeclareLaunchArgument('name', default_value='t'), calibrate,
        RegisterEventHandler(OnProcessExit(target_action=calibrate, on_exit=[
            TimerAction(period=1.0, actions=[tick])])),
        Node(package='rviz2', executable='rviz2')])
""",
        "bringup.launch.py",
    )
    launch = ("record", "--launch", "bringup.launch.py", "--until", "5", "name:=late")
    refused = command(*launch)
    assert refused.returncode == 2
    assert (
        f"bringup.launch.py:{BODY + 7}: rviz2/rviz2: there is no package 'rviz2'" in refused.stderr
    )
    done = command(*launch, "--skip-unsupported")
    assert done.returncode == 0, done.stderr
    assert "read\n" in done.stderr
    with Trace.open("bringup.mcap") as trace:
        ticks = [(stamp, trace.decode("/n/tick", data).data) for stamp, _, data in
                 trace.messages("/n/tick")]  # type: ignore[attr-defined]  # fmt: skip
    assert ticks == [(n * 500_000_000, "late") for n in range(7, 11)]

    # A trace runs no launch file: its job says what came of it.
    text = Path("bringup.launch.py").read_text()
    Path("bringup.launch.py").write_text(f"open('ran', 'w')\n{text}")
    again = command("replay", "bringup.mcap", "--trust")
    assert again.returncode == 0, again.stderr
    unasked = command("replay", "bringup.mcap")
    assert unasked.returncode == 2
    assert "its job is bringup.launch.py, which cannot be compared with it" in unasked.stderr
    assert not Path("ran").exists()


@pytest.mark.long
def test_the_command_line_is_that_of_ros2_launch(
    write: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    body = """
def words(context):
    print(context.argv, sys.argv[:2], sys.argv[2][-11:], sys.argv[3:])
return LaunchDescription([DeclareLaunchArgument("laps"), OpaqueFunction(function=words)])
"""
    read_in_child_process(write_body(write, body), {"laps": "2"}, [])
    said = "['laps:=2'] ['ros2', 'launch'] a.launch.py ['laps:=2']\n"
    assert capsys.readouterr().err == said
