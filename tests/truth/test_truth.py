"""What ``rsltrace diff`` says of planted faults is true: some of ``make truth``."""

from __future__ import annotations

import fnmatch
import os

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from campaigns.truth import faults
from campaigns.truth.campaign import FAMILIES, Outcome, try_cases
from campaigns.truth.faults.answers import LEFT_OPEN
from campaigns.truth.known import KNOWN, mended

faults.load()
NAMES = list(faults.FAULTS)
SEED = int(os.environ.get("RSLTRACE_TRUTH_SEED", "0"))
PARTS = 3
LONG_PARTS = 12
QUARTER = (SEED + 1) % 4
"""Which classes the long set tries: ``make truth`` tries all."""

pytestmark = [
    pytest.mark.ros,
    pytest.mark.filterwarnings(f"ignore:unclosed file .*{LEFT_OPEN}:ResourceWarning"),
]


def wrong(outcomes: list[Outcome]) -> str:
    return "\n".join(
        f"{o.name}: {c.what}: {c.text}\n  {o.reproducer}"
        for o in outcomes
        for c in o.wrong
        if f"{o.name}: {c.what}" in o.unknown
    )


def test_there_are_classes_enough() -> None:
    assert len(NAMES) >= 400
    assert set(faults.FAMILIES.values()) == set(FAMILIES)


@pytest.mark.long
@pytest.mark.parametrize(
    "part", [0, *(pytest.param(part, marks=pytest.mark.long) for part in range(1, PARTS))]
)
def test_what_is_said_of_a_third_of_the_classes_is_true(part: int) -> None:
    """Every class stands in one of the thirds; a tenth of each is tried here."""
    outcomes = list(try_cases((name, SEED) for name in NAMES[part :: 10 * PARTS]))
    assert not wrong(outcomes), wrong(outcomes)
    keys = [key for outcome in outcomes for key in outcome.keys]
    stale = mended(keys, [outcome.name for outcome in outcomes])
    assert not stale, f"no longer wrong, so campaigns/truth/known.py must forget it: {stale}"


@pytest.mark.long
@pytest.mark.parametrize("part", range(LONG_PARTS))
def test_what_is_said_of_a_quarter_of_the_classes_is_true(part: int) -> None:
    names = NAMES[QUARTER::4][part::LONG_PARTS]
    outcomes = list(try_cases((name, SEED + 1) for name in names))
    assert not wrong(outcomes), wrong(outcomes)


def test_what_takes_the_place_of_a_message_in_a_queue_is_no_divergence_of_its_own() -> None:
    """The status of a goal that ends at once overwrites the one before it."""
    outcomes = list(try_cases([("goal cancelled by nobody, in code", SEED)]))
    assert not wrong(outcomes), wrong(outcomes)


def test_the_oracle_sees_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report with another index, another sentence and another cause is not let through."""
    from dataclasses import replace

    from campaigns.truth import oracle
    from rsltrace.diff.result import Diff, Divergence

    real = oracle.diff

    def lying(a: object, b: object) -> object:
        found = real(a, b)
        return replace(found, agreeing=found.agreeing + 1)

    monkeypatch.setattr(Diff, "sentence", property(lambda self: "something differs"))
    monkeypatch.setattr(Divergence, "root_sentence", property(lambda self: "random draws differ"))
    monkeypatch.setattr(oracle, "diff", lying)
    (outcome,) = try_cases([("value, in code", 0)])
    assert {"index", "first line", "cause", "blame", "values"} <= {c.what for c in outcome.wrong}


def test_what_is_known_names_classes() -> None:
    for key in KNOWN:
        assert fnmatch.filter(NAMES, key.rpartition(": ")[0]), key


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        # the exception alone would not say who made the context invalid
        ("shutdown, hidden", 1),
        # one reception more, of which only its execution time tells
        ("mixed: published twice, in code", 3),
        # a bag goes on beside an executor that waits for ever
        ("deadlock: executors", 3),
        ("deadlock: executors", 4),
    ],
)
def test_what_campaigns_have_found(name: str, seed: int) -> None:
    outcomes = list(try_cases([(name, seed)]))
    assert not wrong(outcomes), wrong(outcomes)


def test_code_of_a_main_that_changed_is_why_the_main_waited_otherwise() -> None:
    """A main belongs to no node; the event beside it in the other run is of another node."""
    outcomes = list(try_cases([("time limit of spin_once, in code", 731001)]))
    assert not wrong(outcomes), wrong(outcomes)
