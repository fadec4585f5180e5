"""What runs a file as a process, and files that nothing can run so."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

from rsltrace.adapters.processes import build
from rsltrace.adapters.processes.build import interpreter, why_not_run
from rsltrace.adapters.processes.child import ProcessHandle
from rsltrace.adapters.workspace import cache
from rsltrace.errors import SetupError


@pytest.fixture
def caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for caches of this test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache._root.cache_clear()
    yield tmp_path / "rsltrace"
    cache._root.cache_clear()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("#!/bin/sh -e", ["/bin/sh", "-e"]),
        ("#! /usr/bin/env ruby", ["ruby"]),
        ("#!/usr/bin/env -S ruby -w", ["ruby", "-w"]),
        ("#!", []),
        ("echo", []),
        ("", []),
    ],
)
def test_what_runs_a_script(tmp_path: Path, line: str, words: list[str]) -> None:
    (tmp_path / "script").write_text(f"{line}\n")
    assert interpreter(tmp_path / "script") == words


def _without_headers(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[32:40] = b"\xff" * 8
    file.write_bytes(data)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda file: None, "^$"),
        (lambda file: file.chmod(0o4755), "^$"),
        (_without_headers, "is damaged"),
    ],
)
def test_why_a_program_is_not_run(
    tmp_path: Path, change: Callable[[Path], None], reason: str
) -> None:
    file = tmp_path / "program"
    shutil.copy(Path(sys.executable).resolve(), file)
    change(file)
    assert re.search(reason, why_not_run(file))


def test_a_program_with_the_rights_of_another_user_is_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(Path(sys.executable).resolve(), tmp_path / "program")
    (tmp_path / "program").chmod(0o4755)
    monkeypatch.setattr("os.geteuid", lambda: 4711)
    assert "runs with other rights than its user's" in why_not_run(tmp_path / "program")


def test_a_process_that_says_nothing_is_given_up() -> None:
    child = ProcessHandle(["/bin/sleep", "600"], {}, None, "sleeper")
    child.give_up_after(0.2)
    assert child.receive() is None
    assert child.reap().said == "was killed by SIGKILL"


def test_a_process_that_starts_when_rsltrace_is_gone_does_not_run() -> None:
    """It would run natively, over DDS, and nobody would end it."""
    try:
        built = build.library(lambda line: None)
    except SetupError as error:
        pytest.skip(str(error))
    turns, writer = os.pipe()
    link = f"{1 << 29}:{turns}:0:0:0"
    libraries = os.pathsep.join(map(str, built.ros.libraries))
    around = {"LD_PRELOAD": str(built.path), "LD_LIBRARY_PATH": libraries, "RSLTRACE_LINK": link}
    outside = subprocess.run(["/bin/true"], env=around, pass_fds=[turns])
    os.close(writer)
    late = subprocess.run(["/bin/true"], env=around, pass_fds=[turns])
    os.close(turns)
    assert (outside.returncode, late.returncode) == (0, 120)


def test_a_library_that_is_cut_off_is_built_anew(
    caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = []

    def compile(commands: Iterable[list[str]]) -> None:
        for target in (Path(command[command.index("-o") + 1]) for command in commands):
            built.append(target.suffix)
            target.write_bytes(b"whole")

    pytest.importorskip("rclpy")
    monkeypatch.setattr(build, "_run", compile)
    try:
        first = build.library(lambda line: None)
    except SetupError as error:
        pytest.skip(str(error))
    assert build.library(lambda line: None) == first
    assert built.count(".so") == 2
    first.path.write_bytes(b"who")
    assert build.library(lambda line: None) == first
    assert first.path.read_bytes() == b"whole"
    assert built.count(".so") == 4


def test_what_others_can_change_is_not_taken_from_the_cache(caches: Path) -> None:
    made = cache.cached_folder("things", "a", lambda folder: None)
    assert cache.cached_folder("things", "a", lambda folder: None) == made
    for folder in (made, made.parent):
        folder.chmod(0o777)
        with pytest.raises(SetupError, match=f"others can change what is in {folder}: remove it"):
            cache.cached_folder("things", "a", lambda folder: None)
        folder.chmod(0o755)


def test_a_cache_that_others_can_change_is_left_alone(caches: Path) -> None:
    caches.mkdir(0o755)
    caches.chmod(0o777)
    made = cache.cached_folder("things", "a", lambda folder: None)
    assert caches not in made.parents


def test_one_fills_a_folder_and_others_wait(caches: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filling, another, made = threading.Event(), threading.Event(), []
    lock = fcntl.flock

    def asked(file: int, what: int) -> None:
        if filling.is_set():
            another.set()
        lock(file, what)

    def make(folder: Path) -> None:
        made.append(folder)
        if filling.is_set():
            another.set()
        filling.set()
        assert another.wait(600)

    monkeypatch.setattr(fcntl, "flock", asked)
    first = threading.Thread(target=cache.cached_folder, args=("things", "a", make))
    first.start()
    assert filling.wait(600)
    found = cache.cached_folder("things", "a", make)
    first.join()
    assert len(made) == 1
    assert list(found.parent.iterdir()) == [found], "the lock is left"


FILLS = """
import time
from rsltrace.adapters.workspace.cache import cached_folder
cached_folder("things", "a", lambda folder: print("begun", flush=True) or time.sleep(600))
"""


def test_a_killed_process_fills_no_folder_and_keeps_nobody_waiting(caches: Path) -> None:
    command = [sys.executable, "-c", FILLS]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"begun\n"
        process.kill()
    assert cache.cached_folder("things", "a", lambda folder: None).is_dir()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ('"g++', "is no command: No closing quotation"),
        ("no-such-compiler -O3", "there is no program 'no-such-compiler'"),
    ],
)
def test_a_compiler_that_is_not_there(
    monkeypatch: pytest.MonkeyPatch, given: str, message: str
) -> None:
    monkeypatch.setenv("CXX", given)
    with pytest.raises(SetupError, match=message):
        build.find_compiler()


def test_a_compiler_that_fails_and_says_nothing() -> None:
    with pytest.raises(SetupError, match=r"false cannot build the library[^$]*exit status 1"):
        build._run([["/bin/false"]])


def test_no_compiler_outlives_an_interrupted_build(tmp_path: Path) -> None:
    """Not even the one that its driver has started, which g++ would leave behind."""
    script = tmp_path / "compiler"
    script.write_text(f"#!/bin/sh\necho $$ >> {tmp_path}/pids\nsleep 600 & wait\n")
    script.chmod(0o755)
    code = f"from rsltrace.adapters.processes import build; build._run([[{str(script)!r}]] * 3)"
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL) as building:
        pids = tmp_path / "pids"
        deadline = time.monotonic() + 600
        while not (pids.exists() and pids.read_text().endswith("\n")):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        building.send_signal(signal.SIGINT)
        assert building.wait(600) != 0
    while any(_group_lives(int(pid)) for pid in pids.read_text().split()):
        assert time.monotonic() < deadline, "a compiler was left behind"
        time.sleep(0.02)


def test_an_interrupt_while_a_compiler_is_started_leaves_none() -> None:
    """A mask does not keep the signal out: the thread of a numerical library takes it."""
    code = """
import os, signal, subprocess, time
from rsltrace.adapters.processes import build

class Popen(subprocess.Popen):
    def __init__(self, *words, **options):
        super().__init__(*words, **options)
        print(self.pid)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.05)

build.subprocess.Popen = Popen
build._run([["sleep", "600"]])
"""
    with subprocess.Popen(
        [sys.executable, "-uc", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as building:
        pid = int(building.communicate(timeout=600)[0])
    assert building.returncode != 0
    assert not _group_lives(pid)


def _group_lives(pid: int) -> bool:
    return any(_group_of(path) == pid for path in Path("/proc").glob("[0-9]*/stat"))


def _group_of(stat: Path) -> int:
    """Return the process group of what runs, 0 of what has ended."""
    try:
        state, _, group = stat.read_text().rpartition(")")[2].split()[:3]
    except OSError:
        return 0
    return 0 if state == "Z" else int(group)


def test_what_was_begun_long_ago_is_cleared_away(caches: Path) -> None:
    cache.cached_folder("things", "a", lambda folder: None)
    for name, age_s in ((".new-old", 7200), (".new-now", 0)):
        left = caches / "things" / name
        left.mkdir()
        os.utime(left, (time.time() - age_s,) * 2)
    cache.cached_folder("things", "b", lambda folder: None)
    assert sorted(path.name for path in (caches / "things").iterdir()) == [".new-now", "a", "b"]
