"""Texts of objects have a number of the run's where Python shows an address."""

from __future__ import annotations

import gc
import re
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest

from rsltrace.guard.install import numbered_texts
from rsltrace.trace.model.finding import NondeterminismSource
from rsltrace.trace.reader import Trace
from tests.guard.conftest import node_code

pytestmark = pytest.mark.ros

_MODULE = """
from dataclasses import dataclass
class Thing: pass
class Named:
    def __repr__(self): return f"named {super().__repr__()}"
class Slotted:
    __slots__ = ()
@dataclass
class Data:
    number: int = 1
MARK, kept, keep = object(), [Thing(), Named()], []
"""
_SHOW = """
new = [Thing() for _ in range(3)]
keep.extend(new[1:])
generator, function = (x for x in ()), lambda: 0
self.say(*map(repr, [kept[0], kept, new, MARK, self.tick, function, generator, Data(), {1: Thing}]))
same = Thing.__repr__ is object.__repr__
own = vars(object)["__repr__"]  # numba's jitclass looks for what a class adds to object
same = same and own.__objclass__ is object and type(own) is not type(function)
self.say("%s %r" % (kept[0], MARK), f"{kept[0]}", str(kept[1]), same)
self.say(sorted(map(repr, keep)) == list(map(repr, keep)))
"""


@dataclass
class _Before:
    plain: Any


@pytest.mark.long
def test_texts_are_the_same_in_every_run(said: Callable[..., Any]) -> None:
    ballast = []
    runs = []
    for number in range(3):
        runs.append(said(node_code(_SHOW, module=_MODULE)))
        ballast.append([object() for _ in range(997 * number)])  # other addresses next time
    assert runs[0] == runs[1] == runs[2]
    first, again = runs[0][0], runs[0][3]
    assert first[0] == again[0]  # whoever has a number keeps it
    assert first[2] != again[2]
    assert first[7] == "Data(number=1)"
    assert runs[0][1][3] is True
    assert all(texts[0] for texts in runs[0][2::3])
    numbers = re.findall(r"0x[0-9a-f]+", str(runs[0]))
    assert numbers
    assert all(number.startswith("0x52") and len(number) == 14 for number in numbers)
    assert len({*re.findall(r"0x[0-9a-f]+", str(first))}) == 9


def test_outside_of_runs_texts_are_pythons_own(said: Callable[..., Any]) -> None:
    before = object.__repr__, FunctionType.__repr__
    said(node_code("self.say(repr(self))"))
    assert (object.__repr__, FunctionType.__repr__) == before
    for thing in (object(), _Before, lambda: 0, type("New", (), {})()):
        shown = re.search(r"0x([0-9a-f]+)", repr(thing))
        assert shown is None or int(shown[1], 16) == id(thing)
    assert repr(_Before(1)).endswith("_Before(plain=1)")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("code", "guard", "found"),
    [
        ("self.get_logger().info(repr(Thing()))", "", 0),
        ("self.get_logger().info(repr(Slotted()))", "", 2),
        ("text = repr(kept[0]); assert hex(id(kept[0])) in text", "guard: {address: allow}", 0),
    ],
)
def test_what_keeps_its_address_is_found(
    said: Callable[..., Any], tmp_path: Path, code: str, guard: str, found: int
) -> None:
    said(node_code(code, module=_MODULE), job=f"nodes: [{{node: 'm:N'}}]\n{guard}")
    with Trace.open(tmp_path / "run.mcap") as trace:
        findings = [one for per_event in trace.findings.values() for one in per_event]
    assert len([one for one in findings if one.source is NondeterminismSource.ADDRESS]) == found


def test_classes_that_a_run_outlives_are_kept_until_their_slots_are_as_before() -> None:
    """Else the end of the run writes into memory that is something else's by then."""
    passing = type("Passing", (), {})
    lasting = weakref.ref(passing)
    with numbered_texts():
        del passing
        gc.collect()
        assert lasting() is not None
    gc.collect()
    assert lasting() is None
