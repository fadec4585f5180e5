"""Who listens to what nobody publishes, or is a client of what nobody serves, is told once, after
a recording."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.words.logs import missing_servers, silent_topics


def entities(*ends: tuple[str, EntityKind, str]) -> list[Entity]:
    nodes = {name: number for number, name in enumerate(dict.fromkeys(e[0] for e in ends), 1)}
    found = [Entity(n, n, EntityKind.NODE, name, "", 0, {}) for name, n in nodes.items()]
    return found + [
        Entity(100 + n, nodes[node], kind, topic, "std_msgs/msg/Empty", 0, {})
        for n, (node, kind, topic) in enumerate(ends)
    ]


SUB, PUB = EntityKind.SUBSCRIPTION, EntityKind.PUBLISHER


def test_what_is_said() -> None:
    assert silent_topics(entities(("/a", PUB, "/t"), ("/b", SUB, "/t"))) == ""
    assert silent_topics(entities(("/a", PUB, "/t"), ("/b", SUB, "/T"))) == (
        "nobody publishes /T, which /b listens to"
    )
    both = silent_topics(entities(("/a", SUB, "/t"), ("/b", SUB, "/t")))
    assert both == "nobody publishes /t, which /a and /b listen to"
    many = silent_topics(entities(*(("/b", SUB, f"/t{n}") for n in range(5))))
    assert many == (
        "topics without a publisher: /t0 (for /b), /t1 (for /b), /t2 (for /b) and 2 more topics"
    )


@pytest.mark.parametrize("topic", ["/tf", "/clock", "/parameter_events", "/a/_action/feedback"])
def test_nothing_is_said_of_what_nodes_listen_to_in_case_there_is_some(topic: str) -> None:
    assert silent_topics(entities(("/b", SUB, topic))) == ""


def test_what_is_said_of_clients() -> None:
    calls, serves = EntityKind.CLIENT, EntityKind.SERVICE
    assert missing_servers(entities(("/a", calls, "/s"), ("/b", serves, "/s"))) == ""
    assert missing_servers(entities(("/a", calls, "/s"), ("/b", serves, "/S"))) == (
        "nobody serves /s, of which /a is a client"
    )
    both = missing_servers(entities(("/a", calls, "/s"), ("/b", calls, "/s")))
    assert both == "nobody serves /s, of which /a and /b are clients"
    assert missing_servers(entities(*(("/b", calls, f"/s{n}") for n in range(4)))) == (
        "services without a server: /s0 (for /b), /s1 (for /b), /s2 (for /b) and 1 more services"
    )


@pytest.mark.ros
def test_record_tells_it(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    (tmp_path / "listening.py").write_text(
        "from rclpy.action import ActionClient\nfrom rclpy.node import Node\n"
        "from std_msgs.msg import Empty\nfrom test_msgs.action import Fibonacci\n\n\n"
        "class Base(Node):\n"
        "    def __init__(self):\n        super().__init__('base')\n"
        "        self.create_subscription(Empty, 'cmd_wel', lambda message: None, 1)\n"
        "        self.create_subscription(Empty, 'tf', lambda message: None, 1)\n"
        "        self.dock = ActionClient(self, Fibonacci, 'dock')\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: listening:Base}]\nstop: {duration: 1s}\n")
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", "a.mcap"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    told = [line for line in done.stderr.splitlines() if "nobody" in line]
    whom = "rsltrace check shows the graph"
    assert told == [
        f"note: nobody publishes /cmd_wel, which /base listens to; {whom}",
        f"note: nobody serves /dock, of which /base is a client; {whom}",
    ]
