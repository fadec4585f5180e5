"""What a diff says beyond index and verdict: roots, evidence, counts, settings, what was asked."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from diff_simulator import MS, Fault, NodePlan, Plan, Publication, Simulation, Storage
from rsltrace_viewer.model.comparison import Comparison
from rsltrace_viewer.model.run import Run

import rsltrace
from rsltrace.diff.causes import explain
from rsltrace.diff.facts.causes import Root, Verdict
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import render
from rsltrace.diff.result import Diff
from rsltrace.diff.row_sign import RowSign
from rsltrace.diff.sentences.values import link_text, no_fields_text
from rsltrace.diff.traces.comparison import DIVERGENCES_MAX
from rsltrace.errors import TraceError
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.words.phrases import seconds_text
from rsltrace.trace.writer import TraceWriter

# /source ticks every 10 ms; /left and /right hear it, /sum hears both, /odd has nothing to do with
# any of it. All remember everything they heard.
PLAN = Plan(
    (
        NodePlan("/source", timers=((10 * MS, (Publication("/a"),)),)),
        NodePlan("/left", subscriptions=(("/a", (Publication("/l"),)),)),
        NodePlan("/right", subscriptions=(("/a", (Publication("/r"),)),)),
        NodePlan(
            "/sum", subscriptions=(("/l", (Publication("/s"),)), ("/r", (Publication("/s"),)))
        ),
        NodePlan("/odd", timers=((10 * MS, (Publication("/o"),)),)),
    ),
    end_ns=1000 * MS,
)
PLAIN = Storage()
PER_STEP = 6  # source, left, right, sum twice, odd
FIRST = len(PLAN.nodes)


def step(n: int, event: int) -> int:
    """Return the index of an event of step ``n`` (from 1): 0 source, 1 left, … 5 odd."""
    return FIRST + (n - 1) * PER_STEP + event


def compare(
    folder: Path,
    *faults: Fault,
    a: Plan = PLAN,
    b: Plan | None = None,
    storage: Storage = PLAIN,
    **options: object,
) -> Diff:
    Simulation(a, folder / "a.mcap", storage=storage).run()
    Simulation(b or a, folder / "b.mcap", faults, storage).run()
    return rsltrace.diff(folder / "a.mcap", folder / "b.mcap", **options)


def test_identical_runs(tmp_path: Path) -> None:
    diff = compare(tmp_path)
    assert diff.identical
    assert diff.exit_code == 0
    assert diff.verdict is Verdict.IDENTICAL
    assert diff.agreeing == diff.a.events == diff.b.events
    assert diff.divergences == diff.settings == diff.notes == ()
    assert 0 < diff.bytes_read < 20_000


def test_a_changed_output(tmp_path: Path) -> None:
    diff = compare(tmp_path, Fault("bit", step(20, 1)))
    assert diff.agreeing == step(20, 1)
    (first,) = diff.divergences
    assert (first.verdict, first.root) == (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK)
    assert "/left: the callback for /a at 0.2 s" in first.sentence
    assert "/l" in first.sentence
    assert first.a is not None
    assert first.b is not None
    assert first.a.entity.name == first.b.entity.name == "/a"
    assert first.a.position == 19
    assert first.a.summary == "/l"
    (message,) = first.messages
    assert (message.kind, message.topic, message.presence) == (OutputKind.MESSAGE, "/l", "both")
    assert [field.path for field in message.fields] == ["data"]
    # The chain: what led to it agrees in both runs, then comes the event itself.
    (cause, itself) = first.chain
    assert cause.a is not None
    assert (cause.a.entity.name, link_text(cause.link)) == ("tick", "published /a")
    assert cause.a == cause.b
    assert (itself.a, itself.b) == (first.a, first.b)
    *before, own = first.rows
    assert [row.a.index for row in before] == list(range(step(20, 1) - 5, step(20, 1)))
    assert all((row.sign, row.a) == (RowSign.MATCH, row.b) for row in before)
    assert (own.sign, own.a, own.b) == (RowSign.DIFFERS, first.a, first.b)
    assert {row.a.entity.node for row in first.node_rows} == {"/left"}
    assert [row.a.index for row in first.node_rows] == [step(n, 1) for n in range(15, 20)]
    assert [(r.topic, r.after_ns) for r in first.reaches] == [("/l", 0), ("/s", 0)]
    # The job is not here: only what reads the trace is offered.
    assert first.next_step.startswith("rsltrace cat ")
    assert "--from 0.2 --to 0.2" in first.next_step


def test_counts_per_entity(tmp_path: Path) -> None:
    diff = compare(tmp_path, Fault("bit", step(20, 1)), everything=True)
    counts = {(c.entity.node, c.entity.name): c for c in diff.counts}
    assert counts["/sum", "/l"].differing == 81
    assert counts["/sum", "/r"].differing == 81, "its node's state differs, so its outputs do"
    # Its input is the same from the next step on, but what it remembers is not.
    assert counts["/left", "/a"].differing == 1
    assert counts["/left", "/a"].matching == 80
    assert counts["/odd", "tick"].differing == counts["/right", "/a"].differing == 0
    assert all(c.only_a == c.only_b == 0 for c in diff.counts)
    assert diff.aligned_to == (diff.a.events, diff.b.events)
    assert diff.resync_index is None


def test_where_the_runs_agree_again(tmp_path: Path) -> None:
    forgetful = tuple(replace(node, memory="none") for node in PLAN.nodes)
    plan = replace(PLAN, nodes=forgetful)
    for everything in (False, True):
        diff = compare(tmp_path, Fault("drop", step(20, 1)), a=plan, everything=everything)
        # /left's message and what /sum made of it are missing; then both go on as before.
        assert diff.verdict is Verdict.MISSING
        assert diff.resync_index == (step(20, 4), step(20, 4) - 2)
        assert sum(c.only_a for c in diff.counts) == 2
        assert sum(c.differing + c.only_b for c in diff.counts) == 0


@pytest.mark.parametrize("window", [1, 10, 100, 5000])
def test_the_window_limits_what_is_aligned(tmp_path: Path, window: int) -> None:
    diff = compare(tmp_path, Fault("bit", step(20, 1)), window=window)
    reached = diff.aligned_to[0] - diff.agreeing
    assert diff.verdict is Verdict.SAME_INPUT_DIFFERENT_OUTPUT
    if window == 5000:
        assert reached == diff.a.events - diff.agreeing
    else:  # a block ends between two instants
        assert 0 < reached <= max(window, 2 * PER_STEP) + PER_STEP


@pytest.mark.long
def test_all_looks_at_everything_in_blocks(tmp_path: Path) -> None:
    """A second divergence far behind the first, with equal events in between."""
    long = replace(PLAN, end_ns=40_000 * MS)
    far = Fault("bit", step(3000, 5))
    diff = compare(tmp_path, Fault("drop", step(20, 5)), Fault("bit", far.at - 1), a=long)
    assert len(diff.divergences) == 1, "the window ends long before"
    diff = compare(
        tmp_path, Fault("bit", step(20, 5)), Fault("bit", step(3000, 1)), a=long, everything=True
    )
    assert [d.a.index for d in diff.divergences if d.a] == [step(20, 5), step(3000, 1)]
    assert sum(c.matching + c.differing for c in diff.counts) == diff.a.events - diff.agreeing
    assert diff.aligned_to == (diff.a.events, diff.b.events)


def test_independent_divergences_are_limited_unless_all_are_asked_for(tmp_path: Path) -> None:
    apart = tuple(
        NodePlan(f"/n{n}", "none", timers=((10 * MS, (Publication(f"/t{n}"),)),)) for n in range(20)
    )
    plan = Plan(apart, end_ns=100 * MS)
    faults = [Fault("bit", 20 + 20 * 3 + n) for n in range(20)]
    diff = compare(tmp_path, *faults, a=plan)
    assert len(diff.divergences) == DIVERGENCES_MAX
    assert any("10 more independent divergences" in note for note in diff.notes)
    diff = compare(tmp_path, *faults, a=plan, everything=True)
    assert [d.a.index for d in diff.divergences if d.a] == [fault.at for fault in faults]


# -- asking for nodes and topics -----------------------------------------------------------------


def test_a_consequence_that_was_asked_for_leads_back_to_its_root(tmp_path: Path) -> None:
    diff = compare(tmp_path, Fault("bit", step(20, 1)), nodes=("/sum",))
    assert diff.agreeing == step(20, 1), "the runs diverge where they diverge"
    (first,) = diff.divergences
    assert diff.verdict is first.verdict is Verdict.DIFFERENT_INPUT
    assert first.a is not None
    assert (first.a.entity.node, first.a.entity.name, first.a.index) == ("/sum", "/l", step(20, 3))
    assert first.root is Root.CALLBACK
    assert "/left" in first.root_sentence
    nodes = [step.a.entity.node for step in first.chain if step.a]
    assert nodes == ["/source", "/left", "/sum"]
    assert link_text(first.chain[-2].link) == "published /l"
    assert first.messages[0].position == -1
    assert [field.path for field in first.messages[0].fields] == ["data"]
    assert any("this report shows where /sum differs" in note for note in diff.notes)


def test_state_is_a_way_to_the_root_too(tmp_path: Path) -> None:
    """/sum's answer to /r differs only because it heard another /l before."""
    diff = compare(tmp_path, Fault("bit", step(20, 1)), nodes=("/sum",), topics=("/r",))
    (first,) = diff.divergences
    assert first.verdict is Verdict.SAME_INPUT_DIFFERENT_OUTPUT
    assert first.root is Root.CALLBACK
    assert first.a is not None
    assert first.a.entity.name == "/r"
    assert link_text(first.chain[-2].link) == "may have changed the state of /sum"
    assert "because its node had already diverged" in first.sentence


def test_asking_for_what_does_not_differ(tmp_path: Path) -> None:
    diff = compare(tmp_path, Fault("bit", step(20, 1)), nodes=("/odd",))
    assert not diff.identical
    assert diff.divergences[0].a is not None
    assert diff.divergences[0].a.entity.node == "/left"
    assert any("nothing selected (/odd) differs" in note for note in diff.notes)


# -- what is outside of the events ---------------------------------------------------------------


def test_settings_are_always_listed(tmp_path: Path) -> None:
    other = replace(PLAN, seed=7, version="2")
    diff = compare(tmp_path, Fault("bit", step(20, 1)), b=other)
    places = {setting.place: (setting.a, setting.b) for setting in diff.settings}
    assert places == {"job.yaml:1": ("seed: 0", "seed: 7"), "environment: sim": ("1", "2")}
    # They may be why; what is seen is a callback.
    assert diff.verdict is Verdict.SAME_INPUT_DIFFERENT_OUTPUT
    assert "job.yaml:1, environment.sim" in diff.divergences[0].root_sentence


def test_lines_of_a_job_of_several_files_are_not_those_of_one(tmp_path: Path) -> None:
    """They are counted in the effective job, and what it was made of is no setting."""
    heading = "# The effective job of job.yaml\n"
    other = replace(PLAN, seed=7, job_heading=f"{heading}#   with --set seed=7\n")
    diff = compare(
        tmp_path, Fault("bit", step(20, 1)), a=replace(PLAN, job_heading=heading), b=other
    )
    (setting,) = diff.settings
    assert (setting.place, setting.a, setting.b) == ("effective job.yaml:2", "seed: 0", "seed: 7")


def test_a_constructor_that_differs(tmp_path: Path) -> None:
    drawing = replace(PLAN, nodes=(*PLAN.nodes[:2], replace(PLAN.nodes[2], draws_at_start=True)))
    diff = compare(tmp_path, a=drawing, b=replace(drawing, seed=1))
    assert (diff.verdict, diff.divergences[0].root) == (Verdict.ENVIRONMENT, Root.JOB)
    assert diff.divergences[0].a is not None
    assert diff.divergences[0].a.entity.name == "/right"
    assert "job.yaml:1" in diff.divergences[0].root_sentence
    diff = compare(tmp_path, Fault("bit", 0), a=drawing, b=drawing)
    assert diff.identical, "a fault that cannot strike is none"


def test_traces_of_different_jobs(tmp_path: Path) -> None:
    other = Plan((NodePlan("/else", timers=((7 * MS, ()),)),), end_ns=100 * MS)
    diff = compare(tmp_path, b=other)
    assert diff.sentence.startswith(
        "these are runs of different jobs without a common node: the gr"
    )
    assert diff.verdict is Verdict.GRAPH
    assert diff.divergences[0].root is Root.JOB
    assert {s.place for s in diff.settings} >= {"entity", "job.yaml:3"}
    assert diff.agreeing == 0


def test_a_node_more_shifts_all_ids_and_nothing_else(tmp_path: Path) -> None:
    more = replace(PLAN, nodes=(NodePlan("/more", timers=((10 * MS, ()),)), *PLAN.nodes))
    diff = compare(tmp_path, b=more, everything=True)
    assert diff.verdict is Verdict.GRAPH
    assert "/more is constructed in b but not in a" in diff.sentence
    assert len(diff.divergences) == 1
    by_node: dict[str, int] = {}
    for count in diff.counts:
        own = count.differing + count.only_a + count.only_b
        by_node[count.entity.node] = by_node.get(count.entity.node, 0) + own
    assert by_node.pop("/more") == 102  # constructed, 100 ticks, destroyed
    assert set(by_node.values()) == {0}


# -- how runs end --------------------------------------------------------------------------------


def test_a_run_that_was_told_to_stop_earlier(tmp_path: Path) -> None:
    short = replace(PLAN, end_ns=500 * MS)
    diff = compare(tmp_path, b=short)
    assert diff.verdict is Verdict.ENDED_EARLY
    assert diff.agreeing == step(51, 0)
    (first,) = diff.divergences
    assert first.a is not None
    assert first.a.index == diff.agreeing
    assert first.b is None
    assert "run b ended at 0.5 s (time 500000000)" in first.sentence, "not: A ended, in a report"
    assert first.next_step == f"rsltrace info {tmp_path / 'b.mcap'}"
    assert compare(tmp_path, a=short, b=PLAN).verdict is Verdict.RAN_LONGER


def test_a_last_event_that_is_missing_is_no_earlier_end(tmp_path: Path) -> None:
    """Both runs last as long as they were told to; one loses a message of the last instant."""
    diff = compare(tmp_path, Fault("drop", step(100, 5) - 1))
    assert diff.verdict is Verdict.MISSING
    assert "subscription /r of /sum at 1.0 s is only in a" in diff.sentence
    back = rsltrace.diff(tmp_path / "b.mcap", tmp_path / "a.mcap")
    assert back.verdict is Verdict.EXTRA
    assert "is only in b" in back.sentence


def _cut(path: Path, size: int) -> Path:
    path.write_bytes(path.read_bytes()[:size])
    return path


def test_an_interrupted_run_agrees_only_as_far_as_it_goes(tmp_path: Path) -> None:
    Simulation(PLAN, tmp_path / "a.mcap").run()
    Simulation(PLAN, tmp_path / "b.mcap", storage=Storage(50, close=False)).run()
    _cut(tmp_path / "b.mcap", (tmp_path / "b.mcap").stat().st_size // 2)
    diff = rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert diff.verdict is Verdict.AGREE_UNTIL_TRUNCATED
    assert not diff.b.complete
    assert diff.b.stop_reason == "interrupted"
    assert diff.agreeing == diff.b.events > 100
    assert diff.sentence == (
        f"the two runs agree in the first {diff.b.events} events; the recording of b is truncated"
    )
    assert "the recording of b" in diff.notes[0]
    assert (diff.identical, diff.diverged, diff.failed, diff.exit_code) == (False, False, True, 1)
    accepted = rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap", allow_truncated=True)
    assert (accepted.identical, accepted.failed, accepted.exit_code) == (False, False, 0)


def test_two_runs_that_were_both_interrupted_are_not_identical(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        Simulation(PLAN, tmp_path / name, storage=Storage(50, close=False)).run()
    diff = rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert diff.verdict is Verdict.AGREE_UNTIL_TRUNCATED
    assert diff.sentence.endswith("events; both recordings are truncated")
    assert diff.exit_code == 1


def test_a_trace_is_not_identical_to_its_own_beginning(tmp_path: Path) -> None:
    """Also not to the one that lacks no event, only the end of the file."""
    Simulation(PLAN, tmp_path / "a.mcap").run()
    data = (tmp_path / "a.mcap").read_bytes()
    verdicts = set()
    for size in range(len(data) - 1, 3000, -len(data) // 40):  # its job is before that
        (tmp_path / "b.mcap").write_bytes(data[:size])
        for a, b in (("a", "b"), ("b", "a"), ("b", "b")):
            diff = rsltrace.diff(tmp_path / f"{a}.mcap", tmp_path / f"{b}.mcap")
            verdicts.add(diff.verdict)
            assert diff.exit_code == 1, size
    assert verdicts == {Verdict.AGREE_UNTIL_TRUNCATED}


def test_a_cut_run_still_diverges_where_it_does_something_else(tmp_path: Path) -> None:
    Simulation(PLAN, tmp_path / "a.mcap").run()
    fault = Fault("bit", step(20, 1))
    Simulation(PLAN, tmp_path / "b.mcap", (fault,), storage=Storage(50, close=False)).run()
    diff = rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap", allow_truncated=True)
    assert diff.verdict is Verdict.SAME_INPUT_DIFFERENT_OUTPUT
    assert diff.exit_code == 1


def _without_events(path: Path, name: str, stop: str) -> Path:
    with TraceWriter(path, force=True) as writer:
        resolved = json.dumps({"stop": stop})
        writer.add_metadata("rsltrace:job", {"name": name, "resolved": resolved})
        writer.close(result={"stop_reason": "nothing to do", "exit_code": "0"})
    return path


@pytest.mark.parametrize("size", [None, -200])
def test_runs_without_an_event_are_not_equal_if_their_jobs_are_not(
    tmp_path: Path, size: int | None
) -> None:
    """Nothing was recorded, so nothing but the jobs can be compared."""
    a, b, c = (
        _without_events(tmp_path / f"{name}.mcap", *job)
        for name, *job in (("a", "x", "1s"), ("b", "y", "2s"), ("c", "x", "1s"))
    )
    for path in (a, b, c):
        _cut(path, size) if size else None
    for options in ({}, {"allow_truncated": True}):
        diff = rsltrace.diff(a, b, **options)
        assert diff.verdict is Verdict.DIFFERENT_JOBS
        assert diff.exit_code == 1
        assert '("x", "y")' in diff.sentence
        same = rsltrace.diff(a, c, **options)
        assert same.verdict is (Verdict.AGREE_UNTIL_TRUNCATED if size else Verdict.IDENTICAL)
        assert same.exit_code == (1 if size else 0)


def test_an_exception_in_one_run(tmp_path: Path) -> None:
    diff = compare(tmp_path, Fault("raise", step(20, 3)))
    assert (diff.verdict, diff.divergences[0].root) == (Verdict.EXCEPTION, Root.EXCEPTION)
    assert "raised an exception only in b: ValueError: planted" in diff.sentence
    (first,) = diff.divergences
    exception = [m for m in first.messages if m.kind is OutputKind.EXCEPTION]
    assert exception[0].preview == "ValueError: planted"
    # What a did after that is counted, and is no divergence of its own.
    assert sum(count.only_a for count in diff.counts) > 100


# -- evidence without payloads -------------------------------------------------------------------


def test_without_payloads_it_says_which_output_and_how_to_record_it(tmp_path: Path) -> None:
    diff = compare(tmp_path, Fault("bit", step(20, 1)), storage=Storage(payloads=False))
    (message,) = diff.divergences[0].messages
    assert message.topic == "/l"
    assert message.fields == ()
    assert message.hash_a != message.hash_b
    assert "payloads: true" in no_fields_text(message)


def test_a_dropped_message_names_where_it_came_from(tmp_path: Path) -> None:
    diff = compare(tmp_path, Fault("drop", step(20, 3)))
    (first,) = diff.divergences
    assert (diff.verdict, first.b) == (Verdict.MISSING, None)
    assert first.a is not None
    entity, at = first.a.entity, seconds_text(first.a.stamp_ns)
    asked = f"rsltrace why {tmp_path / 'b.mcap'} {entity.node} {entity.name} --at {at}"
    assert first.next_step == asked
    assert first.absence is None  # a trace that was tampered with has no reason for it
    assert f"event {step(20, 1)}, subscription /a of /left" in first.root_sentence
    (message, output) = first.messages
    assert (message.position, message.presence) == (-1, "only a")
    assert "data:" in message.preview
    assert (output.topic, output.presence) == ("/s", "only a")


@pytest.mark.parametrize("lacking", ["a", "b"])
def test_a_callback_that_one_run_lacks_says_why(
    lacking: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("b.mcap", "a.mcap") if lacking == "a" else ("a.mcap", "b.mcap")
    paths = [Path(__file__).parents[2] / "sample_traces" / "missing_event" / one for one in names]
    (first, *_) = rsltrace.diff(*paths).divergences
    assert first.absence is not None
    assert (first.absence.run, first.absence.reason) == (lacking, "unfinished")
    assert (first.absence.place, first.absence.event) == ("picker.py:39", 31)
    monkeypatch.setattr(explain, "_EXPLAINED_EVENTS_MAX", 10)  # of a longer run nobody looks
    (first, *_) = rsltrace.diff(*paths).divergences
    assert first.absence is None
    assert first.next_step.startswith(f"rsltrace why {paths['ab'.index(lacking)]} /gripper /close")


def test_ignored_fields_leave_the_verdict(tmp_path: Path) -> None:
    """Two digests are never made identical."""
    diff = compare(tmp_path, Fault("bit", step(20, 1)), ignore=("data",))
    assert diff.exit_code == 3
    assert not diff.identical
    assert diff.within_tolerance
    assert diff.verdict is Verdict.SAME_INPUT_DIFFERENT_OUTPUT
    (message,) = diff.divergences[0].messages
    assert message.fields == ()
    assert "ignored" in no_fields_text(message)


@pytest.mark.parametrize("kind", ["drop", "extra", "swap", "late", "raise", "state"])
def test_a_tolerance_covers_messages_and_nothing_else(tmp_path: Path, kind: str) -> None:
    fault = {
        "late": Fault("late", step(20, 0), delay_ns=MS),
        "swap": Fault("swap", step(20, 1), 1),
    }.get(kind, Fault(kind, step(20, 1)))
    diff = compare(tmp_path, fault, ignore=("*",), absolute=(("*", 1e30),))
    if kind == "state":  # only what is published is another number
        assert diff.within_tolerance
    else:
        assert (diff.exit_code, diff.tolerance) == (1, None), diff.sentence


def test_what_was_not_recorded_is_within_no_tolerance(tmp_path: Path) -> None:
    storage = Storage(payloads=False)
    diff = compare(tmp_path, Fault("bit", step(20, 1)), storage=storage, ignore=("*",))
    assert (diff.exit_code, diff.tolerance) == (1, None)


def test_equal_messages_from_other_senders(tmp_path: Path) -> None:
    """Nothing tells the two deliveries apart but which event sent what."""
    twin = NodePlan("/twin", "none", subscriptions=(("/in", (Publication("/out"),)),))
    plan = Plan(
        (twin, NodePlan("/ear", "all", subscriptions=(("/out", (Publication("/z"),)),))),
        bag=((10 * MS, "/in", 5), (10 * MS, "/in", 5), (20 * MS, "/in", 6)),
        end_ns=50 * MS,
    )
    clean = Simulation(plan, tmp_path / "a.mcap").run()
    ear = next(e for e in clean.log if e.node == "/ear")
    diff = compare(tmp_path, Fault("swap", ear.index, 1), a=plan)
    assert (diff.verdict, diff.divergences[0].root) == (Verdict.SCHEDULE, Root.SCHEDULE)
    assert diff.agreeing == ear.index
    assert "received two inputs in swapped order" in diff.sentence


def test_the_same_swap_again_and_again_is_one_divergence(tmp_path: Path) -> None:
    """Two timers that are due at once, decided in another way at every instant."""
    pair = tuple(
        NodePlan(f"/n{n}", "none", timers=((10 * MS, (Publication(f"/t{n}"),)),)) for n in range(2)
    )
    plan = Plan(pair, end_ns=200 * MS)
    diff = compare(tmp_path, *(Fault("swap", 2 + 2 * n, 1) for n in range(20)), a=plan)
    assert diff.verdict is Verdict.SCHEDULE
    assert len(diff.divergences) == 1
    first = diff.divergences[0]
    assert first.a is not None
    assert first.b is not None
    assert {first.a.entity.node, first.b.entity.node} == {"/n0", "/n1"}
    assert first.a.index == first.b.index == 2


def test_a_callback_that_sends_thousands_of_messages_is_compared_once(tmp_path: Path) -> None:
    """Comparing all that it sent for each that was received would take half a minute."""
    often = (Publication("/out"),) * 4000
    fan = NodePlan("/fan", timers=((10 * MS, often),), draws=True)
    plan = Plan((fan, NodePlan("/ear", subscriptions=(("/out", ()),))), end_ns=15 * MS)
    for name, seed in (("a", 0), ("b", 1)):
        Simulation(replace(plan, seed=seed), tmp_path / f"{name}.mcap").run()
    begin = time.process_time()
    diff = rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert time.process_time() - begin < 5
    assert len(diff.divergences) == 1
    (reach,) = diff.divergences[0].reaches
    assert (reach.topic, reach.events) == ("/out", 4000)


# -- the Python API ------------------------------------------------------------------------------


def test_a_node_that_starts_late_stands_where_it_starts(tmp_path: Path) -> None:
    """In the text and in the viewer. Its seed, and so its constructor, is another one in b."""
    late = NodePlan("/late", draws_at_start=True, starts_ns=505 * MS)
    a = replace(PLAN, nodes=(*PLAN.nodes, late))
    faults = Fault("bit", step(20, 1)), Fault("bit", step(30, 5))
    diff = compare(tmp_path, *faults, a=a, b=replace(a, seed=1), everything=True)
    text = render(diff, "text", options=DiffOptions(everything=True))
    places = [text.index(event) for event in ("0.200000000 s", "0.300000000 s", "0.505000000 s")]
    assert places == sorted(places)
    paths = tmp_path / "a.mcap", tmp_path / "b.mcap"
    with closing(Run.open(paths[0])) as run_a, closing(Run.open(paths[1])) as run_b:
        view = Comparison(run_a, run_b)
        while not view.runs.done:
            view.runs.take(view.runs.fetch())
        constructed = step(51, 0)
        assert run_a.trace.event(constructed).kind is EventKind.CONSTRUCT
        assert [view.a(place) for place in range(view.count)] == list(range(run_a.count))
        assert view.sign(constructed) is RowSign.DIFFERS


def test_the_function_is_also_the_package(tmp_path: Path) -> None:
    import rsltrace.diff
    import rsltrace.diff.traces.diff

    diff = compare(tmp_path, Fault("bit", step(20, 1)), context=2)
    assert isinstance(diff, rsltrace.Diff)
    assert len(diff.divergences[0].rows) == 2 + 1
    assert diff.verdict is rsltrace.Verdict.SAME_INPUT_DIFFERENT_OUTPUT
    assert rsltrace.diff.traces.diff.diff_traces is not None
    assert list(inspect.signature(rsltrace.diff).parameters)[:3] == ["a", "b", "context"]
    with pytest.raises(AttributeError, match=r"rsltrace\.diff.*nothing_of_that_name"):
        _ = rsltrace.diff.nothing_of_that_name


def test_options_in_the_shapes_that_come_to_mind(tmp_path: Path) -> None:
    fault = Fault("bit", step(20, 1))
    pairs = compare(tmp_path, fault, topics=["/l"], absolute=[("data", 1.0)], ignore="none")
    mapping = compare(tmp_path, fault, topics="/l", absolute={"data": 1.0}, ignore=("none",))
    assert pairs == mapping
    assert [note.partition(" of ")[0] for note in pairs.notes] == [
        "no command to reproduce this: the job job.yaml"
    ]


def test_options_that_make_no_sense(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="contxt"):
        compare(tmp_path, contxt=3)
    with pytest.raises(TraceError, match="cannot be shown"):
        compare(tmp_path, window=0)
    with pytest.raises(TraceError, match="does not exist"):
        rsltrace.diff(tmp_path / "none.mcap", tmp_path / "a.mcap")


def test_kinds_are_named_in_words(tmp_path: Path) -> None:
    from rsltrace.diff.sentences.divergence import phrase
    from rsltrace.trace.words.phrases import at_time as at

    diff = compare(tmp_path, Fault("bit", step(20, 1)))
    view = diff.divergences[0].a
    assert view is not None
    assert phrase(view) == "subscription /a of /left"
    assert "service" in phrase(replace(view, kind=EventKind.SERVICE))
    assert at(1_500_000_000) == "at 1.5 s"
    assert at(0) == "at 0.0 s"


def test_a_diff_loads_only_what_it_needs(tmp_path: Path) -> None:
    """Waiting for libraries is most of what a user waits for."""
    compare(tmp_path, Fault("bit", step(20, 1)), storage=Storage(payloads=False))
    code = (
        "import sys, rsltrace\n"
        "rsltrace.diff; assert 'numpy' not in sys.modules\n"
        "a, b = sys.argv[1:]\n"
        "assert rsltrace.diff(a, a).identical\n"
        "assert 'rsltrace.diff.traces.comparison' not in sys.modules\n"
        "assert not rsltrace.diff(a, b).identical\n"
        "names = 'pydantic ruamel rosbags rclpy fsspec rich mcap.reader'.split()\n"
        "assert not [n for n in names if n in sys.modules]\n"
    )
    paths = [str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")]
    subprocess.run([sys.executable, "-c", code, *paths], check=True, timeout=300)
