"""What the guard costs: the throughput graphs with it and without, and what state hashes cost.

    python benchmarks/guard.py              about two minutes
    python benchmarks/guard.py --json       the same figures for a machine

Every measurement is a process of its own, guarded and not in turns, so that a busy minute of the
machine hits both. Of a short and a long run the difference is taken, so that start-up counts for
neither. Shown is the CPU time per callback, the best of the repetitions: other users of the machine
only ever add to it.

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
from pathlib import Path
from time import process_time
from typing import Any

from graphs import GRAPHS, run_rsltrace

GRAPH_NAMES = ("ping_pong", "graph8", "graph200")
GUARD_AIM = 1.05
STATE_AIM_US = 50.0
STATE_EVENTS = 4000

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


def state_job(folder: Path, *, hashed: bool, events: int) -> float:
    """Run the node with the large array; return CPU seconds."""
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
    begin = process_time()
    record_job(load_job(path), output=folder / "run.mcap", force=True)
    return process_time() - begin


def work(what: str, on: bool, amount: int) -> dict[str, Any]:
    """Measure in this process; what a worker prints."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if what == "state":
            return {"cpu_s": state_job(folder, hashed=on, events=amount), "callbacks": amount}
        return run_rsltrace(GRAPHS[what], amount, folder, record=True, guarded=on)


def worker(what: str, on: bool, amount: int) -> dict[str, Any]:
    """Run ``work`` in a process of its own."""
    command = [sys.executable, __file__, "--worker", what, str(int(on)), str(amount)]
    environment = {**os.environ, "PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=environment, timeout=300
    )
    if done.returncode:
        sys.exit(f"{what} failed:\n{done.stderr}")
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


class Times:
    """CPU seconds of short and long runs of one thing."""

    def __init__(self, what: str, on: bool, amount: int) -> None:
        self.what, self.on, self.amount = what, on, amount
        self.short: list[float] = []
        self.long: list[float] = []
        self.callbacks = 0

    def measure(self) -> None:
        """Run both once more."""
        short = worker(self.what, self.on, self.amount // 10)
        long = worker(self.what, self.on, self.amount)
        self.short.append(short["cpu_s"])
        self.long.append(long["cpu_s"])
        self.callbacks = long["callbacks"] - short["callbacks"]

    @property
    def us(self) -> float:
        """Microseconds per callback: the best long run without the best short one."""
        return (min(self.long) - min(self.short)) / self.callbacks * 1e6


def main() -> int:
    """Measure and print; the exit status says nothing of the aims."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--events", type=int, default=60_000)
    parser.add_argument("--worker", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        what, on, amount = options.worker
        print(json.dumps(work(what, on == "1", int(amount))))
        return 0
    found = {
        what: [
            Times(what, on, STATE_EVENTS if what == "state" else options.events)
            for on in (False, True)
        ]
        for what in (*GRAPH_NAMES, "state")
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
    for what in GRAPH_NAMES:
        row = result[what]
        met = "met" if row["ratio"] <= GUARD_AIM else "missed"
        print(
            f"  {what:<12} guard off {row['off_us']:6.2f} us, on {row['on_us']:6.2f} us: "
            f"x{row['ratio']:.3f} (aim x{GUARD_AIM}: {met})"
        )
    row = result["state"]
    met = "met" if row["more_us"] <= STATE_AIM_US else "missed"
    print(
        f"  state hash of a node with a changing array of 1 MB: {row['more_us']:.1f} us per event "
        f"(aim {STATE_AIM_US:.0f}: {met})"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
