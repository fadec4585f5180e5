"""``rsltrace debug`` as it is typed: in a script, on a terminal, with pdb, with Ctrl-C."""

from __future__ import annotations

import os
import pty
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros

LIMIT_S = 240
COMMAND = [sys.executable, "-m", "rsltrace", "debug"]


def script(
    folder: Path, lines: Sequence[str], *words: str, source: str = "run.mcap"
) -> subprocess.CompletedProcess[str]:
    """Run the command with its commands in a pipe."""
    return subprocess.run(
        [*COMMAND, source, *words],
        input="".join(f"{line}\n" for line in lines),
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=LIMIT_S,
    )


def said(done: subprocess.CompletedProcess[str]) -> dict[str, list[str]]:
    """Return by command, as it was typed first, the lines that followed it."""
    answers: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in done.stdout.splitlines():
        if line.startswith("(rsltrace) "):
            lines = []
            answers.setdefault(line.removeprefix("(rsltrace) "), lines)
        else:
            lines.append(line)
    return answers


def test_a_session_in_a_script(folder: Path) -> None:
    done = script(
        folder,
        [
            "# a comment is nothing",
            "break /smooth: data > 3",
            "break log warn /too/",
            "info breakpoints",
            "continue",
            "continue",
            "print data",
            "print event",
            "p last",
            "p node('filter').state > 3",
            "info message",
            "list",
            "who-sent",
            "delete 1",
            "c",
            "where",
            "who-changed filter warned",
            "when filter.state > 1",
            "reverse-step 2",
            "next /source",
            "goto 30",
            "quit",
        ],
    )
    assert (done.returncode, done.stderr.splitlines()[0][:10]) == (0, "debugging "), done.stderr
    answers = said(done)
    assert answers["info breakpoints"] == ["  1  /smooth: data > 3", "  2  log warn /too/"]
    sent = answers["continue"]
    assert (
        sent[0]
        == "breakpoint 1 (/smooth: data > 3): /filter has published on /smooth, and data > 3"
    )
    assert re.fullmatch(
        r"   event \d+  0\.\d{9}  /filter: subscription /speed  -> /smooth", sent[1]
    )
    value = float(answers["print data"][0])
    assert value > 3
    here = r"event \d+  0\.\d{9}  /watch: subscription /smooth"
    assert re.fullmatch(here, answers["print event"][0])
    assert 0 < float(answers["p last"][0]) <= 3, "the callback has not run yet"
    assert answers["p node('filter').state > 3"] == ["True"]
    assert answers["info message"][0].split() == ["name", "/smooth"]
    assert float(answers["info message"][3].split()[1]) == value
    assert answers["list"][1].endswith("def got(self, message):")
    assert answers["list"][0].startswith("Watch.got, nodes_of_debug.py:")
    assert "/filter: subscription /speed" in answers["who-sent"][0]
    assert answers["c"][0].startswith("breakpoint 2 (log warn /too/): log 'too fast'")
    warned = answers["c"][1].split()[1]
    assert f"event {warned} " in answers["where"][0]
    assert f"event {warned} " in answers["who-changed filter warned"][0]
    assert answers["when filter.state > 1"][1].strip().startswith("goto ")
    assert f"event {int(warned) - 2} " in answers["reverse-step 2"][0]
    assert "/source: timer" in answers["next /source"][0]
    assert answers["goto 30"][0].split()[1] == "29"


@pytest.mark.long
def test_pdb_in_the_first_line_of_a_callback(folder: Path) -> None:
    done = script(
        folder,
        [
            "break entity /smooth",
            "continue",
            "pdb",
            "p message.data",
            "next",
            "p self.last == message.data",
            "!self.last = -1.0",
            "continue",
            "print last",
            "step",
            "print last > 0",
        ],
    )
    assert done.returncode == 0, done.stderr
    text = done.stdout
    assert "nodes_of_debug.py(" in text
    assert "got()\n-> self.last = message.data\n(Pdb) p message.data\n0.1875\n" in text
    assert "(Pdb) p self.last == message.data\nTrue\n" in text
    answers = said(done)
    assert answers["print last"] == ["0.0"], "what happens under pdb happens in a copy"
    assert answers["print last > 0"] == ["True"]


@pytest.mark.long
def test_what_if_at_the_prompt(folder: Path) -> None:
    edit = 'edit node("/filter").state = 1000.0'
    done = script(folder, ["goto 300", edit, "print filter.state", "keep if.mcap", "edit what"])
    assert said(done)["print filter.state"] == ["1000.0"], done.stderr
    assert said(done)["keep if.mcap"] == ["wrote if.mcap"]
    assert "an edit is one of" in done.stdout + done.stderr
    (folder / "if.mcap").unlink()


@pytest.mark.long
def test_a_script_ends_at_the_first_command_that_is_wrong(folder: Path) -> None:
    done = script(folder, ["break /smooth: data > 3", "break /smoth: data > 3", "continue"])
    assert done.returncode == 2
    assert done.stderr.splitlines()[-3:] == [
        "error: no topic or service is called '/smoth'; did you mean '/smooth'?",
        "  /smoth: data > 3",
        "  ^^^^^^",
    ]
    assert "(rsltrace) continue" not in done.stdout


@pytest.mark.long
def test_a_job_can_be_debugged_without_a_trace(folder: Path) -> None:
    done = script(
        folder,
        [
            "break node /later",
            "goto 10",
            "delete",
            "continue",
            "goto 14",
            "p node('filter').state > 0",
            "info ch",
        ],
        "--set",
        "stop.duration=100ms",
        "-c",
        "step 2",
        source="job.yaml",
    )
    assert done.returncode == 0, done.stderr
    assert next(iter(said(done))) == "step 2", "the command line comes first"
    assert said(done)["continue"][0].startswith("the run is over: duration of 0.1")
    assert "/filter: " in said(done)["goto 14"][0]
    assert said(done)["p node('filter').state > 0"] == ["True"]
    assert said(done)["info ch"][0].startswith("before event 0")


@pytest.mark.long
def test_a_run_that_does_something_else_is_a_status(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    nodes = other / "nodes_of_debug.py"
    nodes.write_text(nodes.read_text().replace("0.75", "0.7"))
    done = script(other, ["continue", "where", "step"])
    assert done.returncode == 1
    assert "(has changed)" in done.stderr
    assert said(done)["continue"][0].startswith("the run has diverged")


@pytest.mark.long
def test_what_a_trace_names_runs_only_if_somebody_agrees(folder: Path, tmp_path: Path) -> None:
    done = script(tmp_path, ["step"], source=str(folder / "run.mcap"))
    assert done.returncode == 2
    assert "nothing was run; use --trust if" in done.stderr
    assert "(rsltrace)" not in done.stdout


# -- on a terminal ---------------------------------------------------------------------------------


class Terminal:
    """The command on a pseudo-terminal: what is typed, and what is then on the screen."""

    def __init__(self, folder: Path, *words: str) -> None:
        self._pid, self._end = pty.fork()
        if self._pid == 0:
            os.chdir(folder)
            os.environ["TERM"] = "dumb"
            os.execv(COMMAND[0], [*COMMAND, *words])
        self.screen = ""

    def until(self, text: str) -> str:
        """Wait for a text; return what came up to its end."""
        limit_s = time.monotonic() + LIMIT_S
        while text not in self.screen:
            assert time.monotonic() < limit_s, f"{text!r} has not come: {self.screen[-2000:]}"
            if select.select([self._end], [], [], 1.0)[0]:
                try:
                    self.screen += os.read(self._end, 65536).decode("utf-8", "replace")
                except OSError:
                    raise AssertionError(f"ended without {text!r}: {self.screen}") from None
        found, _, self.screen = self.screen.partition(text)
        return found.replace("\r", "")

    def type(self, text: str) -> None:
        """Press keys."""
        os.write(self._end, text.encode())

    def ask(self, line: str, prompt: str = "(rsltrace) ") -> str:
        """Type a line; return what came before the next prompt."""
        self.type(f"{line}\n")
        return self.until(prompt).partition("\n")[2]

    def interrupt(self) -> None:
        """Press Ctrl-C, again where that came before anybody was asked, up to a new prompt."""
        for _ in range(10):
            self.type("\x03")
            if select.select([self._end], [], [], LIMIT_S / 10)[0]:
                break
        self.until("(rsltrace) ")

    def end(self) -> int:
        """Return the exit status."""
        while True:
            try:
                if not os.read(self._end, 65536):
                    break
            except OSError:
                break
        os.close(self._end)
        pid, self._pid = self._pid, 0
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])

    def close(self) -> None:
        """Kill it, unless it has ended."""
        if self._pid:
            os.kill(self._pid, signal.SIGKILL)
            self.end()


@pytest.fixture
def on_terminal() -> Iterator[Callable[..., Terminal]]:
    """Start the command on a terminal; it does not outlive the test."""
    started: list[Terminal] = []

    def start(folder: Path, *words: str) -> Terminal:
        started.append(Terminal(folder, *words))
        return started[-1]

    yield start
    for one in started:
        one.close()


@pytest.mark.long
def test_a_session_on_a_terminal(folder: Path, on_terminal: Callable[..., Terminal]) -> None:
    terminal = on_terminal(folder, "run.mcap")
    terminal.until("(rsltrace) ")
    assert "did you mean '/smooth'?" in terminal.ask("break /smoth: data > 3")
    assert "breakpoint 1" in terminal.ask("break entity /smooth")
    assert "-> event " in terminal.ask("c")
    first = terminal.ask("where")
    assert terminal.ask("").endswith(""), "where is not repeated"
    terminal.type("who-ch\t")
    terminal.until("who-changed ")
    terminal.type("\x15")  # the line is gone
    second = terminal.ask("c")
    assert second != first
    third = terminal.ask("")  # an empty line does the same again
    assert "-> event " in third
    assert third != second
    assert "-> self.last = message.data" in terminal.ask("pdb", "(Pdb) ")
    assert terminal.ask("p self.last < message.data", "(Pdb) ").strip() == "True"
    assert terminal.ask("q") == third.splitlines(keepends=True)[-1]
    terminal.interrupt()
    assert "event " in terminal.ask("step")
    terminal.type("\x04")
    assert terminal.end() == 0


@pytest.mark.long
def test_ctrl_c_stops_the_run_and_not_the_session(
    folder: Path, tmp_path: Path, on_terminal: Callable[..., Terminal]
) -> None:
    long = tmp_path / "long"
    shutil.copytree(folder, long)
    job = (long / "job.yaml").read_text().replace("duration: 3s", "duration: 1000000s")
    (long / "job.yaml").write_text(job)
    nodes = (long / "nodes_of_debug.py").read_text()
    there = "        self.count += 1\n        if self.count == 100: open('there', 'w').close()\n"
    (long / "nodes_of_debug.py").write_text(nodes.replace("        self.count += 1\n", there))
    terminal = on_terminal(long, "job.yaml")
    terminal.until("(rsltrace) ")
    terminal.ask("step 10")
    terminal.type("continue\n")
    terminal.until("continue")
    limit_s = time.monotonic() + LIMIT_S
    while not (long / "there").exists():
        assert time.monotonic() < limit_s, terminal.screen
        time.sleep(0.05)
    terminal.type("\x03")
    answer = terminal.until("(rsltrace) ")
    assert "interrupted" in answer
    at = int(re.findall(r"event (\d+)", answer)[-1])
    assert at > 10
    assert f"event {at - 1} " in terminal.ask("rs")
    terminal.type("quit\n")
    assert terminal.end() == 0


@pytest.mark.long
def test_a_session_that_is_killed_leaves_nobody(
    folder: Path, on_terminal: Callable[..., Terminal]
) -> None:
    terminal = on_terminal(folder, "run.mcap")
    terminal.until("(rsltrace) ")
    terminal.ask("goto 100")
    family = descendants(terminal._pid)
    assert len(family) >= 2
    os.kill(terminal._pid, signal.SIGKILL)
    terminal.end()
    limit_s = time.monotonic() + LIMIT_S
    while left := [pid for pid in family if is_alive(pid)]:
        assert time.monotonic() < limit_s, f"still there: {left}"
        time.sleep(0.05)


def descendants(pid: int) -> list[int]:
    """Return the processes below one."""
    found = []
    with suppress(OSError):  # it has ended, or a thread of it
        for task in Path(f"/proc/{pid}/task").iterdir():
            for word in (task / "children").read_text().split():
                found += [int(word), *descendants(int(word))]
    return found


def is_alive(pid: int) -> bool:
    """Whether a process runs: one that has ended and waits for its parent does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
