"""Substitutions: their grammar, their values, and that ``$(eval …)`` runs no code."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.adapters.launch.api.basics import LaunchContext
from rsltrace.adapters.launch.model import LaunchScope
from rsltrace.adapters.launch.substitution import SubstitutionCall, evaluate, parse_template


def text(written: str) -> str:
    context = LaunchContext()
    context.file = Path("/launch/robot.launch.xml")
    context.scope = LaunchScope(
        configurations={"a": "1", "b": "two words", "yes": "True", "name": "a"},
        environment={"HOME": "/home/me"},
    )
    return context.text(parse_template(written))


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("", ""),
        ("plain $ text ()", "plain $ text ()"),
        ("$(var a)", "1"),
        ("x$(var a)y$(var b)", "x1ytwo words"),
        ("$(var $(var name))", "1"),
        ("$(var missing 'a default')", "a default"),
        ("$(env HOME)/x", "/home/me/x"),
        ("$(env NONE '')", ""),
        ('$(env NONE "it\'s $(var a)")', "it's 1"),
        (r"\$(var a)", "$(var a)"),
        (r"a\\b", "a\\b"),
        ("$(dirname)/$(filename)", "/launch//launch/robot.launch.xml"),
        ("$(eval '1 + $(var a)')", "2"),
        ("$(eval \"'$(var b)' == 'two words'\")", "True"),
        ("$(eval 2 * 3)", "6"),
        ("$(and $(var yes) 1)", "true"),
        ("$(or false 0)", "false"),
        ("$(not $(var yes))", "false"),
        ("$(any 0 0 true)$(all)", "truetrue"),
        ("$(equals 1 1.0)$(equals a b)$(not-equals true True)", "truefalsefalse"),
        ("$(if $(var yes) left right)", "left"),
        ("$(anon node)$(anon node)$(anon other)", "node_1node_1other_2"),
    ],
)
def test_what_substitutions_mean(written: str, meant: str) -> None:
    assert text(written) == meant


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("$(var)", "var takes 1 to 2 values, here are 0"),
        ("$(var a b c)", "here are 3"),
        ("$(and x 1)", "expected true, 1, false or 0, got 'x'"),
        ("$(var 'a)", "a quote ' is not closed"),
        ("$(1)", "begins a substitution"),
        ("$(find-pkg-share none)", "there is no ROS package 'none'"),
        ("$(find-exec no-such-program)", "executable 'no-such-program' not found"),
        ("$(file-content /no/such)", "No such file"),
        ("$(" + "var $(" * 60, "nested more than"),
    ],
)
def test_mistakes(written: str, message: str) -> None:
    with pytest.raises(ValueError) as info:
        text(written)
    assert message in str(info.value)


@given(st.text(alphabet="ab $()'\"\\\n", max_size=30))
def test_any_text_is_taken_apart_or_refused(written: str) -> None:
    try:
        parts = parse_template(written)
    except ValueError:
        return
    assert all(isinstance(part, (str, SubstitutionCall)) for part in parts)


@pytest.mark.parametrize(
    "expression",
    [
        "1 + 2 * 3 - 4 / 5 // 1 % 3",
        "2 ** 10",
        "-(-3)",
        "not True or 1 < 2 <= 3 != 4",
        "'a' in 'abc' and 'x' not in ['y']",
        "'yes' if 3 > 2 else 'no'",
        "[1, 2, 3][1] + (4, 5)[0]",
        "'abcdef'[1:4]",
        "math.pi * sin(1.0) + math.sqrt(2)",
        "max(1, 2) + len('abc') + int('7') + round(2.6)",
        "' X '.strip().lower().replace('x', 'y').startswith('y')",
        "None is None",
    ],
)
def test_expressions_are_pythons(expression: str) -> None:
    assert evaluate(expression) == eval(expression, {"math": math, **vars(math)})


@pytest.mark.parametrize(
    "expression",
    [
        "__import__('os').system('true')",
        "open('/etc/passwd').read()",
        "().__class__.__bases__[0].__subclasses__()",
        "'{0.__class__}'.format(1)",
        "'%s' % 1",
        "(lambda: 1)()",
        "[x for x in (1, 2)]",
        "f'{1}'",
        "9 ** 9 ** 9",
        "2 ** 99999999",
        "'a' * 10 ** 9",
        "[0] * 1000000",
        "math.factorial.__self__",
        "exec('1')",
        "a := 1",
        "1 +",
        "1 / 0",
        "print(1)",
        "max(1, 2, key=abs)",
        "(" * 500 + ")" * 500,
        "math.factorial(10 ** 7)",
        "' '.join(sorted('b' * 99999)).replace(' ', 'x' * 99999)",
    ],
)
def test_expressions_have_no_reach(expression: str) -> None:
    with pytest.raises(ValueError):
        evaluate(expression)
