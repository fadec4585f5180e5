"""Answers are short, whatever they are about; folders and trust hold; nothing is left behind."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import anyio
import pytest

from campaigns.attack import mcap_parts
from campaigns.attack.families.texts import with_strings
from rsltrace.child_processes import rsltrace_command
from rsltrace.cli.mcp_server.access import Access, RefusedError
from rsltrace.cli.mcp_server.answers import ANSWER_BYTES_MAX, PageKeeper, answer, bounded, page_of
from rsltrace.cli.mcp_server.commands import CommandResult, run_command
from rsltrace.cli.mcp_server.server import VERDICTS, job_part
from rsltrace.cli.mcp_server.sessions import Sessions
from rsltrace.cli.mcp_server.tools import RUNNING, TOOLS, Tools
from rsltrace.trace.model.texts import printable_lines

from .conftest import Call, converse

pytest.importorskip("mcp.server.mcpserver")

_SYNTHETIC = Path(__file__).parents[2] / "benchmarks" / "synthetic.py"


def write_synthetic(path: Path, events: int, diverges_at: int | None = None) -> None:
    spec = importlib.util.spec_from_file_location("synthetic", _SYNTHETIC)
    assert spec is not None
    assert spec.loader is not None
    synthetic = sys.modules["synthetic"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(synthetic)
    synthetic.write_trace(path, synthetic.Shape(events, diverges_at))


SAMPLES = Path(__file__).parents[2] / "sample_traces"
HOSTILE = b"\x1b[2J\x07\n| x\n"


def write_hostile(source: Path, target: Path) -> None:
    """Write a trace with escapes and line breaks in the names of entities, as long as they were."""

    def change(number: int, text: bytes) -> bytes:
        is_long = number == 0 and len(text) > len(HOSTILE)
        return HOSTILE + text[len(HOSTILE) :] if is_long else text

    parts = mcap_parts.take_apart(source.read_bytes())
    topic = "/rsltrace/entities"
    mcap_parts.change_messages(parts, topic, lambda data, nth: with_strings(data, topic, change))
    target.write_bytes(mcap_parts.put_together(parts))


def size(text: str) -> int:
    return len(text.encode())


@pytest.mark.long
def test_answers_are_short_and_recorded_texts_marked(tmp_path: Path) -> None:
    write_synthetic(tmp_path / "a.mcap", 200_000)
    write_synthetic(tmp_path / "b.mcap", 200_000, 150_001)
    for side in "ab":
        sample = SAMPLES / "nondeterministic_callback" / f"{side}.mcap"
        write_hostile(sample, tmp_path / f"hostile_{side}.mcap")
    answers = converse(
        tmp_path,
        ("overview", {"trace": "a.mcap"}),
        ("events", {"trace": "a.mcap", "limit": 1000}),
        ("events", {"trace": "a.mcap", "skip": 10_000, "limit": 2}),
        ("event", {"trace": "b.mcap", "event": 150_001}),
        ("diff", {"a": "a.mcap", "b": "b.mcap"}),
        ("events", {"trace": "hostile_a.mcap"}),
        ("event", {"trace": "hostile_a.mcap", "event": 64, "sections": ["details", "state"]}),
        ("diff", {"a": "hostile_a.mcap", "b": "hostile_b.mcap"}),
        ("overview", {"trace": "\x1b[2J\u202e\n| x.mcap"}),
        ("record", {"job": "job.yaml", "output": "run.mcap", "trust": True}),
    )
    for text in answers:
        assert printable_lines(text) == text
        assert size(text) <= ANSWER_BYTES_MAX
        for line in text.removeprefix("ERROR ").splitlines()[1:]:
            assert line.startswith(("| ", "|", "next: ", "(")), line
    assert [text.startswith("ERROR") for text in answers] == [False] * 8 + [True] * 2
    assert not [text for text in answers[:8] if "\nnext: " not in text]
    _, many, later, event, diff = answers[:5]
    assert "more lines: skip=" in many
    shown = [line.split()[1] for line in later.splitlines() if line.startswith("| ")]
    assert shown == ["10000", "10001"]
    assert "skip=10002" in later
    assert "150001" in event
    assert "next: event('b.mcap', 150001)" in diff
    assert all("\\x1b[2J" in text for text in answers[5:9])
    assert "rsltrace mcp --trust" in answers[-1]


def test_trust_and_folders_come_from_the_command_line_alone(tmp_path: Path) -> None:
    from rsltrace.cli.mcp_server.server import make_server

    (tmp_path / "job.yaml").write_text("nodes: [{node: 'os:abort'}]\n")
    (tmp_path / "link.mcap").symlink_to(SAMPLES / "schedule" / "job.yaml")
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").symlink_to("/proc/self/environ")

    def errors(calls: Sequence[Call], *, trust: bool) -> list[str]:
        access = Access((tmp_path,), trust=trust, limit_s=60)
        server = make_server(Tools(access, Sessions(access)))

        async def speak() -> list[str]:
            found = []
            for name, arguments in calls:
                with pytest.raises(Exception, match=r".") as raised:
                    await server.call_tool(name, arguments)
                found.append(str(raised.value))
            return found

        return anyio.run(speak)

    job, trace = {"job": "job.yaml"}, {"trace": "job.yaml"}
    running: list[Call] = [
        ("check_job", job),
        ("record", {**job, "output": "run.mcap"}),
        ("verify", job),
        ("explore", {**job, "output": "found"}),
        ("what_if", {**trace, "edits": ["1: drop()"], "output": "branch.mcap"}),
        ("node_state", {**trace, "node": "a", "event": 1}),
        ("run_until", {**trace, "condition": "exception"}),
        ("why", {**trace, "node": "a", "attribute": "x"}),
    ]
    assert {name for name, _ in running} == {*RUNNING, "why"}
    assert all("rsltrace mcp --trust" in text for text in errors(running, trust=False))
    outside: list[Call] = [
        ("overview", {"trace": "../x.mcap"}),
        ("overview", {"trace": "link.mcap"}),
        ("diff", {"a": "bag", "b": "bag"}),
        ("diff", {"a": "job.yaml", "b": "/etc/passwd"}),
        ("record", {**job, "output": "/tmp/x.mcap"}),
        ("explore", {**job, "output": ".."}),
    ]
    assert all("is outside of" in text for text in errors(outside, trust=True))
    wrong: list[Call] = [
        ("overview", {"trace": "https://127.0.0.1:9/a.mcap"}),
        ("overview", {"trace": "a\0b"}),
        ("record", {**job, "output": "job.yaml", "replace": True}),
    ]
    assert len(errors(wrong, trust=True)) == 3
    assert {path.name for path in tmp_path.iterdir()} == {"bag", "job.yaml", "link.mcap"}


def test_a_command_loads_no_module_of_the_working_directory(tmp_path: Path) -> None:
    for module in ("ctypes", "runpy", "os"):
        (tmp_path / f"{module}.py").write_text("raise SystemExit(3)\n")
    done = subprocess.run(rsltrace_command(["--version"]), cwd=tmp_path, timeout=300, check=False)
    assert done.returncode == 0


def test_a_trace_cannot_name_files_to_be_shown(tmp_path: Path) -> None:
    from rsltrace_viewer.model.run import Run

    from rsltrace.cli.mcp_server.event_page import _source

    (tmp_path / "robot.py").write_text("first\nsecond\n")
    (tmp_path / "secret.txt").write_text("secret\n")
    with Run.open(SAMPLES / "schedule" / "a.mcap").trace as trace:
        run = Run(trace)
        trace.job["resolved"] = json.dumps({"search_path": [str(tmp_path)]})
        assert list(_source(run, "robot.py:2", [tmp_path])) == [
            "       1  first",
            "  >    2  second",
        ]
        assert list(_source(run, "robot.py:2", [tmp_path / "other"])) == []
        assert list(_source(run, "secret.txt:1", [tmp_path])) == []


def test_pages() -> None:
    end, start = PageKeeper(end=True), PageKeeper(skip=1)
    for keeper in (end, start):
        for _ in range(100):
            keeper.feed(b"x" * 100_000)
        keeper.feed(b"\nsecond\xff\x1b[2J\n")
        for number in range(3000):
            keeper.feed(f"line {number} é\n".encode())
    assert end.page().lines[-1] == "line 2999 é"
    assert end.page().after == 0
    first = start.page()
    assert first.lines[:2] == ("second\\xff\\x1b[2J", "line 0 é")
    assert first.before + len(first.lines) + first.after == 3002
    following = page_of([f"line {n}" for n in range(3000)], skip=7)
    assert following.lines[0] == "line 7"
    assert "skip=" in answer("t" * 9000, first, ["n" * 9000] * 9)
    assert size(answer("é" * 9000, first, ["é" * 9000] * 9)) <= ANSWER_BYTES_MAX
    assert size(bounded("é" * 9000)) <= ANSWER_BYTES_MAX
    assert bounded("\ud800") == "\\ud800"


def test_names_of_files(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    access = Access((tmp_path / "in", tmp_path / "also"), trust=False, limit_s=1)
    assert access.path("../also/x") == tmp_path / "also" / "x"
    for name in ("../x", "/", "~/../..", "\0"):
        with pytest.raises(RefusedError):
            access.path(name)


ENDLESS = """
import os
from rclpy.node import Node

class Endless(Node):
    def __init__(self):
        super().__init__("endless")
        folder = os.path.dirname(os.path.realpath(__file__))
        with open(os.path.join(folder, "pids"), "a") as file:
            file.write(f"{os.getpid()}\\n")
        self.create_timer(0.001, lambda: None)
"""
_JOB = "nodes: [{node: 'endless:Endless'}]\nstop: {duration: 1000000s}\n"


@pytest.fixture
def endless(tmp_path: Path) -> Path:
    (tmp_path / "endless.py").write_text(ENDLESS)
    (tmp_path / "job.yaml").write_text(_JOB)
    return tmp_path / "pids"


def until(what: Callable[[], bool]) -> None:
    """Wait for something, minutes at most."""
    for _ in range(3000):
        if what():
            return
        time.sleep(0.05)
    raise AssertionError("it did not happen")


def has_begun(pids: Path) -> bool:
    """Return whether a process that runs nodes has written down its number."""
    return pids.exists() and pids.read_text().endswith("\n")


def is_over(pids: Path) -> bool:
    """Return whether the processes that have run nodes are gone."""
    return not any(map(has_command, pids.read_text().split()))


def has_command(pid: str) -> bool:
    """Return whether a process is there: what has ended and was not waited for has none."""
    try:
        return bool(Path(f"/proc/{pid}/cmdline").read_bytes())
    except OSError:
        return False


def test_a_command_has_a_limit_of_time() -> None:
    words = ["0", "--bind", "127.0.0.1"]

    async def serve() -> CommandResult:
        return await run_command(words, 2.0, module="http.server")

    done = anyio.run(serve)
    assert done.status is None
    assert done.has_failed
    assert "took too long" in done.ended


Server = subprocess.Popen[bytes]


def server(folder: Path, *options: str) -> Server:
    return subprocess.Popen(
        [sys.executable, "-m", "rsltrace", "mcp", "--trust", *options],
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )


def send(
    process: subprocess.Popen[bytes], method: str, number: int | None, **params: object
) -> None:
    message = {"jsonrpc": "2.0", "method": method, "params": params}
    if number is not None:
        message["id"] = number
    assert process.stdin is not None
    process.stdin.write(json.dumps(message).encode() + b"\n")
    process.stdin.flush()


def begin(process: Server, tool: str, **arguments: object) -> None:
    """Shake hands, and begin a call."""
    assert process.stdout is not None
    client = {"name": "test", "version": "1"}
    send(process, "initialize", 0, protocolVersion="2025-06-18", capabilities={}, clientInfo=client)
    assert b"rsltrace" in process.stdout.readline()
    send(process, "notifications/initialized", None)
    send(process, "tools/call", 1, name=tool, arguments=arguments)


_CALLS = (
    ("record", {"job": "job.yaml", "output": "run.mcap"}),
    ("explore", {"job": "job.yaml", "output": "found"}),
    ("verify", {"job": "job.yaml"}),
)


@pytest.mark.ros
@pytest.mark.few(1)
@pytest.mark.parametrize("how", ["stdin", "terminated", "killed", "cancelled"])
@pytest.mark.parametrize(("tool", "arguments"), _CALLS)
def test_no_simulation_outlives_the_client(
    tool: str, arguments: dict[str, object], how: str, endless: Path
) -> None:
    process = server(endless.parent)
    with process:
        begin(process, tool, **arguments)
        until(lambda: has_begun(endless))
        if how == "stdin":
            assert process.stdin is not None
            process.stdin.close()
        elif how == "terminated":
            process.send_signal(signal.SIGTERM)
        elif how == "killed":
            process.kill()
        else:
            send(process, "notifications/cancelled", None, requestId=1)
            until(lambda: is_over(endless))
            send(process, "tools/list", 2)
            assert process.stdout is not None
            assert b"run_until" in process.stdout.readline()
            process.kill()
        until(lambda: process.poll() is not None)
    until(lambda: is_over(endless))


@pytest.mark.ros
@pytest.mark.long
@pytest.mark.parametrize("how", ["stdin", "killed"])
def test_no_session_outlives_the_client(how: str, endless: Path) -> None:
    folder = endless.parent
    words = [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-q", "--until", "100"]
    subprocess.run([*words, "-o", "run.mcap"], cwd=folder, check=True, timeout=300)
    endless.unlink()
    process = server(folder, "--limit", "1000")
    with process:
        begin(process, "run_until", trace="run.mcap", condition="when endless.x == 1")
        until(lambda: has_begun(endless))
        assert process.stdin is not None
        if how == "stdin":
            process.stdin.close()
        else:
            os.kill(process.pid, signal.SIGKILL)
        until(lambda: process.poll() is not None)
    until(lambda: is_over(endless))


def test_resources_and_prompts() -> None:
    from mcp.server.mcpserver import MCPServer

    from rsltrace.cli.mcp_server.server import make_server
    from rsltrace.diff.facts.causes import Verdict
    from rsltrace.job.documents.schema import job_schema

    assert set(VERDICTS) == {verdict.value for verdict in Verdict}
    access = Access((Path.cwd(),), trust=False, limit_s=1)
    made: MCPServer = make_server(Tools(access, Sessions(access)))

    async def look() -> None:
        assert [tool.name for tool in await made.list_tools()] == list(TOOLS)
        assert len(await made.list_prompts()) == 4
        for uri in ("verdicts", "job-schema", "job-schema/stop", "job-schema/Node"):
            [content] = await made.read_resource(f"rsltrace://{uri}")  # type: ignore[misc]
            assert size(str(content.content)) <= ANSWER_BYTES_MAX
        prompt = await made.get_prompt("regression", {"golden": "g.mcap", "job": "j.yaml"})
        assert "g.mcap" in str(prompt)

    anyio.run(look)
    parts = [part for part in job_schema()["$defs"] if not part.endswith("Change")]
    assert [p for p in parts if size(job_part(p)) > ANSWER_BYTES_MAX] == ["Job"]


def test_without_the_package_it_says_how_to_install_it(
    command: Callable[..., subprocess.CompletedProcess[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcp", None)
    for name in [
        name for name in sys.modules if name.startswith(("mcp.", "rsltrace.cli.mcp_server."))
    ]:
        monkeypatch.delitem(sys.modules, name)
    done = command("mcp")
    assert done.returncode == 2
    assert "pip install 'rsltrace[mcp]'" in done.stderr
