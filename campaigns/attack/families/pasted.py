"""The ``next:`` line of a report is there to be pasted; a stranger's trace must not be in it.

Each line is pasted into a shell, in a folder with nothing of the stranger's. There ``rsltrace``
only writes down how it was called. Then each of these calls is made in earnest. The canary lies
where such words would lead: a module on the path, a launch file, jobs elsewhere.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Sequence
from random import Random

from mcap import records
from mcap.opcode import Opcode

from campaigns.attack import execution, hostile, mcap_parts, oracle
from campaigns.attack.corpus import SAMPLES, Corpus
from campaigns.attack.families.common import Family
from campaigns.attack.families.texts import with_strings
from campaigns.attack.mcap_parts import Part
from campaigns.attack.model import Case, Complaint, Ran, Wrong

_NEXT = re.compile(r"next:\s+(\S.*)")
_SHIM = """#!/bin/sh
for word in "$@"; do printf '%s\\0' "$word"; done >> {log}
printf '\\n\\0' >> {log}
"""


def _evil_words(rng: Random, case: Case) -> list[str]:
    """Return what a stranger would write behind ``with --`` in the job of a trace."""
    elsewhere = case.folder / "elsewhere"
    return [
        "set nodes=[{main: canary_nodes:main, name: x}]",
        "set nodes.+={node: canary_nodes:hit}",
        "set hooks={after: canary_nodes:hit}",
        "set hooks.before=canary_nodes:before",
        f"set search_path=[{elsewhere}]",
        f"set launch.+={json.dumps({'file': str(elsewhere / 'evil.launch.py'), 'arguments': {}})}",
        f'set launch.+={{"file": "{elsewhere}/evil.launch.py", "arguments": {{"a": "b"}}}}',
        f"set launch=[{elsewhere}/evil.launch.py]",
        "set launch.+=evil.launch.py",
        f"launch {elsewhere}/evil.launch.py",
        f"set ros_arguments=[--params-file, {elsewhere}/x.yaml]",
        f"output {case.canary}",
        f"set x=1 -o {case.canary}",
        f"bag {elsewhere}",
        "set " + rng.choice(hostile.shell_texts(case.canary)),
        rng.choice(hostile.shell_texts(case.canary)),
    ]


def _texts_of_job(rng: Random, case: Case, parts: list[Part]) -> None:
    lines = rng.sample(_evil_words(rng, case), rng.choice((1, 1, 3)))
    text = "# The effective job of job.yaml\n" + "".join(f"#   with --{x}\n" for x in lines)
    for part in parts:
        record = part.record if part.opcode == Opcode.ATTACHMENT else None
        if isinstance(record, records.Attachment) and record.name == "job.yaml":
            record.data = text.encode("utf-8", "surrogatepass") + b"nodes: []\n"
            part.record = record


def _name_of_job(rng: Random, case: Case, parts: list[Part]) -> None:
    elsewhere = case.folder / "elsewhere"
    name = rng.choice(
        [
            str(elsewhere / "job.yaml"),
            "../case/elsewhere/job.yaml",
            "elsewhere/../elsewhere/job.yaml",
            "--launch=evil.launch.py",
            f"--launch={elsewhere}/evil.launch.py",
            "--set=nodes=[{main: canary_nodes:main}]",
            *hostile.texts(case.canary),
        ]
    )
    for part in parts:
        record = part.record if part.opcode == Opcode.METADATA else None
        if isinstance(record, records.Metadata) and record.name == "rsltrace:job":
            record.metadata["name"] = name
            part.record = record


def _names_of_nodes(rng: Random, case: Case, parts: list[Part]) -> None:
    text = rng.choice(hostile.texts(case.canary)).encode("utf-8", "surrogatepass")

    def one(data: bytes, nth: int) -> bytes:
        return with_strings(
            data, "/rsltrace/entities", lambda n, old: old and text if n == 0 else old
        )

    mcap_parts.change_messages(parts, "/rsltrace/entities", one)


def _attack(change: Callable[[Random, Case, list[Part]], None]) -> Callable[..., None]:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        pair = rng.choice(
            (
                "delayed_input",
                "delayed_input",
                "nondeterministic_callback",
                "schedule",
                "missing_event",
            )
        )
        folder = case.folder
        elsewhere = folder / "elsewhere"
        hostile.canary_module(elsewhere, case.canary)
        (elsewhere / "job.yaml").write_text("nodes: [{main: canary_nodes:main, name: x}]\n")
        for side in "ab":
            parts = mcap_parts.take_apart(corpus.samples[f"{pair}/{side}"])
            change(rng, case, parts)
            (folder / f"{side}.mcap").write_bytes(mcap_parts.put_together(parts))
        if rng.random() < 0.5:  # the job that one has oneself
            for source in (SAMPLES / pair).iterdir():
                if source.suffix in (".py", ".yaml"):
                    (folder / source.name).write_bytes(source.read_bytes())
        case.names = ("a.mcap", "b.mcap")
        for words in (["a.mcap", "b.mcap"], ["b.mcap", "a.mcap", "--all"]):
            for form in ("text", "markdown"):
                case.commands.append(oracle.reading("diff", *words, "--format", form, cwd=folder))
        case.commands.append(oracle.reading("info", "a.mcap", cwd=folder))
        case.judge = lambda runs: _judge(case, runs)

    return attack


def _judge(case: Case, runs: Sequence[Ran]) -> list[Complaint]:
    """Paste every ``next:`` line, and look what became of the canary."""
    lines = sorted(
        {
            match[1].strip("`")
            for ran in runs
            for match in _NEXT.finditer(ran.stdout.decode("utf-8", "replace"))
        }
    )
    found: list[Complaint] = []
    shims = case.folder / "shims"
    shims.mkdir(exist_ok=True)
    log = case.folder / "called"
    (shims / "rsltrace").write_text(_SHIM.format(log=log))
    (shims / "rsltrace").chmod(0o755)
    environment = {
        "PATH": f"{shims}:{os.environ.get('PATH', '')}",
        "PYTHONPATH": str(case.folder / "elsewhere"),
    }
    for line in lines:
        log.unlink(missing_ok=True)
        before = {path.name for path in case.folder.iterdir()}
        execution.run_shell(line, case.folder, environment)
        strange = {path.name for path in case.folder.iterdir()} - before - {"called"}
        if strange:
            found.append(Complaint(Wrong.EXECUTED, f"the shell made {sorted(strange)}", line))
        calls = log.read_bytes().decode("utf-8", "replace").split("\n\0") if log.exists() else []
        for call in calls:
            words = tuple(call.split("\0")[:-1])
            if words[:1] == ("record",):
                found += _call_in_earnest(case, words, line)
    return found


def _call_in_earnest(case: Case, words: tuple[str, ...], line: str) -> list[Complaint]:
    command = oracle.reading(
        "record",
        *words[1:],
        "--no-pin",
        "--quiet",
        cwd=case.folder,
        environment=(("PYTHONPATH", str(case.folder / "elsewhere")),),
    )
    execution.run(command, case.folder.parent / "pasted")
    if case.canary.exists():
        text = case.canary.read_text(errors="replace")[:100]
        case.canary.unlink()
        return [Complaint(Wrong.EXECUTED, f"pasted, it ran a stranger's code: {text!r}", line)]
    return []


FAMILY = Family(
    "pasted",
    {
        "job-text": _attack(_texts_of_job),
        "job-name": _attack(_name_of_job),
        "node-names": _attack(_names_of_nodes),
    },
    rounds=2,
    ros=True,
)
