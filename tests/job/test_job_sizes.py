"""Sizes of a job are exact numbers of bytes, or an error."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.job.values.times import format_size, parse_size


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (1, 1),
        ("1B", 1),
        ("4MiB", 4 * 2**20),
        ("0.5 KiB", 512),
        ("1.5kB", 1500),
        (" 2GB ", 2 * 10**9),
        ("1TiB", 2**40),
    ],
)
def test_values(value: object, expected: int) -> None:
    assert parse_size(value) == expected


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (True, "got true"),
        (1.5, "got the number 1.5"),
        ("4", "'4' has no unit: write '4B' for bytes"),
        ("4 mib", "unknown unit 'mib' in '4 mib'; did you mean MiB?"),
        ("4M", "unknown unit 'M' in '4M'; did you mean MB?"),
        ("4 sheep", "unknown unit 'sheep' in '4 sheep'; units are B, kB"),
        ("-4MiB", "expected a size"),
        ("0B", "a size must be from 1B"),
        ("0.3B", "0.3B is not a whole number of bytes"),
        (2**63, "a size must be from 1B"),
    ],
)
def test_what_is_no_size_is_refused(value: object, message: str) -> None:
    with pytest.raises(ValueError, match=r".*") as caught:
        parse_size(value)
    assert message in str(caught.value)


@given(st.integers(1, 2**63 - 1))
def test_a_size_that_is_written_is_read_back(size: int) -> None:
    assert parse_size(format_size(size)) == size
