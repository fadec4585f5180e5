"""TBB computes in one thread, and as if there were one processor, wherever it is linked."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shutil
import sys
from collections.abc import Callable
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import pytest

from rsltrace.job import load_job
from rsltrace.run import record
from rsltrace.trace.model.finding import NondeterminismSource
from rsltrace.trace.reader import Trace
from tests.guard.conftest import node_code

pytestmark = pytest.mark.ros

COUNT = "_ZN3tbb6detail2r115max_concurrencyEPKNS0_2d115task_arena_baseE"
HOLD = "_ZN3tbb6detail2r16createERNS0_2d114global_controlE"
HELD = "_ZN3tbb6detail2r127global_control_active_valueEi"
ONE_CPU = len(os.sched_getaffinity(0)) == 1


@pytest.fixture
def library(tmp_path: Path) -> Path:
    """A library of which this process has no copy yet, with TBB within it."""
    found = importlib.util.find_spec("kiss_icp")
    if found is None or not found.submodule_search_locations:
        pytest.skip("needs kiss-icp: pip install 'rsltrace[lidar]'")
    (original,) = Path(found.submodule_search_locations[0]).glob("pybind/*.so")
    return Path(shutil.copy(original, tmp_path / "computes.so"))


def _node(library: Path, call: str) -> str:
    return node_code(call, init=f"import ctypes\nself.lib = ctypes.CDLL({str(library)!r})")


def test_tbb_believes_in_one_processor(said: Callable[..., Any], library: Path) -> None:
    before = os.sched_getaffinity(0)
    assert said(_node(library, f"self.say(self.lib[{COUNT!r}](None))"))[0] == [1]
    assert os.sched_getaffinity(0) == before


def test_tbb_is_held_to_one_thread_until_the_run_is_over(
    said: Callable[..., Any], library: Path
) -> None:
    many = (ctypes.c_size_t * 3)(4)  # a user's own global_control: four threads
    ask = f"self.say(self.lib[{HELD!r}](0))"
    lib = ctypes.CDLL(str(library))
    lib[HOLD](many)
    assert said(_node(library, ask))[0] == [1]
    assert lib[HELD](0) == 4


def test_without_pinning_tbb_is_left_alone(said: Callable[..., Any], library: Path) -> None:
    job = "nodes: [{node: 'm:N'}]\nguard: {pin: false}"
    found = said(_node(library, f"self.say(self.lib[{COUNT!r}](None))"), job=job)[0]
    assert found == [len(os.sched_getaffinity(0))]


def _findings(folder: Path, code: str, thread: str = "warn") -> list[str]:
    (folder / "m.py").write_text(code)
    (folder / "job.yaml").write_text(
        f"nodes: [{{node: 'm:N'}}]\nguard: {{thread: {thread}}}\nstop: {{duration: 1s}}\n"
    )
    record(load_job(folder / "job.yaml"), folder / "run.mcap")
    with Trace.open(folder / "run.mcap") as trace:
        found = [one for many in trace.findings.values() for one in many]
    return [
        f"{one.call}: {one.value} {one.stack}"
        for one in found
        if one.source is NondeterminismSource.THREAD
    ]


@pytest.mark.skipif(ONE_CPU, reason="needs two processors")
def test_tbb_that_was_in_use_before_is_reported(library: Path) -> None:
    count = ctypes.CDLL(str(library))[COUNT](None)
    (told,) = _findings(library.parent, _node(library, "pass"))
    assert told.startswith("the threads of TBB in computes.so: it was in use before the run and")
    assert f"as for {count} threads; 'taskset --cpu-list 0'" in told
    assert "m.py:10 in " in told


def _module_with_traces_of_tbb(folder: Path, name: str) -> None:
    """Copy an extension module of Python's, with what a hidden TBB leaves in a file."""
    for module in ("_lsprof", "_xxtestfuzz", "xxlimited", "_crypt", "audioop", "_testbuffer"):
        found = None if module in sys.modules else importlib.util.find_spec(module)
        if found is not None and found.origin and found.origin.endswith(".so"):
            content = Path(found.origin).read_bytes() + b"\0N3tbb6detail2r113unsafe_waitE\0"
            (folder / f"{name}{EXTENSION_SUFFIXES[0]}").write_bytes(content)
            (folder / "which.txt").write_text(module)
            return
    pytest.skip("this Python has no extension module to make a copy of")


@pytest.mark.parametrize("mode", ["warn", "allow"])
def test_a_hidden_tbb_is_reported_unless_allowed(tmp_path: Path, mode: str) -> None:
    _module_with_traces_of_tbb(tmp_path, "hidden")
    module = (tmp_path / "which.txt").read_text()
    file = str(next(tmp_path.glob("hidden*")))
    load = (
        "import importlib.util\n"
        f"spec = importlib.util.spec_from_file_location({module!r}, {file!r})\n"
        "importlib.util.module_from_spec(spec)"
    )
    told = _findings(tmp_path, node_code("pass", init=load), mode)
    if mode == "allow":
        assert not told
    else:
        assert "its functions are hidden, so its threads stay many" in told[0]
        assert "m.py:11 in " in told[0]
