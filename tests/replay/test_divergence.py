"""Where a node has changed, the replay stops at the event that `diff` finds, with its report."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import rsltrace
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace
from tests.replay.conftest import NODES

pytestmark = pytest.mark.ros


def mutations() -> Iterator[tuple[str, str]]:
    """Yield (what was changed, the nodes with that change): each number in them, once."""
    for at, node in enumerate(ast.walk(ast.parse(NODES))):
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            tree = ast.parse(NODES)
            constant = list(ast.walk(tree))[at]
            assert isinstance(constant, ast.Constant)
            constant.value = type(node.value)(node.value + 1)
            yield f"line {node.lineno}: {node.value}", ast.unparse(tree)


MUTATIONS = dict(mutations())
WITHOUT_EFFECT = ("10", "1.5")
"""Depths of queues that never fill, and the default of a parameter that the job gives."""


def test_there_is_something_to_change() -> None:
    assert len(MUTATIONS) >= 12


@pytest.mark.few(1)
@pytest.mark.parametrize("what", MUTATIONS)
def test_a_changed_constant_is_found_where_diff_finds_it(
    recorded: Callable[..., Path], tmp_path: Path, what: str
) -> None:
    trace = recorded()
    (tmp_path / "nodes_of_replay.py").write_text(MUTATIONS[what])
    run(load_job(tmp_path / "job.yaml"), tmp_path / "changed.mcap")
    whole = rsltrace.diff(trace, tmp_path / "changed.mcap")
    output = tmp_path / "replay.mcap"
    result = rsltrace.replay(trace, trust=True, output=output)
    assert whole.identical == (what.partition(": ")[2] in WITHOUT_EFFECT)
    if whole.identical:
        assert result.is_whole
        return
    assert result.diverged
    assert result.exit_code == 1
    assert result.diff is not None
    assert result.verified == whole.agreeing == result.diff.agreeing
    assert result.diff.divergences
    with Trace.open(output) as replayed, Trace.open(tmp_path / "changed.mcap") as changed:
        assert replayed.event_count == result.verified + 1, "nothing ran after it"
        assert replayed.event(result.verified) == changed.event(result.verified)


def test_what_follows_a_divergence_does_not_run(
    recorded: Callable[..., Path], tmp_path: Path
) -> None:
    """The message that differs reaches nobody."""
    trace = recorded()
    changed = NODES.replace("+ 0.25", "+ (0.25 if self.count < 5 else 99.0)")
    assert changed != NODES
    received = tmp_path / "received.txt"
    (tmp_path / "nodes_of_replay.py").write_text(
        changed.replace(
            "        self.state = 0.75",
            f"        if message.data > 90: open({str(received)!r}, 'w')\n"
            "        self.state = 0.75",
        )
    )
    result = rsltrace.replay(trace, trust=True)
    assert result.diff is not None
    (divergence,) = result.diff.divergences
    assert divergence.a is not None
    assert divergence.a.entity.node == "/source"
    field = divergence.messages[0].fields[0]
    assert (field.path, field.a, field.b) == ("data", "10.25", "109.0")
    assert not received.exists()
    assert {setting.place for setting in result.diff.settings} == {"code of module nodes_of_replay"}


def test_an_exception_that_was_not_there(recorded: Callable[..., Path], tmp_path: Path) -> None:
    trace = recorded()
    code = NODES.replace("self.count += 1", "self.count += 1; assert self.count < 8")
    (tmp_path / "nodes_of_replay.py").write_text(code)
    result = rsltrace.replay(trace, trust=True)
    assert result.diff is not None
    assert result.diff.verdict.value == "exception"
    assert "AssertionError" in str(result.error)


def test_a_run_that_ends_earlier(recorded: Callable[..., Path], tmp_path: Path) -> None:
    """The events are the same as far as they go, so it is the end that differs."""
    trace = recorded(
        "nodes: [{node: nodes_of_replay:Source}]\nstop: {function: nodes_of_replay:late}\n",
        "def late(progress):\n    return progress.now_ns > 2 * 10**9\n",
    )
    file = tmp_path / "nodes_of_replay.py"
    file.write_text(file.read_text().replace("2 * 10**9", "10**9"))
    result = rsltrace.replay(trace, trust=True)
    assert result.diff is not None
    assert result.diff.verdict.value == "ended-early"
    file.write_text(file.read_text().replace("10**9", "3 * 10**9"))
    result = rsltrace.replay(trace, trust=True)
    assert result.diff is not None
    assert result.diff.verdict.value in ("ran-longer", "extra")


def test_a_node_that_asks_more_from_outside_than_it_did(
    recorded: Callable[..., Path], tmp_path: Path
) -> None:
    job = (
        "nodes: [{node: nodes_of_replay:Source}]\nstop: {duration: 1s}\n"
        "guard: {environment: record}\n"
    )
    trace = recorded(job)
    code = NODES.replace("self.count += 1", "self.count += len(os.environ.get('HOME', 'x'))")
    (tmp_path / "nodes_of_replay.py").write_text(code)
    result = rsltrace.replay(trace, trust=True)
    assert result.diverged
    assert "has no further answer" in str(result.error)
