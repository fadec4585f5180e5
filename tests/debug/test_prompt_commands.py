"""The commands of the prompt: names and abbreviations, help, and what is printed of answers."""

from __future__ import annotations

import io
from collections.abc import Callable

import pytest

from rsltrace.debug.checkpoints import Breakpoint, RunPosition, StopReport
from rsltrace.debug.prompt.command_table import COMMANDS, INFO
from rsltrace.debug.prompt.shell import DebugPrompt, completions
from rsltrace.debug.prompt.show import (
    graph_lines,
    position_line,
    queue_lines,
    source_lines,
    stopped_lines,
    value_lines,
    where_lines,
)
from rsltrace.errors import DebugError

EVENT = {
    "index": 7,
    "stamp_ns": 1_500_000_000,
    "kind": "subscription",
    "node": "/ekf",
    "entity": "/scan",
    "entity_kind": "subscription",
    "flags": 1,
    "cause_event": 5,
    "cause_output": 0,
    "outputs": 2,
    "did": ["/odom", "log WARN too \x1b[2Jfar"],
    "state_hash": "0" * 16,
    "chain_hash": "ab" * 8,
}


@pytest.mark.parametrize(
    ("word", "name"),
    [
        ("s", "step"),
        ("n", "next"),
        ("c", "continue"),
        ("fin", "finish"),
        ("until", "run-to"),
        ("rs", "reverse-step"),
        ("back", "reverse-step"),
        ("reverse-n", "reverse-next"),
        ("rc", "reverse-continue"),
        ("g", "goto"),
        ("b", "break"),
        ("br", "break"),
        ("p", "print"),
        ("i", "info"),
        ("who-c", "who-changed"),
        ("bt", "where"),
        ("?", "help"),
        ("q", "quit"),
    ],
)
def test_abbreviations_are_those_of_gdb_and_pdb(word: str, name: str) -> None:
    assert COMMANDS.find(word).name == name


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("reverse", "'reverse' could be reverse-continue, reverse-next, reverse-step"),
        ("contineu", "did you mean 'continue'?"),
        ("xyzzy", "'help' lists what there is"),
    ],
)
def test_a_word_that_is_no_command(word: str, says: str) -> None:
    with pytest.raises(DebugError, match=says.replace("?", r"\?")):
        COMMANDS.find(word)


def test_help_has_every_command_and_every_command_has_help() -> None:
    shown = "\n".join(COMMANDS.help())
    for command in COMMANDS.all:
        assert f" {command.name} " in f"{shown} ", command.name
        first = command.help.splitlines()[0]
        assert first.endswith(".")
        assert len(first) < 100
        assert next(COMMANDS.help(command.names[-1])).startswith(command.name)
    assert "info stacks" not in shown
    assert "stacks" in INFO


def test_where_a_run_stands() -> None:
    at = RunPosition(8, 1_500_000_000, EVENT)
    line = (
        "   event 7  1.500000000  /ekf: subscription /scan  -> /odom, "
        r"log WARN too \x1b[2Jfar  [raised]"
    )
    assert position_line(at) == line
    assert list(where_lines(at)) == [
        line,
        "   caused by event 5, its output 0",
        f"   chain hash {'ab' * 8}",
    ]
    assert position_line(RunPosition(0, 0)) == "   nothing has run yet  0.000000000"
    following = {"kind": "timer", "node": "/ekf", "entity": "Ekf.tick", "entity_kind": "timer"}
    coming = RunPosition(8, 2_000_000_000, EVENT, is_next=True, next=following)
    assert position_line(coming) == "-> event 8  2.000000000  /ekf: timer Ekf.tick"


def test_why_a_run_has_stopped() -> None:
    at = RunPosition(8, 1_500_000_000, EVENT)
    hit = StopReport("breakpoint", at, Breakpoint(2, "watch ekf.x"), "ekf.x: 1 -> 2")
    assert next(stopped_lines(hit)) == "breakpoint 2 (watch ekf.x): ekf.x: 1 -> 2"
    assert len(list(stopped_lines(StopReport("step", at)))) == 1
    over = next(stopped_lines(StopReport("end", at, None, "duration of 2 s")))
    assert over == "the run is over: duration of 2 s"


def test_tables_of_what_is_in_a_run() -> None:
    rows = [
        {"node": "/ekf", "name": "Ekf.tick", "period_ns": 10_000_000, "due_ns": None},
        {"node": "/a", "name": "x", "period_ns": 1, "due_ns": 2_500_000_000},
    ]
    assert list(value_lines(rows)) == [
        "node  name      period  due",
        "/ekf  Ekf.tick  10 ms   -",
        "/a    x         1 ns    2.500000000",
    ]
    assert list(value_lines([])) == ["none"]
    assert list(value_lines({"P": "[1, 2]", "state": "0.5"})) == ["P      [1, 2]", "state  0.5"]
    assert list(value_lines({"header": {"frame_id": "map\x07"}})) == [
        "header:",
        r"  frame_id  map\x07",
    ]
    queues = [{"node": "/a", "name": "/scan", "waiting": 2}, {"node": "/b", "waiting": 0}]
    assert list(queue_lines(queues)) == [
        "node  name   waiting",
        "/a    /scan  2",
        "nothing waits in the other 1 queue",
    ]


def test_the_graph_is_who_talks_to_whom() -> None:
    graph = {
        "nodes": [{"name": "/ekf", "type": "ekf:Ekf", "timers": [["Ekf.tick", 10_000_000]]}],
        "links": [
            {
                "kind": "topic",
                "name": "/scan",
                "type": "sensor_msgs/msg/LaserScan",
                "senders": [],
                "receivers": [{"node": "/ekf", "qos": "reliable"}],
            }
        ],
        "problems": ["nobody publishes /scan"],
    }
    assert list(graph_lines(graph)) == [
        "node /ekf  ekf:Ekf, Ekf.tick every 10 ms",
        "topic /scan  sensor_msgs/msg/LaserScan  - -> /ekf",
        "! nobody publishes /scan",
    ]


def test_source_lines_have_numbers() -> None:
    source = {"name": "Ekf.tick", "file": "ekf.py", "line": 9, "lines": ["def tick(self):", "  1"]}
    assert list(source_lines(source)) == [
        "Ekf.tick, ekf.py:9",
        " 9  def tick(self):",
        "10    1",
    ]
    assert list(source_lines(None)) == ["there is no Python source for this event"]


class Session:
    """What a shell asks of a session, as far as these tests go."""

    breakpoints = (Breakpoint(3, "node /ekf"),)
    position = RunPosition(8, 1_500_000_000, EVENT)
    step = go_to = None  # nothing gets so far

    def inspect(self, what: str) -> object:
        if what == "processes":
            return [{"pid": 7, "nodes": ["/ear"], "callbacks": ["src/ear.cpp:24", "ear.cpp:9"]}]
        return {"links": []} if what == "graph" else [{"name": "/robot/ekf"}, {"name": "/ear"}]

    def node(self, name: str) -> dict[str, str]:
        return {"P": "[]", "gain": "1.0"}


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], DebugPrompt]:
    def made(text: str = "") -> DebugPrompt:
        monkeypatch.setattr("sys.stdin", io.StringIO(text))
        return DebugPrompt(Session())  # type: ignore[arg-type]

    return made


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("step x", "'x' is no whole number"),
        ("goto", "where to? 812 is an event, 2.5s a time of the run"),
        ("info nods", "no info 'nods'; did you mean 'nodes'?"),
        ("print", "print what?"),
        ("p/x speed", "there are no formats"),
        ("who-changed speed", "give a node and an attribute"),
        ("when", "when what?"),
        ("gdb", "no C or C++ process runs /ekf"),
    ],
)
def test_what_is_typed_wrong_ends_a_script_with_2(
    shell: Callable[[str], DebugPrompt], line: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert shell(f"# first\n\n{line}\nbreak\n").run() == 2
    shown = capsys.readouterr()
    assert says in shown.err
    assert shown.out.splitlines()[-1] == f"(rsltrace) {line}"


def test_gdb_gets_breakpoints_in_the_callbacks_of_a_node(
    shell: Callable[[str], DebugPrompt], capsys: pytest.CaptureFixture[str]
) -> None:
    assert shell("gdb ear").run() == 0
    command = "gdb -p 7 -ex 'break src/ear.cpp:24' -ex 'break ear.cpp:9' -ex continue"
    assert command in capsys.readouterr().out.splitlines()


def test_commands_of_the_command_line_that_are_not_run_are_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    commands = ["break", "blah", "where", "step 2"]
    assert DebugPrompt(Session(), commands).run() == 2  # type: ignore[arg-type]
    assert capsys.readouterr().err.splitlines()[-1] == "not run: where; step 2"


def test_a_script_ends_where_it_ends(
    shell: Callable[[str], DebugPrompt], capsys: pytest.CaptureFixture[str]
) -> None:
    assert shell("break\nquit\nblah\n").run() == 0
    assert capsys.readouterr().out.splitlines()[1:] == [
        "(rsltrace) break",
        "  3  node /ekf",
        "(rsltrace) quit",
    ]
    assert shell("break").run() == 0


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("who-c", ["who-changed "]),
        ("reverse-", ["reverse-continue", "reverse-next", "reverse-step"]),
        ("info s", ["stacks"]),
        ("i node /r", ["/robot/ekf"]),
        ("break node /e", ["/ear"]),
        ("b wa", ["watch"]),
        ("b log w", ["warn", "warning"]),
        ("who-changed ekf g", ["gain"]),
        ("wc e", ["ear", "ekf"]),
        ("delete ", ["3"]),
        ("nothing x", []),
        ("step ", []),
    ],
)
def test_what_a_line_could_become(
    shell: Callable[[str], DebugPrompt], text: str, found: list[str]
) -> None:
    assert completions(text, shell("")) == found
