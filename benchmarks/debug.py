"""What going back costs in a debugging session: python benchmarks/debug.py [--events 100000]

A run is gone through to its end once, with checkpoints left on the way. Then the session goes to
random events and steps back from each: the time of the step is what counts, the way there is told
beside it. Last, it goes back from the end to a condition that is true only early in the run, so
that every event is looked at again. Times are real ones, as whoever waits sees them; on a machine
with other work, the processor time of all processes of the session says more.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

JOB = Path(__file__).resolve().parents[1] / "examples" / "benchmark8" / "job.yaml"
TARGET_MS = {100_000: 100.0, 1_000_000: 1000.0}
"""By the number of events: how long a step back may take, at the 95th percentile."""

_TICKS = os.sysconf("SC_CLK_TCK")


def cpu_s(session: Any) -> float:
    """Return the processor time of all processes of a session, those included that have ended."""
    root = session._process.pid
    children = Path(f"/proc/{root}/task/{root}/children").read_text().split()
    ticks = 0
    for pid in (str(root), *children):
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # its time is counted with the supervisor's, which has waited for it
        ticks += sum(map(int, fields[11:15] if pid == str(root) else fields[11:13]))
    return ticks / _TICKS


def at(values: list[float], share: float) -> float:
    """Return a percentile."""
    return sorted(values)[min(int(len(values) * share), len(values) - 1)]


def timed(action: Callable[[], object]) -> float:
    """Return how long an action takes, in milliseconds."""
    begin = time.perf_counter()
    action()
    return (time.perf_counter() - begin) * 1e3


def measure(trace: Path, folder: Path, steps: int, checkpoints: int) -> dict[str, float]:
    """Return all figures of one trace."""
    import rsltrace

    rng = random.Random(1)
    found: dict[str, float] = {}
    with rsltrace.DebugSession(
        trace, job_folder=folder, trust=True, checkpoints=checkpoints
    ) as session:
        begin_s = cpu_s(session)
        found["through_ms"] = timed(session.go_on)
        found["through_cpu_ms"] = (cpu_s(session) - begin_s) * 1e3
        events = session.position.index
        left = session.checkpoints()
        found.update(events=events, checkpoints=len(left["indices"]), pss_mib=left["bytes"] / 2**20)
        ways, backs, cpus = [], [], []
        for _ in range(steps):
            goal = rng.randrange(2, events)
            ways.append(timed(lambda goal=goal: session.go_to(goal)))  # type: ignore[misc]
            begin_s = cpu_s(session)
            backs.append(timed(session.reverse_step))
            # Answered only once the session has seen to its checkpoints, which costs time, too.
            assert session.position.index == goal - 1
            cpus.append((cpu_s(session) - begin_s) * 1e3)
        for name, values in (("go_to", ways), ("reverse_step", backs), ("reverse_step_cpu", cpus)):
            found[f"{name}_p50_ms"], found[f"{name}_p95_ms"] = at(values, 0.5), at(values, 0.95)
        found["reverse_step_cpu_mean_ms"] = sum(cpus) / len(cpus)
        left = session.checkpoints()
        found.update(checkpoints_after=len(left["indices"]), pss_after_mib=left["bytes"] / 2**20)
        session.go_on()
        session.break_at("120")
        begin_s = cpu_s(session)
        found["reverse_go_on_ms"] = timed(session.reverse_go_on)
        found["reverse_go_on_cpu_ms"] = (cpu_s(session) - begin_s) * 1e3
        assert session.position.index == 120
    return found


def main() -> int:
    """Measure and print; the exit status says whether the target is met."""
    import rsltrace

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--job", type=Path, default=JOB)
    parser.add_argument("--events", type=int, default=100_000)
    parser.add_argument("--steps", type=int, default=60, help="steps back that are measured")
    parser.add_argument("--checkpoints", type=int, default=64)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    job = rsltrace.load_job(options.job, overrides=[f"stop={{events: {options.events}}}"])
    with tempfile.TemporaryDirectory(prefix="rsltrace-bench-") as folder:
        trace = Path(folder, "run.mcap")
        begin = time.process_time()
        rsltrace.record(job, trace)
        record_cpu_ms = (time.process_time() - begin) * 1e3
        found = measure(trace, options.job.parent, options.steps, options.checkpoints)
    found["record_cpu_ms"] = record_cpu_ms
    target = TARGET_MS.get(options.events)
    met = target is None or found["reverse_step_p95_ms"] < target
    if options.json:
        print(json.dumps({**found, "target_ms": target, "met": met}))
        return 0 if met else 1
    print(
        f"{found['events']:,.0f} events: through in {found['through_ms']:,.0f} ms "
        f"({found['through_cpu_ms']:,.0f} ms CPU with {found['checkpoints']:.0f} checkpoints left; "
        f"recording took {record_cpu_ms:,.0f} ms CPU)"
    )
    print(
        f"checkpoints {found['pss_mib']:,.0f} MiB PSS in all; after {options.steps} jumps "
        f"{found['pss_after_mib']:,.0f} MiB in {found['checkpoints_after']:.0f}"
    )
    for name in ("go_to", "reverse_step"):
        p50_ms, p95_ms = found[f"{name}_p50_ms"], found[f"{name}_p95_ms"]
        print(f"{name}: wall p50 {p50_ms:,.1f}, p95 {p95_ms:,.1f} ms")
    print(
        f"reverse_step: CPU p50 {found['reverse_step_cpu_p50_ms']:,.0f}, "
        f"p95 {found['reverse_step_cpu_p95_ms']:,.0f} ms (in steps of {1000 // _TICKS}), "
        f"{found['reverse_step_cpu_mean_ms']:,.1f} ms on average"
    )
    print(
        f"reverse_go_on over all events: {found['reverse_go_on_ms']:,.0f} ms, "
        f"{found['reverse_go_on_cpu_ms']:,.0f} ms CPU"
    )
    if target is not None:
        print(f"target for reverse_step p95 {target:,.0f} ms: {'met' if met else 'missed'}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
