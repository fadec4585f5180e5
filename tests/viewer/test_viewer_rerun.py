"""``view --rerun``: the cursor of Rerun's viewer goes where the selection rests; without a viewer
the screen goes on, and nothing is left behind."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

pytest.importorskip("rerun")

from rsltrace_viewer.rerun_export import picture
from rsltrace_viewer.rerun_export.sdk import viewer
from rsltrace_viewer.terminal.app import ViewerApp, open_session
from rsltrace_viewer.terminal.follow import RerunFollower
from rsltrace_viewer.terminal.screenshot import settle, text_of

from rsltrace.cli.main import cli

pytestmark = pytest.mark.skipif(sys.version_info < (3, 11), reason="needs Rerun 0.41")
real = [
    pytest.mark.native,
    pytest.mark.skipif(
        picture.software_driver() is None,
        reason="needs a Vulkan driver (Debian: mesa-vulkan-drivers)",
    ),
]


def until(true: Callable[[], Any], what: str) -> Any:
    """Wait until something is true, and return it."""
    end = time.monotonic() + 600
    while not (found := true()):
        assert time.monotonic() < end, f"no {what}"
        time.sleep(0.05)
    return found


def below(pid: int) -> list[int]:
    """Return all processes below one."""
    found: list[int] = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            if int(place.read_text().rpartition(")")[2].split()[1]) == pid:
                child = int(place.parent.name)
                found += [child, *below(child)]
    return found


class Shown:
    """An app with a follower, and what it has said."""

    def __init__(self, app: ViewerApp, pilot: Any, folder: Path, heard: list[str]) -> None:
        self.app = app
        self.pilot = pilot
        self.folder = folder
        self.heard = heard
        """All that the follower has said: what comes next may be on the screen before one looks."""

    async def press(self, *keys: str) -> None:
        """Press keys."""
        for key in keys:
            await self.pilot.press(key)
        await settle(self.app, self.pilot.pause)

    async def hears(self, text: str) -> None:
        """Wait until the follower has said a text."""
        while not any(text in one for one in self.heard):
            await self.pilot.pause(0.05)

    async def says(self, text: str) -> str:
        """Wait for a text on the screen."""
        end = time.monotonic() + 600
        while text not in (screen := text_of(self.app)):
            assert time.monotonic() < end, screen
            await self.pilot.pause(0.05)
        return screen


@pytest.fixture
def follow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """``follow(script, steps, *traces)`` shows traces, with a shell script for Rerun's viewer."""
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    before = set(below(os.getpid()))

    def go(script: str, steps: Callable[[Shown], Any], *traces: Path) -> None:
        program = tmp_path / "viewer"
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setenv("RERUN_CLI_PATH", str(program))
        session, follower = open_session(*traces), RerunFollower(traces)
        heard: list[str] = []
        start = follower.start

        def listen(say: Callable[[str, bool], None]) -> None:
            start(lambda text, is_over: (heard.append(text), say(text, is_over))[1])

        monkeypatch.setattr(follower, "start", listen)

        async def run_app() -> None:
            app = ViewerApp(session, rerun=follower)
            async with app.run_test(size=(160, 40), notifications=True) as pilot:
                await settle(app, pilot.pause)
                await steps(Shown(app, pilot, tmp_path, heard))

        try:
            asyncio.run(run_app())
        finally:
            follower.close()
            session.close()

    yield go
    until(lambda: not set(below(os.getpid())) - before, "end of all processes")
    assert list((tmp_path / "tmp").iterdir()) == []


@pytest.mark.long
def test_a_viewer_that_does_not_start(follow: Any, made: Path) -> None:
    async def steps(shown: Shown) -> None:
        screen = await shown.says("the selection is no longer followed")
        text = " ".join(screen.split())
        assert "ended with status 3" in text
        assert "no such display" in text
        await shown.press("down", "down")
        assert shown.app.session.place == 2

    follow("echo 'Error: no such display' >&2; exit 3", steps, made)


@pytest.mark.long
def test_one_leaves_before_anything_is_there(follow: Any, long: Path) -> None:
    async def steps(shown: Shown) -> None:
        await shown.hears("making a recording")

    follow("exit 1", steps, long)


def test_how_it_is_called(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    done = CliRunner().invoke(cli, ["view", str(made), "--rerun"])
    assert done.exit_code == 2
    assert "no display" in done.output
    for words in (["--follow"], ["--export", "screen.txt"]):
        done = CliRunner().invoke(cli, ["view", str(made), "--rerun", *words])
        assert done.exit_code == 2
        assert "cannot be combined with --follow or --export" in done.output


class Cursor:
    """Asks a viewer where its cursor is."""

    def __init__(self, folder: Path) -> None:
        from rerun.experimental import ViewerClient

        self.pid, _, port = (folder / "called").read_text().partition(" ")
        self._client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port.strip()}/proxy")

    def comes_to(self, timeline: str, value: int) -> None:
        """Wait until it is somewhere."""

        def there() -> bool:
            with suppress(ConnectionError, RuntimeError):
                (found,) = self._client.get_state().recordings
                return (found.current_timeline, found.current_time) == (timeline, value)
            return False

        until(there, f"cursor at {timeline} {value}")

    def choose(self, timeline: str) -> None:
        """Do what a user does who takes another timeline."""
        self._client.set_time(timeline)


def headless() -> str:
    """Return a script that runs the real viewer without a window, and writes down its port."""
    driver = picture.software_driver()
    return (
        f"export VK_ICD_FILENAMES={driver}\n"
        'echo "$$ $5" > "$0.new"; mv "$0.new" "$(dirname "$0")/called"\n'
        f"exec '{viewer()}' --headless \"$@\""
    )


@pytest.mark.parametrize("count", [pytest.param(n, marks=real, id=f"{n} traces") for n in (1, 2)])
def test_the_cursor_goes_where_the_selection_is(
    follow: Any, made: Path, pair: tuple[Path, Path], count: int
) -> None:
    async def steps(shown: Shown) -> None:
        await shown.says("Rerun follows the selected event")
        session, cursor = shown.app.session, Cursor(shown.folder)

        def follows(timeline: str) -> None:
            here = session.current()
            assert here is not None
            value = session.place if timeline == first else here[0].stamp(here[1])
            cursor.comes_to(timeline, value)

        first, second = "event" if count == 1 else "row", "sim_time"
        follows(first)
        await shown.press("end")
        follows(first)
        await shown.press(*["up"] * 30)
        follows(first)
        cursor.choose(second)
        await shown.press("home", "down")
        follows(second)
        os.kill(int(cursor.pid), signal.SIGTERM)
        text = " ".join((await shown.says("no longer followed")).split())
        assert "Rerun's viewer has ended with status -15" in text
        await shown.press("down")

    follow(headless(), steps, *([made] if count == 1 else pair))


@pytest.mark.parametrize("end", [pytest.param(signal.SIGKILL, marks=real)])
def test_who_is_killed_leaves_no_viewer_behind(
    follow: Any, made: Path, end: signal.Signals
) -> None:
    async def steps(shown: Shown) -> None:
        await shown.says("Rerun follows the selected event")
        follower = shown.app._rerun
        assert follower is not None
        assert follower._process is not None
        viewer_pid = int(Cursor(shown.folder).pid)
        os.kill(follower._process.pid, end)
        await shown.says("no longer followed")
        until(lambda: not Path(f"/proc/{viewer_pid}").exists(), "end of the viewer")
        for left in (shown.folder / "tmp").iterdir():  # nobody was there to do so
            shutil.rmtree(left)

    follow(headless(), steps, made)
