"""How quick the terminal viewer is on long traces, as its user sees it through a terminal.

    python benchmarks/view.py [--large] [--keep FOLDER]

Starts ``rsltrace view`` in a pseudo-terminal of 120 x 40 cells and measures from the start of the
process to the first screen with events, and from a key to the screen that shows its effect: a
step, a page, a jump to the end and back. Prints the 95th percentiles and the most memory used.
``--large`` adds a trace of ten million events (written once; 1.5 GB, some minutes).
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
import subprocess
import sys
import tempfile
import termios
import time
from pathlib import Path

from rsltrace.model.entity import Entity, EntityKind
from rsltrace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.trace.chain import hash64
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

COLUMNS, ROWS = 120, 40
NODES = 8
PRESSES = 60
_KEYS = ("step", "page", "end")
_ESCAPES = re.compile(rb"\x1b\[[0-9;?]*[ -/]*[@-~]|\x1b\][^\x07]*\x07|\x1b[()][A-Z0-9]|\x1b[=>78]")


def write_trace(path: Path, events: int) -> None:
    """Write a run of ``NODES`` pairs of a timer that publishes and a subscription that receives."""
    with TraceWriter(path, force=True) as writer:
        recorder = Recorder(writer, keep_payload=lambda topic: True)
        timers, publishers, subscriptions, channels = [], [], [], []
        entity_id = 0

        def entity(node: int, kind: EntityKind, name: str, type_: str = "") -> int:
            nonlocal entity_id
            entity_id += 1
            owner = entity_id if node < 0 else node
            recorder.entity(Entity(entity_id, owner, kind, name, type_, 0, {}))
            return entity_id

        for number in range(NODES):
            talker = entity(-1, EntityKind.NODE, f"/talker_{number}")
            timers.append(entity(talker, EntityKind.TIMER, "Talker._on_timer"))
            topic = f"/topic_{number}"
            type_ = "std_msgs/msg/UInt64"
            publishers.append(entity(talker, EntityKind.PUBLISHER, topic, type_))
            listener = entity(-1, EntityKind.NODE, f"/listener_{number}")
            subscriptions.append(entity(listener, EntityKind.SUBSCRIPTION, topic, type_))
            channels.append(writer.add_channel(topic, type_, "uint64 data\n"))
        recorder.end_event(0, EventKind.CONSTRUCT, 0, 0, NO_EVENT, 0, 0)
        head = b"\x00\x01\x00\x00"
        message, timer = int(OutputKind.MESSAGE), int(EventKind.TIMER)
        subscription = int(EventKind.SUBSCRIPTION)
        step = 0
        while recorder.index < events:
            step += 1
            which = step % NODES
            stamp = step * 1_000_000
            data = head + step.to_bytes(8, "little")
            content = hash64(data)
            recorder.message(message, publishers[which], channels[which], stamp, data, content)
            cause = recorder.index
            recorder.end_event(stamp, timer, 0, timers[which], NO_EVENT, 0, step)
            recorder.end_event(stamp, subscription, 0, subscriptions[which], cause, 0, content)
        writer.close(
            result={
                "digest": recorder.digest,
                "start_time": "0",
                "end_time": str(step * 1_000_000),
                "stop_reason": "benchmark",
                "exit_code": "0",
            }
        )


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

    def quit(self) -> None:
        """End the viewer."""
        os.write(self._fd, b"q")
        with contextlib.suppress(OSError):  # how a pseudo-terminal says that the other end is gone
            while os.read(self._fd, 1 << 16):
                pass
        os.waitpid(self.pid, 0)
        os.close(self._fd)


def measure(path: Path, events: int) -> dict[str, float]:
    """Return seconds to the first screen, 95th percentiles of keys in ms, memory in MB."""
    firsts = []
    for _ in range(3):
        terminal = Terminal(path)
        firsts.append(terminal.wait_for(re.compile(b"Talker|_on_timer")) - terminal.started)
        terminal.drain()
        terminal.quit()
    terminal = Terminal(path)
    terminal.wait_for(re.compile(b"_on_timer"))
    terminal.drain(1.0)
    place = 0
    times: dict[str, list[float]] = {"step": [], "page": [], "end": []}
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
    for _ in range(PRESSES // 4):
        times["end"].append(terminal.press(b"\x1b[F", events - 1, events))
        time.sleep(0.05)
        times["end"].append(terminal.press(b"\x1b[H", 0, events))
        time.sleep(0.05)
    result = {name: sorted(values)[int(len(values) * 0.95)] for name, values in times.items()}
    result |= {f"{name} p50": sorted(values)[len(values) // 2] for name, values in times.items()}
    result["memory"] = terminal.memory_mb()
    terminal.quit()
    result["first"] = sorted(firsts)[1]
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
    sizes = [10_000, 1_000_000, *([10_000_000] if arguments.large else [])]
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        print(f"{'events':>10}  first screen       step       page        end  memory  (p50/p95)")
        for events in sizes:
            path = folder / f"view_{events}.mcap"
            if not path.exists():
                write_trace(path, events)
            count = _events_in(path)
            found = measure(path, count)
            print(
                f"{count:>10,}  {found['first']:>10.2f} s  "
                + "  ".join(f"{found[f'{n} p50']:>3.0f}/{found[n]:>3.0f} ms" for n in _KEYS)
                + f"  {found['memory']:>3.0f} MB",
                flush=True,
            )


def _events_in(path: Path) -> int:
    command = [sys.executable, "-m", "rsltrace", "info", "--json", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = re.search(r'"events": (\d+)', done.stdout)
    assert found is not None  # `rsltrace info` counts them
    return int(found[1])


if __name__ == "__main__":
    main()
