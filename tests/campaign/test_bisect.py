"""``rsltrace bisect``: the commit that changed a job, in real repositories; nothing is left."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rsltrace.checks.conditions.run_expression import RunExpression
from rsltrace.cli.bisect import _same_everywhere
from rsltrace.errors import ConditionError, RsltraceError
from rsltrace.job import load_job
from rsltrace.search.bisect.repository import GitRepository, Worktree
from rsltrace.search.bisect.search import python_folders
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros
LONG = pytest.mark.long

JOB = "nodes: [{node: 'steps:Steps'}]\nstop: {duration: 1s}\n"
NODE = """
import os, random, sys, time
from rclpy.node import Node
from std_msgs.msg import Float64

class Steps(Node):
    def __init__(self):
        super().__init__('steps')
        self.out = self.create_publisher(Float64, 'x', 10)
        self.create_timer(0.5, self.step)
    def step(self):
        LINE
"""
ONE, TWO = "self.out.publish(Float64(data=1.0))", "self.out.publish(Float64(data=2.0))"
SLOW = "import threading, signal; signal.pause()"


class Robot:
    """A repository with a job; ``commit`` writes files and returns the commit's hash."""

    def __init__(self, top: Path) -> None:
        self.top = top
        top.mkdir(parents=True)
        self.git("init", "-q", "-b", "main")
        self.git("config", "user.name", "Ada")
        self.git("config", "user.email", "ada@example.org")

    def git(self, *words: str) -> str:
        command = ["git", "-c", "commit.gpgsign=false", *words]
        env = {**os.environ, "GIT_CONFIG_GLOBAL": os.devnull, "GIT_OPTIONAL_LOCKS": "0"}
        done = subprocess.run(
            command, cwd=self.top, env=env, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    def commit(self, message: str, **files: str) -> str:
        for name, text in files.items():
            path = self.top / name.replace("__", ".")
            path.write_text(NODE.replace("LINE", text) if name == "steps__py" else text)
        self.git("add", "--all")
        self.git("commit", "--quiet", "--allow-empty", "-m", message)
        return self.git("rev-parse", "HEAD")

    def bisect(self, *words: str, env: dict[str, str] | None = None) -> Any:
        command = [sys.executable, "-m", "rsltrace", "bisect", *words]
        return subprocess.run(
            command,
            cwd=self.top,
            env={**os.environ, **(env or {})},
            capture_output=True,
            text=True,
            check=False,
        )

    def state(self) -> dict[str, object]:
        """All of the checkout and of what git knows, but for how git stores its references."""
        files = {
            str(path.relative_to(self.top)): path.read_bytes()
            for path in sorted(self.top.rglob("*"))
            if path.is_file() and path.name != "packed-refs"
        }
        git = {
            words: self.git(*words.split()) for words in ("worktree list", "status", "for-each-ref")
        }
        return {**files, **git}


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Whatever a test leaves in the folder of temporary files is a failure."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    yield folder
    assert not list(folder.iterdir())


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path / "src" / "robot")


@pytest.mark.long
def test_the_commit_that_changed_the_digest_is_named_and_the_checkout_is_as_it_was(
    robot: Robot,
) -> None:
    good = robot.commit("Begin", job__yaml=JOB, steps__py=ONE)
    changed = robot.commit("Twice as fast\n\nand why", steps__py=TWO)
    robot.commit("Say even more", README__md="even more")
    (robot.top / "steps.py").write_text("not committed, and no Python")
    (robot.top / "own.txt").write_text("mine")
    before = robot.state()
    done = robot.bisect("--good", good, "--bad", "main", "job.yaml", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["first"]["commit"] == changed
    assert result["first"]["subject"] == "Twice as fast"
    assert result["files"] == ["steps.py"]
    assert result["before"] == result["first"]["parents"][0] == good
    assert [one["answer"] for one in result["tried"][:2]] == ["good", "bad"]
    assert result["diff"]["verdict"] == "same-input-different-output"
    after = robot.state()
    assert {name for name in {*before, *after} if before.get(name) != after.get(name)} == set()
    assert done.stderr.startswith(f"good  {good[:7]}"), "progress is told"


@LONG
def test_what_does_not_run_is_skipped_and_the_answer_is_a_range(
    robot: Robot, tmp_path: Path
) -> None:
    good = robot.commit("Begin", job__yaml=JOB, steps__py=ONE)
    robot.commit("Half of it", steps__py="raise ValueError('half')")
    robot.commit("No Python", steps__py="not Python (")
    robot.commit("All of it", steps__py=TWO)
    done = robot.bisect("--good", good, "--bad", "HEAD", "job.yaml", "-o", str(tmp_path / "kept"))
    assert done.returncode == 1, done.stderr
    first, *rest = done.stdout.splitlines()
    assert first.startswith("first changed at one of these 3 commits")
    assert [line.split(maxsplit=1)[1] for line in rest[:3]] == [
        "Half of it",
        "No Python",
        "All of it",
    ]
    assert "ValueError: half" in done.stderr
    assert "job.yaml:1:" in done.stderr, "a revision's file is named as in the repository"
    assert "|a-b| 1" in done.stdout
    again = subprocess.run(
        [sys.executable, "-m", "rsltrace", "diff", "before.mcap", "after.mcap"],
        cwd=tmp_path / "kept",
        capture_output=True,
        text=True,
        check=False,
    )
    assert again.returncode == 1
    assert again.stdout.splitlines()[0] in done.stdout
    page = (tmp_path / "kept/report.html").read_text()
    assert "<h1>first changed at one of these 3 commits" in page
    assert page.index("before.mcap") < page.index("after.mcap")
    refused = robot.bisect(
        "--good", good, "--bad", "HEAD", "job.yaml", "-o", str(tmp_path / "kept")
    )
    assert (refused.returncode, "before.mcap exists" in refused.stderr) == (2, True)


@LONG
@pytest.mark.parametrize(
    "judge",
    [
        ("--check", "exit_code == 0 and last('/x').data < 2"),
        ("--check", "limits:slow"),
        ("--run", "{python} limits.py"),
    ],
)
def test_a_check_finds_what_digests_hide_and_an_exception_at_an_end_counts(
    robot: Robot, judge: tuple[str, str]
) -> None:
    good = robot.commit("Begin", job__yaml=JOB, steps__py=ONE)
    robot.commit("Another change", steps__py="self.out.publish(Float64(data=1.5))")
    changed = robot.commit("Too fast", steps__py=TWO)
    robot.commit("Raise", steps__py="raise ValueError('at the end')")
    (robot.top / "limits.py").write_text(
        "import os, sys\n"
        "from rsltrace import Trace\n"
        "def slow(trace):\n"
        "    values = [trace.decode('/x', data).data for _, _, data in trace.messages('/x')]\n"
        "    return bool(values) and max(values) < 2\n"
        "if __name__ == '__main__':\n"
        "    sys.exit(0 if slow(Trace.open(os.environ['RSLTRACE_TRACE'])) else 1)\n"
    )
    option, words = judge
    words = words.format(python=sys.executable)
    shared = ["--share", "limits.py"] if option == "--run" else []
    done = robot.bisect("--good", good, "--bad", "main", "job.yaml", option, words, *shared)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"first changed at {changed[:7]} Too fast"), done.stdout


@LONG
def test_merges_and_their_first_parents(robot: Robot) -> None:
    good = robot.commit("Begin", job__yaml=JOB, steps__py=ONE)
    robot.git("checkout", "-q", "-b", "side")
    changed = robot.commit("On a branch", steps__py=TWO)
    robot.git("checkout", "-q", "main")
    robot.commit("On main", README__md="more")
    robot.git("merge", "--quiet", "--no-ff", "-m", "Merge it", "side")
    ends = ("--good", good, "--bad", "main", "job.yaml")
    assert robot.bisect(*ends).stdout.startswith(f"first changed at {changed[:7]} ")
    merged = robot.bisect(*ends, "--first-parent")
    assert "Merge it" in merged.stdout.splitlines()[0], merged.stderr
    assert "a merge of 2 commits" in merged.stdout


@LONG
def test_what_a_job_takes_from_outside_of_its_revisions(robot: Robot, tmp_path: Path) -> None:
    """Neither the job nor its parameters nor the limit beside the repository is tracked."""
    code = "self.out.publish(Float64(data=float(open('../limit.txt').read()) + {}))"
    good = robot.commit("Begin", steps__py=code.format(1), __gitignore="params.yaml")
    changed = robot.commit("One more", steps__py=code.format(2))
    robot.commit("End", README__md="more")
    (robot.top.parent / "limit.txt").write_text("5")
    (robot.top / "params.yaml").write_text("steps: {ros__parameters: {use_sim_time: true}}")
    (robot.top / "job.yaml").write_text(
        "nodes: [{node: 'steps:Steps', parameter_files: [params.yaml]}]\nstop: {duration: 1s}\n"
    )
    done = robot.bisect("--good", good, "--bad", "main", "job.yaml")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"first changed at {changed[:7]} ")
    assert "6.0  |  7.0" in done.stdout


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--good", "main", "--bad", "main", "job.yaml"), "are the same commit"),
        (("--good", "main", "--bad", "main~1", "job.yaml"), "exchange them"),
        (("--good", "v9", "--bad", "main", "job.yaml"), "has no revision 'v9'"),
        (("--good", "-x", "--bad", "main", "job.yaml"), "has no revision '-x'"),
        (("--good", "main~1", "--bad", "main", "job.yaml", "--check", "event > 1"), "'events'?"),
        (("--good", "main~1", "--bad", "main", "../job.yaml"), "not in a checkout of a git"),
        (("--good", "main~1", "--bad", "main", "other.yaml"), "the good revision"),
    ],
)
def test_what_cannot_be_searched_is_said(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], said: str
) -> None:
    from rsltrace.cli.bisect import bisect

    robot.commit("Begin", job__yaml=JOB, steps__py=ONE)
    robot.commit("Change", steps__py=TWO)
    monkeypatch.chdir(robot.top)
    with pytest.raises(RsltraceError) as caught:
        bisect.main(list(words), standalone_mode=False)
    assert said in str(caught.value)


@pytest.mark.long
@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"README__md": "more"}, "have the same run"),
        pytest.param(
            {"steps__py": "self.get_logger().info(str(time.time_ns()))"},
            "the job is not deterministic at",
            marks=LONG,
        ),
    ],
)
def test_ends_without_an_answer_are_said(robot: Robot, files: dict[str, str], said: str) -> None:
    good = robot.commit("Begin", job__yaml=JOB + "guard: false\n", steps__py=ONE)
    robot.commit("Another", **files)
    done = robot.bisect("--good", good, "--bad", "main", "job.yaml")
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr


def test_a_check_looks_at_a_trace() -> None:
    path = Path(__file__).parents[2] / "sample_traces/delayed_input/a.mcap"
    with Trace.open(path) as trace:
        topic = "/odom"
        for text, holds in (
            (f"events == {trace.event_count} and digest == '{trace.digest}'", True),
            (f"count('{topic}') > 3 and count('/nothing') == 0", True),
            (f"len(messages('{topic}')) == count('{topic}')", True),
            (f"last('{topic}') != first('{topic}') or end < 0", True),
        ):
            assert bool(RunExpression(text).value(trace)) is holds, text
        with pytest.raises(ConditionError, match="there is no topic /nothing"):
            RunExpression("last('/nothing').data > 1").value(trace)


def test_packages_that_are_installed_in_place_are_those_of_the_revision(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ``pip install -e`` has them: on Python's path, or known to a finder of setuptools'."""
    (robot.top / "src/steps").mkdir(parents=True)
    (robot.top / "flat").mkdir()
    (robot.top / "build").mkdir()
    (robot.top / "build/copied.py").write_text("")
    (robot.top / "src/steps/__init__.py").write_text("")
    (robot.top / "flat/x.py").write_text("")
    (robot.top / "job.yaml").write_text(
        "nodes: [{node: 'steps:Steps'}, {node: 'copied:Copied'}]\nstop: {duration: 1s}\n"
    )
    robot.commit("Begin", __gitignore="build")
    finder = type("Finder", (), {"__module__": "__editable___robot_finder", "find_spec": None})
    module = types.ModuleType("__editable___robot_finder")
    module.MAPPING = {"x": str(robot.top / "flat/x")}  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, finder])
    for name in ("src", "build"):
        monkeypatch.syspath_prepend(str(robot.top / name))
    repository = GitRepository.of(robot.top / "job.yaml")
    assert python_folders(repository) == [robot.top / "src", robot.top / "flat"]
    (note,) = _same_everywhere(repository, load_job(robot.top / "job.yaml"))
    assert note.startswith(f"copied is loaded from {robot.top}/build/copied.py at every revision")


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_however_it_ends_nothing_is_left_behind(
    robot: Robot, temporary: Path, number: signal.Signals
) -> None:
    good = robot.commit("Begin", job__yaml=JOB, steps__py=SLOW)
    robot.commit("Change", steps__py=TWO)
    before = robot.state()
    command = [sys.executable, "-m", "rsltrace", "bisect", "--good", good, "--bad", "main"]
    process = subprocess.Popen(
        [*command, "job.yaml"], cwd=robot.top, stderr=subprocess.DEVNULL, start_new_session=True
    )
    run = _wait(lambda: _recording(temporary))
    process.send_signal(number)
    assert process.wait(timeout=600) in (128 + number, -number)
    _wait(lambda: not list(temporary.iterdir()))
    _wait(lambda: not Path(f"/proc/{run}").exists())
    assert robot.state() == before


def _recording(folder: Path) -> int:
    """Return the process that records below a folder, 0 if none does yet."""
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes().decode().split("\0")
        except (OSError, UnicodeDecodeError):
            continue
        if "record" in words and any(word.startswith(str(folder)) for word in words):
            return int(entry.name)
    return 0


def _wait(condition: Callable[[], Any]) -> Any:
    for _ in range(12_000):
        if found := condition():
            return found
        time.sleep(0.05)
    raise AssertionError("it did not come about within ten minutes")


@pytest.mark.long
def test_hooks_and_a_search_of_the_users_own_are_left_alone(robot: Robot, tmp_path: Path) -> None:
    robot.commit("Begin", job__yaml=JOB)
    robot.commit("More", README__md="more")
    hook = robot.top / ".git/hooks/post-checkout"
    hook.write_text(f"#!/bin/sh\ntouch {tmp_path}/hooked\n")
    hook.chmod(0o755)
    robot.git("bisect", "start", "main", "main~1")
    (tmp_path / "hooked").unlink(missing_ok=True)
    before = robot.state()
    with Worktree(GitRepository.of(robot.top / "job.yaml")) as tree:
        tree.check_out("main~1")
        assert not (tree.tree / "README.md").exists()
        (tree.tree / "job.yaml").write_text("a run may write what it likes")
        (tree.tree / "out").mkdir()
        assert "merge base" not in tree.bisect("start", "main", "main~1", "--")
        assert not (tree.tree / "out").exists()
        assert (tree.tree / "job.yaml").read_text() == JOB
    assert robot.state() == before
    assert not (tmp_path / "hooked").exists()


@pytest.mark.parametrize(
    ("text", "said", "column"),
    [
        ("evnts > 1", "did you mean 'events'?", 0),
        ("count('/x') > )", "unmatched", 14),
        ("1 + open('x')", "'open' is no function here; there are", 4),
        ("last('/x').__class__", "no field of a message", 0),
        ("last(digest)", "takes a topic", 0),
        ("(lambda: 1)()", "only functions can be called", 0),
        ("max(events, key=abs)", "functions here take no key=", 16),
        ("f'{digest}'", "an f-string has no place in an expression", 0),
    ],
)
def test_a_check_that_is_none_is_refused_with_its_place(text: str, said: str, column: int) -> None:
    with pytest.raises(ConditionError) as caught:
        RunExpression(text)
    message, shown, caret = str(caught.value).splitlines()
    assert said in message
    assert shown == f"  {text}"
    assert caret.index("^") - 2 == column
