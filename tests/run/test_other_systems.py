"""What runs where Linux's parts of Python are missing: hidden here, as there is no other system."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
PAIR = PROJECT / "sample_traces" / "delayed_input"

_HIDE = """
import sys, os, select, selectors, signal, sysconfig
import click, numpy, rich.console, ruamel.yaml, pydantic  # which ask on which system they are
import multiprocessing.synchronize, subprocess, tempfile, threadpoolctl, asyncio, logging.handlers

def hide(module, names):
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)

def no_proc(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and arguments:
        if isinstance(arguments[0], (str, bytes)) and os.fsdecode(arguments[0]).startswith("/proc"):
            raise FileNotFoundError(2, "No such file or directory", arguments[0])

sysconfig.get_config_vars()
sys.addaudithook(no_proc)
hide(select, "epoll")
hide(selectors, "EpollSelector")
hide(os, "sched_getaffinity sched_setaffinity sched_getscheduler sched_setscheduler memfd_create"
         " pidfd_open posix_fadvise posix_fallocate eventfd splice copy_file_range getrandom"
         " getxattr setxattr listxattr removexattr setns unshare fdatasync getresuid O_TMPFILE")
"""
_HIDE_OF = {
    "darwin": _HIDE + "sys.platform = 'darwin'\n",
    "win32": _HIDE
    + """
class Missing:
    names = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}

    def find_spec(self, name, path=None, target=None):
        if name in self.names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
for name in Missing.names:
    sys.modules.pop(name, None)
hide(os, "fork forkpty getuid geteuid getgid setsid getpgid setpgid killpg wait register_at_fork"
         " mkfifo nice getloadavg sysconf fchmod statvfs pread pwrite sendfile openpty posix_spawn"
         " O_NOFOLLOW O_CLOEXEC O_DIRECTORY O_NONBLOCK WNOHANG")
hide(signal, "SIGUSR1 SIGUSR2 SIGALRM SIGKILL SIGHUP SIGPIPE SIGCHLD SIGCONT SIGSTOP SIGTSTP"
             " SIGWINCH SIGQUIT SIGXCPU SIGXFSZ setitimer alarm pthread_sigmask pthread_kill")
sys.platform = "win32"
""",
}


def command(system: str, folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run a command, and the processes that it starts, on what looks like ``system``."""
    (folder / "sitecustomize.py").write_text(_HIDE_OF[system])
    return subprocess.run(
        [sys.executable, "-m", "rsltrace", *map(str, words)],
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
    )


@pytest.mark.long
@pytest.mark.parametrize("system", _HIDE_OF)
def test_traces_are_read_everywhere(system: str, tmp_path: Path) -> None:
    a, b = PAIR / "a.mcap", PAIR / "b.mcap"
    commands = [("info", a), ("diff", a, b), ("why", a, "/localizer", "/odom")]
    for words in commands:
        there = command(system, tmp_path, *words)
        here = subprocess.run(
            [sys.executable, "-m", "rsltrace", *map(str, words)], capture_output=True, text=True
        )
        assert (there.returncode, there.stdout) == (here.returncode, here.stdout), there.stderr


def test_macos_records_the_same_run(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    job = PROJECT / "examples" / "cart" / "job.yaml"
    done = command("darwin", tmp_path, "record", job, "-o", tmp_path / "run.mcap")
    assert done.returncode == 0, done.stderr
    assert "digest 3a16bd1213ed1f0e" in done.stdout + done.stderr


@pytest.mark.parametrize(
    "name",
    ["record", *(pytest.param(name, marks=pytest.mark.long) for name in ("replay", "check"))],
)
def test_windows_says_what_it_cannot_do(name: str, tmp_path: Path) -> None:
    what = PAIR / ("job.yaml" if name == "record" else "a.mcap")
    done = command("win32", tmp_path, name, what)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("rsltrace: error: running nodes needs Linux or macOS")
    assert "Traceback" not in done.stderr
