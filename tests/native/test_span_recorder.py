"""The order in which callbacks are written down, and who is found to have sent what they got."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from itertools import count
from unittest.mock import MagicMock

import pytest

from rsltrace.native.message_observer import MessageObserver, channel_of
from rsltrace.native.observed_entities import ObservedEntities, ObservedEntity
from rsltrace.native.span_recorder import (
    CallbackError,
    CallbackSpan,
    ReceivedInput,
    SentMessage,
    SpanRecorder,
    TaskCreation,
)
from rsltrace.native.span_writer import CauseIndex
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind

TIMER, RESUME, OUTSIDE = map(int, (EventKind.TIMER, EventKind.RESUME, EventKind.OUTSIDE))
THING = ObservedEntity(1, 1, EntityKind.TIMER, "on_timer")
TOPIC = ObservedEntity(2, 1, EntityKind.PUBLISHER, "/topic")
LONG_NS = 10**12


def kinds(spans: list[CallbackSpan]) -> list[int]:
    return [span.kind for span in spans]


def test_what_began_first_keeps_the_others_back() -> None:
    recorder = SpanRecorder()
    recorder.begin(TIMER, THING)
    other = threading.Thread(target=lambda: (recorder.begin(TIMER, TOPIC), recorder.end()))
    other.start()
    other.join()
    assert recorder.finished(LONG_NS) == []
    recorder.end()
    assert [span.entity for span in recorder.finished(LONG_NS)] == [THING, TOPIC]


def test_one_that_never_ends_is_cut_in_two() -> None:
    recorder = SpanRecorder()
    recorder.begin(TIMER, THING)
    recorder.add(TaskCreation())
    (first,) = recorder.finished(0)
    assert first.flags == EventFlag.SUSPENDED
    assert len(first.outputs) == 1
    recorder.add(TaskCreation())
    recorder.end()
    (second,) = recorder.finished(LONG_NS)
    assert (second.kind, second.flags, len(second.outputs)) == (RESUME, 0, 1)
    assert second.start_ns >= first.end_ns


def test_a_callback_within_another_one_suspends_it() -> None:
    recorder = SpanRecorder()
    outer = recorder.begin(TIMER, THING)
    recorder.begin(TIMER, TOPIC)
    recorder.end(CallbackError("ValueError", "no", ""))
    recorder.suspend()  # nothing came of it after the inner one
    recorder.resume(outer)
    place = recorder.add(TaskCreation())
    recorder.end()
    spans = recorder.finished(LONG_NS)
    assert kinds(spans) == [TIMER, TIMER, RESUME]
    assert [span.flags for span in spans] == [EventFlag.SUSPENDED, EventFlag.RAISED, 0]
    assert place == (spans[2], 0)


def test_an_interrupt_waits_until_what_was_sent_is_noted() -> None:
    from std_msgs.msg import String

    class Publisher:
        def publish(self, message: String) -> None:
            os.kill(os.getpid(), signal.SIGINT)

        publish_raw = publish

    recorder = SpanRecorder()
    entities = ObservedEntities(recorder.add)
    observer = MessageObserver(recorder, entities)
    recorder.begin(TIMER, THING)
    before = signal.signal(signal.SIGINT, recorder.interrupts.handle)
    try:
        with observer.watched(MagicMock(Publisher=Publisher)):
            handle = Publisher()
            topic = entities.add((handle,), None, EntityKind.PUBLISHER, "/topic")
            topic.sends_type = String
            with pytest.raises(KeyboardInterrupt):
                handle.publish(String(data="last"))
    finally:
        signal.signal(signal.SIGINT, before)
    recorder.end()
    (span,) = recorder.finished(LONG_NS)
    assert [one.entity for one in span.outputs if isinstance(one, SentMessage)] == [topic]


def test_an_interrupt_waits_until_a_message_is_taken() -> None:
    class Subscription:
        def take_message(self, kind: object, raw: bool) -> None: ...

    taken = []

    def take(*_: object) -> tuple[None, bytes]:
        os.kill(os.getpid(), signal.SIGINT)
        taken.append(True)
        return None, b""

    recorder = SpanRecorder()
    observer = MessageObserver(recorder, ObservedEntities(lambda _: None), take)
    before = signal.signal(signal.SIGINT, recorder.interrupts.handle)
    try:
        with (
            observer.watched(MagicMock(Subscription=Subscription)),
            pytest.raises(KeyboardInterrupt),
        ):
            Subscription().take_message(None, False)
    finally:
        signal.signal(signal.SIGINT, before)
    assert taken == [True]


@pytest.mark.parametrize("kind", [TIMER, int(EventKind.TASK)])
def test_a_callback_that_is_interrupted_as_it_begins_has_raised(kind: int) -> None:
    """It is an event, since what it got is no more, and its end is not that of another."""
    from rsltrace.native.callback_observer import ObservedTask, _run

    class Interrupted(SpanRecorder):
        def time_ns(self) -> int:
            os.kill(os.getpid(), signal.SIGINT)
            return super().time_ns()

    ran: list[bool] = []

    async def call() -> None:
        ran.append(True)

    def task() -> None:
        _run(recorder, THING, lambda: ran.append(True), cause)

    def callback() -> None:
        next(ObservedTask(recorder, kind, THING, call, None).__await__())

    recorder = SpanRecorder()
    main = recorder.begin(int(EventKind.CONSTRUCT), THING)
    cause = recorder.add(TaskCreation())
    recorder.pause(THING)
    recorder.__class__ = Interrupted
    before = signal.signal(signal.SIGINT, recorder.interrupts.handle)
    try:
        with pytest.raises(KeyboardInterrupt):
            (callback if kind == TIMER else task)()
    finally:
        signal.signal(signal.SIGINT, before)
    assert recorder.current() is main
    recorder.end()
    spans = recorder.finished(LONG_NS)
    assert kinds(spans) == [int(EventKind.CONSTRUCT), kind]
    assert spans[1].flags == EventFlag.RAISED
    assert ran == []


def test_threads_that_share_a_publisher_count_as_the_middleware_does() -> None:
    from std_msgs.msg import String

    left: list[str] = []

    class Publisher:
        def publish(self, message: object) -> None:
            left.append(message.data)  # type: ignore[attr-defined]

        publish_raw = publish

    class Slow:
        """Gives numbers, and then lets other threads run."""

        numbers = count(1)

        def __next__(self) -> int:
            number = next(self.numbers)
            time.sleep(1e-4)
            return number

    recorder = SpanRecorder()
    entities = ObservedEntities(lambda _: None)
    with MessageObserver(recorder, entities).watched(MagicMock(Publisher=Publisher)):
        handle = Publisher()
        topic = entities.add((handle,), None, EntityKind.PUBLISHER, "/topic")
        topic.sends_type, topic.sequence = String, Slow()  # type: ignore[assignment]
        threads = [
            threading.Thread(target=lambda n=n: handle.publish(String(data=str(n))))
            for n in range(50)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    sent = [one for span in recorder.finished(None) for one in span.outputs]
    assert all(isinstance(one, SentMessage) for one in sent)
    numbered = sorted((one.sequence, one.data) for one in sent if isinstance(one, SentMessage))
    assert [number for number, _ in numbered] == list(range(1, 51))
    for text, (_, data) in zip(left, numbered, strict=True):
        assert f"{text}\0".encode() in data


def test_what_a_thread_of_the_users_sends_is_an_event_of_its_own() -> None:
    recorder = SpanRecorder()
    recorder.add(TaskCreation())
    assert kinds(recorder.finished(LONG_NS)) == [OUTSIDE]


def test_many_threads_lose_nothing_and_starts_are_in_order() -> None:
    recorder, taken = SpanRecorder(), []

    def run(seed: int) -> None:
        for depth in depths(seed):
            for _ in range(depth):
                recorder.begin(TIMER, THING)
                recorder.add(TaskCreation())
            for _ in range(depth):
                recorder.end()

    threads = [threading.Thread(target=run, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        taken += recorder.finished(LONG_NS)
    taken += recorder.finished(None)
    assert [span.start_ns for span in taken] == sorted(span.start_ns for span in taken)
    assert sum(len(span.outputs) for span in taken) == sum(map(sum, map(depths, range(4))))
    assert {span.thread for span in taken} == {1, 2, 3, 4}


def depths(seed: int) -> list[int]:
    chance = random.Random(seed)
    return [chance.randrange(1, 4) for _ in range(300)]


def sent(digest: int, sequence: int, before_ns: int, after_ns: int) -> SentMessage:
    return SentMessage(1, TOPIC, digest, b"", sequence, after_ns, before_ns)


def got(digest: int, sequence: int, source_ns: int) -> ReceivedInput:
    return ReceivedInput(TOPIC, digest, digest, channel_of(1, "/topic"), sequence, source_ns)


def test_equal_messages_of_equal_numbers_are_told_apart_by_their_time() -> None:
    causes = CauseIndex()
    causes.sent(sent(5, 1, 100, 110), event=0, output=0)
    causes.sent(sent(5, 1, 120, 130), event=1, output=2)
    assert causes.of(got(5, 1, 125)) == (1, 2)
    assert causes.of(got(5, 1, 105)) == (0, 0)
    assert causes.of(got(5, 1, 115)) == (NO_EVENT, 0)  # somebody else's
    assert causes.of(got(6, 1, 105)) == (NO_EVENT, 0)
    assert causes.unknown == 2
    causes.sent(sent(5, 1, 108, 112), event=2, output=0)
    assert causes.of(got(5, 1, 109)) == (NO_EVENT, 0)  # either's
    assert causes.of(got(5, 1, 111)) == (2, 0)


def test_equal_feedback_comes_in_the_order_in_which_it_was_sent() -> None:
    causes = CauseIndex()
    for event in range(2):
        causes.sent(sent(1, 0, 100, 110), event, output=0)
    assert [causes.of(got(1, 0, 0)) for _ in range(3)] == [(0, 0), (1, 0), (1, 0)]


def test_equal_responses_to_two_clients_have_their_own_cause_or_none() -> None:
    causes = CauseIndex()
    causes.sent(sent(5, 1, 100, 110), event=0, output=0)
    assert causes.of(got(5, 1, 0)) == (0, 0)
    for event in (1, 2):
        causes.sent(sent(5, 1, 100, 110), event, output=0)
    assert [causes.of(got(5, 1, 0)) for _ in range(2)] == [(NO_EVENT, 0)] * 2
    assert causes.unknown == 2


def test_a_single_candidate_is_taken_if_only_clocks_disagree() -> None:
    causes, second_ns = CauseIndex(), 10**9
    causes.sent(sent(5, 1, second_ns, second_ns + 10), event=3, output=0)
    assert causes.of(got(5, 1, second_ns - 1)) == (3, 0)
    assert causes.of(got(5, 1, 2 * second_ns)) == (NO_EVENT, 0)


def test_what_was_sent_long_ago_is_forgotten() -> None:
    causes = CauseIndex(kept=2)
    for number in range(3):
        causes.sent(sent(5, number, 0, 10), event=number, output=0)
    assert causes.of(got(5, 0, 5)) == (NO_EVENT, 0)
    assert causes.of(got(5, 2, 5)) == (2, 0)
