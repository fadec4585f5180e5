"""How many runs it takes to find known bugs of ROS graphs, and how often they show natively.

    python benchmarks/explore.py                        everything; some hours on a slow machine
    python benchmarks/explore.py --only order late_tf   groups or bugs
    python benchmarks/explore.py --ways pct native      some of the columns
    python benchmarks/explore.py --keep out.json        figures that are there are not made again
    python benchmarks/explore.py --markdown             a table of the bugs

The bugs are those of campaigns/explore/bugs. Each strategy searches with ``--stop-at-first`` and
several seeds; a figure is the median of the runs it took, ``>1000`` that it was not found in so
many ("not in 12": the systematic search had nothing left to try after 12). Natively the same nodes
run over DDS, each in a process of its own, again and again for ``--native`` seconds: in how many of
those runs the checks were violated. What a job says of delays, clocks and execution times is not
imitated natively.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from campaigns.explore.suite import Bug, all_bugs  # noqa: E402

STRATEGIES = ("pct", "random", "feedback", "systematic", "faults")
WAYS = (*STRATEGIES, "native")

Figures = dict[str, Any]


def explored(bug: Bug, strategy: str, seeds: Sequence[int], budget: int, jobs: int) -> Figures:
    """Search for a bug with several seeds; return how many runs each search took."""
    runs: list[int | None] = []
    wall_s = 0.0
    for seed in seeds if strategy != "systematic" else seeds[:1]:
        with tempfile.TemporaryDirectory() as folder:
            words = ["explore", str(bug.job), "--strategy", strategy, "--budget", str(budget)]
            words += ["--stop-at-first", "--seed", str(seed * 100_000), "--quiet"]
            words += ["--jobs", str(jobs), "-o", f"{folder}/found"]
            begun = time.monotonic()
            done = subprocess.run(
                [sys.executable, "-m", "rsltrace", *words], capture_output=True, text=True
            )
            wall_s += time.monotonic() - begun
            if done.returncode not in (0, 1):
                return {"problem": (done.stderr.strip().splitlines() or ["?"])[-1]}
            lines = Path(folder, "found", "results.jsonl").read_text().splitlines()
        failed = [
            row["trial"]["number"] for row in map(json.loads, lines) if row["failure"] is not None
        ]
        runs.append(min(failed) if failed else None)
    return {"runs": runs, "wall_s": round(wall_s, 1), "tried": len(lines)}


def native(bug: Bug, seconds: float) -> Figures:
    """Run a bug natively for some time."""
    if not bug.native:
        return {"problem": "its checks cannot be watched natively"}
    command = [sys.executable, str(ROOT / "benchmarks" / "explore_native.py"), str(bug.job)]
    done = subprocess.run(
        [*command, "--seconds", str(seconds)], capture_output=True, text=True, timeout=3600
    )
    if done.returncode:
        return {"problem": (done.stderr.strip().splitlines() or ["?"])[-1]}
    return dict(json.loads(done.stdout.splitlines()[-1]))


def cell(way: str, found: Figures | None, budget: int) -> str:
    """Return what the table shows of a measurement."""
    if found is None:
        return ""
    if "problem" in found:
        return "-"
    if way == "native":
        return f"{found['violated']} of {found['runs']}"
    runs = found["runs"]
    if way == "systematic" and runs == [None]:
        return f"not in {found['tried']}"
    middle = statistics.median([budget + 1 if one is None else one for one in runs])
    return f">{budget}" if middle > budget else f"{middle:g}"


def table(bugs: Sequence[Bug], ways: Sequence[str], kept: Figures, budget: int) -> list[str]:
    """Return the rows of the table, in Markdown."""
    rows = [f"| bug | hides in | {' | '.join(ways)} |", "|---" * (len(ways) + 2) + "|"]
    for bug in bugs:
        cells = [cell(way, kept.get(bug.name, {}).get(way), budget) for way in ways]
        rows.append(f"| {bug.kind} (`{bug.name}`) | {bug.search} | {' | '.join(cells)} |")
    return rows


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", default=[], help="groups or bugs")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--seeds", type=int, default=5, help="searches of each strategy")
    parser.add_argument("--budget", type=int, default=1000, help="most runs of a search")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--native", type=float, default=30.0, help="seconds of native runs")
    parser.add_argument("--keep", type=Path, help="JSON file of figures to add to")
    parser.add_argument("--markdown", action="store_true")
    options = parser.parse_args()
    bugs = [
        bug
        for bug in all_bugs()
        if not options.only or {bug.name, bug.folder.parent.name} & set(options.only)
    ]
    kept: dict[str, Figures] = {}
    if options.keep and options.keep.exists():
        kept = json.loads(options.keep.read_text())
    for bug in bugs:
        mine = kept.setdefault(bug.name, {})
        for way in options.ways:
            if way in mine or (way == "faults") != (bug.search == "faults"):
                continue  # what takes a fault is found by faults, and nothing else is
            if way == "native":
                mine[way] = native(bug, options.native)
            else:
                seeds = range(options.seeds)
                mine[way] = explored(bug, way, seeds, options.budget, options.jobs)
            if not options.markdown:
                print(f"{bug.name:28} {way:10} {cell(way, mine[way], options.budget)}", flush=True)
            if options.keep:
                options.keep.write_text(json.dumps(kept, indent=1))
    print("\n".join(table(bugs, options.ways, kept, options.budget)))


if __name__ == "__main__":
    main()
