"""What it costs to find and measure all chains of a trace.

    python benchmarks/latency.py [EVENTS]

A run of 8 nodes of which each receives the messages of the one before: half of the events are
inputs of a chain, and as many outputs.
CPU time, and the most memory that was used beyond what was there before the measurement.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from multiprocessing import get_context
from pathlib import Path

from synthetic import Shape, write_trace

from rsltrace.checks.latency.measure import MEASURES, measure_latencies
from rsltrace.trace.reader import Trace

EVENTS = 1_000_000


def main(events: int) -> None:
    """Print the figures of a trace with so many events."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        writer = get_context("spawn").Process(
            target=write_trace, args=(path, Shape(events, payload_bytes=None))
        )
        writer.start()  # what it takes in memory must not count
        writer.join()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start = time.process_time()
        with Trace.open(path) as trace:
            found = measure_latencies(trace)
            read_s = time.process_time() - start
            for chain in found.chains:
                for measure in MEASURES:
                    chain.worst(measure)
                    chain.figures(measure)
                len(chain.parts) + len(chain.passages)
        all_s = time.process_time() - start
        more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        print(
            f"{events:,} events, {len(found.chains)} chains, "
            f"{sum(chain.outputs for chain in found.chains):,} outputs: read in {read_s:.2f} s, "
            f"with all figures {all_s:.2f} s, {more / 1024:.0f} MiB"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else EVENTS)
