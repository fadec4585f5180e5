"""A page for the browser as its tags, texts and tables; and traces whose names are markup."""

from __future__ import annotations

import base64
import hashlib
import re
from html.parser import HTMLParser

from mcap import records
from mcap.opcode import Opcode

from campaigns.attack import mcap_parts
from campaigns.attack.families.texts import with_strings
from tests.viewer.raw_trace import Event
from tests.viewer.shown_rows import DELTA, Row, check_both_runs, is_one_of

VOID = frozenset(("meta", "br", "img", "link"))
MARKUP = """</td></pre><script>alert(1)</script><img src=x onerror="alert(1)">'&{{7*7}}"""


class Page(HTMLParser):
    """The tags of a page with their attributes, its text, and the cells of its tables."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.text = ""
        self.rows: list[list[str]] = []
        self.classes: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self._open.append(tag)
        if tag == "tr":
            self.rows.append([])
            self.classes.append(dict(attrs).get("class") or "")
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data
        if self._open[-1:] and "tr" in self._open and self.rows[-1]:
            self.rows[-1][-1] += data


def contained(text: str) -> None:
    """Check that a page is small, loads nothing and runs nothing but its own script."""
    page = Page(text)
    assert len(text) < 1_000_000
    names = {name for name, _ in page.attributes}
    assert not names & {"src", "href", "style", "srcset", "action"}
    assert not [name for name in names if name.startswith("on")]
    assert [page.tags.count(tag) for tag in ("script", "style", "img", "link")] == [1, 1, 0, 0]
    policy = next(value or "" for name, value in page.attributes if name == "content")
    assert policy.startswith("default-src 'none'; ")
    for tag in ("script", "style"):
        (own,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.S)
        assert not re.search(r"url\(|@import|https?:|fetch|XMLHttp", own)
        digest = base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}';" in policy


_OWN = re.compile("/rosout$|/parameter_events$|/rsltrace/(?!request/|response/)")


def with_names(parts: list[mcap_parts.Part], extra: str) -> None:
    """Put ``extra`` behind every name, of topics too, and the texts of the metadata. Topics that
    every node has keep theirs."""

    def renamed(nth: int, text: bytes) -> bytes:
        return (
            text + extra.encode() if text and nth == 0 and not _OWN.match(text.decode()) else text
        )

    for part in parts:
        record = part.record if part.opcode == Opcode.METADATA else None
        if isinstance(record, records.Metadata) and not record.name.startswith("rosbag2"):
            kept = ("digest", "version", "resolved", "checksum")
            record.metadata = {
                key: text if key in kept else text + extra for key, text in record.metadata.items()
            }
            part.record = record
        channel = part.record if part.opcode == Opcode.CHANNEL else None
        if isinstance(channel, records.Channel) and not _OWN.match(channel.topic):
            channel.topic += extra
            part.record = channel
    for topic in ("/rsltrace/entities", "/rsltrace/findings", "/rsltrace/code_lines"):
        mcap_parts.change_messages(
            parts,
            topic,
            lambda data, nth, topic=topic: with_strings(data, topic, renamed),
        )


def aligned_rows(page: Page) -> list[Row]:
    """Return the aligned rows of the page of a comparison."""
    found = []
    for sign, a, b, time, node, _, entity, did in [r for r in page.rows if len(r) == 8][1:]:
        later = DELTA.match(did)
        delta, text = (later[0].strip(), did[later.end() :]) if later else ("", did.strip())
        found.append(Row.of(sign, (a, b), time, text, node=node, entity=entity, delta=delta))
    return found


def check_page(text: str, a: list[Event], b: list[Event]) -> list[Row]:
    """Check that a page is small and says what two traces say; return its rows."""
    contained(text)
    page = Page(text)
    rows = aligned_rows(page)
    check_both_runs(rows, a, b)
    kinds = [kind for kind, row in zip(page.classes, page.rows, strict=True) if len(row) == 8]
    here = [row for row, kind in zip(rows, kinds[1:], strict=True) if "here" in kind]
    for path, change, _ in [row for row in page.rows if len(row) == 3]:
        old, arrow, new = change.partition(" → ")
        for side, shown in enumerate((old, new)) if arrow else ():
            numbers = [row.numbers[side] for row in here]
            events = [(a, b)[side][number] for number in numbers if number is not None]
            values = [value for event in events for value in field_values(path, event)]
            assert not values or is_one_of(shown, values), (path, change, values)
    check_picture(text, rows)
    return rows


def field_values(path: str, event: Event) -> list[str]:
    """Return the values of a field of an event's messages, of an array as the page shows it."""
    leaves = [leaf for message in event.messages for leaf in message.leaves or ()]
    values = [value for name, value in leaves if name == path]
    items = [value for name, value in leaves if re.fullmatch(rf"{re.escape(path)}\[\d+\]", name)]
    if items:
        few = f"[{', '.join(items[:4])}, … {len(items)} in all]"
        values += [f"[{', '.join(items)}]", few]
    counts = [re.match(r"\[(\d+) item", value) for value in values]
    return [*values, *(f"{count[1]} items" for count in counts if count)]


def check_picture(text: str, rows: list[Row]) -> None:
    """Check that the lanes show the events of the rows from left to right."""
    cells = re.findall(r'<g class="cell [^"]*"><title>(.*?)</title><rect [^>]*?x="(\d+)"', text)
    places: dict[int, list[str]] = {}
    for title, x in cells:
        places.setdefault(int(x), []).append(title)
    shown = [row for row in rows if row.node in [*dict.fromkeys(row.node for row in rows)][:12]]
    assert len(places) == len(shown)
    for (_, titles), row in zip(sorted(places.items()), shown, strict=True):
        numbers = [
            f"{side} {n}" for side, n in zip("ab", row.numbers, strict=True) if n is not None
        ]
        assert len(titles) == len(numbers)
        assert all(one.startswith(f"{row.sign} {' / '.join(numbers)}  ") for one in titles)
