"""Traces with hostile names and texts: everything that is printed may come from anybody."""

from __future__ import annotations

import struct
from collections.abc import Callable
from random import Random

from mcap import records
from mcap.opcode import Opcode

from campaigns.attack import hostile, mcap_parts
from campaigns.attack.corpus import Corpus
from campaigns.attack.families.common import Family
from campaigns.attack.families.trace_case import HOSTILE, attack_trace
from campaigns.attack.mcap_parts import Part
from campaigns.attack.model import Case

_STRINGS = {
    "/rsltrace/entities": (9, 3),
    "/rsltrace/details": (12, 1),
    "/rsltrace/findings": (12, 6),
    "/rsltrace/states": (12, 1),
    "/rsltrace/code_lines": (16, 2),
    "/rosout": (9, 4),
}
"""Where the strings of these messages begin after the CDR header, and how many there are."""


def with_strings(data: bytes, topic: str, change: Callable[[int, bytes], bytes]) -> bytes:
    """Return a message whose strings are ``change(nth, string)``."""
    start, count = _STRINGS[topic]
    at = 4 + start
    made = data[:at]
    for nth in range(count):
        at += -(at - 4) % 4
        made += bytes(-(len(made) - 4) % 4)
        (length,) = struct.unpack_from("<I", data, at)
        text = change(nth, data[at + 4 : at + 3 + length])
        made += struct.pack("<I", len(text) + 1) + text + b"\0"
        at += 4 + length
    if topic == "/rosout":
        made += bytes(-(len(made) - 4) % 4) + data[-4:]
    return made


def _text(rng: Random, case: Case) -> bytes:
    if rng.random() < 0.1:
        return rng.choice((b"\xff\xfe\x1b[31m", b"\xed\xa0\x80", b"\xc0\x80", b"\x80" * 100))
    return rng.choice(hostile.texts(case.canary)).encode("utf-8", "surrogatepass")


def _messages(topic: str, fields: tuple[int, ...], *, rehash: bool = False) -> Callable[..., None]:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        data = rng.choice(corpus.traces)
        parts = mcap_parts.take_apart(data)
        chosen = {rng.choice(fields)} if rng.random() < 0.7 else set(fields)
        text = _text(rng, case)
        mixed = rng.random() < 0.5

        def one(message: bytes, nth: int) -> bytes:
            new = _text(rng, case) if mixed else text
            return with_strings(message, topic, lambda n, old: new if n in chosen else old)

        mcap_parts.change_messages(parts, topic, one)
        if rehash:
            mcap_parts.rehash(parts)
        attack_trace(case, rng, mcap_parts.put_together(parts), data)

    return attack


def _records(change: Callable[[Random, Case, Part], None]) -> Callable[..., None]:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        data = rng.choice(corpus.traces)
        parts = mcap_parts.take_apart(data)
        for part in parts:
            change(rng, case, part)
        attack_trace(case, rng, mcap_parts.put_together(parts), data)

    return attack


def _string(rng: Random, case: Case) -> str:
    return rng.choice(hostile.texts(case.canary))


def _topics(rng: Random, case: Case, part: Part) -> None:
    record = part.record if part.opcode == Opcode.CHANNEL else None
    if isinstance(record, records.Channel) and not record.topic.startswith("/rsltrace/"):
        record.topic = _string(rng, case)
        part.record = record


def _topics_that_do_not_decode(rng: Random, case: Case, part: Part) -> None:
    """The error that names the topic must not print it raw."""
    _topics(rng, case, part)
    record = part.record if part.opcode == Opcode.SCHEMA else None
    if isinstance(record, records.Schema) and not record.name.startswith("rsltrace_msgs"):
        record.data = rng.choice((b"nowhere/Type \x1b]0;owned\x07\n", b"string s\n" * 50))
        if rng.random() < 0.5:
            record.name = _string(rng, case)
        part.record = record


def _schema_names(rng: Random, case: Case, part: Part) -> None:
    record = part.record if part.opcode == Opcode.SCHEMA else None
    if isinstance(record, records.Schema):
        if rng.random() < 0.5:
            record.name = _string(rng, case)
        if rng.random() < 0.2:
            record.encoding = _string(rng, case)
        part.record = record


def _metadata(rng: Random, case: Case, part: Part) -> None:
    record = part.record if part.opcode == Opcode.METADATA else None
    if isinstance(record, records.Metadata) and record.name != "rsltrace:format":
        for key in list(record.metadata):
            if rng.random() < 0.5:
                record.metadata[key] = _string(rng, case)
        record.metadata[_string(rng, case)] = _string(rng, case)
        if rng.random() < 0.1:
            record.name = _string(rng, case)
        part.record = record


def _format(rng: Random, case: Case, part: Part) -> None:
    if part.opcode == Opcode.HEADER:
        part.record = records.Header(library=_string(rng, case), profile="ros2")
    record = part.record if part.opcode == Opcode.METADATA else None
    if isinstance(record, records.Metadata) and record.name == "rsltrace:format":
        record.metadata["version"] = rng.choice((_string(rng, case), "1\x1b[31m", "2", "1"))
        part.record = record


def _attachments(rng: Random, case: Case, part: Part) -> None:
    record = part.record if part.opcode == Opcode.ATTACHMENT else None
    if isinstance(record, records.Attachment) and record.name != "rsltrace/segments":
        record.data = _string(rng, case).encode("utf-8", "surrogatepass") * rng.choice((1, 3))
        record.media_type = _string(rng, case)
        part.record = record


def _file_name(rng: Random, case: Case, corpus: Corpus) -> None:
    """The name of the file itself, in answers and in errors."""
    data = rng.choice(corpus.traces)
    name = rng.choice(
        ("\x1b]0;owned\x07.mcap", "a\nb.mcap", "\x9b31m.mcap", "-x.mcap", "%s é.mcap")
    )
    attack_trace(case, rng, data, data)
    hurt = rng.choice((data, data[:5000], data[:20], b""))
    (case.folder / name).write_bytes(hurt)
    given = f"./{name}"
    case.names = (*case.names, "mcap")
    for number, command in enumerate(case.commands):
        words = tuple(given if word == HOSTILE else word for word in command.words)
        case.commands[number] = type(command)(
            words, command.allowed, command.cwd, limits=command.limits
        )
    case.judge = None


FAMILY = Family(
    "texts",
    {
        "entities": _messages("/rsltrace/entities", (0, 1, 2), rehash=True),
        "entity-details": _messages("/rsltrace/entities", (2,)),
        "details": _messages("/rsltrace/details", (0,)),
        "findings": _messages("/rsltrace/findings", (0, 1, 2, 3, 4, 5)),
        "states": _messages("/rsltrace/states", (0,)),
        "code-lines": _messages("/rsltrace/code_lines", (0, 1)),
        "logs": _messages("/rosout", (0, 1, 2, 3)),
        "topics": _records(_topics),
        "topics-that-do-not-decode": _records(_topics_that_do_not_decode),
        "schema-names": _records(_schema_names),
        "metadata": _records(_metadata),
        "format": _records(_format),
        "attachments": _records(_attachments),
        "file-name": _file_name,
    },
)
