"""How fast a verified replay is beside recording: python benchmarks/replay.py

Both are done in turns, in one process and on the same job, and compared in pairs: a busy moment of
the machine does not hit one alone. The target is for processor time and the median of the pairs. A
replay writes a trace, too (the report of a divergence is made of it), so it cannot be much faster
than recording.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

JOB = Path(__file__).resolve().parents[1] / "examples" / "benchmark8" / "job.yaml"
RATIO_MIN = 0.8
"""Speed of replaying over that of recording."""


def cpu_s(action: Callable[[], object]) -> float:
    """Return the processor time of an action, in seconds."""
    begin = time.process_time()
    action()
    return time.process_time() - begin


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

        for action in (record, replay):
            action()  # what only the first of each does is nobody's speed
        pairs = [(cpu_s(record), cpu_s(replay)) for _ in range(options.runs)]
    record_s, replay_s = map(min, zip(*pairs, strict=True))
    ratios = sorted(one / other for one, other in pairs)
    ratio = median(ratios)
    met = ratio >= RATIO_MIN
    if options.json:
        values = {"events": events, "record_s": record_s, "replay_s": replay_s}
        print(json.dumps({**values, "ratios": ratios, "ratio": ratio, "met": met}))
    else:
        print(
            f"{events} events: recorded at {events / record_s:,.0f}, replayed and verified at "
            f"{events / replay_s:,.0f} events per CPU second"
        )
        print(f"ratios of the pairs: {', '.join(f'{one:.2f}' for one in ratios)}")
        print(f"ratio {ratio:.2f}, target {RATIO_MIN}: {'met' if met else 'missed'}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
