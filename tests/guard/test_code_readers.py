"""Tools that read code (numba, dill, cloudpickle, inspect) get what Python compiles, not ours."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest

import rsltrace.guard.virtual.original_code as original_code
from rsltrace.adapters.rclpy.hints import hint_for
from rsltrace.guard.virtual.user_modules import rewritten
from rsltrace.trace.model.finding import NondeterminismSource
from tests.guard.conftest import list_as_wheel, node_code

pytestmark = pytest.mark.ros

_SAMPLES = sorted((Path(original_code.__file__).parents[2] / "job").rglob("*.py"))


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield from _codes(part)


@pytest.mark.few(8)
@pytest.mark.parametrize("path", _SAMPLES, ids=lambda path: path.stem)
def test_every_function_has_its_original(path: Path) -> None:
    source = path.read_bytes()
    plain = {
        (code.co_name, code.co_firstlineno, code.co_varnames): code.co_code
        for code in _codes(compile(source, str(path), "exec", dont_inherit=True))
    }
    for code in _codes(rewritten(source, str(path))):
        given = original_code.original_of(code)
        assert not [name for name in given.co_names if name.startswith("__rsltrace_")]
        assert given.co_code == plain[code.co_name, code.co_firstlineno, code.co_varnames]


_PICKLED = """
import {library}, subprocess, sys
def total(pairs):
    return sum(a * b for a, b in {{*pairs}})
def nested(x):
    a, b = x, x
    return [max(n, a) for n in {{1, b}}] if x.__hash__() else 0
code = "import pickle, sys; print([f(9) if f.__name__ == 'nested' else f([(2, 3)])"
code += " for f in pickle.loads(sys.stdin.buffer.read())])"
functions = {library}.dumps([total, nested]{more})
done = subprocess.run([sys.executable, "-c", code], input=functions, capture_output=True)
self.say(done.stdout.decode(), done.stderr.decode())
self.say(__import__("inspect").getsource(N)[:7])
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("library", "more"), [("dill", ", recurse=True"), ("cloudpickle", "")], ids=["dill", "cloud"]
)
def test_pickled_functions_work_where_nobody_puts_sets_in_order(
    said: Callable[..., Any], library: str, more: str
) -> None:
    pytest.importorskip(library)
    first, source = said(node_code(_PICKLED.format(library=library, more=more)))[:2]
    assert first == ["[6, [9, 9]]\n", ""]
    assert source == ["class N"]


_COMPILED = """
@njit(cache=True)
def first(values):
    a, b = values[0], values[-1]
    seen = set()
    for n, value in enumerate(values):
        seen.add(value)
    for value in seen:
        a += value
    return a, max(b, a), len(seen)

def later(n):
    low, high = min(n, 2), max(n, 2)
    return high - low
quick = njit(later)
"""


@pytest.mark.skipif(find_spec("numba") is None, reason="needs numba")
def test_numba_compiles_what_was_written(tmp_path: Path) -> None:
    from rsltrace.trace.reader import Trace

    imports = "import numpy as np\nfrom numba import njit"
    tick = "self.say(*map(float, (*first(np.arange(4.0)), quick(7))))"
    (tmp_path / "m.py").write_text(node_code(tick, imports=imports, module=_COMPILED))
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {time: 1.2s}\n")
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    digests = []
    for name in ("compiled", "cached"):
        words = [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", f"{name}.mcap"]
        subprocess.run(words, cwd=tmp_path, env=env, check=True, capture_output=True)
        with Trace.open(tmp_path / f"{name}.mcap") as trace:
            digests.append(trace.digest)
            found = [one for per_event in trace.findings.values() for one in per_event]
            texts = [trace.decode("/rosout", data).msg for *_, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
        assert texts == ["[6.0, 6.0, 4.0, 5.0]"] * 2
        if name == "compiled":
            calls = {one.call for one in found if one.source is NondeterminismSource.ORDER}
            assert calls == {"order of sets in first, which numba compiles"}
    assert digests[0] == digests[1]


def test_an_error_in_compiled_code_names_the_switch(tmp_path: Path) -> None:
    names: dict[str, Any] = {}
    exec(rewritten(b"def f(s):\n    return s.__hash__()\n", str(tmp_path / "m.py")), names)
    with pytest.raises(NameError, match="__rsltrace_") as failed:
        FunctionType(names["f"].__code__, {"__builtins__": {}})([1])
    assert "guard: {order: allow}" in hint_for(failed.value)
    with pytest.raises(ValueError) as other:
        raise ValueError
    assert "guard" not in hint_for(other.value)


def test_allowed_order_leaves_the_code_as_it_is(said: Callable[..., Any]) -> None:
    code = node_code("f'{self.__hash__}'\nself.say(N.tick.__code__.co_names)")
    job = "nodes: [{node: 'm:N'}]\n"
    (plain,) = said(code, job=job + "guard: {order: allow}")[0]
    (ours,) = said(code, job=job)[0]
    assert not [name for name in plain if "rsltrace" in name]
    assert [name for name in ours if "rsltrace" in name] == ["__rsltrace_hash__"]


def test_variables_that_a_library_reads_are_told_as_one(
    command: Callable[..., subprocess.CompletedProcess[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    site = tmp_path / "site-packages" / "loguru"
    site.mkdir(parents=True)
    (site / "__init__.py").write_text(
        "import os\ndef read():\n    return [os.environ.get(f'LIB_{n}') for n in range(30)]\n"
    )
    list_as_wheel(site.parent, "loguru")
    monkeypatch.syspath_prepend(str(site.parent))
    (tmp_path / "m.py").write_text(
        node_code("import os, loguru\nloguru.read()\nos.environ.get('MINE')")
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {time: 0.7s}\n")
    done = command("record", "job.yaml")
    lines = [line for line in done.stderr.splitlines() if line.startswith("  environment")]
    assert lines == [
        "  environment: environment variables, read by loguru in /n at m.py:16, 30 times",
        "  environment: os.environ['MINE'] in /n at m.py:17",
    ]
    sys.modules.pop("loguru", None)


def test_who_copies_the_environment_is_told_once(
    command: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    (tmp_path / "m.py").write_text(node_code("import os\ndict(os.environ)\n{**os.environ}"))
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {time: 0.7s}\n")
    done = command("record", "job.yaml")
    lines = [line for line in done.stderr.splitlines() if line.startswith("  environment")]
    assert lines == ["  environment: os.environ in /n at m.py:16, m.py:17, 2 times"]
