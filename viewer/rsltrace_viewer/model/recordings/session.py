"""What is open of one or two recordings, and where one is in it; no screen is needed for that."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence

import numpy as np

from rsltrace.diff.bags.comparison import diff_bags
from rsltrace.diff.result import BagDiff
from rsltrace.diff.row_sign import RowSign
from rsltrace.errors import RsltraceError
from rsltrace.job.values.times import START, TimeInRun
from rsltrace.trace.decode import to_plain
from rsltrace.trace.model.texts import format_duration, format_seconds, printable
from rsltrace_viewer.model.inspector.message_tree import Line, Openness, Role, message_lines
from rsltrace_viewer.model.recordings.filter import Mask, TopicCondition, read_filter, steps_of
from rsltrace_viewer.model.recordings.recording import Pairs, Recording, Topic
from rsltrace_viewer.model.timeline.message_values import (
    SAMPLES_MAX,
    differing_values,
    message_values,
    samples,
    too_large,
    varying_values,
)

# The messages of one or two recordings that a filter or a search means, as far as is known.

Side = tuple[Recording, Topic | None]
Key = tuple[str, str]
"""A topic by its name and type."""


class Matches:
    """Looks at a topic when it is asked to, and remembers what it found."""

    def __init__(self, condition: TopicCondition) -> None:
        self._condition = condition
        self._masks: dict[Key, list[Mask]] = {}

    def look(self, key: Key, sides: Sequence[Side]) -> Iterator[int]:
        """Look at a topic in each recording; yields how many messages were looked at by now.

        Raises BagError, TraceError.
        """
        if key in self._masks:
            return
        masks = []
        looked = 0
        for recording, topic in sides:
            found: list[Mask] = [np.zeros(0, dtype=np.bool_)]
            if topic is not None:
                for mask in steps_of(self._condition, recording, topic):
                    found.append(mask)
                    looked += len(mask)
                    yield looked
            masks.append(np.concatenate(found))
        self._masks[key] = masks

    def masks(self, key: Key) -> list[Mask] | None:
        """Return which messages of a topic are meant, for each recording; None if not yet known."""
        return self._masks.get(key)

    def counts(self, key: Key) -> list[int]:
        """Return how many these are; none where nothing is known."""
        return [int(mask.sum()) for mask in self._masks.get(key, [])]


class RecordingSession:
    """One recording, or two. ``row`` is the selected message of the selected topic."""

    def __init__(self, a: Recording, b: Recording | None = None) -> None:
        self.recordings = [a] if b is None else [a, b]
        self.keys: list[Key] = []
        """The topics that are shown."""
        self._by_key: list[dict[Key, Topic]] = []
        for recording in self.recordings:
            topics = {(topic.name, topic.type): topic for topic in recording.topics}
            self._by_key.append(topics)
            self.keys += [key for key in topics if key not in self.keys]
        self._all_keys = self.keys
        self.place = 0
        self.row = 0
        self.openness = Openness()
        self.diff: BagDiff | None = None
        self.damage = ""
        self.filter_text = ""
        self.search_text = ""
        self._filter: Matches | None = None
        self._search: Matches | None = None
        self._kept: tuple[Key | None, tuple[int | None, int | None]] = (None, (None, None))
        self._left_at = (0, 0)
        """Which message the filter should leave selected, and where it did."""
        self._known_varying: dict[tuple[str, ...], tuple[int, frozenset[str]]] = {}
        self._pairs: tuple[object, Pairs] = (None, Pairs(None, None))

    @property
    def two(self) -> bool:
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
        return [topics.get(key) for topics in self._by_key]

    @property
    def pairs(self) -> Pairs:
        """The rows of the selected topic, as far as they are known."""
        if not self.keys or (self.two and not self.done):
            return Pairs(None, None)
        key = self.keys[self.place]
        state = key, self._length(key), self._filter
        if self._pairs[0] != state:
            self._pairs = state, self._pairs_of(key)
        return self._pairs[1]

    def _pairs_of(self, key: Key) -> Pairs:
        found = self.topics(key)
        pairs = Pairs(found[0], found[1] if self.two else None)
        masks = self._filter.masks(key) if self._filter is not None else None
        return pairs if masks is None else pairs.only(pairs.of_masks(masks))

    def _length(self, key: Key) -> int:
        return sum(len(topic.stamps) for topic in self.topics(key) if topic is not None)

    # Filters and searches.

    def set_filter(self, text: str) -> Iterator[int]:
        """Show only messages that a filter means (empty: all). Raises QueryError.

        Finding them goes on with the iterator, which yields how many were looked at, and raises
        BagError or TraceError; ``show_found`` shows what is found by then.
        """
        condition = read_filter(text, self.recordings)
        self.filter_text = text.strip()
        self._kept, self._left_at = self._selected(), (self.place, self.row)
        matches = self._filter = Matches(condition) if condition is not None else None
        self.show_found()
        return iter(()) if matches is None else self._look(matches)

    def _look(self, matches: Matches) -> Iterator[int]:
        before = 0
        for key in self._all_keys:
            for looked in matches.look(key, self._sides(key)):
                yield before + looked
            before += self._length(key)

    def show_found(self) -> None:
        """Show the topics with messages that the filter is known to mean; the selected message
        stays selected, and is again once it is among them."""
        if (self.place, self.row) != self._left_at:
            self._kept = self._selected()
        found = self._filter
        self.keys = [key for key in self._all_keys if found is None or any(found.counts(key))]
        key, at = self._kept
        there = key in self.keys
        self.place = self.keys.index(key) if key is not None and there else 0
        self.row = (self.pairs.row_of(at) or 0) if there else 0
        self._left_at = self.place, self.row

    def _selected(self) -> tuple[Key | None, tuple[int | None, int | None]]:
        if not self.keys:
            return None, (None, None)
        at = self.pairs.at(self.row) if self.row < self.pairs.count else (None, None)
        return self.keys[self.place], at

    @property
    def found_count(self) -> int:
        """How many messages the filter is known to mean."""
        found = self._filter
        return 0 if found is None else sum(sum(found.counts(key)) for key in self._all_keys)

    def set_search(self, text: str) -> None:
        """Set what ``seek`` looks for (empty: nothing). Raises QueryError."""
        condition = read_filter(text, self.recordings)
        self._search = Matches(condition) if condition is not None else None
        self.search_text = text.strip()

    def seek(self, step: int) -> Iterator[tuple[int, int] | int]:
        """Look for the next message (``step`` -1: the previous) that the search means, on this
        topic and then on the others. Yields how many were looked at, and at last the topic's
        place and the row, if there is such a message. Raises BagError, TraceError."""
        search, keys, here, at_row = self._search, self.keys, self.place, self.row
        if search is None or not keys:
            return
        looked = 0
        for away in range(len(keys) + 1):
            place = (here + step * away) % len(keys)
            for count in search.look(keys[place], self._sides(keys[place])):
                yield looked + count
            looked += self._length(keys[place])
            masks = search.masks(keys[place]) or []
            rows = np.flatnonzero(self._pairs_of(keys[place]).of_masks(masks))
            if away == 0:
                rows = rows[rows > at_row] if step > 0 else rows[rows < at_row]
            if len(rows):
                yield place, int(rows[0] if step > 0 else rows[-1])
                return

    def _sides(self, key: Key) -> list[tuple[Recording, Topic | None]]:
        return list(zip(self.recordings, self.topics(key), strict=True))

    # Rows, in words.

    def topic_text(self, place: int) -> tuple[str, str, list[str], bool]:
        """Return name, type, (count and rate) in each recording, and whether these differ."""
        key = name, type_name = self.keys[place]
        topics = self.topics(key)
        texts = []
        for number, topic in enumerate(topics):
            if topic is None:
                texts.append("-")
                continue
            rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.4g} Hz"
            found = self._filter.counts(key) if self._filter is not None else []
            if found:
                texts.append(f"{found[number]:,} of {len(topic.stamps):,}")
            else:
                texts.append(f"{len(topic.stamps):,}  {rate:>8}")
        counts = {len(topic.stamps) if topic is not None else -1 for topic in topics}
        differ = self.done and len(counts) > 1
        if self.diff is not None:
            differ = differ or any(t.topic == name and t.diverged for t in self.diff.topics)
        return printable(name), printable(type_name), texts, differ

    def number_of(self, row: int) -> int:
        """Return the number of a row's message on its topic, in recording a where it is there."""
        a, b = self.pairs.at(row)
        return a if a is not None else b or 0

    def message_text(self, row: int) -> tuple[str, RowSign | None, list[str]]:
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
            texts.append(self._values(recording, topic, place))
        if not self.two:
            return time, None, texts
        sign = pairs.sign(row)
        if sign is RowSign.DIFFERS:
            values = self._differing(topics, places)
            if values == ("", ""):  # nothing but padding, which recorders do not write
                sign = RowSign.MATCH
            elif values is not None:
                texts = list(values)
        return time, sign, texts

    def _values(self, recording: Recording, topic: Topic, place: int) -> str:
        data = topic.data[place]
        if data is None:
            return "(not kept in memory)"
        if too_large(topic.type, len(data)):
            return f"({len(data) / 1e6:.1f} MB)"
        try:
            return message_values(recording.decode(topic, data), self._varying(recording, topic))
        except RsltraceError as error:
            return printable(str(error))

    def _varying(self, recording: Recording, topic: Topic) -> frozenset[str]:
        """Return the values that vary on a topic, as far as it is read."""
        key = str(recording.path), topic.name, topic.type
        count, found = self._known_varying.get(key, (0, frozenset()))
        if len(topic.data) >= 2 * max(count, 1):
            count = len(topic.data)
            found = varying_values(
                topic.type,
                (topic.data[number] for number in samples(count, SAMPLES_MAX)),
                lambda data: recording.decode(topic, data),
            )
            self._known_varying[key] = count, found
        return found

    def _differing(
        self, topics: list[Topic | None], places: tuple[int | None, ...]
    ) -> tuple[str, str] | None:
        """Return the values in which two messages differ; None where nobody can say."""
        decoded = []
        for recording, topic, place in zip(self.recordings, topics, places, strict=True):
            data = None if topic is None or place is None else topic.data[place]
            if topic is None or data is None or too_large(topic.type, len(data)):
                return None
            try:
                decoded.append(recording.decode(topic, data))
            except RsltraceError:
                return None
        values = differing_values(*decoded)
        if values == ("", "") and repr(to_plain(decoded[0])) != repr(to_plain(decoded[1])):
            return None
        return values

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

    # Going somewhere.

    def go_to_time(self, time: TimeInRun) -> None:
        """Select the first message of the topic at a time or later; the last, if there is none."""
        topic, pairs = self.topics(self.keys[self.place])[0] if self.keys else None, self.pairs
        if topic is None or not pairs.count:
            return
        place = bisect_left(
            topic.stamps, time.stamp_ns(self.recordings[0].start_ns, self.recordings[0].end_ns)
        )
        later = np.flatnonzero(pairs.a >= place)
        self.row = int(later[0]) if len(later) else pairs.count - 1

    def go_to_message(self, number: int | None, time: TimeInRun = START) -> str:
        """Select a message of the first recording by its number in the order of time, or the first
        at a time or later; the last, if there is none, which is said then."""
        recording = self.recordings[0]
        stamps = [np.array(topic.stamps, dtype=np.int64) for topic in recording.topics]
        every = np.concatenate([*stamps, np.zeros(0, dtype=np.int64)])
        if not len(every):
            return ""
        order = np.argsort(every, kind="stable")
        if number is None:
            number = int(
                np.searchsorted(every[order], time.stamp_ns(recording.start_ns, recording.end_ns))
            )
        found = int(order[min(number, len(every) - 1)])
        ends = np.cumsum([len(one) for one in stamps])
        which = int(np.searchsorted(ends, found, side="right"))
        topic = recording.topics[which]
        self.place = self.keys.index((topic.name, topic.type))
        self.row = self.pairs.row_of((found - int(ends[which]) + len(stamps[which]), None)) or 0
        return "" if number < len(every) else f"only {len(every):,} messages: this is the last"

    # Words about all of it.

    def title(self) -> str:
        return " ↔ ".join(recording.name for recording in self.recordings)

    def mode(self) -> str:
        return "two recordings" if self.two else "one recording"

    def facts(self) -> str:
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
        if self.diff is None or self.diff.first is None:
            return
        first = self.diff.first
        for place, (name, _) in enumerate(self.keys):
            if name == first.topic:
                self.place = place
                self.row = self.pairs.next_difference(-1, 1) or 0
                return
