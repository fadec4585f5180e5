"""What cannot be made deterministic is found: in the trace, info, cat and diff, or as an error."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis.strategies import none

from rsltrace.errors import GuardError, JobError
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource
from rsltrace.trace.reader import Trace
from tests.guard.conftest import node_code

pytestmark = pytest.mark.ros

NAME = "N." if sys.version_info >= (3, 11) else ""
TICK, INIT = f"m.py:15 in {NAME}tick", f"m.py:9 in {NAME}__init__"
READS = node_code(
    "self.say(os.environ.get('SHIFT', '0'))",
    imports="import os",
    init="self.token = os.getenv('MY_TOKEN')",
)


@pytest.fixture
def recorded(tmp_path: Path) -> Callable[..., Any]:
    """Write and record a job of node ``m:N``; its result."""

    def go(code: str, guard: str = "{}", name: str = "run") -> Any:
        (tmp_path / "m.py").write_text(code)
        (tmp_path / "job.yaml").write_text(
            f"nodes: [{{node: 'm:N'}}]\nstop: {{duration: 1.2s}}\nguard: {guard}\n"
        )
        return run(load_job(tmp_path / "job.yaml"), tmp_path / f"{name}.mcap", force=True)

    return go


@pytest.mark.long
def test_a_finding_says_where_what_and_what_it_gave(
    recorded: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHIFT", "7")
    monkeypatch.setenv("MY_TOKEN", "s3cret")
    result = recorded(READS)
    with Trace.open(result.path) as trace:
        found = [f for findings in trace.findings.values() for f in findings]
        assert [(f.event, f.node, f.call, f.value) for f in found][1:] == [
            (1, "/n", "os.environ['SHIFT']", "'7'"),
            (2, "/n", "os.environ['SHIFT']", "'7'"),
        ]
        assert found[0].value.startswith("SHA-256 "), "what may be a secret is not written down"
        assert {(f.source, f.mode) for f in found} == {
            (NondeterminismSource.ENVIRONMENT, GuardMode.WARN)
        }
        assert found[1].stack == TICK
        assert trace.guarded == result.guarded
    assert b"s3cret" not in result.path.read_bytes()


@pytest.mark.long
def test_findings_change_no_digest(
    recorded: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    warned = recorded(READS)
    allowed = recorded(READS, "{environment: allow}", "allowed")
    assert warned.digest == allowed.digest
    assert not allowed.guarded
    with Trace.open(allowed.path) as trace:
        assert trace.findings == {}
        assert "/rsltrace/findings" not in {c.topic for c in trace.channels.values()}


@pytest.mark.long
def test_an_error_ends_the_run_and_says_what_to_do(recorded: Callable[..., Any]) -> None:
    result = recorded(READS, "{environment: error}")
    assert isinstance(result.error, GuardError)
    assert result.exit_code == 3
    assert "os.environ['MY_TOKEN'] at " + INIT in str(result.error)
    assert "make it a parameter of the node" in str(result.error)
    with Trace.open(result.path) as trace:
        assert [f.mode for f in trace.findings[0]] == [GuardMode.ERROR]


@pytest.mark.few(1)
@pytest.mark.parametrize("call", ["time.time()", "random.random()", "random.Random()"])
def test_what_could_be_virtual_may_be_an_error_too(recorded: Callable[..., Any], call: str) -> None:
    @given(none())
    def installs_a_callback_of_the_garbage_collector(_: None) -> None: ...

    installs_a_callback_of_the_garbage_collector()  # it reads a clock in any node's event
    code = node_code(f"gc.collect(), {call}", imports="import gc, random, time")
    result = recorded(code, "{clock: error, random: error}")
    assert isinstance(result.error, GuardError)
    assert TICK in str(result.error)


@pytest.mark.long
def test_modules_on_the_list_are_allowed(recorded: Callable[..., Any]) -> None:
    assert not recorded(READS, "{environment: {mode: error, allow: [m]}}").error
    assert recorded(READS, "{environment: {mode: error, allow: [m.*, other]}}").error


@pytest.mark.long
def test_imports_are_watched_and_libraries_are_not(recorded: Callable[..., Any]) -> None:
    code = node_code(
        "logging.getLogger('x').debug('y'); copy.deepcopy({1: [2]}); json.dumps({1: 2})",
        imports="import copy, json, logging, os, wave, sqlite3\nX = os.environ.get('SHIFT')",
    )
    result = recorded(code)
    counted = [(met.call, met.node, met.count) for met in result.guarded if met.is_finding]
    assert counted == [("os.environ['SHIFT']", "", 1)]
    with Trace.open(result.path) as trace:
        assert {event: [f.call for f in found] for event, found in trace.findings.items()} == {
            0: ["os.environ['SHIFT']"]
        }


def test_where_python_looks_for_the_line_of_a_syntax_error_is_no_finding(
    recorded: Callable[..., Any],
) -> None:
    """As a traceback does from Python 3.13 on, of its own lines."""
    imports = "import ast\nfrom contextlib import suppress"
    code = node_code("with suppress(SyntaxError):\n    ast.parse('1 +')", imports=imports)
    with Trace.open(recorded(code).path) as trace:
        assert not [met for met in trace.guarded if met.is_finding]


@pytest.mark.long
def test_a_million_calls_in_an_event_are_not_a_million_records(
    recorded: Callable[..., Any],
) -> None:
    result = recorded(node_code("for _ in range(3000): id(self)"))
    with Trace.open(result.path) as trace:
        assert [len(found) for found in trace.findings.values()] == [100, 100]
    assert [met.count for met in result.guarded] == [6000]


@pytest.mark.long
def test_what_a_main_has_read_is_the_likely_cause(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import rsltrace

    (tmp_path / "prog.py").write_text(
        "import os, rclpy\nfrom std_msgs.msg import String\nWHO = os.environ.get('WHO')\n"
        "def main():\n"
        "    rclpy.init()\n"
        "    node = rclpy.create_node('prog')\n"
        "    who = node.create_publisher(String, 'who', 10)\n"
        "    rclpy.spin_once(node, timeout_sec=0.1)\n"
        "    who.publish(String(data=str(WHO)))\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{main: 'prog:main'}]\nsearch_path: [.]\n")
    for name in "ab":
        monkeypatch.setenv("WHO", name * 3)
        job = rsltrace.load_job(tmp_path / "job.yaml")
        rsltrace.record(job, tmp_path / f"{name}.mcap")
    found = rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap")
    cause = "main prog:main read WHO (aaa in a, bbb in b) at prog.py:3"
    assert cause in found.sentence
    assert "not deterministic" not in found.divergences[0].root_sentence


@pytest.mark.long
def test_info_cat_and_diff_tell(
    recorded: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    recorded(READS, name="a")
    monkeypatch.setenv("SHIFT", "9")
    recorded(READS, name="b")

    def command(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "rsltrace", *arguments],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode in (0, 1), done.stderr
        return done.stdout

    info = command("info", "a.mcap")
    assert "guard findings: 3" in info
    assert re.search(r"os\.environ\['SHIFT'\] +\d+  m\.py:\d+$", info, re.MULTILINE), info
    assert "! environment warn: os.environ['SHIFT'] -> '9'  at " + TICK in command("cat", "b.mcap")
    last = json.loads(command("cat", "b.mcap", "--json", "--kind", "timer").splitlines()[0])
    assert last["findings"][0]["value"] == "'9'"
    report = command("diff", "a.mcap", "b.mcap")
    assert "verdict: same-input-different-output" in report
    assert "! environment: os.environ['SHIFT']  not set  |  '9'" in report
    assert "likely cause: /n read SHIFT (not set in a, 9 in b) at m.py:" in " ".join(report.split())
    as_json = json.loads(command("diff", "a.mcap", "b.mcap", "--format", "json"))
    assert as_json["divergences"][0]["calls"][0] == {
        "source": "environment",
        "call": "os.environ['SHIFT']",
        "where": TICK,
        "event_a": 1,
        "event_b": 1,
        "a": "not set",
        "b": "'9'",
        "subject": "SHIFT",
        "short": ["not set", "9"],
        "only_touched": False,
    }


def test_a_diff_remembers_what_the_node_read_before(
    recorded: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    from rsltrace.diff import diff_files

    code = node_code(
        "self.say(self.shift)", imports="import os", init="self.shift = os.environ.get('SHIFT')"
    )
    a = recorded(code, name="a")
    monkeypatch.setenv("SHIFT", "9")
    b = recorded(code, name="b")
    (found,) = diff_files(str(a.path), str(b.path)).divergences
    assert [(c.call, c.event_a, c.a, c.b) for c in found.calls] == [
        ("os.environ['SHIFT']", 0, "not set", "'9'")
    ]
    assert found.root_sentence == f"/n read SHIFT (not set in a, 9 in b) at {INIT.split()[0]}"


@pytest.mark.parametrize(
    ("guard", "message"),
    [
        ("{clock: vrtual}", "guard.clock: expected one of virtual, record, warn, error, allow"),
        ("{thread: virtual}", "the answers of this source cannot be made 'virtual'"),
        ("{thread: record}", "what this source answers cannot be recorded"),
        ("{clok: warn}", "unknown key 'clok' in guard; did you mean 'clock'?"),
        ("{file: {mode: warn, allow: [a/b]}}", "expected the name of a module"),
        ("{state: maybe}", "guard.state: expected true, false or record"),
    ],
)
def test_mistakes_in_guard_point_at_their_line(
    recorded: Callable[..., Any], guard: str, message: str
) -> None:
    with pytest.raises(JobError, match=r"job\.yaml:3:") as raised:
        recorded(node_code("pass"), guard)
    assert message in str(raised.value)


@pytest.mark.long
def test_the_c_library_through_cffi_is_a_finding(recorded: Callable[..., Any]) -> None:
    pytest.importorskip("cffi")
    tick = (
        "ffi = cffi.FFI()\n"
        'ffi.cdef("long clock(void); int abs(int); extern char **environ;")\n'
        "lib = ffi.dlopen(None)\n"
        "lib.clock(), lib.environ\n"
        "assert lib.abs(-3) == 3"
    )
    result = recorded(node_code(tick, imports="import cffi"))
    assert result.error is None
    found = [(met.source, met.node, met.call, met.count) for met in result.guarded]
    assert (NondeterminismSource.CLOCK, "/n", "C library: clock()", 2) in found
    assert not [call for _, _, call, _ in found if "abs" in call or "environ" in call]
    refused = recorded(node_code(tick, imports="import cffi"), "{clock: error}", "x").error
    assert isinstance(refused, GuardError)
