"""What a job asks of a run: where it starts, when it stops, what happens when a node fails."""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace import Trace
from rsltrace.errors import JobError, LivelockError, NodeError, RunError
from rsltrace.job import StopSpec
from rsltrace.run.stop_rules import STOP_RULES, TopicRule
from rsltrace.simulation.loop.stop import Stop

pytestmark = pytest.mark.ros

BOTH = "nodes: [{node: nodes_under_test:Talker}, {node: nodes_under_test:Listener}]\n"
TALKER = "nodes: [{node: nodes_under_test:Talker}]\n"


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("stop", "end_s", "reason"),
    [
        ("{duration: 3s}", 13, "duration of 3.000000000 s"),
        ("{duration: 2.5s}", 12, "duration of 2.500000000 s"),
        ("{time: 14s}", 14, "time 14.000000000 s"),
        ("{events: 9}", 14, "9 events"),
        ("{topic: /numbers}", 11, "message on /numbers"),
        ("{function: 'nodes_under_test:enough'}", 13, "function nodes_under_test:enough"),
    ],
)
def test_stop_conditions(record_job: Any, stop: str, end_s: int, reason: str) -> None:
    code = "def enough(progress):\n    return progress.now_ns >= 13 * 10**9\n"
    result = record_job(f"{BOTH}start: 10s\nstop: {stop}\n", code)
    assert result.error is None
    assert result.stop_reason == reason
    assert result.end_ns == end_s * 10**9
    assert result.exit_code == 0
    with Trace.open(result.path) as trace:
        assert trace.digest == result.digest
        assert trace.event_count == result.events
        assert trace.complete
        # The last step ran fully: the listener heard the last message.
        kinds = [trace.event(i).kind.label for i in range(trace.event_count)]
        assert kinds.count("timer") == kinds.count("subscription") == end_s - 10


TEXTS = [
    "\x1b[1m",
    "\u2028",
    "\ufeff",
    "a\tb\nc\r",
    'q"\\',
    "\x7f\x85",
    "ü",
    "",
    " x ",
    "true",
    "1",
]


@pytest.mark.long
def test_any_text_can_be_a_parameter(record_job: Any) -> None:
    code = (
        "class Told(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('told')\n"
        "        one = self.declare_parameter('one', '').value\n"
        "        many = self.declare_parameter('many', ['']).value\n"
        "        self.get_logger().info(repr([one, *many]))\n"
    )
    for text in TEXTS:
        parameters = json.dumps({"one": text, "many": TEXTS})
        job = f"nodes: [{{node: nodes_under_test:Told, parameters: {parameters}}}]\n"
        result = record_job(f"{job}stop: {{events: 1}}\n", code)
        with Trace.open(result.path) as trace:
            (log,) = [trace.decode("/rosout", data) for *_, data in trace.messages("/rosout")]
        assert log.msg == repr([text, *TEXTS])


@pytest.mark.long
@pytest.mark.parametrize("value", ['"a\\0b"', '["a", "\\0"]'])
def test_a_parameter_that_ros_would_cut_off_is_refused(record_job: Any, value: str) -> None:
    with pytest.raises(JobError, match=r"job\.yaml:1:.*NUL character"):
        record_job(f"nodes: [{{node: nodes_under_test:Talker, parameters: {{p: {value}}}}}]\n")


@pytest.mark.long
def test_a_trace_that_is_large_enough_ends_the_run(record_job: Any) -> None:
    code = "class Fast(Talker):\n    def __init__(self):\n        super().__init__(0.001)\n"
    result = record_job("nodes: [{node: nodes_under_test:Fast}]\nstop: {size: 200kB}\n", code)
    assert result.error is None
    assert result.stop_reason == "a trace of 200kB"
    assert 200_000 <= result.path.stat().st_size < 800_000


def test_the_exit_code_may_come_from_a_message(record_job: Any) -> None:
    code = (
        "class Judge(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('judge')\n"
        "        p = self.create_publisher(Int32, '/rslcpp/error_code', 1)\n"
        "        self.create_timer(2.0, lambda: p.publish(Int32(data=7)))\n"
    )
    job = (
        "nodes: [{node: nodes_under_test:Judge}]\n"
        "stop: {topic: {name: /rslcpp/error_code, exit_code: %s}}\n"
    )
    result = record_job(job % "data", code)
    assert (result.exit_code, result.end_ns) == (7, 2 * 10**9)
    result = record_job(job % "nothing", code)
    assert "without the field 'nothing'" in str(result.error)


@pytest.mark.long
@pytest.mark.parametrize(("answer", "code"), [("True", 0), ("4", 4)])
def test_a_stop_function_gives_the_exit_status(record_job: Any, answer: str, code: int) -> None:
    function = f"def enough(progress):\n    return {answer} if progress.events > 5 else None\n"
    result = record_job(f"{TALKER}stop: {{function: 'nodes_under_test:enough'}}\n", function)
    assert result.exit_code == code


def test_quiescence_ends_a_run_in_which_nothing_is_said_any_more(record_job: Any) -> None:
    code = (
        "class Brief(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('brief')\n"
        "        self.p = self.create_publisher(UInt64, 'n', 1)\n"
        "        self.n = 0\n"
        "        self.create_timer(0.5, self.tick)\n"
        "    def tick(self):\n"
        "        self.n += 1\n"
        "        if self.n <= 4: self.p.publish(UInt64())\n"
    )
    job = "nodes: [{node: nodes_under_test:Brief}]\nstop: {quiescence: 3s}\n"
    result = record_job(job, code)
    assert result.stop_reason == "quiet for 3.000000000 s"
    assert result.end_ns == 5 * 10**9


@pytest.mark.long
def test_a_run_ends_when_nothing_is_left_to_do(record_job: Any) -> None:
    result = record_job("nodes: [{node: nodes_under_test:Listener}]\n")
    assert result.stop_reason == "nothing left to do"
    assert result.end_ns == 0


def test_exception_without_a_text(record_job: Any) -> None:
    code = "class Faulty(Talker):\n    def tick(self):\n        raise AssertionError\n"
    result = record_job("nodes: [{node: nodes_under_test:Faulty}]\n", code)
    assert str(result.error).endswith(" s raised AssertionError")


@pytest.mark.long
def test_an_exception_names_node_entity_and_time_and_the_trace_is_complete(
    record_job: Any, tmp_path: Path
) -> None:
    code = (
        "class Faulty(Talker):\n"
        "    def tick(self):\n"
        "        super().tick()\n"
        "        if self.count == 3:\n"
        "            raise ValueError('three is too many')\n"
    )
    job = "nodes: [{node: nodes_under_test:Faulty}, {node: nodes_under_test:Listener}]\n"
    result = record_job(job, code)
    error = result.error
    assert isinstance(error, NodeError)
    assert (error.node, error.stamp_ns) == ("/talker", 3 * 10**9)
    assert "/talker: timer Faulty.tick" in str(error)
    assert "3.000000000" in str(error)
    assert "three is too many" in str(error)
    assert "raise ValueError('three is too many')" in error.traceback_text
    assert str(tmp_path / "nodes_under_test.py") in error.traceback_text
    assert "rsltrace/adapters" not in error.traceback_text
    assert result.exit_code == 3
    with Trace.open(result.path) as trace:
        assert trace.complete
        last = trace.event(trace.event_count - 1)
        assert last.kind.label == "timer"
        assert int(last.flags) == 1
        outputs = trace.outputs_of(last.index)
        assert [output.kind.label for output in outputs] == ["message", "exception"]
        _, topic, data = trace.payload(outputs[1])
        assert "three is too many" in trace.decode(topic, data).text


@pytest.mark.long
def test_a_constructor_that_raises_is_named(record_job: Any) -> None:
    code = (
        "class Broken(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('broken')\n"
        "        raise RuntimeError('no camera')\n"
    )
    result = record_job("nodes: [{node: nodes_under_test:Broken}]\n", code)
    assert "constructing nodes_under_test:Broken" in str(result.error)
    assert "no camera" in str(result.error)
    with Trace.open(result.path) as trace:
        assert trace.event_count == 1


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("no_such_module:Talker", ["job.yaml:1:16: ", "no module 'no_such_module'"]),
        ("nodes_under_test:Tolker", ["job.yaml:1:16: ", "'Tolker'", "did you mean 'Talker'"]),
        ("nodes_under_test:TALL", ["not callable"]),
        ("nodes_under_test:something", ["returned an object of type int, not an rclpy Node"]),
    ],
)
def test_what_cannot_be_constructed_is_explained(
    record_job: Any, target: str, words: list[str]
) -> None:
    code = "TALL = 3\ndef something():\n    return 5\n"
    try:
        message = str(record_job(f"nodes: [{{node: '{target}'}}]\n", code).error)
    except JobError as error:
        message = str(error)
    for word in words:
        assert word in message


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("import a_missing_library", ["'a_missing_library'", "search_path", "pip install"]),
        (
            "from example_interfaces_of_nobody.srv import AddTwoInts",
            ["holds ROS interfaces", "no wheel", "apt install ros-jazzy-example-interfaces-of"],
        ),
        ("import nobodys_msgs.msg as m", ["holds ROS interfaces", "no wheel", "source /opt/ros/"]),
    ],
)
def test_a_module_that_needs_another_one_says_which_and_what_to_do(
    record_job: Any, tmp_path: Path, line: str, words: list[str]
) -> None:
    with pytest.raises(JobError) as caught:
        record_job(TALKER, f"{line}\n")
    number = len((tmp_path / "nodes_under_test.py").read_text().splitlines())
    for word in ["job.yaml:1:16: ", f"nodes_under_test.py:{number})", "it needs", *words]:
        assert word in str(caught.value)


@pytest.mark.long
def test_an_interface_that_a_callback_imports_in_vain_has_a_next_step(record_job: Any) -> None:
    code = (
        "class Late(Talker):\n"
        "    def tick(self):\n"
        "        from nobodys_interfaces.action import Go\n"
    )
    result = record_job("nodes: [{node: nodes_under_test:Late}]\n", code)
    assert "No module named 'nobodys_interfaces'" in str(result.error)
    assert "apt install ros-jazzy-nobodys-interfaces" in str(result.error)


@pytest.mark.long
def test_who_divides_by_a_time_that_did_not_pass_is_told_so(record_job: Any) -> None:
    code = (
        "class Rated(Talker):\n"
        "    def tick(self):\n"
        "        start = self.get_clock().now()\n"
        "        1 / (self.get_clock().now() - start).nanoseconds\n"
    )
    result = record_job("nodes: [{node: nodes_under_test:Rated}]\n", code)
    assert "raised ZeroDivisionError" in str(result.error)
    assert "computing takes no simulated time" in str(result.error)


@pytest.mark.long
def test_a_cycle_without_time_is_named_not_hung_on(record_job: Any) -> None:
    code = (
        "class Echo(Node):\n"
        "    def __init__(self, name, hear, say):\n"
        "        super().__init__(name)\n"
        "        p = self.create_publisher(UInt64, say, 10)\n"
        "        self.create_subscription(UInt64, hear, p.publish, 10)\n"
        "        if name == 'one': self.create_timer(1.0, lambda: p.publish(UInt64()))\n"
    )
    job = (
        "nodes:\n"
        "- {node: nodes_under_test:Echo, arguments: {name: one, hear: /a, say: /b}}\n"
        "- {node: nodes_under_test:Echo, arguments: {name: two, hear: /b, say: /a}}\n"
        "livelock_limit: 2000\n"
    )
    result = record_job(job, code)
    assert isinstance(result.error, LivelockError)
    for word in ("1.000000000", "2000", "/one: subscription /a", "/two: subscription /b"):
        assert word in str(result.error)
    with Trace.open(result.path) as trace:
        assert trace.complete


@pytest.mark.long
def test_system_exit_in_a_callback_is_the_exit_status(record_job: Any) -> None:
    code = "class Leaver(Talker):\n    def tick(self):\n        raise SystemExit(5)\n"
    result = record_job("nodes: [{node: nodes_under_test:Leaver}]\n", code)
    assert (result.exit_code, result.error) == (5, None)


@pytest.mark.long
def test_payloads_may_be_left_out_without_changing_the_digest(record_job: Any) -> None:
    stop = "stop: {duration: 3s}\n"
    everything = record_job(BOTH + stop)
    with Trace.open(everything.path) as trace:
        assert len(list(trace.messages("/numbers"))) == 3
    for selection in ("{payloads: false}", "{topics: ['/ros*']}", "{exclude: ['/num*']}"):
        result = record_job(f"{BOTH}{stop}record: {selection}\n")
        assert result.digest == everything.digest
        with Trace.open(result.path) as trace:
            assert "/numbers" not in {channel.topic for channel in trace.channels.values()}


@pytest.mark.long
def test_recording_does_not_change_what_the_nodes_do(record_job: Any) -> None:
    a = record_job(f"{BOTH}stop: {{duration: 5s}}\n")
    b = record_job(f"{BOTH}stop: {{duration: 5s}}\n", output=None)
    assert (a.events, a.end_ns, a.stop_reason) == (b.events, b.end_ns, b.stop_reason)
    assert b.digest == ""


@pytest.mark.long
def test_runs_in_one_process_do_not_disturb_each_other(record_job: Any, tmp_path: Path) -> None:
    code = (
        "RUNS = []\nclass Counting(Talker):\n    def __init__(self):\n        RUNS.append(1)\n"
        "        super().__init__(1.0 / len(RUNS))\n"
    )
    job = "nodes: [{node: nodes_under_test:Counting}]\nstop: {duration: 5s}\n"
    before = (set(sys.modules), list(sys.path), threading.active_count())
    first = record_job(job, code)
    second = record_job(job, code)
    assert first.digest == second.digest
    assert "nodes_under_test" not in sys.modules
    assert sys.path == before[1]
    assert threading.active_count() == before[2]
    import rclpy
    from rclpy.impl.implementation_singleton import rclpy_implementation

    assert rclpy_implementation.__class__.__name__ == "module"
    assert not rclpy.ok()


@pytest.mark.long
def test_real_rclpy_works_after_a_simulation(record_job: Any) -> None:
    assert record_job(f"{BOTH}stop: {{duration: 2s}}\n").error is None
    import rclpy
    from rclpy.node import Node

    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    node = Node("native", context=context)
    assert type(node.handle).__module__ == "rclpy._rclpy_pybind11"
    node.destroy_node()
    context.shutdown()


def test_no_socket_or_participant_is_started_and_no_thread_but_the_watchdog(
    rsltrace: Any, job_file: Any
) -> None:
    # Loading rclpy's extension starts the two listeners of LTTng-UST, before any node exists.
    code = """
import os
import rclpy

def sockets():
    \"\"\"Internet sockets of this process (LTTng-UST opens a local one when it likes).\"\"\"
    net = set()
    for kind in ('tcp', 'tcp6', 'udp', 'udp6'):
        lines = open(f'/proc/net/{kind}').read().splitlines()[1:]
        net |= {f'socket:[{line.split()[9]}]' for line in lines}
    files = [f'/proc/self/fd/{n}' for n in os.listdir('/proc/self/fd')]
    return net & {os.readlink(f) for f in files if os.path.lexists(f)}

THREADS = len(os.listdir('/proc/self/task'))

class Look(Node):
    def __init__(self):
        super().__init__('look')
        self.create_timer(1.0, self.tick)

    def tick(self):
        threads = len(os.listdir('/proc/self/task')) - THREADS
        self.get_logger().info(f'SOCKETS {len(sockets())} THREADS {threads}')
"""
    job_file("nodes: [{node: nodes_under_test:Look}]\nstop: {duration: 1s}\n", code)
    done = rsltrace("record", "job.yaml")
    assert "SOCKETS 0 THREADS 1" in done.stderr, done.stderr


def test_a_failing_stop_function_is_an_error_of_the_run(record_job: Any) -> None:
    function = "def enough(progress):\n    return 'yes'\n"
    job = f"{TALKER}stop: {{function: 'nodes_under_test:enough'}}\n"
    result = record_job(job, function)
    assert isinstance(result.error, RunError)
    assert "nodes_under_test:enough" in str(result.error)


@pytest.mark.long
def test_a_virtual_environment_in_the_search_path_is_not_the_users_code(
    record_job: Any, tmp_path: Path
) -> None:
    library = tmp_path / ".venv" / "lib" / "site-packages"
    library.mkdir(parents=True)
    (library / "installed_library.py").write_text("LOADED = object()\n")
    code = f"import sys\nsys.path.append({str(library)!r})\nimport installed_library\n"
    result = record_job(f"{TALKER}stop: {{duration: 1s}}\n", code)
    assert "installed_library" in sys.modules
    assert "nodes_under_test" not in sys.modules
    with Trace.open(result.path) as trace:
        assert list(trace.metadata("rsltrace:sources")) == ["nodes_under_test"]
    del sys.modules["installed_library"]


def test_every_key_of_stop_is_in_the_table() -> None:
    assert set(STOP_RULES) == set(StopSpec.fields)


def test_a_rule_that_counts_messages_takes_one_class(
    record_job: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class CountRule(TopicRule):
        seen = 0

        def on_message(self, message: Callable[[], Any]) -> Stop | None:
            self.seen += 1
            return Stop(f"{message().data} is the third") if self.seen == 3 else None

    monkeypatch.setitem(STOP_RULES, "topic", CountRule)  # type: ignore[arg-type]
    result = record_job(f"{BOTH}stop: {{topic: /numbers}}\n")
    assert result.stop_reason == "3 is the third"


def test_nodes_see_the_variables_of_a_sourced_ros(
    record_job: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ROS_VERSION", "ROS_PYTHON_VERSION"):
        monkeypatch.delenv(name, raising=False)
    code = (
        "import os\n"
        "assert os.environ['ROS_VERSION'] == '2' and os.environ['ROS_PYTHON_VERSION'] == '3'\n"
        "assert os.environ['ROS_DISTRO'] in ('humble', 'jazzy', 'kilted')\n"
    )
    assert record_job(f"{TALKER}stop: {{events: 2}}\n", code).error is None
    assert "ROS_VERSION" not in os.environ
