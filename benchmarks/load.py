"""What much of everything costs, per unit, and whether more of it costs more each.

    python benchmarks/load.py                    everything, about ten minutes
    python benchmarks/load.py --scale 0.1        a tenth of everything, a minute or two
    python benchmarks/load.py --only logs        cases whose name contains "logs"
    python benchmarks/load.py --json             the same figures for a machine

Every measurement is a process of its own, which first does a small run, so that loading modules is
in no figure. Counted is CPU time from the first node's construction to the closed trace (everything
is recorded), less what a run of one unit takes, divided by the number of units. Each case is
measured in several sizes; ``x before`` is what a unit costs compared with the size before: 1 where
cost is linear.

For large messages a unit is a megabyte of one, from ``publish`` through one subscription's
callback, and is compared with what copying it once takes, with and without a recording. For events,
memory is what counts: how much the process has grown since a tenth of them had run.
"""

from __future__ import annotations

import argparse
import array
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

WORKER_S_MAX = 1800
MESSAGES = 5


@dataclass(frozen=True)
class Case:
    """Something there can be much of. ``aim`` is microseconds per unit, if there is one."""

    name: str
    unit: str
    sizes: tuple[int, ...]
    work: Callable[[int, Path], dict[str, float]]
    aim: float | None = None


# -- nodes -----------------------------------------------------------------------------------------


def make_nodes(count: int, timers: int = 0) -> list[Any]:
    """Return nodes, each with so many timers."""
    from rclpy.node import Node

    def idle() -> None:
        pass

    nodes = [Node(f"node_{index}") for index in range(count)]
    for node in nodes:
        for index in range(timers):
            node.create_timer(1.0 + index * 1e-6, idle)
    return nodes


def make_logger(records: int) -> Any:
    """Return a node that logs so often within two seconds, at one line of its code."""
    from rclpy.node import Node

    node = Node("logger")
    timers = min(records, 100)
    each = records // timers

    def log() -> None:
        logger = node.get_logger()
        for index in range(each):
            logger.info(f"record {index}")

    for index in range(timers):
        node.create_timer(1.0 + index * 1e-6, log)
    return node


def make_camera(size: int) -> list[Any]:
    """Return a node that publishes so many bytes each second, and one that listens."""
    from rclpy.node import Node
    from std_msgs.msg import UInt8MultiArray

    camera, display = Node("camera"), Node("display")
    block = os.urandom(min(size, 1 << 20))
    image = UInt8MultiArray(data=array.array("B", block * (size // len(block))))
    publisher = camera.create_publisher(UInt8MultiArray, "image", 1)
    camera.create_timer(1.0, lambda: publisher.publish(image))
    display.create_subscription(UInt8MultiArray, "image", lambda message: None, 1)
    return [camera, display]


def make_pair() -> list[Any]:
    """Return a node that publishes every millisecond, and one that listens."""
    from rclpy.node import Node
    from std_msgs.msg import UInt64

    talker, listener = Node("talker"), Node("listener")
    publisher = talker.create_publisher(UInt64, "count", 10)
    message = UInt64()
    talker.create_timer(0.001, lambda: publisher.publish(message))
    listener.create_subscription(UInt64, "count", lambda message: None, 10)
    return [talker, listener]


# -- runs ------------------------------------------------------------------------------------------


def run(job: Any, output: Path | None, during: Callable[[Any], None] | None = None) -> float:
    """Run a job; return the CPU seconds it took from the first node to the closed trace."""
    from rsltrace import Simulation

    began = time.process_time()
    with Simulation(job, output, force=True) as simulation:
        if during is None:
            simulation.run()
        else:
            during(simulation)
    return time.process_time() - began


def job_of(make: Callable[[], Any], seconds: float) -> Any:
    """Return a job of what a function makes."""
    from rsltrace import Job, NodeSpec, StopSpec

    return Job(nodes=[NodeSpec(node=make)], stop=StopSpec(duration=seconds))


def warm(folder: Path) -> None:
    """Load all modules and generate the codecs."""
    run(job_of(make_pair, 0.01), folder / "warm.mcap")
    run(job_of(partial(make_logger, 1), 2), folder / "warm.mcap")


def per_unit(work: Callable[[int], float], count: int) -> dict[str, float]:
    """Measure ``count`` units; what every run takes, however small, is in no figure."""
    least_s = min(work(1), work(1))
    return {"us": (work(count) - least_s) / count * 1e6}


def of_nodes(count: int, folder: Path) -> dict[str, float]:
    """Make nodes in one go."""
    output = folder / "load.mcap"
    return per_unit(lambda n: run(job_of(partial(make_nodes, n), 0.01), output), count)


def of_entries(count: int, folder: Path) -> dict[str, float]:
    """Make nodes by a job file with an entry for each, which is read in that time, too."""
    (folder / "load_nodes.py").write_text(
        "from rclpy.node import Node\n\n\nclass One(Node):\n"
        "    def __init__(self):\n        super().__init__('one')\n"
    )

    def work(entries: int) -> float:
        lines = [f"  - {{node: load_nodes:One, name: node_{index}}}" for index in range(entries)]
        path = folder / "job.yaml"
        path.write_text("nodes:\n" + "\n".join(lines) + "\nstop: {duration: 10ms}\n")
        return run(path, folder / "load.mcap")

    return per_unit(work, count)


def of_timers(count: int, folder: Path) -> dict[str, float]:
    """Make timers in one node; each ticks once."""
    output = folder / "load.mcap"
    return per_unit(lambda n: run(job_of(partial(make_nodes, 1, n), 1.5), output), count)


def of_logs(count: int, folder: Path) -> dict[str, float]:
    """Log, with what a callback costs now and then."""
    output = folder / "load.mcap"
    return per_unit(lambda n: run(job_of(partial(make_logger, n), 1.5), output), count)


def of_messages(size: int, folder: Path) -> dict[str, float]:
    """Send large messages; also say how many times the copying of their bytes that takes."""
    data = array.array("B", bytes(size))
    began = time.process_time()
    for _ in range(MESSAGES):
        data[:]
    copy_s = (time.process_time() - began) / MESSAGES
    del data
    job = job_of(partial(make_camera, size), MESSAGES + 0.5)
    spent: dict[bool, float] = {}

    def during(recorded: bool, simulation: Any) -> None:
        before = time.process_time()
        simulation.run()
        spent[recorded] = (time.process_time() - before) / MESSAGES

    for recorded in (False, True):
        run(job, folder / "load.mcap" if recorded else None, partial(during, recorded))
    return {
        "us": spent[True] / size * 1e12,
        "copies": spent[False] / copy_s,
        "recorded_copies": spent[True] / copy_s,
    }


def of_events(count: int, folder: Path) -> dict[str, float]:
    """Run that many events; also say how many kB the last nine tenths of them have taken."""
    seconds = count / 2000
    before = [0]

    def during(simulation: Any) -> None:
        simulation.run_for(seconds / 10)
        before[0] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        simulation.run()

    cpu_s = run(job_of(make_pair, seconds), folder / "load.mcap", during)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before[0]
    return {"us": cpu_s / count * 1e6, "grown_kb": grown}


CASES = (
    Case("nodes", "node", (100, 400, 1000), of_nodes),
    Case("entries", "entry of a job", (100, 400, 1000), of_entries),
    Case("timers", "timer that ticks once", (5_000, 20_000), of_timers),
    Case("logs", "log record", (2_000, 20_000), of_logs, aim=60),
    Case(
        "messages",
        "MB of a message of so many bytes, recorded",
        (20_000_000, 200_000_000),
        of_messages,
    ),
    Case("events", "event", (1_000_000, 10_000_000), of_events),
)


# -- measuring and telling -------------------------------------------------------------------------


def measure(case: Case, size: int) -> dict[str, Any]:
    """Measure one size of a case in a fresh interpreter; return figures or what went wrong."""
    with tempfile.TemporaryDirectory(prefix="rsltrace-load-") as folder:
        command = [sys.executable, __file__, "--worker", case.name, str(size), folder]
        environment = os.environ | {"PYTHONHASHSEED": "0"}
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=WORKER_S_MAX
            )
        except subprocess.TimeoutExpired:
            return {"problem": f"no result after {WORKER_S_MAX} s"}
    for line in reversed(done.stdout.splitlines()):
        if line.startswith("{"):
            figures: dict[str, Any] = json.loads(line)
            return figures
    last = done.stderr.strip().splitlines()[-1:] or ["no output"]
    return {"problem": f"exit status {done.returncode}: {last[0]}"}


def measured(case: Case, scale: float, repeat: int) -> list[dict[str, Any]]:
    """Measure all sizes of a case, each the best of ``repeat``, and compare each with the last."""
    found: list[dict[str, Any]] = []
    for size in dict.fromkeys(max(10, int(size * scale)) for size in case.sizes):
        print(f"{case.name} {size:,}", file=sys.stderr, flush=True)
        runs = [measure(case, size) for _ in range(repeat)]
        best = min(runs, key=lambda one: one.get("us", float("inf")))
        best = {"case": case.name, "size": size} | best
        if found and "us" in best and "us" in found[-1]:
            best["x_before"] = best["us"] / found[-1]["us"]
        found.append(best)
    return found


def tell(case: Case, found: list[dict[str, Any]]) -> None:
    """Print what was found of one case."""
    print(f"\nCPU time per {case.unit}")
    for one in found:
        if "problem" in one:
            print(f"  {one['size']:>12,}  {one['problem']}")
            continue
        line = f"  {one['size']:>12,}{one['us']:>14,.1f} µs"
        if "x_before" in one:
            line += f"   x before {one['x_before']:.2f}"
        if case.aim is not None:
            line += f"   (aim {case.aim:g}: {'reached' if one['us'] <= case.aim else 'missed'})"
        if "copies" in one:
            line += (
                f"   {one['copies']:.1f} times copying its bytes, "
                f"recorded {one['recorded_copies']:.1f}"
            )
        if "grown_kb" in one:
            line += f"   grown by {one['grown_kb'] / 1024:.1f} MB over the last nine tenths"
        print(line)


def main() -> int:
    """Measure and print. Returns the exit status: 1 if a case failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--scale", type=float, default=1.0, help="how much of everything (1: all)")
    parser.add_argument("--repeat", type=int, default=1, help="how often each size is measured")
    parser.add_argument("--only", action="append", help="cases whose name contains this")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--worker", nargs=3, metavar=("CASE", "SIZE", "FOLDER"), help="internal")
    options = parser.parse_args()
    if options.worker:
        name, size, folder = options.worker
        warm(Path(folder))
        case = next(case for case in CASES if case.name == name)
        print(json.dumps(case.work(int(size), Path(folder))), flush=True)
        return 0
    if not options.scale > 0 or options.repeat < 1:
        parser.error("--scale must be above 0, --repeat at least 1")
    wanted = [c for c in CASES if not options.only or any(o in c.name for o in options.only)]
    if not wanted:
        print("\n".join(case.name for case in CASES))
        return 2
    everything = []
    for case in wanted:
        found = measured(case, options.scale, options.repeat)
        everything += found
        if not options.json:
            tell(case, found)
    if options.json:
        print(json.dumps(everything, indent=2))
    return int(any("problem" in one for one in everything))


if __name__ == "__main__":
    sys.exit(main())
