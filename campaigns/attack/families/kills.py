"""Recordings that are ended from outside, at any moment: what was written can be read."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from random import Random

from campaigns.attack import oracle
from campaigns.attack.corpus import Corpus, put_robot
from campaigns.attack.families import recordings
from campaigns.attack.families.common import Family
from campaigns.attack.model import Case, Command, Complaint, Kill, Limits, Ran

_JOB = """\
nodes:
  - {node: robot:Driver, parameters: {period: 0.001}}
  - node: robot:Arm
stop: {duration: %s}
record: {segment_events: %d}
"""


def _attack(
    number: int, status: int, *, early: bool = False
) -> Callable[[Random, Case, Corpus], None]:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        folder = case.folder
        put_robot(folder)
        segment = rng.choice((16, 500, 4096) if early else (16, 500))
        (folder / "job.yaml").write_text(_JOB % (rng.choice(("20s", "60s")), segment))
        old = ""
        words = ["record", "job.yaml", "-o", recordings.OUTPUT, "--quiet"]
        if rng.random() < 0.5:
            (folder / recordings.OUTPUT).write_bytes(corpus.robot)
            old = recordings.fingerprint(case)
            words.append("--force")
        fresh = rng.random() < 0.3
        if not fresh:
            words.append("--no-pin")
        kill = Kill(number, rng.choice((6000, 6000 + rng.randrange(1_000_000))))
        if early:  # before the first segment, or before there is a file
            kill = Kill(number, rng.choice((0, 1)), rng.uniform(0.0, 0.8))
        case.user_code = True
        case.names = ("job.yaml", recordings.OUTPUT, "interrupted")
        case.commands.append(
            Command(
                tuple(words),
                oracle.RECORDING | {status, -number},
                folder,
                fresh=fresh,
                kill=kill,
                limits=Limits(cpu_s=40, rss_mib=500),
            )
        )
        case.judge = lambda runs: _judge(case, runs, old, status)

    return attack


def _judge(case: Case, runs: Sequence[Ran], old: str, status: int) -> list[Complaint]:
    whole = (
        frozenset((status,))
        if status > 0 and (case.folder / recordings.OUTPUT).exists()
        else frozenset()
    )
    if old and recordings.fingerprint(case) == old:
        whole = frozenset()  # it had not begun
    return recordings.judge(case, runs, old=old, whole_if=whole)


_ENDS = {
    "sigkill": (signal.SIGKILL, -signal.SIGKILL),
    "sigterm": (signal.SIGTERM, 143),
    "sigint": (signal.SIGINT, 130),
    "sighup": (signal.SIGHUP, 129),
}

FAMILY = Family(
    "kills",
    {
        **{name: _attack(*end) for name, end in _ENDS.items()},
        **{f"{name}-early": _attack(*end, early=True) for name, end in _ENDS.items()},
    },
    slow=frozenset(f"{name}-early" for name in _ENDS),  # what they hit is up to the wall clock
    ros=True,
)
