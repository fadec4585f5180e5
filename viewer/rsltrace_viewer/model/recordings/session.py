"""What is open of one or two recordings, and where one is in it; no screen is needed for that."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.diff.bags.comparison import diff_bags
from rsltrace.diff.result.bags import BagDiff
from rsltrace.errors import RsltraceError
from rsltrace.model.printable import printable
from rsltrace.model.stamp import format_duration, format_seconds
from rsltrace.trace.decode import to_plain
from rsltrace_viewer.model.inspector.lines import Line, Openness, Role
from rsltrace_viewer.model.inspector.message_tree import message_lines
from rsltrace_viewer.model.recordings.pairs import Pairs
from rsltrace_viewer.model.recordings.recording import Recording, Topic
from rsltrace_viewer.model.timeline.message_values import differing_values, message_values
from rsltrace_viewer.model.view import Sign

_PREVIEW_BYTES = 1 << 16
Key = tuple[str, str]
"""A topic by its name and type."""


class RecordingSession:
    """One recording, or two. ``row`` is the selected message of the selected topic."""

    def __init__(self, a: Recording, b: Recording | None = None) -> None:
        self.recordings = [a] if b is None else [a, b]
        self.keys: list[Key] = []
        self._by_key: list[dict[Key, Topic]] = []
        for recording in self.recordings:
            topics = {(topic.name, topic.type): topic for topic in recording.topics}
            self._by_key.append(topics)
            self.keys += [key for key in topics if key not in self.keys]
        self.place = 0
        self.row = 0
        self.openness = Openness()
        self.diff: BagDiff | None = None
        self.damage = ""
        self._pairs: dict[tuple[Key, int], Pairs] = {}

    @property
    def two(self) -> bool:
        """Whether there are two."""
        return len(self.recordings) > 1

    def read(self) -> Iterator[int]:
        """Read the recordings, and compare them. Damage ends it, and ``damage`` says where."""
        try:
            for recording in self.recordings:
                yield from recording.read()
            if self.two:
                a, b = self.recordings
                self.diff = diff_bags(a.path, b.path)
        except RsltraceError as error:
            self.damage = printable(str(error))
        yield sum(recording.count for recording in self.recordings)

    @property
    def done(self) -> bool:
        """Whether all is read, or cannot be."""
        return bool(self.damage) or all(recording.done for recording in self.recordings)

    def topics(self, key: Key) -> list[Topic | None]:
        """Return a topic in each recording."""
        return [topics.get(key) for topics in self._by_key]

    @property
    def pairs(self) -> Pairs:
        """The rows of the selected topic, as far as they are known."""
        if not self.keys:
            return Pairs(None, None)
        key = self.keys[self.place]
        found = self.topics(key)
        known = sum(len(topic.stamps) for topic in found if topic is not None)
        if (key, known) not in self._pairs:
            self._pairs = {
                (key, known): Pairs(found[0], found[1] if self.two else None)
                if self.done or not self.two
                else Pairs(None, None)
            }
        return self._pairs[key, known]

    # Rows, in words.

    def topic_text(self, place: int) -> tuple[str, str, list[str], bool]:
        """Return name, type, (count and rate) in each recording, and whether these differ."""
        name, type_name = self.keys[place]
        topics = self.topics((name, type_name))
        texts = []
        for topic in topics:
            if topic is None:
                texts.append("-")
                continue
            rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.4g} Hz"
            texts.append(f"{len(topic.stamps):,}  {rate:>8}")
        counts = {len(topic.stamps) if topic is not None else -1 for topic in topics}
        differ = self.done and len(counts) > 1
        if self.diff is not None:
            differ = differ or any(t.topic == name and t.diverged for t in self.diff.topics)
        return printable(name), printable(type_name), texts, differ

    def message_text(self, row: int) -> tuple[str, Sign | None, list[str]]:
        """Return the time of a row, how it compares, and the values in each recording."""
        pairs, topics = self.pairs, self.topics(self.keys[self.place])
        places = pairs.at(row)
        time, texts = "", []
        for recording, topic, place in zip(self.recordings, topics, places, strict=False):
            if topic is None or place is None:
                texts.append("")
                continue
            if not time:
                time = format_seconds(topic.stamps[place] - recording.start_ns)[:-3]
            texts.append(_preview(recording, topic, place))
        if not self.two:
            return time, None, texts
        sign = pairs.sign(row)
        if sign is Sign.DIFFERS:
            told = self._differing(topics, places)
            if told == ("", ""):  # nothing but padding, which recorders do not write
                sign = Sign.MATCH
            elif told is not None:
                texts = list(told)
        return time, sign, texts

    def _differing(
        self, topics: list[Topic | None], places: tuple[int | None, ...]
    ) -> tuple[str, str] | None:
        """Return the values in which two messages differ; None where nobody can say."""
        decoded = []
        for recording, topic, place in zip(self.recordings, topics, places, strict=True):
            data = None if topic is None or place is None else topic.data[place]
            if topic is None or data is None or len(data) > _PREVIEW_BYTES:
                return None
            try:
                decoded.append(recording.decode(topic, data))
            except RsltraceError:
                return None
        told = differing_values(*decoded)
        if told == ("", "") and repr(to_plain(decoded[0])) != repr(to_plain(decoded[1])):
            return None
        return told

    def lines(self) -> Iterator[list[Line]]:
        """Yield the lines of the selected message, the last time all of them."""
        lines: list[Line] = []
        pairs = self.pairs
        if not pairs.count:
            yield [Line(0, "", "no messages" if self.done else "reading …", Role.NOTE, "none")]
            return
        key = self.keys[self.place]
        places = pairs.at(min(self.row, pairs.count - 1))
        for number, (recording, topic) in enumerate(
            zip(self.recordings, self.topics(key), strict=True)
        ):
            name = "ab"[number] if self.two else ""
            place = places[number]
            if topic is None or place is None:
                if self.two:
                    lines.append(Line(0, name, "has no such message", Role.NOTE, f"{name}.none"))
                continue
            since = format_duration(topic.stamps[place] - recording.start_ns)
            at = f"{since} after the start, {format_seconds(topic.stamps[place])} s"
            head = f"message {place}" if not name else f"{name}  message {place}"
            is_open = self.openness.is_open(f"run{name}", True)
            lines.append(Line(0, head, at, Role.SECTION, f"run{name}", is_open))
            if not is_open:
                continue
            try:
                for message in recording.message(topic, place):
                    if message is not None:
                        lines += message_lines(message, f"in{name}", 1, self.openness)
            except RsltraceError as error:
                lines.append(Line(1, "", printable(str(error)), Role.ERROR, f"{name}.error"))
            yield lines
        yield lines

    # Words about all of it.

    def title(self) -> str:
        """Return the names of what is open."""
        return " ↔ ".join(recording.name for recording in self.recordings)

    def mode(self) -> str:
        """Return what is shown."""
        return "two recordings" if self.two else "one recording"

    def facts(self) -> str:
        """Return a line of facts."""
        counts = " and ".join(f"{recording.count:,}" for recording in self.recordings)
        parts = [f"{counts} messages", f"{len(self.keys)} topics"]
        if self.done:
            first = self.recordings[0]
            parts.append(format_duration(first.end_ns - first.start_ns))
        else:
            parts.insert(0, "reading …")
        if any(recording.notes for recording in self.recordings):
            parts.insert(0, "incomplete")
        return "  ".join([*parts, self.recordings[0].kind])

    def verdict(self) -> tuple[str, bool]:
        """Return how two recordings compare, and whether they differ."""
        if self.damage:
            return self.damage, True
        if not self.two:
            notes = [note for recording in self.recordings for note in recording.notes]
            return (notes[0] if notes else ""), bool(notes)
        if self.diff is None:
            return "comparing …", False
        same = self.diff.identical
        return f"{'=' if same else '≠'} {self.diff.sentence}", not same

    def go_to_difference(self) -> None:
        """Select the first message that differs."""
        if self.diff is None or self.diff.first is None:
            return
        first = self.diff.first
        for place, (name, _) in enumerate(self.keys):
            if name == first.topic:
                self.place = place
                self.row = self.pairs.next_difference(-1, 1) or 0
                return


def _preview(recording: Recording, topic: Topic, place: int) -> str:
    data = topic.data[place]
    if data is None or len(data) > _PREVIEW_BYTES:
        return "(not kept in memory)" if data is None else f"({len(data) / 1e6:.1f} MB)"
    try:
        return message_values(recording.decode(topic, data))
    except RsltraceError as error:
        return printable(str(error))
