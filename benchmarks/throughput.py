"""What a callback costs: the same node graphs on rclpy's executors over DDS, and under rsltrace.

    python benchmarks/throughput.py                     everything, about ten minutes
    python benchmarks/throughput.py --only rsltrace     cases whose name contains "rsltrace"
    python benchmarks/throughput.py --json              the same figures for a machine

Every measurement is a process of its own, and the repetitions go round all cases, so that a busy
minute of the machine does not hit one case alone. Shown are the best of them and the worst. Others
who use the machine only ever add to what a callback costs, so the best is what is compared.

Wall time is what counts; CPU time (of all threads) is shown beside it, since it suffers less when
others use the machine: where the two are far apart, repeat on a quiet one.

Over DDS the graphs are saturated and callbacks are counted for some seconds of wall time. Under
rsltrace a process does the same run some times, and of the best the loop is timed, with closing the
trace; start-up is not in it, nor in the native figures.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from graphs import EXECUTORS, GRAPHS, Graph, run_native, run_rsltrace

# Mode: whether the run is recorded, and whether every link has a delay.
RSLTRACE_MODES = {
    "rsltrace": (False, False),
    "rsltrace_delayed": (False, True),
    "rsltrace_recorded": (True, False),
    "rsltrace_recorded_delayed": (True, True),
    "rsltrace_recorded_python": (True, False),
}
DELAYED = {plain: f"{plain}_delayed" for plain in ("rsltrace", "rsltrace_recorded")}
DELAYED_AIM = 1.3
TITLES = {
    "single_threaded": "SingleThreadedExecutor over DDS",
    "multi_threaded": "MultiThreadedExecutor over DDS",
    "events_executor": "EventsExecutor over DDS",
    "rsltrace": "rsltrace, nothing recorded",
    "rsltrace_recorded": "rsltrace, everything recorded",
    "rsltrace_delayed": "same, a random delay on every link",
    "rsltrace_recorded_delayed": "same, a random delay on every link",
    "rsltrace_recorded_python": "recorded, no compiled module",
}
AIMS = (
    # (slower case, faster case, how many times faster it is meant to be)
    ("single_threaded", "rsltrace_recorded", 15.0),
    ("events_executor", "rsltrace_recorded", 1.2),
    ("events_executor", "rsltrace", 2.0),
)
ROUNDS = 3
"""How often one process does the same run."""

WORKER_S_MAX = 180
UNAVAILABLE = "unavailable"


@dataclass
class Case:
    """One graph on one executor, with what was measured so far (microseconds per callback)."""

    graph: str
    mode: str
    us: list[float] = field(default_factory=list)
    cpu_us: list[float] = field(default_factory=list)
    callbacks: int = 0
    start_up_s: list[float] = field(default_factory=list)
    problem: str = ""

    @property
    def name(self) -> str:
        """The name that ``--only`` filters: ``ping_pong/single_threaded``."""
        return f"{self.graph}/{self.mode}"


def all_cases() -> list[Case]:
    """Return every case in the order of the table."""
    cases = []
    for graph in GRAPHS.values():
        native = EXECUTORS if graph.make_native else ()
        cases += [Case(graph.name, mode) for mode in (*native, *RSLTRACE_MODES)]
    return cases


def child_environment(folder: Path) -> dict[str, str]:
    """Return an environment in which a native graph neither meets others nor litters."""
    environment = dict(os.environ)
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # users have their modules compiled
    environment.pop("ROS_LOCALHOST_ONLY", None)  # its successor, next line, is enough
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # Domains 1 to 100 have ports below the ephemeral range on every platform.
    environment["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    environment["ROS_LOG_DIR"] = str(folder)
    return environment


def run_worker(case: Case, amount: float) -> dict[str, Any]:
    """Measure ``case`` once in a fresh interpreter; return its figures or what went wrong.

    ``amount`` is seconds of wall time over DDS, callbacks under rsltrace.
    """
    with tempfile.TemporaryDirectory(prefix="rsltrace-throughput-") as folder:
        command = [sys.executable, __file__, "--worker", case.name, str(amount), folder]
        environment = child_environment(Path(folder))
        if case.mode.endswith("_python"):
            environment["RSLTRACE_COMPILED"] = "0"
        try:
            done = subprocess.run(
                command,
                env=environment,
                capture_output=True,
                text=True,
                timeout=WORKER_S_MAX,
            )
        except subprocess.TimeoutExpired:
            return {"problem": f"no result after {WORKER_S_MAX} s"}
    for line in reversed(done.stdout.splitlines()):
        if line.startswith("{"):
            figures: dict[str, Any] = json.loads(line)
            return figures
    last = done.stderr.strip().splitlines()[-1:] or ["no output"]
    return {"problem": f"exit status {done.returncode}: {last[0]}"}


def work(name: str, amount: float, folder: Path) -> dict[str, Any]:
    """Do what one worker process does. A missing package is a finding, not a crash."""
    graph_name, mode = name.split("/")
    graph = GRAPHS[graph_name]
    try:
        if mode in RSLTRACE_MODES:
            return work_rsltrace(graph, mode, int(amount), folder)
        return run_native(graph, mode, amount)
    except ImportError as error:
        return {"problem": f"not available: {error}", UNAVAILABLE: True}


def work_rsltrace(graph: Graph, mode: str, events: int, folder: Path) -> dict[str, Any]:
    """Measure a graph under rsltrace some times; return the best, and the first one's start-up."""
    record, delayed = RSLTRACE_MODES[mode]
    length = int(events * graph.longer)
    runs = [
        run_rsltrace(graph, length, folder, record=record, delayed=delayed) for _ in range(ROUNDS)
    ]
    best = {key: min(run[key] for run in runs) for key in ("wall_s", "cpu_s")}
    return runs[0] | best


def measure(case: Case, amount: float) -> None:
    """Add one repetition to ``case``."""
    figures = run_worker(case, amount)
    case.problem = figures.get("problem", "")
    if not case.problem:
        case.callbacks = figures["callbacks"]
        case.us.append(figures["wall_s"] / case.callbacks * 1e6)
        case.cpu_us.append(figures["cpu_s"] / case.callbacks * 1e6)
        if "start_up_s" in figures:
            case.start_up_s.append(figures["start_up_s"])


def ratios(cases: list[Case]) -> list[dict[str, Any]]:
    """Return what was aimed at and what was reached, for the pairs that were both measured.

    ``x`` compares the best wall times, ``cpu_x`` the best CPU times.
    """
    best = {case.name: (min(case.us), min(case.cpu_us)) for case in cases if case.us}

    def compare(slow: str, fast: str) -> dict[str, float]:
        (wall, cpu), (fast_wall, fast_cpu) = best[slow], best[fast]
        return {"x": wall / fast_wall, "cpu_x": cpu / fast_cpu}

    found: list[dict[str, Any]] = []
    for graph in GRAPHS:
        for slow, fast, aim in AIMS:
            names = f"{graph}/{slow}", f"{graph}/{fast}"
            if all(name in best for name in names):
                pair = {"graph": graph, "slow": slow, "fast": fast, "aim": aim}
                found.append(pair | compare(*names))
        for plain, delayed in DELAYED.items():
            names = f"{graph}/{delayed}", f"{graph}/{plain}"
            if all(name in best for name in names):
                pair = {"graph": graph, "slow": delayed, "fast": plain, "most": DELAYED_AIM}
                found.append(pair | compare(*names))
    for mode in RSLTRACE_MODES:
        for few_graph, many_graph in (("graph8", "graph200"), ("ping_pong", "mains")):
            few, many = f"{few_graph}/{mode}", f"{many_graph}/{mode}"
            if few in best and many in best:
                pair = {"graph": many_graph, "slow": mode, "fast": few_graph}
                found.append(pair | compare(many, few))
    return found


def print_table(cases: list[Case]) -> None:
    """Print the figures for a person."""
    best = {case.name: min(case.us) for case in cases if case.us}
    for graph in GRAPHS.values():
        rows = [case for case in cases if case.graph == graph.name]
        if not rows:
            continue
        heads = f"{'µs/callback':>12}{'worst':>10}{'CPU µs':>10}{'× single':>10}"
        print(f"\n{graph.title:<36}{heads}")
        base = best.get(f"{graph.name}/single_threaded")
        for case in rows:
            if not case.us:
                print(f"  {TITLES[case.mode]:<34}{'':>12}  {case.problem}")
                continue
            us, cpu_us = best[case.name], min(case.cpu_us)
            speed = f"{base / us:.1f}" if base else ""
            failed = f"  then: {case.problem}" if case.problem else ""
            print(
                f"  {TITLES[case.mode]:<34}{us:>12.2f}{max(case.us):>10.2f}{cpu_us:>10.2f}"
                f"{speed:>10}{failed}"
            )
    print()
    for each in ratios(cases):
        if "aim" in each:
            verdict = "reached" if each["x"] >= each["aim"] else "missed"
            print(
                f"{each['graph']}: {TITLES[each['fast']]} is {each['x']:.1f} times as fast as "
                f"{TITLES[each['slow']]} (aim {each['aim']:g}: {verdict}; "
                f"by CPU time {each['cpu_x']:.1f})"
            )
        elif "most" in each:
            verdict = "kept" if each["x"] <= each["most"] else "missed"
            print(
                f"{each['graph']}: delays cost {each['x']:.2f} of {TITLES[each['fast']]} "
                f"(at most {each['most']:g}: {verdict}; by CPU time {each['cpu_x']:.2f})"
            )
        else:
            print(
                f"an event of {each['graph']} costs {each['x']:.2f} of one of {each['fast']} "
                f"({TITLES[each['slow']]}; by CPU time {each['cpu_x']:.2f})"
            )


def main() -> int:
    """Measure and print. Returns the exit status: 1 if a case failed that could have run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--repeat", type=int, default=4, help="how often each case is measured")
    parser.add_argument("--seconds", type=float, default=3.0, help="wall time of a native case")
    parser.add_argument("--events", type=int, default=60_000, help="events of an rsltrace run")
    parser.add_argument("--only", action="append", help="cases whose name contains this")
    parser.add_argument("--list", action="store_true", help="print the names of the cases")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--worker", nargs=3, metavar=("CASE", "AMOUNT", "FOLDER"), help="internal")
    options = parser.parse_args()
    if options.worker:
        name, amount, folder = options.worker
        print(json.dumps(work(name, float(amount), Path(folder))), flush=True)
        # DDS's threads may linger, and what they would still do is not part of the measurement.
        sys.stderr.flush()
        os._exit(0)
    if options.repeat < 1 or options.events < 1000 or not options.seconds > 0:
        parser.error("--repeat must be at least 1, --events at least 1000, --seconds above 0")

    cases = all_cases()
    if options.only:
        cases = [case for case in cases if any(part in case.name for part in options.only)]
    if options.list or not cases:
        print("\n".join(case.name for case in cases or all_cases()))
        return 0 if cases else 2
    unavailable: set[str] = set()
    for turn in range(options.repeat):
        for case in cases:
            if case.name not in unavailable:
                print(f"{turn + 1}/{options.repeat} {case.name}", file=sys.stderr, flush=True)
                native = case.mode not in RSLTRACE_MODES
                measure(case, options.seconds if native else options.events)
                if case.problem.startswith("not available"):
                    unavailable.add(case.name)
    if options.json:
        figures = [
            {"case": c.name, "us_per_callback": c.us, "cpu_us_per_callback": c.cpu_us}
            | {"callbacks": c.callbacks, "start_up_s": c.start_up_s, "problem": c.problem}
            for c in cases
        ]
        print(json.dumps({"cases": figures, "ratios": ratios(cases)}, indent=2))
    else:
        print_table(cases)
    return int(any(case.problem and case.name not in unavailable for case in cases))


if __name__ == "__main__":
    sys.exit(main())
