"""What a breakpoint's text means: where it stops, and what of a wrong text is pointed at."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.checks.conditions.condition import ActiveCondition, EventCondition
from rsltrace.checks.conditions.expressions import parse_expression
from rsltrace.checks.conditions.names import RunNames, loaded_fields
from rsltrace.checks.conditions.text import parse_condition
from rsltrace.checks.conditions.view import SentOutput
from rsltrace.errors import ConditionError
from rsltrace.trace.model.event import EventKind, OutputKind

NODES = ("/ekf", "/robot/scanner", "/left/wheel", "/right/wheel")
TOPICS = ("/odom", "/scan", "/robot/plan")
ODOMETRY = {"header": "std_msgs/Header", "pose": "geometry_msgs/PoseWithCovariance"}
FIELDS: dict[str, dict[str, str]] = {
    "nav_msgs/msg/Odometry": ODOMETRY,
    "std_msgs/msg/Header": {"stamp": "builtin_interfaces/Time", "frame_id": "string"},
    "geometry_msgs/msg/PoseWithCovariance": {
        "pose": "geometry_msgs/Pose",
        "covariance": "double[36]",
    },
    "geometry_msgs/msg/Pose": {"position": "geometry_msgs/Point"},
    "geometry_msgs/msg/Point": {"x": "double", "y": "double", "z": "double"},
    "sensor_msgs/msg/LaserScan": {"ranges": "sequence<float>", "range_max": "float"},
}
NAMES = RunNames(
    nodes=NODES,
    topics=TOPICS,
    entities=(*NODES, *TOPICS, "Ekf.update"),
    are_all=True,
    interfaces={"/odom": "nav_msgs/msg/Odometry", "/scan": "sensor_msgs/msg/LaserScan"},
    fields=FIELDS.get,
)


@dataclass
class View:
    """An event made by hand."""

    index: int = 0
    stamp_ns: int = 0
    start_ns: int = 0
    kind: int = EventKind.SUBSCRIPTION
    entity: int = 7
    entity_name: str = "/odom"
    node: str = "/ekf"
    output_hash: int = 0
    input: tuple[str, object] | None = None
    outputs: Sequence[SentOutput] = ()
    found: Sequence[str] = ()
    there: Mapping[str, object] = field(default_factory=dict)

    def nodes(self) -> Mapping[str, object]:
        return self.there

    def received(self) -> tuple[str, object] | None:
        return self.input

    def sent(self) -> Sequence[SentOutput]:
        return self.outputs

    def findings(self) -> Sequence[str]:
        return self.found


def armed(text: str, at: View | None = None) -> ActiveCondition:
    return parse_condition(text, NAMES).arm(at or View())


def odometry(x: float) -> SimpleNamespace:
    position = SimpleNamespace(x=x, y=0.0, z=0.0)
    return SimpleNamespace(pose=SimpleNamespace(pose=SimpleNamespace(position=position)))


def wrong(text: str, names: RunNames = NAMES) -> tuple[str, str]:
    """Return what is said of a wrong text, and the part that is pointed at."""
    with pytest.raises(ConditionError) as caught:
        parse_condition(text, names)
    error = caught.value
    _, shown, carets = str(error).rsplit("\n", 2)
    assert shown == f"  {error.text}"
    begin = carets.index("^") - 2
    assert error.text[begin : begin + carets.count("^")] == error.text[error.start : error.end]
    return error.message, error.text[error.start : error.end]


# -- each kind -------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["812", "event 812", "index:812", "  812  "])
def test_an_index_stops_before_that_event(text: str) -> None:
    watch = armed(text)
    assert watch.before(View(index=812)) == "event 812"
    assert not watch.before(View(index=811))
    assert not watch.after(View(index=812))


@pytest.mark.parametrize("text", ["t=2.5s", "t = 2500ms", "time:2.5", "2.5", "2.5 s", "t=2.5 s"])
def test_a_time_stops_before_the_first_event_at_it_or_after_it_and_once(text: str) -> None:
    watch = armed(text)
    assert not watch.before(View(stamp_ns=2_499_999_999))
    assert not watch.before(View(stamp_ns=2_600_000_000, kind=EventKind.CONSTRUCT))
    assert watch.before(View(stamp_ns=2_600_000_000)) == "2.600000000 s"
    assert not watch.before(View(stamp_ns=2_600_000_000))
    late = armed(text, View(stamp_ns=2_500_000_000))
    assert not late.before(View(stamp_ns=2_600_000_000)), "it is past already"


def test_nodes_and_entities_go_by_name_pattern_and_number() -> None:
    event = View(entity_name="Ekf.update", entity=27)
    for text in ("node /ekf", "node ekf", "node:/ekf", "node /e*", "/ekf", "entity Ekf.update"):
        assert armed(text).before(event), text
    assert armed("entity #27").before(event) == "/ekf: Ekf.update"
    for text in ("node /robot/scanner", "entity /odom", "entity #28", "node *wheel"):
        assert not armed(text).before(event), text
    assert not armed("node /ekf").before(View(node=""))


def test_a_topic_stops_after_who_sends_and_before_who_receives() -> None:
    watch = armed("topic /odom")
    sent = [SentOutput(OutputKind.LOG, "", 1), SentOutput(OutputKind.MESSAGE, "/odom", 2)]
    assert watch.after(View(outputs=sent)) == "/ekf has published on /odom"
    assert watch.before(View(input=("/odom", None))) == "/ekf receives /odom"
    assert not watch.after(View(input=("/odom", None)))
    assert not watch.before(View(input=("/scan", None)))
    call = View(outputs=[SentOutput(OutputKind.REQUEST, "/robot/plan", 3)])
    assert armed("/robot/plan").after(call) == "/ekf has called /robot/plan"


@pytest.mark.parametrize(
    "text",
    [
        "/odom: pose.pose.position.x > 3",
        "topic /odom: msg.pose.pose.position.x > 3",
        "topic /odom if pose.pose.position.x > 3",
    ],
)
def test_a_message_stops_where_its_fields_say_so(text: str) -> None:
    watch = armed(text)
    assert watch.before(View(input=("/odom", odometry(3.5)))).endswith("pose.position.x > 3")
    assert not watch.before(View(input=("/odom", odometry(3.0))))
    assert not watch.before(View(input=("/scan", odometry(3.5))))
    out = SentOutput(OutputKind.MESSAGE, "/odom", 2, message=lambda: odometry(4.0))
    assert watch.after(View(outputs=[out])).startswith("/ekf has published on /odom, and ")


def test_an_element_that_is_not_there_makes_it_false_and_a_wrong_field_is_an_error() -> None:
    watch = armed("/scan: ranges[5] < 1")
    assert not watch.before(View(input=("/scan", SimpleNamespace(ranges=[0.1]))))
    assert watch.note == "IndexError: list index out of range"
    unknown = parse_condition("/scan: rages[0] < 1").arm(View())
    with pytest.raises(ConditionError, match="no field 'rages'; did you mean 'ranges'") as caught:
        unknown.before(View(index=12, input=("/scan", SimpleNamespace(ranges=[0.1]))))
    assert caught.value.message.startswith("event 12: ")
    assert caught.value.text[caught.value.start :] == "rages[0] < 1"


def test_hashes_of_all_outputs_and_of_each() -> None:
    view = View(output_hash=0x3F2A << 48, outputs=[SentOutput(OutputKind.TIMER, "", 0xABC << 52)])
    for text in ("output 3f2a", "output 3F2A…", "hash:3f", "output abc", "output abc0000000000000"):
        assert armed(text).after(view), text
    assert not armed("output 3f2b").after(view)
    assert not armed("output 0").after(View()), "no outputs, no hash"


def test_exceptions_by_type_and_by_what_python_derives_it_from() -> None:
    view = View(outputs=[SentOutput(OutputKind.EXCEPTION, "", 1, "FileNotFoundError: no map.yaml")])
    for text in ("exception", "exception FileNotFoundError", "exception OSError", "raised"):
        assert armed(text).after(view) == "raised FileNotFoundError: no map.yaml", text
    assert not armed("exception ValueError").after(view)
    own = View(outputs=[SentOutput(OutputKind.EXCEPTION, "", 1, "robot.errors.Lost: where am I")])
    assert armed("exception Lost").after(own)
    assert not armed("exception Los").after(own)


def test_log_records_by_level_and_text() -> None:
    log = SentOutput(OutputKind.LOG, "", 1, "Too far: 3.2 m", 30)
    view = View(outputs=[log])
    for text in ("log", "log warn", "log info too far", 'log "too far"', r"log warn /far: \d/"):
        assert armed(text).after(view) == "log 'Too far: 3.2 m'", text
    for text in ("log error", "log near", "log /too far/"):
        assert not armed(text).after(view), text
    assert armed("log /Too/ if event.index == 3").after(View(index=3, outputs=[log]))
    assert not armed("log too if event.index == 3").after(View(index=4, outputs=[log]))


def test_findings_by_kind() -> None:
    view = View(found=["clock"])
    assert armed("finding").after(view) == armed("finding clock").after(view) != ""
    assert not armed("finding random").after(view)
    assert not armed("finding").after(View())


def test_watch_tells_what_changed_and_how() -> None:
    ekf = SimpleNamespace(P=[[0.5, 0.0]])
    view = View(there={"/ekf": ekf})
    watch = armed("watch ekf.P[0][0]", view)
    assert not watch.after(view)
    ekf.P[0][1] = 1.0
    assert not watch.after(view)
    ekf.P[0][0] = 0.25
    assert watch.after(view) == "ekf.P[0][0]: 0.5 -> 0.25"
    assert not watch.after(view)
    del ekf.P
    assert watch.after(view) == "ekf.P[0][0]: 0.25 -> (not there)"
    assert watch.note.startswith("AttributeError")


def test_watch_sees_a_list_that_is_changed_in_place() -> None:
    ekf = SimpleNamespace(track=[1])
    view = View(there={"/ekf": ekf})
    watch = armed('watch node("/ekf").track', view)
    ekf.track.append(2)
    assert watch.after(view) == 'node("/ekf").track: [1] -> [1, 2]'


def test_when_stops_where_it_becomes_true() -> None:
    ekf = SimpleNamespace(x=0)
    view = View(there={"/ekf": ekf})
    watch = armed('when node("ekf").x > 1 and now < 5', view)
    hits = []
    for x in (1, 2, 3, 1, 2):
        ekf.x = x
        hits.append(bool(watch.after(view)))
    assert hits == [False, True, False, False, True]
    late = armed("when ekf.x > 1", View())
    assert not late.after(View())
    assert late.note == "NameError: there is no node 'ekf' (yet)"


def test_if_takes_fields_of_what_was_received() -> None:
    watch = armed("entity /odom if pose.pose.position.x > 3 and event.node == '/ekf'")
    assert watch.before(View(input=("/odom", odometry(4)))) != ""
    assert not watch.before(View(input=("/odom", odometry(2))))
    assert not watch.before(View(node="/other", input=("/odom", odometry(4))))


# -- what is wrong ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "says", "part"),
    [
        ("", "where to stop?", ""),
        ("node", "a name is missing here", ""),
        ("node /efk", "no node is called '/efk'; did you mean '/ekf'?", "/efk"),
        ("node /scaner", "did you mean '/robot/scanner'?", "/scaner"),
        ("topic /odmo", "no topic or service is called '/odmo'; did you mean '/odom'?", "/odmo"),
        ("/odmo: pose.x > 1", "did you mean '/odom'?", "/odmo"),
        ("/odom: poes.x > 1", "has no field 'poes'; did you mean 'pose'?", "poes"),
        (
            "/odom: pose.pose.position.w > 1",
            "geometry_msgs/msg/Point has no field 'w'; it has x, y, z",
            "pose.pose.position.w",
        ),
        ("/odom: pose.pose.position.x >", "not an expression", ">"),
        ("/odom: (y := 3)", "an assignment (:=) has no place", "y := 3"),
        ("/odom:", "an expression is missing here", ""),
        ("watch efk.P", "there is no node 'efk'; did you mean 'ekf'?", "efk"),
        ("watch wheel.speed", "several nodes are called 'wheel'", "wheel"),
        ('when node("efk").P > 1', "did you mean '/ekf'?", 'node("efk")'),
        ("output 3x", "1 to 16 digits of 0-9 and a-f", "3x"),
        ("t=2,5s", "2,5", "2,5s"),
        ("t=abc", "expected a time", "abc"),
        ("finding clok", "did you mean 'clock'?", "clok"),
        ("log /(/", "not a regular expression", "("),
        ("exeption", "'exeption' is no condition; did you mean 'exception'?", "exeption"),
        ("/nothing", "no node, topic or entity is called '/nothing'", "/nothing"),
        ("812 /odom", "only 'if EXPRESSION' can follow here", "/odom"),
        ("/odom pose.x > 1", "after a topic also ': EXPRESSION'", "pose.x > 1"),
        ("node /ekf if", "an expression is missing here", ""),
        ("when ä.x > 1", "there is no node 'ä'", "ä"),
        ("when ekf.ä > efk.x", "there is no node 'efk'; did you mean 'ekf'?", "efk"),
        ("9" * 30, "no run has so many events", "9" * 30),
    ],
)
def test_a_wrong_text_is_pointed_at(text: str, says: str, part: str) -> None:
    message, pointed = wrong(text)
    assert says in message
    assert pointed == part


def test_of_a_run_that_may_make_more_a_name_is_no_mistake() -> None:
    some = RunNames(nodes=("/ekf",))
    for text in ("node /later", "topic /later", "watch later.x", "/later: x > 1"):
        assert parse_condition(text, some).text == text


def test_a_forgotten_colon_is_told_before_the_names_are_known() -> None:
    with pytest.raises(ConditionError, match="of messages /later: EXPRESSION"):
        parse_condition("/later x > 1", RunNames())


def test_control_characters_do_not_reach_a_terminal_and_the_place_stays() -> None:
    with pytest.raises(ConditionError) as caught:
        parse_condition("node \x1b]0;x\x07/efk", NAMES)
    assert "\x1b" not in str(caught.value).splitlines()[1]


# -- for all texts ---------------------------------------------------------------------------------

_PIECES = st.sampled_from(
    "node topic entity output exception log finding watch when if t= time 812 2.5s /ekf /odom "
    "/odom: ekf. P[0] > 3 ( ) [ ] \" ' / : … := await lambda x: and or not #7 warn \n ä 😀 \x00 "
    '{ } * ** , clock 3f2a node("ekf")'.split(" ")
)
_TEXTS = st.one_of(st.text(max_size=40), st.lists(_PIECES, max_size=8).map(" ".join))


def read(text: str, names: RunNames) -> EventCondition | ConditionError:
    try:
        return parse_condition(text, names)
    except ConditionError as error:
        return error


@given(_TEXTS)
def test_every_text_is_a_condition_or_an_error_with_its_place(text: str) -> None:
    for names in (NAMES, RunNames()):
        found = read(text, names)
        if isinstance(found, EventCondition):
            assert found.before or found.after
        else:
            assert 0 <= found.start < found.end
            assert found.start <= len(text)


@given(st.sampled_from(NODES + TOPICS), st.data())
def test_one_wrong_letter_is_pointed_at_with_what_was_meant(name: str, data: Any) -> None:
    at = data.draw(st.integers(1, len(name) - 1))
    typed = f"{name[:at]}{data.draw(st.sampled_from('qjz'))}{name[at + 1 :]}"
    kind = "node" if name in NODES else "topic"
    message, pointed = wrong(f"{kind} {typed}")
    assert pointed == typed
    assert name in message


_EVENTS = st.lists(
    st.builds(
        View,
        stamp_ns=st.integers(0, 5).map(lambda s: s * 1_000_000_000),
        entity_name=st.sampled_from(TOPICS),
        node=st.sampled_from(NODES),
        input=st.one_of(st.none(), st.tuples(st.just("/odom"), st.floats(-5, 5).map(odometry))),
    ),
    max_size=30,
)


@given(_EVENTS, st.integers(0, 30), st.integers(0, 5), st.sampled_from(NODES), st.floats(-5, 5))
def test_stops_are_those_of_a_plain_loop(
    events: list[View], index: int, second: int, node: str, limit: float
) -> None:
    for number, event in enumerate(events):
        event.index = number

    def stops(text: str) -> list[int]:
        watch = parse_condition(text, NAMES).arm(View(stamp_ns=-1))
        return [event.index for event in events if watch.before(event)]

    assert stops(str(index)) == [e.index for e in events if e.index == index]
    assert stops(f"node {node}") == [e.index for e in events if e.node == node]
    late = [e.index for e in events if e.stamp_ns >= second * 1_000_000_000]
    assert stops(f"t={second}s") == late[:1]
    assert stops(f"/odom: pose.pose.position.x > {limit!r}") == [
        e.index
        for e in events
        if e.input is not None and e.input[1].pose.pose.position.x > limit  # type: ignore[attr-defined]
    ]
    assert stops(f"node {node} if event.index % 2") == [
        e.index for e in events if e.node == node and e.index % 2
    ]


_VALUES = st.one_of(
    st.integers(),
    st.floats(allow_nan=False),
    st.text(max_size=3),
    st.lists(st.integers(), max_size=3),
)


@given(st.lists(_VALUES, min_size=1, max_size=12))
def test_watch_and_when_hit_exactly_where_the_value_changes(values: list[Any]) -> None:
    node = SimpleNamespace(x=values[0])
    view = View(there={"/ekf": node})
    watch, when = armed("watch ekf.x", view), armed("when bool(ekf.x)", view)
    for before, after in itertools.pairwise(values):
        node.x = after
        changed = type(before) is not type(after) or before != after
        assert bool(watch.after(view)) == changed
        assert bool(when.after(view)) == (bool(after) and not bool(before))


_NUMBERS = st.recursive(
    st.sampled_from(["x", "y", "msg.x", "2", "0.5", "now", "event.index", "math.pi"]),
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+ - * < >= == and or".split()), inner).map(
            lambda parts: f"({' '.join(parts)})"
        ),
        inner.map(lambda one: f"abs({one})"),
        inner.map(lambda one: f"max(v for v in [{one}, x])"),
        st.tuples(inner, inner, inner).map(lambda p: f"({p[0]} if {p[1]} else {p[2]})"),
    ),
    max_leaves=8,
)


@given(_NUMBERS, st.floats(-10, 10), st.integers(-10, 10))
def test_an_expression_is_worth_what_python_says(text: str, x: float, y: int) -> None:
    message = SimpleNamespace(x=x, y=y)
    view = View(index=3, stamp_ns=1_500_000_000)
    scope = {"x": x, "y": y, "msg": message, "now": 1.5, "event": view, "math": math}
    expected = eval(text, scope)
    found = parse_expression(text, NAMES, has_own=True).value(view, message=message)
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.ros
def test_fields_are_those_of_loaded_classes() -> None:
    for package in ("geometry_msgs", "nav_msgs"):
        import_module(f"{package}.msg")
    interfaces = {"/odom": "nav_msgs/msg/Odometry"}
    names = RunNames(topics=("/odom",), are_all=True, interfaces=interfaces, fields=loaded_fields)
    parse_condition("/odom: pose.pose.position.x > 3 and pose.covariance[0] > 1", names)
    for text in ("/odom: pose.pose.position.w > 3", "/odom: pose.position.x > 3"):
        with pytest.raises(ConditionError, match="has no field"):
            parse_condition(text, names)
    assert loaded_fields("no_such_msgs/msg/Thing") is None
