"""What came from outside, as a sentence; and which of several answers is told."""

from __future__ import annotations

from typing import Any

import pytest

from rsltrace.diff.causes.calls import _paired, answer_text, call_difference
from rsltrace.diff.causes.likely_cause import telling_calls
from rsltrace.diff.facts.causes import ExternalAnswers
from rsltrace.diff.facts.evidence import (
    CallDifference,
    FieldDifference,
    MessageDifference,
    Presence,
)
from rsltrace.diff.sentences import sentence
from rsltrace.diff.sentences.divergence import call_text
from rsltrace.guard.recorded_answers import encoded_answer
from rsltrace.trace.model.finding import Finding, GuardMode, NondeterminismSource
from rsltrace.trace.words.entities import EntityKey

PLACE = "picker.py:24 in Picker.pick"


def call(
    source: str, text: str, a: str | None, b: str | None, where: str = PLACE
) -> CallDifference:
    return call_difference(source, text, where, (3, 3), (a, b))


def told(calls: tuple[CallDifference, ...], *messages: MessageDifference) -> str:
    return sentence(ExternalAnswers("/picker", telling_calls(calls, messages)))


@pytest.mark.parametrize(
    ("found", "text"),
    [
        (
            call("environment", "os.environ['MOTOR_SEED']", "'6'", "'4'"),
            "/picker read MOTOR_SEED (6 in a, 4 in b) at picker.py:24",
        ),
        (
            call("environment", "os.environ['NOTE']", "not set", "'a, b'"),
            "/picker read NOTE (not set in a, 'a, b' in b) at picker.py:24",
        ),
        (
            call("file", "open('/x/gains.yaml')", "4 bytes, SHA-256 ab", "4 bytes, SHA-256 cd"),
            "/picker read gains.yaml (SHA-256 ab in a, SHA-256 cd in b) at picker.py:24",
        ),
        (
            call("file", "os.stat(PosixPath('/x/gains.yaml'))", None, "4 bytes"),
            "/picker found gains.yaml only in b at picker.py:24",
        ),
        (
            call("directory", "os.listdir('/x/models')", "1 name (a)", "2 names (a, b)"),
            "/picker listed models (1 name (a) in a, 2 names (a, b) in b) at picker.py:24",
        ),
        (
            call("random", "random.random()", "0.25", "0.5"),
            "/picker drew random.random() (0.25 in a, 0.5 in b) at picker.py:24",
        ),
        (
            call("process", "subprocess.run\x1b[2J", "'1'", None),
            "/picker called subprocess.run\\x1b[2J only in a at picker.py:24",
        ),
    ],
)
def test_a_call_as_a_sentence(found: CallDifference, text: str) -> None:
    assert told((found,)) == text


def test_of_several_answers_those_that_show_are_told() -> None:
    unused = call("environment", "os.environ['UNUSED']", "'1'", "'2'", "picker.py:8 in <module>")
    same = call("environment", "os.environ['SAME']", "'1'", "'1'")
    topic = call("environment", "os.environ['TOPIC']", "'/one'", "'/other'")
    calls = (unused, unused, same, topic)
    name = EntityKey("/picker", "publisher", "/one", "")
    made = message("new publisher /one", Presence.ONLY_A, entity=name)
    one = "/picker read TOPIC (/one in a, /other in b) at picker.py:24"
    assert told(calls, made) == one
    field = FieldDifference("data", '"x"', '"/other"')
    assert told(calls, message("/t", Presence.BOTH, fields=(field,))) == one
    assert told(calls) == (
        "/picker read UNUSED (1 in a, 2 in b) at picker.py:8; " + one.removeprefix("/picker ")
    )


def message(topic: str, presence: Presence, **more: Any) -> MessageDifference:
    return MessageDifference(None, topic, "", 0, presence, None, None, **more)


def test_calls_are_the_same_though_an_edit_has_moved_their_lines() -> None:
    def finding(call: str, value: str, stack: str) -> Finding:
        source, mode = NondeterminismSource.CLOCK, GuardMode.RECORD
        return Finding(3, 7, "/picker", source, mode, call, value, stack)

    a = [finding("now()", "1", f"picker.cpp:{line} in tick()") for line in (10, 12)]
    b = [finding("now()", "1", f"picker.cpp:{line} in tick()") for line in (11, 12, 13)]
    b += [finding("now()", "2", "picker+0x10"), finding("rand()", "4", "picker.cpp:11 in tick()")]
    pairs = [
        (found.call, found.a, found.b)
        for found in _paired([*a, finding("now()", "2", "picker+0x8")], b)
    ]
    assert sorted(pairs, key=str) == [
        ("now()", "1", "1"),
        ("now()", "1", "1"),
        ("now()", "2", "2"),
        ("now()", None, "1"),
        ("rand()", None, "4"),
    ]


def test_a_call_without_a_line_is_said_without_one() -> None:
    assert call_text(call("clock", "now()", None, "2", where="")) == "read now() only in b"


def test_a_process_id_that_a_library_reads_too_is_not_told() -> None:
    process = call("pid", "os.getpid()", "41", "42")
    assert told((process, call("file", "open('/proc/stat')", "1 bytes", "2 bytes"))) == (
        "/picker read stat (1 bytes in a, 2 bytes in b) at picker.py:24"
    )
    assert told((process,)) == "/picker read os.getpid() (41 in a, 42 in b) at picker.py:24"


def test_a_recorded_variable_is_text() -> None:
    source, mode = NondeterminismSource.ENVIRONMENT, GuardMode.RECORD
    kept = encoded_answer(lambda: b"6")
    found = Finding(3, 7, "/picker", source, mode, "os.environ['MOTOR_SEED']", kept, PLACE)
    assert answer_text(found) == "'6'"
