"""Hold bounds against random systems: ``python -m campaigns.timing --systems 1000``."""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from campaigns.timing.random_systems import draw, held


def main() -> int:
    """Print how tight the bounds are; return 1 if one is below what was seen."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", type=int, default=1000)
    parser.add_argument("--first-seed", type=int, default=0)
    options = parser.parse_args()
    ratios: defaultdict[str, list[float]] = defaultdict(list)
    unbounded = too_low = 0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(options.first_seed, options.first_seed + options.systems):
            plan = draw(seed)
            for path, bound in held(plan, Path(folder)):
                if bound.ns is None:
                    unbounded += 1
                elif path.worst_ns > bound.ns:
                    too_low += 1
                    chain = " -> ".join(map(str, path.key))
                    print(f"{plan.description}: {chain} took {path.worst_ns}, not {bound}")
                elif path.worst_ns:
                    ratios[bound.method].append(bound.ns / path.worst_ns)
    for method, found in sorted(ratios.items()):
        tenths = statistics.quantiles(found, n=10)
        print(
            f"{method}: {len(found)} bounds; bound / observed: median "
            f"{statistics.median(found):.2f}, 10 to 90 % {tenths[0]:.2f} to {tenths[8]:.2f}, "
            f"tightest {min(found):.3f}"
        )
    print(f"{options.systems} systems: {too_low} bounds too low, {unbounded} chains without one")
    return 1 if too_low else 0


if __name__ == "__main__":
    sys.exit(main())
