"""A debugging session from Python: forwards, backwards, questions, breakpoints."""

from __future__ import annotations

from pathlib import Path

import pytest

import rsltrace
from rsltrace import DebugSession
from rsltrace.errors import ConditionError, DebugError, EditError, OutputError, ReplayError
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.events import EventWords


def test_an_exception_of_several_lines_is_known_by_its_type(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "strict.py").write_text(
        "from rclpy.node import Node\n"
        "class Strict(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('strict')\n"
        "        self.create_timer(0.1, self.tick)\n"
        "    def tick(self):\n"
        "        raise ValueError('2 errors:\\n  rate: too high')\n"
    )
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: 'strict:Strict'}]\nsearch_path: [.]\nstop: {duration: 1s}\n"
        "checks: [{never: exception ValueError}]\n"
    )
    monkeypatch.chdir(tmp_path)
    job = rsltrace.load_job("job.yaml")
    with pytest.raises(rsltrace.errors.NodeError):
        rsltrace.record(job, "run.mcap")
    said = "raised ValueError: 2 errors: rate: too high"
    with Trace.open("run.mcap") as trace:
        (never,) = rsltrace.evaluate_checks(trace, job)
        words = EventWords(trace).outputs(trace.outputs_of(1))
        assert [one.text for one in never.violations] == [said]
        assert said.replace("raised", "exception") in list(words)
    with DebugSession("run.mcap", trust=True) as session:
        session.break_at("exception ValueError")
        assert session.go_on().position.index == 2


def test_a_step_is_an_event_of_the_trace(session: DebugSession, trace: Trace) -> None:
    assert session.position.index == 0
    assert session.position.event is None
    for index in range(6):
        stopped = session.step()
        event = trace.event(index)
        assert (stopped.reason, stopped.position.index) == ("step", index + 1)
        assert stopped.position.event is not None
        assert stopped.position.event["chain_hash"] == f"{event.chain_hash:016x}"
        assert stopped.position.event["stamp_ns"] == event.stamp_ns
    assert session.step(10).position.index == 16


def test_going_back_gives_the_states_that_were_there(session: DebugSession) -> None:
    session.run_to(500)
    forward = {}
    for _ in range(6):
        position = session.step().position
        forward[position.index] = (position, session.evaluate("filter.state"))
    for index in (506, 505, 504, 503, 502):
        position = session.reverse_step().position if index < 506 else session.position
        assert (position, session.evaluate("filter.state")) == forward[index]
    assert session.reverse_step(4).position.index == 498
    assert session.go_to(503).position == forward[503][0]


def test_time_steps_and_times(session: DebugSession, trace: Trace) -> None:
    stopped = session.run_to("1.005s")
    assert stopped.position.is_next
    stamps = [int(s) for rows in trace.events() for s in rows["stamp"]]
    assert stopped.position.index == sum(stamp <= 1_005_000_000 for stamp in stamps)
    ended = session.finish().position
    assert stamps[ended.index - 1] < stamps[ended.index]
    assert stamps[ended.index - 2] == stamps[ended.index - 1]
    back = session.go_to("0.5").position
    assert back.index == sum(stamp <= 500_000_000 for stamp in stamps)
    with pytest.raises(DebugError, match="in the past"):
        session.run_to("0.2s")
    with pytest.raises(DebugError, match="neither an index"):
        session.go_to("soon")


def test_next_and_reverse_next_stay_in_a_node(session: DebugSession) -> None:
    session.run_to(200)
    places = []
    for _ in range(3):
        stopped = session.next("filter")
        assert stopped.reason == "step"
        assert stopped.position.event is not None
        assert stopped.position.event["node"] == "/filter"
        places.append(stopped.position)
    assert session.reverse_next().position == places[1]
    assert session.reverse_next().position == places[0]
    with pytest.raises(DebugError, match="did you mean '/filter'"):
        session.next("filtr")


def test_next_is_of_the_node_whose_event_is_about_to_run(session: DebugSession) -> None:
    with pytest.raises(DebugError, match="nothing has run yet: give a node"):
        session.next()
    session.run_to(200)
    session.break_at("node /watch")
    here = session.go_on().position
    assert here.is_next
    assert here.event is not None
    assert here.event["node"] != "/watch"
    after = session.next().position
    assert (after.index, after.is_next) == (here.index + 1, False)


def test_the_nodes_of_a_main_are_there_before_it_spins(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(
        "import rclpy\n\n"
        "rclpy.init()\n"
        "node = rclpy.create_node('early')\n"
        "node.level = 7\n"
        "node.get_clock().sleep_for(rclpy.duration.Duration(seconds=1))\n"
        "rclpy.spin(node)\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{script: program.py}]\nstop: {duration: 2s}\n")
    with DebugSession(tmp_path / "job.yaml") as session:
        session.step()
        assert session.evaluate("early.level") == 7


@pytest.mark.long
def test_breakpoints_stop_forwards_and_backwards(session: DebugSession) -> None:
    too_fast = session.break_at("log warn /fast/")
    stopped = session.go_on()
    assert stopped.breakpoint == too_fast
    warned = stopped.position
    assert session.evaluate("filter.state") > 100
    session.clear(too_fast.number)
    message = session.break_at("/smooth: data > 150")
    first = session.go_on()
    assert first.breakpoint == message
    second = session.go_on()
    assert (second.position.index, second.position.is_next) == (first.position.index, True)
    assert "receives" in second.text
    third = session.go_on()
    assert third.position.index == first.position.index + 3
    assert session.reverse_go_on().position == second.position
    assert session.reverse_go_on().position == first.position
    back = session.reverse_go_on()
    assert (back.reason, back.position.index) == ("begin", 0)
    session.clear(message.number)
    at = session.break_at(str(warned.index))
    assert session.breakpoints == (at,)
    stopped = session.go_on()
    assert (stopped.position.index, stopped.position.is_next) == (warned.index, True)
    assert session.go_on().reason == "end"
    assert session.reverse_go_on().position == stopped.position
    with pytest.raises(ConditionError, match="did you mean '/smooth'"):
        session.break_at("/smoth: data > 1")


def test_the_end_is_an_end_from_which_one_can_go_back(session: DebugSession, trace: Trace) -> None:
    stopped = session.go_on()
    assert (stopped.reason, stopped.position.index) == ("end", trace.event_count)
    assert session.step().reason == "end"
    assert session.reverse_step().position.index == trace.event_count - 1
    assert session.step().reason == "end"


def test_who_changed_sent_and_when_it_became_true(session: DebugSession) -> None:
    session.go_to(700)
    changed = session.last_changed("filter", "warned")
    session.go_to(changed.index)
    assert session.evaluate("warned", "filter") == changed.stamp_ns
    session.reverse_step()
    assert session.evaluate("warned", "filter") is None
    made = session.last_changed("filter", "warned")
    assert made.event is not None
    assert made.event["kind"] == "construct"
    with pytest.raises(DebugError, match="/filter has had no attribute nothing so far"):
        session.last_changed("filter", "nothing")
    session.go_on()  # to the end, where the node is gone
    assert session.last_changed("filter", "warned") == changed
    session.go_to(700)
    true = session.first_true("when filter.state > 100")
    assert true == changed
    assert session.position.index == 700
    event = session.event(changed.index - 1)
    sent = session.sent_by(event["index"])
    assert sent.index == event["cause_event"] + 1
    assert sent.event is not None
    assert sent.event["node"] == "/source"


def test_questions(session: DebugSession) -> None:
    session.run_to(100)
    session.next("filter")
    own = session.node("filter")
    assert own["warned"] == "None"
    assert float(own["model.last"]) == 1.5 * session.evaluate("source.count")
    assert own["model.noise.level"] == str(session.evaluate("filter.model.noise.level"))
    assert "Filter object" in own["model.noise.node"]
    assert "model" not in own
    assert [node["name"] for node in session.inspect("nodes")] == ["/source", "/filter", "/watch"]
    message = session.inspect("message")
    assert message["name"] == "/speed"
    assert message["content"] == {"data": 1.5 * session.evaluate("source.count")}
    queues = {(one["node"], one["name"]): one["waiting"] for one in session.inspect("queues")}
    assert queues["/watch", "/smooth"] == 1
    assert queues["/filter", "/speed"] == 0
    (timer,) = session.inspect("timers")
    assert (timer["name"], timer["period_ns"]) == ("Source.tick", 10_000_000)
    assert timer["due_ns"] > session.position.stamp_ns
    assert "got" in session.inspect("source")["name"]
    links = {link["name"] for link in session.inspect("graph")["links"]}
    assert {"/speed", "/smooth", "/reset"} <= links
    assert session.inspect("stacks") == []
    with pytest.raises(DebugError, match="nothing is called 'queus'; did you mean 'queues'"):
        session.inspect("queus")
    with pytest.raises(DebugError, match="ZeroDivisionError"):
        session.evaluate("1 / 0")


def test_an_expression_changes_nothing(session: DebugSession) -> None:
    session.run_to(100)
    assert session.evaluate("vars(filter).update(state=1e9)") is None
    assert session.evaluate("filter.state") < 1e6
    assert session.go_on().reason == "end"


@pytest.mark.long
def test_a_job_that_was_never_recorded(folder: Path) -> None:
    with DebugSession(folder / "job.yaml") as session, Trace.open(folder / "run.mcap") as trace:
        assert session.events is None
        stopped = session.run_to(300)
        assert stopped.position.event is not None
        assert stopped.position.event["chain_hash"] == f"{trace.event(299).chain_hash:016x}"
        assert session.reverse_step().position.index == 299
        assert session.go_on().reason == "end"
        assert session.position.index == trace.event_count
        assert session.go_to(10).position.index == 10
        assert session.checkpoints()["why_not"] == ""


@pytest.mark.long
def test_a_trace_that_nobody_trusts_is_not_run(folder: Path) -> None:
    with pytest.raises(ReplayError, match="would run code"):
        DebugSession(folder / "run.mcap")


@pytest.mark.long
def test_what_if(folder: Path, tmp_path: Path, trace: Trace) -> None:
    """A session goes on in the branch that an edit makes, back and ahead, and keeps it."""
    with DebugSession(folder / "run.mcap", trust=True) as session:
        with pytest.raises(DebugError, match="nothing has been edited"):
            session.branch(tmp_path / "branch.mcap")
        stop = session.break_at("/smooth: data > 500")
        session.go_to(300)
        count, state = session.evaluate("source.count"), session.evaluate("filter.state")
        with pytest.raises(EditError, match="did you mean 'state'"):
            session.edit('node("/filter").stat = 0.0')
        assert session.evaluate("filter.state") == state
        assert session.edit('node("/filter").state = 1000.0').index == 300
        assert session.evaluate("filter.state") == 1000.0
        assert session.evaluate("source.count") == count
        assert session.reverse_step().position.index == 299
        assert session.evaluate("filter.state") == state
        assert [one.text for one in session.breakpoints] == [stop.text]
        hit = session.go_on()
        assert hit.reason == "breakpoint"
        assert hit.position.index in range(300, 306)
        session.go_to(330)
        session.edit('parameters("/source")["use_sim_time"] = True')
        path = session.branch(tmp_path / "branch.mcap")
        with pytest.raises(OutputError, match="exists"):
            session.branch(path)
    result = rsltrace.replay(path, trust=True, job_folder=folder)
    assert result.is_whole
    with Trace.open(path) as branch:
        assert branch.event_count == trace.event_count + 1
        assert branch.event(299).chain_hash == trace.event(299).chain_hash
        assert branch.digest != trace.digest


@pytest.mark.long
def test_what_if_of_a_job(folder: Path, tmp_path: Path) -> None:
    with DebugSession(folder / "job.yaml", overrides=["stop.duration=0.2s"]) as session:
        session.run_to("0.1s")
        index = session.position.index
        assert session.edit("drop()").index == index
        assert session.go_on().reason == "end"
        session.branch(tmp_path / "branch.mcap")
    with Trace.open(tmp_path / "branch.mcap") as branch:
        assert branch.end_ns == 200_000_000
