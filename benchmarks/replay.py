"""How fast a verified replay is beside recording: python benchmarks/replay.py

Both are done in turns, in one process and on the same job, and the best of each counts: a busy
moment of the machine does not hit one alone. The target is for processor time. A replay writes a
trace, too (the report of a divergence is made of it), so it cannot be much faster than recording.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

JOB = Path(__file__).resolve().parents[1] / "examples" / "benchmark8" / "job.yaml"
RATIO_MIN = 0.8
"""Speed of replaying over that of recording."""


def best_s(runs: int, *actions: Callable[[], object]) -> list[float]:
    """Return the least processor time of each action, in seconds."""
    best = [float("inf")] * len(actions)
    for _ in range(runs):
        for number, action in enumerate(actions):
            begin = time.process_time()
            action()
            best[number] = min(best[number], time.process_time() - begin)
    return best


def main() -> int:
    """Measure and print; the exit status says whether the target is met."""
    import rsltrace

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--job", type=Path, default=JOB)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    job = rsltrace.load_job(options.job)
    with tempfile.TemporaryDirectory(prefix="rsltrace-bench-") as folder:
        trace = Path(folder, "run.mcap")
        events = rsltrace.record(job, trace).events

        def record() -> None:
            rsltrace.record(job, Path(folder, "other.mcap"), force=True)

        def replay() -> None:
            found = rsltrace.replay(trace, job_folder=options.job.parent, trust=True)
            assert found.is_whole, found.sentence

        record_s, replay_s = best_s(options.runs, record, replay)
    ratio = record_s / replay_s
    met = ratio >= RATIO_MIN
    if options.json:
        values = {"events": events, "record_s": record_s, "replay_s": replay_s, "ratio": ratio}
        print(json.dumps({**values, "met": met}))
    else:
        print(
            f"{events} events: recorded at {events / record_s:,.0f}, replayed and verified at "
            f"{events / replay_s:,.0f} events per CPU second"
        )
        print(f"ratio {ratio:.2f}, target {RATIO_MIN}: {'met' if met else 'missed'}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
