"""Run rclpy's own tests on rsltrace's middleware, from a checkout of rclpy.

    python campaigns/rclpy_suite --rclpy ~/src/rclpy [-k test_action] [--processes | --native]

None of rclpy's code is kept here: its folder ``rclpy/test`` is copied to a temporary folder for the
time of the run. Each module is a job of its own, in a process of its own; a test that hangs or
crashes ends the process, is reported, and the rest of the module runs in a new one. What cannot
run in a simulation is listed in ``excluded.py`` with the reason.

The exit status is 0 if every test passes or is excluded.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from document import Counts, document, read
from excluded import EXCLUDED
from suite import Outcome, copy_tests, module_names, run_module

DOCUMENT = Path(__file__).parents[2] / "docs" / "qualification" / "rclpy-tests.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for and print the counts."""
    options = _parser().parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="rclpy_suite_") as temporary:
        folder = copy_tests(options.rclpy, Path(temporary))
        modules = [m for m in module_names(folder) if not options.module or m in options.module]
        where = "here" if options.native else "process" if options.processes else "simulation"
        excluded = {} if options.all else EXCLUDED.get(where, {})

        def one(module: str) -> list[Outcome]:
            return run_module(
                folder,
                module,
                excluded,
                where=where,
                keyword=options.keyword,
                limit_s=options.timeout,
            )

        outcomes: list[Outcome] = []
        with ThreadPoolExecutor(options.jobs) as pool:
            for module, found in zip(modules, pool.map(one, modules), strict=True):
                passed = sum(outcome.passed for outcome in found)
                print(f"{module}: {passed} of {len(found)}", flush=True)
                for outcome in found:
                    if not outcome.passed:
                        print(f"  {outcome.verdict} {outcome.test}: {outcome.reason}", flush=True)
                        if options.verbose and outcome.text:
                            print("    " + outcome.text.replace("\n", "\n    "))
                outcomes += found
    return _report(outcomes, options)


def _report(outcomes: list[Outcome], options: argparse.Namespace) -> int:
    passed = {outcome.test for outcome in outcomes if outcome.passed}
    excluded = {outcome.test for outcome in outcomes if outcome.verdict == "excluded"}
    failed = [o.test for o in outcomes if not o.passed and o.test not in excluded]
    where = "in the simulation"
    if options.native or options.processes:
        where = "natively" if options.native else "in processes of the simulation"
    print(
        f"{len(outcomes)} tests: {len(passed)} pass {where}, {len(excluded)} excluded with a "
        f"reason, {len(failed)} fail"
    )
    baseline: set[str] = set()
    if options.baseline is not None:
        baseline = set(options.baseline.read_text().split()) & {o.test for o in outcomes}
        print(
            f"of {len(baseline)} that pass natively: {len(baseline & passed)} pass here, "
            f"{len(baseline & excluded)} excluded, {len(baseline - passed - excluded)} fail"
        )
    if options.list is not None:
        options.list.write_text("".join(f"{test}\n" for test in sorted(passed)))
    if options.document:
        counts = Counts(
            suite=len(outcomes),
            native=len(baseline),
            passed=len(passed),
            both=len(baseline & passed),
            excluded=len(excluded),
            failed=len(failed),
        )
        way = "process" if options.processes else "simulation"
        of_both = {**read(DOCUMENT.read_text())[1], way: counts}
        DOCUMENT.write_text(document(options.document, of_both, EXCLUDED))
    return 1 if failed else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="rclpy_suite", description=__doc__.split("\n")[0])
    parser.add_argument("--rclpy", type=Path, required=True, help="a checkout of rclpy")
    parser.add_argument("-k", dest="keyword", default="", help="as pytest's")
    parser.add_argument("-v", "--verbose", action="store_true", help="print why tests fail")
    way = parser.add_mutually_exclusive_group()
    way.add_argument(
        "--processes", action="store_true", help="unmodified, in `isolated:` processes"
    )
    way.add_argument("--native", action="store_true", help="over DDS, for comparison")
    parser.add_argument("--all", action="store_true", help="try what is excluded, too")
    parser.add_argument("--baseline", type=Path, help="ids of the tests that pass natively")
    parser.add_argument("--list", type=Path, help="write the ids of the tests that passed")
    parser.add_argument(
        "--document", metavar="VERSION", default="", help="write docs/qualification/rclpy-tests.md"
    )
    parser.add_argument("--timeout", type=float, default=120, help="wall seconds for a process")
    parser.add_argument("-j", "--jobs", type=int, default=1, help="modules at a time")
    parser.add_argument("module", nargs="*", help="test modules (test_node.py); default: all")
    return parser


if __name__ == "__main__":
    sys.exit(main())
