"""How long a diff takes, beside reading both traces up to the divergence and comparing.

    python benchmarks/diff.py            1e4, 1e5 and 1e6 events, about three minutes
    python benchmarks/diff.py --large    1e7 events, too (3.5 GB of files, some minutes more)

Each run is compared with itself and with runs that diverge from it at 10, 50 and 99 %. "diff" is
what a user waits for: a new process, from start to exit, the best of nine; "cpu" is its time on a
CPU (of all threads: numpy's BLAS starts some), which a busy machine changes less. "linear" is the
mcap package's reader going through the messages of both files in its usual order until they differ,
without the start of a process; "events" the same with the events only, for somebody who knows what
these are. What is marked with ~ was not waited for, but scaled from the half of 1e6 events. All
files are in the page cache. They are kept in the temporary folder for the next time.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from itertools import zip_longest
from pathlib import Path

from mcap.reader import make_reader
from synthetic import Shape, write_trace

from rsltrace.diff.traces.diff import diff_traces
from rsltrace.trace.format import TOPIC_EVENTS
from rsltrace.trace.reader import Trace

SIZES = (10_000, 100_000, 1_000_000)
LARGE = 10_000_000
PLACES = (0.10, 0.50, 0.99)
PAYLOADS_MAX = 1_000_000
LINEAR_MAX = 500_000
"""Events read one by one; the time for more is that of so many, scaled."""

_VERSION = 2
_TRIES = 9


def traces(count: int) -> list[tuple[str, Path, Path]]:
    """Return (where they diverge, one trace, the other), written now if they are not there yet."""
    folder = Path(tempfile.gettempdir()) / f"rsltrace-benchmark-diff-{_VERSION}"
    folder.mkdir(exist_ok=True)
    payload_bytes = 0 if count <= PAYLOADS_MAX else None
    places = {"same": None, **{f"{p:.0%}": int(count * p) for p in PLACES}}
    paths = {}
    for name, diverges_at in places.items():
        path = paths[name] = folder / f"{count}-{name.rstrip('%')}.mcap"
        if not path.exists():
            write_trace(path, Shape(count, diverges_at, payload_bytes))
    return [(name, paths["same"], path) for name, path in paths.items()]


LAUNCHER = """
import os, sys, time
for _ in range(int(sys.argv[1])):
    start = time.perf_counter()
    process = os.posix_spawn(sys.executable, [sys.executable, *sys.argv[2:]], os.environ,
        file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)])
    _, status, usage = os.wait4(process, 0)
    seconds = time.perf_counter() - start
    cpu = usage.ru_utime + usage.ru_stime
    print(os.waitstatus_to_exitcode(status), seconds, cpu, usage.ru_maxrss / 1024)
"""
"""Starts a command some times. It is small: a process counts the memory of the one it came from."""


def run_diff(a: Path, b: Path) -> tuple[float, float, float]:
    """Return the seconds of ``rsltrace diff`` as a process, its CPU seconds (the best of some
    tries each) and its peak in MB."""
    command = ["-m", "rsltrace", "diff", str(a), str(b)]
    launch = [sys.executable, "-S", "-c", LAUNCHER, str(_TRIES), *command]
    done = subprocess.run(launch, stdout=subprocess.PIPE, text=True, check=True)
    tries = [[float(cell) for cell in row.split()] for row in done.stdout.splitlines()]
    if any(status not in (0, 1) for status, *_ in tries):
        raise SystemExit(f"rsltrace diff {a} {b} failed")
    _, seconds, cpu, peak = zip(*tries, strict=True)
    return min(seconds), min(cpu), max(peak)


def read_linearly(a: Path, b: Path, topics: list[str] | None) -> float:
    """Return the seconds until the mcap package has found a message that differs, or the end."""
    start = time.perf_counter()
    with a.open("rb") as stream_a, b.open("rb") as stream_b:
        messages = [make_reader(stream).iter_messages(topics) for stream in (stream_a, stream_b)]
        for mine, theirs in zip_longest(*messages):
            if mine is None or theirs is None or mine[2].data != theirs[2].data:
                break
    return time.perf_counter() - start


class Linear:
    """Times linear reading, in processes of their own: memory of this one would count as theirs."""

    def __init__(self) -> None:
        self._per_event: dict[str, float] = {}

    def seconds(self, a: Path, b: Path, what: str, events: int) -> tuple[float, bool]:
        """Return the seconds for so many events, and whether they were measured."""
        if events > LINEAR_MAX and what in self._per_event:
            return self._per_event[what] * events, False
        command = [sys.executable, __file__, "--read", what, str(a), str(b)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        self._per_event[what] = float(done.stdout) / events
        return float(done.stdout), True


HEAD = (
    "   events  diverge   diff s   cpu s  peak MB  read kB    of kB"
    "  linear s   ratio  events s   ratio"
)


def measure(count: int, linear: Linear) -> None:
    """Measure one size and print its rows."""
    for name, a, b in sorted(traces(count), key=lambda trace: trace[0]):
        taken, cpu, peak = run_diff(a, b)
        with Trace.open(a) as trace_a, Trace.open(b) as trace_b:
            found = diff_traces(trace_a, trace_b)
            whole = trace_a.size + trace_b.size
        diverges_at = count if name == "same" else int(count * float(name[:-1]) / 100)
        assert found.agreeing == diverges_at, (found.agreeing, diverges_at)
        row = f"{count:>9}  {name:>7}  {taken:>7.3f}  {cpu:>6.3f}  {peak:>7.0f}"
        row += f"  {found.bytes_read / 1e3:>7.0f}  {whole / 1e3:>7.0f}"
        for what in ("all", "events"):
            seconds, measured = linear.seconds(a, b, what, diverges_at)
            text = f"{'' if measured else '~'}{seconds:.2f}"
            row += f"  {text:>8}  {seconds / taken:>6.0f}"
        print(row, flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Time diffs of traces of several sizes.")
    parser.add_argument("--large", action="store_true", help=f"{LARGE} events, too")
    parser.add_argument("--read", nargs=3, metavar=("WHAT", "A", "B"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.read is not None:
        what, a, b = arguments.read
        print(read_linearly(Path(a), Path(b), [TOPIC_EVENTS] if what == "events" else None))
        return
    print(HEAD)
    linear = Linear()
    for count in (*SIZES, *((LARGE,) if arguments.large else ())):
        measure(count, linear)


if __name__ == "__main__":
    main()
