"""Traces whose message definitions are hostile: huge, endless, exploding, of types within types."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from mcap import records
from mcap.opcode import Opcode

from campaigns.attack import mcap_parts
from campaigns.attack.corpus import Corpus
from campaigns.attack.families.common import Family
from campaigns.attack.families.trace_case import attack_trace
from campaigns.attack.model import Case

_LINE = "=" * 80


def _with_types(root: str, types: dict[str, str]) -> str:
    parts = [root]
    parts += [f"{_LINE}\nMSG: {name}\n{text}" for name, text in types.items()]
    return "\n".join(parts)


def _doubling(rng: Random) -> str:
    """Each type has two (or more) of the next: 2^n fields, or none of them with any bytes."""
    depth, width = rng.choice(((20, 2), (30, 2), (60, 2), (12, 10), (200, 3)))
    last = rng.choice(("", "uint8 x\n", "string s\n", "uint8[] data\n"))
    types = {f"p/T{i}": "".join(f"p/T{i + 1} f{j}\n" for j in range(width)) for i in range(depth)}
    types[f"p/T{depth}"] = last
    return _with_types("p/T0 root\n", types)


def _arrays(rng: Random) -> str:
    """Arrays of arrays of nothing: as many elements as one likes, from no bytes at all."""
    count = rng.choice((2**16, 2**31 - 1, 2**32, 2**40, 10**5))
    depth = rng.choice((1, 2, 4, 10))
    types = {f"p/T{i}": f"p/T{i + 1}[{count}] f\n" for i in range(depth)}
    types[f"p/T{depth}"] = rng.choice(("", "uint8 x\n", "string s\n", "float64[3] v\n"))
    return _with_types("p/T0 root\n", types)


def _bounded(rng: Random) -> str:
    bound = rng.choice((0, 1, 2**32, 10**30))
    return f"string<={bound} s\nuint8[<={bound}] a\nstring<={bound}[<={bound}] b\n"


def _sequences_of_nothing(rng: Random) -> str:
    """A length field of four bytes asks for four thousand million empty elements."""
    empty = rng.choice(("", "p/E2[0] z\n", "p/E2 z\n"))
    return _with_types("p/E[] all\n", {"p/E": empty, "p/E2": ""})


def _recursive(rng: Random) -> str:
    loop = rng.choice(("p/A a\n", "p/A[] a\n", "p/B b\n"))
    return _with_types("p/A root\n", {"p/A": loop, "p/B": "p/A a\n"})


def _deep(rng: Random) -> str:
    depth = rng.choice((100, 900, 3000, 20_000))
    types = {f"p/T{i}": f"p/T{i + 1} f\n" for i in range(depth)}
    types[f"p/T{depth}"] = "uint8 x\n"
    return _with_types("p/T0 root\n", types)


def _wide(rng: Random) -> str:
    count = rng.choice((1000, 20_000, 100_000))
    return "".join(f"uint8 f{i}\n" for i in range(count))


def _huge(rng: Random) -> str:
    return rng.choice(
        ("# comment\n" * 300_000, "x" * 3_000_000, "uint8 " + "a" * 1_000_000, "\n" * 10**6)
    )


def _syntax(rng: Random) -> str:
    return rng.choice(
        (
            "",
            "\0",
            "uint8\n",
            "uint8 1x\n",
            "uint8 x=\n",
            "string S='" + "a" * 100_000 + "\n",
            "uint8 class\nuint8 def\nuint8 __init__\n",
            "uint8 x\nuint8 x\n",
            "uint8[ x\n",
            "uint8[-1] x\n",
            "uint8[0x10] x\n",
            "uint8[٣] x\n",
            "int128 x\n",
            "wstring w\nchar c\nbyte b\n",
            "nowhere/Type t\n",
            "float64 x 1e999999\n",
            "uint8 X=" + "9" * 5000 + "\n",
            "uint8[" + "9" * 5000 + "] x\n",
            "__import__('os').system('x') y\n",
            "uint8 x'); import os #\n",
            f"{_LINE}\n" * 1000,
            f"{_LINE}\nMSG: \n" * 1000,
            "\ufeffuint8 x\r\nuint8 y\r",
            "((((" * 10_000,
            'string s "' + "\\" * 100_001,
        )
    )


def _attack(make: Callable[[Random], str]) -> Callable[..., None]:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        data = rng.choice((corpus.robot, *list(corpus.samples.values())[:4]))
        parts = mcap_parts.take_apart(data)
        text = make(rng)
        own = rng.random() < 0.15  # a schema of rsltrace itself, whose layout is known anyway
        chosen = {
            part.record.id  # type: ignore[attr-defined]
            for part in parts
            if part.opcode == Opcode.SCHEMA and part.record.name.startswith("rsltrace_msgs") == own  # type: ignore[attr-defined]
        }
        if rng.random() < 0.5:
            chosen = set(rng.sample(sorted(chosen), 1))
        for part in parts:
            if part.opcode == Opcode.SCHEMA:
                record = part.record
                assert isinstance(record, records.Schema)
                if record.id in chosen:
                    record.data = text.encode("utf-8", "surrogatepass")
                    if rng.random() < 0.1:
                        record.encoding = rng.choice(("", "ros2idl", "protobuf", "omgidl"))
                    part.record = record
        _lengthen(rng, parts)
        attack_trace(case, rng, mcap_parts.put_together(parts), data)

    return attack


def _lengthen(rng: Random, parts: list[mcap_parts.Part]) -> None:
    """Give messages contents that make the most of such types: long, or with great counts."""
    tail = rng.choice(
        (b"", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x10\x00", bytes(5000))
    )
    if not tail:
        return
    for topic in mcap_parts.channel_ids(parts):
        if not topic.startswith("/rsltrace/"):
            mcap_parts.change_messages(parts, topic, lambda data, nth: data[:4] + tail)


FAMILY = Family(
    "schemas",
    {
        "doubling": _attack(_doubling),
        "arrays": _attack(_arrays),
        "bounded": _attack(_bounded),
        "sequences-of-nothing": _attack(_sequences_of_nothing),
        "recursive": _attack(_recursive),
        "deep": _attack(_deep),
        "wide": _attack(_wide),
        "huge": _attack(_huge),
        "syntax": _attack(_syntax),
    },
)
