"""What if: a replay that goes on otherwise from somewhere, and the branch that comes of it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import rsltrace
from rsltrace.cli.main import cli
from rsltrace.errors import EditError
from rsltrace.job import load_job
from rsltrace.replay.edits import parse_edit
from rsltrace.run import run
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.recordings.export import export_bag
from tests.replay.conftest import JOB, NODES
from tests.run.conftest import TALKER
from tests.run.test_recorded_order import ALL, MIXED

pytestmark = pytest.mark.ros

SERVICE = """
from std_srvs.srv import SetBool

class Pair(Node):
    def __init__(self):
        super().__init__('pair')
        self.said = []
        self.declare_parameter('limit', 2.0)
        self.add_on_set_parameters_callback(self.check)
        self.server = self.create_service(SetBool, 'switch', self.serve)
        self.client = self.create_client(SetBool, 'switch')
        self.create_subscription(Float64, 'smooth', self.waits, 10)
        self.create_timer(0.5, self.ask)

    def check(self, parameters):
        from rcl_interfaces.msg import SetParametersResult
        return SetParametersResult(successful=parameters[0].value < 5, reason='too much')

    def ask(self):
        self.client.call_async(SetBool.Request(data=True))

    def serve(self, request, response):
        self.get_logger().info(f'asked {request.data}')
        return response

    async def waits(self, message):
        if message.data > 1:
            self.get_logger().info(f'{message.data:.3f}')
"""
SERVICE_JOB = JOB.replace("stop:", "  - node: nodes_of_replay:Pair\nstop:")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a job that has all that can be edited, and its trace."""
    folder = tmp_path_factory.mktemp("edits")
    (folder / "nodes_of_replay.py").write_text(NODES + SERVICE)
    (folder / "job.yaml").write_text(SERVICE_JOB)
    run(load_job(folder / "job.yaml"), folder / "run.mcap")
    return folder


def branch(folder: Path, *edits: str, trace: str = "run.mcap") -> rsltrace.ReplayResult:
    """Make a branch, and see that it replays with every event verified, to the same bytes."""
    made = folder / "branch.mcap"
    result = rsltrace.replay(folder / trace, edits=edits, output=made, force=True, trust=True)
    again = rsltrace.replay(made, output=folder / "again.mcap", force=True, trust=True)
    assert again.is_whole, again.sentence
    assert again.digest == result.digest
    a, b = made.read_bytes(), (folder / "again.mcap").read_bytes()
    assert len(a) == len(b)
    return result


def events(path: Path, kind: EventKind, name: str) -> list[int]:
    """Return the indexes of the events of that kind and entity."""
    with Trace.open(path) as trace:
        found = (trace.event(index) for index in range(trace.event_count))
        return [e.index for e in found if e.kind is kind and trace.entity(e.entity).name == name]


def values(path: Path, topic: str) -> list[float]:
    with Trace.open(path) as trace:
        return [trace.decode(topic, data).data for _, _, data in trace.messages(topic)]  # type: ignore[attr-defined]


@pytest.mark.long
def test_a_message_as_one_receives_it_or_as_it_is_published(folder: Path) -> None:
    at = events(folder / "run.mcap", EventKind.SUBSCRIPTION, "/speed")[3]
    result = branch(folder, f"{at}: message.data += 100")
    before, after = (
        values(folder / "run.mcap", "/smooth"),
        values(folder / "branch.mcap", "/smooth"),
    )
    assert after[:3] == before[:3]
    assert after[3] == pytest.approx(before[3] + 12.5)
    assert values(folder / "branch.mcap", "/speed") == values(folder / "run.mcap", "/speed")
    assert result.verified == at
    assert result.exit_code == 1
    assert result.diff is not None
    assert result.diff.agreeing == at
    assert any(one.place == "edits" for one in result.diff.settings)

    branch(folder, '1.05s: topic("/speed").data = -1.0')
    before = values(folder / "run.mcap", "/speed")
    assert values(folder / "branch.mcap", "/speed") == [*before[:10], -1.0, *before[11:]]


@pytest.mark.long
def test_attributes_and_parameters(folder: Path) -> None:
    result = branch(folder, '1.05s: node("/source").gain = 0')
    assert values(folder / "branch.mcap", "/speed")[9:12] == [20.25, 0.25, 0.25]
    assert result.verified == events(folder / "run.mcap", EventKind.TIMER, "Source.tick")[10]
    branch(folder, '1.05s: parameters("/pair")["limit"] = 4')
    with Trace.open(folder / "branch.mcap") as trace:
        (at,) = (e for e in map(trace.event, range(trace.event_count)) if e.kind.name == "OUTSIDE")
        sent = [trace.channel_of(one) for one in trace.outputs_of(at.index)]
        assert [one.topic for one in sent if one is not None] == ["/parameter_events"]


@pytest.mark.long
def test_what_is_dropped_and_what_comes_later(folder: Path) -> None:
    recorded = folder / "run.mcap"
    tick = events(recorded, EventKind.TIMER, "Source.tick")[4]
    speed = values(recorded, "/speed")
    branch(folder, f"{tick}: drop()")
    assert values(folder / "branch.mcap", "/speed") == speed[:-1], "it counts its ticks"
    branch(folder, '0.45s: drop("/speed")')
    assert values(folder / "branch.mcap", "/speed") == [*speed[:4], *speed[5:]]
    asked = events(recorded, EventKind.SERVICE, "/switch")
    branch(folder, f"{asked[1]}: delay('20ms')", f"{asked[0]}: drop()")
    with Trace.open(folder / "branch.mcap") as trace:
        stamps = [
            trace.event(at).stamp_ns
            for at in events(folder / "branch.mcap", EventKind.SERVICE, "/switch")
        ]
    assert len(stamps) == len(asked) - 1
    heard = events(recorded, EventKind.SUBSCRIPTION, "/smooth")
    later = branch(folder, f"{heard[0]}: delay('7ms')")
    assert later.diff is not None
    assert later.diff.verdict.value == "timing"


@pytest.mark.long
def test_the_order_of_two_that_are_ready(folder: Path) -> None:
    """At 0.5 s Source.tick and Pair.ask are due, in this order."""
    tick = events(folder / "run.mcap", EventKind.TIMER, "Source.tick")[4]
    ask = events(folder / "run.mcap", EventKind.TIMER, "Pair.ask")[0]
    for count, expected in (("1", 1), ("", 1)):
        branch(folder, f"{tick}: defer({count})")
        swapped = folder / "branch.mcap"
        of_tick = events(swapped, EventKind.TIMER, "Source.tick")[4]
        of_ask = events(swapped, EventKind.TIMER, "Pair.ask")[0]
        assert of_ask == tick
        assert of_tick >= tick + expected
        with Trace.open(swapped) as trace:
            assert trace.event(of_tick).stamp_ns == trace.event(of_ask).stamp_ns == 500_000_000
    assert ask > tick


@pytest.mark.long
def test_a_coroutine_gets_another_message_or_none(folder: Path) -> None:
    with Trace.open(folder / "run.mcap") as trace:
        pair = next(one for one in trace.entities.values() if one.name == "/pair").id
        mine = next(
            one.id for one in trace.entities.values() if one.node == pair and one.name == "/smooth"
        )
        at = next(
            e.index
            for e in map(trace.event, range(trace.event_count))
            if e.entity == mine and e.kind is EventKind.SUBSCRIPTION
        )
    told = branch(folder, f"{at}: message.data = 77.5")
    assert told.diff is not None
    assert "77.500" in str(told.diff)
    branch(folder, f"{at}: drop()")


@pytest.mark.long
def test_a_branch_of_a_branch(folder: Path) -> None:
    branch(folder, '1s: node("/source").gain = 5.0')
    (folder / "branch.mcap").rename(folder / "first.mcap")
    result = branch(folder, '2.05s: drop("/speed")', trace="first.mcap")
    assert result.edits == ('1s: node("/source").gain = 5.0', '2.05s: drop("/speed")')
    first, second = (
        values(folder / "first.mcap", "/speed"),
        values(folder / "branch.mcap", "/speed"),
    )
    assert second == [*first[:20], *first[21:]]


@pytest.mark.long
def test_messages_of_a_bag(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "nodes_of_replay.py").write_text(NODES)
    export_bag(folder / "run.mcap", tmp_path / "bag")
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: 'nodes_of_replay:Filter'}]\nbags: [{path: bag, topics: [/speed]}]\n"
    )
    run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    speed = values(tmp_path / "run.mcap", "/speed")
    branch(tmp_path, '@3s: drop("/speed")')
    assert values(tmp_path / "branch.mcap", "/speed") == speed[:-1]
    fifth = events(tmp_path / "run.mcap", EventKind.BAG, "/speed")[4]
    branch(tmp_path, f"{fifth}: message.data = -1", '2.85s: topic("/speed").data += 1')
    expected = [*speed[:4], -1.0, *speed[5:-1], speed[-1] + 1]
    assert values(tmp_path / "branch.mcap", "/speed") == expected
    branch(tmp_path, f"{fifth}: drop()")
    assert values(tmp_path / "branch.mcap", "/speed") == [*speed[:4], *speed[5:]]


@pytest.mark.long
def test_edits_that_change_nothing(folder: Path) -> None:
    result = branch(folder, '1s: node("/pair").said = [1]')
    assert result.exit_code == 0
    assert result.diff is None
    assert "change nothing" in result.sentence


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ("3: message.data = 1.0", "receives no message"),
        ("10: message.dta = 1.0", "has no dta (it has data); did you mean 'data'?"),
        ("10: message.data = 'text'", "must be a float"),
        ('1s: node("/filter").stat = 1', "has no attribute 'stat'; did you mean 'state'?"),
        ('1s: node("/fliter").state = 1', "is not a node in"),
        ('1s: topic("/spede").data = 1.0', "has no publisher"),
        ('1s: parameters("/source")["gian"] = 1.0', "has no parameter 'gian'"),
        ('1s: parameters("/pair")["limit"] = 9.0', "refuses limit = 9.0: too much"),
        ("9999: drop()", "the last event of"),
        ("60s: drop()", "ends at 3 s"),
        ("0: drop()", "cannot be dropped"),
        ("0: defer()", "cannot run later"),
        ('2.95s: topic("/speed").data = 1e999', None),
        ('2.99s: topic("/parameter_events").node = "x"', "was not made: the run was over before"),
    ],
)
def test_what_cannot_be_edited_leaves_no_branch(folder: Path, edit: str, said: str | None) -> None:
    output = folder / "never.mcap"
    output.unlink(missing_ok=True)
    if said is None:
        assert rsltrace.replay(folder / "run.mcap", edits=edit, trust=True).diverged
        return
    with pytest.raises(EditError) as caught:
        rsltrace.replay(folder / "run.mcap", edits=edit, output=output, trust=True)
    assert said in str(caught.value)
    assert [path for path in folder.iterdir() if "never" in path.name] == []


@pytest.mark.long
def test_what_cannot_be_edited_leaves_what_is_there(folder: Path) -> None:
    output = folder / "kept.mcap"
    recorded = (folder / "run.mcap").read_bytes()
    output.write_bytes(recorded)
    with pytest.raises(EditError):
        rsltrace.replay(
            folder / "run.mcap",
            edits='1s: node("/filter").stat = 1',
            output=output,
            force=True,
            trust=True,
        )
    assert output.read_bytes() == recorded
    assert [path.name for path in folder.iterdir() if "kept" in path.name] == ["kept.mcap"]


@pytest.mark.parametrize(
    ("text", "said", "column"),
    [
        ("drop()", "begins with where", 0),
        ("soon: drop()", "neither the index", 0),
        ("12: message.data = ", "invalid syntax", None),
        ("12: message.data = open('x')", "a value is a literal", 19),
        ("12: message = 3", "an edit is one of", 4),
        ("12: drop(); drop()", "an edit is one of", 4),
        ("12: delay(5)", "delay takes a time", 4),
        ("12: delay('-5ms')", "", 4),
        ("12: defer(0)", "defer takes nothing", 4),
        ("12: drop('odom')", "drop takes nothing or a topic", 4),
        ("12: message.data += 'x'", "takes a number", 20),
        ('12: node("/x") = 3', "cannot assign", None),
        ("12: import os", "an edit is one of", 4),
        ('12: parameters("/x")["a"] += 1', "an edit is one of", 4),
    ],
)
def test_texts_that_are_no_edits(text: str, said: str, column: int | None) -> None:
    with pytest.raises(EditError) as caught:
        parse_edit(text)
    message, shown, caret = str(caught.value).split("\n")
    assert said in message
    assert shown == f"  {text.strip()}"
    if column is not None:
        assert caret.index("^") - 2 == column


@pytest.mark.long
def test_the_command_and_what_others_say_of_a_branch(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr("rsltrace.cli.replay.unpin", lambda: None)
    edit = '1s: topic("/speed").data = 0.0'
    command: Callable[..., Any] = CliRunner().invoke
    done = command(cli, ["replay", "run.mcap", "--edit", edit, "-o", "told.mcap", "-q"])
    assert done.exit_code == 1, done.output
    assert f"edit {edit}\n" in done.stdout
    assert "same-input-different-output" in done.stdout
    assert f"edits  -  |  {edit}" in done.stdout
    assert f"  {edit}\n" in command(cli, ["info", "told.mcap"]).stdout
    refused = command(cli, ["replay", "told.mcap"])
    assert refused.exit_code != 0
    assert "it holds edits" in refused.stderr
    again = command(cli, ["replay", "told.mcap", "--trust"])
    assert again.exit_code == 0
    assert f"with the edits {edit}" in again.stderr


KINDS = ("drop()", "defer()", "defer(1)", "delay('30ms')", "message.data = 5")


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mixed")
    (folder / "nodes_under_test.py").write_text(TALKER + MIXED)
    for name, more in (
        ("plain", ""),
        (
            "busy",
            "policy: permutation\nexecutors: single_threaded\n"
            "execution: {default: 2ms}\ndelay: {default: 3ms}\n",
        ),
    ):
        (folder / "job.yaml").write_text(ALL + more + "seed: 5\n")
        run(load_job(folder / "job.yaml"), folder / f"{name}.mcap")
    return folder


@pytest.mark.long
@pytest.mark.repeated
@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_any_edit_of_mains_threads_and_policies_gives_a_branch_or_a_reason(
    mixed: Path, data: st.DataObject
) -> None:
    name = data.draw(st.sampled_from(("plain.mcap", "busy.mcap")))
    with Trace.open(mixed / name) as trace:
        at = data.draw(st.integers(0, trace.event_count - 1))
    edit = f"{at}: {data.draw(st.sampled_from(KINDS))}"
    with contextlib.suppress(EditError):
        result = branch(mixed, edit, trace=name)
        assert result.verified <= at or result.diff is None
