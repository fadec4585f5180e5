"""What a diff of two traces of 1 GB fetches from a web server: requests, bytes, seconds.

    python benchmarks/diff_remote.py     (9 GB of files, kept in the temporary folder; minutes)

The server is on this machine and counts. Three kinds of traces, which diverge at 10, 50 and 99 %:
"small" messages (1e7 events, their index is the most there is to fetch), "large" ones (2e5 events
with messages of 5 kB, which do not compress), and "cut" the large ones compared with a trace whose
segments end elsewhere, so that each step of the search has to fetch a segment.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from synthetic import Shape, write_trace

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.range_server import RangeServer

PLACES = (0.10, 0.50, 0.99)
KINDS = {
    "small": (Shape(8_000_000), 4096),
    "large": (Shape(200_000, payload_bytes=5000), 4096),
    "cut": (Shape(200_000, payload_bytes=5000), 1000),
}
_VERSION = 2


def measure(server: RangeServer, kind: str, place: str, a: Path, b: Path) -> None:
    """Diff two served traces and print a row."""
    server.requests.clear()
    server.sent = 0
    addresses = [f"{server.address}/{path.name}" for path in (a, b)]
    start = time.perf_counter()
    command = [sys.executable, "-m", "rsltrace", "diff", *addresses]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    taken = time.perf_counter() - start
    if done.returncode != (0 if place == "same" else 1):
        raise SystemExit(f"{' '.join(command)} failed")
    whole = (a.stat().st_size + b.stat().st_size) / 1e6
    row = f"{kind:>6}  {place:>7}  {whole:>8.0f}  {len(server.requests):>8}"
    print(f"{row}  {server.sent / 1e6:>7.2f}  {taken:>6.2f}", flush=True)


def main() -> None:
    """Measure and print."""
    folder = Path(tempfile.gettempdir()) / f"rsltrace-benchmark-diff-remote-{_VERSION}"
    folder.mkdir(exist_ok=True)
    server = RangeServer(folder)
    print("  kind  diverge  MB whole  requests  MB sent       s")
    for kind, (shape, segment) in KINDS.items():
        a = folder / f"{kind}-a.mcap"
        if not a.exists():
            write_trace(a, shape)
        for place in (None, *PLACES):
            name = "same" if place is None else f"{place:.0%}"
            b = folder / f"{kind}-{name.rstrip('%')}.mcap"
            if not b.exists():
                diverges_at = None if place is None else int(shape.events * place)
                write_trace(b, Shape(shape.events, diverges_at, shape.payload_bytes, segment))
            measure(server, kind, name, a, b)
    server.close()


if __name__ == "__main__":
    if shutil.disk_usage(tempfile.gettempdir()).free < 15e9:
        raise SystemExit("the temporary folder has no room for 9 GB of traces")
    main()
