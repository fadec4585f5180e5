"""The hash rules, spelled out by hand and compared."""

from __future__ import annotations

import struct

import numpy as np
import xxhash
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.trace.chain import digest_text, hash64, output_hash, verify_chain
from rsltrace.trace.dtypes import EVENT_DTYPE
from rsltrace.trace.format import EVENT_REST, OUTPUT

U64 = st.integers(0, 2**64 - 1)


def chained(rests: list[bytes], previous: int = 0) -> np.ndarray:
    rows = b""
    for rest in rests:
        previous = xxhash.xxh3_64(rest, seed=previous).intdigest()
        rows += struct.pack("<Q", previous) + rest
    return np.frombuffer(rows, dtype=EVENT_DTYPE)


def rests_of(count: int) -> list[bytes]:
    return [EVENT_REST.pack(i, 10 * i, 0, i * 7, 0, 0, i % 5, 0, 0, 2, 0) for i in range(count)]


def test_hash64_is_xxh3_with_a_64_bit_seed() -> None:
    assert hash64(b"") == 0x2D06800538D394C2
    assert hash64(b"abc", 2**64 - 1) == xxhash.xxh3_64(b"abc", seed=2**64 - 1).intdigest()


@given(previous=U64, count=st.integers(0, 20))
def test_a_right_chain_verifies_from_any_start(previous: int, count: int) -> None:
    assert verify_chain(chained(rests_of(count), previous), previous) is None


@given(
    position=st.integers(0, 19),
    field=st.sampled_from(EVENT_DTYPE.names),
    flip=st.integers(1, 255),
)
def test_any_changed_field_is_found_at_its_event(position: int, field: str, flip: int) -> None:
    events = chained(rests_of(20)).copy()
    events[position][field] ^= np.array(flip, dtype=EVENT_DTYPE[field])
    assert verify_chain(events) == position


def test_a_wrong_start_is_found_at_the_first_event() -> None:
    assert verify_chain(chained(rests_of(3), previous=5), previous=6) == 0


def test_verify_chain_takes_views_that_are_not_contiguous() -> None:
    padded = np.zeros(10, dtype=[("before", "u1"), ("event", EVENT_DTYPE)])
    padded["event"] = chained(rests_of(10))
    assert verify_chain(padded["event"]) is None


def test_output_hash_folds_hash_entity_and_kind_and_nothing_else() -> None:
    first, second = OUTPUT.pack(3, 11, 5, 1, 7), OUTPUT.pack(3, 12, 6, 4, 8)
    expected = xxhash.xxh3_64(first[8:24], seed=0).intdigest()
    expected = xxhash.xxh3_64(second[8:24], seed=expected).intdigest()
    assert output_hash([first, second]) == expected
    assert output_hash([second, first]) != expected
    elsewhere = [OUTPUT.pack(99, 11, 5, 1, 70), OUTPUT.pack(99, 12, 6, 4, 80)]
    assert output_hash(elsewhere) == expected
    assert output_hash([]) == 0


def test_a_digest_has_16_digits_whatever_its_value() -> None:
    assert digest_text(0) == "0" * 16
    assert digest_text(0xAB) == "00000000000000ab"
