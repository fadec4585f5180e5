"""The language of conditions: what it has is worth what Python says, all else is refused, and
nothing in it can do harm or go on without end."""

from __future__ import annotations

import builtins
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace import Trace, evaluate_checks
from rsltrace.checks.conditions.bounds import INT_BITS_MAX, STEPS_MAX, LimitError, StepBudget
from rsltrace.checks.conditions.expressions import parse_expression
from rsltrace.checks.conditions.run_expression import RunExpression
from rsltrace.checks.conditions.text import parse_condition
from rsltrace.checks.evaluate import job_of_checks
from rsltrace.errors import CheckError, ConditionError
from tests.trace.make import write_run

_CPU_S = 20.0
"""So long may a hostile expression keep a busy machine; most are refused at once."""


@dataclass
class Inner:
    frame_id: str = "map"
    _x: int = 4
    __msgtype__: ClassVar[str] = "a_msgs/msg/Inner"


@dataclass
class Message:
    """As those of a trace are: a dataclass with numpy arrays."""

    data: int = 3
    x: float = 0.5
    text: str = "hello"
    header: Inner = field(default_factory=Inner)
    ranges: Any = field(default_factory=lambda: np.linspace(0.1, 5, 1000, dtype=np.float32))
    image: Any = field(default_factory=lambda: np.zeros(300_000, np.uint8))
    poses: list[Inner] = field(default_factory=lambda: [Inner(), Inner("odom")])
    __msgtype__: ClassVar[str] = "a_msgs/msg/Message"


@dataclass
class View:
    index: int = 7
    kind: int = 1
    entity: int = 2
    entity_name: str = "/x"
    node: str = "/n"
    stamp_ns: int = 1_500_000_000
    output_hash: int = 0

    def nodes(self) -> dict[str, object]:
        return {}

    def received(self) -> None:
        return None


def value(text: str, message: object = None) -> Any:
    found = parse_expression(text, has_own=True)
    return found.value(View(), message=message or Message())


# -- what is worth what ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("data + 1 == 4 and not text == 'x'", True),
        ("msg.header.frame_id in ('map', 'odom')", True),
        ("header._x", 4),
        ("poses[1].frame_id[0:2] + '!'", "od!"),
        ("[one.frame_id for one in poses if one.frame_id != 'map']", ["odom"]),
        ("len(ranges), ranges[0] < 0.2, ranges[-1]", (1000, True, 5.0)),
        ("min(ranges) < 0.3 < max(ranges)", True),
        ("any(ranges > 4.9) and all(ranges > 0)", True),
        ("(ranges > 4.9).any() and ranges.max() == 5", True),
        ("any(b < a for a, b in zip(ranges, ranges[1:]))", False),
        ("sum(image) + sum([1, 2.5])", 3.5),
        ("np.isnan(ranges).any() or math.isinf(x)", False),
        ("np.linalg.norm(np.array([3, 4])), norm([3, 4])", (5.0, 5.0)),
        ("round(np.mean(ranges), 3), round(median([1, 5, 3]), 1)", (2.55, 3.0)),
        ("hypot(3, 4), sqrt(9), degrees(pi)", (5.0, 3.0, 180.0)),
        ("(1 if data > 2 else 0) << 4 | 1", 17),
        ("sorted([3, 1, 2], reverse=True)[0], max([], default=-1)", (3, -1)),
        ("len(set([1, 1, 2])), text.startswith('he'), upper(text)", (2, True, "HELLO")),
        ("event.index == 7 and event.node == '/n' and now == 1.5", True),
        ("len(ranges[ranges < 1]) > 100", True),
        ("[(i, r) for i, r in enumerate([5, 6])][1]", (1, 6)),
        ("sum(a * b for a in [1, 2] for b in [3, 4] if a != b)", 21),
        ("data is not None and nan != nan", True),
    ],
)
def test_what_the_language_has(text: str, expected: object) -> None:
    found = value(text)
    assert found == expected
    assert type(found) is type(expected)


_ATOMS = st.sampled_from(["data", "x", "msg.x", "2", "0.5", "-3", "True", "now", "event.index"])
_TEXTS = st.recursive(
    _ATOMS,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+ - * / // % < <= > >= == != and or".split()), inner).map(
            lambda parts: f"({' '.join(parts)})"
        ),
        st.tuples(inner, inner, inner).map(lambda p: f"({p[0]} < {p[1]} <= {p[2]})"),
        st.tuples(inner, inner, inner).map(lambda p: f"({p[0]} if {p[1]} else {p[2]})"),
        inner.map(lambda one: f"(not {one})"),
        inner.map(lambda one: f"abs({one})"),
        inner.map(lambda one: f"[{one}, data][0]"),
        st.tuples(inner, inner).map(lambda p: f"max({p[0]}, {p[1]})"),
        st.tuples(inner, inner).map(lambda p: f"sum(v * 2 for v in [{p[0]}, {p[1]}] if v > 0)"),
        st.tuples(inner, inner).map(lambda p: f"any(v < w for v, w in [({p[0]}, {p[1]})])"),
    ),
    max_leaves=10,
)


@given(_TEXTS, st.integers(-5, 5), st.floats(-3, 3))
def test_it_is_worth_what_python_says(text: str, data: int, x: float) -> None:
    message = Message(data=data, x=x)
    scope = {"data": data, "x": x, "msg": message, "now": 1.5, "event": View()}
    try:
        expected = builtins.eval(text, scope)
    except ZeroDivisionError:
        with pytest.raises(ZeroDivisionError):
            value(text, message)
        return
    found = value(text, message)
    assert found == expected or (math.isnan(found) and math.isnan(expected))
    assert type(found) is type(expected)


# -- what is refused -------------------------------------------------------------------------------

_DAG = "".join(f" for v{i + 1} in [[v{i}, v{i}]]" for i in range(25))
HOSTILE = f"""
np.load.__globals__["os"].system("id > PWNED") == 0
np.save("PWNED2", np.zeros(3)) is None
np.load("/etc/passwd")
np.fromfile("/etc/passwd")
np.core.multiarray
np.random.rand(3)
np.lib.npyio.load("x")
np.linalg.norm.__globals__
np.linalg.svd(ranges)
np.abs(ranges, image)
np.outer(ranges, ranges)
np.tile(ranges, 10**9)
np.zeros(10**10)
np.diff(ranges, 10**9)
math.factorial(100000)
math.prod(range(1, 100000))
__import__("os").system("id")
eval("1")
exec("1")
open("/etc/passwd").read()
breakpoint()
getattr(msg, "__class__")
vars(msg)
type(data)
globals()
print(1)
data.__class__.__mro__
text.__class__
text.format(data)
"".join(text)
text.encode()
msg.__dict__
msg.__init__.__globals__
msg.__msgtype__
header._y
ranges.__array_interface__
ranges.ctypes.data
ranges.tofile("PWNED")
ranges.tobytes()
ranges.base
event._trace
event.received()
event.__class__
abs.__self__
(x for x in ranges).gi_frame.f_globals
[x for x in ranges].append(1)
(lambda: 1)()
(a := 1)
{{1: 2}}
{{x for x in ranges}}
(yield)
await data
f"{{data:1000000000}}"
'%1000000000d' % 1
text % data
'{{:1000000000}}'.format(1)
max(*ranges)
max(ranges, key=len)
pow(3, 10**9, 7)
str(ranges)
9**9**9 > 1
2**(2**data**data)
10**10**10
pow(10, 10**9)
1 << 10**9
1 << data * 10**9
-(1 << 600)
10**400
'a' * 10**9
text * (data * 10**9)
[0] * 10**9
[data] * (data * 10**8)
range(10**30)
list(range(10**8))
sorted(range(10**7))
round(10, -10**9)
int('9' * 5000)
[[0] * 1000000 for i in range(1000)]
[ranges * 1.0 for r in image]
[text * 100000 for a in ranges for b in ranges]
sum(1 for a in range(100000) for b in range(100000))
sum(1 for a in ranges for b in ranges for c in ranges)
sum(1 for a in image if any(image < a))
any(v25 == w25 for v0 in [[0]]{_DAG} for w0 in [[0]]{_DAG.replace("v", "w")})
ranges[:, None] * ranges
{"(" * 300}1{")" * 300}
{"not " * 900}1
{"-" * 4000}1
1{" + 1" * 900}
{"9" * 4000}
{"a" * 5000}
""".strip().splitlines()


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: text[:40])
def test_hostile_expressions_are_refused_or_have_no_value(
    text: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    message, begin = Message(), time.process_time()
    copies = message.ranges.copy(), message.image.copy()
    refused = (ConditionError, LimitError, AttributeError, NameError, TypeError)
    with pytest.raises(refused) as caught:
        value(text, message)
    assert str(caught.value)
    assert time.process_time() - begin < _CPU_S
    assert not list(tmp_path.iterdir())
    assert (message.ranges == copies[0]).all()
    assert (message.image == copies[1]).all()
    with pytest.raises(ConditionError):
        RunExpression(text).value(None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "says", "part"),
    [
        ("1 + 9**9**9", "more than 512 bits", "9**9**9"),
        ("max(data) + opne(1)", "'opne' is no function here", "opne(1)"),
        ("data + np.lod(1)", "'np.lod' is no function here", "np.lod(1)"),
        ("data.__class__", "'__class__' is no field", "data.__class__"),
        ("x + (lambda: 1)()", "only functions can be called", "(lambda: 1)()"),
        ("x > f'{x}'", "an f-string has no place in an expression, which has fields", "f'{x}'"),
        ("abs(1, 2)", "abs: too many positional arguments", "abs(1, 2)"),
    ],
)
def test_an_error_names_the_part_and_what_is_allowed(text: str, says: str, part: str) -> None:
    with pytest.raises(ConditionError, match=says[:20].replace("(", r"\(")) as caught:
        parse_expression(text, has_own=True)
    assert says in caught.value.message
    assert caught.value.text[caught.value.start : caught.value.end] == part


# -- bounds ----------------------------------------------------------------------------------------


@pytest.mark.long
def test_steps_are_counted_so_that_an_expression_ends_alike_everywhere() -> None:
    text = "sum(1 for a in ranges for b in ranges)"
    both = [parse_expression(text, has_own=True) for _ in range(2)]
    while both[0].budget.left > 1_000_000:  # a loop in a loop is no mistake
        for one in both:
            assert one.value(View(), message=Message()) == 1_000_000
    assert both[0].budget.left == both[1].budget.left < STEPS_MAX
    for one in both:
        with pytest.raises(LimitError, match="too many steps"):
            one.value(View(), message=Message())


def test_what_goes_through_the_data_once_costs_no_steps() -> None:
    for text in (
        "max(image) < 255 and all(ranges < 9)",
        "all(0 <= r < 9 for r in ranges)",
        "all(abs(a - b) < 9 for a, b in zip(ranges, ranges[1:]))",
    ):
        expression = parse_expression(text, has_own=True)
        for _ in range(20):
            assert expression.value(View(), message=Message())
        assert expression.budget.left >= STEPS_MAX


@given(st.lists(st.sampled_from(["**", "*", "<<", "+"]), min_size=1, max_size=6), st.data())
def test_numbers_stay_within_their_bits(signs: list[str], data: Any) -> None:
    numbers = [str(data.draw(st.integers(0, 10**6))) for _ in range(len(signs) + 1)]
    text = numbers[0] + "".join(f" {s} {n}" for s, n in zip(signs, numbers[1:], strict=True))
    try:
        found = value(text)
    except (ConditionError, LimitError):
        return
    assert found.bit_length() <= INT_BITS_MAX


def test_a_large_sequence_is_paid_for() -> None:
    budget = StepBudget()
    budget.make(1000)
    assert budget.left == STEPS_MAX - 1001
    with pytest.raises(LimitError, match="1,000,001 items"):
        budget.make(1_000_001)


@pytest.mark.parametrize("pattern", ["(a+)+$", "(a|a)+$", "a*a*a*a*a*a*a*a*a*b"])
def test_no_pattern_of_logs_keeps_a_check_busy(pattern: str) -> None:
    from rsltrace.checks.conditions.view import SentOutput
    from rsltrace.trace.model.event import OutputKind

    @dataclass
    class Logs(View):
        def sent(self) -> list[SentOutput]:
            return [SentOutput(OutputKind.LOG, "", 1, "a" * 50_000 + "c", 30)]

    begin = time.process_time()
    watch = parse_condition(f"log /{pattern}/").arm(Logs())
    assert not watch.after(Logs())  # type: ignore[arg-type]
    assert time.process_time() - begin < _CPU_S


def test_a_pattern_that_looks_around_is_refused() -> None:
    with pytest.raises(ConditionError, match="look-around"):
        parse_condition("log /(?=x)y/")


def test_what_a_check_cannot_compute_is_said_with_its_place(tmp_path: Path) -> None:
    write_run(tmp_path / "run.mcap", 60, checks="checks:\n  - never: '/count: 2**data**2 < 1'\n")
    with Trace.open(tmp_path / "run.mcap") as trace:
        job = job_of_checks(trace)
        with pytest.raises(CheckError) as caught:
            evaluate_checks(trace, job)
    said = str(caught.value)
    assert said.startswith(
        f"the job of {tmp_path}/run.mcap:5:12: a check cannot be evaluated: event"
    )
    assert "it makes a number of more than 512 bits\n  /count: 2**data**2 < 1" in said
