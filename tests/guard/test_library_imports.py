"""The first run, in which a library builds its cache while it is imported, is like the second."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.trace.model.finding import NondeterminismSource
from tests.guard.conftest import list_as_wheel, node_code

pytestmark = pytest.mark.ros

_LIBRARY = """
import os, random, subprocess, threading, time
CACHE = {cache!r}
lock = threading.Lock()
began = time.monotonic()
if not os.path.exists(CACHE):
    warning = threading.Timer(5, print, ["this takes long"])
    warning.start()
    assert warning.is_alive()
    try:
        deadline = time.monotonic() + 0.02
        while time.monotonic() < deadline:
            time.sleep(0.005)
        subprocess.run(["true"], check=True)
        assert threading.Thread(target=print).name != "Thread-1"
        random.random()
        open(CACHE, "w").close()
    finally:
        warning.cancel()
        {join}
"""
_TICK = """
import threading, time, random
began = time.monotonic_ns()
import {name}
thread = threading.Thread(target=lambda: None)
thread.start()
with {name}.lock:
    self.say(began, time.monotonic_ns(), thread.name, thread.ident, random.random())
"""
_MAIN = """
import rclpy
def main():
    rclpy.init()
    node = N()
    node.tick()
    rclpy.spin(node)
"""


def _install(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, code: str) -> None:
    (folder / "site-packages").mkdir()
    (folder / "site-packages" / f"{name}.py").write_text(code)
    monkeypatch.syspath_prepend(str(folder / "site-packages"))


@pytest.mark.long
@pytest.mark.parametrize("join", ["pass", "warning.join(); assert not warning.is_alive()"])
@pytest.mark.parametrize("entry", ["node: 'm:N'", "main: 'm:main'"])
@pytest.mark.parametrize("at_top", [True, False], ids=["top", "inside"])
def test_a_cache_that_an_import_builds_changes_nothing(
    said: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    join: str,
    entry: str,
    at_top: bool,
) -> None:
    name, cache = f"lib{abs(hash((join, entry, at_top)))}", tmp_path / "cache"
    _install(tmp_path, monkeypatch, name, _LIBRARY.format(cache=str(cache), join=join))
    imports = f"import {name}" if at_top else ""
    code = node_code(_TICK.format(name=name), imports=imports) + _MAIN
    runs, traces = [], []
    for _ in range(2):
        monkeypatch.delitem(__import__("sys").modules, name, raising=False)
        runs.append(said(code, job=f"nodes: [{{{entry}}}]"))
        traces.append((tmp_path / "run.mcap").read_bytes())
        assert cache.exists()
    assert runs[0] == runs[1]
    assert runs[0][0][2] == "Thread-1 (<lambda>)"
    from rsltrace.trace.reader import Trace

    (tmp_path / "first.mcap").write_bytes(traces[0])
    with Trace.open(tmp_path / "first.mcap") as a, Trace.open(tmp_path / "run.mcap") as b:
        assert a.digest == b.digest


def test_a_thread_that_an_import_leaves_running_is_named(
    said: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rsltrace.trace.reader import Trace

    code = "import threading\nthreading.Thread(target=int).start()\nthreading.Timer(9, int).start()"
    _install(tmp_path, monkeypatch, "lib_that_goes_on", code)
    said(node_code("import lib_that_goes_on"))
    with Trace.open(tmp_path / "run.mcap") as trace:
        found = [one for per_event in trace.findings.values() for one in per_event]
    calls = [one.call for one in found if one.source is NondeterminismSource.THREAD]
    assert calls == ["threading.Thread.start() while lib_that_goes_on is imported"] * 2


@pytest.mark.long
def test_a_folder_that_pip_installed_into_is_of_libraries(tmp_path: Path) -> None:
    """As ``pip install --target`` makes one, for ``PYTHONPATH``."""
    from rsltrace.trace.reader import Trace

    libs = tmp_path / "libs"
    libs.mkdir()
    cache = tmp_path / "cache"
    code = _LIBRARY.format(cache=str(cache), join="pass")
    (libs / "lib_in_target.py").write_text(code + "os.path.realpath(__file__)\n")
    list_as_wheel(libs, "lib_in_target")
    (tmp_path / "m.py").write_text(node_code(_TICK.format(name="lib_in_target")))
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {duration: 1.2s}\n")
    digests = []
    for name in ("first", "second"):
        command = [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", f"{name}.mcap"]
        environment = {**os.environ, "PYTHONPATH": str(libs)}
        subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True)
        with Trace.open(tmp_path / f"{name}.mcap") as trace:
            digests.append(trace.digest)
            found = [one.call for many in trace.findings.values() for one in many]
            assert not [call for call in found if str(libs) in call]
    assert cache.exists()
    assert digests[0] == digests[1]


def test_following_the_links_of_a_path_is_news_only_of_links(
    said: Callable[..., Any], tmp_path: Path
) -> None:
    from rsltrace.trace.reader import Trace

    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "deep")
    said(node_code(f"import os\nself.say(os.path.realpath({str(tmp_path / 'link' / 'er')!r}))"))
    with Trace.open(tmp_path / "run.mcap") as trace:
        found = {one.call for many in trace.findings.values() for one in many}
    assert found == {f"os.lstat({str(tmp_path / 'link')!r})"}
