"""Changed traces for commands that do more than read: ``replay``, ``rerun``, ``export``.

``replay`` runs what a trace names, so a stranger's trace is the way to a stranger's code. The
canary lies in modules, launch files and folders that such a trace can name; nobody says
``--trust``.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

from mcap import records
from mcap.opcode import Opcode

from campaigns.attack import hostile, mcap_parts, oracle
from campaigns.attack.corpus import SAMPLES, Corpus, put_robot
from campaigns.attack.execution import call
from campaigns.attack.families import records as changed_records
from campaigns.attack.families import schemas, texts, traces
from campaigns.attack.families.common import Attack, Family
from campaigns.attack.families.trace_case import HOSTILE, ORIGINAL
from campaigns.attack.model import Case, Command, Complaint, Limits, Ran, Wrong
from campaigns.attack.reading import content

_LIMITS = Limits(cpu_s=30, rss_mib=700)
_REPLAYING = oracle.COMPARING
_CUT = re.compile("cut off")

# -- traces of jobs that are not the one in the folder ---------------------------------------------

Evil = Callable[[Random, Case, dict[str, Any]], None]
"""Changes the job in a trace (what ``Job.resolved()`` says) into a stranger's."""


def _set(path: str, value: object) -> Evil:
    def change(rng: Random, case: Case, job: dict[str, Any]) -> None:
        *way, last = path.split(".")
        place: Any = job
        for key in way:
            inner = place[int(key)] if isinstance(place, list) else place.get(key)
            if not isinstance(inner, (dict, list)):
                inner = {}
                place[key] = inner
            place = inner
        text = json.dumps(value).replace("ELSEWHERE", str(case.folder / "elsewhere"))
        place[int(last) if isinstance(place, list) else last] = json.loads(text)

    return change


def _add_node(rng: Random, case: Case, job: dict[str, Any]) -> None:
    one = dict(job["nodes"][0])
    one.update(rng.choice(({"node": "canary_nodes:hit"}, {"node": None, "main": "timeit:main"})))
    one["name"] = "another"
    job["nodes"].append(one)


def _anything(rng: Random, case: Case, job: dict[str, Any]) -> None:
    """Put an odd value at an odd place."""
    keys = [*job, "bogus"]
    for _ in range(rng.choice((1, 3))):
        values: list[Any] = [None, [], {}, True, -1, 1e308, hostile.number(rng), [[]] * 1000]
        values += ["canary_nodes:hit", *hostile.texts(case.canary)]
        value = rng.choice(values)
        key = rng.choice(keys)
        if isinstance(job.get(key), dict) and rng.random() < 0.7:
            job[key] = {**job[key], rng.choice([*job[key], "bogus"]): value}
        else:
            job[key] = value


_LAUNCH = {"file": "ELSEWHERE/evil.launch.py", "arguments": {}}
_EVIL: dict[str, tuple[Evil, ...]] = {
    "nodes": (
        _set("nodes.0.node", "canary_nodes:hit"),
        _set("nodes.1.node", "canary_nodes:hit"),
        _set("nodes.0.parameter_files", ["ELSEWHERE/x.yaml"]),
        _set("ros_arguments", ["--params-file", "ELSEWHERE/x.yaml"]),
        _add_node,
    ),
    "functions": (
        _set("hooks.before", "canary_nodes:before"),
        _set("hooks.after", "canary_nodes:after"),
        _set("stop.function", "canary_nodes:hit"),
        _set("policy", {"function": "canary_nodes:hit"}),
        _set("execution", {"default": {"function": "canary_nodes:hit"}}),
        _set("delay", {"default": "canary_nodes:hit"}),
    ),
    "places": (
        _set("search_path", ["ELSEWHERE", "."]),
        _set("search_path", [".", "ELSEWHERE"]),
        _set("search_path", ["elsewhere"]),
        _set("bags", [{"path": "ELSEWHERE/pipe"}]),
        _set("bags", [{"path": "/dev/zero"}]),
        _set("policy", {"recorded": "ELSEWHERE/pipe"}),
        _set("execution", {"default": {"samples": "ELSEWHERE/pipe"}}),
    ),
    "launch": (
        _set("launch", [_LAUNCH]),
        _set("launch", [{"file": "elsewhere/evil.launch.py", "arguments": {}}]),
        _set("launch", [{"file": "../case/elsewhere/evil.launch.py", "arguments": {"a": "b"}}]),
        _set("launch", [{"file": "elsewhere/evil.launch.xml", "arguments": {}}]),
    ),
    "anything": (_anything,),
}


def _stranger(kind: str) -> Attack:
    """A trace whose job is a stranger's, where its job file is one's own."""

    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        put_robot(case.folder)
        _put_elsewhere(case)
        evil = rng.choice(_EVIL[kind])
        _write_trace(case, corpus, lambda job: evil(rng, case, job))
        more = rng.choice(((), (), ("--job-folder", "."), ("--until", "10"), ("--json",)))
        _replay(case, HOSTILE, *more)
        case.judge = lambda runs: _judge_replays(case, runs, answers=False)

    return attack


def _download(rng: Random, case: Case, corpus: Corpus) -> None:
    """Trace, job file and code agree with each other, and are all a stranger's."""
    folder = case.folder
    _put_elsewhere(case)
    download = folder / "download"
    download.mkdir()
    put_robot(download)
    code = (download / "robot.py").read_text()
    (download / "robot.py").write_text(f"open({str(case.canary)!r}, 'a').write('robot')\n{code}")
    _write_trace(case, corpus, lambda job: None)
    (folder / HOSTILE).rename(download / HOSTILE)
    name = f"download/{HOSTILE}"
    if rng.random() < 0.3:
        (folder / "link.mcap").symlink_to(name)
        name = "link.mcap"
    if rng.random() < 0.3:  # one has a job of that name, which runs other code
        (folder / "job.yaml").write_text("nodes: [{node: mine:Mine}]\n")
    case.names = (HOSTILE, "link.mcap")
    _replay(case, name, allowed=frozenset((oracle.USAGE,)))
    case.judge = lambda runs: _judge_replays(case, runs, answers=False)


def _nameless(rng: Random, case: Case, corpus: Corpus) -> None:
    """The trace's job file has another name: that of a stranger's file, or of none."""
    put_robot(case.folder)
    elsewhere = _put_elsewhere(case)
    (elsewhere / "job.yaml").write_text("nodes: [{main: canary_nodes:main, name: x}]\n")
    (elsewhere / "job.launch.py").write_text((elsewhere / "evil.launch.py").read_text())
    for name in ("evil.launch.py", "other.py"):
        shutil.copy(elsewhere / "evil.launch.py", case.folder / name)
    named = rng.choice(
        [
            "elsewhere/job.yaml",
            str(elsewhere / "job.yaml"),
            "../case/elsewhere/job.yaml",
            "evil.launch.py",
            "other.py",
            "<python>",
            "",
            *hostile.texts(case.canary),
        ]
    )
    evil = rng.choice((_set("hooks.before", "canary_nodes:before"), _set("seed", 3)))
    _write_trace(case, corpus, lambda job: evil(rng, case, job), name=named)
    _replay(case, HOSTILE)
    case.judge = lambda runs: _judge_replays(case, runs, answers=False)


def _put_elsewhere(case: Case) -> Path:
    """Make the folder of a stranger, with a module of the name of one's own, too."""
    elsewhere = case.folder / "elsewhere"
    hostile.canary_module(elsewhere, case.canary)
    code = (elsewhere / "canary_nodes.py").read_text()
    (elsewhere / "robot.py").write_text(code)
    (elsewhere / "evil.launch.xml").write_text(
        '<launch><node_container pkg="a" exec="b" name="c" namespace="">'
        '<composable_node pkg="canary_nodes" plugin="canary_nodes.hit" name="x"/>'
        "</node_container></launch>"
    )
    (elsewhere / "x.yaml").write_text("/**: {ros__parameters: {period: 0.5}}\n")
    os.mkfifo(elsewhere / "pipe")
    return elsewhere


def _write_trace(
    case: Case, corpus: Corpus, change: Callable[[dict[str, Any]], None], name: str | None = None
) -> None:
    parts = mcap_parts.take_apart(corpus.robot)
    for part in parts:
        record = part.record if part.opcode == Opcode.METADATA else None
        if isinstance(record, records.Metadata) and record.name == "rsltrace:job":
            job = json.loads(record.metadata["resolved"])
            change(job)
            record.metadata["resolved"] = json.dumps(job)
            if name is not None:
                record.metadata["name"] = name
            part.record = record
    (case.folder / HOSTILE).write_bytes(mcap_parts.put_together(parts))
    case.names = (HOSTILE, "job.yaml", "No such command")
    case.user_code = True


def _replay(case: Case, name: str, *more: str, allowed: frozenset[int] = _REPLAYING) -> None:
    case.commands.append(
        Command(
            ("replay", name, "--no-pin", "--quiet", *more),
            allowed,
            case.folder,
            limits=_LIMITS,
            environment=(("PYTHONPATH", str(case.folder / "elsewhere")),),
        )
    )


# -- traces that are damaged, or changed by who knows the format -----------------------------------


def _as_changed_by(family: Family) -> Attack:
    """Take what another family makes of a trace, and replay, draw and export that."""

    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        folder = case.folder
        family.attacks[rng.choice(list(family.attacks))](rng, case, corpus)
        original = (folder / ORIGINAL).read_bytes()
        for pair, data in corpus.samples.items():
            if data == original:
                for source in (SAMPLES / pair.partition("/")[0]).iterdir():
                    if source.suffix in (".py", ".yaml"):
                        shutil.copy(source, folder)
        if not (folder / "job.yaml").exists():
            put_robot(folder)
        case.commands.clear()
        case.names += ("job.yaml",)
        case.user_code = True
        _replay(case, HOSTILE, *rng.choice(((), ("--json",), ("-o", "again.mcap"))))
        (limits, topics) = (Limits(cpu_s=30, rss_mib=900), rng.choice(("*", "/r*", "?x[", "/said")))
        (folder / "old.rrd").write_bytes(b"old")
        words = [
            ("rerun", HOSTILE, "-o", "new.rrd"),
            ("rerun", ORIGINAL, HOSTILE, "-o", "old.rrd", "--force"),
            ("export", HOSTILE, "-o", "bag", "--topic", topics),
        ]
        for each in rng.sample(words, 2):
            case.commands.append(oracle.reading(*each, cwd=folder, limits=limits))
        case.judge = lambda runs: _judge_replays(case, runs) + _judge_files(case, runs)

    return attack


def _judge_replays(case: Case, runs: Sequence[Ran], *, answers: bool = True) -> list[Complaint]:
    """A replay that ends well has verified the whole trace, and that is one of the right run."""
    found: list[Complaint] = []
    for ran in runs:
        if ran.command.words[0] != "replay" or ran.status != oracle.OK or not answers:
            continue
        told = (ran.stdout + ran.stderr).decode("utf-8", "replace")
        ours, theirs = _events(case, ORIGINAL), _events(case, HOSTILE)
        if theirs is None:
            continue  # damaged where it was not read, or nobody else can tell
        if ours is not None and theirs != ours[: len(theirs)]:
            found.append(Complaint(Wrong.ANSWER, "verified events that are others", ran.line))
        elif ours is not None and len(theirs) < len(ours) and not _CUT.search(told):
            found.append(Complaint(Wrong.ANSWER, "verified a part, and does not say so", ran.line))
    return found


def _events(case: Case, name: str) -> list[object] | None:
    answer = call(lambda: content(case.folder / name), case.folder / ".scratch")
    if answer is None:
        return None
    found = json.loads(answer)["events"]
    assert isinstance(found, list)
    return found


def _read(place: Path) -> bytes:
    return place.read_bytes() if place.is_file() else b""


def _judge_files(case: Case, runs: Sequence[Ran]) -> list[Complaint]:
    """What was not written well is not there; what was there before, is."""
    found: list[Complaint] = []
    folder = case.folder
    for ran in runs:
        words = ran.command.words
        if words[0] == "rerun":
            name = words[words.index("-o") + 1]
            place = folder / name
            if ran.status == oracle.OK and not (place.is_file() and place.stat().st_size > 3):
                found.append(Complaint(Wrong.LOST, f"{name} is not there", ran.line))
            if ran.status == oracle.USAGE and name == "new.rrd" and place.exists():
                found.append(Complaint(Wrong.LOST, f"half of {name} is left", ran.line))
            if ran.status == oracle.USAGE and name == "old.rrd" and _read(place) != b"old":
                found.append(Complaint(Wrong.LOST, f"the old {name} is gone", ran.line))
        if words[0] == "export" and ran.status == oracle.USAGE and (folder / "bag").exists():
            found.append(Complaint(Wrong.LOST, "half of a bag is left", ran.line))
    return found


FAMILY = Family(
    "replays",
    {
        **{f"stranger-{kind}": _stranger(kind) for kind in _EVIL},
        "download": _download,
        "nameless": _nameless,
        "traces": _as_changed_by(traces.FAMILY),
        "records": _as_changed_by(changed_records.FAMILY),
        "texts": _as_changed_by(texts.FAMILY),
        "schemas": _as_changed_by(schemas.FAMILY),
    },
    ros=True,
)
