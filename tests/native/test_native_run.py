"""Native runs: what is observed of nodes on rclpy's own executors, over DDS, in real time."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rsltrace.diff.traces.native import said_of_parameters
from rsltrace.trace.contents import check_contents
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.timings import callback_figures, timings
from tests.native.running import (
    COMMAND,
    PATIENCE_S,
    environment,
    events_of,
    job,
    record,
    wait_until,
)

pytestmark = [
    pytest.mark.ros,
    pytest.mark.native,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs rclpy"),
]


def outputs_on(trace: Trace, node: str, topic: str) -> list[Any]:
    (sender,) = [
        entity.id
        for entity in trace.entities.values()
        if (trace.node_of(entity).name, entity.name) == (node, topic)
    ]
    outputs = [o for event in events_of(trace) for o in trace.outputs_of(event.index)]
    return [output for output in outputs if output.entity == sender and output.kind == 1]


GRAPH = """
nodes:
  - {node: robot:Talker, arguments: {offset: 0}, parameters: {period: 0.01}, name: fast}
  - {node: robot:Talker, arguments: {offset: 100000}}
  - {node: robot:Listener, remappings: {/echo: /heard}}
  - node: robot:Server
  - node: robot:Asker
  - node: robot:Nested
seed: 7
stop: {function: robot:finished, timeout: 300s}
"""


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Trace, str]]:
    """A run of all kinds of callbacks, and what the command said."""
    folder = tmp_path_factory.mktemp("graph")
    done = record(folder, GRAPH)
    assert done.returncode == 0, done.stderr
    with Trace.open(folder / "run.mcap") as trace:
        yield trace, done.stdout + done.stderr


def test_the_trace_is_whole_and_says_that_it_is_native(graph: tuple[Trace, str]) -> None:
    trace, said = graph
    trace.check()
    check_contents(trace)
    assert is_native(trace)
    described = trace.metadata("rsltrace:native")
    assert described["middleware"].startswith("rmw_")
    assert described["executor"].startswith("SingleThreadedExecutor")
    assert int(trace.result["observer_ns"]) > 0
    assert "without effect in the job: seed" in said
    assert "digest" not in said
    assert "native  events" in said


def test_every_kind_of_callback_is_there(graph: tuple[Trace, str]) -> None:
    trace, _ = graph
    events = events_of(trace)
    met = {(trace.entity(e.entity).name, e.kind) for e in events}
    assert {
        ("Talker.on_timer", EventKind.TIMER),
        ("/numbers", EventKind.SUBSCRIPTION),
        ("/ask", EventKind.SERVICE),
        ("/ask", EventKind.CLIENT),
        ("/count/_action/send_goal", EventKind.ACTION),
        ("/count/_action/get_result", EventKind.ACTION),
        ("Asker.on_timer", EventKind.RESUME),
        ("Nested.on_timer", EventKind.RESUME),
        ("/listener", EventKind.SHUTDOWN),
    } <= met
    assert not any(e.flags & EventFlag.RAISED for e in events)
    # What the executor ran of an action's goal belongs to the server, not to nobody.
    assert EventKind.OUTSIDE not in {e.kind for e in events}
    logs = [o for e in events for o in trace.outputs_of(e.index) if o.kind is OutputKind.LOG]
    assert len(logs) >= 1
    names = {e.name for e in trace.entities.values() if e.kind is EntityKind.NODE}
    assert {"/fast", "/talker100000", "/listener", "/inner"} <= names
    assert "Rate" in {e.name for e in trace.entities.values() if e.kind is EntityKind.TIMER}


def test_the_causes_are_right(graph: tuple[Trace, str]) -> None:
    """/same always says the same, from two talkers that count alike."""
    trace, _ = graph
    taken: Counter[tuple[str, int, int]] = Counter()
    for event in events_of(trace):
        if event.kind not in (EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT):
            continue
        entity = trace.entity(event.entity)
        assert event.cause_event != NO_EVENT, entity
        assert event.cause_event < event.index
        output = trace.outputs_of(event.cause_event)[event.cause_output]
        assert output.hash == event.input_hash
        assert trace.entity(output.entity).name == entity.name
        taken[entity.name, event.cause_event, event.cause_output] += 1
    # Nothing that the fast talker did is missing: it counts.
    payloads = [trace.payload(output) for output in outputs_on(trace, "/fast", "/numbers")]
    messages: list[Any] = [trace.decode("/numbers", found[2]) for found in payloads if found]
    counted = [message.data for message in messages]
    assert counted == list(range(len(counted)))
    by_topic = Counter(name for name, _, _ in taken)
    assert by_topic["/numbers"] > 50
    assert by_topic["/same"] > 50
    assert max(taken.values()) == 1  # each message was taken once: there is one subscription
    alone = [
        e for e in events_of(trace) if e.kind is EventKind.ACTION and e.cause_event == NO_EVENT
    ]
    # rcl makes the status of goals itself, so nobody knows what was sent.
    assert {trace.entity(e.entity).name for e in alone} <= {"/count/_action/status"}
    assert trace.result["unknown_causes"] == str(len(alone))


def test_times_are_those_of_the_callbacks(graph: tuple[Trace, str]) -> None:
    trace, _ = graph
    rows = timings(trace)
    assert len(rows) == trace.event_count
    clocks = trace.metadata("rsltrace:native")
    for event in events_of(trace):
        row = rows[event.index]
        since = int(row["steady"]) - int(clocks["steady_ns"])
        assert event.stamp_ns == int(clocks["wall_ns"]) + since
    assert (rows["steady"][1:] >= rows["steady"][:-1]).all()
    figures = {
        (trace.node_of(one.entity).name, one.entity.name): one for one in callback_figures(trace)
    }
    heard = figures["/listener", "/numbers"]
    assert heard.lost is not None
    assert heard.latency is not None
    assert heard.latency.median_ns > 0
    assert figures["/fast", "Talker.on_timer"].jitter is not None


def test_info_and_cat_show_it(graph: tuple[Trace, str], command: Any) -> None:
    trace, _ = graph
    told = command("info", trace.name).stdout
    assert "none: no two native runs have the same times" in told
    assert "real time, from 20" in told
    assert "times of callbacks" in told
    values = json.loads(command("info", trace.name, "--json").stdout)
    assert values["digest"] is None
    assert {one["lost"] for one in values["native"]["callbacks"]} > {None}
    lines = command("cat", trace.name).stdout.splitlines()
    assert len(lines) == trace.event_count


def test_nothing_claims_that_it_repeats(graph: tuple[Trace, str], command: Any) -> None:
    trace, _ = graph
    for words in (
        ("diff", trace.name, trace.name, "--again", trace.name),
        ("view", trace.name, trace.name, "--export", "x.txt"),
    ):
        done = command(*words)
        assert done.returncode == 2, words
        assert "of a native run: it was observed, not simulated" in done.stderr
    assert command("view", trace.name, "--export", "x.txt").returncode == 0
    assert " native " in Path("x.txt").read_text()


def test_diff_tells_content_from_timing(tmp_path: Path, command: Any) -> None:
    """The nodes answer each other, so that all runs say the same, whatever the times."""
    nodes = "nodes: [{node: robot:Counter}, {node: robot:Listener}]"
    plain = f"{nodes}\nstop: {{topic: /over, timeout: 300s}}\n"
    assert record(tmp_path, plain).returncode == 0
    os.rename(tmp_path / "run.mcap", tmp_path / "native.mcap")
    other = record(tmp_path, plain.replace("Counter}", "Counter, arguments: {first: 1000}}"))
    assert other.returncode == 0, other.stderr
    simulated = command("record", job(tmp_path, plain), "-o", "simulated.mcap", "-q")
    assert simulated.returncode == 0, simulated.stderr
    same = command("diff", "native.mcap", "simulated.mcap")
    assert same.returncode == 3, same.stdout
    assert "messages are the same except for times" in same.stdout
    assert "verdict: same-content" in same.stdout
    differs = command("diff", "run.mcap", "native.mcap", "--format", "json")
    assert differs.returncode == 1
    values = json.loads(differs.stdout)
    assert values["verdict"] == "other-content"
    assert values["native"]["first"]["topic"] == "/numbers"
    assert values["native"]["first"]["fields"][0]["path"] == "data"
    assert "next: rsltrace record" not in differs.stdout


def test_nodes_that_are_made_at_once_say_the_same_of_their_parameters(
    tmp_path: Path, command: Any
) -> None:
    """Their messages mix on /parameter_events, each with its time."""
    rest = "parameters: {period: 0.1}}"
    talkers = [f"{{node: robot:Talker, name: {name}, {rest}" for name in "ab"]
    stop = "stop: {events: 1}\n"
    traces = []
    for number, nodes in enumerate(
        (talkers, [*reversed(talkers)], [talkers[0].replace("0.1", "0.2"), talkers[1]])
    ):
        path = job(tmp_path, f"nodes: [{', '.join(nodes)}]\nstart: {number}s\n{stop}")
        done = command("record", path, "-o", f"{number}.mcap", "-q")
        assert done.returncode == 0, done.stderr
        with Trace.open(Path(f"{number}.mcap")) as trace:
            traces.append(said_of_parameters(trace))
    assert traces[0] == traces[1]
    assert traces[0] != traces[2]


def test_a_node_that_raises_ends_the_run(tmp_path: Path) -> None:
    done = record(tmp_path, "nodes: [{node: robot:Raising}, {node: robot:Listener}]\n")
    assert done.returncode == 3
    assert "ValueError: the third" in done.stderr
    assert "rsltrace/" not in done.stderr.split("rsltrace: error")[0].replace("tests/", "")
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        raised = [e for e in events_of(trace) if e.flags & EventFlag.RAISED]
        assert [trace.entity(e.entity).name for e in raised] == ["Raising.on_timer"]
        assert trace.result["exit_code"] == "3"


@pytest.mark.parametrize("how", ["single", "multi", "processes"])
def test_ctrl_c_ends_it_properly_even_if_a_callback_is_stuck(tmp_path: Path, how: str) -> None:
    path = job(tmp_path, "nodes: [{node: robot:Stuck}, {node: robot:Talker}]\n")
    options = ["--processes"] if how == "processes" else ["--executor", how]
    process = subprocess.Popen(
        [*COMMAND, "record", "--native", *options, str(path), "-o", "run.mcap"],
        cwd=tmp_path,
        env={**environment(tmp_path), "STUCK": "stuck"},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        wait_until((tmp_path / "stuck").exists, process)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130
    assert "a callback of robot:Stuck did not return" in said
    assert re.search(r"robot\.py:\d+ in on_timer$", said, re.MULTILINE), said
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        assert trace.result["stop_reason"] == "interrupted"


@pytest.mark.parametrize(
    ("text", "words", "said"),
    [
        ("nodes: [{component: a/b, container: /c}]", (), "job.yaml:2:"),
        ("nodes: [{node: robot:Talker}]\nhooks: {before: robot:Talker}", (), "has no hooks"),
        ("nodes: [{node: robot:Talker}]", ("--seed", "1"), "have no effect on a native run"),
    ],
)
def test_what_cannot_be_native_is_refused(
    text: str, words: tuple[str, ...], said: str, tmp_path: Path, command: Any
) -> None:
    done = command("record", "--native", job(tmp_path, text), "-o", "run.mcap", *words)
    assert done.returncode == 2
    assert said in done.stderr
    assert not Path("run.mcap").exists()
