"""A job of plain nodes, run natively: a process for each node, over DDS, in real time.

    python benchmarks/explore_native.py campaigns/explore/bugs/order/late_tf/job.yaml --seconds 20

Says in how many of the runs that fit into the time the job's checks were violated. The nodes are
constructed and find each other; then all of their timers start together, so that what counts is
what the nodes do and not how long discovery takes. An observer subscribes to what the checks speak
of. A job's delays, losses, clocks and execution times are not imitated: that is the comparison.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsltrace import Job, load_job
from rsltrace.checks.conditions.names import RunNames
from rsltrace.checks.conditions.view import SentOutput
from rsltrace.checks.evaluate import condition, opposite, title, topic_of, with_topic_prefix
from rsltrace.checks.properties import EventuallyProperty, NeverProperty, RateProperty, RunProperty
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.texts import NS_PER_S

DISCOVERY_S_MAX = 30.0
SETTLE_S = 0.2
TURN_S = 0.02
"""One timeout for all turns: rclpy's executor begins anew where it changes, and serves only
coroutines that wait then."""

NAMES = RunNames()


@dataclass
class Seen:
    """A message that the observer has received, as checks see an event."""

    index: int
    stamp_ns: int
    output: SentOutput
    kind: int = int(EventKind.SUBSCRIPTION)
    entity: int = 0
    entity_name: str = ""
    node: str = ""
    output_hash: int = 0

    def nodes(self) -> dict[str, object]:
        return {}

    def received(self) -> None:
        return None

    def sent(self) -> Sequence[SentOutput]:
        return [self.output]

    def findings(self) -> Sequence[str]:
        return []


@dataclass
class Start:
    """The moment at which the timers start."""

    stamp_ns: int = 0

    def nodes(self) -> dict[str, object]:
        return {}


def properties(job: Job) -> dict[str, RunProperty]:
    """Return what the checks of a job say, by their titles."""
    found: dict[str, RunProperty] = {}
    for spec in job.checks:
        if spec.rate is not None:
            over_ns = spec.over_ns or NS_PER_S
            found[title(spec)] = RateProperty(spec.rate, spec.at_least, spec.at_most, over_ns)
            continue
        text = spec.always or spec.never or spec.eventually
        assert text is not None, f"{job.source_name}: a function takes a trace"
        what = (opposite if spec.always else condition)(text, NAMES).arm(Start())
        after = None if spec.after is None else condition(spec.after, NAMES).arm(Start())
        kind = EventuallyProperty if spec.eventually else NeverProperty
        found[title(spec)] = kind(what, after, spec.within_ns)
    return found


def topics(job: Job) -> set[str]:
    """Return the topics that the checks of a job speak of."""
    texts = [t for s in job.checks for t in (s.always, s.never, s.eventually, s.after) if t]
    found = {topic for text in texts if (topic := topic_of(with_topic_prefix(text)))}
    return found | {spec.rate for spec in job.checks if spec.rate}


# -- processes of a run ----------------------------------------------------------------------------


def construct(job: Job, index: int) -> Any:
    """Initialize rclpy and construct a node of the job."""
    import rclpy

    spec = job.nodes[index]
    words = ["--ros-args"]
    if spec.name:
        words += ["-r", f"__node:={spec.name}"]
    for name, value in (spec.parameters or {}).items():
        words += ["-p", f"{name}:={json.dumps(value)}"]
    rclpy.init(args=words)
    sys.path[:0] = [str(job.resolve(folder)) for folder in job.search_path]
    module, _, attribute = str(spec.node).partition(":")
    return getattr(importlib.import_module(module), attribute)()


def meet(node: Any, count: int, ready: Any, go: Any) -> float:
    """Wait until all nodes know each other; return when the run begins (``time.monotonic``)."""
    import rclpy

    end = time.monotonic() + DISCOVERY_S_MAX
    while len(node.get_node_names()) < count:
        if time.monotonic() > end:
            raise SystemExit("the nodes do not find each other")
        rclpy.spin_once(node, timeout_sec=0.01)
    ready.release()
    if not go.acquire(timeout=DISCOVERY_S_MAX):
        raise SystemExit("the others have not come")
    return time.monotonic()


def run_node(job: Job, index: int, seconds: float, ready: Any, go: Any) -> None:
    """Be a node. The exit status is 3 when a callback raises."""
    import rclpy
    from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor

    node = construct(job, index)
    many = any((executor.workers or 1) > 1 for executor in job.executors or ())
    executor = MultiThreadedExecutor(4) if many else SingleThreadedExecutor()
    timers = list(node.timers)
    for timer in timers:  # from here on discovery has no part in it
        timer.cancel()
    end = meet(node, len(job.nodes) + 1, ready, go) + seconds
    for timer in timers:
        timer.reset()
    executor.add_node(node)
    try:
        while time.monotonic() < end and rclpy.ok():
            executor.spin_once(timeout_sec=TURN_S)
    except Exception:
        os._exit(3)
    os._exit(0)


def observe(job: Job, seconds: float, ready: Any, go: Any, told: Any) -> None:
    """Be the observer: tell which checks were violated."""
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    rclpy.init()
    node = rclpy.create_node("observer_of_checks")
    held = properties(job)
    begin, count = 0.0, 0

    def on_message(topic: str, message: Any) -> None:
        nonlocal count
        if not begin:
            return
        stamp_ns = int((time.monotonic() - begin) * 1e9)
        if topic == "/rosout":
            output = SentOutput(int(OutputKind.LOG), topic, 0, message.msg, message.level)
        else:
            output = SentOutput(int(OutputKind.MESSAGE), topic, 0, message=lambda: message)
        seen = Seen(count, stamp_ns, output)
        count += 1
        for one in held.values():
            one.see(seen)

    wanted = {*topics(job), "/rosout"}
    subscribed: set[str] = set()
    qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
    end = time.monotonic() + DISCOVERY_S_MAX
    while subscribed < wanted and time.monotonic() < end:
        for topic, types in node.get_topic_names_and_types():
            if topic in wanted - subscribed:
                subscribed.add(topic)
                package, _, name = types[0].split("/")
                kind = getattr(importlib.import_module(f"{package}.msg"), name)
                node.create_subscription(kind, topic, lambda m, t=topic: on_message(t, m), qos)
        rclpy.spin_once(node, timeout_sec=0.01)
    begin = meet(node, len(job.nodes) + 1, ready, go)
    while (left := begin + seconds - time.monotonic()) > 0:
        rclpy.spin_once(node, timeout_sec=left)
    for one in held.values():
        one.end(int(seconds * 1e9), complete=True)
    told.send([name for name, one in held.items() if one.count])
    os._exit(0)


def run_once(job: Job, seconds: float) -> list[str]:
    """Run the job natively; return what was violated.

    :raises RuntimeError: the run did not come about.
    """
    context = multiprocessing.get_context("fork")
    ready, go = context.Semaphore(0), context.Semaphore(0)
    receive, told = context.Pipe(duplex=False)
    nodes = [
        context.Process(target=run_node, args=(job, index, seconds, ready, go))
        for index in range(len(job.nodes))
    ]
    everybody = [context.Process(target=observe, args=(job, seconds, ready, go, told)), *nodes]
    for one in everybody:
        one.start()
    try:
        for _ in everybody:
            if not ready.acquire(timeout=2 * DISCOVERY_S_MAX):
                raise RuntimeError("the nodes do not find each other")
        time.sleep(SETTLE_S)  # endpoints match after the nodes have met
        for _ in everybody:
            go.release()
        if not receive.poll(seconds + DISCOVERY_S_MAX):
            raise RuntimeError("the observer has not answered")
        violated: list[str] = receive.recv()
        for one in nodes:
            one.join(5)
        return violated + [f"{n.name} raised" for n in nodes if n.exitcode == 3]
    finally:
        for one in everybody:
            one.kill()
            one.join()


def run_for(path: Path, budget_s: float) -> dict[str, Any]:
    """Run a job again and again; return how many runs there were, and how many violated what."""
    job = load_job(path)
    seconds = (job.stop.duration_ns or NS_PER_S) / 1e9
    begun = time.monotonic()
    runs, violated, problems = 0, 0, []
    whys: set[str] = set()
    while time.monotonic() - begun < budget_s:
        os.environ["ROS_DOMAIN_ID"] = str(1 + (os.getpid() + runs) % 100)
        try:
            why = run_once(job, seconds)
        except RuntimeError as error:
            problems.append(str(error))
            continue
        runs += 1
        violated += bool(why)
        whys.update(why)
    return {"runs": runs, "violated": violated, "why": sorted(whys), "problems": problems}


def main() -> None:
    """Run one job and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("job", type=Path)
    parser.add_argument("--seconds", type=float, default=20.0, help="wall time")
    options = parser.parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with tempfile.TemporaryDirectory() as logs:
        os.environ["ROS_LOG_DIR"] = logs
        import rclpy.executors  # noqa: F401

        print(json.dumps(run_for(options.job, options.seconds)))


if __name__ == "__main__":
    main()
