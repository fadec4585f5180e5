"""Running one command under limits: in a fork of this process, or in a process of its own.

A fork has everything loaded and costs milliseconds, so thousands of cases fit into minutes; what
it does to itself (memory, descriptors, signals, a crash) stays its own. A fresh process is for what
attacks the process: pinning, exits, descriptors closed by whoever started it.
"""

from __future__ import annotations

import contextlib
import gc
import importlib.metadata
import os
import resource
import select
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import NoReturn

from campaigns.attack.model import MIB, Command, Ran

OUTPUT_BYTES_MAX = 16 * MIB
"""No more is read of what a command prints."""

_POLL_S = 0.004
LEFT_S = 30.0


@lru_cache
def entry_point() -> Callable[[], object]:
    """Return what the ``rsltrace`` command calls."""
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="rsltrace")
    loaded = entry.load()
    assert callable(loaded)
    return loaded  # type: ignore[no-any-return]


def preload(*, ros: bool) -> None:
    """Import what commands need, so that forks have it; ``ros``: what runs nodes, too."""
    import pkgutil

    import rsltrace

    roots = ("bag", "cli", "diff", "errors", "job", "mcap", "model", "trace")
    for module in pkgutil.walk_packages(rsltrace.__path__, "rsltrace."):
        if module.name.split(".")[1] in roots and not module.name.endswith("__main__"):
            with contextlib.suppress(ImportError):
                importlib.import_module(module.name)
    modules = ["aiohttp", "fsspec.implementations.http", "textual.app", "rosbags.rosbag2"]
    modules += ["tty", "html", "rich._export_format", "textual.drivers.linux_driver"]
    for name in modules:
        importlib.import_module(name)
    entry_point()  # a signal that comes while a fork looks for it would be no fault of ours
    b"x".decode("utf-8-sig")  # another user may not be able to read Python's own files
    if ros:
        for name in ("rclpy.node", "std_msgs.msg", "std_srvs.srv", "rsltrace.run"):
            importlib.import_module(name)
        _ = rsltrace.record
    gc.collect()
    gc.freeze()


def run(command: Command, scratch: Path) -> Ran:
    """Run a command to its end, or to a limit, and return how it ended."""
    scratch.mkdir(parents=True, exist_ok=True)
    places = scratch / "stdout", scratch / "stderr"
    started = time.monotonic()
    grown_from = _size(command.cwd) if command.kill else 0
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        _in_child(command, places)
    client = _start_client(command, pid) if command.client else 0
    status, usage, timed_out, killed = _wait(pid, command, grown_from)
    left = 0 if command.words[:1] == ("record",) else _left_behind(pid)  # nodes may leave some
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)
    if client:
        with contextlib.suppress(ProcessLookupError):
            os.kill(client, signal.SIGKILL if timed_out else 0)
        os.waitpid(client, 0)
    return Ran(
        command,
        os.waitstatus_to_exitcode(status),
        _read(places[0]),
        _read(places[1]),
        usage.ru_utime + usage.ru_stime,
        usage.ru_maxrss / 1024,
        time.monotonic() - started,
        timed_out,
        killed,
        left,
    )


def _start_client(command: Command, pid: int) -> int:
    """Start what attacks a command while it runs; return its process id."""
    assert command.client is not None
    client = os.fork()
    if client == 0:
        try:
            command.client(pid)
        except BaseException:
            traceback.print_exc()
        os._exit(0)
    return client


def _left_behind(group: int) -> int:
    """Return how many processes of a group go on after its leader's end, whatever they were told.

    Half a minute is for those that look now and then whether they are still wanted.
    """
    until = time.monotonic() + LEFT_S
    while left := _members(group):
        if time.monotonic() > until:
            break
        time.sleep(0.05)
    return left


def _members(group: int) -> int:
    try:
        os.killpg(group, 0)
    except (ProcessLookupError, PermissionError):
        return 0
    count = 0
    for place in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            state, _, of_group = place.read_text().rpartition(")")[2].split()[:3]
            count += int(of_group) == group and state not in "ZX"
    return count


def call(function: Callable[[], bytes], scratch: Path, *, cpu_s: int = 20) -> bytes | None:
    """Return what a function returns, called in a fork with limits; None if it fails."""
    scratch.mkdir(parents=True, exist_ok=True)
    place = scratch / "answer"
    place.unlink(missing_ok=True)
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
            resource.setrlimit(resource.RLIMIT_AS, (4096 * MIB, 4096 * MIB))
            place.write_bytes(function())
            code = 0
        finally:  # whatever hostile bytes make it raise: that it failed is the answer
            os._exit(code)
    _, status = os.waitpid(pid, 0)
    return place.read_bytes() if status == 0 else None


def _in_child(command: Command, places: tuple[Path, Path]) -> NoReturn:
    code = 70
    try:
        os.setsid()
        os.chdir(command.cwd)
        os.environ.update({"COLUMNS": "100", "NO_COLOR": "1", **dict(command.environment)})
        _redirect(command, places)
        _limit(command)
        if command.user is not None:
            os.setgroups([])
            os.setresgid(command.user, command.user, command.user)
            os.setresuid(command.user, command.user, command.user)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if command.fresh or command.program:
            ours = str(Path(sys.executable).with_name("rsltrace"))
            words = [*command.program] or [ours, *command.words]
            os.execve(words[0], words, dict(os.environ))
        code = _call_entry(command)
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()
        os._exit(code & 0xFF)


def _call_entry(command: Command) -> int:
    from rsltrace.errors import RsltraceError  # noqa: F401  (loaded, as the command has it)

    sys.argv = ["rsltrace", *command.words]
    path = dict(command.environment).get("PYTHONPATH", "")
    sys.path[:0] = [part for part in path.split(":") if part]
    try:
        entry_point()()
    except SystemExit as end:
        if end.code is None:
            return 0
        if isinstance(end.code, int):
            return end.code
        print(end.code, file=sys.stderr)
        return 1
    return 0


def _redirect(command: Command, places: tuple[Path, Path]) -> None:
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    for number, (wanted, place) in enumerate(
        zip((command.stdout, command.stderr), places, strict=True), 1
    ):
        place.unlink(missing_ok=True)
        where = "/dev/full" if wanted == "full" else str(place)
        handle = os.open(where, os.O_WRONLY | (0 if wanted == "full" else os.O_CREAT), 0o600)
        os.dup2(handle, number)
        os.close(handle)
        if wanted == "closed":
            os.close(number)
    os.close(null)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
    for name, number in (("stdout", 1), ("stderr", 2)):
        closed = getattr(command, name) == "closed"
        stream = None if closed else open(number, "w", closefd=False, encoding="utf-8")  # noqa: SIM115
        setattr(sys, name, stream)  # as Python sets them when it starts


def _limit(command: Command) -> None:
    limits = command.limits
    cpu = int(limits.cpu_s * 2) + 1
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (cpu, cpu + 1))
    resource.setrlimit(resource.RLIMIT_AS, (limits.address_mib * MIB,) * 2)
    if limits.file_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limits.file_bytes,) * 2)


def _wait(
    pid: int, command: Command, grown_from: int
) -> tuple[int, resource.struct_rusage, bool, bool]:
    """Wait for the end; send the signal that is planned; end what does not end."""
    begun = time.monotonic()
    handle = os.pidfd_open(pid)
    timed_out = killed = False
    try:
        while True:
            waits_to_kill = command.kill is not None and not killed
            ended, _, _ = select.select([handle], [], [], _POLL_S if waits_to_kill else 0.25)
            if ended:
                break
            since = time.monotonic() - begun
            if command.kill is not None and waits_to_kill and since >= command.kill.delay_s:
                grown = _size(command.cwd) - grown_from
                if grown >= command.kill.grown_bytes:
                    os.kill(pid, command.kill.signal)
                    killed = True
            if since > command.limits.wall_s:
                timed_out = True
                os.kill(pid, signal.SIGKILL)
                break
        _, status, usage = os.wait4(pid, 0)
    finally:
        os.close(handle)
    return status, usage, timed_out, killed


def _size(folder: Path) -> int:
    total = 0
    for entry in os.scandir(folder):
        with contextlib.suppress(OSError):
            total += entry.stat(follow_symlinks=False).st_size if entry.is_file() else 0
    return total


def _read(place: Path) -> bytes:
    try:
        with place.open("rb") as file:
            return file.read(OUTPUT_BYTES_MAX)
    except OSError:
        return b""


def run_shell(
    script: str, cwd: Path, environment: dict[str, str]
) -> subprocess.CompletedProcess[bytes]:
    """Run what somebody pastes into a shell."""
    return subprocess.run(
        ["/bin/sh", "-c", script],
        cwd=cwd,
        env={"PATH": os.environ.get("PATH", ""), **environment},
        capture_output=True,
        stdin=subprocess.DEVNULL,
        timeout=600,
        check=False,
    )
