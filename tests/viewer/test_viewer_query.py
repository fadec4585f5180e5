"""The filter language: what it finds, how it completes, where it says it is wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rsltrace_viewer.model.query.conditions import mask_of
from rsltrace_viewer.model.query.fields import FIELDS
from rsltrace_viewer.model.query.parser import completions, parse
from rsltrace_viewer.model.query.tokens import QueryError
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.events import outputs_text

from tests.tiers import cases


def found(run: Run, text: str) -> list[int]:
    condition = parse(text, run)
    if condition is None:
        return list(range(run.count))
    result: list[int] = []
    for number in range(len(run.segments)):
        segment, mask = mask_of(run, condition, number)
        assert condition.can_be_in(run, number) or not mask.any()
        result += (np.flatnonzero(mask) + segment.first).tolist()
    return result


def column(run: Run, name: str) -> list[int]:
    return np.concatenate([part[name] for part in run.trace.events()]).tolist()


def test_kinds_and_nodes(run: Run) -> None:
    kinds = column(run, "kind")
    assert found(run, "kind:timer") == [i for i, kind in enumerate(kinds) if kind == 2]
    assert found(run, "kind:srv,client") == [i for i, kind in enumerate(kinds) if kind in (4, 5)]
    assert found(run, "kind:subscription") == found(run, "kind:sub")
    listener = found(run, "node:/listener")
    assert 1 in listener  # its constructor belongs to it
    assert set(found(run, "kind:sub")) <= set(listener)
    assert found(run, "node:listen") == listener
    assert found(run, "node:/list*") == listener


def test_and_or_not_and_brackets(run: Run) -> None:
    timers, subs = set(found(run, "kind:timer")), set(found(run, "kind:sub"))
    early = set(found(run, "index:..50"))
    assert set(found(run, "kind:timer or kind:sub")) == timers | subs
    assert set(found(run, "kind:timer index:..50")) == timers & early
    assert set(found(run, "-kind:timer")) == set(range(run.count)) - timers
    assert set(found(run, "not kind:timer")) == set(range(run.count)) - timers
    assert set(found(run, "(kind:timer or kind:sub) and index:..50")) == (timers | subs) & early
    assert set(found(run, "kind:timer or kind:sub index:..50")) == timers | (subs & early)


def test_ranges(run: Run) -> None:
    stamps = column(run, "stamp")
    low, high = 10_100_000_000, 10_500_000_000
    inside = [i for i, stamp in enumerate(stamps) if low <= stamp <= high]
    assert found(run, "time:0.1..0.5") == inside
    assert found(run, "time:@10.1..@10.5") == inside
    assert found(run, "time:100ms..500ms") == inside
    assert found(run, "time:>=0.1 time:<=@10.5") == inside
    assert found(run, "index:7") == [7]
    assert found(run, "index:>597") == list(range(598, run.count))
    assert found(run, "index:<3") == [0, 1, 2]


def test_topics_are_received_and_sent(run: Run) -> None:
    topic = found(run, "topic:/count")
    assert {2, 3} <= set(topic)
    assert found(run, "topic:count") == topic


def test_text_in_logs_and_in_messages(run: Run) -> None:
    logged = [i for i in range(run.count) if "log INFO" in outputs_text(run, run.outputs(i))]
    assert found(run, "level:info") == logged
    assert found(run, "level:error") == []
    assert found(run, "out:log") == logged
    value = outputs_text(run, run.outputs(logged[0])).rpartition(" ")[2]
    by_text = found(run, f"text:{value}")
    assert logged[0] in by_text
    assert len(by_text) > 1  # the timer that sent it and whoever else has it


def test_states_and_hashes(run: Run) -> None:
    assert found(run, "is:raised") == [run.count - 1]
    assert set(found(run, "is:silent")) == {
        i for i, outputs in enumerate(column(run, "outputs")) if not outputs
    }
    digits = f"{column(run, 'input_hash')[2]:016x}"
    assert 2 in found(run, f"hash:{digits[:6]}")
    assert found(run, f"hash:{digits}")


def test_bare_words(run: Run) -> None:
    assert found(run, '"too many"') == [run.count - 1]
    assert set(found(run, "listener")) >= set(found(run, "kind:sub"))


@pytest.mark.parametrize(
    ("text", "start", "part"),
    [
        ("node:/nobody", 5, "no node matches"),
        ("kind:timer kin:3", 11, "there is no field 'kin'"),
        ("kind:timer,quux", 11, "no such kind"),
        ("time:abc", 5, "not a time"),
        ("time:3..1", 5, "before the start"),
        ("index:1.5", 6, "not an index"),
        ("(kind:timer", 0, "not closed"),
        ("kind:timer)", 10, "no opening bracket"),
        ('text:"abc', 5, "quote is not closed"),
        ("kind:", 5, "a value is missing"),
        ("kind:timer or", 13, "missing here"),
        ("hash:xyz", 5, "digits"),
        ("kind:timer,,sub", 11, "missing"),
        ("is:happy", 3, "raised"),
        ("level:loud", 6, "no such level"),
        ('kind:timer ""', 11, "nothing between the quotes"),
        ("(" * 5000, 0, "nested too deeply"),
        ("not " * 5000, 0, "nested too deeply"),
    ],
)
def test_errors_say_where(run: Run, text: str, start: int, part: str) -> None:
    with pytest.raises(QueryError, match=part) as caught:
        parse(text, run)
    assert caught.value.start == start
    assert caught.value.end > caught.value.start


_PIECES = ["kind:", "timer", "(", ")", "or", "not", "-", "node:/talker", "time:1..2", '"', " "]
_PIECES += ["index:>3", ",", "\\", "text:", "and", "9" * 30]


@settings(max_examples=cases(50, 300), deadline=None)
@given(
    st.one_of(
        st.text(max_size=30),
        st.lists(
            st.sampled_from(_PIECES),
            max_size=8,
        ).map("".join),
    )
)
def test_anything_parses_or_says_why(run: Run, text: str) -> None:
    complaint = None
    try:
        condition = parse(text, run)
    except QueryError as error:
        complaint = error
    if complaint is not None:
        assert str(complaint)
        assert 0 <= complaint.start < complaint.end
    elif condition is not None:
        mask_of(run, condition, 0)
    for choice in completions(text, run):
        assert isinstance(choice, str)


def test_completion(run: Run) -> None:
    assert completions("n", run) == ["node:"]
    assert completions("kind:timer no", run) == ["kind:timer node:"]
    assert completions("node:", run) == ["node:/talker", "node:/listener"]
    assert completions("-node:/l", run) == ["-node:/listener"]
    assert completions("kind:timer,cl", run)[0] == "kind:timer,client"
    assert completions("(level:w", run) == ["(level:warn", "(level:warning"]
    assert completions("", run) == []
    assert completions("nothing:x", run) == []
    for name in FIELDS:
        assert f"{name}:" in completions(name[:1], run)
