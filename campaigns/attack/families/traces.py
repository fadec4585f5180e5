"""Traces changed as bytes: by a bad disk, a broken copy, a run that was cut."""

from __future__ import annotations

from random import Random

from campaigns.attack.corpus import Corpus
from campaigns.attack.families.common import Family
from campaigns.attack.families.trace_case import attack_trace, flip
from campaigns.attack.model import Case


def _flips(rng: Random, case: Case, corpus: Corpus) -> None:
    data = rng.choice(corpus.traces)
    attack_trace(case, rng, flip(rng, data, rng.choice((1, 1, 1, 2, 10, 200))), data)


def _flips_in_the_summary(rng: Random, case: Case, corpus: Corpus) -> None:
    data = rng.choice(corpus.traces)
    attack_trace(case, rng, flip(rng, data, rng.choice((1, 2, 5)), len(data) - 2500), data)


def _flips_in_the_beginning(rng: Random, case: Case, corpus: Corpus) -> None:
    data = rng.choice(corpus.traces)
    attack_trace(case, rng, flip(rng, data, rng.choice((1, 2, 5)), 0, 4000), data)


def _bytes_set(rng: Random, case: Case, corpus: Corpus) -> None:
    data = rng.choice(corpus.traces)
    changed = bytearray(data)
    for _ in range(rng.choice((1, 3, 20))):
        at = rng.randrange(len(changed) - 8)
        size = rng.choice((1, 2, 4, 8))
        changed[at : at + size] = rng.choice((b"\x00", b"\xff", b"\x7f", b"\x80")) * size
    attack_trace(case, rng, bytes(changed), data)


def _truncated(rng: Random, case: Case, corpus: Corpus) -> None:
    data = rng.choice(corpus.traces)
    cut = rng.choice((rng.randrange(len(data)), len(data) - rng.randrange(1, 3000)))
    attack_trace(case, rng, data[:cut], data, differs=True)


def _cut_then_damaged(rng: Random, case: Case, corpus: Corpus) -> None:
    data = corpus.robot
    cut = data[: rng.randrange(len(data) // 2, len(data) - 3000)]
    attack_trace(case, rng, flip(rng, cut, 1), data, differs=True)


def _cut_and_grown(rng: Random, case: Case, corpus: Corpus) -> None:
    """A copy that broke off into another file, or into zeros."""
    data = rng.choice(corpus.traces)
    cut = rng.randrange(len(data))
    rest = rng.choice((bytes(rng.randrange(1, 100_000)), rng.choice(corpus.traces)[cut:]))
    attack_trace(case, rng, data[:cut] + rest, data, differs=data[:cut] + rest != data)


def _spliced(rng: Random, case: Case, corpus: Corpus) -> None:
    data, other = corpus.robot, corpus.other
    at, size = rng.randrange(len(data)), rng.randrange(1, 5000)
    start = rng.randrange(len(other))
    changed = data[:at] + other[start : start + size] + data[at + size :]
    attack_trace(case, rng, changed, data)


def _zeroed(rng: Random, case: Case, corpus: Corpus) -> None:
    data = rng.choice(corpus.traces)
    size = rng.choice((1, 16, 512, 4096, 20_000))
    at = rng.randrange(max(len(data) - size, 1))
    attack_trace(case, rng, data[:at] + bytes(size) + data[at + size :], data)


def _block_twice(rng: Random, case: Case, corpus: Corpus) -> None:
    data = rng.choice(corpus.traces)
    size = rng.choice((1, 8, 512, 4096))
    at = rng.randrange(len(data) - size)
    attack_trace(
        case,
        rng,
        data[:at] + data[at : at + size] * rng.choice((2, 3, 50)) + data[at + size :],
        data,
    )


def _block_lost(rng: Random, case: Case, corpus: Corpus) -> None:
    data = rng.choice(corpus.traces)
    size = rng.choice((1, 8, 512, 4096))
    at = rng.randrange(len(data) - size)
    attack_trace(case, rng, data[:at] + data[at + size :], data)


def _appended(rng: Random, case: Case, corpus: Corpus) -> None:
    data = rng.choice(corpus.traces)
    rest = rng.choice((b"\0" * 4096, b"\n", data, rng.randbytes(1000), data[-28:]))
    attack_trace(case, rng, data + rest, data)


def _noise(rng: Random, case: Case, corpus: Corpus) -> None:
    """Not a trace at all, or just its first bytes."""
    data = corpus.samples["schedule/a"]
    start = data[: rng.choice((0, 1, 8, 30, 120, 500))]
    body = start + rng.randbytes(rng.choice((0, 1, 100, 10_000)))
    attack_trace(case, rng, body, data, differs=True)


def _another_run(rng: Random, case: Case, corpus: Corpus) -> None:
    """Two healthy files of different runs, whole or cut: never identical."""
    a, b = rng.choice(
        [(corpus.robot, corpus.other), (corpus.samples["schedule/a"], corpus.samples["schedule/b"])]
    )
    cut_a = a[: rng.choice((len(a), rng.randrange(2000, len(a))))]
    cut_b = b[: rng.choice((len(b), rng.randrange(2000, len(b))))]
    attack_trace(case, rng, cut_a, cut_b, differs=True, names=("original.mcap",))


def _cut_before_the_first_segment(rng: Random, case: Case, corpus: Corpus) -> None:
    a, b = rng.choice(corpus.traces), rng.choice(corpus.traces)
    cut_a = a[: a.find(b"/rsltrace/states") + rng.randrange(700)]
    cut_b = b[: b.find(b"/rsltrace/states") + rng.randrange(700)]
    attack_trace(case, rng, cut_a, cut_b, differs=True, names=("original.mcap",))


FAMILY = Family(
    "traces",
    {
        "flips": _flips,
        "flips-in-summary": _flips_in_the_summary,
        "flips-in-beginning": _flips_in_the_beginning,
        "bytes-set": _bytes_set,
        "truncated": _truncated,
        "cut-then-damaged": _cut_then_damaged,
        "cut-and-grown": _cut_and_grown,
        "spliced": _spliced,
        "zeroed": _zeroed,
        "block-twice": _block_twice,
        "block-lost": _block_lost,
        "appended": _appended,
        "noise": _noise,
        "another-run": _another_run,
        "cut-before-first-segment": _cut_before_the_first_segment,
    },
)
