"""The trace says from which line each output came, and which function ran where that varies."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from rsltrace.cli.main import cli
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.code import code_place, output_places

pytestmark = pytest.mark.ros

PROGRAM = """\
import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci


class Server(Node):
    def __init__(self):
        super().__init__("server")
        self.create_service(Trigger, "go", lambda request, response: response)  # serve
        self.action = ActionServer(self, Fibonacci, "fib", self.execute)

    def execute(self, goal):  # executes
        goal.publish_feedback(Fibonacci.Feedback())  # feedback
        goal.succeed()
        return Fibonacci.Result()


class Caller(Node):
    def __init__(self):
        super().__init__("caller")
        self.declare_parameter("speed", 1.0)
        self.pub = self.create_publisher(String, "chat", 10)
        self.client = self.create_client(Trigger, "go")
        self.waits = self.create_client(Trigger, "go")
        self.action = ActionClient(self, Fibonacci, "fib")
        self.ticks = 0
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.ticks += 1
        if self.ticks % 2:
            self.pub.publish(String(data="a"))  # odd
        else:
            self.pub.publish(String(data="b"))  # even
        for _ in range(2):
            send(self.pub, "c")
        self.client.call_async(Trigger.Request()).add_done_callback(self.on_answer)  # calls
        self.executor.create_task(self.work)
        if self.ticks == 1:
            sent = self.action.send_goal_async(  # goal
                Fibonacci.Goal(), feedback_callback=self.on_feedback
            )
            sent.add_done_callback(self.on_goal)
            self.set_parameters([Parameter("speed", value=2.0)])  # parameter

    async def work(self):  # work
        await self.waits.call_async(Trigger.Request())  # awaits
        self.get_logger().info("done")  # logs

    def on_answer(self, future):  # answer
        pass

    def on_feedback(self, message):  # on feedback
        pass

    def on_goal(self, future):  # on goal
        pass


def send(publisher, text):
    publisher.publish(String(data=text))  # helper


def main():  # main
    rclpy.init()
    rclpy.spin(Caller())
"""


OFTEN = """\
from rclpy.node import Node
from std_msgs.msg import String


class Often(Node):
    def __init__(self):
        super().__init__("often")
        self.pub = self.create_publisher(String, "x", 10)
        self.ticks = 0
        self.create_timer(0.1, self.tick)
        self.create_timer(5.95, self.end)

    def tick(self):
        self.ticks += 1
        if self.ticks == 51:
            self.pub.publish(String(data="wrong"))  # seldom
        else:
            self.pub.publish(String(data="right"))  # usual

    def end(self):
        self.pub.publish(String(data="end"))  # late
"""


WRAPPED = """\
import functools
import rclpy


class Counted:
    def __init__(self, function):
        functools.update_wrapper(self, function)
        self.function = function

    def __call__(self):
        return self.function()


def tick():
    raise SystemExit


rclpy.init()
node = rclpy.create_node("node")
node.create_timer(0.1, Counted(tick))
try:
    rclpy.spin(node)
except SystemExit:
    pass
"""


def _line(mark: str) -> str:
    lines = PROGRAM.splitlines()
    return f"marked.py:{1 + next(i for i, line in enumerate(lines) if line.endswith(f'# {mark}'))}"


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("test_msgs.action", reason="needs ros-jazzy-test-msgs")
    import rsltrace

    folder = tmp_path_factory.mktemp("lines")
    (folder / "marked.py").write_text(PROGRAM)
    (folder / "job.yaml").write_text(
        "nodes: [{node: 'marked:Server'}, {main: 'marked:main'}]\n"
        "search_path: [.]\nstop: {time: 500 ms}\n"
    )
    rsltrace.record(rsltrace.load_job(folder / "job.yaml"), folder / "run.mcap")
    return folder / "run.mcap"


def test_outputs_have_the_lines_that_sent_them(trace: Path) -> None:
    with Trace.open(trace) as opened:
        met: dict[tuple[str, str], list[list[str]]] = {}
        for index in range(opened.event_count):
            for output in opened.outputs_of(index):
                key = output.kind.name, opened.entity(output.entity).name
                met.setdefault(key, []).append(output_places(opened, output))
    odd, even, helper = (_line(mark) for mark in ("odd", "even", "helper"))
    chat = met["MESSAGE", "/chat"]
    assert chat[:4] == [[odd], [helper], [odd, helper], [even]]
    assert chat[4] == [odd, helper, even]  # all have been met, so nobody knows
    calls = {tuple(places) for places in met["REQUEST", "/go"]}
    assert calls == {(_line("calls"),), (_line("awaits"),)}
    assert met["REQUEST", "/fib/_action/send_goal"] == [[_line("goal")]]
    assert met["MESSAGE", "/fib/_action/feedback"] == [[_line("feedback")]]
    assert [_line("parameter")] in met["MESSAGE", "/parameter_events"]
    assert [_line("logs")] in met["LOG", "/rosout"]


def test_events_have_the_function_that_ran(trace: Path) -> None:
    with Trace.open(trace) as opened:
        events = [opened.event(index) for index in range(opened.event_count)]
        met = {
            (event.kind, opened.entity(event.entity).name, code_place(opened, event))
            for event in events
        }
        mains = [one.source for one in opened.entities.values() if one.kind.name == "MAIN"]
    assert mains == [_line("main")]
    assert {
        (EventKind.TASK, "Caller.tick", _line("work")),
        (EventKind.CLIENT, "/go", _line("answer")),
        (EventKind.CLIENT, "/go", _line("awaits")),
        (EventKind.ACTION, "/fib/_action/feedback", _line("on feedback")),
        (EventKind.TASK, "/fib/_action/send_goal", _line("on goal")),
        (EventKind.TASK, "/fib/_action/send_goal", _line("executes")),
        (EventKind.SERVICE, "/go", _line("serve")),
    } <= met


def test_programs_and_wrapped_callbacks_have_the_place_of_what_they_run(tmp_path: Path) -> None:
    import rsltrace

    (tmp_path / "pack").mkdir()
    (tmp_path / "pack/__init__.py").write_text("")
    (tmp_path / "pack/talk.py").write_text(WRAPPED)
    (tmp_path / "talk.py").write_text(WRAPPED)
    (tmp_path / "job.yaml").write_text(
        "nodes: [{script: talk.py}, {module: pack.talk, name: second}]\nsearch_path: [.]\n"
    )
    rsltrace.record(rsltrace.load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as opened:
        made = {one.kind.name: [] for one in opened.entities.values()}
        for one in opened.entities.values():
            made[one.kind.name].append(one.source)
    assert made["MAIN"] == ["talk.py:1", "pack/talk.py:1"]
    line = 1 + WRAPPED.splitlines().index("def tick():")
    assert made["TIMER"] == [f"talk.py:{line}", f"talk.py:{line}"]


def test_what_was_not_looked_at_is_not_told_as_certain(tmp_path: Path) -> None:
    import rsltrace

    (tmp_path / "often.py").write_text(OFTEN)
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: 'often:Often'}]\nsearch_path: [.]\nstop: {time: 6 s}\n"
    )
    rsltrace.record(rsltrace.load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    lines = OFTEN.splitlines()
    usual, seldom, late = (
        f"often.py:{1 + next(i for i, line in enumerate(lines) if line.endswith(f'# {mark}'))}"
        for mark in ("usual", "seldom", "late")
    )
    with Trace.open(tmp_path / "run.mcap") as opened:
        told = [
            output_places(opened, output)
            for index in range(opened.event_count)
            for output in opened.outputs_of(index)
            if opened.entity(output.entity).name == "/x" and output.kind is OutputKind.MESSAGE
        ]
    assert told[:32] == [[usual]] * 32
    assert {tuple(places) for places in told[32:59]} == {(usual, "elsewhere")}
    assert told[50] == [usual, "elsewhere"] != [seldom]  # it came from there, and nobody has looked
    assert [late] in told  # another callback is looked at from its own first output on


def test_the_lines_of_many_outputs_are_found_without_reading_all_for_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import rsltrace

    (tmp_path / "burst.py").write_text(
        "from rclpy.node import Node\n"
        "from std_msgs.msg import String\n"
        "class Burst(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('burst')\n"
        "        out = self.create_publisher(String, 'x', 10)\n"
        "        for _ in range(50):\n"
        "            out.publish(String())\n"
    )
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: 'burst:Burst'}]\nsearch_path: [.]\nstop: {time: 1 s}\n"
    )
    rsltrace.record(rsltrace.load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as opened:
        outputs = opened.outputs_of(0)
        monkeypatch.setattr("rsltrace.trace.segments.output_of", None)
        told = [output_places(opened, one) for one in outputs]
    assert [one[0] for one in told if one].count("burst.py:8") == 50


def test_each_place_is_told_once_and_where(trace: Path) -> None:
    with Trace.open(trace) as opened:
        for entity, lines in opened.code_lines.items():
            assert len({(line.place, line.output) for line in lines}) <= len(lines) <= 5
            for line in lines:
                if line.output != 2**32 - 1:
                    output = opened.outputs_of(line.event)[line.output]
                    assert output.entity == entity
                    assert output.kind in (OutputKind.MESSAGE, OutputKind.REQUEST)


def test_commands_show_them(trace: Path) -> None:
    def run(*words: str) -> str:
        done = CliRunner().invoke(cli, [*words, str(trace)])
        assert done.exit_code == 0, done.output
        return done.output

    assert f"call /go at {_line('calls')}" in run("cat", "--code")
    chat = [line for line in run("info").splitlines() if "  /chat  " in line]
    assert f"{_line('odd')}, {_line('helper')}, {_line('even')}" in chat[0]
    rows = map(json.loads, run("cat", "--json").splitlines())
    sent = [output for row in rows for output in row["outputs"] if output["kind"] == "log"]
    assert sent[0]["code"] == [_line("logs")]
