"""Headlines for changes a robot engineer makes: the node, what changed, both values."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

import rsltrace
from rsltrace.diff.result import Diff

pytestmark = pytest.mark.ros

SOURCE = """
import time
from rclpy.node import Node
from std_msgs.msg import UInt64

class Source(Node):
    def __init__(self):
        super().__init__("source")
        self.declare_parameter("gain", 1)
        self.count = 0
        self.out = self.create_publisher(UInt64, "/signal", 5)
        self.timer = self.create_timer(0.1, self.tick)

    def tick(self):
        self.count += self.get_parameter("gain").value
        self.out.publish(UInt64(data=self.count))
"""
SINK = """
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt64

class Sink(Node):
    def __init__(self):
        super().__init__("sink")
        self.out = self.create_publisher(UInt64, "/heard", 5)
        best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(UInt64, "/signal", self.heard, best_effort)

    def heard(self, message):
        self.out.publish(message)
"""
JOB = """
nodes:
  - node: headline_source:Source
  - node: headline_sink:Sink
stop: {duration: 2s}
"""
FILES = {"headline_source.py": SOURCE, "headline_sink.py": SINK, "job.yaml": JOB}


def recorded(folder: Path, name: str, *changes: tuple[str, str]) -> Path:
    """Record the job with texts of its files replaced."""
    from rsltrace.run import run

    files = "\0".join(FILES.values())
    for old, new in changes:
        assert old in files
        files = files.replace(old, new)
    for file, text in zip(FILES, files.split("\0"), strict=True):
        (folder / file).write_text(text)
    importlib.invalidate_caches()
    run(rsltrace.load_job(folder / "job.yaml"), folder / name, force=True)
    return folder / name


def both_ways(a: Path, b: Path) -> tuple[Diff, Diff]:
    return rsltrace.diff(a, b, window=10), rsltrace.diff(b, a, window=10)


STOP = "stop: {duration: 2s}"
OUTAGE = "delay: {{outages: [{{topic: /signal, from: {}s, to: {}s}}]}}\n"


def test_outage_after_many_delays_of_zero(tmp_path: Path) -> None:
    """The draws of 0 ns before the outage are no effect, however many they are."""
    a = recorded(tmp_path, "a.mcap")
    b = recorded(tmp_path, "b.mcap", (STOP, OUTAGE.format(1.65, 1.85) + STOP))
    for found in both_ways(a, b):
        assert "first effect: timer Source.tick of /source at 1.7 s" in found.sentence
        assert "lost in an outage" in found.sentence
        assert any("from event 2 on, one run adds delays of 0 ns" in note for note in found.notes)


def test_outage_after_the_end(tmp_path: Path) -> None:
    a = recorded(tmp_path, "a.mcap")
    b = recorded(tmp_path, "b.mcap", (STOP, OUTAGE.format(5, 6) + STOP))
    for found in both_ways(a, b):
        assert "; no effect: one run only adds delays of 0 ns, first in timer" in found.sentence


CAMERA = """
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node

class Camera(LifecycleNode):
    def __init__(self):
        super().__init__("camera")

    def on_configure(self, state):
        self.calibrate()
        return super().on_configure(state)

    def calibrate(self):
        pass

class Manager(Node):
    def __init__(self):
        super().__init__("manager")
        self.client = self.create_client(ChangeState, "/camera/change_state")
        self.timer = self.create_timer(0.5, self.tick)

    def tick(self):
        self.timer.cancel()
        configure = Transition(id=Transition.TRANSITION_CONFIGURE)
        self.client.call_async(ChangeState.Request(transition=configure))
"""
MANAGED = "  - node: headline_camera:Camera\n  - node: headline_camera:Manager\n"


def test_exception_that_rclpy_suppresses(tmp_path: Path) -> None:
    (tmp_path / "headline_camera.py").write_text(CAMERA)
    a = recorded(tmp_path, "a.mcap", (STOP, MANAGED + STOP))
    (tmp_path / "headline_camera.py").write_text(CAMERA.replace("pass", 'raise KeyError("lens")'))
    b = recorded(tmp_path, "b.mcap", (STOP, MANAGED + STOP))
    line = CAMERA.splitlines().index("        pass") + 1
    for found, run in zip(both_ways(a, b), "ba", strict=True):
        raised = f"raised KeyError: 'lens' at headline_camera.py:{line} only in {run}"
        told = f"Camera.on_configure of /camera {raised}; rclpy suppressed it"
        assert f"likely cause: {told}" in found.sentence
        cause = found.divergences[0].root_sentence
        assert cause.startswith(f"{told}; no earlier event differs, but the runs had different")


@pytest.mark.long
def test_exception_that_a_setting_provokes_and_rclpy_suppresses(tmp_path: Path) -> None:
    asked = 'self.get_parameter("lens").value'
    raising = CAMERA.replace("pass", f'if {asked}: raise KeyError("lens")')
    raising = raising.replace(
        '"camera")',
        '"camera", allow_undeclared_parameters=True,\n'
        "            automatically_declare_parameters_from_overrides=True)",
    )
    (tmp_path / "headline_camera.py").write_text(raising)
    jobs = [
        MANAGED.replace("Camera\n", f"Camera\n    parameters: {{lens: {lens}}}\n") + STOP
        for lens in ("false", "true")
    ]
    a, b = (recorded(tmp_path, f"{n}.mcap", (STOP, job)) for n, job in zip("ab", jobs, strict=True))
    for found, run in zip(both_ways(a, b), "ba", strict=True):
        assert found.sentence.startswith("parameter lens ")
        assert "; first effect: Camera.on_configure of /camera raised KeyError" in found.sentence
        assert found.sentence.endswith(f" only in {run}; rclpy suppressed it")


@pytest.mark.parametrize(
    "permission",
    ["guard: false", "guard: {clock: allow}", "guard: {clock: {allow: [headline_source]}}"],
    ids=["all", "source", "module"],
)
def test_call_that_the_job_permits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, permission: str
) -> None:
    """The call in the callback is named, and the command that lists all."""
    monkeypatch.chdir(tmp_path)
    timed = ("data=self.count", "data=time.time_ns()")
    off = (STOP, f"{permission}\n{STOP}")
    a, b = (recorded(tmp_path, f"{name}.mcap", timed, off) for name in "ab")
    line = SOURCE.splitlines().index("        self.out.publish(UInt64(data=self.count))") + 1
    call = f"time.time_ns() at headline_source.py:{line}"
    for found in both_ways(a, b):
        assert f"; possible cause: {call}, which {permission} lets differ" in found.sentence
        root = found.divergences[0].root_sentence
        assert f"; a possible cause is {call}, which {permission} lets differ" in root
        assert found.divergences[0].next_step == "rsltrace audit headline_source.py"


def test_call_that_the_job_permits_in_a_module_that_the_node_imports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "headline_clock.py").write_text(
        "import time\ndef read():\n    return time.time_ns()\n"
    )
    changes = (
        ("import time\n", "import headline_clock\n"),
        ("data=self.count", "data=headline_clock.read()"),
        (STOP, f"guard: false\n{STOP}"),
    )
    found = rsltrace.diff(*(recorded(tmp_path, f"{name}.mcap", *changes) for name in "ab"))
    assert "; possible cause: time.time_ns() at headline_clock.py:3" in found.sentence
    assert found.divergences[0].next_step == "rsltrace audit headline_clock.py"


LATCHED = (
    (
        "import time\n",
        "import time\nfrom rclpy.qos import QoSProfile, DurabilityPolicy\n",
    ),
    (
        '        self.out = self.create_publisher(UInt64, "/signal", 5)\n        self.timer',
        """        latched = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.out = self.create_publisher(UInt64, "/signal", latched)
        for number in range(3): self.out.publish(UInt64(data=EACH))
        self.timer""",
    ),
    (
        "reliability=ReliabilityPolicy.BEST_EFFORT)",
        "durability=DurabilityPolicy.TRANSIENT_LOCAL)",
    ),
    ("QoSProfile, ReliabilityPolicy", "QoSProfile, DurabilityPolicy"),
)


@pytest.mark.few(1)
@pytest.mark.parametrize("each", ["number", "7"])
def test_depth_of_a_history(each: str, tmp_path: Path) -> None:
    latched = (*LATCHED, ("EACH", each))
    a = recorded(tmp_path, "a.mcap", *latched)
    b = recorded(tmp_path, "b.mcap", *latched, ("depth=3", "depth=1"))
    for found, depths in zip(both_ways(a, b), ("3 → 1", "1 → 3"), strict=True):
        created = "/source created publisher /signal with a different QoS"
        assert f"likely cause: {created}: depth {depths}" in found.sentence


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("1)", "3)", "parameter gain of /source 1 → 3"),
        ("1)", '1)\n        self.declare_parameter("more", 2.5)', "more of /source 2.5 only"),
        ("1)", '1)\n        self.declare_parameter("more", [2.5])', "more of /source [2.5] only"),
    ],
)
def test_default_of_a_parameter(old: str, new: str, told: str, tmp_path: Path) -> None:
    a = recorded(tmp_path, "a.mcap")
    b = recorded(tmp_path, "b.mcap", (f'"gain", {old}', f'"gain", {new}'))
    found, _ = both_ways(a, b)
    assert told in found.sentence
    assert "(code of module headline_source)" in found.sentence


def test_timeout_of_a_call(tmp_path: Path) -> None:
    """A callback that wakes up at the same time in both runs and sleeps again in one."""
    waits = "self.client.wait_for_service(timeout_sec=1.0)"
    client = (
        ("time\n", "time\nfrom std_srvs.srv import Trigger\n"),
        ("        self.count = 0", '        self.client = self.create_client(Trigger, "/ask")'),
        ("        self.count += ", f"        {waits}\n        self.count = "),
    )
    a = recorded(tmp_path, "a.mcap", *client)
    b = recorded(tmp_path, "b.mcap", *client, ("timeout_sec=1.0", "timeout_sec=0.2"))
    for found, run in zip(both_ways(a, b), "ab", strict=True):
        assert f" slept 250 ms in {run} but not in " in found.sentence


def test_sleep_of_overlapping_callbacks(tmp_path: Path) -> None:
    """Whichever of them wakes up first: that one waits is said, not for how long."""
    group = "callback_group=ReentrantCallbackGroup()"
    overlapping = (
        (
            "import time\n",
            "import time\nfrom rclpy.callback_groups import ReentrantCallbackGroup\n",
        ),
        ("self.tick)", f"self.tick, {group})"),
        ("        self.out.publish(UInt64(data=self.count))", "        pass"),
    )
    a = recorded(tmp_path, "a.mcap", *overlapping)
    b = recorded(tmp_path, "b.mcap", *overlapping, ("        pass", "        time.sleep(0.15)"))
    for found, run in zip(both_ways(a, b), "ba", strict=True):
        assert f"received the same input in both runs but waited only in {run}" in found.sentence


def test_delays_that_differ_in_the_seventh_digit(tmp_path: Path) -> None:
    """In the setting, in the draw and in the report's table."""
    delay = "delay: {{topics: {{/signal: {}}}}}\n"
    a = recorded(tmp_path, "a.mcap", (STOP, delay.format("100ms") + STOP))
    b = recorded(tmp_path, "b.mcap", (STOP, delay.format("100.0001ms") + STOP))
    found, _ = both_ways(a, b)
    assert "100 ms → 100.0001 ms (job.yaml:5)" in found.sentence
    assert "delay 100 ms in a, delay 100.0001 ms in b" in found.sentence
    (draw,) = found.divergences[0].messages[0].fields
    assert (draw.a, draw.b) == ("delay 100 ms", "delay 100.0001 ms")


def test_a_message_that_comes_so_late_that_the_next_one_does(tmp_path: Path) -> None:
    """The second waits for the first, and is not as late."""
    a = recorded(tmp_path, "a.mcap")
    slow = "        if message.data == 5:\n            import time; time.sleep(0.13)\n"
    publish = "        self.out.publish(message)"
    b = recorded(tmp_path, "b.mcap", (publish, slow + publish))
    for found, late in zip(both_ways(a, b), "ba", strict=True):
        assert f"(/heard 130 ms later in {late})" in found.sentence
