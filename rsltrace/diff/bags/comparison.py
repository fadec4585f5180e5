"""Two recordings, topic by topic: which message first differs, is missing or extra, and how.

Three passes, each reading a file once from front to end: hash every message as it was recorded;
where these hashes differ, hash what the messages say (recorders leave garbage in CDR padding); and
fetch the few messages that are shown. With tolerances the last pass looks at every difference.
"""

from __future__ import annotations

import os
import shlex
import struct
from array import array
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xxhash

from rsltrace.diff.bags.messages import FetchedMessages, TopicPair, compare_topic
from rsltrace.diff.bags.sequences import Gap, Keys, gaps_by_order, gaps_by_stamp
from rsltrace.diff.bags.source import RecordingSource, SourceTopic, open_source, source_of
from rsltrace.diff.facts.bags import (
    BagVerdict,
    ComparedRecording,
    LoneTopic,
    MessageDivergence,
    TopicDiff,
)
from rsltrace.diff.facts.remarks import (
    DifferentType,
    LogTimesIgnored,
    ReaderNote,
    Remark,
    UndecodedMessages,
)
from rsltrace.diff.options import BY_STAMP, DiffOptions
from rsltrace.diff.result import BagDiff
from rsltrace.diff.values.fields import fields_of
from rsltrace.diff.values.globs import FieldRules
from rsltrace.errors import TraceError
from rsltrace.trace.reader import Trace

# A number that is equal for two messages exactly when nothing that is compared differs in them.
#
# The bytes of a recording do not serve: recorders leave garbage in the padding, and fields that
# are not compared would count. So the key is made of the decoded fields, bit for bit.

_LENGTH = struct.Struct("<Q").pack
_FLOAT = struct.Struct("<d").pack
_PLAIN = frozenset((float, int, bool, str, np.ndarray))


class ContentKeys:
    """Makes keys of messages under one set of rules."""

    def __init__(self, rules: FieldRules) -> None:
        self._rules = rules
        self._ignored: dict[str, bool] = {}
        self._elements: dict[tuple[str, int], Any] = {}

    def key(self, message: object) -> int:
        parts: list[bytes] = []
        if self._rules.empty:
            _add_all(parts, message)
        else:
            self._add(parts, "", message)
        return xxhash.xxh3_64_intdigest(b"".join(parts))

    def _add(self, parts: list[bytes], path: str, value: Any) -> None:
        """Add what is compared of a value."""
        kind = type(value)
        if kind is np.ndarray:
            _add_all(parts, self._without_ignored(path, value))
        elif kind in _PLAIN:
            _add_all(parts, value)
        elif kind is list:
            parts.append(_LENGTH(len(value)))
            for place, item in enumerate(value):
                inner = f"{path}[{place}]"
                if type(item) is not str or not self._is_ignored(inner):
                    self._add(parts, inner, item)
        else:
            prefix = f"{path}." if path else ""
            for name, attribute, _ in fields_of(value):
                inner = prefix + name
                if not self._is_ignored(inner):
                    self._add(parts, inner, getattr(value, attribute))

    def _is_ignored(self, path: str) -> bool:
        known = self._ignored.get(path)
        if known is None:
            known = self._ignored[path] = self._rules.ignored(path)
        return known

    def _without_ignored(self, path: str, values: Any) -> Any:
        """Return an array with zeros where single elements are not compared."""
        if not self._rules.by_element:
            return values
        place = (path, len(values))
        mask = self._elements.get(place)
        if mask is None:
            ignored = [self._rules.ignored(f"{path}[{index}]") for index in range(len(values))]
            mask = self._elements[place] = np.array(ignored, dtype=bool)
        if not mask.any():
            return values
        values = values.copy()
        values[mask] = 0
        return values


def _add_all(parts: list[bytes], value: Any) -> None:
    """Add a value with all that is in it, without building the paths of its fields."""
    kind = type(value)
    if kind is float:
        parts.append(_FLOAT(value))
    elif kind is int or kind is bool:
        parts.append(value.to_bytes(9, "little", signed=True))
    elif kind is str:
        encoded = value.encode("utf-8", "surrogatepass")
        parts += (_LENGTH(len(encoded)), encoded)
    elif kind is np.ndarray:
        parts += (_LENGTH(len(value)), value.tobytes())
    elif kind is list:
        parts.append(_LENGTH(len(value)))
        for item in value:
            _add_all(parts, item)
    else:
        for _, attribute, _ in fields_of(value):
            _add_all(parts, getattr(value, attribute))


@dataclass(slots=True)
class _Scan:
    """The messages of one topic: hashes of their bytes and log times, in order."""

    hashes: array[int] = field(default_factory=lambda: array("Q"))
    stamps: array[int] = field(default_factory=lambda: array("q"))


def diff_bags(
    a: str | os.PathLike[str], b: str | os.PathLike[str], options: DiffOptions | None = None
) -> BagDiff:
    """Compare two recordings (bags, or a trace's messages) topic by topic.

    ``a`` and ``b`` are folders with metadata.yaml, single ``.mcap`` or ``.db3`` files, or traces.
    Messages are matched in the order of their topic, or by log time; log times themselves are not
    compared when matching by order. Memory: 32 bytes per message, and a few messages.

    :raises BagError, TraceError: a file cannot be read, or no topic is left to compare.
    """
    options = options or DiffOptions()
    with open_source(a) as source_a, open_source(b) as source_b:
        return _BagComparison(source_a, source_b, options).run()


def compare_messages(a: Trace, b: Trace, options: DiffOptions) -> BagDiff:
    """Compare all messages, requests and responses of two traces; those of one time belong
    together. Reads all of both. Raises TraceError where they are damaged."""
    options = replace(options, by=BY_STAMP, topics=(), nodes=())
    return _BagComparison(source_of(a, services=True), source_of(b, services=True), options).run()


def compare_content(a: Trace, b: Trace, options: DiffOptions) -> BagDiff:
    """Compare all messages, requests and responses of two traces, topic by topic and in the order
    of each, whatever their times. Reads all of both. Raises TraceError where they are damaged."""
    return _BagComparison(source_of(a, services=True), source_of(b, services=True), options).run()


class _BagComparison:
    def __init__(self, a: RecordingSource, b: RecordingSource, options: DiffOptions) -> None:
        self._a, self._b = a, b
        self._options = options
        self._pairs, self._lone_a, self._lone_b = _paired(a, b, options)
        self._remarks: list[Remark] = [ReaderNote(note) for note in (*a.notes, *b.notes)]

    def run(self) -> BagDiff:
        scans_a, scans_b = self._scan(self._a, 0), self._scan(self._b, 1)
        recording_a = _recording(self._a, scans_a)
        recording_b = _recording(self._b, scans_b)
        starts = (recording_a.start_ns, recording_b.start_ns)
        if self._options.by == BY_STAMP:
            starts = (min(starts), min(starts))
        pairs = []
        for i, j in self._pairs:
            keys = (_keys(scans_a[i]), _keys(scans_b[j]))
            stamps = (_times(scans_a[i]), _times(scans_b[j]))
            gaps = self._gaps(keys, stamps)
            names = (self._a.topics[i], self._b.topics[j])
            ignores = self._options.for_topic(names[0].name).ignore
            full = tuple(side.copy() for side in keys) if ignores else keys
            pairs.append(TopicPair(i, j, *names, *keys, *stamps, gaps, *full))
        self._make_canonical(pairs)
        for pair in pairs:
            keys = (pair.keys_a, pair.keys_b)
            pair.gaps[:] = self._gaps(keys, (pair.stamps_a, pair.stamps_b), list(pair.gaps))
        topics = tuple(self._compare(pairs, starts))
        lone_a = tuple(_lone(self._a.topics[i], scans_a[i]) for i in self._lone_a)
        lone_b = tuple(_lone(self._b.topics[j], scans_b[j]) for j in self._lone_b)
        return self._result(recording_a, recording_b, topics, lone_a, lone_b)

    def _scan(self, source: RecordingSource, side: int) -> dict[int, _Scan]:
        lone = (self._lone_a, self._lone_b)[side]
        wanted = {pair[side] for pair in self._pairs} | set(lone)
        scans = {number: _Scan() for number in sorted(wanted)}
        digest = xxhash.xxh3_64_intdigest
        for stamp_ns, number, data in source.read(wanted):
            scan = scans[number]
            scan.hashes.append(digest(data))
            scan.stamps.append(stamp_ns)
        return scans

    def _gaps(
        self, keys: tuple[Keys, Keys], stamps: tuple[Keys, Keys], within: list[Gap] | None = None
    ) -> list[Gap]:
        if self._options.by == BY_STAMP:
            return gaps_by_stamp(*keys, *stamps)
        return gaps_by_order(*keys, within)

    def _make_canonical(self, pairs: list[TopicPair]) -> None:
        """Where bytes differ, replace the keys by keys of what the messages say."""
        for side, source in ((0, self._a), (1, self._b)):
            wanted: dict[int, tuple[Keys, Keys, npt.NDArray[np.bool_], ContentKeys]] = {}
            for pair in pairs:
                number, keys, full, name = (
                    (pair.number_a, pair.keys_a, pair.full_a, pair.a.name)
                    if side == 0
                    else (pair.number_b, pair.keys_b, pair.full_b, pair.b.name)
                )
                in_gap = np.zeros(len(keys), dtype=bool)
                for gap in pair.gaps:
                    start, end = gap[:2] if side == 0 else gap[2:]
                    in_gap[start:end] = True
                if in_gap.any():
                    rules = FieldRules(self._options.for_topic(name))
                    wanted[number] = (keys, full, in_gap, ContentKeys(rules))
            if not wanted:
                continue
            everything = ContentKeys(FieldRules(DiffOptions()))
            seen = dict.fromkeys(wanted, 0)
            for _, number, data in source.read(set(wanted)):
                place = seen[number]
                seen[number] = place + 1
                keys, full, in_gap, maker = wanted[number]
                if not in_gap[place]:
                    continue
                try:
                    message = source.decode(number, data)
                    if full is not keys:
                        full[place] = everything.key(message)
                    keys[place] = maker.key(message)
                except TraceError as error:
                    self._note(UndecodedMessages(str(error)))

    def _compare(self, pairs: list[TopicPair], starts: tuple[int, int]) -> list[TopicDiff]:
        fetched = FetchedMessages(self._a, self._b, pairs, self._options)
        return [compare_topic(pair, fetched, starts, self._options) for pair in pairs]

    def _note(self, remark: Remark) -> None:
        if remark not in self._remarks and len(self._remarks) < 10:
            self._remarks.append(remark)

    def _result(
        self,
        a: ComparedRecording,
        b: ComparedRecording,
        topics: tuple[TopicDiff, ...],
        lone_a: tuple[LoneTopic, ...],
        lone_b: tuple[LoneTopic, ...],
    ) -> BagDiff:
        firsts = [topic.first for topic in topics if topic.first is not None]
        first = min(firsts, key=lambda found: (found.after_ns, found.topic), default=None)
        tolerated = sum(topic.tolerated + topic.ignored for topic in topics)
        if first is not None or lone_a or lone_b:
            verdict = BagVerdict.DIFFERENT
        else:
            verdict = BagVerdict.WITHIN_TOLERANCE if tolerated else BagVerdict.EQUAL
            if not (a.complete and b.complete):
                verdict = BagVerdict.AGREE_UNTIL_TRUNCATED
        if self._options.by != BY_STAMP and topics:
            self._note(LogTimesIgnored())
        for topic in topics:
            if topic.type_a != topic.type_b:
                self._note(DifferentType(topic.topic, topic.type_a, topic.type_b))
        return BagDiff(
            a=a,
            b=b,
            verdict=verdict,
            by=self._options.by,
            topics=topics,
            topics_only_a=lone_a,
            topics_only_b=lone_b,
            first=first,
            next_step=_next_step(a, b, first, self._options),
            remarks=tuple(self._remarks),
            allow_truncated=self._options.allow_truncated,
        )


def _paired(
    a: RecordingSource, b: RecordingSource, options: DiffOptions
) -> tuple[list[tuple[int, int]], list[int], list[int]]:
    """Return the pairs of topics to compare, and those that only one side has."""
    in_a = [i for i, topic in enumerate(a.topics) if options.wants_topic(topic.name)]
    in_b = [j for j, topic in enumerate(b.topics) if options.wants_topic(topic.name)]
    if not in_a and not in_b:
        names = sorted({topic.name for topic in (*a.topics, *b.topics)})
        raise TraceError(
            f"{a.path} and {b.path} have no topic that matches {' or '.join(options.topics)}; "
            f"they have {', '.join(names[:12]) or 'none'}"
        )
    pairs = []
    # The same type first; a topic whose only types differ is compared all the same, and says so.
    for same_type in (True, False):
        for i in list(in_a):
            for j in in_b:
                one, other = a.topics[i], b.topics[j]
                if one.name == other.name and (one.type == other.type or not same_type):
                    pairs.append((i, j))
                    in_a.remove(i)
                    in_b.remove(j)
                    break
    return sorted(pairs), in_a, in_b


def _keys(scan: _Scan) -> Keys:
    return np.array(scan.hashes, dtype=np.uint64)


def _times(scan: _Scan) -> Keys:
    # Bags before 1970 are refused when they are opened.
    return np.array(scan.stamps, dtype=np.uint64)


def _recording(source: RecordingSource, scans: dict[int, _Scan]) -> ComparedRecording:
    filled = [scan.stamps for scan in scans.values() if scan.stamps]
    return ComparedRecording(
        path=source.path,
        kind=source.kind,
        topics=len(source.topics),
        messages=sum(map(len, filled)),
        start_ns=min((min(stamps) for stamps in filled), default=0),
        end_ns=max((max(stamps) for stamps in filled), default=0),
        complete=source.complete,
    )


def _lone(topic: SourceTopic, scan: _Scan) -> LoneTopic:
    return LoneTopic(topic.name, topic.type, len(scan.hashes))


def _next_step(
    a: ComparedRecording,
    b: ComparedRecording,
    first: MessageDivergence | None,
    options: DiffOptions,
) -> str:
    if first is None or options.topics == (first.topic,):
        return ""
    command = ["rsltrace", "diff", a.path, b.path, "--topic", first.topic, "--context", "20"]
    if options.by == BY_STAMP:
        command += ["--by", BY_STAMP]
    return shlex.join(command)
