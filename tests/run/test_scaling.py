"""Memory does not grow with the length of a run, nor an event's work with the number of nodes.

No wall times: memory is the peak of a process, work is counted in calls of Python functions, that
of the kernel in pages that it has to clear. The peak is read from /proc: what ``getrusage`` gives
is never less than that of whoever started it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.long]

CODE = """
import json, sys
from rclpy.node import Node
from std_msgs.msg import UInt64
from rsltrace import Job, NodeSpec, StopSpec, record

class Pair(Node):
    def __init__(self, number):
        super().__init__(f'pair_{number}')
        publisher = self.create_publisher(UInt64, f'n_{number}', 10)
        self.create_subscription(UInt64, f'n_{number}', lambda m: None, 10)
        self.create_timer(0.001, lambda: publisher.publish(UInt64(data=number)))

def pairs(count):
    return [Pair(number) for number in range(count)]

events, nodes, profile = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == 'profile'
job = Job(nodes=[NodeSpec(node=pairs, arguments={'count': nodes})], stop=StopSpec(events=events))
calls = 0
if profile:
    def count(frame, event, argument):
        global calls
        calls += event == 'call'
    short = Job(nodes=job.nodes, stop=StopSpec(events=1))
    record(short, sys.argv[4], force=True)
    sys.setprofile(count)
    record(short, sys.argv[4], force=True)
    begun = calls
    calls = 0
    result = record(job, sys.argv[4], force=True)
    sys.setprofile(None)
    calls -= begun
else:
    result = record(job, sys.argv[4], force=True)
with open('/proc/self/status') as status:
    (peak,) = [line.split()[1] for line in status if line.startswith('VmHWM:')]
print(json.dumps({
    'events': result.events,
    'peak_mib': int(peak) / 1024,
    'calls': calls,
}))
"""


def measure(events: int, nodes: int, mode: str, path: Any) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(events), str(nodes), mode, str(path)],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    values: dict[str, Any] = json.loads(done.stdout)
    return values


def test_memory_does_not_grow_with_the_length_of_the_run(tmp_path: Any) -> None:
    short = measure(100_000, 1, "memory", tmp_path / "run.mcap")
    long = measure(1_000_000, 1, "memory", tmp_path / "run.mcap")
    assert long["events"] >= 1_000_000
    assert long["peak_mib"] - short["peak_mib"] < 10


def test_an_event_takes_the_same_work_whatever_the_number_of_nodes(tmp_path: Any) -> None:
    """Counted between two lengths of one job: what is done once per node is no work of events.

    So it is with the lines of a node's first 32 outputs, which all 200 nodes have sent by the
    16,000th event.
    """

    def calls_per_event(nodes: int) -> float:
        lengths = 16_000, 32_000
        short, long = (measure(n, nodes, "profile", tmp_path / "run.mcap") for n in lengths)
        return float(long["calls"] - short["calls"]) / (long["events"] - short["events"])

    assert calls_per_event(200) < 1.05 * calls_per_event(8)


PING_PONG = Path(__file__).resolve().parents[2] / "examples" / "ping_pong"
FAULTS = """
import sys
from resource import RUSAGE_SELF, getrusage
from rsltrace import load_job, record
print(record(load_job(sys.argv[1]), sys.argv[2]).events, getrusage(RUSAGE_SELF).ru_minflt)
"""


def test_segments_are_laid_out_in_memory_that_is_there(tmp_path: Path) -> None:
    """Without ``keep_heap`` every fifth event made the kernel clear a page (with delays)."""

    def events_and_faults(messages: int) -> tuple[int, int]:
        job = tmp_path / f"{messages}.yaml"
        parameters = f"{{messages: {messages}, burst: true}}"
        job.write_text(
            f"search_path: [{json.dumps(str(PING_PONG))}]\n"
            f"nodes: [{{node: 'ping_pong:Ping', parameters: {parameters}}}, "
            "{node: 'ping_pong:Pong'}]\n"
            "delay: {default: {uniform: {min: 10us, max: 90us}}}\n"
            "stop: {topic: /ping_pong/done}\n"
        )
        command = [sys.executable, "-c", FAULTS, str(job), str(job.with_suffix(".mcap"))]
        out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        events, faults = out.split()
        return int(events), int(faults)

    (few, faults), (many, more_faults) = map(events_and_faults, (5_000, 30_000))
    assert (more_faults - faults) / (many - few) < 0.05
