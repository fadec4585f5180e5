"""A diff decides by facts: no sentence is made while it does, and none is read afterwards."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import FrozenInstanceError, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, get_args

import pytest

from rsltrace.diff import diff_files, sentences
from rsltrace.diff.facts import causes, evidence, remarks
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import FORMATS, render
from rsltrace.diff.result import BagDiff, Diff
from rsltrace.diff.sentences import divergence, runs

FILLED_BY = (divergence, runs)
"""Importing them fills the table."""

ROOT = Path(__file__).parent.parent.parent
PAIRS = sorted(path.parent for path in (ROOT / "sample_traces").glob("*/job.yaml"))
PLANTED = 200
SPOKEN = ("sentence", "root_sentence", "likely_cause", "notes", "note", "reason", "relation")
SPOKEN += ("absence_sentence",)
"""Keys of the JSON report that hold sentences."""


@pytest.fixture
def silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """While it compares, nobody may ask for a sentence."""

    def ask(fact: Any, of: Any) -> str:
        raise AssertionError(f"a sentence was asked for: {fact}")

    for fact in list(sentences.SENTENCES):
        monkeypatch.setitem(sentences.SENTENCES, fact, ask)


def key_of(fact: Any) -> str:
    return f"<{fact}>" if isinstance(fact, Enum) else f"<{fact.__name__}>"


def with_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    def key(fact: Any, of: Any) -> str:
        return key_of(fact if isinstance(fact, Enum) else type(fact))

    for fact in list(sentences.SENTENCES):
        monkeypatch.setitem(sentences.SENTENCES, fact, key)


def facts_of(value: Any) -> Any:
    """Return a JSON report without its sentences."""
    if isinstance(value, dict):
        return {key: facts_of(item) for key, item in value.items() if key not in SPOKEN}
    return [facts_of(item) for item in value] if isinstance(value, list) else value


def decided(diff: Diff | BagDiff) -> tuple[Any, ...]:
    shown = diff.shown if isinstance(diff, Diff) else None
    causes = shown and (shown.root, shown.what, shown.why, shown.likely, shown.settings)
    report = facts_of(json.loads(render(diff, "json")))
    return diff.verdict, diff.exit_code, causes, report


def check(a: Path, b: Path, **options: Any) -> None:
    """Compare with sentences that say nothing, then with keys in their place."""
    with pytest.MonkeyPatch.context() as patch:
        with_keys(patch)
        keyed = diff_files(a, b, **options)
        found = decided(keyed)
        for form in FORMATS:
            assert "<" in render(keyed, form, DiffOptions(everything=True))
    told = diff_files(a, b, **options)
    assert decided(told) == found
    assert told == keyed


@pytest.mark.parametrize("folder", PAIRS, ids=lambda path: path.name)
def test_the_samples_are_decided_by_facts(folder: Path) -> None:
    check(folder / "a.mcap", folder / "b.mcap")
    check(folder / "b.mcap", folder / "a.mcap", everything=True)


@pytest.mark.parametrize("folder", PAIRS, ids=lambda path: path.name)
@pytest.mark.usefixtures("silent")
def test_no_sentence_is_made_while_comparing(folder: Path) -> None:
    assert diff_files(folder / "a.mcap", folder / "b.mcap", everything=True).diverged


@pytest.mark.ros
@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("part", range(10))
def test_planted_faults_are_decided_by_facts(part: int, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    from campaigns.truth import campaign

    seed = int(os.environ.get("RSLTRACE_TRUTH_SEED", "0"))
    tried = 0
    for number, (name, its_seed) in enumerate(campaign.cases(2 * PLANTED, seed)):
        if number % 10 == part and tried < PLANTED // 10:
            folder = tmp_path / str(number)
            folder.mkdir()
            campaign.try_case(name, its_seed, folder)
            if (folder / "a.mcap").is_file() and (folder / "b.mcap").is_file():
                check(folder / "a.mcap", folder / "b.mcap")
                tried += 1
    assert tried == PLANTED // 10


def all_facts() -> Iterator[Any]:
    """Yield whatever a sentence can be asked for."""
    for union in (
        evidence.OutputFate,
        causes.DivergenceFact,
        causes.CauseFact,
        causes.Loss,
        causes.LikelyCause,
        remarks.Remark,
        remarks.Outcome,
    ):
        for kind in get_args(union):
            yield from kind if issubclass(kind, Enum) else (kind,)
    yield from evidence.NoFieldsReason
    yield causes.CallbackAbsence


def test_every_fact_has_its_sentence() -> None:
    assert set(all_facts()) == set(sentences.SENTENCES)


def test_facts_hold_values_that_nobody_can_change() -> None:
    for kind in all_facts():
        if is_dataclass(kind):
            with pytest.raises(FrozenInstanceError):
                del object.__new__(kind).text
            assert all(field.name.isidentifier() for field in fields(kind))
