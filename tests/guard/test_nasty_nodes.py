"""Sixty nasty nodes: each differs from run to run, unless the guard prevents or reports it.

All nodes are in one job, which is recorded a few times in unlike surroundings with the guard and
without. ``docs/guard.md`` has the table of what came out (UPDATE_GOLDEN=1 writes it).
"""

from __future__ import annotations

import json
import os
import random
import re
from pathlib import Path
from typing import Any

import pytest

from rsltrace.campaign.perturb import (
    KERNEL,
    LOCALE,
    THREAD_COUNT,
    TIME_ZONE,
    Surroundings,
    record_in,
    surroundings,
)
from rsltrace.trace.reader import Trace
from tests.guard.nasty_nodes import CASES, DETECTED, DETERMINISTIC

pytestmark = [pytest.mark.ros, pytest.mark.slow]

DOCUMENT = Path(__file__).parents[2] / "docs" / "guard.md"
RUNS = 2
Seen = dict[str, list[str]]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Seen], list[Seen], set[str]]:
    """What every node logged: unguarded runs, guarded runs, and which nodes had findings."""
    pytest.importorskip("rclpy")
    folder = tmp_path_factory.mktemp("nasty")
    seen: dict[bool, list[Seen]] = {False: [], True: []}
    reported: set[str] = set()
    for guarded in (False, True):
        for number in range(RUNS):
            job = _job(folder, number, guarded=guarded)
            done = record_in(_around(number), [str(job)], folder)
            assert done.exit_code == 0, done.errors
            with Trace.open(done.path) as trace:
                seen[guarded].append(_said(trace))
                reported |= {met.node.strip("/") for met in trace.guarded if met.is_finding}
    return seen[False], seen[True], reported


def _around(number: int) -> Surroundings:
    values = dict(surroundings(number).values)
    values.pop(KERNEL, None)  # has a case of its own
    if number:
        values.update({LOCALE: "C", TIME_ZONE: "XYZ+5:17", THREAD_COUNT: "1"})
    return Surroundings(number, values)


def _job(folder: Path, number: int, *, guarded: bool) -> Path:
    listed = _shared_memory(folder) / f"listed{number}"
    listed.mkdir(exist_ok=True)
    names = [f"f{n}" for n in range(30)]
    random.Random(number).shuffle(names)
    for name in names:
        (listed / name).touch()
    nodes = [
        {"node": "nasty_nodes:Nasty", "arguments": {"case": name, "folder": str(listed)}}
        for name in CASES
    ]
    job = {
        "nodes": nodes,
        "search_path": [str(Path(__file__).parent)],
        "stop": {"duration": "1.2s"},
        "guard": guarded,
    }
    path = folder / f"job{number}{guarded}.yaml"
    path.write_text(json.dumps(job))
    return path


def _shared_memory(folder: Path) -> Path:
    """A file system that lists files as they were made, if there is one."""
    place = Path("/dev/shm")
    if not os.access(place, os.W_OK):
        return folder
    own = place / f"rsltrace-{folder.name}-{os.getpid()}"
    own.mkdir(exist_ok=True)
    return own


def _said(trace: Trace) -> Seen:
    seen: Seen = {}
    for *_, data in trace.messages("/rosout"):
        record: Any = trace.decode("/rosout", data)
        seen.setdefault(record.name, []).append(record.msg)
    return seen


def test_there_are_enough() -> None:
    assert len(CASES) >= 30
    assert {expected for expected, _, _ in CASES.values()} == {DETERMINISTIC, DETECTED}


@pytest.mark.parametrize("name", CASES)
def test_a_nasty_node(runs: tuple[list[Seen], list[Seen], set[str]], name: str) -> None:
    unguarded, guarded, reported = runs
    if name in ("list_directory", "glob_and_pathlib") and not os.access("/dev/shm", os.W_OK):
        pytest.skip("no file system here lists files in the order they were made")
    if name == "threaded_blas" and (os.cpu_count() or 1) < 2:
        pytest.skip("one core: the library uses one thread anyway")
    assert len({tuple(run[name]) for run in unguarded}) > 1, "it proves nothing"
    assert all(len(run[name]) == 2 for run in guarded)
    if CASES[name][0] == DETERMINISTIC:
        assert len({tuple(run[name]) for run in guarded}) == 1
    else:
        assert name in reported


def test_what_is_deterministic_by_itself_has_no_findings(
    runs: tuple[list[Seen], list[Seen], set[str]],
) -> None:
    """What is reported is news: most of the nodes that were made deterministic have nothing."""
    noisy = {name for name in runs[2] if CASES[name][0] == DETERMINISTIC}
    assert noisy <= {"temporary_names", "the_locale", "list_directory", "glob_and_pathlib"}


def test_another_kernel_of_the_numerical_library_is_in_the_environment(tmp_path: Path) -> None:
    """Which code OpenBLAS runs depends on the processor: not made equal, but told."""
    from rsltrace.campaign.perturb import core_types
    from rsltrace.diff import diff_files

    kernels = core_types()
    if len(kernels) < 2:
        pytest.skip("this processor can be one core type only")
    job = _job(tmp_path, 0, guarded=True)
    content = json.loads(job.read_text())
    content["nodes"] = [n for n in content["nodes"] if n["arguments"]["case"] == "threaded_blas"]
    job.write_text(json.dumps(content))
    around = [Surroundings(n, {KERNEL: kernels[-n]}) for n in (0, 1)]
    runs = [record_in(one, [str(job)], tmp_path) for one in around]
    found = diff_files(str(runs[0].path), str(runs[1].path))
    with Trace.open(runs[0].path) as one, Trace.open(runs[1].path) as other:
        if one.environment["numerics"] == other.environment["numerics"]:
            pytest.skip("numpy does not use OpenBLAS")
    assert not found.identical
    assert "environment: numerics" in [setting.place for setting in found.settings]


def test_the_document_has_the_table() -> None:
    rows = ["| source | with the guard |", "|---|---|"]
    rows += [f"| {what} | {expected} |" for expected, what, _ in CASES.values()]
    rows.append("| the kernel a numerical library chooses for the processor | detected |")
    table = "\n".join(rows)
    begin, end = "<!-- nasty nodes -->\n", "\n<!-- end -->"
    text = DOCUMENT.read_text()
    if os.environ.get("UPDATE_GOLDEN"):
        text = re.sub(f"{begin}.*?{end}", lambda _: begin + table + end, text, flags=re.DOTALL)
        DOCUMENT.write_text(text)
    assert begin + table + end in text
