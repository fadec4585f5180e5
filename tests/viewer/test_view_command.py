"""``rsltrace view``: exports, errors, choosing a trace, a real terminal, a browser."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from rsltrace_viewer.model.folder import found_in
from rsltrace_viewer.terminal.choose import ChooseApp

from rsltrace.cli.main import cli
from rsltrace.trace.reader import Trace
from tests.free_port import free_port


def view(*arguments: object) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(cli, ["view", *map(str, arguments)])


@pytest.mark.long
def test_a_screen_as_text_and_as_a_picture(made: Path, tmp_path: Path) -> None:
    text, picture = tmp_path / "screen.txt", tmp_path / "screen.svg"
    assert view(made, "--export", text, "--size", "100x30", "--at", 3).exit_code == 0
    lines = text.read_text().splitlines()
    assert len(lines) == 30
    assert any(line.startswith(">") and "/listener" in line for line in lines)
    assert view(made, "--at", 0, "--export", picture, "--keys", "end d").exit_code == 0
    svg = picture.read_text()
    assert svg.startswith("<svg")
    assert "too&#160;many" in svg
    assert "@font-face" not in svg
    assert "http" not in svg.replace("http://www.w3.org/2000/svg", "").replace(
        "https://www.textualize.io", ""
    )


@pytest.mark.long
def test_pictures_are_reproducible(made: Path, tmp_path: Path) -> None:
    one, other = tmp_path / "one.svg", tmp_path / "other.svg"
    assert view(made, "--export", one).exit_code == 0
    assert view(made, "--export", other).exit_code == 0
    assert one.read_bytes() == other.read_bytes()


def test_starting_somewhere(made: Path, tmp_path: Path) -> None:
    text = tmp_path / "screen.txt"
    assert view(made, "--export", text, "--at", "1s", "--filter", "kind:timer").exit_code == 0
    selected = next(line for line in text.read_text().splitlines() if line.startswith(">  "))
    assert " 1.0" in selected
    assert "timer" in selected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--export", "x.png"], "should end in .svg or .txt"),
        (["--export", "x.txt", "--size", "big"], "is not a size"),
        (["--export", "x.txt", "--at", "soon"], "expected a time"),
        (["--export", "x.txt", "--at", "603"], "no event 603 (events: 0 to 602)"),
        (["--export", "x.txt", "--at", "99s"], "the run ends at 12s"),
        (["--export", "x.txt", "--at", "@99s"], "the run ends at @22s"),
        (["--export", "x.txt", "--keys", "n pgdown"], "no key 'pgdown'; did you mean 'pagedown'?"),
        (["--export", "x.txt", "--keys", "ctrl+foo"], "no key 'ctrl+foo'; keys are named like"),
        (["--keys", "n"], "--keys needs --export"),
        (["--export", "x.txt", "--filter", "kin:3"], "^^^"),
        (["--export", "no/such/folder/x.txt"], "cannot be written"),
        ([], "needs a terminal"),
    ],
)
def test_what_is_wrong_is_said(
    made: Path, arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = view(made, *arguments)
    assert result.exit_code == 2
    assert message in result.output


def test_files_that_cannot_be_opened(made: Path, tmp_path: Path) -> None:
    for path, message in ((tmp_path / "no.mcap", "does not exist"), (tmp_path, "not a bag")):
        result = view(path, "--export", tmp_path / "x.txt")
        assert result.exit_code == 2
        assert message in result.output
    assert "takes more" in view(made, made, made).output
    assert "one trace" in view(made, made, "--follow").output


def test_without_textual_it_says_what_to_install(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "textual" else find(name)
    )
    result = view(made)
    assert result.exit_code == 2
    assert "pip install 'rsltrace[view]'" in result.output


def test_the_traces_of_a_folder(
    made: Path, long: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "the working directory has no trace and no bag" in view().output
    shutil.copy(made, tmp_path / "made.mcap")
    (tmp_path / "sub").mkdir()
    shutil.copy(long, tmp_path / "sub" / "long.mcap")
    (tmp_path / "junk.mcap").write_bytes(b"junk")
    assert "the working directory has" in view().output
    found = found_in(Path())
    assert {str(entry.path) for entry in found} == {"made.mcap", "sub/long.mcap"}
    assert {entry.amount for entry in found} == {"603 events", "30,003 events"}

    async def choose(*keys: str) -> Any:
        app = ChooseApp(found)
        async with app.run_test() as pilot:
            await pilot.press(*keys)
        return app.return_value

    assert asyncio.run(choose("enter")) == [found[0].path]
    assert asyncio.run(choose("j", "k", "down", "enter")) == [found[1].path]
    assert asyncio.run(choose("space", "j", "enter")) == [found[0].path, found[1].path]
    assert asyncio.run(choose("space", "space", "enter")) == [found[0].path]
    assert asyncio.run(choose("q")) is None


@pytest.mark.long
@pytest.mark.skipif(shutil.which("tmux") is None, reason="needs tmux")
def test_in_a_real_terminal(made: Path, tmp_path: Path) -> None:
    server = f"rsltrace-test-{os.getpid()}"

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

    command = f"{sys.executable} -m rsltrace view {made}; echo left with $?; cat"
    tmux("new-session", "-d", "-x", "80", "-y", "24", command)
    try:
        wait_for("made.mcap", "what went wrong", "/talker")
        tmux("send-keys", "Escape")
        wait_for("1/603")
        tmux("send-keys", "j", "Down")
        wait_for("3/603")
        tmux("send-keys", "PPage", "End")
        wait_for("603/603", "ValueError: too many")
        tmux("send-keys", "/", "kind:srv", "Enter")
        wait_for("srv", "/check")
        tmux("resize-window", "-x", "150", "-y", "40")
        with Trace.open(made) as trace:
            wait_for(f"digest {trace.digest}", "13/603")
        assert tmux("display-message", "-p", "#{alternate_on}").strip() == "1"
        tmux("send-keys", "q")
        assert "Traceback" not in wait_for("left with 0")
        assert tmux("display-message", "-p", "#{alternate_on}").strip() == "0"
    finally:
        tmux("kill-server")


@pytest.mark.long
def test_in_a_browser_on_this_machine_only(made: Path) -> None:
    pytest.importorskip("textual_serve")
    port = free_port()
    command = [sys.executable, "-m", "rsltrace", "view", str(made), "--serve", "--port", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        assert server.stderr is not None
        url = re.search(r"http://127[^ ]*", server.stderr.readline())[0]
        for _ in range(6000):
            with suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                break
            time.sleep(0.1)
        asyncio.run(_browse(port, url))
        bound = [line for line in _listening() if f":{port:04X}" in line]
        assert bound
        assert all("0100007F" in line for line in bound)
        second = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
        assert second.returncode != 0
        assert f"port {port} cannot be used" in second.stderr
        asyncio.run(_viewers_end_with(url, server))
    finally:
        server.terminate()
        server.communicate(timeout=600)


async def _browse(port: int, url: str) -> None:
    """Do what the page does: draw what comes through the socket, send keys."""
    import aiohttp

    async with aiohttp.ClientSession() as browser:
        async with browser.get(url) as answer:
            text = await answer.text()
            assert "rsltrace view" in text
            assert "focus()" in text, "keys need no click before"
            policy = answer.headers["Content-Security-Policy"]
            assert "default-src http://127.0.0.1" in policy  # no fonts from elsewhere
        for stranger in ({"Origin": "http://example.org"}, {"Host": "example.org"}):
            async with browser.get(f"{url}ws", headers=stranger) as answer:
                assert answer.status == 403
        async with browser.ws_connect(f"{url}ws?width=100&height=30") as page:
            await _until(page, "/talker")
            await page.send_str(json.dumps(["stdin", "x"]))
            await _until(page, "too many")
            await page.send_str(json.dumps(["stdin", "q"]))
        for path in ("", "ws", "static/", "0" * 32 + "/"):  # of somebody without the token
            async with browser.get(f"http://127.0.0.1:{port}/{path}") as answer:
                assert answer.status == 404


async def _viewers_end_with(url: str, server: subprocess.Popen[str]) -> None:
    import aiohttp

    address = f"{url}ws?width=100&height=30"
    async with aiohttp.ClientSession() as browser, browser.ws_connect(address) as page:
        await _until(page, "/talker")
        viewers = _children(server.pid)
        assert viewers
        server.kill()
        for _ in range(6000):
            if not any(Path(f"/proc/{pid}").exists() for pid in viewers):
                return
            await asyncio.sleep(0.1)
        raise AssertionError("a viewer has outlived its server")


def _children(pid: int) -> list[str]:
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(status.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(status.parent.name)
    return found


async def _until(page: Any, wanted: str) -> None:
    seen = b""
    while wanted.encode() not in seen:
        message = await asyncio.wait_for(page.receive(), 600)
        assert isinstance(message.data, bytes | str), message
        seen += message.data if isinstance(message.data, bytes) else b""


def _listening() -> list[str]:
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    return [line.split()[1] for line in lines if line.split()[3] == "0A"]
