"""How fast a search is: forks from a common prefix, runs per second, memory of a worker.

    python benchmarks/explore_speed.py fork              from a prefix against from the beginning
    python benchmarks/explore_speed.py throughput        against a loop of "rsltrace record"
    python benchmarks/explore_speed.py memory            10,000 short runs of one worker

``fork`` makes runs of one job forked and from the beginning in turn, with the same orders, and
compares their digests; what it prints is processor time of the worker and all of its copies.
``throughput`` is real time, so it wants a quiet machine: whole searches (``--runs`` each) with one
and two workers here and four on a LocalCluster of Dask, in ``--rounds`` turns, medians.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rsltrace.job.values.times import parse_time
from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.trial import JobSource, Trial
from rsltrace.search.explore.workers import Worker

ROOT = Path(__file__).resolve().parents[1]
SHORT = ROOT / "campaigns/explore/bugs/order/command_after_stop/job.yaml"
TICKS = os.sysconf("SC_CLK_TCK")

NODES = """
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node


class Sensor(Node):
    def __init__(self):
        super().__init__('sensor')
        self.publisher = self.create_publisher(Odometry, 'odom', 10)
        self.create_timer(0.01, lambda: self.publisher.publish(Odometry()))


class Controller(Node):
    def __init__(self):
        super().__init__('controller')
        self.odom = None
        self.publisher = self.create_publisher(Twist, 'cmd_vel', 10)
        self.create_subscription(Odometry, 'odom', self.keep, 10)
        self.create_timer(0.01, self.tick)

    def keep(self, message):
        self.odom = message

    def tick(self):
        WORK
        command = Twist()
        command.linear.x = 0.0 if self.odom is None else 1.0
        self.publisher.publish(command)
"""
WORK = {
    "nothing else": "pass",
    "0.3 ms of Python in each tick": "sum(i * i for i in range(4000))",
}
JOB = """\
nodes: [{node: graph_of_a_search:Sensor}, {node: graph_of_a_search:Controller}]
stop: {duration: END}
"""


def cpu_s(pid: int) -> float:
    """Return the processor time of a process, its children and those that it has waited for."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, words[11:15])) / TICKS + sum(map(cpu_s, children_of(pid)))


def children_of(pid: int) -> list[int]:
    """Return the processes that a process has started and that are there."""
    return list(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))


def rss_kb(pid: int) -> int:
    """Return the resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0])


def pid_of(worker: Worker) -> int:
    """Return the id of a worker's process, which has run something."""
    assert worker._process is not None
    return worker._process.pid


def fork(runs: int) -> None:
    """Print what a run costs that is forked after 30 of 31 seconds, and one from the beginning."""
    for work, line in WORK.items():
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "graph_of_a_search.py").write_text(NODES.replace("WORK", line))
            (folder / "job.yaml").write_text(JOB.replace("END", "31s"))
            both, digests = {}, {}
            for fork_ns in (-1, 30 * 10**9):
                with Worker(JobSource(str(folder / "job.yaml"))) as worker:
                    wants = TrialOptions(fork_ns=fork_ns)
                    seen = []
                    # The first run loads what runs need, the second one makes the prefix.
                    for number in range(2 + runs):
                        if number == 2:
                            began_s = cpu_s(pid_of(worker))
                        order = {"order": "permutation", "after": "30s", "seed": number}
                        trial = Trial(number, {"policy": order})
                        found = worker.run(trial, folder / "run.mcap", wants)
                        assert number < 1 or found.is_forked == (fork_ns >= 0)
                        seen.append(found.digest)
                    both[fork_ns] = (cpu_s(pid_of(worker)) - began_s) / runs
                    digests[fork_ns] = seen
                    events = found.events
            assert digests[-1] == digests[30 * 10**9], "they are not the same runs"
            whole, forked = both.values()
            print(
                f"{work}: {events} events, from the beginning {whole:.3f} s of processor time a "
                f"run, forked after 30 of 31 s {forked:.3f} s: {whole / forked:.1f} times as fast, "
                f"{runs} runs each, same digests"
            )


def memory(runs: int, job: Path, fork_after: str | None) -> None:
    """Print the memory of one worker after some of its runs, and of the process that it forks from
    if ``fork_after`` says when."""
    fork_ns = -1 if fork_after is None else parse_time(fork_after)
    order = {"order": "permutation", **({} if fork_after is None else {"after": fork_after})}
    wants = TrialOptions(behaviours=True, fork_ns=fork_ns)
    with tempfile.TemporaryDirectory() as folder, Worker(JobSource(str(job))) as worker:
        began_s = time.monotonic()
        for number in range(1, runs + 1):
            trial = Trial(number, {"policy": {**order, "seed": number}})
            found = worker.run(trial, Path(folder, "run.mcap"), wants)
            assert number == 1 or found.is_forked == (fork_ns >= 0)
            if found.trace is not None:
                Path(found.trace).unlink()
            if number in (10, 100, 300) or number % 1000 == 0:
                rate = number / (time.monotonic() - began_s)
                print(f"{number} runs, {rate:.1f}/s", end="", flush=True)
                for pid in (pid_of(worker), *children_of(pid_of(worker))):
                    open_files = len(os.listdir(f"/proc/{pid}/fd"))
                    print(f"; {rss_kb(pid)} kB, {open_files} descriptors", end="")
                print(flush=True)


def quietly(command: list[str]) -> None:
    """Run a command that says 0 or 1 in the end."""
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode in (0, 1), done.stderr


def throughput(runs: int, rounds: int, job: Path) -> None:
    """Print runs per second, of a loop of ``record`` and of searches."""
    from distributed import LocalCluster

    def search(*words: str) -> Callable[[Path], None]:
        command = [sys.executable, "-m", "rsltrace", "explore", str(job), "--strategy", "random"]

        def run(folder: Path) -> None:
            budget = ["--budget", str(runs), "-q", "-o", str(folder / "found")]
            quietly([*command, *budget, *words])

        return run

    def loop(folder: Path) -> None:
        command = [sys.executable, "-m", "rsltrace", "record", str(job), "-q", "--force"]
        for seed in range(loops):
            order = ["--set", "policy=permutation", "--seed", str(seed)]
            quietly([*command, *order, "-o", str(folder / "run.mcap")])

    loops = max(runs // 10, 5)
    with LocalCluster(n_workers=4, threads_per_worker=1, dashboard_address=None) as cluster:
        ways: dict[str, tuple[int, Callable[[Path], None]]] = {
            "a loop of rsltrace record": (loops, loop),
            "1 worker": (runs, search("--jobs", "1")),
            "2 workers": (runs, search("--jobs", "2")),
            "LocalCluster, 4 workers": (runs, search("--cluster", cluster.scheduler_address)),
        }
        rates: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(rounds):
            for name, (count, run) in ways.items():
                with tempfile.TemporaryDirectory() as folder:
                    began_s = time.monotonic()
                    run(Path(folder))
                    rates[name].append(count / (time.monotonic() - began_s))
    middle = {name: statistics.median(found) for name, found in rates.items()}
    base = middle["a loop of rsltrace record"]
    print("| way | runs per second | against the loop |\n|---|---|---|")
    for name, rate in middle.items():
        print(f"| {name} | {rate:.1f} | {rate / base:.1f} |")
    efficiency = statistics.median(
        two / (2 * one) for one, two in zip(rates["1 worker"], rates["2 workers"], strict=True)
    )
    print(f"efficiency of 2 workers: {100 * efficiency:.0f} %, {os.cpu_count()} processors")


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("fork", "throughput", "memory"))
    parser.add_argument("--runs", type=int, help="(default: 20, 400 and 10000)")
    parser.add_argument("--rounds", type=int, default=3, help="of throughput")
    parser.add_argument("--fork-after", metavar="T", help="of memory: fork its runs")
    parser.add_argument("--job", type=Path, default=SHORT, help="of throughput and memory")
    options = parser.parse_args()
    if options.what == "fork":
        fork(options.runs or 20)
    elif options.what == "memory":
        memory(options.runs or 10_000, options.job, options.fork_after)
    else:
        throughput(options.runs or 400, options.rounds, options.job)


if __name__ == "__main__":
    main()
