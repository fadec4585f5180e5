"""Much of everything: a unit costs the same work, however many there are. Calls are counted."""

from __future__ import annotations

import cProfile
import pstats
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from rclpy.node import Node

from rsltrace import Job, NodeSpec, Simulation, StopSpec

pytestmark = pytest.mark.ros

SIZES = (30, 90, 210)
"""The second step is twice as large as the first."""


def many_nodes(count: int) -> list[Node]:
    return [Node(f"node_{index}") for index in range(count)]


def many_timers(count: int) -> Node:
    node = Node("ticking")
    for index in range(count):
        node.create_timer(0.5 + index * 1e-6, lambda: None)
    return node


def one_topic(count: int) -> list[Node]:
    """One publisher and many subscriptions, in nodes of their own."""
    from std_msgs.msg import UInt64

    talker, listener = Node("talker"), Node("listener")
    talker.create_publisher(UInt64, "count", 1)
    for _ in range(count):
        listener.create_subscription(UInt64, "count", lambda message: None, 1)
    return [talker, listener]


def work_of(job: Any, output: Path) -> int:
    """Return how many calls a recorded run makes."""
    profile = cProfile.Profile()
    profile.enable()
    with Simulation(job, output, force=True) as simulation:
        simulation.run()
    profile.disable()
    return int(pstats.Stats(profile).total_calls)  # type: ignore[attr-defined]


def growth(work: Callable[[int], int]) -> float:
    """Return how much more work twice as many further units take; 2 if it is linear."""
    work(1)  # loads modules, generates codecs
    few, some, many = (work(size) for size in SIZES)
    return (many - some) / (some - few)


@pytest.mark.long
@pytest.mark.parametrize(
    "make",
    [
        one_topic,
        *(pytest.param(make, marks=pytest.mark.long) for make in (many_nodes, many_timers)),
    ],
)
def test_work_grows_with_what_there_is(make: Callable[[int], Any], tmp_path: Path) -> None:
    def work(count: int) -> int:
        nodes = [NodeSpec(node=partial(make, count))]
        return work_of(Job(nodes=nodes, stop=StopSpec(duration=1.0)), tmp_path / "run.mcap")

    assert growth(work) < 2.2


@pytest.mark.long
def test_the_work_of_a_job_file_grows_with_its_entries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "one_of_many.py").write_text(
        "from rclpy.node import Node\nclass One(Node):\n"
        "    def __init__(self):\n        super().__init__('one')\n"
    )

    def work(count: int) -> int:
        path = tmp_path / "job.yaml"
        lines = [
            f"  - {{node: one_of_many:One, name: n{i}, parameters: {{use_sim_time: false}}}}\n"
            for i in range(count)
        ]
        path.write_text(f"nodes:\n{''.join(lines)}stop: {{duration: 1ms}}\n")
        return work_of(path, tmp_path / "run.mcap")

    assert growth(work) < 2.2


_SHARED = """
import gc, sys
from rsltrace import Job, NodeSpec, Simulation, StopSpec
from rsltrace.adapters.rclpy.handles.entity_handle import EntityHandle
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rclpy.node import Node
from std_msgs.msg import UInt64

def many():
    nodes = []
    for index in range(100):
        node = Node(f"node_{index}")
        publisher = node.create_publisher(UInt64, "count", 1)
        node.create_subscription(UInt64, "count", lambda message: None, 1)
        node.create_timer(0.5, lambda publisher=publisher: publisher.publish(UInt64()))
        nodes.append(node)
    return nodes

with Simulation(Job(nodes=[NodeSpec(node=many)], stop=StopSpec(duration=1.0))) as simulation:
    simulation.run()
    gc.unfreeze()
    for handle in gc.get_objects():
        if isinstance(handle, (EntityHandle, NodeHandle)):
            own = vars(handle)
            print(type(handle).__name__, sys.getsizeof(own) < sys.getsizeof(dict(own)))
"""


@pytest.mark.long
@pytest.mark.skipif(sys.version_info < (3, 11), reason="3.10 shares by other rules")
def test_handles_share_the_names_of_their_attributes(tmp_path: Path) -> None:
    """Else each has a table of its own of 1.5 kB, and 200 nodes do not fit into the cache."""
    program = tmp_path / "program.py"
    program.write_text(_SHARED)
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, check=True)
    found = Counter(done.stdout.split("\n"))
    assert found["NodeHandle True"] == found["SubscriptionHandle True"] == 100, found
    # The executor's two guard conditions have too few attributes to tell.
    assert not [line for line, many in found.items() if line.endswith("False") and many > 2]
