"""Sets in user modules have one order: that of their elements where those have one."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.guard.virtual import user_modules
from rsltrace.guard.virtual.user_modules import rewritten
from tests.guard.conftest import node_code

pytestmark = pytest.mark.ros

WAYS = {
    "loop": "r = []\nfor x in s: r.append(x)",
    "comprehension": "r = [x for x in s]",
    "nested": "r = [x for y in [s] for x in y if x]",
    "list": "r = list(s)",
    "tuple": "r = [*tuple(s)]",
    "join": "r = ' '.join(s).split()",
    "star": "r = [*s]",
    "unpacked": "a, *b = s\nr = [a, *b]",
    "enumerate": "r = [x for _, x in enumerate(s)]",
    "map": "r = list(map(str, s))",
    "next": "r = [next(iter(s)), *sorted(s)[1:]]",
    "pop": "s = set(s)\nr = [s.pop() for _ in range(5)]",
    "text": "r = eval('[' + f'{s}'[1:-1] + ']')",
    "repr": "r = eval('[' + str(s)[1:-1] + ']') if repr(s) == f'{s!r}' else []",
    "frozen": "r = list(frozenset(s))",
    "difference": "r = list(s - {'zz'})",
    "dict": "r = list(dict.fromkeys(s))",
    "extend": "r = []\nr.extend(s)",
    "added": "r = []\nr += s",
    "slice": "r = []\nr[:] = s",
    "sorted": "r = sorted(s, key=lambda text: 0)",
    "smallest": "r = __import__('heapq').nsmallest(5, s, key=lambda text: 0)",
    "counter": "r = list(__import__('collections').Counter(s))",
    "chain": "r = list(__import__('itertools').chain(s))",
    "pickle": "r = list(dict.fromkeys(__import__('pickle').loads(__import__('pickle').dumps(s))))",
}


@pytest.mark.few(3)
@pytest.mark.parametrize("way", WAYS)
def test_texts_are_in_order_whatever_the_hash_seed(said: Callable[..., Any], way: str) -> None:
    code = node_code(
        f"s = {{'delta', 'alpha', 'echo', 'bravo', 'charlie'}}\n{WAYS[way]}\nself.say(r)"
    )
    assert said(code)[0] == [["alpha", "bravo", "charlie", "delta", "echo"]]


def test_subclasses_of_values_are_in_order(tmp_path: Path) -> None:
    """As texts are: a set of ``np.str_`` is no finding."""
    from rsltrace.job import load_job
    from rsltrace.run import run

    kinds = "np.str_, np.bytes_, type('T', (str,), {}), type('S', (str,), {'__slots__': ()})"
    code = node_code(f"""
import numpy as np
for kind in ({kinds}):
    made = [kind(c.encode() if issubclass(kind, bytes) else c) for c in "cabde"]
    assert list({{*made}}) == sorted(made), kind
""")
    (tmp_path / "m.py").write_text(code)
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {duration: 1.2s}\n")
    assert [met.mode.value for met in run(load_job(tmp_path / "job.yaml"), None).guarded] == [
        "virtual"
    ]


def test_numbers_keep_the_order_that_python_gives_them(said: Callable[..., Any]) -> None:
    numbers = {8, 1, 17, -3, 64}
    assert said(node_code("self.say(list({8, 1, 17, -3, 64}))"))[0] == [list(numbers)]


def test_a_set_that_changes_on_the_way_is_still_an_error(said: Callable[..., Any]) -> None:
    code = node_code("s = {'a', 'b'}\nfor x in s: s.add(x + x)")
    with pytest.raises(Exception, match="Set changed size during iteration"):
        said(code)


def test_a_set_of_objects_is_a_finding(tmp_path: Path) -> None:
    from rsltrace.job import load_job
    from rsltrace.run import run

    (tmp_path / "m.py").write_text(node_code("for x in {object(), object()}: pass"))
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {duration: 1.2s}\n")
    result = run(load_job(tmp_path / "job.yaml"), None)
    assert [(met.call, met.count) for met in result.guarded] == [("order of a set of object", 2)]


def test_temporary_name_that_an_earlier_run_left(tmp_path: Path) -> None:
    """The first run asks for nothing from outside; the next finds the name taken and says so."""
    from rsltrace.job import load_job
    from rsltrace.run import run

    (tmp_path / "m.py").write_text(
        node_code(f"import tempfile\nself.say(tempfile.mkdtemp(dir={str(tmp_path)!r}))")
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {duration: 0.7s}\n")
    first, second = (run(load_job(tmp_path / "job.yaml"), None) for _ in range(2))
    assert [met.call for met in first.guarded if met.mode.value == "warn"] == []
    (taken,) = [met for met in second.guarded if met.mode.value == "warn"]
    assert taken.call.startswith(f"the taken name '{tmp_path}/tmp")


def test_what_is_rewritten_means_the_same() -> None:
    """Whole modules of Python's own, rewritten, still do what their tests say."""
    source = '''
import json, textwrap
class A:
    """Doc."""
    __slots__ = ("x",)
    def __init__(self): self.x = {1: 2}
    def take(self): return self.x.pop(1), self.x.pop(1, "none")
    def more(self, *a, **k): return [*a], {**k}
class B(A):
    def take(self): return super().take()
    def pop(self, *a): return ("own", a)
async def c():
    return [x async for x in d()]
async def d():
    for i in range(3): yield i
def e():
    x, (y, *z) = 1, "abc"
    return x, y, z, f"{x:>{3}}|{y!r:^5}|{x=}", max(x for x in (3, 1)), B().pop(5)
def g():
    yield from "ab"
match {"k": [1, 2]}:
    case {"k": [a, *rest]}: m = (a, rest)
out = (B().take(), A().more(1, b=2), e(), list(g()), m, A.__doc__, dict(a=1), sum([1, 2], 3))
'''
    plain: dict[str, Any] = {}
    exec(compile(source, "x.py", "exec"), plain)
    other: dict[str, Any] = {}
    with user_modules.user_modules(frozenset()):
        exec(rewritten(source.encode(), "x.py"), other)
    assert other["out"] == plain["out"]


def test_lines_of_tracebacks_stay(tmp_path: Path) -> None:
    from rsltrace.job import load_job
    from rsltrace.run import run

    code = node_code("values = [\n    x\n    for x in [1, 0]\n    if 1 / x\n]")
    (tmp_path / "m.py").write_text(code)
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {duration: 1.2s}\n")
    error: Any = run(load_job(tmp_path / "job.yaml"), None).error
    line = 1 + code.splitlines().index("            if 1 / x")
    assert f"line {line}, in" in error.traceback_text


def test_modules_are_found_rewritten_only_during_a_run(said: Callable[..., Any]) -> None:
    before = list(sys.meta_path)
    members = {kind: dict(vars(kind)) for kind in (set, frozenset, dict, list)}
    said(node_code("pass"))
    assert sys.meta_path == before
    assert members == {kind: dict(vars(kind)) for kind in members}
    probe = "import sys; assert not any('rsltrace' in str(f) for f in sys.meta_path)"
    subprocess.run([sys.executable, "-c", probe], check=True, env=dict(os.environ), timeout=300)
