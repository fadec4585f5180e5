"""How quick the terminal viewer is on long traces, as its user sees it through a terminal.

    python benchmarks/view.py [--large] [--keep FOLDER]

Starts ``rsltrace view`` in a pseudo-terminal of 120 x 40 cells and measures from the start of the
process to the first screen (the overview, with the topics), and from a key to the screen that shows
its effect: among the events a step, a page, a jump to the end and back. Prints the first screen as
the best of five starts, with the processor time of a whole short session beside it; of keys the
median and 95th percentile, the best of three rounds; and the most memory used.
``--large`` adds a trace of ten million events (1.5 GB; about two minutes to write).
The export to Rerun is measured by ``rerun_export.py``.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import os
import pty
import re
import select
import struct
import sys
import tempfile
import termios
import time
from pathlib import Path

from synthetic import Shape, write_trace

COLUMNS, ROWS = 120, 40
LARGE = 10_000_000
STARTS = 5
PRESSES = 60
ROUNDS = 3
_TOPICS = re.compile(b"/topic0")
_KEYS = ("step", "page", "end")
_ESCAPES = re.compile(rb"\x1b\[[0-9;?]*[ -/]*[@-~]|\x1b\][^\x07]*\x07|\x1b[()][A-Z0-9]|\x1b[=>78]")


class Terminal:
    """``rsltrace view`` in a pseudo-terminal."""

    def __init__(self, path: Path) -> None:
        self.started = time.perf_counter()
        pid, self._fd = pty.fork()
        if pid == 0:
            os.environ.update(TERM="xterm-256color", COLORTERM="truecolor")
            size = struct.pack("HHHH", ROWS, COLUMNS, 0, 0)
            fcntl.ioctl(0, termios.TIOCSWINSZ, size)
            os.execv(sys.executable, [sys.executable, "-m", "rsltrace", "view", str(path)])
        self.pid = pid

    def wait_for(self, wanted: re.Pattern[bytes], timeout_s: float = 60.0) -> float:
        """Read until ``wanted`` is on the screen; return when that was. Raises TimeoutError."""
        seen = b""
        end = time.perf_counter() + timeout_s
        while time.perf_counter() < end:
            ready, _, _ = select.select([self._fd], [], [], 0.2)
            if not ready:
                continue
            seen += os.read(self._fd, 1 << 16)
            now = time.perf_counter()
            if wanted.search(_ESCAPES.sub(b"", seen)):
                return now
        raise TimeoutError(f"{wanted.pattern!r} did not appear; last: {seen[-500:]!r}")

    def drain(self, quiet_s: float = 0.3) -> None:
        """Read until nothing comes any more."""
        while select.select([self._fd], [], [], quiet_s)[0]:
            os.read(self._fd, 1 << 16)

    def press(self, key: bytes, place: int, count: int) -> float:
        """Press a key and return how many ms it took until row ``place`` is said to be reached."""
        wanted = re.compile(f"{place + 1:,}/{count:,}".encode())
        start = time.perf_counter()
        os.write(self._fd, key)
        return (self.wait_for(wanted, 20.0) - start) * 1000

    def memory_mb(self) -> float:
        """Return the most memory the process has had."""
        text = Path(f"/proc/{self.pid}/status").read_text()
        found = re.search(r"VmHWM:\s+(\d+) kB", text)
        assert found is not None  # Linux always has it
        return int(found[1]) / 1024

    def quit(self) -> float:
        """End the viewer; return the processor time it took."""
        os.write(self._fd, b"q")
        with contextlib.suppress(OSError):  # how a pseudo-terminal says that the other end is gone
            while os.read(self._fd, 1 << 16):
                pass
        _, _, usage = os.wait4(self.pid, 0)
        os.close(self._fd)
        return usage.ru_utime + usage.ru_stime


def measure(path: Path, events: int) -> dict[str, float]:
    """Return seconds to the first screen, percentiles of keys in ms, memory in MB."""
    firsts, processor = [], []
    for _ in range(STARTS):
        terminal = Terminal(path)
        firsts.append(terminal.wait_for(_TOPICS) - terminal.started)
        terminal.drain()
        processor.append(terminal.quit())
    rounds = [_press_keys(path, events) for _ in range(ROUNDS)]
    best = {name: min(one[name] for one in rounds) for name in rounds[0]}
    best["memory"] = max(one["memory"] for one in rounds)
    return best | {"first": min(firsts), "processor": min(processor)}


def _press_keys(path: Path, events: int) -> dict[str, float]:
    terminal = Terminal(path)
    terminal.wait_for(_TOPICS)
    terminal.drain(1.0)
    terminal.press(b"O", 0, events)  # from the overview to the events
    place = 0
    times: dict[str, list[float]] = {name: [] for name in _KEYS}
    for _ in range(PRESSES):
        place += 1
        times["step"].append(terminal.press(b"j", place, events))
        time.sleep(0.03)
    page = _page(terminal, place, events)
    place += page
    for _ in range(PRESSES):
        place += page
        times["page"].append(terminal.press(b"\x1b[6~", place, events))
        time.sleep(0.03)
    for _ in range(PRESSES // 2):
        times["end"].append(terminal.press(b"\x1b[F", events - 1, events))
        time.sleep(0.05)
        times["end"].append(terminal.press(b"\x1b[H", 0, events))
        time.sleep(0.05)
    result = {name: sorted(values)[int(len(values) * 0.95)] for name, values in times.items()}
    result |= {f"{name} p50": sorted(values)[len(values) // 2] for name, values in times.items()}
    result["memory"] = terminal.memory_mb()
    terminal.quit()
    return result


def _page(terminal: Terminal, place: int, events: int) -> int:
    """Return how many rows a page is: what the first press of PgDn goes on by."""
    os.write(terminal._fd, b"\x1b[6~")
    seen = b""
    pattern = re.compile(f"([0-9,]+)/{events:,}".encode())
    while True:
        seen += os.read(terminal._fd, 1 << 16)
        found = pattern.search(_ESCAPES.sub(b"", seen))
        if found and int(found[1].replace(b",", b"")) > place + 2:
            return int(found[1].replace(b",", b"")) - 1 - place


def main() -> None:
    """Write the traces, measure, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--large", action="store_true", help="a trace of 1e7 events, too")
    parser.add_argument("--keep", type=Path, help="folder for the traces, used again next time")
    arguments = parser.parse_args()
    sizes = [10_000, 1_000_000, *([LARGE] if arguments.large else [])]
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        keys = "".join(f"{name:>12}" for name in _KEYS)
        print(f"{'events':>10}  first screen  processor{keys}  memory  (keys: p50/p95)")
        for events in sizes:
            path = folder / f"view_{events}.mcap"
            if not path.exists():
                write_trace(path, Shape(events, payload_bytes=0 if events < LARGE else None))
            found = measure(path, events)
            print(
                f"{events:>10,}  {found['first']:>10.2f} s  {found['processor']:>7.2f} s  "
                + "  ".join(f"{found[f'{n} p50']:>3.0f}/{found[n]:>3.0f} ms" for n in _KEYS)
                + f"  {found['memory']:>3.0f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main()
