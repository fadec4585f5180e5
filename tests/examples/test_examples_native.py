"""The examples are ordinary rclpy nodes: they run on rclpy's own executors over DDS as well."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
THROUGHPUT = ROOT / "benchmarks" / "throughput.py"
pytestmark = [
    pytest.mark.ros,
    pytest.mark.native,
    pytest.mark.usefixtures("own_domain"),
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs rclpy"),
]

SPIN = """
import os, sys, time
sys.path.insert(0, sys.argv[1])
import rclpy
from rclpy.executors import SingleThreadedExecutor

def spin(seconds, *classes, until=lambda nodes: True):
    nodes = [each() for each in classes]
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    begun = time.monotonic()
    # Longer than asked for only where discovery or a busy machine needs it.
    while (took := time.monotonic() - begun) < seconds or (took < 500 and not until(nodes)):
        executor.spin_once(timeout_sec=0.1)
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown()
"""

NETWORK = """
rclpy.init()
import nodes
from functools import partial
spin(2.5, *(partial(each, keep_order=True)
            for each in (nodes.NodeA, nodes.NodeB, nodes.NodeC, nodes.NodeD)),
     partial(nodes.Monitor, seconds=1),
     until=lambda _: len(nodes.EXECUTED) > 200 and len(set(nodes.EXECUTED)) == 10)
print(len(nodes.EXECUTED), len(set(nodes.EXECUTED)))
"""

FUSION = """
rclpy.init(args=['--ros-args', '-p', 'datum_latitude:=47.0', '-p', 'datum_longitude:=8.0'])
from fusion_demo.robot import SimulatedRobot
from fusion_demo.ekf_node import EkfNode
from fusion_demo.planner import Planner
from fusion_demo.follower import PathFollower
from fusion_demo.track_monitor import TrackMonitor
spin(5.0, SimulatedRobot, EkfNode, Planner, PathFollower, TrackMonitor,
     until=lambda nodes: nodes[-1]._length_m > 1.5)
"""


def native(arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "ROS_LOG_DIR": str(folder)}
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return done


def test_the_determinism_network_runs_over_dds(tmp_path: Path) -> None:
    folder = str(ROOT / "examples" / "rslcpp_determinism")
    done = native(["-c", SPIN + NETWORK, folder], tmp_path)
    callbacks, kinds = map(int, done.stdout.split())
    assert kinds == 10  # every callback of the network, service and response among them
    assert callbacks > 200
    assert done.stderr.count("final state") == 4
    assert "combined hash" in done.stderr


def test_the_robot_drives_over_dds(tmp_path: Path) -> None:
    done = native(["-c", SPIN + FUSION, str(ROOT / "examples" / "sensor_fusion")], tmp_path)
    assert "plan of" in done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert "to the truth" in last
    assert float(last.split("driven ")[1].split(" m")[0]) > 1.0


@pytest.mark.parametrize("graph", ["ping_pong", "graph8"])
@pytest.mark.parametrize("executor", ["single_threaded", "events_executor"])
def test_a_benchmark_case_measures_something(graph: str, executor: str, tmp_path: Path) -> None:
    worker = [str(THROUGHPUT), "--worker", f"{graph}/{executor}", "0.5", str(tmp_path)]
    figures = json.loads(native(worker, tmp_path).stdout.splitlines()[-1])
    assert figures["callbacks"] > 0
    assert figures["wall_s"] >= 0.4
