"""What an answer of ``why`` says in detail."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.diff.why.answer import evidence, sentence, why
from rsltrace.diff.why.filters import _spread
from rsltrace.errors import TraceError
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.finding import decode_drops
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.phrases import exception_of

_TOPICS = st.lists(st.lists(st.integers(0, 50), min_size=1, max_size=4), min_size=2, max_size=3)


@given(_TOPICS)
def test_the_nearest_stamps_are_those_of_all_choices(topics: list[list[int]]) -> None:
    choices: list[list[int]] = [[]]
    for stamps in topics:
        choices = [[*chosen, stamp] for chosen in choices for stamp in stamps]
    assert _spread(topics) == min(max(chosen) - min(chosen) for chosen in choices)


def test_an_exception_of_several_lines_keeps_its_type_and_message() -> None:
    frame = '  File "a.py", line 3, in tick\n    raise ValueError(text)\n    ^^^^^\n'
    text = f"Traceback (most recent call last):\n{frame}ValueError: bad\n second line"
    assert exception_of(text) == "ValueError: bad second line"


@pytest.fixture
def two_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of two robots of one name, of which the second sends the first a goal each 0.1 s."""
    (tmp_path / "robots.py").write_text(
        "from rclpy.action import ActionClient, ActionServer\n"
        "from rclpy.node import Node\n"
        "from test_msgs.action import Fibonacci\n"
        "class Robot(Node):\n"
        "    def __init__(self, **keywords):\n"
        "        super().__init__('mover', **keywords)\n"
        "        if self.get_namespace() == '/one':\n"
        "            self.server = ActionServer(self, Fibonacci, 'drive', self.drive)\n"
        "        else:\n"
        "            self.client_ = ActionClient(self, Fibonacci, '/one/drive')\n"
        "            self.create_timer(0.1, self.tick)\n"
        "    def drive(self, goal):\n"
        "        goal.succeed()\n"
        "        return Fibonacci.Result()\n"
        "    def tick(self):\n"
        "        self.client_.send_goal_async(Fibonacci.Goal()).add_done_callback(id)\n"
    )
    (tmp_path / "job.yaml").write_text(
        "nodes:\n"
        "  - {node: robots:Robot, namespace: /one}\n"
        "  - {node: robots:Robot, namespace: /two}\n"
        "stop: {duration: 1s}\n"
    )
    monkeypatch.chdir(tmp_path)
    run(load_job("job.yaml"), "run.mcap")
    return tmp_path / "run.mcap"


@pytest.mark.ros
def test_a_name_may_be_relative_and_is_never_guessed(two_robots: Path) -> None:
    with Trace.open(two_robots) as trace:
        with pytest.raises(TraceError, match="'mover' matches /one/mover, /two/mover: give the"):
            why(trace, "mover", "drive")
        with pytest.raises(
            TraceError, match=r"several drive; .*\(service /one/drive/_action/c.*l\)"
        ):
            why(trace, "/one/mover", "drive")
        assert why(trace, "/one/mover", "send_goal").question.entity.name.endswith("/send_goal")


@pytest.mark.ros
def test_a_goal_is_counted_once_and_up_to_the_time_asked_about(two_robots: Path) -> None:
    with Trace.open(two_robots) as trace:
        for node, by in (("/one/mover", "client"), ("/two/mover", "service")):
            reason = why(trace, node, "/one/drive/_action/send_goal", 350_000_000)
            assert "ran as expected, 3 times, last at 0.3 s" in sentence(reason)
            sent = next(evidence(reason))
            assert sent.startswith(f"sent: 3 by {by} ")
            assert sent.endswith("received: 3")


@pytest.mark.ros
def test_a_topic_with_two_callbacks_is_not_answered_for_one_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "twice.py").write_text(
        "from rclpy.node import Node\n"
        "from std_msgs.msg import String\n"
        "class Twice(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('twice')\n"
        "        self.create_subscription(String, '/x', self.one, 1)\n"
        "        self.create_subscription(String, '/x', self.other, 1)\n"
        "    def one(self, m): pass\n"
        "    def other(self, m): pass\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: twice:Twice}]\nstop: {duration: 1s}\n")
    monkeypatch.chdir(tmp_path)
    run(load_job("job.yaml"), "run.mcap")
    with Trace.open("run.mcap") as trace:
        with pytest.raises(TraceError, match=r"several /x; .*Twice\.one.*Twice\.other"):
            why(trace, "/twice", "/x")
        assert why(trace, "/twice", "one") is not None


_BURSTS = """
import time
from rclpy.node import Node
from std_msgs.msg import String

class Sends(Node):
    def __init__(self):
        super().__init__("sends")
        self.publishers_there = [self.create_publisher(String, name, 50) for name in ("/a", "/b")]
        self.timer = self.create_timer(1.0, self.tick)

    def tick(self):
        self.timer.cancel()
        for _ in range(5):
            self.publishers_there[0].publish(String())
        self.publishers_there[1].publish(String())

class Hears(Node):
    def __init__(self):
        super().__init__("hears")
        self.create_subscription(String, "/a", self.slow, 50)
        self.create_subscription(String, "/b", self.waits, 50)

    def slow(self, message): pass
    def waits(self, message): pass
"""
_BURSTS_JOB = """
nodes: [{node: bursts:Sends}, {node: bursts:Hears}]
execution: {entities: [{node: /hears, entity: /a, constant: 30ms}]}
stop: {duration: 3s}
"""


@pytest.mark.ros
def test_a_callback_that_waited_for_several(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bursts.py").write_text(_BURSTS)
    (tmp_path / "job.yaml").write_text(_BURSTS_JOB)
    monkeypatch.chdir(tmp_path)
    run(load_job("job.yaml"), "run.mcap")
    with Trace.open("run.mcap") as trace:
        late = why(trace, "/hears", "waits", trace.start_ns + 10**9).words()
        assert late.startswith("subscription /b of /hears was 150 ms late: subscription /a of")
        assert late.endswith(" ran from 1.0 s to 1.03 s, and 4 more callbacks")
        before = why(trace, "/sends", "tick", trace.start_ns + 5 * 10**8).words()
        assert before == (
            "timer Sends.tick of /sends did not run until then, as expected: first at 1.0 s"
        )


@pytest.mark.ros
def test_a_timer_of_period_0_is_not_late_every_millisecond(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "restless.py").write_text(
        "from rclpy.node import Node\n"
        "class Restless(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('restless')\n"
        "        self.create_timer(0.0, self.tick)\n"
        "    def tick(self): pass\n"
    )
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: restless:Restless}]\nexecution: {default: 10us}\nstop: {duration: 5ms}\n"
    )
    monkeypatch.chdir(tmp_path)
    run(load_job("job.yaml"), "run.mcap")
    with Trace.open("run.mcap") as trace:
        assert "ran as expected, 6 times" in why(trace, "/restless", "tick").words()


_FIB = """
from example_interfaces.action import Fibonacci
from rclpy.action import ActionClient, ActionServer
from rclpy.node import Node

class Serves(Node):
    def __init__(self):
        super().__init__("serves")
        self.server = ActionServer(self, Fibonacci, "/fib", self.execute)

    def execute(self, goal):
        goal.succeed()
        return Fibonacci.Result()

class Asks(Node):
    def __init__(self):
        super().__init__("asks")
        self.client = ActionClient(self, Fibonacci, "/fib")
        self.timer = self.create_timer(1.0, self.tick)

    def tick(self):
        self.client.send_goal_async(Fibonacci.Goal())
"""
_FIB_JOB = """
nodes: [{node: fib:Serves}, {node: fib:Asks}]
execution: {nodes: {/asks: 300ms}}
stop: {duration: 5.5s}
"""


@pytest.mark.ros
def test_an_action_is_found_by_its_name_and_counted_by_its_goals(
    tmp_path: Path, command: Callable[..., CompletedProcess[str]]
) -> None:
    (tmp_path / "fib.py").write_text(_FIB)
    (tmp_path / "job.yaml").write_text(_FIB_JOB)
    result = run(load_job("job.yaml"), "run.mcap")
    assert result.error is None
    assert not any("full queues" in note for note in result.notes), "the latest status is enough"
    entities = json.loads(command("info", "run.mcap", "--json").stdout)["entities"]
    (goals,) = [
        one
        for one in entities
        if (one["name"], one["kind"]) == ("/fib/_action/send_goal", "service")
    ]
    assert (goals["events"], goals["rate_hz"]) == (10, 1.0)
    with Trace.open("run.mcap") as trace:
        assert decode_drops(trace.result)
        for name in ("fib", "/fib"):
            with pytest.raises(TraceError, match=r"several /?fib; .*service /fib/_action"):
                why(trace, "/serves", name)
    asked = command("why", "run.mcap", "/asks")
    assert asked.returncode == 2
    assert "name a topic or callback of /asks; there are" in asked.stderr
    assert ", Asks.tick" in asked.stderr


def test_of_a_run_that_was_cut_before_its_first_event_nothing_ran(
    tmp_path: Path, command: Callable[..., CompletedProcess[str]]
) -> None:
    whole = Path(__file__).parents[2].joinpath("sample_traces/missing_event/b.mcap").read_bytes()
    for kept in range(0, len(whole), 500):
        (tmp_path / "cut.mcap").write_bytes(whole[:kept])
        asked = command("why", "cut.mcap", "/picker", "/close")
        if asked.returncode != 2:  # the first cut with the graph, and yet without an event
            break
    assert "client /close of /picker has sent nothing (picker.py:" in asked.stdout


@pytest.mark.ros
def test_a_timer_that_is_destroyed_did_not_run_as_expected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "short.py").write_text(
        "from rclpy.node import Node\n"
        "class Short(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('short')\n"
        "        self.count = 0\n"
        "        self.timer = self.create_timer(0.1, self.tick)\n"
        "        self.create_timer(0.1, lambda: None)\n"
        "    def tick(self):\n"
        "        self.count += 1\n"
        "        if self.count == 3: self.destroy_timer(self.timer)\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: short:Short}]\nstop: {duration: 1s}\n")
    monkeypatch.chdir(tmp_path)
    run(load_job("job.yaml"), "run.mcap")
    with Trace.open("run.mcap") as trace:
        at = {tenths: why(trace, "/short", "tick", tenths * 10**8) for tenths in (3, 4, 8, 90)}
    assert "ran as expected, 3 times" in at[3].words()
    assert not at[4].is_reason
    for later in (8, 90):
        assert "was destroyed" in at[later].words()
        assert "did not run after 0.3 s, and its period is 100 ms" in at[later].words()


@pytest.mark.ros
def test_after_the_end_of_a_run_nothing_is_expected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "echo.py").write_text(
        "from rclpy.node import Node\n"
        "from std_msgs.msg import String\n"
        "class Echo(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('echo')\n"
        "        out = self.create_publisher(String, '/x', 1)\n"
        "        self.create_timer(0.1, lambda: out.publish(String()))\n"
        "        self.create_subscription(String, '/x', self.heard, 1)\n"
        "    def heard(self, m): pass\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: echo:Echo}]\nstop: {duration: 1s}\n")
    monkeypatch.chdir(tmp_path)
    run(load_job("job.yaml"), "run.mcap")
    with Trace.open("run.mcap") as trace:
        found = why(trace, "/echo", "heard", 9 * 10**9)
    assert "was due at 9.0 s, and the run ended at 1.0 s" in found.words()
    assert not found.is_reason
