"""Jobs whose nodes are installed executables, found and run as ``ros2 run`` finds and runs them."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.reader import Trace
from tests.tiers import cases

PACKAGE = """
import argparse
import sys
import rclpy
from rclpy.node import Node
from std_msgs.msg import String

made = 0

class Talker(Node):
    def __init__(self):
        super().__init__('talker')
        self.declare_parameter('word', 'hello')
        self.publisher = self.create_publisher(String, 'chatter', 10)
        self.create_timer(0.5, self.tick)

    def tick(self):
        self.publisher.publish(String(data=self.get_parameter('word').value))

def talker():
    global made
    made += 1
    rclpy.init()
    node = Talker()
    node.get_logger().info(f'made {made} as {sys.argv[0]} {sys.argv[1:]}')
    try:
        rclpy.spin(node)
    finally:
        node.get_logger().info('bye')

def listener():
    rclpy.init()
    node = Node('listener')
    node.create_subscription(String, 'chatter', lambda m: node.get_logger().info(m.data), 10)
    rclpy.spin(node)

def defaults(args=sys.argv, options=sys.argv[1:]):
    rclpy.init(args=args)
    node = Node('defaults')
    parser = argparse.ArgumentParser()
    parser.add_argument('-n', type=int, default=1)
    chosen = parser.parse_args(options).n
    node.get_logger().info(f'{args[0]} {chosen}, {parser.format_usage()}')
    rclpy.spin(node)

def quitter():
    rclpy.init()
    raise SystemExit('no hardware')

not_callable = 3
"""

SCRIPT = """#!/usr/bin/env python3
import rclpy
from rclpy.node import Node

def main():
    rclpy.init()
    node = Node('scripted')
    node.create_timer(1.0, lambda: node.get_logger().info('tick'))
    rclpy.spin_once(node)

if __name__ == '__main__':
    main()
"""


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A ROS package with entry points, one with scripts, as an installed workspace has them."""
    site = tmp_path / "site"
    site.mkdir()
    (site / "my_demo_nodes.py").write_text(PACKAGE)
    info = site / "my_demo-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_demo\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[console_scripts]\n"
        + "".join(
            f"{n} = my_demo_nodes:{n}\n" for n in ("talker", "listener", "defaults", "quitter")
        )
        + "broken = my_demo_nodes:not_callable\n"
    )
    prefix = tmp_path / "install"
    index = prefix / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "my_scripts").touch()
    folder = prefix / "lib/my_scripts"
    folder.mkdir(parents=True)
    files = {
        "scripted": SCRIPT.encode(),
        "compiled": b"\x7fELF\x02\x01\x01" + bytes(64),
        "launcher.sh": b"#!/bin/sh\nexec true\n",
        "half": b"#!/usr/bin/env python3\ndef f(:\n",
    }
    for name, data in files.items():
        (folder / name).write_bytes(data)
        (folder / name).chmod(0o755)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(prefix))
    return site


@pytest.fixture
def record_yaml(tmp_path: Path, workspace: Path) -> Callable[[str], Any]:
    from rsltrace.job import load_job
    from rsltrace.run import run

    def go(yaml: str) -> Any:
        path = tmp_path / "job.yaml"
        path.write_text(textwrap.dedent(yaml) + "search_path: [site]\nstop: {duration: 2s}\n")
        return run(load_job(path), tmp_path / "run.mcap", force=True)

    return go


def logs(path: Path) -> list[str]:
    from rsltrace import Trace

    with Trace.open(path) as trace:
        return [
            (message := trace.decode("/rosout", data)).name + ": " + message.msg
            for _, _, data in trace.messages("/rosout")
        ]


def test_executables_of_packages_run_with_the_jobs_names_and_parameters(
    record_yaml: Callable[[str], Any], tmp_path: Path
) -> None:
    result = record_yaml(
        """
        nodes:
          - executable: my_demo/talker
            parameters: {word: one}
          - executable: my_demo/talker
            name: second
            arguments: [--verbose, 3]
            parameters: {word: two}
            remappings: {chatter: other}
          - executable: my_demo/listener
          - executable: my_scripts/scripted
        """
    )
    assert result.error is None
    assert logs(tmp_path / "run.mcap") == [
        "talker: made 1 as talker []",
        "second: made 1 as talker ['--verbose', '3']",  # its module's globals are its own
        "listener: one",
        "listener: one",
        "scripted: tick",
        "listener: one",
        "listener: one",
        "talker: bye",
        "second: bye",
    ]
    assert result.notes == ("my_scripts/scripted ended at 1.000000000 s",)


def test_sources_of_every_main_of_a_package(
    record_yaml: Callable[[str], Any], workspace: Path
) -> None:
    """Each main imports its package for itself; the trace has the hashes of all their modules."""
    package = workspace / "shared"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "helper.py").touch()
    (package / "one.py").write_text(f"{PACKAGE}main = listener\n")
    (package / "two.py").write_text("from shared import helper\nfrom shared.one import talker\n")
    result = record_yaml("nodes: [{main: 'shared.one:main'}, {main: 'shared.two:talker'}]\n")
    with Trace.open(result.path) as trace:
        assert [*trace.metadata(METADATA_SOURCES)] == [
            "shared",
            "shared.helper",
            "shared.one",
            "shared.two",
        ]


def test_arguments_that_were_looked_at_on_import_are_those_of_the_main(
    record_yaml: Callable[[str], Any], tmp_path: Path
) -> None:
    """``def main(args=sys.argv)`` is decided when the module is imported."""
    before = list(sys.argv)
    result = record_yaml(
        """
        nodes:
          - executable: my_demo/defaults
            arguments: [-n, 3]
          - main: my_demo_nodes:defaults
            name: second
        """
    )
    assert result.error is None
    assert logs(tmp_path / "run.mcap") == [
        "defaults: defaults 3, usage: defaults [-h] [-n N]\n",
        "second: my_demo_nodes 1, usage: my_demo_nodes [-h] [-n N]\n",
    ]
    assert sys.argv == before
    assert not result.guarded, "what argparse looks at to lay out its help is no finding"


def test_a_main_that_exits_is_reported_and_the_others_go_on(
    record_yaml: Callable[[str], Any], tmp_path: Path
) -> None:
    result = record_yaml("nodes: [{executable: my_demo/quitter}, {executable: my_demo/talker}]\n")
    assert result.error is None
    assert result.exit_code == 1
    assert result.sim_seconds == "2.000000000"
    assert result.notes == ("my_demo/quitter exited with 1 at 0.000000000 s: no hardware",)


def test_entries_of_one_program_are_told_apart_in_notes(record_yaml: Callable[[str], Any]) -> None:
    result = record_yaml("nodes: [{executable: my_demo/quitter}, {executable: my_demo/quitter}]\n")
    said = "exited with 1 at 0.000000000 s: no hardware"
    assert result.notes == (f"my_demo/quitter {said}", f"my_demo/quitter #2 {said}")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("executable: my_dmo/talker", "there is no package 'my_dmo'; did you mean 'my_demo'?"),
        (
            "executable: my_demo/taker",
            "package 'my_demo' has no executable 'taker'; did you mean 'talker'? "
            "It has broken, defaults, listener, quitter, talker",
        ),
        ("executable: my_demo/broken", "my_demo_nodes:not_callable is a int, not callable"),
        ("executable: my_scripts/compiled", "my_scripts/compiled is a program for another machine"),
        ("executable: my_scripts/launcher.sh", "my_scripts/launcher.sh is a script for /bin/sh"),
        ("executable: my_scripts/half", "my_scripts/half is not a Python program"),
        ("main: my_demo_nodes:taker", "module 'my_demo_nodes' has no 'taker'"),
        ("main: no_such_module:main", "there is no module 'no_such_module'"),
    ],
)
def test_what_cannot_be_run_is_said_before_a_file_is_made(
    record_yaml: Callable[[str], Any], tmp_path: Path, target: str, message: str
) -> None:
    from rsltrace.errors import JobError

    with pytest.raises(JobError) as caught:
        record_yaml(f"nodes:\n  - {target}\n")
    key = target.partition(":")[0]
    assert str(caught.value).startswith(f"{tmp_path / 'job.yaml'}:2:{len(key) + 7}: {message}")
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.long
@pytest.mark.repeated
def test_mains_and_threads_give_one_digest_however_the_process_differs(
    rsltrace: Any, tmp_path: Path, workspace: Path
) -> None:
    (tmp_path / "busy.py").write_text(
        textwrap.dedent(
            """
            import queue, threading, time
            from concurrent.futures import ThreadPoolExecutor, as_completed
            import rclpy
            from rclpy.executors import MultiThreadedExecutor
            from rclpy.callback_groups import ReentrantCallbackGroup
            from std_msgs.msg import String

            def main():
                rclpy.init()
                nodes = [rclpy.create_node(f'busy{n}') for n in range(6)]
                found = queue.Queue()
                group = ReentrantCallbackGroup()
                executor = MultiThreadedExecutor()
                for n, node in enumerate(nodes):
                    publisher = node.create_publisher(String, 'chatter', 10)
                    def got(message, n=n):
                        time.sleep(0.01 * (n % 3))
                        found.put(n)
                    node.create_subscription(String, 'numbers', got, 10)
                    executor.add_node(node)
                out = nodes[0].create_publisher(String, 'numbers', 10)
                thread = threading.Thread(target=executor.spin)
                thread.start()
                with ThreadPoolExecutor() as pool:
                    for turn in range(4):
                        out.publish(String(data=str(turn)))
                        work = [pool.submit(found.get) for _ in nodes]
                        for done in as_completed(work):
                            publisher.publish(String(data=f'{turn} {done.result()}'))
                rclpy.shutdown()
                thread.join()
            """
        )
    )
    (tmp_path / "job.yaml").write_text(
        "nodes: [{main: 'busy:main'}, {executable: my_demo/listener}]\n"
        "search_path: [., site]\nstop: {duration: 2s}\n"
    )
    digests = set()
    for number in range(cases(3, 33)):
        environment = {
            "PYTHONHASHSEED": str(number),
            "TZ": ("UTC", "Asia/Tokyo")[number % 2],
            "NOISE": "x" * (number * 997),
        }
        words = ("record", "job.yaml", "-o", f"{number}.mcap", "--no-pin")
        done = rsltrace(*words, env=environment)
        assert done.returncode == 0, done.stderr
        digests.add(done.stdout.split()[1])
    assert len(digests) == 1
