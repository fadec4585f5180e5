"""``stdin:``: what is typed at the terminals of mains; the same programs read from a real
pseudo-terminal natively."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace.errors import JobError
from rsltrace.job import load_job
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

PROGRAMS = r"""
import curses, os, select, sys, termios, threading, tty
from rclpy.node import Node
import rclpy

def node_of(name):
    rclpy.init()
    node = Node(name)
    node.get_logger().info('here')
    return node

def lines():
    node = node_of('lines')
    say = node.get_logger().info
    say(f'tty {sys.stdin.isatty()} {os.isatty(0)} {sys.stdin.fileno()}')
    say(input('name? '))
    for line in sys.stdin:
        say(repr(line))
    for _ in range(3):
        try:
            input()
        except EOFError as error:
            say(str(error))
    say(repr(sys.stdin.read(5)))

def keyboard():
    # as the keyboard teleoperation of ROS packages does it
    node = node_of('keyboard')
    settings = termios.tcgetattr(sys.stdin)
    while True:
        tty.setraw(sys.stdin.fileno())
        ready = select.select([sys.stdin], [], [], 0.1)[0]
        key = sys.stdin.read(1) if ready else ''
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, settings)
        if key:
            node.get_logger().info(repr(key))
        if key == '\x03':
            return

def thread():
    node = node_of('thread')
    before = termios.tcgetattr(0)
    tty.setcbreak(0)

    def read():
        while (key := os.read(0, 8)) != b'q':
            node.get_logger().info(repr(key))
        rclpy.shutdown()

    reader = threading.Thread(target=read)
    reader.start()
    try:
        rclpy.spin(node)
    except rclpy.executors.ExternalShutdownException:
        pass
    reader.join()
    termios.tcsetattr(0, termios.TCSADRAIN, before)

def screen():
    node = node_of('screen')

    def app(window):
        window.timeout(60_000)
        while (key := window.getch()) != ord('q'):
            node.get_logger().info(curses.keyname(key).decode())
            window.addstr(0, 0, 'x' * 60)
            window.refresh()

    curses.wrapper(app)

def looks():
    node = node_of('looks')
    os.set_blocking(0, False)
    tty.setcbreak(0)
    count = 0
    while True:
        try:
            key = os.read(0, 1)
        except BlockingIOError:
            count += 1
            rclpy.spin_once(node, timeout_sec=0.1)
        else:
            node.get_logger().info(f'{key} after {count} looks')
            return

def ask():
    node_of('ask')
    input()

def iterate():
    node_of('iterate')
    next(iter(sys.stdin))

def select_nothing():
    node_of('nothing')
    os.read(0, 1)

class Asks(Node):
    def __init__(self):
        super().__init__('asks')
        self.create_timer(1.0, lambda: sys.stdin.readline())

if __name__ == '__main__':
    globals()[sys.argv[1]]()
"""

TYPED = {
    "lines": ["Bob", "one", "", "two"],
    "keyboard": ["w", "a", "\x1b", "\x03"],
    "thread": ["w", "\x1b[A", "x", "q"],
    "screen": ["w", "\x1bOA", "\x1b[Z", "é", "q"],
}


def logs(path: Path) -> list[tuple[int, str]]:
    """Return (milliseconds, text) of each log record."""
    with Trace.open(path) as trace:
        return [
            (time_ns // 1_000_000, trace.decode("/rosout", data).msg)  # type: ignore[attr-defined]
            for time_ns, _, data in trace.messages("/rosout")
        ]


def native(code: Path, name: str, slower: int) -> list[str]:
    """Run a program natively at a pseudo-terminal, type slowly, and return what it logs."""
    keyboard, terminal = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, str(code), name],
        stdin=terminal,
        stdout=terminal,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TERM": "xterm"},
    )
    os.close(terminal)
    shown = bytearray()

    def show() -> None:
        while True:
            try:
                shown.extend(os.read(keyboard, 4096))
            except OSError:
                return

    threading.Thread(target=show, daemon=True).start()
    said: list[str] = []

    def hear() -> None:
        assert process.stderr is not None
        for line in process.stderr:
            found = re.search(r"\[INFO\] \[[\d.]+\] \[\w+\]: (.*)", line)
            if found:
                said.append(found[1])

    listener = threading.Thread(target=hear)
    listener.start()
    typed = [f"{line}\r" if name == "lines" else line for line in TYPED[name]]
    if name == "lines":
        typed += ["\x04"] * 5
    until = time.monotonic() + 600
    while not said and time.monotonic() < until and process.poll() is None:
        time.sleep(0.05)
    time.sleep(1.0 * slower)
    for keys in typed:
        if process.poll() is not None:
            break
        before = len(said)
        os.write(keyboard, keys.encode())
        until = time.monotonic() + 2 * slower
        while len(said) == before and time.monotonic() < until and process.poll() is None:
            time.sleep(0.05)
        time.sleep(0.3 * slower)
    with suppress(subprocess.TimeoutExpired):  # a key was lost as it changed its terminal's mode
        process.wait(60 * slower)
    process.kill()
    process.wait()
    listener.join()
    assert process.stderr is not None
    process.stderr.close()
    os.close(keyboard)
    return said


def entry(name: str) -> str:
    typed = TYPED[name]
    if name == "lines":
        return '{main: "nodes_under_test:lines", stdin: in.txt}'
    keys = ", ".join(f"{{at: {number + 1}s, keys: {key!a}}}" for number, key in enumerate(typed))
    return f'{{main: "nodes_under_test:{name}", stdin: [{keys}]}}'.replace("'", '"')


@pytest.fixture
def recorded(
    record_job: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    monkeypatch.setenv("TERM", "xterm")
    (tmp_path / "in.txt").write_text("".join(f"{line}\n" for line in TYPED["lines"]))

    def record(*entries: str, output: str = "run.mcap") -> Any:
        yaml = "nodes:\n" + "".join(f"  - {one}\n" for one in entries)
        result = record_job(yaml + "stop: {duration: 60s}\n", PROGRAMS, output=output)
        assert result.error is None, result.error
        return result

    return record


def test_what_is_typed_reaches_its_main_at_its_time(recorded: Any) -> None:
    entries = [entry(name) for name in TYPED]
    result = recorded(*entries)
    assert recorded(*entries, output="again.mcap").digest == result.digest
    said = logs(result.path)
    assert [text for at_ms, text in said if at_ms == 0][:6] == [
        "here", "tty True True 0", "Bob", r"'one\n'", r"'\n'", r"'two\n'",
    ]  # fmt: skip
    # keyboard, thread and screen, each in the order of its own
    assert sorted(pair for pair in said if pair[0] >= 1000) == sorted([
        (1000, "'w'"), (1000, "b'w'"), (1000, "w"),
        (2000, "'a'"), (2000, r"b'\x1b[A'"), (2000, "KEY_UP"),
        (3000, r"'\x1b'"), (3000, "b'x'"), (3000, "KEY_BTAB"),
        (4000, r"'\x03'"), (4000, "M-C"), (4000, "M-)"),
    ])  # fmt: skip
    whole = rsltrace.replay(result.path, trust=True)
    assert (whole.exit_code, whole.digest) == (0, result.digest)
    assert rsltrace.replay(result.path, node="keyboard", trust=True).same


def test_without_a_standard_input_of_its_own(recorded: Any, tmp_path: Path) -> None:
    result = recorded(entry("keyboard"))
    done = subprocess.run(
        ["bash", "-c", 'exec "$0" -m rsltrace record job.yaml -o closed.mcap <&-', sys.executable],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert f"digest {result.digest}" in done.stdout


@pytest.mark.long
@pytest.mark.parametrize("name", list(TYPED))
def test_programs_read_as_they_do_natively(name: str, recorded: Any, tmp_path: Path) -> None:
    here = [text for _, text in logs(recorded(entry(name)).path)]
    for slower in (1, 4, 16):  # a machine may stand still where a program is about to read
        if here == (there := native(tmp_path / "nodes_under_test.py", name, slower)):
            return
    assert here == there


def test_a_main_that_looks_now_and_then_finds_keys_when_they_come(recorded: Any) -> None:
    result = recorded('{main: "nodes_under_test:looks", stdin: [{at: 550ms, keys: x}]}')
    assert logs(result.path)[1:] == [(600, "b'x' after 6 looks")]


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("what", "call"),
    [
        ("main: nodes_under_test:ask", "input(): nodes_under_test:ask reads from its terminal"),
        ("main: nodes_under_test:iterate", "for line in sys.stdin: nodes_under_test:iterate"),
        ("main: nodes_under_test:select_nothing", "os.read(0): nodes_under_test:select_nothing"),
        ("node: nodes_under_test:Asks", "sys.stdin.readline(): a 'node' of a job has no terminal"),
    ],
)
def test_without_it_the_first_read_is_an_error(
    what: str, call: str, record_job: Callable[..., Any]
) -> None:
    stdin, copy = sys.stdin, os.fstat(0)
    result = record_job(f"nodes: [{{{what}}}]\nstop: {{duration: 5s}}", PROGRAMS)
    assert result.exit_code == 3
    assert call in str(result.error)
    assert "stdin: [" in str(result.error)
    assert sys.stdin is stdin
    assert os.fstat(0).st_ino == copy.st_ino


@pytest.mark.parametrize(
    ("stdin", "wrong"),
    [
        ("nowhere.txt", "'nowhere.txt': there is no such file"),
        ("[{at: 1s}]", "give one of line, keys, file, end"),
        ("[{line: a, keys: b}]", "give one of line, keys, file, end"),
        ('["a\\nb"]', "this is more than one line"),
        ("[{keys: ''}]", "no key is given"),
        ("7", "expected a file whose lines are typed, or a list of what is typed, got"),
        (f"[{'x' * 4001}]", "a terminal takes lines of at most 4000 bytes"),
    ],
)
def test_mistakes(stdin: str, wrong: str, job_file: Callable[..., Path]) -> None:
    yaml = f"nodes:\n  - main: nodes_under_test:ask\n    stdin: {stdin}\n"
    with pytest.raises(JobError) as raised:
        load_job(job_file(yaml, PROGRAMS))
    assert "job.yaml:3:" in str(raised.value)
    assert wrong in str(raised.value)


def test_a_node_has_no_terminal(job_file: Callable[..., Path]) -> None:
    yaml = "nodes:\n  - node: nodes_under_test:Asks\n    stdin: [a]\n"
    with pytest.raises(JobError, match=r"job\.yaml:3:5: .*a 'node' has no terminal of its own"):
        load_job(job_file(yaml, PROGRAMS))
