"""Sixty nasty nodes: each differs from run to run, unless the guard prevents or reports it.

All nodes are in one job, which is recorded a few times in unlike surroundings with the guard and
without. ``nasty_nodes.md`` has the table of what came out (``--update-golden`` writes it).
"""

from __future__ import annotations

import json
import os
import random
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rsltrace.search.perturb import (
    KERNEL,
    LOCALE,
    THREAD_COUNT,
    TIME_ZONE,
    Perturbation,
    perturbation,
    record_perturbed,
)
from rsltrace.trace.reader import Trace
from tests.golden_files import check_golden
from tests.guard.nasty_nodes import CASES, DETECTED, DETERMINISTIC

pytestmark = [pytest.mark.ros, pytest.mark.long]

DOCUMENT = Path(__file__).parent / "nasty_nodes.md"
RUNS = 2
RUNS_MAX = 8
"""Without the guard: until every node has differed, as what chance decides may be equal twice."""
SHARED_MEMORY = Path("/dev/shm")
Seen = dict[str, list[str]]
Runs = tuple[list[Seen], list[Seen], set[str]]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """What every node logged: unguarded runs, guarded runs, and which nodes had findings."""
    pytest.importorskip("rclpy")
    folder = tmp_path_factory.mktemp("nasty")
    seen: dict[bool, list[Seen]] = {False: [], True: []}
    reported: set[str] = set()
    with _listed_as_made(folder) as listed:

        def go(number: int, *, guarded: bool) -> None:
            job = _job(folder, listed, number, guarded=guarded)
            done = record_perturbed(_around(number), [str(job)], folder)
            assert done.exit_code == 0, done.errors
            with Trace.open(done.path) as trace:
                seen[guarded].append(_said(trace))
                reported.update(met.node.strip("/") for met in trace.guarded if met.is_finding)

        for number in range(RUNS):
            go(number, guarded=True)
        wanted = {name for name in CASES if not _cannot_differ(name)}
        for number in range(RUNS_MAX):
            if number >= RUNS and all(_differs(seen[False], name) for name in wanted):
                break
            go(number, guarded=False)
    return seen[False], seen[True], reported


def _differs(runs: list[Seen], name: str) -> bool:
    return len({tuple(run[name]) for run in runs}) > 1


def _cannot_differ(name: str) -> str:
    """Say why a node is the same in every run on this machine; empty if it is not."""
    if name in ("list_directory", "glob_and_pathlib") and not os.access(SHARED_MEMORY, os.W_OK):
        return "no file system here lists files in the order they were made"
    if name == "threaded_blas" and len(os.sched_getaffinity(0)) < 2:
        return "one core: the library uses one thread anyway"
    return ""


def _around(number: int) -> Perturbation:
    values = dict(perturbation(number).values)
    values.pop(KERNEL, None)  # has a case of its own
    odd = number % 2
    values[LOCALE] = ("C.UTF-8", "C")[odd]
    values[TIME_ZONE] = ("UTC", "XYZ+5:17")[odd]
    values[THREAD_COUNT] = (str(len(os.sched_getaffinity(0))), "1")[odd]
    return Perturbation(number, values)


def _job(folder: Path, place: Path, number: int, *, guarded: bool) -> Path:
    listed = place / f"listed{number}"
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


@contextmanager
def _listed_as_made(folder: Path) -> Iterator[Path]:
    """A folder on a file system that lists files as they were made, if there is one."""
    if not os.access(SHARED_MEMORY, os.W_OK):
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="rsltrace-", dir=SHARED_MEMORY) as own:
        yield Path(own)


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
def test_a_nasty_node(runs: Runs, name: str) -> None:
    unguarded, guarded, reported = runs
    if why := _cannot_differ(name):
        pytest.skip(why)
    assert _differs(unguarded, name), "it proves nothing"
    assert all(len(run[name]) == 2 for run in guarded)
    if CASES[name][0] == DETERMINISTIC:
        assert not _differs(guarded, name)
    else:
        assert name in reported


def test_what_is_deterministic_by_itself_has_no_findings(runs: Runs) -> None:
    """What is reported is news: most of the nodes that were made deterministic have nothing."""
    noisy = {name for name in runs[2] if CASES[name][0] == DETERMINISTIC}
    assert noisy <= {
        "temporary_names",
        "made_up_name",
        "the_locale",
        "list_directory",
        "glob_and_pathlib",
    }


def test_another_kernel_of_the_numerical_library_is_in_the_environment(tmp_path: Path) -> None:
    """Which code OpenBLAS runs depends on the processor: not made equal, but told."""
    from rsltrace.diff import diff_files
    from rsltrace.search.perturb import core_types

    kernels = core_types()
    if len(kernels) < 2:
        pytest.skip("this processor can be one core type only")
    job = _job(tmp_path, tmp_path, 0, guarded=True)
    content = json.loads(job.read_text())
    content["nodes"] = [n for n in content["nodes"] if n["arguments"]["case"] == "threaded_blas"]
    job.write_text(json.dumps(content))
    around = [Perturbation(n, {KERNEL: kernels[-n]}) for n in (0, 1)]
    runs = [record_perturbed(one, [str(job)], tmp_path) for one in around]
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
    wanted = re.sub(f"{begin}.*?{end}", lambda _: begin + table + end, text, flags=re.DOTALL)
    assert begin + table + end in wanted
    check_golden(DOCUMENT, wanted)
