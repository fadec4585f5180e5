"""Plant faults and check what ``rsltrace diff`` says: ``make truth``, or one case again."""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from campaigns.truth import faults
from campaigns.truth.campaign import Outcome, cases, families, keep_case, table, try_cases
from rsltrace import diff
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import render

_AT_ONCE = 20


def main() -> int:
    """Return 0 if all that is said is true, but for what is known; else 1."""
    options = _options()
    faults.load()
    if options.list:
        print(*faults.FAULTS, f"{len(faults.FAULTS)} classes", sep="\n")
        return 0
    if options.only and options.seed is not None:
        return _one(options)
    planned = cases(options.faults, options.first_seed)
    if options.only:
        planned = [(options.only, options.first_seed + n) for n in range(options.faults)]
    parts = [planned[at : at + _AT_ONCE] for at in range(0, len(planned), _AT_ONCE)]
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(options.workers) as pool:
        for done in pool.map(_part, parts):
            outcomes += done
            for outcome in done:
                _tell(outcome)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "table.md").write_text(table(outcomes), encoding="utf-8")
    (options.out / "families.md").write_text(families(outcomes), encoding="utf-8")
    print(table(outcomes))
    unknown = [key for outcome in outcomes for key in outcome.unknown]
    print(f"{len(outcomes)} faults, {sum(not o.wrong for o in outcomes)} reports right")
    return 1 if unknown else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m campaigns.truth", description=__doc__)
    parser.add_argument("--faults", type=int, default=1000, help="how many")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--only", help="this class alone")
    parser.add_argument("--seed", type=int, help="with --only: this case; its report is printed")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--out", type=Path, default=Path("out") / "truth")
    parser.add_argument("--list", action="store_true", help="the classes")
    return parser.parse_args()


def _part(part: list[tuple[str, int]]) -> list[Outcome]:
    return list(try_cases(part))


def _tell(outcome: Outcome) -> None:
    for complaint in outcome.wrong:
        print(f"{outcome.name}: {complaint.what}: {complaint.text}")
    if outcome.wrong:
        print(f"  {outcome.reproducer}", flush=True)


def _one(options: argparse.Namespace) -> int:
    folder = options.out.resolve() / "case"
    outcome = keep_case(options.only, options.seed, folder)
    found = diff(folder / "a.mcap", folder / "b.mcap")
    print(render(found, "text", options=DiffOptions(everything=True), width=100))
    _tell(outcome)
    print(f"the traces are in {folder}")
    return 1 if outcome.wrong else 0


sys.exit(main())
