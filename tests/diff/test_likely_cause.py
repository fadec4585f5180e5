"""What came from outside, as a sentence; and which of several answers is told."""

from __future__ import annotations

import pytest

from rsltrace.diff.causes.likely_cause import call_sentence, calls_sentence
from rsltrace.diff.result.divergence import CallDifference, MessageDifference
from rsltrace.diff.result.fields import FieldDifference

PLACE = "picker.py:24 in Picker.pick"


def call(
    source: str, text: str, a: str | None, b: str | None, where: str = PLACE
) -> CallDifference:
    return CallDifference(source, text, where, 3, 3, a, b)


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (
            call("environment", "os.environ['MOTOR_SEED']", "'6'", "'4'"),
            "/picker read MOTOR_SEED, 6 in a and 4 in b, at picker.py:24",
        ),
        (
            call("environment", "os.environ['NOTE']", "not set", "'a, b'"),
            "/picker read NOTE, not set in a and 'a, b' in b, at picker.py:24",
        ),
        (
            call("file", "open('/x/gains.yaml')", "4 bytes, SHA-256 ab", "4 bytes, SHA-256 cd"),
            "/picker read gains.yaml, SHA-256 ab in a and SHA-256 cd in b, at picker.py:24",
        ),
        (
            call("file", "os.stat(PosixPath('/x/gains.yaml'))", None, "4 bytes"),
            "/picker read gains.yaml only in b, at picker.py:24",
        ),
        (
            call("directory", "os.listdir('/x/models')", "1 name (a)", "2 names (a, b)"),
            "/picker listed models, 1 name (a) in a and 2 names (a, b) in b, at picker.py:24",
        ),
        (
            call("random", "random.random()", "0.25", "0.5"),
            "/picker drew random.random(), 0.25 in a and 0.5 in b, at picker.py:24",
        ),
        (
            call("process", "subprocess.run\x1b[2J", "'1'", None),
            "/picker called subprocess.run\\x1b[2J only in a, at picker.py:24",
        ),
    ],
)
def test_a_call_as_a_sentence(found: CallDifference, sentence: str) -> None:
    assert call_sentence(found, "/picker") == sentence


def test_of_several_answers_those_that_show_are_told() -> None:
    unused = call("environment", "os.environ['UNUSED']", "'1'", "'2'", "picker.py:8 in <module>")
    same = call("environment", "os.environ['SAME']", "'1'", "'1'")
    topic = call("environment", "os.environ['TOPIC']", "'/one'", "'/other'")
    calls = (unused, unused, same, topic)
    made = MessageDifference(None, "new publisher /one", "", 0, "only a", None, None)
    told = "/n read TOPIC, /one in a and /other in b, at picker.py:24"
    assert calls_sentence(calls, "/n", (made,)) == told
    field = FieldDifference("data", '"x"', '"/other"')
    text = MessageDifference(None, "/t", "", 0, "both", None, None, (field,))
    assert calls_sentence(calls, "/n", (text,)) == told
    assert calls_sentence(calls, "/n", ()) == (
        "/n read UNUSED, 1 in a and 2 in b, at picker.py:8; " + told.removeprefix("/n ")
    )
