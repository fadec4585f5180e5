"""Whether the observer loses anything, over many runs: ``python -m tests.native.many_runs``.

Nodes count what they do; the trace has to have the same. Every other run has a process for each
entry, the rest all of them in one. With ``--program`` all runs have two nodes in C: ``counting.c``,
compiled.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from rsltrace.trace.model.event import NO_EVENT
from rsltrace.trace.reader import Trace
from tests.native.running import record

JOB = """
nodes:
  - {node: robot_mains:Counting, arguments: {name: a, first: 100000}, parameters: {told: a}}
  - {node: robot_mains:Counting, arguments: {name: b, first: 200000}, parameters: {told: b}}
  - node: robot_mains:Counting
    arguments: {name: c, first: 300000}
    parameters: {told: c, period: 0.013}
  - {node: robot_mains:Counting, arguments: {name: d, first: 400000}, parameters: {told: d}}
stop: {duration: 2s}
"""
IN_C = """
nodes:
  - {node: robot_mains:Counting, arguments: {name: a, first: 100000}, parameters: {told: a}}
  - {program: PROGRAM, arguments: [b, "200000", "10"], name: b}
  - {program: PROGRAM, arguments: [c, "300000", "13"], name: c}
  - {node: robot_mains:Counting, arguments: {name: d, first: 400000}, parameters: {told: d}}
stop: {duration: 2s}
"""
NAMES = "abcd"


def compare(folder: Path) -> Counter[str]:
    """Return how much there was in a run, and how much of it is missing or wrong in the trace."""
    found: Counter[str] = Counter()
    with Trace.open(folder / "run.mcap") as trace:
        trace.check()
        nodes = {one.id: trace.node_of(one).name.strip("/") for one in trace.entities.values()}
        met: dict[tuple[str, str], list[Any]] = defaultdict(list)
        for index in range(trace.event_count):
            event = trace.event(index)
            entity = trace.entity(event.entity)
            met[nodes[entity.id], entity.name].append(event)
        for name in NAMES:
            own = json.loads((folder / name).read_text())
            for what, count in (
                ("Counting.on_timer", own["sent"]),
                ("/numbers", len(own["got"])),
                ("/same", own["same"]),
            ):
                found["callbacks"] += count
                found["missing callbacks"] += abs(count - len(met[name, what]))
            for event, number in zip(met[name, "/numbers"], own["got"], strict=False):
                found["messages with a number in them"] += 1
                found["wrong causes"] += _number(trace, event) != number
            senders = Counter(
                (event.cause_event, event.cause_output) for event in met[name, "/same"]
            )
            found["equal messages"] += sum(senders.values())
            found["wrong causes"] += sum(senders.values()) - len(senders)
        found["unknown causes"] += int(trace.result["unknown_causes"])
        for key in ("observer_ns", "pen_ns", "callback_ns"):
            found[key] += int(trace.result[key])
    return found


def _number(trace: Trace, event: Any) -> int | None:
    if event.cause_event == NO_EVENT:
        return None
    output = trace.outputs_of(event.cause_event)[event.cause_output]
    payload = trace.payload(output)
    if payload is None:
        return None
    message: Any = trace.decode("/numbers", payload[2])
    return int(message.data)


def main() -> None:
    """Run and compare, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--program", default="")
    options = parser.parse_args()
    runs, job = options.runs, IN_C.replace("PROGRAM", options.program) if options.program else JOB
    totals: dict[str, Counter[str]] = defaultdict(Counter)
    for number in range(runs):
        with tempfile.TemporaryDirectory() as name:
            words = ["--processes"] if number % 2 or options.program else []
            done = record(Path(name), job, "--quiet", *words)
            assert done.returncode == 0, done.stderr
            kind = "one process" if not words else "four processes"
            totals[kind]["runs"] += 1
            totals[kind].update(compare(Path(name)))
            print(number, dict(totals[kind]), flush=True)
    for kind, total in totals.items():
        print(kind)
        for what, count in total.items():
            average = count // total["runs"]
            print(f"  {what}: {f'{average / 1000:.1f} us' if what.endswith('_ns') else count}")


if __name__ == "__main__":
    main()
