"""From a run of known delays and execution times, as if it had been observed, back to them."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

pytest.importorskip("rclpy")

from rsltrace import Trace, record
from rsltrace.checks.latency.measure import measure_latencies
from rsltrace.cli.main import cli
from rsltrace.job import load_job
from rsltrace.native.fit.measurement import NativeTimes, measure_times
from rsltrace.native.fit.models import ks_distance
from rsltrace.run.plans.network import make_distribution
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.trace.model.event import OutputKind, RandomDecision
from tests.fit.native_like import AHEAD_NS, BITS, as_native

pytestmark = pytest.mark.ros
MS = 1_000_000

NODES = """\
import time

from rclpy.node import Node
from std_msgs.msg import Int64
from std_srvs.srv import Trigger


class Camera(Node):
    def __init__(self):
        super().__init__("camera")
        self.image = self.create_publisher(Int64, "/image", 10)
        self.count = 0
        self.create_timer(0.05, self.tick)

    def tick(self):
        self.count += 1
        self.image.publish(Int64(data=self.count))


class Stage(Node):
    def __init__(self, name, hears, says):
        super().__init__(name)
        self.says = self.create_publisher(Int64, says, 10)
        self.create_subscription(Int64, hears, self.hear, 10)

    def hear(self, message):
        self.says.publish(message)


class Asker(Node):
    def __init__(self):
        super().__init__("asker")
        self.client = self.create_client(Trigger, "/ask")
        self.create_subscription(Int64, "/objects", self.hear, 10)
        self.create_subscription(Int64, "/never", self.hear, 10)

    def hear(self, message):
        self.client.call_async(Trigger.Request())


class Server(Node):
    def __init__(self):
        super().__init__("server")
        self.create_service(Trigger, "/ask", lambda request, response: response)
"""
GRAPH = """\
nodes:
  - node: robot:Camera
  - {node: robot:Stage, arguments: {name: detector, hears: /image, says: /objects}}
  - {node: robot:Stage, arguments: {name: tracker, hears: /objects, says: /tracks}}
  - node: robot:Asker
  - node: robot:Server
stop: {duration: 40s}
"""
KNOWN = """\
seed: 5
delay:
  default: {uniform: {min: 1ms, max: 4ms}}
  links: [{topic: /objects, to: /tracker, lognormal: {median: 2ms, sigma: 0.8}}]
execution:
  default: {constant: 700us}
  nodes:
    /detector: {gamma: {mean: 20ms, sd: 8ms}}
    /tracker: {normal: {mean: 9ms, sd: 2ms}}
"""


@dataclass
class Known:
    """A folder with ``truth.yaml`` and its run as if native, ``native.mcap``."""

    folder: Path
    simulated: Path

    def fit(self, *words: str) -> Result:
        return CliRunner().invoke(cli, ["fit", *words], catch_exceptions=False)


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Known:
    folder = tmp_path_factory.mktemp("fit")
    (folder / "robot.py").write_text(NODES)
    (folder / "job.yaml").write_text(GRAPH)
    (folder / "truth.yaml").write_text(f"base: job.yaml\n{KNOWN}")
    simulated = folder / "simulated.mcap"
    record(load_job(folder / "truth.yaml"), simulated)
    as_native(simulated, folder / "native.mcap")
    return Known(folder, simulated)


def drawn(path: Path) -> dict[tuple[int, str, str, str], list[int]]:
    """Return what a simulated run has drawn, by kind of draw, sender, name and receiver."""
    found: dict[tuple[int, str, str, str], list[int]] = {}
    with Trace.open(path) as trace:
        for index in range(trace.event_count):
            sender = -1
            for output in trace.outputs_of(index):
                if output.kind is not OutputKind.DRAW:
                    sender = output.entity
                    continue
                kind, value = output.hash >> BITS, output.hash & (1 << BITS) - 1
                entity = trace.entity(output.entity)
                node = trace.node_of(entity).name
                key = (
                    kind,
                    "" if kind == RandomDecision.EXECUTION else nodes_of(trace, sender),
                    entity.name,
                    node,
                )
                found.setdefault(key, []).append(value)
    return found


def nodes_of(trace: Trace, entity: int) -> str:
    return trace.node_of(trace.entity(entity)).name


def look(path: Path) -> NativeTimes:
    with Trace.open(path) as trace:
        return measure_times(trace)


def test_what_was_drawn_is_what_is_measured(known: Known) -> None:
    """Each time of a callback; of messages those that arrived before the end."""
    truth, found = drawn(known.simulated), look(known.folder / "native.mcap")
    times = {(one.node, one.entity): one.busy.tolist() for one in found.executions}
    expected = {
        (node, name): values
        for (kind, _, name, node), values in truth.items()
        if kind == RandomDecision.EXECUTION
    }
    assert times == expected
    assert len(times) == 6
    links = {(one.topic, one.sender, one.receiver): one for one in found.links}
    assert set(links) == {
        ("/ask", None, ""),
        ("/image", "/camera", "/detector"),
        ("/objects", "/detector", "/asker"),
        ("/objects", "/detector", "/tracker"),
    }
    for (topic, sender, receiver), link in links.items():
        if not link.is_service:
            values = truth[int(RandomDecision.DELAY), sender or "", topic, receiver]
            assert link.delays.tolist() == values[: len(link.delays)]
            assert len(values) - len(link.delays) <= 2
    assert found.idle == (("/asker", "/never"),)
    nodes = ("/asker", "/camera", "/detector", "/server", "/tracker")
    assert sorted(one.nodes for one in found.executors) == [(name,) for name in nodes]


@pytest.mark.parametrize("how", ["tables", pytest.param("distributions", marks=pytest.mark.long)])
def test_the_job_that_comes_out_has_the_distributions_that_went_in(
    known: Known, how: str, tmp_path: Path
) -> None:
    """Each is within what sampling makes of it: D of two samples of this size, at 1 in 1000."""
    output = known.folder / f"{how}.yaml"
    done = known.fit(str(known.folder / "native.mcap"), "-o", str(output), "--as", how, "--json")
    assert done.exit_code == 0, done.output
    truth, job = load_job(known.folder / "truth.yaml"), load_job(output)
    assert job.nodes == truth.nodes
    assert truth.delay is not None
    assert truth.execution is not None
    assert job.delay is not None
    assert job.execution is not None
    by_entity = {(one.node, one.entity): one for one in job.execution.entities}
    pairs = [
        (truth.execution.nodes["/detector"], by_entity["/detector", "/image"]),
        (truth.execution.nodes["/tracker"], by_entity["/tracker", "/objects"]),
        (truth.execution.default, by_entity["/camera", "Camera.tick"]),
        (truth.delay.default, job.delay.services["/ask"]),
    ]
    of_link = {(one.topic, one.receiver): one for one in job.delay.links}
    pairs.append((truth.delay.default, of_link["/image", "/detector"]))
    pairs.append((truth.delay.links[0], of_link["/objects", "/tracker"]))
    for given, found in pairs:
        samples = []
        for spec in (given, found):
            assert spec is not None
            draw = make_distribution(job, spec).sampler(RandomStream(1, "any"), 0)
            samples.append(np.array([draw(0) for _ in range(20_000)]))
        assert ks_distance(*samples) < 1.95 / np.sqrt(780) + 0.02, (given, found)
        if how == "distributions":
            assert found.kinds() == given.kinds()


@pytest.mark.long
def test_the_simulation_of_the_fitted_job_has_the_latencies_of_the_run(
    known: Known, tmp_path: Path
) -> None:
    """Against a run with another seed, as a second run of the robot would be."""
    shutil.copytree(known.folder, tmp_path, dirs_exist_ok=True)
    other = load_job(tmp_path / "truth.yaml", overrides=["seed=99"])
    record(other, tmp_path / "other.mcap")
    as_native(tmp_path / "other.mcap", tmp_path / "second.mcap")
    done = known.fit(
        str(tmp_path / "native.mcap"),
        str(tmp_path / "job.yaml"),
        *("-o", str(tmp_path / "fitted.yaml"), "--check", str(tmp_path / "second.mcap")),
        *("--simulated", str(tmp_path / "again.mcap"), "--json"),
    )
    assert done.exit_code == 0, done.output
    chains = {one["chain"]: one for one in json.loads(done.stdout)["check"]}
    whole = chains["/image → /objects → /tracks"]
    assert whole["far"] == []
    for one in whole["simulated"]["quantiles"]:
        assert one["low"] <= one["ratio"] <= one["high"]
        assert 0.9 < one["ratio"] < 1.1
    assert whole["simulated"]["distance"] < 1.95 * np.sqrt(2 / 780)
    assert whole["simulated"]["p_value"] > 0.001
    assert whole["simulated_to_first"]["distance"] < 1.95 * np.sqrt(2 / 780)
    with Trace.open(tmp_path / "again.mcap") as trace:
        assert trace.complete


@pytest.mark.long
def test_a_series_goes_through_the_run_again(known: Known, tmp_path: Path) -> None:
    """Bursts of load come when they came: not only quantiles, each latency is that of the run."""
    shutil.copytree(known.folder, tmp_path, dirs_exist_ok=True)
    native, output = str(tmp_path / "native.mcap"), tmp_path / "again.yaml"
    done = known.fit(native, str(tmp_path / "job.yaml"), "-o", str(output), "--as", "series")
    assert done.exit_code == 0, done.output
    assert "series of 7" in done.stdout
    record(load_job(output), tmp_path / "again.mcap")
    with Trace.open(native) as first, Trace.open(tmp_path / "again.mcap") as again:
        (one,), (other,) = (
            measure_latencies(trace, start="/image", end="/tracks").chains
            for trace in (first, again)
        )
        a, b = one.durations("latency"), other.durations("latency")
    count = min(len(a), len(b))
    assert count > 750
    assert np.mean(np.abs(a[:count] - b[:count]) < 10_000) > 0.98


def test_what_an_executor_needs_before_a_callback_is_part_of_its_time(
    known: Known, tmp_path: Path
) -> None:
    late = look(as_native(known.simulated, tmp_path / "late.mcap", before_ns=300_000))
    for one, same in zip(
        late.executions, look(known.folder / "native.mcap").executions, strict=True
    ):
        assert one.busy.tolist() == same.busy.tolist()
        assert (one.runs <= one.busy).all()
        assert one.runs.mean() < same.runs.mean()


@pytest.mark.long
def test_a_clock_that_is_set_and_one_that_is_behind(known: Known, tmp_path: Path) -> None:
    """A step leaves out what was on its way; delays are never negative, nor a second long."""

    def stepping(at_ns: int) -> int:
        return at_ns + AHEAD_NS + (10**9 if at_ns % (1 << 50) > 20 * 10**9 else 0)

    start_ns = int(next(iter(_stamps(known.simulated))))
    found = look(
        as_native(
            known.simulated,
            tmp_path / "set.mcap",
            clock=lambda at_ns: stepping(at_ns - start_ns) + start_ns,
        )
    )
    assert found.steps == 1
    for link in found.links:
        assert link.delays.max() < 100 * MS
        assert link.delays.min() >= 0
    assert sum(link.stepped for link in found.links) > 0
    exact = look(known.folder / "native.mcap")
    for one, other in zip(found.executions, exact.executions, strict=True):
        assert len(one.busy) == len(other.busy)
        assert abs(int(one.busy.max()) - int(other.busy.max())) < 100 * MS


def _stamps(path: Path) -> list[int]:
    with Trace.open(path) as trace:
        return [trace.event(0).stamp_ns]


LATE = """
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int64

KEPT = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Map(Node):
    def __init__(self):
        super().__init__("map")
        self.map = self.create_publisher(Int64, "/map", KEPT)
        self.map.publish(Int64(data=1))
        self.create_timer(1.5, lambda: self.map.publish(Int64(data=2)))


class Planner(Node):
    def __init__(self):
        super().__init__("planner")
        self.create_subscription(Int64, "/map", lambda message: None, KEPT)
"""


def test_history_for_a_late_joiner_says_nothing_of_the_link(tmp_path: Path) -> None:
    """It waited for the subscription; as a delay it would be late by that once more."""
    (tmp_path / "late.py").write_text(LATE)
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: late:Map}, {node: late:Planner, start_after: 1s}]\n"
        "start: 9s\ndelay: {default: 3ms}\nstop: {duration: 2s}\n"
    )
    record(load_job(tmp_path / "job.yaml"), tmp_path / "simulated.mcap")
    as_native(tmp_path / "simulated.mcap", tmp_path / "native.mcap")
    (link,) = look(tmp_path / "native.mcap").links
    assert (link.delays.tolist(), link.history) == ([3 * MS], 1)
    fitted = tmp_path / "fitted.yaml"
    done = CliRunner().invoke(cli, ["fit", str(tmp_path / "native.mcap"), "-o", str(fitted)])
    assert "left out 1 message sent before the subscription was created" in done.output
    assert done.output.count("measured fewer than 30 times") == 1, "one note, not one for each"


@pytest.mark.long
def test_messages_of_unknown_senders(known: Known, tmp_path: Path) -> None:
    path = as_native(known.simulated, tmp_path / "unknown.mcap", unknown=frozenset({"/image"}))
    found = look(path)
    senders = {one.topic: one.sender for one in found.links}
    assert senders["/image"] is None
    assert found.unknown > 700
    output = tmp_path / "fitted.yaml"
    done = known.fit(str(path), str(known.folder / "job.yaml"), "-o", str(output))
    assert done.exit_code == 0, done.output
    assert "nobody knows who sent them" in done.stderr
    job = load_job(output)
    assert job.delay is not None
    (link,) = (one for one in job.delay.links if one.topic == "/image")
    assert (link.sender, link.receiver) == ("*", "/detector")


@pytest.mark.long
def test_the_jobs_own_times_are_replaced(known: Known) -> None:
    """Those had no effect natively; the note says so."""
    output = known.folder / "replaced.yaml"
    done = known.fit(
        str(known.folder / "native.mcap"), str(known.folder / "truth.yaml"), "-o", str(output)
    )
    assert done.exit_code == 0, done.output
    assert "in place of the job's own delay, execution" in done.stderr
    job = load_job(output)
    assert job.delay is not None
    assert job.execution is not None
    assert (job.delay.default, job.execution.default, job.execution.nodes) == (None, None, {})
    assert "/asker: the callback of /never never ran" in done.stderr


@pytest.mark.long
def test_what_the_run_was_recorded_with_is_in_the_fitted_job(known: Known, tmp_path: Path) -> None:
    """``--set`` and ``--until`` are in no job file; what a job file cannot say is a note."""
    shutil.copytree(known.folder, tmp_path, dirs_exist_ok=True)
    overrides = [
        "stop.duration=3s",
        "record.payloads=false",
        "execution.default=1ms",
        "nodes.0.parameters.gain=2",
        "guard=false",
        ("--until", 'stop.time="2s"'),
    ]
    record(load_job(tmp_path / "truth.yaml", overrides=overrides), tmp_path / "short.mcap")
    native = as_native(tmp_path / "short.mcap", tmp_path / "short_native.mcap")
    output = tmp_path / "fitted.yaml"
    done = known.fit(str(native), "-o", str(output), "--as", "series")
    assert done.exit_code == 0, done.output
    job = load_job(output)
    assert (job.stop.duration_ns, job.stop.time_ns) == (3000 * MS, 2000 * MS)
    assert not job.record.payloads
    assert job.execution is not None
    assert job.execution.default is None
    assert (
        "recorded with --set nodes.0.parameters.gain=2, --set guard=false, which the "
        "fitted job lacks" in done.stderr
    )


@pytest.mark.long
@pytest.mark.parametrize("text", ["vars: {n: 10}\nseed: $(var n)\n", ""])
def test_a_job_that_is_put_together_has_not_changed(
    known: Known, tmp_path: Path, text: str
) -> None:
    shutil.copytree(known.folder, tmp_path, dirs_exist_ok=True)
    job = tmp_path / "again.yaml"
    job.write_text(f"base: job.yaml\n{text}")
    record(load_job(job, overrides=["stop.duration=1s"]), tmp_path / "short.mcap")
    native = as_native(tmp_path / "short.mcap", tmp_path / "short_native.mcap")
    assert (
        "is not the job of the run"
        not in known.fit(str(native), "-o", str(tmp_path / "f.yaml")).stderr
    )
    job.write_text(f"base: job.yaml\n{text}min_time_step: 1us\n")
    assert (
        "is not the job of the run" in known.fit(str(native), "-o", str(tmp_path / "g.yaml")).stderr
    )


@pytest.mark.long
def test_nodes_that_shared_an_executor_share_one(known: Known, tmp_path: Path) -> None:
    path = as_native(
        known.simulated,
        tmp_path / "shared.mcap",
        together={"/server": "/asker"},
        executor="SingleThreadedExecutor per entry of the job",
    )
    output = tmp_path / "fitted.yaml"
    done = known.fit(str(path), str(known.folder / "job.yaml"), "-o", str(output))
    assert done.exit_code == 0, done.output
    job = load_job(output)
    assert job.executors is not None
    assert [(one.nodes, one.workers) for one in job.executors] == [(("/asker", "/server"), 1)]
    assert job.policy is not None
    assert job.policy.order == "rclpy"


@pytest.mark.long
def test_a_picture(known: Known) -> None:
    pytest.importorskip("matplotlib")
    picture = known.folder / "fit.svg"
    native = str(known.folder / "native.mcap")
    done = known.fit(native, str(known.folder / "job.yaml"), "--plot", str(picture))
    assert done.exit_code == 0, done.output
    drawn_text = picture.read_text()
    assert drawn_text.count('<g id="axes_') == len(look(Path(native)).links) + 6
    bad = known.fit(native, str(known.folder / "job.yaml"), "--plot", str(known.folder / "fit.gif"))
    assert (bad.exit_code, bad.stderr.count("the file name must end in .png, .svg, .pdf")) == (2, 1)


def test_without_the_libraries_the_message_says_what_to_install(
    known: Known, monkeypatch: pytest.MonkeyPatch
) -> None:
    from importlib import util

    real = util.find_spec
    gone = ("scipy", "matplotlib")
    monkeypatch.setattr(util, "find_spec", lambda name: None if name in gone else real(name))
    native = [str(known.folder / "native.mcap"), str(known.folder / "job.yaml")]
    for words in (["--as", "distributions"], ["--plot", str(known.folder / "none.png")]):
        done = known.fit(*native, *words)
        assert done.exit_code == 2
        assert "pip install 'rsltrace[fit]'" in done.stderr
    assert not (known.folder / "none.png").exists()


@pytest.mark.long
def test_mistakes(known: Known, tmp_path: Path) -> None:
    native, job = str(known.folder / "native.mcap"), str(known.folder / "job.yaml")
    simulated = known.fit(str(known.simulated), job)
    assert simulated.exit_code == 2
    assert "is of a simulated run" in simulated.stderr
    assert "rsltrace record --native" in simulated.stderr
    (tmp_path / "native.mcap").symlink_to(native)
    alone = known.fit(str(tmp_path / "native.mcap"))
    assert alone.exit_code == 2
    assert "(truth.yaml) is neith" in alone.stderr
    itself = known.fit(native, job, "-o", job, "--force")
    assert itself.exit_code == 2
    assert "is the job that the fitted one extends" in itself.stderr
    there = known.fit(native, job, "-o", job)
    assert (there.exit_code, "use --force to replace it" in there.stderr) == (2, True)
    for words in (["--check", native], ["--simulated", "x.mcap"]):
        assert known.fit(native, job, *words).exit_code == 2
    wrong = known.fit(native, job, "-o", str(tmp_path / "f.yaml"), "--check", str(known.simulated))
    assert (wrong.exit_code, "is not of a native run" in wrong.stderr) == (2, True)
