"""What the guard adds to one call: clocks, chance, the file system, going through sets and dicts.

    python benchmarks/guard_calls.py                a few seconds
    python benchmarks/guard_calls.py --markdown     the table of docs/performance.md

Each call is made in a node's own module, in a library and in rclpy (code that says it is of a file
of numpy or of rclpy), inside of a run and, beside it, without one. Counted is CPU time, the best of
many callbacks; what the call itself takes is shown as bare Python.
"""

from __future__ import annotations

import argparse
import builtins
import json
import sys
import tempfile
from pathlib import Path
from time import process_time
from typing import Any

CALLS = 300
"""In one callback: more findings than an event keeps, as in any loop that asks again and again."""

ROUNDS = 40

MODULE = '''
import os

import numpy
import rclpy
from rclpy.node import Node

CALLS = """
import os, random, time

def time_time(count):
    for _ in range(count):
        time.time()

def random_random(count):
    for _ in range(count):
        random.random()

def os_stat(count):
    for _ in range(count):
        os.stat("/tmp")

def os_path_exists(count):
    for _ in range(count):
        os.path.exists("/tmp")
"""
exec(compile(CALLS, __file__, "exec"))
NUMBERS, TEXTS = set(range(10)), {str(number) for number in range(10)}
VALUES = {str(number): number for number in range(10)}


def set_of_10_numbers(count):
    for _ in range(count):
        for _ in NUMBERS:
            pass


def set_of_10_texts(count):
    for _ in range(count):
        for _ in TEXTS:
            pass


def dict_of_10(count):
    for _ in range(count):
        for _ in VALUES:
            pass


def of(file):
    names = {"__file__": file, "__name__": os.path.basename(os.path.dirname(file))}
    exec(compile(CALLS, file, "exec"), names)
    return {name: names[name] for name in NAMES}


NAMES = ("time_time", "random_random", "os_stat", "os_path_exists")
CASES = {(name, "a node"): globals()[name] for name in NAMES}
CASES |= {(name, "a library"): function for name, function in of(numpy.__file__).items()}
CASES |= {(name, "rclpy"): function for name, function in of(rclpy.__file__).items()}
for function in (set_of_10_numbers, set_of_10_texts, dict_of_10):
    CASES[function.__name__, "a node"] = function


class Caller(Node):
    def __init__(self):
        super().__init__("caller")
        self.cases = list(CASES) * ROUNDS
        self.create_timer(0.01, self.call)

    def call(self):
        if self.cases:
            measure(self.cases.pop())
'''


def run(folder: Path) -> tuple[dict[Any, float], dict[Any, float]]:
    """Return microseconds per call, without a run and in one."""
    from rsltrace import load_job
    from rsltrace import record as record_job
    from rsltrace.guard.redirect import copy_of

    cpu_s = copy_of(process_time)  # type: ignore[arg-type]  # it goes on showing real time
    best: dict[Any, float] = {}

    def measure(case: Any) -> None:
        function = sys.modules["called"].CASES[case]
        function(10)
        start = cpu_s()
        function(CALLS)
        best[case] = min(best.get(case, 1e9), (cpu_s() - start) / CALLS * 1e6)

    vars(builtins).update(measure=measure, ROUNDS=ROUNDS)
    (folder / "called.py").write_text(MODULE)
    sys.path.insert(0, str(folder))
    import called  # type: ignore[import-not-found]

    for case in called.CASES:
        for _ in range(ROUNDS):
            measure(case)
    without, length = dict(best), len(called.CASES) * ROUNDS
    del sys.modules["called"]
    best.clear()
    job = {"nodes": [{"node": "called:Caller"}], "stop": {"duration": f"{10 * (length + 2)}ms"}}
    (folder / "job.yaml").write_text(json.dumps(job))
    record_job(load_job(folder / "job.yaml"), folder / "run.mcap")
    return without, best


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        without, inside = run(Path(folder))
    rows = [("call", "made by", "bare Python", "in a run", "more")]
    if options.markdown:
        rows.append(("---", "---", "--:", "--:", "--:"))
    for case in sorted(without):
        name, caller = case
        costs = (without[case], inside[case], inside[case] - without[case])
        rows.append((name.replace("_", " "), caller, *(f"{cost:.2f} µs" for cost in costs)))
    for row in rows:
        if options.markdown:
            print(f"| {' | '.join(row)} |")
        else:
            print(f"{row[0]:20}{row[1]:12}{row[2]:>14}{row[3]:>12}{row[4]:>12}")


if __name__ == "__main__":
    main()
