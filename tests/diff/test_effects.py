"""Of settings that differ, what they did is told first, not that a node was set up otherwise."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace.diff.facts.causes import Verdict
from rsltrace.diff.facts.evidence import SettingKind
from rsltrace.diff.report import render

pytestmark = [pytest.mark.ros]
pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

NODES = """
from geometry_msgs.msg import Twist
from rclpy.node import Node
from std_msgs.msg import Float64


class Lidar(Node):
    def __init__(self):
        super().__init__("lidar")
        self.publisher = self.create_publisher(Float64, "range", 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.publisher.publish(Float64(data=2.0))


class Follower(Node):
    def __init__(self):
        super().__init__("follower")
        self.speed = self.declare_parameter("speed", 1.0).value
        self.from_ = self.declare_parameter("from", 1).value
        self.declare_parameter("unused", 1)
        self.get_logger().info(f"speed {self.speed}")
        self.publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Float64, "range", self.got, 10)
        self.heard = 0

    def got(self, message):
        self.heard += 1
        command = Twist()
        command.angular.z = 1e-9 * self.speed
        if self.heard >= self.from_:
            command.linear.x = self.speed * message.data
        self.publisher.publish(command)
"""
JOB = """\
nodes:
  - node: following:Lidar
  - node: following:Follower
    name: follower
    parameters:
      speed: SPEED
      from: FROM
      unused: UNUSED
stop: {duration: 3s}
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Record with some values of the parameters, each once."""
    from rsltrace.run import run

    folder = tmp_path_factory.mktemp("following")
    (folder / "following.py").write_text(NODES)

    def go(speed: str = "1.0", from_: str = "1", unused: str = "1") -> Path:
        path = folder / f"{speed}-{from_}-{unused}.mcap"
        if not path.exists():
            text = JOB.replace("SPEED", speed).replace("FROM", from_).replace("UNUSED", unused)
            (folder / "job.yaml").write_text(text)
            run(rsltrace.load_job(folder / "job.yaml"), path)
        return path

    return go


def test_a_parameter_and_what_it_did(recorded: Callable[..., Path]) -> None:
    a, b = recorded(), recorded(speed="1.5")
    diff = rsltrace.diff(a, b)
    assert diff.verdict is Verdict.ENVIRONMENT
    assert diff.agreeing == diff.divergences[0].a.index == 1  # type: ignore[union-attr]
    assert diff.sentence == (
        "parameter speed 1.0 → 1.5 (job.yaml:6); first effect: /follower published a different "
        "linear.x on /cmd_vel at 0.1 s (linear.x 2.0 → 3.0 and 1 more field)"
    )
    other = rsltrace.diff(b, a).sentence
    assert other.startswith("parameter speed 1.5 → 1.0 (job.yaml:6); first effect: /follower pub")
    assert "(linear.x 3.0 → 2.0 and 1 more field)" in other


def test_all_reports_lead_with_the_effect(recorded: Callable[..., Path]) -> None:
    diff = rsltrace.diff(recorded(), recorded(speed="1.5"))
    text = render(diff, "text")
    assert text.startswith("Parameter speed 1.0 → 1.5 (job.yaml:6); first effect: /follower ")
    assert "subscription /range, call 1 (" in text
    assert "parameter_events" not in text.split("\nevents ")[0]
    for form in ("junit", "github", "markdown"):
        assert "first effect: /follower published" in render(diff, form).replace("\\", ""), form
    assert "following.py,line=" in render(diff, "github") or "file=" in render(diff, "github")
    found: dict[str, Any] = json.loads(render(diff, "json"))
    assert found["effect"]["a"]["entity"]["name"] == "/range"
    assert found["effect"]["settings"] == found["divergences"][0]["settings"]
    assert found["effect"]["settings"][0]["key"] == "nodes.follower.parameters.speed"


@pytest.mark.long
def test_an_effect_that_comes_late_is_found(recorded: Callable[..., Path]) -> None:
    options = {"ignore": "/cmd_vel:angular"}
    a, b = recorded(from_="20"), recorded(speed="1.5", from_="20")
    diff = rsltrace.diff(a, b, window=5, ignore=options["ignore"])
    assert (
        "first effect: /follower published a different linear.x on /cmd_vel at 2.0 s"
        in diff.sentence
    )


def test_a_parameter_without_effect(recorded: Callable[..., Path]) -> None:
    diff = rsltrace.diff(recorded(), recorded(unused="2"))
    assert diff.effect is None
    assert diff.sentence == (
        "parameter unused 1 → 2 (job.yaml:8); no effect except on /parameter_events, by the "
        "constructor of /follower"
    )
    assert diff.shown is diff.divergences[0]


def test_what_is_ignored_or_tolerated_does_not_lead(recorded: Callable[..., Path]) -> None:
    a, b = recorded(from_="20"), recorded(speed="1.5", from_="20")
    plain = rsltrace.diff(a, b)
    assert "angular.z" in plain.sentence
    near = rsltrace.diff(a, b, absolute={"angular.z": 1e-6})
    assert "a different linear.x" in near.sentence
    assert "at 2.0 s" in near.sentence
    ignored = ["/parameter_events:*", "/rosout:*", "angular.z"]
    diff = rsltrace.diff(a, b, ignore=ignored)
    assert "/cmd_vel (linear.x 2.0 → 3.0)" in diff.sentence
    assert any("but only in ignored fields or within tolerance" in note for note in diff.notes)
    assert not any("this report shows where" in note for note in diff.notes), (
        "no topic was asked for"
    )
    assert diff.agreeing == 1


def test_view_and_rerun_open_at_the_effect(recorded: Callable[..., Path]) -> None:
    from rsltrace_viewer.model.run import Run
    from rsltrace_viewer.session import Session

    session = Session(Run.open(recorded()), Run.open(recorded(speed="1.5")))
    try:
        comparison = session.comparison
        assert comparison is not None
        assert session.place == comparison.first_place == 3
        comparison.finish_diff()
        assert comparison.diff is not None
        assert comparison.diff.shown is not None
        assert comparison.diff.shown.a is not None
        assert comparison.diff.shown.a.index == comparison.a(session.place)
    finally:
        session.close()
    marks = pytest.importorskip("rsltrace_viewer.rerun_export.divergence")
    diff = rsltrace.diff(recorded(), recorded(speed="1.5"))
    found = marks.marks_of(diff, comparison.runs)
    assert (found.stamp_ns, found.row) == (100_000_000, 3)


def test_a_factory_and_what_one_of_its_nodes_did(tmp_path: Path) -> None:
    """All nodes of a factory come from one event, which is that of the first of them."""
    from rsltrace.run import run

    made = f"""{NODES}

def make(speed):
    lidar, follower = Lidar(), Follower()
    lidar.declare_parameter("speed", speed)
    follower.speed = speed
    return [lidar, follower]
"""
    (tmp_path / "factory.py").write_text(made)
    job, traces = tmp_path / "job.yaml", []
    for speed in ("1.0", "1.5"):
        nodes = f"[{{node: factory:make, arguments: {{speed: {speed}}}}}]"
        job.write_text(f"nodes: {nodes}\nstop: {{duration: 1s}}\n")
        traces.append(tmp_path / f"{speed}.mcap")
        run(rsltrace.load_job(job), traces[-1])
    assert rsltrace.diff(*traces).sentence == (
        "setting nodes.0.arguments.speed 1.0 → 1.5 (job.yaml:1); first effect: /follower published "
        "a different linear.x on /cmd_vel at 0.1 s (linear.x 2.0 → 3.0 and 1 more "
        "field)"
    )


def test_of_a_class_of_another_module_both_modules_may_be_the_cause(tmp_path: Path) -> None:
    """Not the one that comes first in a set of them: reports of the same runs are the same."""
    from rsltrace.run import run

    job, traces = tmp_path / "job.yaml", []
    for module, sent in (("lidar_one", "2.0"), ("lidar_two", "3.0")):
        (tmp_path / f"{module}.py").write_text(NODES.replace("data=2.0", f"data={sent}"))
        nodes = ", ".join(f"{{node: {module}:Lidar, name: lidar{n}}}" for n in range(8))
        job.write_text(f"nodes: [{nodes}]\nstop: {{duration: 1s}}\n")
        traces.append(tmp_path / f"{module}.mcap")
        run(rsltrace.load_job(job), traces[-1])
    shown = rsltrace.diff(*traces).shown
    assert shown is not None
    code = {setting.name for setting in shown.settings if setting.kind is SettingKind.CODE}
    assert code == {"lidar_one", "lidar_two"}
