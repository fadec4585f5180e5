"""Chains of a run: in the overview, and as plots of their latencies."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rsltrace_viewer.model import chains
from rsltrace_viewer.model.chains import read_chains
from rsltrace_viewer.model.plots.series import CHAIN_AGE, CHAIN_LATENCY, PlotSource, series_of
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.terminal.screens.overview import OverviewScreen
from trace_maker import MS, START_NS, Opened

from rsltrace import measure_latencies
from rsltrace.trace.format import ATTACHMENT_JOB
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventKind, OutputKind

Drive = Callable[..., None]
SAMPLE = Path(__file__).parents[2] / "sample_traces" / "nondeterministic_callback" / "a.mcap"
_JOB = """\
nodes: [{node: m:N}]
checks:
  - latency: {from: /raw, to: /cmd, via: [/driver], below: 1s}
"""


@pytest.fixture
def slow_once(tmp_path: Path) -> Path:
    """A run of ten chains /raw → /filtered, of which the fourth takes 40 ms instead of 5, and of a
    timer that publishes /cmd."""
    path = tmp_path / "slow.mcap"
    with Opened(path) as feeder:
        feeder.writer.add_attachment(ATTACHMENT_JOB, "application/yaml", _JOB.encode())
        nodes = [feeder.entity(EntityKind.NODE, name) for name in ("/lidar", "/filter", "/driver")]
        timer, tick = (feeder.entity(EntityKind.TIMER, "t", node=nodes[n]) for n in (0, 2))
        raw, filtered, command = (
            feeder.entity(EntityKind.PUBLISHER, topic, node=node)
            for topic, node in zip(("/raw", "/filtered", "/cmd"), nodes, strict=True)
        )
        heard, last = (
            feeder.entity(EntityKind.SUBSCRIPTION, topic, node=nodes[n])
            for topic, n in (("/raw", 1), ("/filtered", 2))
        )
        for round_ in range(10):
            now_ns = START_NS + 100 * MS * round_
            for sender, entity, later_ns, cause in (
                (raw, timer, 0, None),
                (filtered, heard, (40 if round_ == 3 else 5) * MS, -1),
                (None, last, 45 * MS, -1),
                (command, tick, 50 * MS, None),
            ):
                if sender is not None:
                    feeder.output(OutputKind.MESSAGE, sender, b"x")
                kind = EventKind.TIMER if cause is None else EventKind.SUBSCRIPTION
                of = (NO_EVENT if cause is None else len(feeder.events) + cause, 0)
                feeder.event(kind, entity, now_ns + later_ns, cause=of)
        feeder.writer.close(result={"stop_reason": "done", "exit_code": "0"})
    return path


def test_chains_of_causes_and_those_that_checks_are_about(slow_once: Path) -> None:
    run = Run.open(slow_once)
    by_cause, by_check = list(read_chains(run))[-1]
    assert (by_cause.name, by_cause.slowest) == ("/raw → /filtered", 13)
    assert by_check.name == "/raw → /filtered → /cmd via /driver"
    assert by_check.latency is not None
    assert (by_check.latency.min_ns, by_check.latency.max_ns) == (50 * MS, 50 * MS)
    assert by_check.oldest_ns == 150 * MS
    for kind, name, measure in (
        (CHAIN_LATENCY, by_cause.name, "latency"),
        (CHAIN_AGE, by_check.name, "age"),
    ):
        series = list(series_of(run, PlotSource(kind, name)))[-1]
        (chain,) = measure_latencies(
            run.trace,
            topics=name.partition(" via ")[0].split(" → "),
            via=["/driver"] if "via" in name else [],
        ).chains
        assert series.values.tolist() == [ns / MS for ns in chain.durations(measure).tolist()]
        assert series.times.tolist() == [ns / 1e9 for ns in chain.found.output_ns.tolist()]
    gone = list(series_of(run, PlotSource(CHAIN_AGE, "/raw → /gone")))[-1]
    assert gone.note.startswith("nobody publishes /gone")
    run.close()


def test_the_overview_leads_to_the_slowest_of_a_chain_and_plots_it(
    slow_once: Path, drive: Drive
) -> None:
    async def steps(viewer: Any) -> None:
        assert isinstance(viewer.app.screen, OverviewScreen)
        shown = [one.strip() for one in viewer.text.splitlines()]
        place = next(n for n, line in enumerate(shown) if line.startswith("/raw → /filtered "))
        assert shown[place].endswith("5 ms, 40 ms, 140 ms")
        await viewer.press(*["j"] * (place - 1), "enter")
        assert viewer.app.session.current()[1] == 13
        names = [one.label for one in viewer.app.session.plots().others()]
        assert "chain latency of /raw → /filtered" in names
        assert "data age at the end of /raw → /filtered → /cmd via /driver" in names

    drive(slow_once, steps, overview=True)


def test_long_runs_are_not_searched_for_chains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run.open(Path(shutil.copy(SAMPLE, tmp_path / "a.mcap")))
    assert [one.name for one in list(read_chains(run))[-1]] == ["/scan → /push → /cmd_vel"]
    monkeypatch.setattr(chains, "EVENTS_MAX", 10)
    assert list(read_chains(run)) == []
    run.close()
