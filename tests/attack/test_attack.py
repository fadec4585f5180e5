"""A slice of the standing attack, and that the attack itself works.

``make test`` tries a third of it, ``make test-long`` all; ``make attack`` goes on for an hour.
What gives way here and is not mended yet stands in ``known``.
"""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import rsltrace
from campaigns.attack import campaign, execution, mcap_parts, oracle
from campaigns.attack.corpus import REPOSITORY, SAMPLES, Corpus
from campaigns.attack.families import NAMES, Family, families
from campaigns.attack.families.common import stream
from campaigns.attack.families.trace_case import attack_trace
from campaigns.attack.known import KNOWN, mended
from campaigns.attack.model import Case, Command, Complaint, Kill, Limits, Ran, Verdict, Wrong
from campaigns.attack.reading import content

pytestmark = pytest.mark.ros

HALVES = (
    ("traces", "records", "schemas", "texts", "pasted", "servers", "golden"),
    ("bags", "jobs", "nodes", "kills", "disks", "serving", "replays", "sources"),
)
"""Two processes, so that two cores share the work; each loads what it attacks once."""


def test_the_halves_are_all_families() -> None:
    assert sorted(HALVES[0] + HALVES[1]) == sorted(NAMES)


@pytest.mark.long
@pytest.mark.parametrize("every", [3, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("half", HALVES, ids=("files", "runs"))
def test_nothing_gives_way_that_is_not_known(
    tmp_path: Path, half: tuple[str, ...], every: int
) -> None:
    words = [sys.executable, "-m", "campaigns.attack", "--slice", "--out", str(tmp_path)]
    words += ["--every", str(every)]
    for name in half:
        words += ["--family", name]
    done = subprocess.run(
        words, cwd=REPOSITORY, capture_output=True, text=True, timeout=1800, check=False
    )
    log = tmp_path / "cases.jsonl"
    assert log.exists(), done.stderr
    lines = log.read_text().splitlines()
    tally = campaign.Tally()
    for line in lines:
        tally.add(campaign.from_json(line))
    assert {verdict.family for verdict in tally.verdicts} == set(half)
    new = [f"{k}  {v.reproducer}" for v in tally.unknown() for k in sorted(campaign.new_of(v))]
    assert not new, "\n".join((*new, done.stdout[-5000:]))
    if every == 1:
        held = [key for key in mended(tally.found) if key.partition("/")[0] in half]
        assert not held, f"these hold now: take them out of known.py: {held}"
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_known_failure_names_an_attack_and_an_item() -> None:
    every = {
        f"{one.name}/{attack}: {wrong.value}"
        for one in families().values()
        for attack in one.attacks
        for wrong in Wrong
    }
    assert mended(every) == []
    assert all(item.startswith("item ") for item in KNOWN.values())


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Corpus:
    """A corpus that needs no recording: a checked-in trace stands for the robot's."""
    folder = tmp_path_factory.mktemp("corpus")
    for name, sample in (("robot", "schedule/a"), ("other", "schedule/b")):
        (folder / f"{name}.mcap").write_bytes((SAMPLES / f"{sample}.mcap").read_bytes())
    return Corpus(folder)


def _made(family: Family, seed: int, folder: Path, corpus: Corpus) -> dict[str, object]:
    folder.mkdir(parents=True)
    case = family.case(seed, folder, corpus)
    for clean in case.cleanup:
        clean()
    files = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }
    return {"files": files, "words": [c.words for c in case.commands], "note": case.note}


@pytest.mark.parametrize(
    "name",
    [
        "traces",
        "records",
        "schemas",
        "texts",
        "pasted",
        "bags",
        "jobs",
        "nodes",
        "kills",
        "golden",
        "replays",
    ],
)
def test_a_seed_always_makes_the_same_case(name: str, tmp_path: Path, corpus: Corpus) -> None:
    family = families()[name]
    folder = tmp_path / "case"
    seen = []
    for seed in (0, 1, 2, 3, 1001, 1002):
        made = _made(family, seed, folder, corpus)
        folder.rename(tmp_path / "first")
        assert _made(family, seed, folder, corpus) == made, f"seed {seed}"
        folder.rename(tmp_path / "second")
        (tmp_path / "first").rename(tmp_path / f"first-{seed}")
        (tmp_path / "second").rename(tmp_path / f"second-{seed}")
        seen.append(made)
    assert any(made != seen[0] for made in seen[1:])


def test_seeds_try_all_attacks_in_turn() -> None:
    for family in families().values():
        count = len(family.attacks)
        assert {family.attack_of(seed) for seed in range(7, 7 + count)} == set(family.attacks)


def test_streams_do_not_depend_on_the_process() -> None:
    assert stream("traces", 1234).randrange(10**9) == 255489659


def test_a_file_put_together_again_is_the_same() -> None:
    for path in SAMPLES.glob("*/*.mcap"):
        data = path.read_bytes()
        assert mcap_parts.put_together(mcap_parts.take_apart(data)) == data


def test_a_forger_who_changes_nothing_gets_the_same_digest() -> None:
    for path in SAMPLES.glob("*/*.mcap"):
        parts = mcap_parts.take_apart(path.read_bytes())
        with rsltrace.Trace.open(path) as trace:
            assert mcap_parts.rehash(parts) == trace.digest


def test_a_reading_sees_what_is_changed(tmp_path: Path, corpus: Corpus) -> None:
    place = tmp_path / "x.mcap"
    place.write_bytes(corpus.robot)
    before = content(place)
    assert len(json.loads(before)["events"]) > 100
    parts = mcap_parts.take_apart(corpus.robot)
    mcap_parts.change_messages(
        parts, "/tilt", lambda data, nth: data[:-1] + b"\1" if not nth else data
    )
    place.write_bytes(mcap_parts.put_together(parts))
    assert content(place) != before


# Sabotage: a target that is broken on purpose, once for each thing the oracle must see.

_SABOTAGE: dict[Wrong, str] = {
    Wrong.DIED: "import os; os.abort()",
    Wrong.STATUS: "import sys; sys.stderr.write('error: x.mcap'); sys.exit(9)",
    Wrong.TRACEBACK: "raise RuntimeError('inside')",
    Wrong.UNNAMED: "import sys; sys.exit('error: no')",
    Wrong.RAW: "print('\\x1b]0;owned\\x07')",
    Wrong.CPU: "while True: pass",
    Wrong.MEMORY: "x = b'x' * (1500 << 20)",
    Wrong.HANG: "import time; time.sleep(60)",
    Wrong.EXECUTED: "open('canary', 'w').write('x')",
    Wrong.SECRET: "print('password-of-mine')",
    Wrong.LEFT: "import os, time\nif os.fork() == 0: time.sleep(600)",
}


def _tight() -> Limits:
    """Return limits that sabotage breaks. A process began as a copy of this one, and its peak as
    what this one has."""
    status = Path("/proc/self/status").read_text()
    own_mib = int(status.split("VmRSS:")[1].split()[0]) >> 10
    return Limits(cpu_s=2, rss_mib=own_mib + 100)


def _case(folder: Path) -> Case:
    return Case(folder, names=("x.mcap",), secrets=("password-of-mine",))


def _run(case: Case, code: str, allowed: frozenset[int] = oracle.READING) -> Ran:
    program = (sys.executable, "-c", code)
    limits = _tight()
    if "sleep(60)" in code:
        limits = dataclasses.replace(limits, wall_s=2)
    command = Command(("info", "x.mcap"), allowed, case.folder, limits=limits, program=program)
    return execution.run(command, case.folder.parent / "streams")


@pytest.mark.few(4)
@pytest.mark.parametrize("wrong", _SABOTAGE, ids=lambda wrong: wrong.value)
def test_the_oracle_sees_sabotage(
    wrong: Wrong, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(execution, "LEFT_S", 0.5)
    (tmp_path / "case").mkdir()
    case = _case(tmp_path / "case")
    allowed = oracle.READING | {1} if wrong in (Wrong.TRACEBACK, Wrong.UNNAMED) else oracle.READING
    code = _SABOTAGE[wrong]
    if wrong is Wrong.UNNAMED:
        code = "import sys; sys.stderr.write('error: no'); sys.exit(2)"
    found = oracle.judge(case, [_run(case, code, allowed)])
    assert [complaint.wrong for complaint in found] == [wrong]


@pytest.mark.parametrize(
    "code",
    [
        "print('fine: é \\t ✓')",
        "import sys; sys.exit(print('error: x.mcap is cut', file=sys.stderr) or 2)",
    ],
)
def test_the_oracle_lets_answers_and_named_errors_pass(code: str, tmp_path: Path) -> None:
    (tmp_path / "case").mkdir()
    case = _case(tmp_path / "case")
    assert oracle.judge(case, [_run(case, code)]) == []


def test_users_tracebacks_are_theirs_unless_ours_are_in_them(tmp_path: Path) -> None:
    case = dataclasses.replace(_case(tmp_path), user_code=True)
    command = Command(("record", "x"), oracle.RECORDING, tmp_path)
    theirs = b'error: x.mcap\nTraceback (most recent call last):\n  File "/home/me.py", line 3\n'
    place = Path(rsltrace.__file__).parent / "run" / "session.py"
    ours = theirs + f'  File "{place}", line 9, in go\n'.encode()
    assert oracle.judge(case, [Ran(command, 3, b"", theirs, 0, 1, 0)]) == []
    (found,) = oracle.judge(case, [Ran(command, 3, b"", ours, 0, 1, 0)])
    assert found.wrong is Wrong.TRACEBACK


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (lambda data: data[:-500], Wrong.ANSWER),
        (None, Wrong.FORGED),
    ],
)
def test_identical_is_not_believed(
    change: object, wrong: Wrong, tmp_path: Path, corpus: Corpus
) -> None:
    """A diff that says "identical" of a cut file, or of one with other messages, is caught."""
    data = corpus.robot
    if callable(change):
        hostile = change(data)
    else:
        parts = mcap_parts.take_apart(data)
        mcap_parts.change_messages(parts, "/tilt", lambda one, nth: one[:-1] + b"\7")
        hostile = mcap_parts.put_together(parts)
    (tmp_path / "case").mkdir()
    case = Case(tmp_path / "case")
    attack_trace(case, stream("x", 1), hostile, data, differs=callable(change))
    checked = not callable(change)  # without --check, diff reads no messages
    (diff, *_) = [
        c for c in case.commands if c.words[0] == "diff" and ("--check" in c.words) is checked
    ]
    assert case.judge is not None
    (found,) = case.judge([Ran(diff, 0, b"identical", b"", 0, 1, 0)])
    assert found.wrong is wrong
    assert case.judge([Ran(diff, 1, b"they diverge", b"", 0, 1, 0)]) == []


def test_a_kill_from_outside_is_no_crash(tmp_path: Path) -> None:
    (tmp_path / "case").mkdir()
    case = _case(tmp_path / "case")
    code = "import time\nopen('grown', 'w').write('x' * 100)\ntime.sleep(60)"
    command = Command(
        ("record",),
        oracle.READING,
        case.folder,
        program=(sys.executable, "-c", code),
        kill=Kill(signal.SIGKILL, 50),
    )
    ran = execution.run(command, tmp_path / "streams")
    assert (ran.status, ran.killed, ran.timed_out) == (-signal.SIGKILL, True, False)
    assert oracle.judge(case, [ran]) == []


def test_what_gave_way_is_kept_with_its_reproducer(tmp_path: Path, corpus: Corpus) -> None:
    def attack(rng: object, case: Case, corpus: Corpus) -> None:
        (case.folder / "bad.mcap").write_bytes(b"bad")
        case.commands.append(
            Command(
                ("info",),
                oracle.READING,
                case.folder,
                program=(sys.executable, "-c", "print('\\x1b')"),
            )
        )

    family = Family("sabotage", {"one": attack, "other": attack})
    verdict = campaign.try_case(family, 7, tmp_path, corpus, tmp_path / "kept")
    assert verdict.keys == {"sabotage/other: raw"}
    place = tmp_path / "kept" / "sabotage-other-7"
    assert (place / "bad.mcap").read_bytes() == b"bad"
    report = (place / "report.txt").read_text()
    assert report.startswith("python -m campaigns.attack --family sabotage --seed 7\n")
    assert "\x1b" not in report
    assert campaign.from_json(campaign.as_json(verdict)) == verdict


def test_the_table_has_a_row_for_each_family() -> None:
    tally = campaign.Tally()
    fine = Verdict("jobs", "keys", 1, ("answer", "named error"), (), 0.5, 0.4, 60.0, 1.0)
    bad = dataclasses.replace(fine, family="nodes", complaints=(Complaint(Wrong.LOST, "x"),))
    for verdict in (fine, fine, bad):
        tally.add(verdict)
    rows = tally.table().splitlines()
    assert rows[2] == "| jobs | 2 | 4 | 2 | 2 | 0 | 0 | 0 | 1 | 0.4 | 60 |"
    assert rows[3] == "| nodes | 1 | 2 | 1 | 1 | 0 | 1 | 0 | 0 | 0.4 | 60 |"
    assert rows[4].startswith("| all | 3 | 6 | 3 | 3 |")
    assert tally.unknown() == [bad]


@pytest.mark.long
def test_the_reproducer_does_it_again(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "campaigns.attack", "--family", "texts", "--seed", "5"]
    done = subprocess.run(
        [*words, "--out", str(tmp_path)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        check=False,
    )
    (line,) = (tmp_path / "cases.jsonl").read_text().splitlines()
    verdict = campaign.from_json(line)
    assert (verdict.family, verdict.seed, verdict.attack) == ("texts", 5, "code-lines")
    assert verdict.reproducer == "python -m campaigns.attack --family texts --seed 5"
    assert done.returncode in (0, 1)
