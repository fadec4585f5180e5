"""What a search lets bags play instead can all be played, and is the same when runs are forked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # noqa: E402
from rclpy.node import Node  # noqa: E402
from sensor_msgs.msg import Image, LaserScan  # noqa: E402

from campaigns.explore.suite import BUGS  # noqa: E402
from rsltrace.adapters.rclpy.messages.codec import codec_for  # noqa: E402
from rsltrace.errors import BagError  # noqa: E402
from rsltrace.job import Job, NodeSpec, StopSpec  # noqa: E402
from rsltrace.run import record  # noqa: E402
from rsltrace.run.plans.faults import (  # noqa: E402
    FieldChangeError,
    check_changes,
    field_changer,
)
from rsltrace.search.explore.outcome import TrialOptions  # noqa: E402
from rsltrace.search.explore.strategies.faults import FaultWalk  # noqa: E402
from rsltrace.search.explore.trial import JobSource, Trial, TrialResult  # noqa: E402
from rsltrace.search.explore.workers import Worker  # noqa: E402

STATUS = [DiagnosticStatus(values=[KeyValue(key="a")]), DiagnosticStatus(level=b"\2")]
MESSAGES: dict[str, Any] = {
    "/scan": LaserScan(ranges=[1.0, 2.0, 3.0]),
    "/diagnostics": DiagnosticArray(status=STATUS),
    "/image": Image(width=2, height=2, data=b"abcd", encoding="mono8"),
}


class Talker(Node):
    def __init__(self) -> None:
        super().__init__("talker")
        self.ends = [self.create_publisher(type(m), name, 10) for name, m in MESSAGES.items()]
        self.create_timer(0.1, self.tick)

    def tick(self) -> None:
        for end, message in zip(self.ends, MESSAGES.values(), strict=True):
            end.publish(message)


@pytest.mark.long
def test_changes_that_a_search_tries_fit_the_types_and_hit_all_fields(tmp_path: Path) -> None:
    record(Job(nodes=[NodeSpec(node=Talker)], stop=StopSpec(duration=0.45)), tmp_path / "bag.mcap")
    job = Job(bags=[{"path": str(tmp_path / "bag.mcap")}], progress="/progress")
    record(job, tmp_path / "plain.mcap")
    walk = FaultWalk(job, 1)
    walk.begin(TrialResult(Trial(0, {}), trace=str(tmp_path / "plain.mcap")))
    kinds, fields = set(), set()
    for number in range(1, 500):
        proposal = walk.propose(number)
        assert proposal is not None
        trial = job.replace(faults=proposal.overlay["faults"])
        for fault in trial.faults:
            kinds.add(fault.kind)
            assert fault.name in MESSAGES or not fault.of_bag
            assert 1 <= (fault.message or 0) <= 4 or fault.name == "/progress"
            if fault.change is not None:
                fields.add(f"{fault.name} {fault.field}")
                message = MESSAGES[fault.name]
                cls = type(message)
                check_changes(trial, fault.name, cls)
                try:
                    field_changer(cls, fault)(codec_for(cls).serialize(message))
                except FieldChangeError:
                    assert "values[" in str(fault.field), "only the first status has some"
    assert kinds == {"drop", "delay", "duplicate", "change", "swap", "repeat"}
    assert {"/scan ranges", "/scan ranges[*]", "/scan header.frame_id", "/image data"} <= fields
    assert any("values[0].key" in field for field in fields)


def test_a_change_that_cannot_be_names_its_place() -> None:
    fault = {"change": "/scan", "message": 1, "field": "ranges", "value": 1}
    with pytest.raises(BagError, match=r"faults\[0\]: ranges is an array"):
        check_changes(Job(nodes=[NodeSpec(node=Talker)], faults=[fault]), "/scan", LaserScan)


@pytest.mark.long
def test_forked_runs_of_bags_that_change_are_those_from_the_beginning(tmp_path: Path) -> None:
    source = JobSource(str(BUGS / "bags" / "nan_poisons_average" / "job.yaml"))
    change = {"change": "/range", "field": "range", "value": "nan"}
    with Worker(source) as worker:
        worker.run(Trial(0, {}), tmp_path / "plain.mcap", TrialOptions(), 300)
        for number, (fault, is_forked) in enumerate(
            [
                ({**change, "message": 30}, True),
                ({"swap": "/range", "message": 30}, True),
                ({"repeat": "/range", "message": 25}, True),
                ({**change, "message": 5}, False),
            ],
            start=1,
        ):
            trial = Trial(number, {"faults": [fault]})
            forked, whole = (tmp_path / f"{name}{number}.mcap" for name in ("forked", "whole"))
            found = worker.run(trial, forked, TrialOptions(keep=True, fork_ns=1_000_000_000), 300)
            assert found.is_forked == is_forked, found.why_not_forked
            worker.run(trial, whole, TrialOptions(keep=True), 300)
            assert forked.read_bytes() == whole.read_bytes()
