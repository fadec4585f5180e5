"""Bags, in MCAP and in sqlite3, and the ``metadata.yaml`` beside them."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

from mcap import records
from mcap.opcode import Opcode

from campaigns.attack import hostile, mcap_parts, oracle
from campaigns.attack.corpus import Corpus, put_robot
from campaigns.attack.families.common import Family
from campaigns.attack.families.trace_case import flip
from campaigns.attack.model import Case, Command, Complaint, Limits, Ran, Wrong

_LIMITS = Limits(cpu_s=10, rss_mib=700)
_JOB = """\
nodes: [{node: robot:Arm}]
bags: [hostile]
stop: {duration: 500ms}
"""


def _ask(rng: Random, case: Case, *, differs: bool = False, single: str = "") -> None:
    """Have everything that reads bags read ``hostile``, or one file of it."""
    folder = case.folder
    put_robot(folder)
    (folder / "play.yaml").write_text(_JOB)
    case.names = ("hostile", "play.yaml", "--by needs a recording")
    target = single or "hostile"
    sides = rng.choice((("original", target), (target, "original")))
    commands = [
        oracle.reading("diff", *sides, cwd=folder, limits=_LIMITS),
        oracle.reading("diff", target, target, "--by", "stamp", cwd=folder, limits=_LIMITS),
        oracle.reading("init", "new.yaml", "--from", target, cwd=folder, limits=_LIMITS),
        Command(
            ("record", "play.yaml", "--no-pin", "--quiet", "-o", "out.mcap", "--force"),
            oracle.RECORDING,
            folder,
            limits=_LIMITS,
        ),
    ]
    if single:
        commands[3:] = [oracle.reading("info", single, cwd=folder, limits=_LIMITS)]
    case.commands += commands
    case.judge = lambda runs: _judge(runs, differs=differs)


def _judge(runs: Sequence[Ran], *, differs: bool) -> list[Complaint]:
    if not differs:
        return []
    return [
        Complaint(Wrong.ANSWER, "called equal, though messages are missing or others", ran.line)
        for ran in runs
        if ran.command.words[0] == "diff" and "original" in ran.command.words and ran.status == 0
    ]


def _copied(case: Case, source: Path) -> Path:
    """Copy a bag into the case, whole as ``original`` and to be hurt as ``hostile``."""
    for name in ("original", "hostile"):
        shutil.copytree(source, case.folder / name)
    return case.folder / "hostile"


def _storage(folder: Path) -> Path:
    (place,) = [path for path in folder.iterdir() if path.name != "metadata.yaml"]
    return place


def _bytes(sqlite: bool) -> Callable[..., None]:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        folder = _copied(case, corpus.sqlite_bag if sqlite else corpus.bag)
        place = _storage(folder)
        data = place.read_bytes()
        action = rng.randrange(6)
        differs = False
        if action <= 1:
            data = flip(rng, data, rng.choice((1, 5, 100)))
        elif action == 2:
            data = data[: rng.randrange(len(data))]
        elif action == 3:
            at = rng.randrange(len(data))
            data = data[:at] + bytes(rng.choice((16, 4096))) + data[at + 16 :]
        elif action == 4:
            data = rng.choice((b"", b"\0" * 100, b"SQLite format 3\0", data + data))
            differs = len(data) < 200
        else:
            data = flip(rng, data, 20, 0, 200)
        place.write_bytes(data)
        if rng.random() < 0.3:
            (folder / "metadata.yaml").unlink()
        single = f"hostile/{place.name}" if rng.random() < 0.3 else ""
        _ask(rng, case, single=single, differs=differs)

    return attack


def _records(rng: Random, case: Case, corpus: Corpus) -> None:
    folder = _copied(case, corpus.bag)
    place = _storage(folder)
    parts = mcap_parts.take_apart(place.read_bytes())
    action = rng.randrange(7)
    chunks = [part for part in parts if part.opcode == Opcode.CHUNK]
    if action == 0 and chunks:
        chunk = rng.choice(chunks).record
        assert isinstance(chunk, records.Chunk)
        chunk.uncompressed_size = hostile.number(rng)
        rng.choice(chunks).record = chunk
    elif action == 1:
        part = rng.choice([part for part in parts if part.opcode == Opcode.SCHEMA])
        schema = part.record
        assert isinstance(schema, records.Schema)
        types = {f"p/T{i}": f"p/T{i + 1}[64] a\np/T{i + 1}[64] b\n" for i in range(12)}
        line = "=" * 80
        text = "p/T0 x\n" + "".join(f"{line}\nMSG: {n}\n{t}" for n, t in types.items())
        schema.data = (text + f"{line}\nMSG: p/T12\nuint8 x\n").encode()
        part.record = schema
    elif action == 2:
        for part in parts:
            if part.opcode == Opcode.CHANNEL and rng.random() < 0.7:
                channel = part.record
                assert isinstance(channel, records.Channel)
                channel.topic = rng.choice(hostile.texts(case.canary))
                channel.metadata["offered_qos_profiles"] = rng.choice(hostile.texts(case.canary))
                part.record = channel
    elif action == 3 and chunks:
        part = rng.choice(chunks)
        rows = list(mcap_parts.inner(mcap_parts.chunk_data(part)))
        at = rng.randrange(len(rows))
        rows[at] = (rows[at][0], hostile.number(rng, 16).to_bytes(2, "little") + rows[at][1][2:])
        mcap_parts.set_chunk_data(part, mcap_parts.joined(rows))
    elif action == 4:
        parts.pop(rng.randrange(1, len(parts)))
    elif action == 5:
        rng.choice(parts).length = hostile.number(rng)
    else:
        parts = [p for p in parts if p.opcode not in (Opcode.CHUNK_INDEX, Opcode.STATISTICS)]
    place.write_bytes(mcap_parts.put_together(parts, repair=rng.random() < 0.8))
    _ask(rng, case)


def _sql(rng: Random, case: Case, corpus: Corpus) -> None:
    folder = _copied(case, corpus.sqlite_bag)
    place = _storage(folder)
    text = rng.choice(hostile.texts(case.canary)).replace("\0", "")
    number = hostile.number(rng, 63)
    statements = rng.choice(
        (
            ["UPDATE topics SET type = :t"],
            ["UPDATE topics SET name = :t"],
            ["UPDATE topics SET offered_qos_profiles = :t"],
            ["UPDATE topics SET serialization_format = :t"],
            ["UPDATE topics SET id = id + 1"],
            ["UPDATE messages SET topic_id = :n"],
            ["UPDATE messages SET timestamp = :n"],
            ["UPDATE messages SET timestamp = -timestamp"],
            ["UPDATE messages SET timestamp = :t WHERE id % 3 = 0"],
            ["UPDATE messages SET data = NULL WHERE id % 3 = 0"],
            ["UPDATE messages SET data = :t WHERE id % 3 = 0"],
            ["UPDATE messages SET data = zeroblob(200000000) WHERE id = 1"],
            ["DROP TABLE topics"],
            ["DROP TABLE messages"],
            ["DELETE FROM topics"],
            ["DROP TABLE IF EXISTS message_definitions"],
            ["DROP TABLE IF EXISTS schema"],
            [
                "ALTER TABLE messages RENAME TO m",
                "CREATE VIEW messages AS WITH RECURSIVE c(id, topic_id, timestamp, data) AS ("
                "SELECT 1, 1, 1, x'00' UNION ALL SELECT id + 1, 1, id, x'00' FROM c) SELECT * "
                "FROM c",
            ],
            [
                "ALTER TABLE topics RENAME TO t",
                "CREATE VIEW topics AS SELECT t.* FROM t, t AS u, t AS v, t AS w, t AS x, t AS y",
            ],
            ["CREATE TRIGGER x AFTER UPDATE ON topics BEGIN DELETE FROM messages; END"],
        )
    )
    with contextlib.closing(sqlite3.connect(place)) as database:
        with contextlib.suppress(sqlite3.Error, OverflowError):
            for statement in statements:
                database.execute(statement, {"t": text, "n": number} if ":" in statement else {})
        database.commit()
    _ask(rng, case)


def _metadata(rng: Random, case: Case, corpus: Corpus) -> None:
    folder = _copied(case, rng.choice((corpus.bag, corpus.sqlite_bag)))
    place = folder / "metadata.yaml"
    text = place.read_text()
    storage = _storage(folder).name
    action = rng.randrange(8)
    if action == 0:
        outside = rng.choice(
            (
                "../original/" + storage,
                "/etc/passwd",
                "/dev/zero",
                "../../../../etc/shadow",
                "pipe",
                ".",
                "",
            )
        )
        if outside == "pipe":
            os.mkfifo(folder / "pipe")
        text = text.replace(storage, outside)
    elif action == 1:
        lines = text.splitlines()
        at = rng.choice([i for i, line in enumerate(lines) if ":" in line])
        key, _, _ = lines[at].partition(":")
        value = rng.choice(
            (str(hostile.number(rng)), "-1", "x", "[]", "{}", "null", "9" * 5000, ".nan")
        )
        lines[at] = f"{key}: {value}"
        text = "\n".join(lines)
    elif action == 2:
        lines = text.splitlines()
        lines.pop(rng.randrange(len(lines)))
        text = "\n".join(lines)
    elif action == 3:
        text = rng.choice(
            ("", "[" * 50_000, "\0", "x: *y", "- " * 20_000, "rosbag2_bagfile_information:")
        )
    elif action == 4:
        laughs = "".join(f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 9)}]\n" for i in range(1, 9))
        text = "x0: &x0 [lol]\n" + laughs + text
    elif action == 5:
        text = text.replace("/ticks", "\x1b]0;owned\x07").replace("ticks", "a\nb")
    elif action == 6:
        text = text[: rng.randrange(len(text))]
    else:
        text = "# " + "x" * 5_000_000 + "\n" + text
    place.write_text(text)
    _ask(rng, case)


def _strange_places(rng: Random, case: Case, corpus: Corpus) -> None:
    """What is given as a bag and is none: pipes, devices, a trace, a folder of nothing."""
    folder = _copied(case, corpus.bag)
    place = _storage(folder)
    kind = rng.randrange(6)
    single = ""
    if kind == 0:
        place.unlink()
    elif kind == 1:
        place.unlink()
        os.mkfifo(place)
    elif kind == 2:
        place.unlink()
        place.symlink_to("/dev/zero")
    elif kind == 3:
        single = "hostile.mcap"
        (case.folder / single).write_bytes(corpus.robot)
        shutil.rmtree(folder)
        (case.folder / "hostile").write_bytes(corpus.robot)
    elif kind == 4:
        place.unlink()
        place.mkdir()
    else:
        shutil.rmtree(folder)
        folder.mkdir()
    _ask(rng, case, single=single, differs=kind != 3)


FAMILY = Family(
    "bags",
    {
        "bytes": _bytes(sqlite=False),
        "sqlite-bytes": _bytes(sqlite=True),
        "records": _records,
        "sql": _sql,
        "metadata": _metadata,
        "strange-places": _strange_places,
    },
    ros=True,
)
