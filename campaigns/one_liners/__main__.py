"""``python -m campaigns.one_liners``: record the lines and say which are held."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

from campaigns.one_liners.campaign import LIMITS, all_lines, run


def main() -> int:
    """Run the lines and print a table; return 1 if one is silent that is not known to be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=6, help="environments to record each line in")
    parser.add_argument("--only", default="", help="lines that contain this text")
    parser.add_argument("--no-pin", action="store_true", help="record as pytest does")
    parser.add_argument("--verbose", action="store_true", help="show every line")
    options = parser.parse_args()
    lines = [line for line in all_lines() if options.only in line.text]
    with tempfile.TemporaryDirectory() as folder:
        more = ["--no-pin"] if options.no_pin else []
        judged = run(lines, options.runs, Path(folder), options=more)
    for topic in dict.fromkeys(line.topic for line in lines):
        counts = Counter(one.verdict for one in judged if one.line.topic == topic)
        print(f"{topic:20}", *(f"{counts[verdict]:4} {verdict}" for verdict in VERDICTS))
    for one in judged:
        if options.verbose or one.verdict == "silent":
            print(f"{one.verdict}: {one.line.text}  {' '.join(sorted(one.sources))}")
            for text in dict.fromkeys(one.given):
                print(f"    {text[:200]}")
    counts = Counter(one.verdict for one in judged)
    print(f"{len(lines)} lines:", *(f"{counts[verdict]} {verdict}" for verdict in VERDICTS))
    return int(any(one.verdict == "silent" and one.line.topic != LIMITS for one in judged))


VERDICTS = ("held", "reported", "silent")

if __name__ == "__main__":
    sys.exit(main())
