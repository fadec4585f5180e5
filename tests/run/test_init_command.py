"""``rsltrace init``: what it writes is a job that runs, and it runs nothing itself."""

from __future__ import annotations

import json
import sqlite3
import struct
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import JobError
from rsltrace.job import load_job
from rsltrace.job.documents.schema import job_schema
from rsltrace.job.reading.node_source import inspect_target

NODE = """
from rclpy.node import Node
from std_msgs.msg import UInt64
IMPORTED = open('imported', 'w').close()
DEFAULT = 3

class Hearer(Node):
    def __init__(self):
        super().__init__('hearer')
        self.declare_parameter('rate', 10.0)
        self.declare_parameter('name', value='x: y')
        self.declare_parameter('computed', DEFAULT)
        self.declare_parameters('deep', [('a', 1), ('b', [1.0, 2.0])])
        self.declare_parameters('', [('c',)])
        self.create_subscription(UInt64, '/n', lambda message: None, 10)
        heard = self.create_publisher(UInt64, 'heard', 10)
        self.create_publisher(UInt64, topic='~/own', qos_profile=10)
        self.create_timer(0.2, lambda: heard.publish(UInt64()))
"""
MAINS = """
import rclpy
from rclpy.node import Node

class One(Node):
    pass

class Two(rclpy.node.Node):
    def __init__(self, name):
        super().__init__(name)

def main(args=None):
    rclpy.init(args=args)
    rclpy.spin(Two('two'))

def make():
    return One('one')
"""


def write_bag(path: Path) -> None:
    db = sqlite3.connect(path)
    db.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
        " serialization_format TEXT, offered_qos_profiles TEXT);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
        " data BLOB);"
        "INSERT INTO topics VALUES (1, '/n', 'std_msgs/msg/UInt64', 'cdr', '');"
        "INSERT INTO topics VALUES (3, '/rosout', 'rcl_interfaces/msg/Log', 'cdr', '');"
        "INSERT INTO topics VALUES (2, '/go/_action/status', 'x/msg/Y', 'cdr', '');"
    )
    for i in range(3):
        data = b"\0\1\0\0" + struct.pack("<Q", i)
        db.execute("INSERT INTO messages VALUES (?, 1, ?, ?)", (i + 1, (5 + i) * 10**9, data))
    db.commit()
    db.close()


@pytest.fixture(autouse=True)
def folder(tmp_path: Path) -> Path:
    (tmp_path / "src" / "robot").mkdir(parents=True)
    (tmp_path / "src" / "robot" / "__init__.py").touch()
    (tmp_path / "src" / "robot" / "nodes.py").write_text(NODE)
    (tmp_path / "src" / "robot" / "mains.py").write_text(MAINS)
    write_bag(tmp_path / "a.db3")
    return tmp_path


def test_a_job_from_a_node_and_a_bag_runs(rsltrace: Any, folder: Path) -> None:
    done = rsltrace("init", "--from", "a.db3", "--from", "robot.nodes:Hearer")
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == (
        "search_path: [., src], relative to job.yaml: the nodes are there\n"
        "wrote job.yaml and job.schema.json; next: rsltrace check job.yaml\n"
    )
    assert json.loads((folder / "job.schema.json").read_text()) == job_schema()
    assert not (folder / "imported").exists()
    text = (folder / "job.yaml").read_text()
    assert text.startswith("# yaml-language-server: $schema=")
    for line in (
        "    #   rate: 10.0",
        "    #   name: 'x: y'",
        "    #   deep.a: 1",
        "    #   deep.b: [1.0, 2.0]",
        "    # more parameters: c, computed",
        "search_path: [., src]  # where modules are, before Python's own path",
        "    name: hearer",
        "      - /n       # std_msgs/msg/UInt64, 3 messages",
        "      # - /rosout  # rcl_interfaces/msg/Log, 0 messages",
        "    # from 5.000000000 s on, 2 s long",
        "    # not played: /go/_action/status",
    ):
        assert line in text.splitlines()
    done = rsltrace("record", "job.yaml", "-o", "run.mcap")
    assert done.returncode == 0, done.stderr
    # What it offers as comments is right, too.
    offered = text.replace("    # parameters:  #", "    parameters:  #").replace(
        "    #   ", "      "
    )
    offered = offered.replace("# checks:  #", "checks:  #").replace("\n#   - ", "\n  - ")
    (folder / "more.yaml").write_text(offered)
    job = load_job(folder / "more.yaml")
    assert job.nodes[0].parameters["name"] == "x: y"
    assert job.nodes[0].parameters["deep.b"] == (1.0, 2.0)
    checked = rsltrace("check", "run.mcap", "--job", "more.yaml")
    for title in ("never log error", "eventually /heard", "rate /heard"):
        assert f"check passed: {title}" in checked.stdout
    assert "check violated: eventually /hearer/own" in checked.stdout


def test_odd_texts_of_a_bag_stay_on_their_line(rsltrace: Any, folder: Path) -> None:
    db = sqlite3.connect(folder / "a.db3")
    db.execute("UPDATE topics SET type = ? WHERE id = 1", ("a\nrsltrace: error: not true",))
    db.execute("UPDATE topics SET name = '/odd: # x' WHERE id = 3")
    db.commit()
    db.close()
    done = rsltrace("init", "--from", "a.db3")
    assert done.returncode == 0, done.stderr
    assert load_job(folder / "job.yaml").bags[0].topics == ("/n", "/odd: # x")
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "--set", "bags.0.topics=[/n]")
    assert done.returncode == 2
    assert "type a\\nrsltrace: error: not true, which" in done.stderr


@pytest.mark.long
@pytest.mark.parametrize("sources", [[], ["--from", "a.db3"], ["--from", "robot.nodes:Hearer"]])
def test_each_kind_of_first_job_loads(rsltrace: Any, folder: Path, sources: list[str]) -> None:
    done = rsltrace("init", "sub.yaml", *sources)
    assert done.returncode == 0, done.stderr
    load_job(folder / "sub.yaml")


@pytest.mark.long
def test_a_node_is_named_by_its_file_in_a_job_as_for_init(rsltrace: Any, folder: Path) -> None:
    (folder / "nodes.py").write_text(NODE)
    rsltrace("init", "--from", "nodes.py:Hearer")
    (folder / "by_file.yaml").write_text(
        (folder / "job.yaml").read_text().replace("node: nodes:Hearer", "node: nodes.py:Hearer")
    )
    runs = [rsltrace("record", name, "-o", f"{name}.mcap") for name in ("job.yaml", "by_file.yaml")]
    assert runs[0].returncode == 0, runs[0].stderr
    assert runs[0].stdout == runs[1].stdout
    assert load_job(folder / "by_file.yaml").nodes[0].target == "nodes:Hearer"


def test_a_file_that_exists_is_left_alone(rsltrace: Any, folder: Path) -> None:
    (folder / "job.yaml").write_text("mine")
    done = rsltrace("init")
    assert done.returncode == 2
    assert "job.yaml exists; name another file, or remove it" in done.stderr
    assert (folder / "job.yaml").read_text() == "mine"


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("nowhere", "nowhere: there is no such bag (a node is named as module:Class or"),
        ("robot.nodes:Herer", "nodes.py has no 'Herer'; did you mean 'Hearer'?"),
        ("robot.no_nodes:Hearer", "there is no module 'robot.no_nodes' in"),
        ("src/robot/no.py:Hearer", "src/robot/no.py:Hearer: there is no file src/robot/no.py"),
        ("src/robot/mains.py", "say which class: src/robot/mains.py:Class (one of One, Two)"),
        ("src/robot/mains.py:Thre", "mains.py has no 'Thre'"),
        ("robot.nodes:2", "expected module:Class or module:function, got 'robot.nodes:2'"),
    ],
)
def test_what_is_not_there(rsltrace: Any, folder: Path, source: str, expected: str) -> None:
    done = rsltrace("init", "--from", source)
    assert done.returncode == 2
    assert expected in done.stderr
    assert not (folder / "job.yaml").exists()


@pytest.mark.long
def test_a_second_node_without_its_option_is_no_job_file(rsltrace: Any, folder: Path) -> None:
    done = rsltrace("init", "--from", "hearer:Hearer", "mains:One")
    assert done.returncode == 2
    assert "rsltrace init --from hearer:Hearer --from mains:One" in " ".join(done.stderr.split())
    assert not list(folder.glob("*:*"))


@pytest.mark.long
def test_a_module_on_pythons_own_path(folder: Path) -> None:
    found = inspect_target("rclpy.node:Node", [folder])
    assert found.folder is None
    (folder / "src" / "robot" / "nodes.py").write_text("class (")
    with pytest.raises(JobError, match=r"nodes\.py:1: not Python"):
        inspect_target("robot.nodes:Hearer", [folder / "src"])


@pytest.mark.long
@pytest.mark.parametrize("at", [".", "src", "src/robot"])
@pytest.mark.parametrize("chosen", ["", ":Hearer"])
def test_a_node_named_by_its_file(rsltrace: Any, folder: Path, at: str, chosen: str) -> None:
    """As the shell completes it, from wherever one is."""
    place = folder / at
    file = f"{(folder / 'src/robot/nodes.py').relative_to(folder)}"
    source = file if at == "." else file.removeprefix(f"{at}/")
    done = rsltrace("init", "--from", f"{source}{chosen}", cwd=place)
    assert done.returncode == 0, done.stderr
    job = load_job(place / "job.yaml")
    assert (job.nodes[0].node, job.nodes[0].name) == ("robot.nodes:Hearer", "hearer")
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", cwd=place)
    assert done.returncode == 0, done.stderr


def test_functions_are_mains_unless_they_return_a_node(folder: Path) -> None:
    found = {
        name: inspect_target(f"robot.mains:{name}", [folder / "src"]) for name in ("main", "make")
    }
    assert [found[name].is_main for name in ("main", "make")] == [True, False]
    assert not inspect_target("robot.mains:Two", [folder / "src"]).name, "it is told its name"


@pytest.mark.long
def test_a_job_of_a_main_runs(rsltrace: Any, folder: Path) -> None:
    done = rsltrace("init", "--from", "robot.mains:main")
    assert done.returncode == 0, done.stderr
    assert "  - main: robot.mains:main  # it runs as it is" in (folder / "job.yaml").read_text()
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "--until", "1")
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_without_a_node_a_search_path_is_guessed_and_said(rsltrace: Any, folder: Path) -> None:
    done = rsltrace("init", "guessed.yaml")
    assert done.returncode == 0
    assert "search_path: [., src], relative to guessed.yaml: there is Python code" in done.stderr
    assert "\nsearch_path: [., src]  #" in (folder / "guessed.yaml").read_text()
