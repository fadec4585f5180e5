"""Nodes on rcl's C API, again and again on a busy machine: one digest.

``RSLTRACE_RUNS`` sets how many runs there are: 100 in ``make test-long``.
"""

from __future__ import annotations

import itertools
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from rsltrace.doors.processes import child
from rsltrace.job import load_job
from rsltrace.run.recording import run
from rsltrace.trace.reader import Trace

pytestmark = [pytest.mark.ros, pytest.mark.long]

RUNS = int(os.environ.get("RSLTRACE_RUNS", "6"))
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


def test_nodes_of_c_have_one_digest_on_any_core_under_load_with_random_addresses_and_without(
    compiled: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs = {name: compiled(f"{name}.c") for name in ("network", "counter")}
    (tmp_path / "job.yaml").write_text(PROGRAMS.format(**programs))
    job = load_job(tmp_path / "job.yaml")
    cores = sorted(os.sched_getaffinity(0))
    ways = itertools.cycle(itertools.product([{cores[0]}, {cores[-1]}, set(cores)], (True, False)))
    traces: dict[str, Path] = {}
    with _load():
        for number, (where, fixed) in zip(range(RUNS), ways, strict=False):
            path = tmp_path / f"{number}.mcap"
            with _on(where), monkeypatch.context() as patch:
                if not fixed:
                    patch.setattr(child, "_NO_RANDOM_ADDRESSES", 0)
                result = run(job, path)
            assert result.error is None
            assert traces.setdefault(result.digest, path) == path or path.unlink() is None
    assert len(traces) == 1, f"rsltrace diff {' '.join(map(str, traces.values()))}"
    with Trace.open(next(iter(traces.values()))) as trace:
        assert trace.event_count > 100
