"""RSLCPP's determinism network: the oracle for the loop.

The numbers were measured from RSLCPP (C++, rclcpp jazzy 28.1.6, rcl 9.2.8). The second combined
hash is also the one printed in RSLCPP's own sources.
"""

from __future__ import annotations

import lzma
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsltrace import Trace, load_job
from rsltrace.trace.model.event import EventKind

pytestmark = pytest.mark.ros

ROOT = Path(__file__).parents[2]
JOBS = ROOT / "examples" / "rslcpp_determinism"
ORDER = ROOT / "tests" / "golden" / "rslcpp_callback_order_creation.txt.xz"

CALLBACKS = [EventKind.TIMER, EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT]

GOLDEN = {
    "job.yaml": (
        [
            13404255130693361018,
            6314714395288068323,
            271694970909356762,
            18227695353861151360,
        ],
        14807076229895937644,
    ),
    "job_heap.yaml": (
        [
            3924739178523851918,
            416215330994369847,
            18314823502387776320,
            1601759294353606794,
        ],
        7448837717382456148,
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(GOLDEN))
def test_states_and_combined_hash_are_rslcpps(name: str, tmp_path: Path) -> None:
    from rsltrace import record

    result = record(load_job(JOBS / name), tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as trace:
        texts = [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]
        monitor = next(e.id for e in trace.entities.values() if e.name == "/monitor")
        others = [e.id for e in trace.entities.values() if e.node != monitor]
        callbacks = sum(
            int(np.count_nonzero(np.isin(p["kind"], CALLBACKS) & np.isin(p["entity"], others)))
            for p in trace.events()
        )
    states, combined = GOLDEN[name]
    assert [int(t.split()[-1]) for t in texts if t.startswith("final state")] == states
    assert texts[-1] == f"combined hash {combined}"
    assert callbacks == 19_011
    assert (result.exit_code, result.end_ns) == (0, 110 * 10**9)


def test_callbacks_run_in_rslcpps_order(tmp_path: Path, capfd: Any) -> None:
    """The seeds as executed, read off by the nodes themselves (one argument in the job)."""
    from rsltrace import record

    text = (JOBS / "job.yaml").read_text()
    asked = r"- {node: nodes:Node\1, arguments: {keep_order: true}}"
    text = re.sub(r"- node: nodes:Node(.)", asked, text)
    probe = tmp_path / "probe.py"
    probe.write_text(
        "from rclpy.node import Node\n"
        "import nodes\n"
        "class Probe(Node):\n"
        "    def __init__(self): super().__init__('probe')\n"
        "    def destroy_node(self):\n"
        "        import pathlib\n"
        f"        pathlib.Path({str(tmp_path / 'order.txt')!r}).write_text(\n"
        "            ' '.join(map(str, nodes.EXECUTED)))\n"
        "        super().destroy_node()\n"
    )
    text = text.replace("- node: nodes:Monitor", "- node: nodes:Monitor\n  - node: probe:Probe")
    job = tmp_path / "job.yaml"
    job.write_text(f"search_path: ['{JOBS}', .]\n" + text)
    record(load_job(job), tmp_path / "run.mcap")
    expected = lzma.decompress(ORDER.read_bytes()).decode().split()
    assert len(expected) == 19_011
    assert (tmp_path / "order.txt").read_text().split() == expected
