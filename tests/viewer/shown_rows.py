"""Rows of two runs as a screen or a page shows them, and whether they say what the traces say."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from tests.viewer.raw_trace import Event, Message

_TURNS = {"x": "ωx", "y": "ωy", "z": "ω"}
_UNITS_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
_VALUE = r'"[^"]*"|\[[^\]…]*\]|[^\s,…"\[\]]+'
DELTA = re.compile(r"([+-][\d.e+]+) (ns|us|ms|s)\b\s*")
_MARK = re.compile(r"([↓↑]) ([ab]) (\d+)(?: |$)")
_SIDE = re.compile(r"(?:^| \| )([ab]): ")
_CHANGE = re.compile(rf"(?:(?<=\s)|^)(?:([^\s,:]*) )?({_VALUE}) → ({_VALUE})(?=[\s,]|$)")
_FIELD = re.compile(rf"(?:(?<=\s)|^)([\w.]+)=({_VALUE})(?=[\s,]|$)")
_SINGLE = re.compile(r"(?:^|, )(/\S+) (-?\d[\d.e+-]*)(?=,|$| ×)")
NUMBER = re.compile(r"-?(inf|nan|\d+(\.\d*)?(e[-+]?\d+)?)")


@dataclass
class Row:
    """A row of the list of events. ``text`` is what it did."""

    sign: str
    numbers: tuple[int | None, ...]
    time_ns: int
    text: str
    unit_ns: int = 1
    """The digits of the time that there is room for."""
    node: str = ""
    entity: str = ""
    delta: str = ""

    @classmethod
    def of(cls, sign: str, numbers: Sequence[str], time: str, text: str, **cells: str) -> Row:
        """Return a row from the texts of its cells."""
        seconds, _, part = time.partition(".")
        assert len(part) in (6, 9), time
        unit_ns = 10 ** (9 - len(part))
        time_ns = int(seconds) * 10**9 + int(part) * unit_ns
        indexes = tuple(int(number) if number else None for number in numbers)
        return cls(sign, indexes, time_ns, text, unit_ns, **cells)

    def is_at(self, stamp_ns: int) -> bool:
        return self.time_ns == stamp_ns - stamp_ns % self.unit_ns

    @property
    def moved(self) -> re.Match[str] | None:
        """What points to the other place of an event that moved."""
        return _MARK.match(self.text)


def rows_on(screen: str) -> list[Row]:
    """Return what the lines of the list say, by the places of its headings."""
    lines = screen.splitlines()
    top = next(n for n, line in enumerate(lines) if "what it did" in line)
    head = lines[top]
    what = head.index("what it did")
    two = re.match(r" +a +b +time", head) is not None
    ends = [head.index(" a ") + 2, head.index(" b ") + 2] if two else [head.index("event") + 5]
    delta = head.find("b − a") - 3  # it stands right in eight cells

    def cell(line: str, title: str) -> str:
        start = head.find(f" {title} ") + 1
        end = next((n for n in range(start + len(title), what) if head[n] != " "), what)
        return line[start:end].strip() if start else ""

    found = []
    for line in lines[top + 1 :]:
        if not re.match(r"[>←→ ][=≠~+?-] ", line) or line.startswith(" ? help"):
            break
        starts = [4, *ends[:-1]]
        numbers = [line[start:end].strip() for start, end in zip(starts, ends, strict=True)]
        text = re.sub(r" +[▁▂▃▄▅▆▇█]?$", "", line[what:].partition("│")[0].rstrip())
        if two and delta < 0 and (early := DELTA.match(text)):
            later, text = early[0].strip(), text[early.end() :]
        else:
            later = line[delta : delta + 8].strip() if two and delta >= 0 else ""
        found.append(
            Row.of(
                line[1],
                numbers,
                line[ends[-1] :].split()[0],
                text,
                node=cell(line, "node"),
                entity=cell(line, "entity"),
                delta=later,
            )
        )
    return found


def check_one_run(rows: list[Row], own: list[Event]) -> int:
    """Check the list of one run; return how many values were compared."""
    assert [row.numbers for row in rows] == [(event.index,) for event in own]
    for row, event in zip(rows, own, strict=True):
        assert row.is_at(event.stamp_ns), (row, event)
        check_names(row, event)
        assert " → " not in row.text or "→" in "".join(event.values), row
        assert "only in" not in row.text
    return sum(check_values(row.text, event) for row, event in zip(rows, own, strict=True))


def check_both_runs(rows: list[Row], a: list[Event], b: list[Event]) -> Counter[str]:
    """Check rows that follow each other in the list of two runs; return how many rows of which
    kind there were, and how many values were compared."""
    counts: Counter[str] = Counter()
    at: list[dict[int | None, int]] = [{}, {}]
    for side in (0, 1):
        shown = [row.numbers[side] for row in rows if row.numbers[side] is not None]
        first = shown[0] if shown else 0
        assert shown == [*range(first or 0, (first or 0) + len(shown))]
        at[side] = {row.numbers[side]: place for place, row in enumerate(rows)}
    for place, row in enumerate(rows):
        i, j = row.numbers
        event = a[i] if i is not None else b[j or 0]
        assert row.is_at(event.stamp_ns), (row, event)
        check_names(row, event)
        text, moved = row.text, row.moved
        if moved:
            counts["moved"] += 1
            text = text[moved.end() :]
            side, other = "ab".index(moved[2]), int(moved[3])
            own = row.numbers[1 - side]
            assert own is not None, row
            assert row.numbers[side] is None, row
            there = at[side].get(other)
            if there is not None:
                assert (there > place) == (moved[1] == "↓"), row
                back = rows[there].moved
                assert back is not None, rows[there]
                assert (back[2], int(back[3])) == ("ba"[side], own), (row, rows[there])
                assert back[1] != moved[1], (row, rows[there])
            else:  # it stands beyond what is shown
                shown = [n for n in at[side] if n is not None]
                assert not shown or (other > max(shown)) == (moved[1] == "↓"), row
            i, j = (own, other) if side else (other, own)
        elif row.sign in "-+":
            counts["only"] += 1
            name = "a" if row.sign == "-" else "b"
            assert text.startswith(f"only in {name}"), row
            assert row.numbers["-+".index(row.sign)] is not None, row
            assert row.numbers["+-".index(row.sign)] is None, row
            counts["values"] += check_values(text.removeprefix(f"only in {name}: "), event)
            continue
        assert i is not None, row
        assert j is not None, row
        check_delta(row, b[j].stamp_ns - a[i].stamp_ns)
        if row.sign == "≠":
            counts["differs"] += 1
            counts["values"] += check_difference(text, a[i], b[j])
            continue
        counts["same"] += 1
        assert same_messages(a[i], b[j]), (row, a[i], b[j])
        assert a[i].stamp_ns == b[j].stamp_ns or row.sign == "~", row
        counts["values"] += check_values(text, event)
    return counts


def same_messages(x: Event, y: Event) -> bool:
    """Whether all messages that two events have in their files are the same ones."""
    pairs = [*zip(x.outputs, y.outputs, strict=True)]
    pairs += [(x.input, y.input)] if x.input is not None and y.input is not None else []
    return all(
        one.leaves is None or other.leaves is None or _told(one) == _told(other)
        for one, other in pairs
    )


def _told(message: Message) -> str:
    """Return what is compared of a message: of a log record not when and where."""
    kept = {"level", "name", "msg"} if message.name == "/rosout" else None
    return repr([leaf for leaf in message.leaves or () if kept is None or leaf[0] in kept])


def check_names(row: Row, event: Event) -> None:
    """Check the names of the node and of what ran, of which a part may be left out."""
    for shown, name in ((row.node, event.node), (row.entity, event.entity)):
        assert not name or all(part in name for part in shown.split("…")), (row, event)


def check_delta(row: Row, later_ns: int) -> None:
    """Check how much later an event happened in b."""
    shown = DELTA.fullmatch(row.delta)
    assert shown is None or later_ns, (row, later_ns)
    assert shown is not None or not later_ns or row.unit_ns > 1, (row, later_ns)
    if shown is not None:
        difference = abs(float(shown[1]) * _UNITS_NS[shown[2]] - later_ns)
        assert difference <= abs(later_ns) * 0.005 + 0.5, (row, later_ns)


def check_difference(text: str, x: Event, y: Event) -> int:
    """Check what a row says of two events that differ; return how many values were compared."""
    sides = [*_SIDE.finditer(text)]
    if sides and sides[0].start() == 0:
        ends = [*(side.start() for side in sides[1:]), len(text)]
        return sum(
            check_values(text[side.end() : end], y if side[1] == "b" else x)
            for side, end in zip(sides, ends, strict=True)
        )
    compared = 0
    for one in _CHANGE.finditer(text):
        name, old, new = one.groups()
        if re.search(r"\bdraw\b[^,]*$", text[: one.start(2)]):
            continue  # what was drawn is no message
        assert old != new, text
        topic = _topic_before(text, one.start(2), x, y)
        olds, news = (candidates(name or "", event, topic) for event in (x, y))
        if "absent" in (old, new):  # an array is shorter in one run
            there, shown = (olds, old) if new == "absent" else (news, new)
            assert not (news if new == "absent" else olds), (text, x, y)
            assert not NUMBER.fullmatch(shown) or is_one_of(shown, there), (text, x, y)
        else:
            assert any(is_change((old, new), pair) for pair in product(olds, news)), (text, x, y)
        compared += 2
    return compared


def check_values(text: str, event: Event) -> int:
    """Check the values that a row says of one event; return how many there were."""
    compared = 0
    for one in _FIELD.finditer(text):
        values = candidates(one[1], event, _topic_before(text, one.start(), event))
        assert is_one_of(one[2], values), (text, one[0], event)
        compared += 1
    for one in _SINGLE.finditer(text):
        if any(message.name == one[1] and message.leaves for message in event.messages):
            assert is_one_of(one[2], candidates("", event, one[1])), (text, one[0], event)
            compared += 1
    return compared


def _topic_before(text: str, place: int, *events: Event) -> str:
    """Return the topic that a value belongs to; "" if the row does not say."""
    names = {message.name for event in events for message in event.messages if message.leaves}
    words = [
        word for word in re.findall(r"[^\s,]+", text[:place]) if word in {*names, "got", "log"}
    ]
    return words[-1].replace("log", "/rosout").replace("got", "") if words else ""


def candidates(name: str, event: Event, topic: str) -> list[str]:
    """Return the values of the fields of an event that a row may call by a name."""
    return [
        value
        for message in (event.messages if topic != "got" else [event.input])
        if message is not None and topic in ("", "got", message.name)
        for path, value in message.leaves or ()
        if name in ("", message.name, "log", "got") or name in names_of(path)
    ]


def names_of(path: str) -> set[str]:
    """Return what rows call a field."""
    parts = path.split(".")
    turned = _TURNS.get(parts[-1], parts[-1]) if "angular" in parts else parts[-1]
    last = turned.rstrip("_")
    names = {path, last, ".".join([*parts[-2:-1], last])}
    if letter := {"linear": "v", "linear_acceleration": "a"}.get("".join(parts[-2:-1])):
        names.add(letter + last)
    return names | {re.sub(r"\[\d+\]", "", one) for one in names} | {re.sub(r"^[^\[]*", "", path)}


def is_change(shown: tuple[str, str], values: tuple[str, str]) -> bool:
    """Whether two texts are two values that differ, and do not look much further apart."""
    if not all(is_value(*one) for one in zip(shown, values, strict=True)):
        return False
    if not all(map(NUMBER.fullmatch, (*shown, *values))):
        return values[0] != values[1]
    differences = [abs(float(old) - float(new)) for old, new in (shown, values)]
    return not differences[0] > 10 * differences[1]


def is_one_of(text: str, values: list[str]) -> bool:
    """Whether a text is one of some values, or a short list of them."""
    items = text.strip("[]").split() if text.startswith("[") else [text]
    return text in values or all(any(is_value(item, one) for one in values) for item in items)


def is_value(text: str, value: str) -> bool:
    """Whether a text is a value, as far as its digits or letters go."""
    if not NUMBER.fullmatch(text):
        inner = text.strip('"')
        return inner == value or (bool(inner.strip("…")) and inner.strip("…") in value)
    if text == value or not NUMBER.fullmatch(value):
        return text == value
    digits = len(re.sub(r"e.*|[-.]", "", text).lstrip("0"))
    return float(f"{float(value):.{max(digits, 4)}g}") == float(text)
