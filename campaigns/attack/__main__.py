"""The command line of the attack; see ``--help``."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from campaigns.attack import campaign, execution
from campaigns.attack.campaign import Tally
from campaigns.attack.corpus import REPOSITORY, Corpus
from campaigns.attack.families import NAMES, Family, family
from campaigns.attack.known import item_of


def main() -> int:
    """Attack; return 0 if nothing gave way that is not known, else 1."""
    options = _options()
    chosen = [family(name) for name in options.family or NAMES]
    if options.list:
        for one in chosen:
            print(one.name, *one.attacks, sep="\n  ")
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="rsltrace-attack-") as name:
        work = Path(name)
        corpus = Corpus(work / "corpus")
        if options.seed is not None and not options.minutes:
            planned: Iterator[tuple[Family, int]] = iter([(one, options.seed) for one in chosen])
        elif options.slice:
            planned = campaign.slice_of(chosen, options.every)
        else:
            return _long(options, chosen, work, corpus)
        log = options.out / f"{options.name}.jsonl"
        _warm(chosen, corpus)
        _try_all(planned, work, corpus, options.out, log)
        return _report(options, [log])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m campaigns.attack", description=__doc__)
    parser.add_argument("--family", action="append", choices=NAMES, help="only these")
    parser.add_argument("--seed", type=int, help="this case alone; with --minutes, where to begin")
    parser.add_argument("--minutes", type=float, default=0, help="go on for so long")
    parser.add_argument("--slice", action="store_true", help="what tests try")
    parser.add_argument("--every", type=int, default=1, help="one in so many of the slice")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "out" / "attack")
    parser.add_argument("--name", default="cases", help="of the files with the figures")
    parser.add_argument("--list", action="store_true", help="the attacks by family")
    options = parser.parse_args()
    if options.seed is None and not options.minutes and not options.slice and not options.list:
        options.minutes = 60.0
    return options


def _warm(chosen: list[Family], corpus: Corpus) -> None:
    """Load what forks share, and make what cases start from."""
    execution.preload(ros=any(one.ros for one in chosen))
    for made in (corpus.robot, corpus.other, corpus.samples):
        assert made
    if any(one.name in ("bags", "disks") for one in chosen):
        assert corpus.bag.exists()
        assert corpus.sqlite_bag.exists()


def _try_all(
    planned: Iterator[tuple[Family, int]], work: Path, corpus: Corpus, out: Path, log: Path
) -> None:
    with log.open("w", encoding="utf-8") as file:
        for one, seed in planned:
            verdict = campaign.try_or_tell(one, seed, work, corpus, out)
            print(campaign.as_json(verdict), file=file, flush=True)
            for complaint in verdict.complaints:
                key = f"{one.name}/{verdict.attack}: {complaint.wrong.value}"
                known = f" ({item})" if (item := item_of(key)) else ""
                print(f"{key}{known}: {complaint.text!r:.300}\n  {complaint.command}")
                print(f"  {verdict.reproducer}", flush=True)


def _long(options: argparse.Namespace, chosen: list[Family], work: Path, corpus: Corpus) -> int:
    first = random.SystemRandom().randrange(10**9) if options.seed is None else options.seed
    print(f"seed {first}, {options.minutes:g} minutes, {options.workers} workers", flush=True)
    _warm(chosen, corpus)
    until = time.monotonic() + 60 * options.minutes
    logs = [options.out / f"{options.name}-{number}.jsonl" for number in range(options.workers)]
    workers = []
    for number, log in enumerate(logs):
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                planned = _endless(chosen, first + number, options.workers, until)
                _try_all(planned, work, corpus, options.out, log)
                code = 0
            except KeyboardInterrupt:
                code = 0
            finally:
                sys.stdout.flush()
                os._exit(code)
        workers.append(pid)
    failed = False
    try:
        for pid in workers:
            failed |= os.waitpid(pid, 0)[1] != 0
    except KeyboardInterrupt:
        for pid in workers:
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(pid, signal.SIGINT)
                os.waitpid(pid, 0)
    return _report(options, logs) or int(failed)


def _endless(
    chosen: list[Family], first: int, step: int, until: float
) -> Iterator[tuple[Family, int]]:
    """Yield cases until the time is over, with about the same time for each family."""
    spent = dict.fromkeys((one.name for one in chosen), 0.0)
    seeds = {one.name: itertools.count(first, step) for one in chosen}
    by_name = {one.name: one for one in chosen}
    while time.monotonic() < until:
        name = min(spent, key=lambda each: spent[each])
        began = time.monotonic()
        yield by_name[name], next(seeds[name])
        spent[name] += time.monotonic() - began


def _report(options: argparse.Namespace, logs: list[Path]) -> int:
    tally = Tally()
    whole = options.out / f"{options.name}.jsonl"
    lines = [line for log in logs for line in log.read_text(encoding="utf-8").splitlines()]
    for log in logs:
        log.unlink()
    whole.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    for line in lines:
        tally.add(campaign.from_json(line))
    (options.out / f"{options.name}.md").write_text(tally.table(), encoding="utf-8")
    print(tally.table())
    for verdict in tally.verdicts:
        if verdict.skipped:
            print(f"skipped {verdict.family}/{verdict.attack}: {verdict.skipped}")
    for key, count in sorted(tally.found.items()):
        print(f"{count:5}  {key}  {item_of(key) or 'NEW'}")
    return 1 if tally.unknown() else 0


if __name__ == "__main__":
    sys.exit(main())
