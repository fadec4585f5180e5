"""One topic of two recordings: which messages belong together where they are not the same.

Gaps come from keys; here the messages themselves are looked at, to tell a changed message from a
missing one, to apply tolerances and to say what differs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

from rsltrace.diff.bags.sequences import LOOKAHEAD, Gap, Keys, MessagePair, Pairing, moved_messages
from rsltrace.diff.bags.source import RecordingSource, SourceTopic
from rsltrace.diff.facts.bags import BagMessage, MessageDivergence, TopicDiff
from rsltrace.diff.facts.evidence import FieldDifference, NoFieldsReason, Presence
from rsltrace.diff.options import BY_STAMP, DiffOptions
from rsltrace.diff.values.fields import diff_messages, field_differences, preview
from rsltrace.diff.values.globs import FieldRules
from rsltrace.errors import TraceError

_PREVIEW = 160


@dataclass(frozen=True, slots=True)
class TopicPair:
    """A topic in both recordings: its numbers there, keys and log times, and where they diverge.

    ``full_*`` are the keys with all fields, also those that are ignored.
    """

    number_a: int
    number_b: int
    a: SourceTopic
    b: SourceTopic
    keys_a: Keys
    keys_b: Keys
    stamps_a: Keys
    stamps_b: Keys
    gaps: list[Gap]
    full_a: Keys
    full_b: Keys


class FetchedMessages:
    """Gives the messages of the gaps, by topic and index, decoded.

    Without tolerances only what is shown is needed: one pass per file collects it for all topics.
    With tolerances every gap is looked at: each topic is then read by itself, in step.
    """

    def __init__(
        self, a: RecordingSource, b: RecordingSource, pairs: list[TopicPair], options: DiffOptions
    ) -> None:
        self._a, self._b = a, b
        self._context = options.context
        self._collected: tuple[dict[int, dict[int, bytes]], ...] = ({}, {})
        if not options.tolerant:
            for side, source in ((0, a), (1, b)):
                self._collect(source, side, pairs)

    def _collect(self, source: RecordingSource, side: int, pairs: list[TopicPair]) -> None:
        ranges: dict[int, tuple[int, int]] = {}
        for pair in pairs:
            if pair.gaps:
                gap = pair.gaps[0]
                start, end = (gap[2:], gap[:2])[side == 0]
                number = (pair.number_a, pair.number_b)[side]
                ranges[number] = (start - self._context, min(end, start + 4 * LOOKAHEAD))
        if not ranges:
            return
        found = self._collected[side]
        seen = dict.fromkeys(ranges, 0)
        for _, number, data in source.read(set(ranges)):
            place = seen[number]
            seen[number] = place + 1
            first, last = ranges[number]
            if first <= place < last:
                found.setdefault(number, {})[place] = data
            elif place >= last and all(seen[n] >= end for n, (_, end) in ranges.items()):
                return

    def sides(self, pair: TopicPair) -> tuple[_TopicMessages, _TopicMessages]:
        """Return access to the messages of a topic in a and in b."""
        made = []
        for side, source, number in ((0, self._a, pair.number_a), (1, self._b, pair.number_b)):
            collected = self._collected[side].get(number)
            if collected is not None:
                made.append(_TopicMessages(source, number, known=collected))
            else:
                stream = (data for _, _, data in source.read({number}))
                made.append(_TopicMessages(source, number, stream=stream, keep=self._context))
        return made[0], made[1]


class _TopicMessages:
    """The messages of one topic of one recording, read in about their order."""

    def __init__(
        self,
        source: RecordingSource,
        number: int,
        *,
        known: dict[int, bytes] | None = None,
        stream: Iterator[bytes] | None = None,
        keep: int = 0,
    ) -> None:
        self._source = source
        self._number = number
        self._known = known if known is not None else {}
        self._stream = stream
        self._order: deque[int] = deque()
        self._keep = keep + 2 * LOOKAHEAD
        self._next = 0

    def get(self, index: int) -> object | None:
        """Return a decoded message, or None if it is not available. Raises TraceError."""
        while self._stream is not None and self._next <= index:
            data = next(self._stream, None)
            if data is None:
                return None
            self._known[self._next] = data
            self._order.append(self._next)
            self._next += 1
            if len(self._order) > self._keep:
                del self._known[self._order.popleft()]
        found = self._known.get(index)
        return None if found is None else self._source.decode(self._number, found)

    def view(self, index: int, stamps: Keys) -> BagMessage:
        try:
            message = self.get(index)
            text = "" if message is None else preview(message, _PREVIEW)
        except TraceError:
            text = "(cannot be decoded)"
        return BagMessage(index, int(stamps[index]), text)


def compare_topic(
    pair: TopicPair, fetched: FetchedMessages, starts: tuple[int, int], options: DiffOptions
) -> TopicDiff:
    """Return how the messages of one topic compare. Raises BagError or TraceError."""
    own = options.for_topic(pair.a.name)
    moved = {} if options.by == BY_STAMP else moved_messages(pair.keys_a, pair.keys_b, pair.gaps)
    came_from = {in_b: in_a for in_a, in_b in moved.items()}
    counts = _counted(pair, len(moved))
    counts.ignored = _ignored(pair, outside=own.tolerant and options.by != BY_STAMP)
    first = None
    if pair.gaps:
        rules = FieldRules(own)
        side_a, side_b = fetched.sides(pair)
        if own.tolerant:
            counts = _Counts(equal=len(pair.keys_a), ignored=counts.ignored)
        gaps = pair.gaps if own.tolerant else pair.gaps[:1]
        by_stamp, tolerant = options.by == BY_STAMP, own.tolerant
        pairing = Pairing(side_a.get, side_b.get, rules, by_stamp=by_stamp, tolerant=tolerant)
        for one in pairing.of(gaps, pair.keys_a, pair.keys_b):
            if min(one) >= 0 and pair.keys_a[one.a] == pair.keys_b[one.b]:
                counts.ignored += bool(pair.full_a[one.a] != pair.full_b[one.b])
                continue
            whole = MessagePair(
                one.a if one.a >= 0 else came_from.get(one.b, -1),
                one.b if one.b >= 0 else moved.get(one.a, -1),
            )
            covered = own.tolerant and _covered(side_a, side_b, one, rules)
            if first is None and not covered:
                if whole != one:
                    first = _moved(pair, one, whole, side_a, side_b, starts, own)
                else:
                    first = _divergence(pair, one, side_a, side_b, starts, own)
            if not own.tolerant:
                break
            counts.add(one, covered=covered, moved=whole != one)
    return TopicDiff(
        topic=pair.a.name,
        type_a=pair.a.type,
        type_b=pair.b.type,
        equal=counts.equal - counts.ignored,
        tolerated=counts.tolerated,
        differing=counts.differing,
        only_a=counts.only_a,
        only_b=counts.only_b,
        ignored=counts.ignored,
        moved=counts.moved,
        first=first,
    )


@dataclass(slots=True)
class _Counts:
    equal: int = 0
    tolerated: int = 0
    differing: int = 0
    only_a: int = 0
    only_b: int = 0
    moved: int = 0
    ignored: int = 0

    def add(self, one: MessagePair, *, covered: bool, moved: bool) -> None:
        """Count what is not the same; ``equal`` begins as all of a."""
        self.equal -= one.a >= 0
        if moved:
            self.moved += one.a >= 0
        elif one.b < 0:
            self.only_a += 1
        elif one.a < 0:
            self.only_b += 1
        elif covered:
            self.tolerated += 1
        else:
            self.differing += 1


def _counted(pair: TopicPair, moved: int) -> _Counts:
    """Count by keys alone, as if what is surplus in a gap stood at its end."""
    counts = _Counts(moved=moved)
    for gap in pair.gaps:
        size = min(gap.a_end - gap.a_start, gap.b_end - gap.b_start)
        left = pair.keys_a[gap.a_start : gap.a_start + size]
        right = pair.keys_b[gap.b_start : gap.b_start + size]
        counts.differing += int((left != right).sum())
        counts.only_a += max(gap.surplus, 0)
        counts.only_b += max(-gap.surplus, 0)
    counts.equal = len(pair.keys_a) - counts.differing - counts.only_a
    counts.only_a -= moved
    counts.only_b -= moved
    return counts


def _ignored(pair: TopicPair, *, outside: bool) -> int:
    """Return how many messages belong together and differ in nothing but what is ignored.

    ``outside``: before the first gap and after the last one only.
    """
    if pair.full_a is pair.keys_a:
        return 0
    gaps = pair.gaps
    if outside and gaps:
        gaps = [Gap(gaps[0].a_start, gaps[-1].a_end, gaps[0].b_start, gaps[-1].b_end)]
    count = i = j = 0
    for gap in (*gaps, Gap(len(pair.keys_a), 0, len(pair.keys_b), 0)):
        size = gap.a_start - i
        count += int((pair.full_a[i : i + size] != pair.full_b[j : j + size]).sum())
        size = min(gap.a_end - gap.a_start, gap.b_end - gap.b_start)
        if size > 0 and not outside:
            in_a, in_b = (
                slice(gap.a_start, gap.a_start + size),
                slice(gap.b_start, gap.b_start + size),
            )
            same = pair.keys_a[in_a] == pair.keys_b[in_b]
            count += int((same & (pair.full_a[in_a] != pair.full_b[in_b])).sum())
        i, j = gap.a_end, gap.b_end
    return count


def _covered(a: _TopicMessages, b: _TopicMessages, one: MessagePair, rules: FieldRules) -> bool:
    if one.a < 0 or one.b < 0:
        return False
    try:
        left, right = a.get(one.a), b.get(one.b)
        return all(found.within_tolerance for found in field_differences(left, right, rules))
    except TraceError:
        return False


def _divergence(
    pair: TopicPair,
    one: MessagePair,
    a: _TopicMessages,
    b: _TopicMessages,
    starts: tuple[int, int],
    options: DiffOptions,
) -> MessageDivergence:
    in_a, in_b = one.a >= 0, one.b >= 0
    view_a = a.view(one.a, pair.stamps_a) if in_a else None
    view_b = b.view(one.b, pair.stamps_b) if in_b else None
    fields: tuple[FieldDifference, ...] = ()
    more, no_fields, problem = 0, None, ""
    if in_a and in_b:
        try:
            fields, more = diff_messages(a.get(one.a), b.get(one.b), options)
            if not fields:
                no_fields = NoFieldsReason.UNDESCRIBED_BYTES
        except TraceError as error:
            no_fields, problem = NoFieldsReason.UNREADABLE, str(error)
    side, stamps, index = (a, pair.stamps_a, one.a) if in_a else (b, pair.stamps_b, one.b)
    before = range(max(index - options.context, 0), index)
    return MessageDivergence(
        topic=pair.a.name,
        type=pair.a.type,
        presence=(Presence.BOTH if in_a and in_b else Presence.ONLY_A if in_a else Presence.ONLY_B),
        a=view_a,
        b=view_b,
        after_ns=min(
            view.stamp_ns - start
            for view, start in zip((view_a, view_b), starts, strict=True)
            if view is not None
        ),
        fields=fields,
        more_fields=more,
        no_fields=no_fields,
        error=problem,
        before=tuple(side.view(place, stamps) for place in before),
    )


def _moved(
    pair: TopicPair,
    one: MessagePair,
    whole: MessagePair,
    a: _TopicMessages,
    b: _TopicMessages,
    starts: tuple[int, int],
    options: DiffOptions,
) -> MessageDivergence:
    """Return the divergence at a message that the other side has, too, but not in this place."""
    found = _divergence(pair, one, a, b, starts, options)
    shown = found.a or found.b
    assert shown is not None
    views = [
        BagMessage(index, int(stamps[index]), shown.preview)
        for index, stamps in ((whole.a, pair.stamps_a), (whole.b, pair.stamps_b))
    ]
    gap = next(g for g in pair.gaps if g.a_start <= one.a < g.a_end or g.b_start <= one.b < g.b_end)
    here, there = (gap.b_start, whole.b) if one.a >= 0 else (gap.a_start, whole.a)
    after_ns = min(view.stamp_ns - start for view, start in zip(views, starts, strict=True))
    return replace(
        found,
        presence=Presence.BOTH,
        a=views[0],
        b=views[1],
        after_ns=after_ns,
        moved=True,
        swapped_at=gap.a_start if there == here + 1 and abs(gap.surplus) == 1 else None,
    )
