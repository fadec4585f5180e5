"""Two runs of one job stopped at different times diverge by ending, whatever the job has."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

import rclpy
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import UInt64

import rsltrace
from rsltrace.diff.facts.causes import Root, Verdict
from rsltrace.diff.result import Diff
from rsltrace.run import run

pytestmark = pytest.mark.ros

MS = 1_000_000


class Talker(Node):
    def __init__(self, name: str, period_s: float) -> None:
        super().__init__(name)
        self.publisher = self.create_publisher(UInt64, "numbers", 10)
        self.create_subscription(UInt64, "numbers", lambda message: None, 10)
        self.count = 0
        self.create_timer(period_s, self.tick)

    def tick(self) -> None:
        self.count += 1
        self.publisher.publish(UInt64(data=self.count))


class LastWords(Talker):
    """Says something when it is destroyed."""

    def destroy_node(self) -> None:
        self.get_logger().info(f"{self.count} ticks")
        super().destroy_node()


class Sleeper(Talker):
    """Is asleep most of the time, in a callback."""

    def tick(self) -> None:
        time.sleep(0.17)
        super().tick()


def spinning(name: str, period_s: float) -> None:
    rclpy.init()
    node = LastWords(name, period_s)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.get_logger().info("told to end")
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def careless(name: str, period_s: float) -> None:
    rclpy.init()
    rclpy.get_default_context().on_shutdown(lambda: None)
    rclpy.spin(Talker(name, period_s))


def beside_a_thread(name: str, period_s: float) -> None:
    rclpy.init()
    node = Talker(name, period_s)
    thread = threading.Thread(target=rclpy.spin, args=(node,))
    thread.start()
    while rclpy.ok():
        time.sleep(period_s * 1.3)
        node.publisher.publish(UInt64(data=0))
    thread.join()
    node.get_logger().info("joined")


def with_a_daemon(name: str, period_s: float) -> None:
    def work() -> None:
        while True:
            time.sleep(period_s / 2)
            node.publisher.publish(UInt64(data=1))

    rclpy.init()
    node = Talker(name, period_s)
    threading.Thread(target=work, daemon=True).start()
    executor = MultiThreadedExecutor(2)
    executor.add_node(node)
    try:
        executor.spin()
    finally:
        executor.shutdown()


def brief(name: str, period_s: float) -> None:
    rclpy.init()
    node = Talker(name, period_s)
    for _ in range(3):
        rclpy.spin_once(node, timeout_sec=period_s)
    node.destroy_node()
    rclpy.shutdown()


CLASSES: list[Callable[..., Any]] = [Talker, LastWords, Sleeper]
MAINS: list[Callable[..., Any]] = [spinning, careless, beside_a_thread, with_a_daemon, brief]
PARTS = st.tuples(st.sampled_from(CLASSES + MAINS), st.sampled_from([0.05, 0.13, 0.3]))


def spec(kind: Callable[..., Any], name: str, period_s: float) -> rsltrace.NodeSpec:
    if kind in CLASSES:
        return rsltrace.NodeSpec(node=kind, arguments={"name": name, "period_s": period_s})
    return rsltrace.NodeSpec(main=lambda: kind(name, period_s))


def compared(folder: Path, parts: Any, stops: list[dict[str, Any]]) -> Diff:
    for file, stop in zip(("a.mcap", "b.mcap"), stops, strict=True):
        nodes = [spec(kind, f"n{i}", period_s) for i, (kind, period_s) in enumerate(parts)]
        job = rsltrace.Job(nodes=nodes, stop=rsltrace.StopSpec(**stop))
        result = rsltrace.record(job, folder / file, force=True)
        assert result.error is None
    return rsltrace.diff(folder / "a.mcap", folder / "b.mcap")


@pytest.mark.long
@settings(max_examples=4, deadline=None)
@given(
    parts=st.lists(PARTS, min_size=1, max_size=3),
    first_ms=st.integers(0, 900),
    more_ms=st.integers(1, 400),
    by_events=st.booleans(),
)
def test_a_run_that_was_stopped_earlier_ended_early(
    tmp_path_factory: pytest.TempPathFactory,
    parts: Any,
    first_ms: int,
    more_ms: int,
    by_events: bool,
) -> None:
    longer: dict[str, Any] = {"duration": f"{first_ms + more_ms}ms"}
    shorter: dict[str, Any] = {"duration": f"{first_ms}ms"}
    if by_events:
        shorter = {**longer, "events": 1 + first_ms // 30}
    folder = tmp_path_factory.mktemp("ended")
    diff = compared(folder, parts, [longer, shorter])
    if diff.a.digest == diff.b.digest:
        assert diff.a.end_ns == diff.b.end_ns  # nothing happens between the two ends
        return
    assert diff.verdict is Verdict.ENDED_EARLY, diff.sentence
    assert diff.divergences[0].root is Root.JOB
    assert "stop." in diff.divergences[0].root_sentence
    turned = rsltrace.diff(folder / "b.mcap", folder / "a.mcap")
    assert turned.verdict is Verdict.RAN_LONGER


def test_a_main_that_raises_in_one_run_is_no_early_end(tmp_path: Path) -> None:
    class Raising(Talker):
        def tick(self) -> None:
            super().tick()
            if self.count == 3 and broken:
                raise ValueError("broken")

    def main() -> None:
        rclpy.init()
        rclpy.spin(Raising("raising", 0.1))

    for name, broken in (("a.mcap", False), ("b.mcap", True)):  # noqa: B007
        job = rsltrace.Job(
            nodes=[rsltrace.NodeSpec(main=main), spec(spinning, "other", 0.1)],
            stop=rsltrace.StopSpec(duration="1s"),
        )
        run(job, tmp_path / name)
    diff = rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert diff.verdict is Verdict.EXCEPTION, diff.sentence


@pytest.mark.long
@pytest.mark.parametrize("kept", ["a", "b"])
def test_a_run_that_ended_since_its_last_timer_is_gone_tells_the_timer(
    tmp_path: Path, kept: str
) -> None:
    class Ending(Talker):
        def tick(self) -> None:
            super().tick()
            if self.count == 3 and gone:
                self.destroy_timer(next(self.timers))

    for name in ("a", "b"):
        gone = name != kept
        job = rsltrace.Job(
            nodes=[rsltrace.NodeSpec(node=Ending, arguments={"name": "ending", "period_s": 0.1})],
            stop=rsltrace.StopSpec(duration="1s"),
        )
        run(job, tmp_path / f"{name}.mcap")
    diff = rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert diff.verdict is (Verdict.ENDED_EARLY if kept == "a" else Verdict.RAN_LONGER)
    why = diff.divergences[0].root_sentence
    assert "nothing left to do: timer " in why, why
    assert f"Ending.tick of /ending at 0.4 s is only in {kept}; " in why, why
    assert why.endswith("/ending is not deterministic"), why
