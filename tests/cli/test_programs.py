"""Programs on the command line: ``record -- ros2 run …``, ``flaky -- pytest …``."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from rsltrace.cli.job_source import split_programs
from rsltrace.errors import JobError

Command = Callable[..., subprocess.CompletedProcess[str]]

_SETUP = """
from setuptools import setup
scripts = ["talker = duo.nodes:talker", "ear = duo.nodes:ear"]
setup(name="duo", version="0.1.0", packages=["duo"], entry_points={"console_scripts": scripts})
"""
_NODES = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import Int32


def talker():
    rclpy.init()
    node = Node("talker")
    rate = node.declare_parameter("rate", 10.0).value
    publisher = node.create_publisher(Int32, "numbers", 10)
    node.create_timer(1 / rate, lambda: publisher.publish(Int32(data=1)))
    rclpy.spin(node)


def ear():
    rclpy.init()
    node = Node("ear")
    node.create_subscription(Int32, "numbers", lambda message: None, 10)
    rclpy.spin(node)
"""
_RACE = """
import sys
import rclpy
from std_msgs.msg import Int32


def order():
    rclpy.init()
    ear, others = rclpy.create_node("ear"), [rclpy.create_node(name) for name in "ab"]
    got = []
    ear.create_subscription(Int32, "n", lambda message: got.append(message.data), 10)
    for number, node in enumerate(others):
        node.create_publisher(Int32, "n", 10).publish(Int32(data=number))
    while len(got) < 2:
        rclpy.spin_once(ear)
    return got


def test_first_comes_first():
    assert order() == [0, 1]


if __name__ == "__main__":
    sys.exit(order() != [0, 1])
"""


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    package = tmp_path / "src" / "duo"
    (package / "duo").mkdir(parents=True)
    (package / "package.xml").write_text(
        '<package format="3"><name>duo</name><version>0.1.0</version><description/>'
        '<maintainer email="a@b.c">a</maintainer><license>MIT</license></package>'
    )
    (package / "setup.py").write_text(_SETUP)
    (package / "duo" / "__init__.py").touch()
    (package / "duo" / "nodes.py").write_text(_NODES)
    (package / "duo.launch.xml").write_text(
        '<launch><arg name="rate" default="5.0"/><node pkg="duo" exec="talker" name="talker">'
        '<param name="rate" value="$(var rate)"/></node></launch>'
    )
    (tmp_path / "race.py").write_text(_RACE)
    (tmp_path / "rate.yaml").write_text("talker: {ros__parameters: {rate: 4.0}}\n")
    return tmp_path


@pytest.mark.parametrize(
    ("line", "own", "programs"),
    [
        ("job.yaml", "job.yaml", None),
        ("job.yaml --ros-args -p a:=1 -- -q", "job.yaml --ros-args -p a:=1 -- -q", None),
        ("-q -- a --ros-args -p b:=1 -- c", "-q", ["a --ros-args -p b:=1", "c"]),
        ("--ros-args -p a:=1 -- -q -- a", "--ros-args -p a:=1 -- -q", ["a"]),
        ("-- a --", "", ["a", ""]),
    ],
)
def test_where_programs_begin(line: str, own: str, programs: list[str] | None) -> None:
    expected = None if programs is None else [words.split() for words in programs]
    assert split_programs(line.split()) == (own.split(), expected)


def test_the_job_that_programs_make(workspace: Path, command: Command) -> None:
    words = (
        *("record", "--print-job", "--until", "1", "--"),
        *("ros2", "run", "duo", "talker", "word", "--ros-args", "-p", "rate:=20.0", "-r"),
        *("numbers:=/n", "-r", "__ns:=/robot", "-p", "talker:x:=1", "--params-file", "rate.yaml"),
        *("--", "python3", "race.py", "--", "python3", "-m", "timeit"),
        *("--", "pytest", "race.py::test_first_comes_first", "-q"),
        *("--", "ros2", "launch", "duo", "duo.launch.xml", "rate:=2.5"),
    )
    done = command(*words)
    assert YAML(typ="safe").load(done.stdout) == {
        "nodes": [
            {
                "executable": "duo/talker",
                "namespace": "/robot",
                "parameter_files": ["rate.yaml"],
                "parameters": {"rate": 20.0},
                "remappings": {"numbers": "/n"},
                "arguments": ["word", "--ros-args", "-p", "talker:x:=1"],
            },
            {"script": "race.py"},
            {"module": "timeit"},
            {
                "main": "rsltrace.testing.plugin:run_pytest",
                "arguments": ["race.py::test_first_comes_first", "-q"],
                "required": True,
            },
            {
                "executable": "duo/talker",
                "name": "talker",
                "parameters": {"rate": 2.5},
                "arguments": [],
            },
        ],
        "search_path": [".", "src"],
        "stop": {"duration": "1s"},
    }


@pytest.mark.long
@pytest.mark.ros
def test_the_same_bag_the_same_result(workspace: Path, command: Command) -> None:
    made = command(
        "record", "--until", "1", "--export-bag", "bag", "--", "ros2", "run", "duo", "talker"
    )
    assert "the job (--print-job" in made.stderr
    assert "  - executable: duo/talker\n" in made.stderr
    assert (workspace / "talker.mcap").is_file()
    done = command("record", "--bag", "bag", "-q", "--", "ros2", "run", "duo", "ear")
    assert "end of the bag" in done.stderr
    assert "nobody subscribes" not in done.stderr
    again = command("replay", "ear.mcap", "--trust", "-q")
    assert done.stdout.split()[1] == again.stdout.split()[-5]
    job = command("record", "--bag", "bag", "--print-job", "--", "ros2", "run", "duo", "ear").stdout
    (workspace / "job.yaml").write_text(job)
    assert command("record", "job.yaml", "-q", "-o", "of_job.mcap").stdout == done.stdout
    away = ("ros2", "run", "duo", "ear", "--ros-args", "-r", "numbers:=/n")
    unheard = command("record", "--bag", "bag", "-q", "-o", "x.mcap", "--", *away).stderr
    assert "nobody subscribes to /numbers, which a bag plays" in unheard


def test_entries_of_set_are_a_job(workspace: Path, command: Command) -> None:
    """Child processes are given programs in this way."""
    done = command("record", "--print-job", "--set", "nodes.+={script: race.py}")
    assert done.stdout == command("record", "--print-job", "--", "python3", "race.py").stdout


@pytest.mark.ros
@pytest.mark.long
def test_verify_of_programs(workspace: Path, command: Command) -> None:
    done = command("verify", "--runs", "2", "--until", "1", "--", "ros2", "run", "duo", "talker")
    assert "2 runs, 9 perturbations, one digest" in done.stdout


@pytest.mark.ros
def test_what_ends_a_run_is_said(workspace: Path, command: Command) -> None:
    said = "it lasts as long as its programs: --until 10 ends it after 10 s"
    assert said in command("record", "-o", "a.mcap", "--", "python3", "race.py").stderr
    line = ("record", "-o", "b.mcap", "--until", "1", "--", "python3", "race.py")
    assert said not in command(*line).stderr


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--", "there is no program after '--': write 'ros2 run PACKAGE EXECUTABLE'"),
        ("-- ros2 run duo ear --", "there is no program after '--'"),
        ("job.yaml -- ros2 run duo ear", "give job.yaml or programs after '--', not both"),
        ("-- job.yaml", "job.yaml is a job, not a program: leave out the '--' before it"),
        ("-- nosuch", "there is no program 'nosuch': it is no file, no console script"),
        ("-- python3 nosuch.py", "there is no file nosuch.py"),
        ("-- python3 -c pass", "write 'python3 FILE' or 'python3 -m MODULE'"),
        ("-- pytest nosuch.py::test_a", "there is no file nosuch.py"),
        ("-- ros2 topic list", "ros2 topic list: write 'ros2 run PACKAGE EXECUTABLE'"),
        ("-- ros2 run --prefix gdb duo ear", "write 'ros2 run PACKAGE EXECUTABLE'"),
        ("-- ros2 launch duo x.launch.py", "did you mean 'duo.launch.xml'?"),
        ("-- ros2 launch -d duo.launch.xml", "leave out the options of ros2 launch"),
        ("-- ros2 run duo ear --ros-args -p", "the ROS argument -p has no value"),
        ("-- launch_test race.py", "a launch_testing file cannot run in simulated time"),
        ("-- pytest launched.py", "a launch_testing file cannot run in simulated time"),
        ("--bag nosuch -- ros2 run duo ear", "there is no bag nosuch (record --export-bag"),
        ("-- ros2 run duo eat", "-- ros2 run duo eat: package 'duo' has no executable 'eat'"),
        ("-- ros2 run due ear", "there is no package 'due'; did you mean 'duo'?"),
    ],
)
def test_what_is_no_program(workspace: Path, command: Command, line: str, message: str) -> None:
    (workspace / "launched.py").write_text("def generate_test_description(): ...\n")
    assert message in refused(command, "record", *line.split())


def refused(command: Command, *words: str) -> str:
    """Return the error of a command line."""
    try:
        done = command(*words)
    except JobError as error:  # main() prints it
        return str(error)
    assert done.returncode == 2
    return done.stderr


@pytest.mark.ros
@pytest.mark.long
@pytest.mark.parametrize("line", ["pytest -q race.py", "python3 race.py"])
def test_flaky_finds_a_run_that_fails_and_one_that_passes(
    workspace: Path, command: Command, line: str
) -> None:
    search = ("--budget", "30", "--jobs", "1", "-q", "--stop-at-first")
    done = command("flaky", *search, "--", *line.split())
    assert done.returncode == 1, done.stderr
    assert done.stdout.startswith("it failed in 1 of ")
    words = {words[0]: words[1:] for words in map(str.split, done.stdout.splitlines()) if words}
    assert command(*words["passes:"][1:], "-q", "-o", "passes.mcap").returncode == 0
    assert command(*words["fails:"][1:], "-q", "-o", "fails.mcap").returncode in (1, 3)
    assert command(*words["compare:"][1:]).returncode == 1
    if "pytest" in line:
        assert "AssertionError at race.py:" in done.stdout


@pytest.mark.ros
@pytest.mark.long
def test_flaky_calls_a_test_that_passes_at_times_flaky(workspace: Path, command: Command) -> None:
    """Also if the first run fails, whose delays are random, too."""
    text = _RACE.replace("order() == [0, 1]", "order() == [1, 0]")
    (workspace / "test_late.py").write_text(text)
    done = command(
        "flaky", "--budget", "8", "--jobs", "1", "-q", "--", "pytest", "-q", "test_late.py"
    )
    assert done.returncode == 1
    assert "it failed in 6 of 8 runs" in done.stdout
    assert "not flaky" not in done.stdout
    words = ("flaky", "--force", "--stop-at-first", "--jobs", "1", "-q", "--")
    done = command(*words, "pytest", "-q", "test_late.py")
    assert "it failed in 1 of 1 run" in done.stdout
    assert "not flaky" not in done.stdout


@pytest.mark.ros
@pytest.mark.long
def test_flaky_says_that_a_test_never_failed(workspace: Path, command: Command) -> None:
    text = _RACE.replace("order() == [0, 1]", "sorted(order()) == [0, 1]")
    (workspace / "test_fine.py").write_text(text)
    done = command(
        "flaky", "--budget", "4", "--jobs", "1", "-q", "--", "pytest", "-q", "test_fine.py"
    )
    assert done.returncode == 0
    assert done.stdout.startswith("it never failed in 4 runs, ")
    assert "name the test after '--'" in command("flaky").stderr
    text = _RACE.replace("order() == [0, 1]", "not order()")
    (workspace / "test_wrong.py").write_text(text)
    done = command(
        "flaky", "--budget", "2", "--jobs", "1", "-q", "--", "pytest", "-q", "test_wrong.py"
    )
    assert done.returncode == 1
    assert done.stdout.splitlines()[1] == "it never passed, so it is not flaky"
    assert "simulated time stops exactly" in done.stdout
