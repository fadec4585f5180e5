"""A callback that does not return is named; a debugger that stands still is left alone."""

from __future__ import annotations

import importlib
import os
import re
import signal
import subprocess
import sys
import time
from _thread import allocate_lock
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rclpy.node import Node
from std_msgs.msg import UInt8

import rsltrace
from rsltrace.run import RunCallbacks, run, watchdog
from rsltrace.simulation.loop.stop import Stop
from tests.guard.conftest import list_as_wheel

pytestmark = pytest.mark.ros

TURNS_MAX = 300_000_000
"""A busy loop that the watchdog does not end fails after so many turns instead of hanging."""


class Looks:
    """Stands in for the lock that the watchdog waits for: it looks when it is told to."""

    def __init__(self) -> None:
        self._turn = allocate_lock()
        self._turn.acquire()
        self._over = False
        self._arrivals = 0

    def acquire(self, timeout: float | None = None) -> bool:
        if timeout is not None:
            self._arrivals += 1
            self._turn.acquire()
        return self._over

    def release(self) -> None:
        self._over = True
        self._turn.release()

    def __call__(self, count: int) -> None:
        """Keep the calling code busy until the watchdog has looked ``count`` times."""
        for _ in range(count):
            arrivals = self._arrivals
            self._turn.release()
            for _ in range(TURNS_MAX):
                if self._arrivals != arrivals:
                    break
            else:
                raise AssertionError("the watchdog does not look")


@pytest.fixture
def busy(monkeypatch: pytest.MonkeyPatch) -> Looks:
    """Keeps whoever calls it busy for so many looks of the watchdog."""
    looks = Looks()
    real = watchdog.Watchdog.__init__

    def init(self: Any, *given: Any) -> None:
        real(self, *given)
        self._stopping = looks

    monkeypatch.setattr(watchdog.Watchdog, "__init__", init)
    return looks


def record(callback: Callable[[int], None], path: Path, **options: Any) -> rsltrace.RunResult:
    """Record a node whose timer calls ``callback(1)``, ``callback(2)``, … every second."""

    class Busy(Node):
        def __init__(self) -> None:
            super().__init__("busy")
            self.create_timer(1.0, self.tick)
            self.count = 0

        def tick(self) -> None:
            self.count += 1
            callback(self.count)

    stop = rsltrace.StopSpec(duration="20s")
    job = rsltrace.Job(nodes=[rsltrace.NodeSpec(node=Busy)], stop=stop, **options)
    return rsltrace.record(job, path, force=True)


@pytest.mark.few(1)
@pytest.mark.parametrize("guard", [True, False])
def test_a_busy_loop_is_named_with_its_line(
    busy: Looks, tmp_path: Path, capsys: pytest.CaptureFixture[str], guard: bool
) -> None:
    def spin_wheels(count: int) -> None:
        busy(9 if count == 2 else 4)  # four looks in every other event are no reason for a note

    record(spin_wheels, tmp_path / "a.mcap", guard=guard)
    said = capsys.readouterr().err
    assert said.count("rsltrace: note:") == 1, said
    assert "/busy: timer" in said
    assert "Busy.tick has not returned for 10 s of real time" in said
    assert "stands still at 2.000000000 s" in said
    lines = Path(__file__).read_text().splitlines()
    first = next(n for n, line in enumerate(lines, 1) if "def __call__" in line)
    places = [f"{__file__}:{n} in __call__" for n in range(first, first + 11)]
    assert any(place in said for place in places), said


def test_a_busy_subscription_is_named(
    busy: Looks, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Busy(Node):
        def __init__(self) -> None:
            super().__init__("busy")
            publisher = self.create_publisher(UInt8, "/numbers", 1)
            self.create_subscription(UInt8, "/numbers", lambda _: busy(9), 1)
            self.create_timer(1.0, lambda: publisher.publish(UInt8()))

    stop = rsltrace.StopSpec(duration="1500ms")
    job = rsltrace.Job(nodes=[rsltrace.NodeSpec(node=Busy)], stop=stop)
    rsltrace.record(job, tmp_path / "a.mcap")
    assert "/busy: subscription /numbers" in capsys.readouterr().err


LIBRARY = """
import sys
looks = sys.modules["looks_of_this_test"].looks
for _ in range(9):
    arrivals = looks._arrivals
    looks._turn.release()
    while looks._arrivals == arrivals:
        pass
"""


@pytest.mark.long
@pytest.mark.parametrize("name", ["torchvision", "my_own_package"])
def test_the_import_of_a_library_may_take_its_time(
    busy: Looks,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
) -> None:
    folder = tmp_path / ("src" if name == "my_own_package" else "site-packages")
    folder.mkdir()
    (folder / f"{name}.py").write_text(LIBRARY)
    if folder.name == "site-packages":
        list_as_wheel(folder, name)
    monkeypatch.syspath_prepend(str(folder))
    here = ModuleType("looks_of_this_test")
    here.looks = busy  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, here.__name__, here)
    monkeypatch.delitem(sys.modules, name, raising=False)

    def import_it(count: int) -> None:
        if count == 2:
            importlib.import_module(name)

    record(import_it, tmp_path / "a.mcap")
    said = capsys.readouterr().err
    assert said.count("rsltrace: note:") == (name == "my_own_package"), said


@pytest.mark.long
def test_there_is_at_most_one_note_in_a_minute(
    busy: Looks, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(lambda count: busy(68 if count == 1 else 6), tmp_path / "a.mcap")
    said = capsys.readouterr().err
    assert re.findall(r"returned for (\d+) s .* at (\d+)", said) == [
        ("10", "1"),
        ("70", "1"),
        ("130", "1"),
        ("10", "6"),
        ("10", "11"),
        ("10", "16"),
    ]


@pytest.mark.long
def test_the_trace_is_that_of_a_run_without_a_busy_loop(busy: Looks, tmp_path: Path) -> None:
    slow = record(lambda count: busy(6), tmp_path / "a.mcap")
    busy._over = False
    assert record(lambda count: None, tmp_path / "b.mcap").digest == slow.digest
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


@pytest.mark.long
def test_a_simulation_that_its_driver_leaves_standing_is_no_alarm(
    busy: Looks, capsys: pytest.CaptureFixture[str]
) -> None:
    class Quiet(Node):
        def __init__(self) -> None:
            super().__init__("quiet")
            self.create_timer(1.0, lambda: busy(6))

    stop = rsltrace.StopSpec(duration="3s")
    with rsltrace.Simulation(rsltrace.Job(nodes=[rsltrace.NodeSpec(node=Quiet)], stop=stop)) as sim:
        sim.run_for(0.5)
        busy(20)
        assert capsys.readouterr().err == ""
        sim.run_for(1.0)
        assert "/quiet: timer" in capsys.readouterr().err, "within the run it is one"


@pytest.mark.long
@pytest.mark.parametrize(("told_of", "went_on"), [(True, []), (False, [1, 2, 3])])
def test_one_interrupt_ends_what_was_told_of(
    busy: Looks, tmp_path: Path, told_of: bool, went_on: list[int]
) -> None:
    ends: list[Callable[[Stop], None]] = []
    seen: list[int] = []

    class Busy(Node):
        def __init__(self) -> None:
            super().__init__("busy")
            self.count = 0
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            self.count += 1
            busy(9 if self.count < 3 else 2)  # the first two are told of, the third is not
            if told_of or self.count == 3:
                ends[0](Stop("interrupted", 130))  # as the command's signal handler does
            seen.append(self.count)

    stop = rsltrace.StopSpec(duration="20s")
    job = rsltrace.Job(nodes=[rsltrace.NodeSpec(node=Busy)], stop=stop)
    result = run(job, tmp_path / "a.mcap", observer=RunCallbacks(interrupt=ends.append))
    assert (result.exit_code, result.stop_reason) == (130, "interrupted")
    assert seen == went_on


def test_a_callback_that_is_over_is_not_interrupted(busy: Looks, tmp_path: Path) -> None:
    """A traceback takes seconds to write down, if a recursion was very deep."""
    ends: list[Callable[[Stop], None]] = []

    class Lengthy(KeyboardInterrupt):
        @property
        def __cause__(self) -> None:  # type: ignore[override]
            busy(6)

    class Raises(Node):
        def __init__(self) -> None:
            super().__init__("raises")
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            ends[0](Stop("interrupted", 130))  # as the command's signal handler does
            raise Lengthy

    job = rsltrace.Job(nodes=[rsltrace.NodeSpec(node=Raises)])
    result = run(job, tmp_path / "a.mcap", observer=RunCallbacks(interrupt=ends.append))
    assert result.exit_code == 130
    with rsltrace.Trace.open(tmp_path / "a.mcap") as trace:
        assert trace.complete
        assert trace.event(1).flags.name == "RAISED"


@pytest.mark.long
def test_a_debugger_is_no_alarm(
    busy: Looks, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names: dict[str, Any] = {"busy": busy}
    exec(compile("def interaction(): busy(20)", "/usr/lib/python3/pdb.py", "exec"), names)
    record(lambda count: names["interaction"](), tmp_path / "a.mcap")
    assert capsys.readouterr().err == ""


@pytest.mark.long
def test_it_is_gone_after_the_run(tmp_path: Path) -> None:
    def threads() -> set[str]:
        return set(os.listdir("/proc/self/task"))

    seen: list[set[str]] = []

    class Look(Node):
        def __init__(self) -> None:
            super().__init__("look")
            seen.append(threads())

    stop = rsltrace.StopSpec(duration="1s")
    job = rsltrace.Job(nodes=[rsltrace.NodeSpec(node=Look)], stop=stop)
    rsltrace.record(job, tmp_path / "a.mcap")  # loads what starts threads of its own
    before = threads()
    rsltrace.record(job, tmp_path / "a.mcap", force=True)
    assert len(seen[-1] - before) == 1
    deadline = time.monotonic() + 600
    while threads() - before and time.monotonic() < deadline:
        time.sleep(0.01)  # the system takes a moment to clear a thread away that has ended
    assert threads() <= before


@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "at_once", "later"),
    [(signal.SIGINT, 1, 1), (signal.SIGTERM, 1, 0), (signal.SIGTERM, 2, 0)],  # 2: as timeout does
)
def test_signals_end_a_busy_loop_with_a_whole_trace(
    tmp_path: Path, number: signal.Signals, at_once: int, later: int
) -> None:
    patience = "10**9" if later else "watchdog._LOOKS_BEFORE_END"  # or the second comes too late
    (tmp_path / "busy_node.py").write_text(
        "from rclpy.node import Node\n"
        "from rsltrace.run import watchdog\n"
        f"watchdog._LOOKS_BEFORE_END = {patience}\n"
        "class Busy(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('busy')\n"
        "        self.create_timer(1.0, self.tick)\n"
        "    def tick(self):\n"
        "        open('reached', 'w').close()\n"
        "        while True:\n"
        "            pass\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'busy_node:Busy'}]\nstop: {duration: 3s}\n")
    command = [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", "run.mcap"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and not (tmp_path / "reached").exists():
            time.sleep(0.05)
        for _ in range(at_once):
            process.send_signal(number)
        assert process.stderr is not None
        said = []
        for line in process.stderr:
            said.append(line)
            if "repeat to force" in line and later:
                process.send_signal(number)
    assert later or any(re.search(r"Busy.tick has not .* now at .*busy_node.py", s) for s in said)
    assert process.returncode == 128 + number
    with rsltrace.Trace.open(tmp_path / "run.mcap") as trace:
        assert trace.complete
        assert trace.event(1).flags.name == "RAISED"
