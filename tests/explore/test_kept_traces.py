"""What a search keeps and makes small does not depend on which of its runs ends first."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import ExploreError
from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.search import Explorer, SearchBudget
from rsltrace.search.explore.small.causes import reduce_failures
from rsltrace.search.explore.strategies.named import RandomWalk
from rsltrace.search.explore.table import ResultsFolder, result_rows
from rsltrace.search.explore.trial import CHECK, Failure, JobSource, KeptTraces, Trial, TrialResult

_TRIALS = 8


class Late:
    """A pool in which the runs end in an order that the test says, with files for traces."""

    def __init__(self, order: Callable[[list[int]], list[int]]) -> None:
        self._order = order
        self._under_way: dict[int, tuple[Trial, Path]] = {}

    @property
    def idle(self) -> int:
        return _TRIALS - self.busy

    @property
    def busy(self) -> int:
        return len(self._under_way)

    def submit(
        self, trial: Trial, trace: Path, wants: TrialOptions, timeout_s: float | None = None
    ) -> None:
        self._under_way[trial.number] = (trial, trace)

    def results(self, wait_s: float | None = None) -> Iterator[TrialResult]:
        ended, self._under_way = self._under_way, {}
        for number in self._order(sorted(ended)):
            trial, trace = ended[number]
            failure = None if number == 0 else Failure(CHECK, "bad", f"cause {number % 2}")
            trace.write_text(str(number))
            yield TrialResult(trial, f"{number:016x}", choices=1, failure=failure, trace=str(trace))


def searched(job: Path, folder: Path, order: Callable[[list[int]], list[int]]) -> Explorer:
    loaded = JobSource(str(job)).job()
    with ResultsFolder(folder, {}, resume=False) as table:
        search = Explorer(loaded, RandomWalk(0), table, budget=SearchBudget(trials=_TRIALS))
        with search:
            search.run(Late(order))
    return search


def test_the_lowest_trials_of_a_cause_are_kept_in_whatever_order_they_come() -> None:
    for order in permutations(range(1, 6)):
        kept, files = KeptTraces(), set()
        for number in order:
            files.add(number)
            files.discard(kept.add("a check", number) or 0)
        assert files == {1, 2, 3}


def test_a_search_keeps_the_same_traces_whichever_run_ends_first(
    write_job: Callable[[str, str], Path], tmp_path: Path
) -> None:
    job = write_job("kept", "nodes: [{node: nodes_under_search:Last}]\nstop: {time: 1s}\n")
    kept = []
    for name, order in (("in order", list), ("backwards", lambda numbers: numbers[::-1])):
        search = searched(job, tmp_path / name, order)
        of_rows = {one.trial.number: one.trace is not None for one in result_rows(tmp_path / name)}
        files = sorted(path.name for path in (tmp_path / name / "traces").iterdir())
        assert sorted(f"{number:06d}.mcap" for number in of_rows if of_rows[number]) == files
        first = {key: one.trial.number for key, one in search.tally.first.items()}
        kept.append((files, first))
    assert kept[0] == kept[1]
    assert kept[0][0] == [f"{number:06d}.mcap" for number in range(7)]


@pytest.mark.long
@pytest.mark.ros
def test_a_run_whose_trace_is_lost_is_made_again_to_be_made_small(
    write_job: Callable[[str, str], Path], tmp_path: Path
) -> None:
    text = """
nodes: [{node: nodes_under_search:Last}]
stop: {duration: 0.3s}
checks: [{name: none, never: /last.data == 0}]
"""
    job = write_job("lost", text)
    failure = Failure(CHECK, "none", "none")
    lost = TrialResult(Trial(1, {"seed": 3}), failure=failure)
    found = reduce_failures(JobSource(str(job)), {"none": lost}, tmp_path)
    assert not found["none"].trouble
    assert (found["none"].folder / "failing.mcap").is_file()


def test_a_cluster_fetches_what_may_be_kept_when_later_runs_come_first(
    write_job: Callable[[str, str], Path], tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="needs Dask: pip install 'rsltrace[explore]'")
    from rsltrace.search.explore.cluster import Cluster

    job = write_job("fetched", "nodes: [{node: nodes_under_search:Last}]\nstop: {time: 1s}\n")

    class Client:
        def run(self, function: Any, trace: str, wanted: bool, workers: Any) -> Any:
            return {"a": trace.encode() if wanted else b""}

    cluster = Cluster(JobSource(str(job)), "dask")
    cluster._client = Client()
    there = []
    for number in (5, 4, 3, 9, 2, 1):
        one = TrialResult(Trial(number, {}), failure=Failure(CHECK, "x", "x"), trace=f"/{number}")
        if cluster._with_trace(one, "a", tmp_path / str(number)).trace:
            there.append(number)
    assert there == [5, 4, 3, 2, 1]


def test_nothing_is_said_to_be_kept_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(ExploreError, match=r"Not a directory; name another folder with -o$"),
        ResultsFolder(tmp_path / "file/search", {}, resume=False),
    ):
        pass
