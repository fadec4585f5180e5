"""Launch files and ROS arguments on the command line and in jobs, run to the end."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from rsltrace import Job, Trace
from rsltrace.adapters.launch.specs import launch_file
from rsltrace.errors import JobError
from rsltrace.job import LaunchSpec, load_job
from rsltrace.run import run

pytestmark = pytest.mark.ros
Command = Callable[..., subprocess.CompletedProcess[str]]

NODES = """
from rclpy.node import Node
from std_msgs.msg import String

class Talker(Node):
    def __init__(self):
        super().__init__('talker')
        self.declare_parameter('rate', 1.0)
        self.declare_parameter('word', 'hello')
        self.publisher = self.create_publisher(String, 'chatter', 10)
        self.create_timer(1.0 / self.get_parameter('rate').value, self.tick)

    def tick(self):
        self.publisher.publish(String(data=self.get_parameter('word').value))
"""

LAUNCH = """<launch>
  <arg name="word" default="hi" description="what to say"/>
  <group><push_ros_namespace namespace="robot"/>
    <node_container pkg="rclpy_components" exec="container" name="c" namespace="">
      <composable_node pkg="demo" plugin="demo_nodes.Talker" name="talk">
        <param name="rate" value="4.0"/><param name="word" value="$(var word)"/>
        <remap from="chatter" to="/chat"/>
      </composable_node>
    </node_container>
  </group>
  <node pkg="rviz2" exec="rviz2"/>
</launch>
"""

JOB = "nodes: [{node: demo_nodes:Talker, parameters: {rate: 2.0}}]\nstop: {duration: 2s}\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "demo_nodes.py").write_text(NODES)
    (tmp_path / "demo.launch.xml").write_text(LAUNCH)
    (tmp_path / "job.yaml").write_text(JOB)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def rsltrace(folder: Path, command: Command) -> Command:
    return command


def topics(path: Path) -> dict[str, int]:
    """Return how many messages were published on each topic of the nodes' own."""
    with Trace.open(path) as trace:
        names = [entity.name for entity in trace.entities.values()]
        assert trace.complete
        events = [trace.event(i) for i in range(trace.event_count)]
        timers = sum(event.kind.label == "timer" for event in events)
    return {name: timers for name in names if name in ("/chat", "/chatter", "/other")}


@pytest.mark.long
def test_record_a_launch_file(rsltrace: Command) -> None:
    refused = rsltrace("record", "--launch", "demo.launch.xml", "--until", "2")
    assert refused.returncode == 2
    assert "demo.launch.xml:11:3: rviz2/rviz2: there is no package 'rviz2'" in refused.stderr
    assert not Path("demo.mcap").exists()

    launch = ("record", "--launch", "demo.launch.xml", "--skip-unsupported", "--until", "2")
    done = rsltrace(*launch, "word:=there")
    assert (done.returncode, topics(Path("demo.mcap"))) == (0, {"/chat": 8}), done.stderr
    assert "note: left out: demo.launch.xml:11:3: rviz2/rviz2" in done.stderr

    other = rsltrace(*launch, "word:=here", "-o", "other.mcap")
    assert other.stdout.split()[1] != done.stdout.split()[1]

    unknown = rsltrace(*launch, "wrd:=here", "-o", "unknown.mcap")
    assert unknown.returncode == 2
    assert unknown.stderr.splitlines() == [
        "rsltrace: error: demo.launch.xml: unknown launch argument 'wrd'; did you mean 'word'?",
        "there are:",
        "  word (default 'hi', what to say)",
    ]

    Path("robot/launch").mkdir(parents=True)
    deeper = shutil.copy("demo.launch.xml", "robot/launch")
    unknown = rsltrace("check", "--launch", deeper, "wrd:=here")
    assert unknown.stderr.startswith(f"rsltrace: error: {deeper}: unknown launch argument 'wrd'")


@pytest.mark.long
def test_print_job_gives_a_job_that_does_the_same(rsltrace: Command, folder: Path) -> None:
    launch = ("--launch", "demo.launch.xml", "--skip-unsupported", "--until", "2")
    first = rsltrace("record", *launch)
    (folder / "printed.yaml").write_text(rsltrace("record", *launch, "--print-job").stdout)
    second = rsltrace("record", "printed.yaml")
    assert first.stdout == second.stdout


def test_a_launch_file_in_a_job(rsltrace: Command, folder: Path) -> None:
    wrong = JOB + "launch:\n  - {file: demo.launch.xml, arguments: {wrd: five}}\n"
    (folder / "wrong.yaml").write_text(wrong)
    line = wrong.count("\n")
    told = rsltrace("check", "wrong.yaml").stderr
    assert f"wrong.yaml:{line}:46: unknown launch argument 'wrd' of demo.launch.xml; did" in told
    assert f"{line:>5} |   - {{file: demo.launch.xml" in told

    (folder / "both.yaml").write_text(
        JOB
        + "launch:\n  - {file: demo.launch.xml, arguments: {word: five}, skip_unsupported: true}\n"
    )
    done = rsltrace("record", "both.yaml")
    assert topics(Path("both.mcap")) == {"/chat": 12, "/chatter": 12}, done.stderr
    with Trace.open("both.mcap") as trace:
        assert '"launch": []' in trace.job["resolved"]
        assert '"name": "talk"' in trace.job["resolved"]

    also = rsltrace("record", "job.yaml", "--launch", "demo.launch.xml", "--skip-unsupported",
                    "word:=five", "-o", "also.mcap")  # fmt: skip
    assert also.stdout == done.stdout


def test_words_that_do_not_fit_together(rsltrace: Command) -> None:
    for arguments, message in [
        ((), "Missing argument 'JOB' (or --launch FILE, or -- PROGRAM)"),
        (("--set", "seed=1"), "Missing argument 'JOB' (or --launch FILE, or -- PROGRAM)"),
        (("a.yaml", "b.yaml"), "give one JOB, not a.yaml and b.yaml"),
        (("job.yaml", "a:=1"), "a:=… is a launch argument: give the launch file with --launch"),
        (("job.yaml", "--skip-unsupported"), "--skip-unsupported: give the launch file"),
    ]:
        done = rsltrace("record", *arguments)
        assert done.returncode == 2
        assert message in done.stderr


def test_a_launch_file_of_a_package(rsltrace: Command, folder: Path) -> None:
    robot = folder / "src" / "robot"
    (robot / "launch").mkdir(parents=True)
    (robot / "package.xml").write_text("<package><name>robot</name></package>")
    shutil.copy("demo.launch.xml", robot / "launch" / "demo.launch.xml")
    for place in ("real/up.launch.xml", "sim/up.launch.xml"):
        (robot / place).parent.mkdir()
        (robot / place).write_text("<launch/>")
    done = rsltrace("record", "--launch", "robot", "demo.launch.xml", "--print-job", "word:=five",
                    "--skip-unsupported")  # fmt: skip
    assert "word: five" in done.stdout, done.stderr
    plain = Path("demo.launch.xml")
    assert launch_file(plain, ["a:=1"]) == (plain, ["a:=1"])
    found, words = launch_file(Path("robot"), ["job.yaml", "sim/up.launch.xml", "a:=1"])
    assert (str(found), words) == ("src/robot/sim/up.launch.xml", ["job.yaml", "a:=1"])
    for named, given, message in [
        ("no.xml", [], "--launch: there is no such launch file: no.xml"),
        ("dmo.launch.xml", [], "dmo.launch.xml; did you mean 'demo.launch.xml'?"),
        ("src", [], "src is a folder; name a launch file in it: robot/launch/demo.launch.xml"),
        ("robot", [], "no such launch file: robot (of a package: --launch robot FILE)"),
        ("rbt", ["up.launch.xml"], "there is no package 'rbt'; did you mean 'robot'?"),
        ("robot", ["dem.launch.xml"], "no launch file 'dem.launch.xml': did you mean 'demo.launch"),
        ("robot", ["x.yaml"], "no launch file 'x.yaml': there are demo.launch.xml, up.launch.xml"),
        ("robot", ["up.launch.xml"], "is several files of robot: real/up.launch.xml, sim/up.laun"),
    ]:
        with pytest.raises(JobError) as caught:
            launch_file(Path(named), given)
        assert message in str(caught.value)


def test_a_launch_file_that_starts_nothing_is_named_from_here(
    rsltrace: Command, folder: Path
) -> None:
    """Not from the launch file's own folder, where paths in it begin."""
    (folder / "here" / "launch").mkdir(parents=True)
    (folder / "here" / "launch" / "empty.launch.xml").write_text("<launch/>")
    done = rsltrace("check", "--launch", "here/launch/empty.launch.xml")
    assert done.returncode == 2
    assert "error: here/launch/empty.launch.xml: the launch file starts nothing" in done.stderr


def test_launch_specs_in_python(folder: Path) -> None:
    job = Job(launch=[LaunchSpec(file="demo.launch.xml", arguments={"word": 1.5, "b": True})])
    assert job.launch[0].arguments == {"word": "1.5", "b": "true"}
    assert load_job(_write(folder / "again.yaml", job.to_yaml())).launch == job.launch
    with pytest.raises(JobError, match="there is no such launch file"):
        Job(launch=["nothing.xml"])


def _write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


# -- --ros-args ------------------------------------------------------------------------------------


@pytest.mark.long
def test_ros_arguments_have_the_last_word(rsltrace: Command, folder: Path) -> None:
    (folder / "sub").mkdir()
    (folder / "sub" / "p.yaml").write_text("talker: {ros__parameters: {word: filed, rate: 8.0}}\n")
    cases: list[tuple[list[str], dict[str, int]]] = [
        ([], {"/chatter": 4}),
        (["--ros-args", "-p", "rate:=5.0"], {"/chatter": 10}),
        (["--ros-args", "-p", "talker:rate:=5.0", "-p", "no:rate:=9.0"], {"/chatter": 10}),
        (["--ros-args", "-r", "chatter:=/other", "--", "--quiet"], {"/other": 4}),
        (["--ros-args", "-r", "talker:chatter:=/other"], {"/other": 4}),
        (["--ros-args", "--params-file", "sub/p.yaml"], {"/chatter": 16}),
        (["--ros-args", "--params-file", "sub/p.yaml", "-p", "rate:=1.0"], {"/chatter": 2}),
    ]
    for arguments, expected in cases:
        done = rsltrace("record", "job.yaml", "--force", *arguments)
        assert (done.returncode, topics(Path(f"{folder.name}.mcap"))) == (0, expected), (
            arguments,
            done.stderr,
        )


def test_ros_arguments_win_over_names_given_in_the_job(rsltrace: Command, folder: Path) -> None:
    (folder / "named.yaml").write_text(
        "nodes: [{node: demo_nodes:Talker, name: mine, remappings: {chatter: /chat}}]\n"
        "stop: {duration: 1s}\n"
        "ros_arguments: [-r, chatter:=/other, -r, __ns:=/space]\n"
    )
    assert rsltrace("record", "named.yaml").returncode == 0
    with Trace.open("named.mcap") as trace:
        names = {entity.name for entity in trace.entities.values()}
    assert {"/other", "/space/mine"} <= names


def test_wrong_ros_arguments(rsltrace: Command) -> None:
    for words, message in [
        (["-p", "rate"], "error: --ros-args: Couldn't parse"),
        (["-p", "rate=1"], "ROS arguments are written -p [NODE:]NAME:=VALUE"),
        (["--params-file", "none.yaml"], "none.yaml"),
        (["--bogus"], "unknown ROS arguments"),
        (["--", "--set", "ros_arguments=[-p, rate]"], "      | ros_arguments=[-p, rate]\n"),
    ]:
        done = rsltrace("record", "job.yaml", "--ros-args", *words)
        assert done.returncode == 2
        assert message in done.stderr
        assert "Traceback" not in done.stderr


# -- installed executables -------------------------------------------------------------------------

TALKER = """#!/usr/bin/env python3
import sys

import rclpy
from rclpy.node import Node
from std_msgs.msg import String


def main():
    rclpy.init(args=sys.argv)
    node = Node('talker')
    node.declare_parameter('rate', 1.0)
    node.declare_parameter('word', 'none')
    publisher = node.create_publisher(String, 'chatter', 10)
    text = node.get_parameter('word').value + ' ' + ' '.join(sys.argv[1:2])
    timer = node.create_timer(1.0 / node.get_parameter('rate').value,
                              lambda: publisher.publish(String(data=text)))
    try:
        rclpy.spin(node)
    finally:
        node.get_logger().info('goodbye')
        node.destroy_node()


if __name__ == '__main__':
    main()
"""

EXECUTABLES = """<launch>
  <arg name="robots" default="true"/>
  <group if="$(var robots)">
    <push_ros_namespace namespace="one"/>
    <node pkg="demo" exec="talker" name="talk" args="--loud">
      <param from="$(find-pkg-share demo)/config/demo.yaml"/>
      <param name="rate" value="4.0"/>
      <remap from="chatter" to="/chat"/>
    </node>
  </group>
  <node pkg="demo" exec="talker" namespace="two"><param name="word" value="second"/></node>
</launch>
"""


@pytest.mark.long
def test_installed_executables_run_with_what_the_launch_file_gives_them(
    rsltrace: Command, prefix: Path, folder: Path
) -> None:
    (prefix / "lib" / "demo" / "talker").write_text(TALKER)
    (folder / "robots.launch.xml").write_text(EXECUTABLES)
    done = rsltrace("record", "--launch", "robots.launch.xml", "--until", "2")
    assert done.returncode == 0, done.stderr
    assert "[one.talk]: goodbye" in done.stderr
    assert "[two.talker]: goodbye" in done.stderr
    with Trace.open("robots.mcap") as trace:
        said = {
            topic: [(stamp, trace.decode(topic, data).data) for stamp, _, data in
                    trace.messages(topic)]  # type: ignore[attr-defined]
            for topic in ("/chat", "/two/chatter")
        }  # fmt: skip
    quarter = 250_000_000
    assert said["/chat"] == [(n * quarter, "from file --loud") for n in range(1, 9)]
    assert said["/two/chatter"] == [(n * 4 * quarter, "second ") for n in (1, 2)]

    one = rsltrace("record", "--launch", "robots.launch.xml", "robots:=false", "--until", "2",
                   "-o", "one.mcap", "--ros-args", "-p", "rate:=2.0")  # fmt: skip
    assert one.returncode == 0, one.stderr
    with Trace.open("one.mcap") as trace:
        assert len(list(trace.messages("/two/chatter"))) == 4


def test_parameters_that_a_launch_file_gives_all_nodes_are_meant_for_who_has_them(
    folder: Path,
) -> None:
    (folder / "demo_nodes.py").write_text(
        NODES
        + """
class Mute(Node):
    def __init__(self):
        super().__init__('mute')
"""
    )
    (folder / "all.launch.xml").write_text(
        """<launch>
  <set_parameter name="rate" value="4.0"/>
  <set_parameter name="nobody" value="1"/>
  <node_container pkg="rclpy_components" exec="container" name="c" namespace="">
    <composable_node pkg="demo" plugin="demo_nodes.Talker" name="talk"/>
    <composable_node pkg="demo" plugin="demo_nodes.Mute" name="mute"/>
  </node_container>
</launch>
"""
    )
    (folder / "job.yaml").write_text("launch: [all.launch.xml]\nstop: {duration: 1s}\n")
    notes = run(load_job("job.yaml"), None).notes
    assert [note.partition(": ")[2][:5] for note in notes] == ["/talk", "/mute"]
    assert all("has not declared the parameter 'nobody'" in note for note in notes)
