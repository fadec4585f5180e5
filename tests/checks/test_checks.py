"""Checks of a job against traces: what they say, and that the right runs are told apart."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from rsltrace import CheckResult, Job, NodeSpec, Trace, evaluate_checks, load_job, measure_latencies
from rsltrace.checks.conditions.condition import ActiveCondition
from rsltrace.checks.properties import EventuallyProperty, NeverProperty, RateProperty, RunProperty
from rsltrace.cli.main import cli
from rsltrace.errors import CheckError, JobError

SAMPLE = Path(__file__).parents[2] / "sample_traces" / "nondeterministic_callback"
A = SAMPLE / "a.mcap"
S = 1_000_000_000


def checked(*checks: dict[str, Any], load: Any = None) -> list[CheckResult]:
    with Trace.open(A) as trace:
        return evaluate_checks(trace, Job(nodes=[NodeSpec(node="m:N")], checks=checks), load)


def messages(topic: str) -> list[tuple[int, Any]]:
    with Trace.open(A) as trace:
        return [(stamp, trace.decode(topic, data)) for stamp, _, data in trace.messages(topic)]


@pytest.mark.parametrize("limit", [-1.0, 0.0, 0.21, 0.23, 1.0])
@pytest.mark.parametrize("text", ["/cmd_vel.linear.x < {}", "/cmd_vel: linear.x < {}"])
def test_always_and_never_agree_with_the_messages(limit: float, text: str) -> None:
    wrong = [stamp for stamp, m in messages("/cmd_vel") if not m.linear.x < limit]
    always, never = checked(
        {"always": text.format(limit)}, {"never": text.format(limit).replace("<", ">=")}
    )
    for found in (always, never):
        assert found.count == len(wrong)
        assert [one.stamp_ns for one in found.violations] == wrong
        assert found.verdict == ("violated" if wrong else "passed")
    if wrong:
        assert "linear.x = 0." in always.violations[0].text
        assert always.violations[0].text.startswith(f"not {text.format(limit)}")


def test_what_has_to_follow_in_time() -> None:
    soon, late, rare, early = checked(
        {"eventually": "/cmd_vel", "after": "/scan: min(ranges) < 2", "within": "1ns"},
        {"eventually": "/scan", "after": "/cmd_vel", "within": "90ms"},
        {"eventually": "exception"},
        {"eventually": "exception", "within": "90ms"},
    )
    assert soon.verdict == "passed"
    assert late.verdict == "violated"
    assert late.violations[0].event is not None
    assert "within 90 ms of event" in late.violations[0].text
    assert (rare.verdict, rare.violations[0].event) == ("violated", None)
    with Trace.open(A) as trace:  # when it was too late
        assert rare.violations[0].stamp_ns == trace.end_ns
        assert early.violations[0].stamp_ns == trace.start_ns + 90_000_000


ROVER = SAMPLE.parent / "delayed_input" / "b.mcap"
POSE = {"from": "/odom", "to": "/pose", "via": ["/localizer"]}


@pytest.mark.parametrize("measure", ["latency", "age", "last_age", "reaction", "worst_reaction"])
def test_latencies(measure: str) -> None:
    below_ms, percent = [1, 9, 19, 39, 49, 1000], [None, 50, 99]
    with Trace.open(ROVER) as trace:
        given = [
            {"latency": {**POSE, "measure": measure, "below": f"{ms}ms", "quantile": of}}
            for ms in below_ms
            for of in percent
        ]
        found = evaluate_checks(trace, Job(nodes=[NodeSpec(node="m:N")], checks=given))
        (chain,) = measure_latencies(trace, start="/odom", end="/pose", via=["/localizer"]).chains
        measured = sorted(chain.durations(measure).tolist())
        sent = set(chain.events()[:, -1].tolist())
        for one, check in zip(found, given, strict=True):
            limit, of = (
                int(check["latency"]["below"][:-2]) * S // 1000,
                check["latency"]["quantile"],
            )
            over = [ns for ns in measured if ns >= limit]
            at_most = measured[-1 if of is None else math.ceil(of / 100 * len(measured)) - 1]
            assert (one.verdict == "violated") == (at_most >= limit)
            if one.verdict == "violated":
                assert one.count == len(over)
                assert {v.event for v in one.violations} <= sent
                stamps = {v.stamp_ns for v in one.violations}
                assert stamps <= set(chain.found.output_ns.tolist())
    assert {one.verdict for one in found} == {"passed", "violated"}


def test_latencies_of_what_is_not_there() -> None:
    assert [
        one.verdict
        for one in checked(
            {"latency": {"from": "/scan", "to": "/driver", "below": 1}},
            {"latency": {"chain": ["/scan", "/push", "/driver"], "below": 1}},
        )
    ] == ["passed", "passed"], "a chain may end in a node"
    never, gone = checked(
        {"latency": {"from": "/cmd_vel", "to": "/scan", "below": 1}},
        {"latency": {"chain": ["/scan", "/cmd_vel"], "below": 1}},
    )
    assert (never.verdict, never.violations[0].event) == ("violated", None)
    assert "no way leads there" in never.violations[0].text
    assert "/push may belong in between" in gone.violations[0].text
    with pytest.raises(JobError, match="no topic is called '/scn'; did you mean '/scan'"):
        checked({"latency": {"from": "/scn", "to": "/push", "below": 1}})
    with pytest.raises(JobError, match="no node is called '/diver'; did you mean '/driver'"):
        checked({"latency": {"from": "/scan", "to": "/push", "below": 1, "via": ["/diver"]}})
    for wrong, said in (
        ({"from": "/scan", "below": 1}, "which chain"),
        ({"chain": ["/scan"], "below": 1}, "two topics"),
        ({"chain": ["/scan", "/push"], "to": "/push", "below": 1}, "either chain"),
        ({"from": "/scan", "to": "/push"}, "'below' is missing"),
    ):
        with pytest.raises(JobError, match=said):
            checked({"latency": wrong})


def test_rates() -> None:
    at_least, too_fast, short = checked(
        {"rate": "/scan", "at_least": "10 Hz"},
        {"rate": "/scan", "at_most": 9},
        {"rate": "/scan", "at_least": 1, "over": "1h"},
    )
    assert at_least.verdict == "passed"
    assert "10 messages" in too_fast.violations[0].text
    assert short.verdict == "undecided"
    assert short.note == "less than 3600 s is left after its first message"


@pytest.mark.parametrize(
    ("at_least", "end_ns", "violations", "undecided"),
    [(1, 2 * S, 1, 0), (1, S // 2, 0, 1), (None, 2 * S, 0, 0)],
)
def test_a_silent_topic_is_too_slow(
    at_least: float | None, end_ns: int, violations: int, undecided: int
) -> None:
    rate = RateProperty("/x", at_least, 9)
    rate.end(end_ns, complete=True)
    assert (rate.count, rate.undecided) == (violations, undecided)
    for found in rate.found:
        assert (found.event, found.stamp_ns) == (None, end_ns)
        assert found.text == "there is no message: 0 Hz, at least 1 Hz"


@pytest.mark.parametrize(
    ("check", "said"),
    [
        ({"always": "/scna: min(ranges) < 2"}, "did you mean '/scan'"),
        (
            {"always": "/scan.ranges[0] <"},
            "not an expression: invalid syntax\n  /scan: msg.ranges[0] <",
        ),
        ({"always": "/scan"}, "for what must not happen, never"),
        ({"never": "node /driver"}, "takes a function"),
        ({"never": "when driver.x > 1"}, "takes a function"),
        ({"never": "/scan.ranges[0] > /cmd_vel.linear.x"}, "messages of one topic"),
        ({"rate": "/scna", "at_least": 1}, "did you mean '/scan'"),
    ],
)
def test_what_cannot_be_understood(check: dict[str, Any], said: str) -> None:
    with pytest.raises(JobError, match=r"checks\[0\]") as caught:
        checked(check)
    assert said in str(caught.value)


def test_what_cannot_be_evaluated() -> None:
    with pytest.raises(JobError, match=r"checks\[0\].*did you mean .ranges."):
        checked({"always": "/scan: rangs[0] > 0"})
    (found,) = checked({"never": "/scan: ranges[100000] > 0"})
    assert found.verdict == "passed"
    assert "IndexError" in found.note
    (found,) = checked({"always": "/scan: ranges[100000] > 0"})
    assert (found.verdict, found.count) == ("violated", len(messages("/scan")))
    assert "(ranges[100000] = IndexError: " in found.violations[0].text


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"always": "/a", "never": "/b"},
        {"rate": "/a"},
        {"rate": "/a", "at_least": "fast"},
        {"rate": "/a", "at_least": "0 Hz"},
        {"never": "/a", "at_least": 1},
        {"rate": "/a", "at_least": 1, "within": "1s"},
        {"eventually": "/a", "within": 0},
        {"eventually": "/a", "wihin": "1s"},
    ],
)
def test_checks_that_make_no_sense(keys: dict[str, Any]) -> None:
    with pytest.raises(JobError):
        Job(nodes=[NodeSpec(node="m:N")], checks=[keys])


@pytest.mark.parametrize(
    ("said", "texts"),
    [
        (None, []),
        (True, []),
        (False, ["it returned False"]),
        ("too near", ["too near"]),
        ([(3, "odd"), "at the end"], ["odd", "at the end"]),
    ],
)
def test_functions(said: Any, texts: list[str]) -> None:
    (found,) = checked({"function": "m:f"}, load=lambda target: lambda trace: said)
    assert [one.text for one in found.violations] == texts


def test_functions_that_raise() -> None:
    def asserts(trace: Trace) -> None:
        raise AssertionError("hit the wall")

    (found,) = checked({"function": asserts}, load=lambda target: target)
    assert found.violations[0].text == "hit the wall"
    for wrong in (lambda trace: 1 / 0, lambda trace: 3, lambda trace: [(10**9, "where?")]):
        with pytest.raises(CheckError):
            checked({"function": wrong}, load=lambda target: target)
    assert checked({"function": "m:f"})[0].verdict == "skipped"


# -- against the definition ------------------------------------------------------------------------


class _Is(ActiveCondition):
    def __init__(self, letter: str) -> None:
        self._letter = letter

    def after(self, view: Any) -> str:
        return self._letter if self._letter in view.letters else ""


class _Event:
    def __init__(self, index: int, stamp_ns: int, letters: str) -> None:
        self.index, self.stamp_ns, self.letters = index, stamp_ns, letters

    def sent(self) -> Sequence[Any]:
        from rsltrace.checks.conditions.view import SentOutput

        return [SentOutput(1, letter, 0) for letter in self.letters]


RUNS = st.lists(
    st.tuples(st.integers(0, 3), st.sampled_from(["", "x", "t", "xt", "o"])), max_size=12
)


def _held(one: RunProperty, run: list[tuple[int, str]], end: int) -> list[int | None]:
    for index, (stamp, letters) in enumerate(run):
        one.advance(stamp - 1)  # as while a native run goes on
        one.see(_Event(index, stamp, letters))  # type: ignore[arg-type]
    one.end(end, complete=True)
    return [found.event for found in one.found]


def _run(steps: list[tuple[int, str]]) -> tuple[list[tuple[int, str]], int]:
    stamp, run = 0, []
    for step, letters in steps:
        stamp += step
        run.append((stamp, letters))
    return run, stamp + 2


@given(RUNS, st.one_of(st.none(), st.integers(1, 4)))
def test_eventually_is_what_it_says(steps: list[tuple[int, str]], within: int | None) -> None:
    run, end = _run(steps)
    wanted = []
    for at, (begin, letters) in enumerate(run):
        last = end if within is None else begin + within
        follows = any("x" in later and stamp <= last for stamp, later in run[at:])
        if "t" in letters and not follows and last <= end:
            wanted.append(at)
    assert _held(EventuallyProperty(_Is("x"), _Is("t"), within), run, end) == wanted


@given(RUNS, st.one_of(st.none(), st.integers(1, 4)))
def test_never_is_what_it_says(steps: list[tuple[int, str]], within: int | None) -> None:
    run, end = _run(steps)
    wanted = [
        at
        for at, (stamp, letters) in enumerate(run)
        if "x" in letters
        and any(
            "t" in before and (within is None or stamp <= begin + within)
            for begin, before in run[:at]
        )
    ]
    assert _held(NeverProperty(_Is("x"), _Is("t"), within), run, end) == wanted


@given(RUNS, st.integers(1, 4), st.integers(1, 5))
def test_rates_are_what_they_say(steps: list[tuple[int, str]], over: int, count: int) -> None:
    run, end = _run(steps)
    sent = [(at, stamp) for at, (stamp, letters) in enumerate(run) if "x" in letters]
    wanted = []
    for number, (at, begin) in enumerate(sent):
        inside = [one for one, stamp in sent[number + 1 :] if stamp <= begin + over]
        if begin + over <= end and len(inside) < count:
            wanted.append(at)
    expected: list[int | None] = [*wanted] if sent else [None] if end >= over else []
    hz = count * S / over
    assert math.isclose(hz * over / S, count)
    assert _held(RateProperty("x", hz, None, over), run, end) == expected


# -- as a user runs it -----------------------------------------------------------------------------

NODES = """
from rclpy.node import Node
from std_msgs.msg import Float64

class Talker(Node):
    def __init__(self):
        super().__init__("talker")
        self.sent = self.create_publisher(Float64, "/x", 10)
        self.count = 0
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.count += 1
        self.sent.publish(Float64(data=float(self.count)))

def few(trace):
    assert trace.event_count < 5, f"{trace.event_count} events"
"""


@pytest.mark.ros
def test_a_job_with_checks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "src").mkdir()
    (tmp_path / "talkers.py").write_text(NODES)
    job = tmp_path / "job.yaml"
    job.write_text(
        "nodes: [{node: talkers:Talker}]\nstop: {duration: 1s}\nsearch_path: [., src]\n"
        "checks:\n  - always: /x.data < 8\n  - {name: few, function: talkers:few}\n"
    )
    done = CliRunner().invoke(cli, ["record", "job.yaml", "-o", "run.mcap", "--no-pin"])
    assert done.exit_code == 1, done.output
    assert done.stdout.startswith("digest ")
    assert "check violated: always /x.data < 8" in done.stderr
    assert "not /x.data < 8 (data = 8.0)" in done.stderr
    assert "check violated: few" in done.stderr
    with Trace.open("run.mcap") as trace:
        (first, _) = evaluate_checks(trace, load_job(job))
        assert f"view run.mcap --at {first.violations[0].event}" in done.stderr
        assert trace.event(first.violations[0].event or 0).stamp_ns == 8 * S // 10

    done = CliRunner().invoke(cli, ["check", "run.mcap", "--format", "json"])
    assert done.exit_code == 1
    found = json.loads(done.stdout)
    assert [one["verdict"] for one in found["checks"]] == ["violated", "skipped"]
    assert found["metrics"] == {}
    monkeypatch.chdir("/")  # where nothing is that the job names
    elsewhere = CliRunner().invoke(cli, ["check", str(tmp_path / "run.mcap"), "--format", "json"])
    assert (elsewhere.exit_code, json.loads(elsewhere.stdout)) == (1, found), elsewhere.output
    monkeypatch.chdir(tmp_path)
    job.write_text(job.read_text().replace("< 8", "< 80").replace("talkers:few", "talkers:Talker"))
    job.write_text(job.read_text().split("  - {name")[0])
    assert CliRunner().invoke(cli, ["check", "run.mcap", "--job", "job.yaml"]).exit_code == 0

    rest = (
        "  - eventually: '/x: dta > 1'\n  - {rate: /x, at_least: 1}\n  - {rate: /y, at_least: 1}\n"
    )
    job.write_text(job.read_text() + rest)
    done = CliRunner().invoke(cli, ["check", "job.yaml"])
    assert done.exit_code == 1, done.output
    assert "job.yaml:6:17: eventually: the message has no field 'dta'; did you mean" in done.stdout
    assert "job.yaml:8:12: no topic is called '/y'; there are /x" in done.stdout
    assert done.stdout.count("job.yaml:") == 2

    (tmp_path / "talkers.py").write_text(NODES.replace("self.count = 0", "self.count = None"))
    done = CliRunner().invoke(cli, ["record", "job.yaml", "-o", "failed.mcap", "--no-pin"])
    assert done.exit_code == 3, "the run failed, and what would have come later is no mistake"
    assert "'/y'" not in done.stderr

    job.write_text(job.read_text().replace("/x.data < 80", "/x.data <"))
    done = CliRunner().invoke(cli, ["record", "job.yaml", "-o", "other.mcap", "--no-pin"])
    assert done.exit_code == 2
    assert "job.yaml:5" in done.stderr
    assert not (tmp_path / "other.mcap").exists(), "it is said before anything runs"
