"""``view --live``: selecting an event executes it; what is shown is what a session says of it."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace_viewer.live.app import BreakpointsPanel, LiveApp
from rsltrace_viewer.live.execution import Execution, LiveSession
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.events import node_of
from rsltrace_viewer.terminal.keys import KEYS, LIVE_KEYS
from rsltrace_viewer.terminal.screenshot import settle, text_of
from rsltrace_viewer.terminal.widgets.source import SourceView

from rsltrace import DebugSession
from rsltrace.cli.main import cli
from rsltrace.errors import DebugError
from rsltrace.job import load_job
from rsltrace.run import run as run_job

pytestmark = pytest.mark.ros

NODES = """
from rclpy.node import Node
from std_msgs.msg import Float64

class Source(Node):
    def __init__(self):
        super().__init__('source')
        self.count = 0
        self.out = self.create_publisher(Float64, 'speed', 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.count += 1
        self.out.publish(Float64(data=1.5 * self.count))

class Filter(Node):
    def __init__(self):
        super().__init__('filter')
        self.state = 0.0
        self.create_subscription(Float64, 'speed', self.got, 10)

    def got(self, message):
        self.state = 0.75 * self.state + 0.125 * message.data
        if self.state > 3:
            self.alarm = True
"""
JOB = "nodes: [{node: live_nodes:Source}, {node: live_nodes:Filter}]\nstop: {duration: 3s}\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job, its nodes and its trace."""
    place = tmp_path_factory.mktemp("live")
    (place / "live_nodes.py").write_text(NODES)
    (place / "job.yaml").write_text(JOB)
    run_job(load_job(place / "job.yaml"), place / "run.mcap")
    return place


class Live:
    """A live app without a terminal."""

    def __init__(self, app: LiveApp, pilot: Any) -> None:
        self.app = app
        self.pilot = pilot

    async def press(self, *keys: str) -> None:
        """Press keys, each after the one before has had its effect."""
        for key in keys:
            await self.pilot.press(key)
            await settle(self.app, self.pilot.pause)

    async def answer(self, key: str, text: str) -> None:
        """Press a key that asks, and answer."""
        await self.press(key)
        assert self.app.prompt.asking
        self.app.prompt.query_one("#answer").value = text
        await self.press("enter")

    @property
    def text(self) -> str:
        """The screen."""
        return text_of(self.app)

    @property
    def here(self) -> Any:
        """What was executed."""
        assert self.app.session.here is not None
        return self.app.session.here

    @property
    def said(self) -> str:
        """All notifications."""
        return " ".join(one.message for one in self.app._notifications)


Steps = Callable[[Live], Awaitable[None]]


@pytest.fixture(scope="module")
def debugged(folder: Path) -> Iterator[DebugSession]:
    """A session that all tests of the screen drive, one after the other."""
    with DebugSession(folder / "run.mcap", job_folder=folder) as session:
        yield session


@pytest.fixture
def live(folder: Path, debugged: DebugSession) -> Iterator[Callable[..., None]]:
    """``live(steps, size=…)`` runs the app and ``async def steps(live)``."""
    run = Run.open(folder / "run.mcap")

    def go(steps: Steps, size: tuple[int, int] = (120, 40), **options: Any) -> None:
        async def run_app() -> None:
            app = LiveApp(LiveSession(run), Execution(debugged, run), **options)
            async with app.run_test(size=size, notifications=True) as pilot:
                shown = Live(app, pilot)
                await settle(app, pilot.pause)
                await steps(shown)

        asyncio.run(run_app())

    yield go
    for one in debugged.breakpoints:
        debugged.clear(one.number)
    run.close()


def test_stepping_executes_and_shows_what_changed(live: Any, folder: Path) -> None:
    seen: dict[int, Any] = {}

    async def steps(viewer: Live) -> None:
        assert viewer.here.index == 0
        for key in ["down"] * 5 + ["up"] * 2 + ["end", "home", "pagedown", "]", "["]:
            await viewer.press(
                {"]": "right_square_bracket", "[": "left_square_bracket"}.get(key, key)
            )
            index = viewer.app.session.current()[1]
            assert viewer.here.index == index
            assert seen.setdefault(index, viewer.here) == viewer.here
        index = next(i for i, one in seen.items() if one.changed == ("count",))
        await viewer.press("home", *["down"] * index)
        one = seen[index]
        assert f"count {one.before['count']} → {one.after['count']}" in viewer.text
        assert "self.count += 1" in viewer.text
        assert "live_nodes.py:" in viewer.text

    live(steps)
    assert len(seen) > 7
    with DebugSession(folder / "run.mcap", job_folder=folder) as session:
        run = Run.open(folder / "run.mcap")
        for index, one in seen.items():
            node = node_of(run, run.event(index))
            assert one.node == node
            session.go_to(index + 1)
            try:
                told = session.node(node)
            except DebugError:  # it was destroyed
                told = {}
            assert one.after == {k: re.sub(" at 0x[0-9a-f]+>", ">", v) for k, v in told.items()}
        run.close()


@pytest.mark.long
def test_what_a_fast_hand_skips_is_not_shown_for_another_event(live: Any) -> None:
    async def steps(viewer: Live) -> None:
        for _ in range(15):
            await viewer.pilot.press("down")
        await viewer.press("down", "up")
        assert viewer.here.index == 15
        assert viewer.app.session.place == 15

    live(steps)


@pytest.mark.long
def test_breakpoints_stop_the_run_forwards_and_back(live: Any) -> None:
    async def steps(viewer: Live) -> None:
        panel = viewer.app.query_one(BreakpointsPanel)
        assert "none: B sets one" in viewer.text
        await viewer.answer("B", "watch filter.alarm")
        assert "● 1  watch filter.alarm" in viewer.text
        await viewer.press("full_stop")
        assert set(viewer.here.changed) == {"alarm", "state"}
        assert float(viewer.here.after["state"]) > 3 >= float(viewer.here.before["state"])
        assert "▶ 1  watch filter.alarm" in viewer.text
        assert "breakpoint 1: watch filter.alarm" in viewer.text
        alarm = viewer.here.index
        await viewer.answer("B", "/speed: data == 3.0")
        await viewer.press("comma")
        second = viewer.here.index
        assert second < alarm
        assert "▶ 2  /speed: data == 3.0" in viewer.text
        await viewer.press("comma")
        assert viewer.here.index < second
        for _ in range(6):
            await viewer.press("full_stop")
            if "▶ 1" in viewer.text:
                break
        assert viewer.here.index == alarm
        await viewer.press("full_stop")
        assert viewer.here.index == viewer.app.session.view.count - 1
        await viewer.press("down", "D")
        await viewer.press("enter")
        assert "● 1" not in viewer.text
        await viewer.press("D")
        assert "none: B sets one" in viewer.text
        assert panel.size.height >= 1

    live(steps)


@pytest.mark.long
def test_questions_to_the_run(live: Any) -> None:
    async def steps(viewer: Live) -> None:
        await viewer.press("end")
        while "state" not in viewer.here.after:
            await viewer.press("up")
        end = viewer.here.index
        await viewer.answer("V", "state * 2")
        assert f"state * 2 = {2 * float(viewer.here.after['state'])}" in viewer.text
        await viewer.answer("V", "stat +")
        assert "stat + = " in viewer.text
        await viewer.answer("V", "")
        assert "state * 2" not in viewer.text
        await viewer.answer("C", "alarm")
        alarm = viewer.here.index
        assert alarm < end
        assert "alarm" in viewer.here.changed
        await viewer.press("end")
        await viewer.answer("T", 'when node("filter").state > 1')
        assert float(viewer.here.after["state"]) > 1 >= float(viewer.here.before["state"])

    live(steps)


@pytest.mark.long
def test_what_is_wrong_is_said_and_the_run_goes_on(live: Any) -> None:
    async def steps(viewer: Live) -> None:
        await viewer.press("down", "down")
        await viewer.answer("B", "/sped: data > 1")
        assert "/sped" in viewer.said
        assert "none: B sets one" in viewer.text
        await viewer.answer("C", "nothing_of_the_kind")
        assert "nothing_of_the_kind" in viewer.said
        await viewer.press("down")
        assert viewer.here.index == 3
        await viewer.press("D")
        assert "there is no breakpoint" in viewer.text

    live(steps)


@pytest.mark.long
def test_panes_and_help(live: Any) -> None:
    async def steps(viewer: Live) -> None:
        await viewer.press("down")
        for _ in range(2):
            await viewer.press("tab")
        assert isinstance(viewer.app.focused, SourceView)
        await viewer.press("z")
        assert not viewer.app.timeline.display
        assert "def " in viewer.text
        await viewer.press("z", "escape", "question_mark")
        for key in (*KEYS, *LIVE_KEYS):
            assert key.two or key.help[:50] in viewer.text, key

    live(steps, size=(140, 70))


@pytest.mark.long
@pytest.mark.parametrize("size", [(80, 24), (40, 10)])
def test_any_size(live: Any, size: tuple[int, int]) -> None:
    async def steps(viewer: Live) -> None:
        await viewer.press("down", "down", "B", "escape")
        assert viewer.here.index == 2
        lines = viewer.text.splitlines()
        assert len(lines) == size[1]
        assert any(line.startswith(">") for line in lines)
        if size == (80, 24):
            assert "self" in viewer.text
            assert "state of /" in viewer.text

    live(steps, size=size)


@pytest.mark.long
def test_a_run_that_is_not_the_recorded_one(folder: Path, tmp_path: Path) -> None:
    for name in ("job.yaml", "run.mcap"):
        shutil.copy(folder / name, tmp_path)
    changed = NODES.replace("1.5 * self.count", "1.5 * self.count + (self.count > 4)")
    (tmp_path / "live_nodes.py").write_text(changed)
    screen = tmp_path / "screen.txt"
    words = ["view", str(tmp_path / "run.mcap"), "--live", "--job-folder", str(tmp_path)]
    done = CliRunner().invoke(cli, [*words, "--export", str(screen), "--at", "2s"])
    assert done.exit_code == 0, done.output
    text = " ".join(screen.read_text().split())
    assert "diverged" in text
    assert "state of" not in text


@pytest.mark.long
def test_what_is_not_trusted_does_not_run(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("job.yaml", "run.mcap"):
        shutil.copy(folder / name, tmp_path)
    marker = tmp_path / "ran"
    (tmp_path / "live_nodes.py").write_text(f"open({str(marker)!r}, 'w').close()\n{NODES}")
    (tmp_path / "above").mkdir()
    monkeypatch.chdir(tmp_path / "above")
    words = ["view", "../run.mcap", "--live", "--export", "screen.txt"]
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 2
    assert "would run code" in done.output
    assert "use --trust if" in done.output
    assert not marker.exists()
    assert CliRunner().invoke(cli, [*words, "--trust"]).exit_code == 0
    assert marker.exists()


@pytest.mark.long
def test_how_it_is_called(folder: Path) -> None:
    trace = str(folder / "run.mcap")
    for words in ([trace, trace, "--live"], ["--live"], [trace, "--live", "--follow"]):
        done = CliRunner().invoke(cli, ["view", *words])
        assert done.exit_code == 2
        assert "--live needs one trace" in done.output
    done = CliRunner().invoke(cli, ["view", trace, "--trust"])
    assert "need --live" in done.output


@pytest.mark.long
@pytest.mark.skipif(shutil.which("tmux") is None, reason="needs tmux")
def test_in_a_real_terminal(folder: Path) -> None:
    server = f"rsltrace-live-{os.getpid()}"

    def tmux(*arguments: str) -> str:
        command = ["tmux", "-L", server, "-f", "/dev/null", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    def wait_for(*wanted: str) -> str:
        end = time.monotonic() + 600
        screen = ""
        while time.monotonic() < end:
            screen = tmux("capture-pane", "-p")
            if all(part in screen for part in wanted):
                return screen
            time.sleep(0.1)
        raise AssertionError(f"{wanted} did not come up:\n{screen}")

    program = f"cd {folder}; {sys.executable} -m rsltrace view run.mcap --live"
    tmux("new-session", "-d", "-x", "120", "-y", "40", f"{program}; echo left with $?; cat")
    try:
        wait_for("state of /source")
        viewer = _children(int(tmux("display-message", "-p", "#{pane_pid}")))
        tmux("send-keys", "B", "watch filter.alarm", "Enter")
        wait_for("● 1  watch filter.alarm")
        tmux("send-keys", ".")
        wait_for("▶ 1  watch filter.alarm", "alarm", "def got(self, message):")
        tmux("send-keys", "Up")
        wait_for("● 1  watch filter.alarm", "def tick(self):")
        tmux("resize-window", "-x", "80", "-y", "24")
        wait_for("state of /source", "self.count += 1")
        tmux("send-keys", "q")
        assert "Traceback" not in wait_for("left with 0")
        assert viewer
        _wait_until_gone(viewer)
    finally:
        tmux("kill-server")


@pytest.mark.long
def test_a_viewer_that_is_killed_leaves_nothing(folder: Path) -> None:
    code = (
        "import sys, time\nfrom rsltrace import DebugSession\n"
        "with DebugSession('run.mcap') as s:\n    s.go_to(20)\n    print('there', flush=True)\n"
        "    time.sleep(600)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=folder, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "there\n"
    below = _children(process.pid)
    assert below
    process.kill()
    process.communicate(timeout=600)
    _wait_until_gone(below)


def _children(pid: int) -> list[int]:
    """Return all processes below one."""
    found: list[int] = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            if int(place.read_text().rpartition(")")[2].split()[1]) == pid:
                child = int(place.parent.name)
                found += [child, *_children(child)]
    return found


def _wait_until_gone(pids: list[int]) -> None:
    end = time.monotonic() + 300
    while left := [pid for pid in pids if Path(f"/proc/{pid}").exists()]:
        assert time.monotonic() < end, f"{left} are left behind"
        time.sleep(0.1)
