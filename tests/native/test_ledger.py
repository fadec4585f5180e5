"""The order in which callbacks are written down, and who is found to have sent what they got."""

from __future__ import annotations

import random
import threading

from rsltrace.native.boundary import channel_of
from rsltrace.native.ledger import Failed, Ledger, Scheduled, Sent, Span, Taken
from rsltrace.native.pen import Causes
from rsltrace.native.things import Thing
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind

TIMER, RESUME, OUTSIDE = map(int, (EventKind.TIMER, EventKind.RESUME, EventKind.OUTSIDE))
THING = Thing(1, 1, EntityKind.TIMER, "on_timer")
TOPIC = Thing(2, 1, EntityKind.PUBLISHER, "/topic")
LONG_NS = 10**12


def kinds(spans: list[Span]) -> list[int]:
    return [span.kind for span in spans]


def test_what_began_first_keeps_the_others_back() -> None:
    ledger = Ledger()
    ledger.begin(TIMER, THING)
    other = threading.Thread(target=lambda: (ledger.begin(TIMER, TOPIC), ledger.end()))
    other.start()
    other.join()
    assert ledger.finished(LONG_NS) == []
    ledger.end()
    assert [span.thing for span in ledger.finished(LONG_NS)] == [THING, TOPIC]


def test_one_that_never_ends_is_cut_in_two() -> None:
    ledger = Ledger()
    ledger.begin(TIMER, THING)
    ledger.add(Scheduled())
    (first,) = ledger.finished(0)
    assert first.flags == EventFlag.SUSPENDED
    assert len(first.outputs) == 1
    ledger.add(Scheduled())
    ledger.end()
    (second,) = ledger.finished(LONG_NS)
    assert (second.kind, second.flags, len(second.outputs)) == (RESUME, 0, 1)
    assert second.start_ns >= first.end_ns


def test_a_callback_within_another_one_suspends_it() -> None:
    ledger = Ledger()
    outer = ledger.begin(TIMER, THING)
    ledger.begin(TIMER, TOPIC)
    ledger.end(Failed("ValueError", "no", ""))
    ledger.suspend()  # nothing came of it after the inner one
    ledger.resume(outer)
    place = ledger.add(Scheduled())
    ledger.end()
    spans = ledger.finished(LONG_NS)
    assert kinds(spans) == [TIMER, TIMER, RESUME]
    assert [span.flags for span in spans] == [EventFlag.SUSPENDED, EventFlag.RAISED, 0]
    assert place == (spans[2], 0)


def test_what_a_thread_of_the_users_sends_is_an_event_of_its_own() -> None:
    ledger = Ledger()
    ledger.add(Scheduled())
    assert kinds(ledger.finished(LONG_NS)) == [OUTSIDE]


def test_many_threads_lose_nothing_and_starts_are_in_order() -> None:
    ledger, taken = Ledger(), []

    def run(seed: int) -> None:
        for depth in depths(seed):
            for _ in range(depth):
                ledger.begin(TIMER, THING)
                ledger.add(Scheduled())
            for _ in range(depth):
                ledger.end()

    threads = [threading.Thread(target=run, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        taken += ledger.finished(LONG_NS)
    taken += ledger.finished(None)
    assert [span.start_ns for span in taken] == sorted(span.start_ns for span in taken)
    assert sum(len(span.outputs) for span in taken) == sum(map(sum, map(depths, range(4))))
    assert {span.thread for span in taken} == {1, 2, 3, 4}


def depths(seed: int) -> list[int]:
    chance = random.Random(seed)
    return [chance.randrange(1, 4) for _ in range(300)]


def sent(digest: int, sequence: int, before_ns: int, after_ns: int) -> Sent:
    return Sent(1, TOPIC, digest, b"", sequence, after_ns, before_ns)


def got(digest: int, sequence: int, source_ns: int) -> Taken:
    return Taken(TOPIC, digest, digest, channel_of(1, "/topic"), sequence, source_ns)


def test_equal_messages_of_equal_numbers_are_told_apart_by_their_time() -> None:
    causes = Causes()
    causes.sent(sent(5, 1, 100, 110), event=0, output=0)
    causes.sent(sent(5, 1, 120, 130), event=1, output=2)
    assert causes.of(got(5, 1, 125)) == (1, 2)
    assert causes.of(got(5, 1, 105)) == (0, 0)
    assert causes.of(got(5, 1, 115)) == (NO_EVENT, 0)  # somebody else's
    assert causes.of(got(6, 1, 105)) == (NO_EVENT, 0)
    assert causes.unknown == 2


def test_a_single_candidate_is_taken_if_only_clocks_disagree() -> None:
    causes, second_ns = Causes(), 10**9
    causes.sent(sent(5, 1, second_ns, second_ns + 10), event=3, output=0)
    assert causes.of(got(5, 1, second_ns - 1)) == (3, 0)
    assert causes.of(got(5, 1, 2 * second_ns)) == (NO_EVENT, 0)


def test_what_was_sent_long_ago_is_forgotten() -> None:
    causes = Causes(kept=2)
    for number in range(3):
        causes.sent(sent(5, number, 0, 10), event=number, output=0)
    assert causes.of(got(5, 0, 5)) == (NO_EVENT, 0)
    assert causes.of(got(5, 2, 5)) == (2, 0)
