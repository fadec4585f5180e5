"""Disks that are full, outputs that are no files, streams that nobody reads any more."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from random import Random

from campaigns.attack.corpus import Corpus, put_robot
from campaigns.attack.families import recordings
from campaigns.attack.families.common import Attack, Family
from campaigns.attack.model import Case, Command, Complaint, Limits, Ran, Wrong

_INPUTS = ("a.mcap", "b.mcap", "job.yaml", "robot.py")
_BROKEN_PIPE = 141
_NOBODY = 65534
_DEVICES = {"null": 3, "full": 7}
_LIMITS = Limits(cpu_s=12, rss_mib=700)

_WRITING: tuple[tuple[str, ...], ...] = (
    ("record", "job.yaml", "-o", "out.mcap"),
    ("record", "job.yaml", "-o", "out.mcap", "--export-bag", "bag"),
    ("record", "job.yaml", "-o", "out.mcap", "--force"),
    ("export", "a.mcap", "-o", "bag"),
    ("diff", "a.mcap", "b.mcap", "-o", "report.txt"),
    ("diff", "a.mcap", "b.mcap", "-o", "report.txt", "--format", "junit"),
    ("view", "a.mcap", "--export", "screen.svg"),
    ("rerun", "a.mcap", "-o", "out.rrd"),
    ("check", "job.yaml", "--graph", "graph.svg"),
    ("init", "new.yaml", "--from", "robot.py:Arm"),
)
_PRINTING: tuple[tuple[str, ...], ...] = (
    ("info", "a.mcap"),
    ("info", "a.mcap", "--json"),
    ("cat", "a.mcap"),
    ("cat", "a.mcap", "--json", "--payloads"),
    ("diff", "a.mcap", "b.mcap"),
    ("diff", "a.mcap", "a.mcap", "--format", "json"),
    ("diff", "a.mcap", "nowhere.mcap"),
    ("check", "job.yaml"),
    ("audit", "job.yaml"),
    ("schema",),
    ("record", "job.yaml", "-o", "out.mcap"),
    ("record", "job.yaml", "-o", "out.mcap", "--json"),
    ("record", "nowhere.yaml"),
    ("--help",),
    ("--version",),
    ("nonsense",),
)


def _begin(case: Case, corpus: Corpus) -> str:
    put_robot(case.folder)
    (case.folder / "a.mcap").write_bytes(corpus.robot)
    (case.folder / "b.mcap").write_bytes(corpus.other)
    case.user_code = True
    case.names = (
        "out.mcap",
        "bag",
        "report.txt",
        "screen.svg",
        "out.rrd",
        "graph.svg",
        "new.yaml",
        "job.schema.json",
        "job.yaml",
    )
    return _state(case.folder)


def _state(folder: Path) -> str:
    parts = [
        hashlib.sha256(place.read_bytes()).hexdigest() if place.is_file() else "gone"
        for place in (folder / name for name in _INPUTS)
    ]
    return " ".join(parts)


def _command(case: Case, words: Sequence[str], **more: object) -> Command:
    pin = ("--no-pin",) if words[0] == "record" else ()
    made = Command((*words, *pin), frozenset((0, 1, 2, 3)), case.folder, limits=_LIMITS)
    return dataclasses.replace(made, **more)  # type: ignore[arg-type]


def _inputs_kept(case: Case, before: str, ran: Ran) -> list[Complaint]:
    if _state(case.folder) == before:
        return []
    return [Complaint(Wrong.LOST, "a file that it reads was overwritten", ran.line)]


def _outputs_whole(case: Case, ran: Ran) -> list[Complaint]:
    """What exit 0 stands for: each file named on the command line is there, and can be read."""
    if ran.status not in (0, 1) or (ran.status == 1 and ran.command.words[0] != "diff"):
        return []
    found = []
    for option in ("-o", "--export-bag", "--export", "--graph"):
        if option in ran.command.words:
            place = case.folder / ran.command.words[ran.command.words.index(option) + 1]
            if not place.exists() or (place.is_file() and not place.stat().st_size):
                text = f"status {ran.status}, and {place.name} is not there, or empty"
                found.append(Complaint(Wrong.LOST, text, ran.line))
    if ran.command.words[0] == "record" and not found:
        found += recordings.judge(case, [ran])
    return found


def _no_room(rng: Random, case: Case, corpus: Corpus) -> None:
    """The file system ends a file at so many bytes."""
    before = _begin(case, corpus)
    words = rng.choice(_WRITING)
    old = ""
    if "--force" in words:
        (case.folder / "out.mcap").write_bytes(corpus.robot)
        old = recordings.fingerprint(case)
    size = rng.choice((0, 1, 100, 2000, 20_000, 50_000, rng.randrange(100_000)))
    case.note = f"files end at {size} bytes"
    limits = dataclasses.replace(_LIMITS, file_bytes=size)
    command = _command(case, words, limits=limits, stderr="lost" if size < 5000 else "file")
    case.commands.append(command)

    def judge(runs: Sequence[Ran]) -> list[Complaint]:
        found = _inputs_kept(case, before, runs[-1]) + _outputs_whole(case, runs[-1])
        if old and runs[-1].status:
            found += recordings.judge(case, runs, old=old)
        if words[0] in ("diff", "export", "view", "rerun") and runs[-1].status == 2:
            target = case.folder / words[words.index("-o" if "-o" in words else "--export") + 1]
            if target.exists():
                text = f"{target.name} was left, half-written"
                found.append(Complaint(Wrong.LOST, text, runs[-1].line))
        return found

    case.judge = judge


def _stream(name: str, how: str) -> Attack:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        before = _begin(case, corpus)
        words = rng.choice(_PRINTING)
        case.names = (*case.names, "nowhere", "nonsense", "No space", "Bad file")
        more: dict[str, object] = {name: how}
        if how == "closed" and rng.random() < 0.3:
            more = {"stdout": "closed", "stderr": "closed"}
        fresh = rng.random() < 0.1
        case.commands.append(_command(case, words, fresh=fresh))
        second = (*words, "--force") if words[0] == "record" else words
        allowed = frozenset((0, 1, 2, 3, _BROKEN_PIPE))
        case.commands.append(_command(case, second, fresh=fresh, allowed=allowed, **more))
        case.judge = lambda runs: (
            _judge_stream(runs, "stdout" in more)
            + _inputs_kept(case, before, runs[-1])
            + (_outputs_whole(case, runs[-1]) if words[0] == "record" else [])
        )

    return attack


def _judge_stream(runs: Sequence[Ran], stdout: bool) -> list[Complaint]:
    healthy, hurt = runs
    if hurt.status < 0 or hurt.status == healthy.status != 0:
        return []
    if not stdout:
        if hurt.status == healthy.status:
            return []
        text = f"status {hurt.status} instead of {healthy.status}, as nobody takes the errors"
        return [Complaint(Wrong.STATUS, text, hurt.line)]
    if hurt.command.stdout == "full" and hurt.status == 0 and healthy.stdout:
        return [Complaint(Wrong.LOST, "status 0, though its output went nowhere", hurt.line)]
    if hurt.status in (2, _BROKEN_PIPE) or hurt.status == healthy.status:
        return []
    text = f"status {hurt.status} instead of {healthy.status} or 2"
    return [Complaint(Wrong.STATUS, text, hurt.line)]


def _strange_outputs(rng: Random, case: Case, corpus: Corpus) -> None:
    """Outputs that are inputs, devices, folders, links, nowhere."""
    before = _begin(case, corpus)
    folder = case.folder
    (folder / "folder").mkdir()
    (folder / "link").symlink_to("a.mcap")
    (folder / "hard").hardlink_to(folder / "a.mcap")
    (folder / "circle").symlink_to("circle")
    _devices(folder)
    place = rng.choice(
        "a.mcap job.yaml robot.py link hard circle folder folder/x/y.mcap full null . "
        "/proc/nowhere job.yaml/x".split()
    )
    words = rng.choice(
        (
            ("record", "job.yaml", "-o", place, "--force"),
            ("record", "job.yaml", "-o", place),
            ("record", "job.yaml", "-o", "out.mcap", "--export-bag", place),
            ("export", "a.mcap", "-o", place),
            ("export", "a.mcap", "-o", place, "--force"),
            ("diff", "a.mcap", "b.mcap", "-o", place),
            ("view", "a.mcap", "--export", place),
            ("init", place, "--from", "robot.py:Arm"),
            ("check", "job.yaml", "--graph", place),
        )
    )
    case.names = (*case.names, place, "a.mcap")
    case.note = f"writes to {place}"
    case.commands.append(_command(case, words))
    is_read = words[0] != "diff" or place not in ("job.yaml", "robot.py")
    case.judge = lambda runs: (
        (_inputs_kept(case, before, runs[-1]) if is_read else [])
        + _devices_kept(case.folder, runs[-1])
    )


def _devices(folder: Path) -> None:
    """Make devices of the case's own: those of the machine must survive that we are root."""
    for name, number in _DEVICES.items():
        try:
            os.mknod(folder / name, stat.S_IFCHR | 0o666, os.makedev(1, number))
        except PermissionError:
            os.mkfifo(folder / name)


def _devices_kept(folder: Path, ran: Ran) -> list[Complaint]:
    gone = [name for name in _DEVICES if not _is_special(folder / name)]
    if not gone:
        return []
    return [Complaint(Wrong.LOST, f"a device or pipe was replaced: {gone}", ran.line)]


def _is_special(place: Path) -> bool:
    return place.is_char_device() or place.is_fifo()


def _another_user(rng: Random, case: Case, corpus: Corpus) -> None:
    """A folder in which one may read and not write, or not even read."""
    before = _begin(case, corpus)
    if os.geteuid() != 0:
        case.skipped = "only root can try as another user"
        return
    mode = rng.choice((0o755, 0o700, 0o000))
    hidden = rng.choice(_INPUTS)
    (case.folder / hidden).chmod(mode & 0o600 if mode else 0)
    parent = case.folder
    while parent.parent != parent and parent.stat().st_mode & 0o005 != 0o005:
        parent.chmod(parent.stat().st_mode | 0o055)
        parent = parent.parent
    words = rng.choice(_WRITING + _PRINTING[:8])
    case.names = (*case.names, *_INPUTS, "nowhere.mcap", "Permission")
    case.commands.append(_command(case, words, user=_NOBODY))
    case.judge = lambda runs: _inputs_kept(case, before, runs[-1])


@lru_cache(maxsize=1)
def _why_no_mount() -> str:
    words = ["unshare", "-m", "sh", "-c", "mount -t tmpfs -o size=64k none /mnt"]
    if shutil.which("unshare") is None or shutil.which("mount") is None:
        return "there is no unshare or mount here"
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else f"mounting is not permitted: {done.stderr.strip()}"


def _small_disk(rng: Random, case: Case, corpus: Corpus) -> None:
    """A file system of a few pages, filled while it is written to."""
    before = _begin(case, corpus)
    case.skipped = _why_no_mount()
    if case.skipped:
        return
    small = case.folder / "small"
    small.mkdir()
    after = case.folder / "after"
    after.mkdir()
    words = rng.choice(_WRITING[:6])
    changed = ["small/" + w if w in ("out.mcap", "bag", "report.txt") else w for w in words]
    if words[0] == "record":
        changed.append("--no-pin")
    size = rng.choice((8, 16, 64, 128))
    ours = Path(sys.executable).with_name("rsltrace")
    script = (
        f"mount -t tmpfs -o size={size}k none small && "
        f"{ours} {' '.join(changed)}; s=$?; cp -r small/. after/; exit $s"
    )
    program = (shutil.which("unshare") or "", "-m", "/bin/sh", "-c", script)
    case.commands.append(_command(case, words, program=program))

    def judge(runs: Sequence[Ran]) -> list[Complaint]:
        for path in after.iterdir():
            path.rename(case.folder / path.name)
        return _inputs_kept(case, before, runs[-1]) + _outputs_whole(case, runs[-1])

    case.judge = judge


_ATTACKS: dict[str, Callable[[Random, Case, Corpus], None]] = {
    "no-room": _no_room,
    "stdout-full": _stream("stdout", "full"),
    "stderr-full": _stream("stderr", "full"),
    "stdout-closed": _stream("stdout", "closed"),
    "stderr-closed": _stream("stderr", "closed"),
    "strange-outputs": _strange_outputs,
    "another-user": _another_user,
    "small-disk": _small_disk,
}

FAMILY = Family("disks", _ATTACKS, ros=True)
