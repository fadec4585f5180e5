"""Nodes on rcl's C API, again and again on a busy machine: one digest.

Thirty-six runs in all with ``--many-cases``, as in ``make test-all``.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from rsltrace.adapters.processes import child
from rsltrace.adapters.workspace import cache
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.reader import Trace
from tests.tiers import cases

pytestmark = [pytest.mark.ros, pytest.mark.long]

RUNS = cases(6, 36)
WAYS = 6
HOGS = 3
PROGRAMS = """
nodes:
  - {{program: {network}, arguments: [a]}}
  - {{program: {network}, arguments: [b]}}
  - {{program: {network}, arguments: [c]}}
  - {{program: {network}, arguments: [d]}}
  - {{program: {counter}, arguments: ["50"]}}
policy: permutation
execution: {{nodes: {{/counter: 10ms, /c: 3ms}}}}
stop: {{duration: 1s}}
"""


@contextmanager
def _load() -> Iterator[None]:
    with ExitStack() as stack:
        for _ in range(HOGS):
            hog = stack.enter_context(subprocess.Popen(["sh", "-c", "while :; do :; done"]))
            stack.callback(hog.kill)
        yield


@contextmanager
def _on(cores: set[int]) -> Iterator[None]:
    """Let this thread, and what it starts, run on some cores only."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@pytest.mark.parametrize("fixed", [True, False], ids=["fixed", "random"])
@pytest.mark.parametrize("where", [slice(0, 1), slice(-1, None), slice(None)], ids=str)
def test_nodes_of_c_have_one_digest_on_any_core_under_load_with_random_addresses_and_without(
    where: slice,
    fixed: bool,
    compiled: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    programs = {name: compiled(f"{name}.c") for name in ("network", "counter")}
    (tmp_path / "job.yaml").write_text(PROGRAMS.format(**programs))
    job = load_job(tmp_path / "job.yaml")
    quiet = tmp_path / "quiet.mcap"
    digest = run(job, quiet).digest
    with Trace.open(quiet) as trace:
        assert trace.event_count > 100
    if not fixed:
        monkeypatch.setattr(child, "fix_addresses", lambda fixed: False)
    cores = set(sorted(os.sched_getaffinity(0))[where])
    path = tmp_path / "run.mcap"
    with _load(), _on(cores):
        for _ in range(-(-RUNS // WAYS)):
            result = run(job, path, force=True)
            assert result.error is None
            assert result.digest == digest, f"rsltrace diff {quiet} {path}"


ADDRESSED = """import rclpy
rclpy.init()
rclpy.spin(rclpy.create_node("listener_%x" % id(object())))
"""


def test_a_node_with_an_address_in_its_name_has_one_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the node of a tf2_ros::TransformListener."""
    monkeypatch.setattr(child, "fix_addresses", lambda fixed: False)
    (tmp_path / "node.py").write_text(ADDRESSED)
    entry = "{script: node.py, isolated: true}"
    (tmp_path / "job.yaml").write_text(f"nodes: [{entry}, {entry}]\nstop: {{duration: 1s}}\n")
    job = load_job(tmp_path / "job.yaml")
    path = tmp_path / "run.mcap"
    digests = {run(job, path, force=True).digest for _ in range(3)}
    assert len(digests) == 1
    with Trace.open(path) as trace:
        nodes = [one.name for one in trace.entities.values() if one.kind is EntityKind.NODE]
    assert len({name for name in nodes if name.startswith("/listener_")}) == 2


def test_where_the_stack_lies_does_not_depend_on_the_size_of_the_surroundings(
    compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    """``counter`` publishes where a variable of its ``main`` lies."""
    found = set()
    for i, more in enumerate(("", "a", "b" * 1000, "c" * 15_000)):
        variables = {f"MORE_{k}": more for k in range(i)}
        entry = {"program": str(compiled("counter.c")), "environment": variables}
        entry["arguments"] = ["100", "address", *["d" * i] * i]
        (tmp_path / "job.yaml").write_text(
            json.dumps({"nodes": [entry], "stop": {"duration": "1s"}})
        )
        found |= _counts(tmp_path, f"{i}.mcap")
    assert len(found) == 1


def _counts(folder: Path, name: str) -> set[int]:
    """Run a job, and return what ``counter`` published."""
    assert run(load_job(folder / "job.yaml"), folder / name).error is None
    with Trace.open(folder / name) as trace:
        return {trace.decode("/count", data).data for _, _, data in trace.messages("/count")}  # type: ignore[attr-defined]


@pytest.mark.parametrize("what", ["heap", "thread"])
def test_where_memory_lies_does_not_depend_on_the_folder_for_caches(
    compiled: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """The library that processes are started with lies there: another user's has another path."""
    (tmp_path / "job.yaml").write_text(
        f"nodes: [{{program: {compiled('counter.c')}, arguments: ['100', {what}]}}]\n"
        "stop: {duration: 250ms}\n"
    )
    root = cache._root()
    found = [_counts(tmp_path, "here.mcap")]
    names = ["a", "b" * 20, "u" * 100 + "/er", "u" * 100 + "/" + "s" * 200]
    (tmp_path / names[-1]).parent.mkdir(parents=True)
    for name in names:
        (tmp_path / name).symlink_to(root)
        monkeypatch.setattr(cache, "_root", lambda place=tmp_path / name: place)
        found.append(_counts(tmp_path, f"{len(found)}.mcap"))
    assert all(one == found[0] for one in found)


def test_where_memory_lies_does_not_depend_on_the_folder_of_the_program(
    compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    """rcl copies the command line; and the trace has the program's path."""
    found = []
    for folder in ("a", "b" * 20, "c" * 200):
        program = tmp_path / folder / "counter"
        program.parent.mkdir()
        shutil.copy(compiled("counter.c"), program)
        (tmp_path / "job.yaml").write_text(
            f"nodes: [{{program: {program}, arguments: ['100', heap]}}]\n"
            "stop: {duration: 250ms}\n"
        )
        found.append(_counts(tmp_path, f"{folder}.mcap"))
    assert all(one == found[0] for one in found)


def test_a_thread_begins_when_the_one_before_it_has_given_back_its_heap(
    compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    """Else chance says which heap it gets, and so the order of all that goes by addresses."""
    (tmp_path / "job.yaml").write_text(
        f"nodes: [{{program: {compiled('counter.c')}, arguments: ['100', heaps]}}]\n"
        "stop: {duration: 250ms}\n"
    )
    assert _counts(tmp_path, "run.mcap") == {1}
