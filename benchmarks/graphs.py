"""The node graphs of the benchmarks, and one way to run each: on DDS, or under rsltrace.

Both ways use the very same node classes, from ``examples/``. A measurement happens in the process
that calls :func:`run_native` or :func:`run_rsltrace`, so call them in a fresh interpreter.
"""

from __future__ import annotations

import importlib
import json
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

# Bound before rsltrace is imported: under it, ``time.perf_counter`` may tell simulated time.
from time import perf_counter, process_time, sleep
from typing import Any

BENCHMARKS = Path(__file__).resolve().parent
EXAMPLES = BENCHMARKS.parent / "examples"

WARM_UP_S = 0.5
"""How long a native graph runs, after every node has had work, before it is measured."""

DISCOVERY_S_MAX = 20.0
"""A native graph that has not come alive after this long never will."""


@dataclass(frozen=True, slots=True)
class Graph:
    """A graph that can be built as rclpy nodes or described as a job.

    ``native_args`` are given to ``rclpy.init``; ``make_native`` returns the nodes, each with a
    ``callbacks`` counter. ``job`` returns a job of about so many callbacks, as job.yaml has it. A
    graph that takes long to construct is run ``longer`` times as long; one whose callbacks take
    long, less.
    """

    name: str
    title: str
    native_args: tuple[str, ...]
    make_native: Callable[[], list[Any]] | None
    job: Callable[[int], dict[str, Any]]
    longer: float = 1


def _from_example(folder: str, module: str) -> Any:
    sys.path.insert(0, str(EXAMPLES / folder))
    return importlib.import_module(module)


def _ping_pong_nodes() -> list[Any]:
    module = _from_example("ping_pong", "ping_pong")
    return [module.Ping(), module.Pong()]


def _ping_pong_job(callbacks: int) -> dict[str, Any]:
    messages = max(1, callbacks // 2)
    return {
        "nodes": [
            {"node": "ping_pong:Ping", "parameters": {"messages": messages, "burst": True}},
            {"node": "ping_pong:Pong"},
        ],
        "search_path": [str(EXAMPLES / "ping_pong")],
        "livelock_limit": 10 * (callbacks + 100),
        "stop": {"topic": {"name": "/ping_pong/done", "exit_code": "data"}},
    }


def _eight_nodes() -> list[Any]:
    # Over DDS timers run on wall time. A period that no executor can keep leaves it never idle,
    # which is what makes its cost per callback visible; one period for all timers gives the mix
    # of callbacks that the job below has, too.
    nodes: list[Any] = _from_example("benchmark8", "benchmark8").make_nodes(1, period=1e-6)
    return nodes


CALLBACKS_PER_PERIOD = 17
"""What one group of the eight-node graph does each time all its timers fire."""


def _groups_job(groups: int) -> Callable[[int], dict[str, Any]]:
    def job(callbacks: int) -> dict[str, Any]:
        periods = max(1, callbacks // (CALLBACKS_PER_PERIOD * groups))
        arguments = {"groups": groups, "period": 0.001}
        return {
            "nodes": [{"node": "benchmark8:make_nodes", "arguments": arguments}],
            "search_path": [str(EXAMPLES / "benchmark8")],
            "stop": {"duration": f"{periods}ms"},
        }

    return job


EVENTS_PER_GOAL = 14
"""What an action's goal is: request, answer, status, feedback, result and their callbacks."""

EVENTS_PER_CALL = 3
"""What a blocking call is: the caller that goes on, the service, the response."""


def _action_nodes() -> list[Any]:
    import usual_nodes

    return [usual_nodes.Asker(), usual_nodes.Worker()]


def _action_job(callbacks: int) -> dict[str, Any]:
    goals = max(1, callbacks // EVENTS_PER_GOAL)
    return {
        "nodes": [
            {"node": "usual_nodes:Asker", "parameters": {"goals": goals}},
            {"node": "usual_nodes:Worker"},
        ],
        "search_path": [str(BENCHMARKS)],
        "livelock_limit": 10 * (callbacks + 100),
        "stop": {"topic": {"name": "/asker/done", "exit_code": "data"}},
    }


def _mains_job(callbacks: int) -> dict[str, Any]:
    job = _ping_pong_job(callbacks)
    ping, pong = job["nodes"]
    ping["main"], pong["main"] = "usual_nodes:ping", "usual_nodes:pong"
    del ping["node"], pong["node"]
    job["search_path"].append(str(BENCHMARKS))
    return job


def _calls_job(callbacks: int) -> dict[str, Any]:
    calls = max(1, callbacks // EVENTS_PER_CALL)
    return {
        "nodes": [
            {"main": "usual_nodes:call", "parameters": {"calls": calls}},
            {"main": "usual_nodes:serve"},
        ],
        "search_path": [str(BENCHMARKS)],
        "livelock_limit": 10 * (callbacks + 100),
        "stop": {"topic": {"name": "/caller/done", "exit_code": "data"}},
    }


GRAPHS = {
    graph.name: graph
    for graph in (
        Graph(
            "ping_pong",
            "two-node ping-pong",
            ("--ros-args", "-p", "messages:=0", "-p", "burst:=true", "-p", "period:=0.1"),
            _ping_pong_nodes,
            _ping_pong_job,
        ),
        Graph("graph8", "graph of 8 nodes", (), _eight_nodes, _groups_job(1)),
        Graph("graph200", "graph of 200 nodes", (), None, _groups_job(25), longer=4),
        Graph("actions", "goals, one after the other", (), _action_nodes, _action_job, longer=0.25),
        Graph("mains", "ping-pong of two mains that spin", (), None, _mains_job, longer=0.5),
        Graph("calls", "blocking calls of a main", (), None, _calls_job, longer=0.5),
    )
}

EXECUTORS = ("single_threaded", "multi_threaded", "events_executor")


def run_native(
    graph: Graph,
    executor_name: str,
    seconds: float,
    *,
    count: Callable[[Any], int] = lambda node: int(node.callbacks),
) -> dict[str, Any]:
    """Spin ``graph`` over DDS and count its callbacks for ``seconds`` of wall time.

    ``count`` says what to count of a node instead.

    Returns ``{"callbacks": n, "wall_s": s, "cpu_s": s}``, CPU time being that of all threads.
    Raises RuntimeError if the graph does not come alive.
    """
    import rclpy
    from rclpy.executors import (
        ExternalShutdownException,
        MultiThreadedExecutor,
        SingleThreadedExecutor,
    )
    from rclpy.experimental import EventsExecutor

    if graph.make_native is None:
        raise RuntimeError(f"{graph.name} is not meant to be run over DDS")
    rclpy.init(args=list(graph.native_args))
    nodes = graph.make_native()
    executor = {
        "single_threaded": SingleThreadedExecutor,
        "multi_threaded": MultiThreadedExecutor,
        "events_executor": EventsExecutor,
    }[executor_name]()
    for node in nodes:
        executor.add_node(node)

    measured: dict[str, Any] = {}
    enough: Any = rclpy.Future()
    left = threading.Event()

    def counted() -> int:
        return sum(map(count, nodes))

    def measure() -> None:
        # Sampling from a thread that sleeps leaves the executor alone.
        given_up = perf_counter() + DISCOVERY_S_MAX
        while not all(node.callbacks for node in nodes) and perf_counter() < given_up:
            sleep(0.05)
        sleep(WARM_UP_S)
        first, start, cpu_start = counted(), perf_counter(), process_time()
        sleep(seconds)
        measured["callbacks"], measured["wall_s"] = counted() - first, perf_counter() - start
        measured["cpu_s"] = process_time() - cpu_start
        measured["idle"] = [node.get_name() for node in nodes if not node.callbacks]
        enough.set_result(None)
        if not left.wait(2.0):
            rclpy.try_shutdown()  # nothing happens any more that would end spin_once()

    sampler = threading.Thread(target=measure)
    sampler.start()
    try:
        if executor_name == "events_executor":
            # In the 7.1.6 wheels its waits without a time limit spin on a mutex and starve the
            # threads that would bring work: 100 % CPU, no callbacks. With a limit it is well.
            while not enough.done():
                executor.spin_until_future_complete(enough, timeout_sec=1.0)
        else:
            while not enough.done():
                executor.spin_once()  # spin() is this loop
    except ExternalShutdownException:
        pass
    left.set()
    sampler.join()
    if measured["idle"] or not measured["callbacks"]:
        raise RuntimeError(
            f"{graph.name} did not run over DDS: {measured['callbacks']} callbacks in "
            f"{seconds} s, nodes without any: {', '.join(measured['idle']) or 'none'}"
        )
    return measured


class Spent:
    """Wall and CPU time that some methods have taken, in seconds."""

    def __init__(self) -> None:
        self.wall_s = 0.0
        self.cpu_s = 0.0

    @contextmanager
    def timing(self, owner: type, name: str) -> Iterator[None]:
        """Add up what calls of a method take within the ``with`` block."""
        method = getattr(owner, name)

        def timed(*args: Any, **named: Any) -> Any:
            start, cpu_start = perf_counter(), process_time()
            try:
                return method(*args, **named)
            finally:
                self.wall_s += perf_counter() - start
                self.cpu_s += process_time() - cpu_start

        setattr(owner, name, timed)
        try:
            yield
        finally:
            setattr(owner, name, method)


def run_rsltrace(
    graph: Graph,
    callbacks: int,
    folder: Path,
    *,
    record: bool,
    delayed: bool = False,
    guarded: bool = True,
) -> dict[str, Any]:
    """Run ``graph`` for about ``callbacks`` events under rsltrace, in ``folder``.

    ``delayed`` gives every link a random delay, shorter than any period; without ``guarded`` the
    job says ``guard: false``.
    Returns ``{"callbacks": n, "wall_s": s, "cpu_s": s, "start_up_s": s, "digest": d, "bytes":
    size}``. The times are those of the loop and of closing the trace; start-up, in wall time, is
    all the rest. Raises ImportError if rsltrace cannot record.
    """
    sys.path.insert(0, str(EXAMPLES.parent))  # the checkout this file is in, installed or not
    from rsltrace import load_job
    from rsltrace import record as record_job
    from rsltrace.run.session import RunSession
    from rsltrace.trace.writer import TraceWriter

    job_path = folder / "job.yaml"
    job = graph.job(callbacks)
    if delayed:
        job["delay"] = {"default": {"uniform": {"min": "10us", "max": "90us"}}}
    if not guarded:
        job["guard"] = False
    job_path.write_text(json.dumps(job))  # JSON is YAML
    output = folder / "run.mcap" if record else None
    spent = Spent()
    start = perf_counter()
    with spent.timing(RunSession, "go_on"), spent.timing(TraceWriter, "close"):
        result = record_job(load_job(job_path), output=output, force=True)
    return {
        "callbacks": int(result.events),
        "wall_s": spent.wall_s,
        "cpu_s": spent.cpu_s,
        "start_up_s": perf_counter() - start - spent.wall_s,
        "digest": str(result.digest),
        "bytes": output.stat().st_size if output else 0,
    }
