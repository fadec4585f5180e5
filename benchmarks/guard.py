"""What the guard costs: the throughput graphs with it and without, and what state hashes cost.

    python benchmarks/guard.py              about two minutes
    python benchmarks/guard.py --json       the same figures for a machine

Every measurement is a process of its own, guarded and not in turns, so that a busy minute of the
machine hits both. Runs of one job are alike event by event, so their CPU time is taken for each
segment of the trace (4096 events) by itself, from the second on, and of each segment the best of
the repetitions counts: other users of the machine, and where things lie in memory, only ever add to
it. What is constructed at the start counts for neither.

State hashes are measured in a node that changes one element of an array of one megabyte in each
event, with ``guard: {state: true}`` and without.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import Any

from graphs import GRAPHS, run_rsltrace

GRAPH_NAMES = ("ping_pong", "graph8", "graph200")
GUARD_AIM = 1.05
STATE_AIM_US = 50.0
SEGMENT_EVENTS = 4096
STATE_EVENTS = 4 * SEGMENT_EVENTS

ARRAY_NODE = """
import numpy as np
from rclpy.node import Node
class Big(Node):
    def __init__(self):
        super().__init__('big')
        self.data = np.zeros(131072)
        self.count = 0
        self.create_timer(0.001, self.tick)
    def tick(self):
        self.count += 1
        self.data[(self.count * 7919) % 131072] = self.count
"""


def state_job(folder: Path, *, hashed: bool, events: int) -> None:
    """Run the node with the large array."""
    from rsltrace import load_job
    from rsltrace import record as record_job

    (folder / "big.py").write_text(ARRAY_NODE)
    job = {
        "nodes": [{"node": "big:Big"}],
        "stop": {"events": events},
        "guard": {"state": hashed},
    }
    path = folder / "job.yaml"
    path.write_text(json.dumps(job))
    record_job(load_job(path), output=folder / "run.mcap", force=True)


def work(what: str, on: bool, events: int) -> list[float]:
    """Measure in this process; return the CPU seconds of each segment."""
    from rsltrace.guard.redirect import copy_of
    from rsltrace.trace.writer import TraceWriter

    cpu_s = copy_of(process_time)  # the one that goes on showing real time in a run
    ends: list[float] = []
    write_segment = TraceWriter._write_segment

    def write(self: TraceWriter) -> None:
        ends.append(cpu_s())
        write_segment(self)

    TraceWriter._write_segment = write  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if what == "state":
            state_job(folder, hashed=on, events=events)
        else:
            run_rsltrace(GRAPHS[what], events, folder, record=True, guarded=on)
    whole = events // SEGMENT_EVENTS
    return [end - begin for begin, end in pairwise(ends[:whole])]


def worker(what: str, on: bool, events: int) -> list[float]:
    """Run ``work`` in a process of its own."""
    command = [sys.executable, __file__, "--worker", what, str(int(on)), str(events)]
    environment = {**os.environ, "PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=environment, timeout=300
    )
    if done.returncode:
        sys.exit(f"{what} failed:\n{done.stderr}")
    result: list[float] = json.loads(done.stdout.splitlines()[-1])
    return result


class Times:
    """CPU seconds of the segments of one job, the best of all repetitions."""

    def __init__(self, what: str, on: bool, events: int) -> None:
        self.what = what
        self.on = on
        self.events = events
        self.best: list[float] = []

    def measure(self) -> None:
        """Run it once more."""
        segments = worker(self.what, self.on, self.events)
        self.best = [min(pair) for pair in zip(self.best or segments, segments, strict=True)]

    @property
    def us(self) -> float:
        """Microseconds per callback."""
        return sum(self.best) / len(self.best) / SEGMENT_EVENTS * 1e6


def main() -> int:
    """Measure and print; the exit status says nothing of the aims."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--repeat", type=int, default=8)
    parser.add_argument("--events", type=int, default=60_000)
    parser.add_argument("--only", choices=[*GRAPH_NAMES, "state"], help="measure this one only")
    parser.add_argument("--worker", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        what, on, events = options.worker
        print(json.dumps(work(what, on == "1", int(events))))
        return 0
    names = [options.only] if options.only else [*GRAPH_NAMES, "state"]
    found = {
        what: [
            Times(what, on, STATE_EVENTS if what == "state" else options.events)
            for on in (False, True)
        ]
        for what in names
    }
    for _ in range(options.repeat):
        for both in found.values():
            for times in both:
                times.measure()
    result: dict[str, Any] = {}
    for what, (off, on) in found.items():
        result[what] = {
            "off_us": off.us,
            "on_us": on.us,
            "ratio": on.us / off.us,
            "more_us": on.us - off.us,
        }
    if options.json:
        print(json.dumps(result, indent=2))
        return 0
    print(f"CPU time per callback, best of {options.repeat}, everything recorded")
    for what, row in result.items():
        if what == "state":
            met = "met" if row["more_us"] <= STATE_AIM_US else "missed"
            print(
                "  state hash of a node with a changing array of 1 MB: "
                f"{row['more_us']:.1f} us per event (aim {STATE_AIM_US:.0f}: {met})"
            )
            continue
        met = "met" if row["ratio"] <= GUARD_AIM else "missed"
        print(
            f"  {what:<12} guard off {row['off_us']:6.2f} us, on {row['on_us']:6.2f} us: "
            f"x{row['ratio']:.3f} (aim x{GUARD_AIM}: {met})"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
