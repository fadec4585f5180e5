"""``rsltrace rerun``: what it writes, where it opens, what it says when it cannot."""

from __future__ import annotations

import importlib.metadata
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import trace_maker
from click.testing import CliRunner, Result

from rsltrace.cli.main import cli

pytest.importorskip("rerun")

from rsltrace_viewer.rerun_export import show


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    trace_maker.write_run(tmp_path / "run.mcap", 20)
    return tmp_path / "run.mcap"


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, ["rerun", *map(str, arguments)])


def test_it_writes_a_recording_and_says_so(trace: Path) -> None:
    output = trace.with_suffix(".rrd")
    result = run(trace, "-o", output)
    assert result.exit_code == 0, result.output
    assert result.output.startswith(f"wrote {output}: 2")
    assert output.stat().st_size > 0
    assert run(trace, "-o", output).exit_code == 2
    quiet = run(trace, "-o", output, "--force", "-q")
    assert (quiet.exit_code, quiet.output) == (0, "")


def test_without_a_display_it_says_what_to_do(trace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    for arguments in ((trace,), (trace, "--spawn")):
        result = run(*arguments)
        assert result.exit_code == 2
        assert "-o run.rrd" in result.output
        assert "--web" in result.output


@pytest.mark.parametrize(
    ("environ", "platform", "found"),
    [
        ({}, "linux", False),
        ({"DISPLAY": ""}, "linux", False),
        ({"DISPLAY": ":0"}, "linux", True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True),
        ({}, "darwin", True),
    ],
)
def test_a_display_is_known_when_there_is_one(
    environ: dict[str, str], platform: str, found: bool
) -> None:
    assert show.has_display(environ, platform) is found


@pytest.mark.parametrize("ports", [None, (9001, 9002)])
def test_a_viewer_is_bound_to_this_machine_only(ports: tuple[int, int] | None) -> None:
    line = show.command(Path("run.rrd"), ports)
    assert line[line.index("--bind") + 1] == "127.0.0.1"
    assert ("--web-viewer" in line) is (ports is not None)


@pytest.mark.long
def test_a_web_viewer_says_at_which_address_it_is(trace: Path) -> None:
    """Before it blocks: the page is there, and so is the recording that the address names."""
    command = [sys.executable, "-m", "rsltrace", "rerun", str(trace), "--web"]
    environ = {**os.environ, "BROWSER": "true"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environ, start_new_session=True
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.match(r"open (http://127\.0\.0\.1:\d+/\?url=(\S+)) in a browser", line)
            assert found is not None
            with urllib.request.urlopen(found[1], timeout=600) as page:
                assert page.status == 200
                assert b"<html" in page.read().lower()
            data = urllib.parse.urlsplit(urllib.parse.unquote(found[2]))
            assert (data.scheme, data.path) == ("rerun+http", "/proxy")
            socket.create_connection((str(data.hostname), int(data.port or 0)), timeout=600).close()
        finally:
            os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C does, to the viewer as well
            process.wait(600)


def test_what_is_opened_is_a_temporary_recording(
    trace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[tuple[Path, show.How, int]] = []

    def remember(path: Path, how: show.How) -> None:
        opened.append((path, how, path.stat().st_size))

    monkeypatch.setattr(show, "open_viewer", remember)
    assert run(trace, "--web").exit_code == 0
    ((path, how, size),) = opened
    assert how is show.How.BROWSER
    assert size > 0
    assert not path.exists()


def test_a_viewer_that_fails_is_an_error(monkeypatch: pytest.MonkeyPatch, trace: Path) -> None:
    monkeypatch.setattr(show, "command", lambda *_: [sys.executable, "-c", "raise SystemExit(7)"])
    result = run(trace, "--web")
    assert result.exit_code == 2
    assert "ended with status 7" in result.output


def test_window_and_browser_exclude_each_other(trace: Path) -> None:
    result = run(trace, "--web", "--spawn")
    assert result.exit_code == 2
    assert "not both" in result.output


@pytest.mark.parametrize("version", [None, "0.30.0"])
def test_without_rerun_it_says_how_to_install_it(
    trace: Path, monkeypatch: pytest.MonkeyPatch, version: str | None
) -> None:
    def find(name: str) -> str:
        if version is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return version

    monkeypatch.setattr(importlib.metadata, "version", find)
    result = run(trace, "-o", trace.with_suffix(".rrd"))
    assert result.exit_code == 2
    assert "pip install 'rsltrace[rerun]'" in result.output
    assert not trace.with_suffix(".rrd").exists()


def test_a_file_that_is_no_trace_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"no trace at all, but long enough to look at")
    result = run(tmp_path / "x.mcap", "-o", tmp_path / "x.rrd")
    assert result.exit_code == 2
    assert "is not a trace" in result.output
    assert not (tmp_path / "x.rrd").exists()


def test_help_loads_neither_rerun_nor_numpy() -> None:
    code = (
        "import sys, contextlib\n"
        "sys.argv = ['rsltrace', 'rerun', '--help']\n"
        "from rsltrace.cli.main import main\n"
        "with contextlib.suppress(SystemExit):\n    main()\n"
        "print(*[m for m in ('rerun', 'numpy', 'pyarrow') if m in sys.modules])"
    )
    done: Any = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300
    )
    assert done.stdout.splitlines()[-1] == ""
