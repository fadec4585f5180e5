"""What it costs to have the events of a trace as an Arrow table, beside the mcap package.

    python benchmarks/tables.py [EVENTS]

Both read the same file, in turn, in one process; the mcap package's messages are taken apart by
``struct`` and put into columns as it gives them. CPU time, the best of three.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path

import pyarrow
from mcap.reader import make_reader
from synthetic import Shape, write_trace

from rsltrace.trace.dtypes import EVENT_DTYPE
from rsltrace.trace.format import CDR_HEADER, EVENT_REST, TOPIC_EVENTS
from rsltrace.trace.reader import Trace

EVENTS = 1_000_000
_TOPIC = "/topic0"


def events(path: Path) -> pyarrow.Table:
    """Return the events by ``Trace.tables``."""
    with Trace.open(path) as trace:
        return trace.tables.events().to_arrow()


def events_by_mcap(path: Path) -> pyarrow.Table:
    """Return the same by the mcap package."""
    columns: list[list[int]] = [[] for _ in EVENT_DTYPE.names]
    unpack, head = EVENT_REST.unpack_from, len(CDR_HEADER)
    with path.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(topics=[TOPIC_EVENTS]):
            data = message.data
            columns[0].append(int.from_bytes(data[head : head + 8], "little"))
            for column, value in zip(columns[1:], unpack(data, head + 8), strict=True):
                column.append(value)
    fields = [(name, pyarrow.from_numpy_dtype(EVENT_DTYPE[name])) for name in EVENT_DTYPE.names]
    arrays = [pyarrow.array(c, t) for c, (_, t) in zip(columns, fields, strict=True)]
    return pyarrow.table(arrays, schema=pyarrow.schema(fields))


def outputs(path: Path) -> pyarrow.Table:
    """Return the outputs."""
    with Trace.open(path) as trace:
        return trace.tables.outputs().to_arrow()


def frame(path: Path) -> object:
    """Return the events for pandas."""
    with Trace.open(path) as trace:
        return trace.tables.events().to_pandas()


def messages(path: Path) -> pyarrow.Table:
    """Return a field of the messages of one topic."""
    with Trace.open(path) as trace:
        return trace.tables.messages(_TOPIC, ["value"]).to_arrow()


def best_of(function: Callable[[Path], object], path: Path, repeat: int) -> float:
    """Return the least CPU time of some runs, in seconds."""
    times = []
    for _ in range(repeat):
        start = time.process_time()
        function(path)
        times.append(time.process_time() - start)
    return min(times)


def main(count: int) -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        writer = get_context("spawn").Process(target=write_trace, args=(path, Shape(count)))
        writer.start()
        writer.join()
        ours, theirs = events(path), events_by_mcap(path)
        assert ours["chain_hash"] == theirs["chain_hash"]
        mcap_s = best_of(events_by_mcap, path, 1)
        rows = (
            ("events, Trace.tables", count, best_of(events, path, 3)),
            ("events, mcap package", count, mcap_s),
            ("events for pandas", count, best_of(frame, path, 3)),
            ("outputs", count, best_of(outputs, path, 3)),
            (f"messages of {_TOPIC}, one field", count // 8, best_of(messages, path, 3)),
        )
        print(f"{'':32} {'rows':>9}   CPU s   rows/s     mcap package / this")
        for name, number, seconds in rows:
            ratio = f"{mcap_s / seconds:.0f}" if name.startswith("events,") else ""
            rate = number / seconds / 1e6
            print(f"{name:32} {number:>9,}  {seconds:>6.2f}   {rate:.2f} M {ratio:>8}".rstrip())


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else EVENTS)
