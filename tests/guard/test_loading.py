"""Modules are patched when they are loaded; nobody sees that they were not loaded before."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from rsltrace.guard.loading import when_loaded
from rsltrace.guard.pin import PINNED_VARIABLES

LAZY = ("asyncio", "ssl", "sqlite3", "numpy.random", "tracemalloc", "_curses", "_elementtree")

IMPORTS = """
import _curses, asyncio, sqlite3, ssl, tracemalloc
from xml.etree.ElementTree import Element
from asyncio import run, sleep
from numpy.random import default_rng, rand
import numpy.random
"""

NODE = """
import sys
from rclpy.node import Node

AT_MODULE_LEVEL

class Lazy(Node):
    def __init__(self):
        super().__init__("lazy")
        self.tick_timer = self.create_timer(0.1, self.tick)

    def tick(self):
IN_CALLBACK
        async def nap():
            await sleep(0.05)
            return asyncio.get_running_loop().time()

        shared = numpy.random.mtrand._rand
        made = [rand(), default_rng(), shared.random_sample(), numpy.random.RandomState()]
        texts = [run(nap()), made[0], made[1].random(), made[2], made[3].rand()]
        kinds = [type(asyncio.events._lock), type(shared._bit_generator.lock)]
        kinds += asyncio.events._RunningLoop.__mro__
        connection = sqlite3.connect(":memory:")
        dates = connection.execute("select julianday() > 0").fetchall()
        context = ssl.create_default_context()
        tracemalloc.get_traced_memory()
        shown = repr([Element("a"), Element("b")])
        self.get_logger().info(repr([texts, kinds, dates, shown, ssl.MemoryBIO().pending]))
"""

RUN = """
import json, sys
LOADED
from rsltrace import Job, NodeSpec, StopSpec, record
before = sorted(set(LAZY) & set(sys.modules))
job = Job(nodes=[NodeSpec(node="lazy:Lazy")], search_path=["."], stop=StopSpec(duration="0.3s"))
def once(name):
    done = record(job, name)
    met = [[one.source, one.mode, one.node, one.call, one.count] for one in done.guarded]
    return [done.digest, met]
found = [once("a.mcap"), once("b.mcap")]
import asyncio, sqlite3
left = [asyncio.BaseEventLoop.time.__module__, sqlite3.connect.__self__ is None]
hooks = [type(one).__module__ for one in sys.meta_path]
print(json.dumps([before, found, left, hooks]))
"""


def _run(folder: Path, *, loaded: bool, in_callback: bool) -> Any:
    folder.mkdir()
    inner = "".join(f"        {line}\n" for line in IMPORTS.strip().splitlines())
    at_level, in_body = ("", inner) if in_callback else (IMPORTS, "")
    node = NODE.replace("AT_MODULE_LEVEL", at_level).replace("IN_CALLBACK\n", in_body)
    (folder / "lazy.py").write_text(node)
    program = RUN.replace("LOADED", IMPORTS if loaded else "").replace("set(LAZY)", repr(set(LAZY)))
    environment = {**os.environ, **PINNED_VARIABLES}
    command = [sys.executable, "-c", program]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.ros
@pytest.mark.parametrize("in_callback", [False, True])
def test_a_run_is_the_same_whatever_was_loaded_before(tmp_path: Path, in_callback: bool) -> None:
    pytest.importorskip("rclpy")
    before, found, left, hooks = _run(tmp_path / "a", loaded=False, in_callback=in_callback)
    assert before == []
    assert found[0] == found[1]
    calls = {call for _, _, _, call, _ in found[0][1]}
    assert {"numpy.random.rand()", "SQLite: julianday()"} <= calls
    assert "tracemalloc.get_traced_memory()" in calls
    assert left[0] == "asyncio.base_events"
    assert "rsltrace.guard.loading" not in hooks
    other = _run(tmp_path / "b", loaded=True, in_callback=in_callback)
    assert other[0] == sorted(LAZY)
    assert other[1] == found
    for name in ("a.mcap", "b.mcap"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def _module(folder: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> str:
    name = f"patched_{folder.name}"
    (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, name, raising=False)
    return name


def test_nobody_gets_a_module_before_it_is_patched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = _module(tmp_path, "import time\ntime.sleep(0.2)\nvalue = 1\n", monkeypatch)
    seen: list[int] = []

    def patch() -> None:
        vars(sys.modules[name])["value"] = 2

    def look() -> None:
        seen.append(__import__(name).value)

    with ExitStack() as stack:
        when_loaded(stack, name, patch)
        threads = [threading.Thread(target=look) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        module = sys.modules[name]
        assert type(module.__loader__).__module__ != "rsltrace.guard.loading"
        assert module.__spec__ is not None
        assert module.__spec__.loader is module.__loader__
    assert seen == [2] * 4


def test_a_loaded_module_is_patched_at_once_and_none_after_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = _module(tmp_path, "", monkeypatch)
    finders = list(sys.meta_path)
    patched: list[str] = []
    with ExitStack() as stack:
        when_loaded(stack, "json", lambda: patched.append("json"))
        when_loaded(stack, name, lambda: patched.append(name))
        assert patched == ["json"]
    __import__(name)
    assert patched == ["json"]
    assert sys.meta_path == finders


def test_a_module_that_fails_is_patched_when_it_has_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = _module(tmp_path, "import sys\nsys.once.pop()\n", monkeypatch)
    monkeypatch.setattr(sys, "once", [], raising=False)
    patched: list[str] = []
    with ExitStack() as stack:
        when_loaded(stack, name, lambda: patched.append(name))
        with pytest.raises(IndexError):
            __import__(name)
        assert patched == []
        vars(sys)["once"].append(1)
        __import__(name)
    assert patched == [name]
