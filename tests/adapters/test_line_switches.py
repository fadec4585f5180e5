"""``threads: {switch: every_line}``: threads take turns at lines of user code, as a policy says."""

from __future__ import annotations

import gc
import json
import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Int32

from rsltrace.errors import NodeError, RunError
from rsltrace.run.plans.recorded_order import ATTACHMENT_CHOICES
from rsltrace.simulation.loop.policy import Candidate, ChoicePoint, decode_choices
from rsltrace.trace.model.event import is_switch
from tests.forked_command import Forks

pytestmark = pytest.mark.ros
LINES = {"threads": {"switch": "every_line"}}


class Turns:
    """Lets another one run whenever there is one: the one that has waited longest."""

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        return len(ready) > 1 and ready[0].kind == "resume"


def switched(recorded: Any) -> list[str]:
    """The lines of this file before which others went on."""
    with recorded.trace() as trace:
        lines = Path(__file__).read_text().splitlines()
        marked = [o for i in range(trace.event_count) for o in trace.outputs_of(i)]
        places = list(trace.switches.values())
        assert len(places) == sum(o.kind.label == "draw" and is_switch(o.hash) for o in marked)
    assert all("test_line_switches.py:" in place for place in places), places
    return [lines[int(place.rpartition(":")[2]) - 1].strip() for place in places]


class Tally(Node):  # type: ignore[misc]
    """Three threads count to one each; what they have counted is said."""

    def __init__(self) -> None:
        super().__init__("tally")
        self.count = 0
        self.publisher = self.create_publisher(Int32, "count", 10)
        self.timer = self.create_timer(0.1, self.begin)

    def begin(self) -> None:
        self.timer.cancel()
        threads = [threading.Thread(target=self.add) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        self.publisher.publish(Int32(data=self.count))

    def add(self) -> None:
        count = self.count
        for step in (1, 0, 0):
            count += step
        self.count = count


class LockedTally(Tally):
    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()

    def add(self) -> None:
        with self.lock:
            super().add()


def count_of(recorded: Any) -> int:
    with recorded.trace() as trace:
        *_, (_, _, data) = trace.messages("/count")
        return int(trace.decode("/count", data).data)


@pytest.mark.long
def test_threads_take_turns_at_lines_and_lose_updates_only_without_a_lock(simulate: Any) -> None:
    plain = simulate(Tally, duration=0.2)
    digest = plain.result.digest
    assert count_of(plain) == 3
    assert simulate(Tally, duration=0.2, job=LINES).result.digest == digest  # fifo: all go on
    policy = {"policy": {"function": Turns}}
    assert simulate(Tally, duration=0.2, job=policy).result.digest == digest  # off: nobody is asked
    lost = simulate(Tally, duration=0.2, job={**LINES, **policy})
    assert count_of(lost) == 1
    assert "self.count = count" in switched(lost)
    again = simulate(Tally, duration=0.2, job={**LINES, **policy})
    assert again.result.digest == lost.result.digest
    locked = simulate(LockedTally, duration=0.2, job={**LINES, **policy})
    assert count_of(locked) == 3
    assert "count = self.count" in switched(locked)


@pytest.mark.long
def test_one_departure_is_one_switch_and_cat_and_diff_name_its_line(
    simulate: Any, tmp_path: Path, forks: Forks
) -> None:
    def told(*words: str) -> tuple[int, str]:
        done = forks.run(list(words), tmp_path, dict(os.environ), 300)
        return done.returncode, done.stdout

    for count in (0, 1):
        departures = [{"choice": 1, "run": 1}][:count]
        job = {**LINES, "policy": {"departures": departures}}
        simulate(Tally, duration=0.2, job=job).path.rename(tmp_path / f"{count}.mcap")
    line = Path(__file__).read_text().splitlines().index("        for step in (1, 0, 0):") + 1
    place = f"tests/adapters/test_line_switches.py:{line}"
    assert "goes on before" not in told("cat", "0.mcap")[1]
    assert told("cat", "1.mcap")[1].count(f"another thread goes on before {place}") == 1
    rows = map(json.loads, told("cat", "1.mcap", "--json")[1].splitlines())
    outputs = [output for row in rows for output in row["outputs"]]
    assert [output["code"] for output in outputs if output["kind"] == "draw"] == [[place]]
    status, text = told("diff", "0.mcap", "1.mcap")
    words = " ".join(text.split())
    assert status == 1
    assert "verdict: schedule" in words
    assert f"switched to another thread before {place} in b but not in a" in words


class Sides(Node):  # type: ignore[misc]
    """Publishes on two topics at once, and twice on the first."""

    def __init__(self) -> None:
        super().__init__("sides")
        sides = [self.create_publisher(Int32, topic, 10) for topic in "aab"]
        self.create_timer(0.1, lambda: [one.publish(Int32()) for one in sides])


class Sums(Node):  # type: ignore[misc]
    """Counts what comes, and says after each how many callbacks are under way."""

    def __init__(self, group: Any = None) -> None:
        super().__init__("sums")
        self.inside = self.most = 0
        for topic in "ab":
            self.create_subscription(Int32, topic, self.hear, 10, callback_group=group)

    def hear(self, message: Int32) -> None:
        self.inside += 1
        self.most = max(self.most, self.inside)
        self.inside -= 1


MOST: list[Sums] = []


def single() -> None:
    rclpy.init()
    MOST.append(Sums())
    rclpy.spin(MOST[-1])


def many() -> None:
    rclpy.init()
    MOST.append(Sums(ReentrantCallbackGroup()))
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(MOST[-1])
    executor.spin()


def reentrant() -> Sums:
    MOST.append(Sums(ReentrantCallbackGroup()))
    return MOST[-1]


def exclusive() -> Sums:
    MOST.append(Sums())
    return MOST[-1]


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("runs", "job", "most"),
    [
        (exclusive, {}, 1),
        (reentrant, {}, 3),
        (reentrant, {"executors": "per_node"}, 1),
        (reentrant, {"executors": [{"workers": 2}]}, 2),
        (single, {}, 1),
        (many, {}, 3),
    ],
)
def test_callbacks_overlap_where_groups_and_executors_let_them(
    simulate: Any, runs: Callable[[], Any], job: dict[str, Any], most: int
) -> None:
    from rsltrace import NodeSpec

    runner = NodeSpec(main=runs) if runs in (single, many) else NodeSpec(node=runs)
    policy = {"policy": {"function": Turns}, **job}
    recorded = simulate(Sides, runner, duration=0.15, job={**LINES, **policy})
    assert MOST.pop().most == most
    assert bool(switched(recorded)) == (most > 1)


def test_pct_and_a_recorded_order_switch_between_callbacks_of_one_subscription(
    simulate: Any, tmp_path: Path
) -> None:
    found = []
    for seed in range(12):
        policy = {"seed": seed, "policy": {"pct": {"depth": 3, "choices": 10}}}
        recorded = simulate(Sides, reentrant, duration=0.15, job={**LINES, **policy})
        found.append(MOST.pop().most)
        if found[-1] > 1:
            break
    assert found[-1] > 1
    with recorded.trace() as trace:
        assert any(decode_choices(trace.attachment(ATTACHMENT_CHOICES) or b""))
    kept = recorded.path.rename(tmp_path / "kept.mcap")
    again = simulate(
        Sides, reentrant, duration=0.15, job={**LINES, "policy": {"recorded": kept.name}}
    )
    assert again.result.digest == recorded.result.digest


class Uneasy(Tally):
    """Its threads do what must not be interrupted."""

    def add(self) -> None:
        class Left:
            def __del__(inner) -> None:  # noqa: N805
                self.count += 0
                self.count += 0

        import tests.adapters.imported_by_a_thread  # noqa: F401

        Left()
        json.dumps([Left()], default=str)
        gc.collect()


def test_finalizers_and_imports_are_not_interrupted(simulate: Any) -> None:
    recorded = simulate(Uneasy, duration=0.2, job={**LINES, "policy": {"function": Turns}})
    assert not [line for line in switched(recorded) if line == "self.count += 0"]


class Bad:
    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        if ready[0].kind == "resume" and len(ready) > 1:
            raise ValueError("at a line")
        return 0


class Catcher(Tally):
    def add(self) -> None:
        try:
            super().add()
        except Exception as error:
            raise AssertionError("a policy's trouble is not the node's") from error


def test_a_policy_that_raises_at_a_line_ends_the_run_and_is_not_for_user_code_to_catch(
    simulate: Any,
) -> None:
    with pytest.raises(RunError, match="the policy Bad raised ValueError: at a line") as raised:
        simulate(Catcher, duration=0.2, job={**LINES, "policy": {"function": Bad}})
    assert not isinstance(raised.value, NodeError)


class Raiser(Tally):
    def add(self) -> None:
        self.count += 1
        if self.count == 3:
            raise ValueError("while others wait for their turn")
        self.count += 0


def test_who_waits_for_its_turn_is_unwound_when_the_run_fails(simulate: Any) -> None:
    with pytest.raises(NodeError, match="while others wait"):
        simulate(Raiser, duration=0.2, job={**LINES, "policy": {"function": Turns}})
    assert count_of(simulate(Tally, duration=0.2)) == 3  # and the next run is as any other


@pytest.mark.long
def test_a_single_node_of_such_a_run_is_not_replayed(
    simulate: Any, forks: Forks, tmp_path: Path
) -> None:
    simulate(Tally, duration=0.2, job=LINES)
    words = ["replay", "run.mcap", "--node", "/tally", "--trust"]
    done = forks.run(words, tmp_path, dict(os.environ), 300)
    assert done.returncode == 2
    assert "it replays as a whole only" in done.stderr
