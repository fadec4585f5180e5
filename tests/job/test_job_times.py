"""Times of a job are exact: what is written is the number of nanoseconds, or an error."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.job import load_job
from rsltrace.job.values.times import TIME_NS_MAX, UNITS_NS, Nanoseconds, format_time, parse_time

times_ns = st.integers(0, TIME_NS_MAX)


@pytest.mark.parametrize(
    ("value", "expected_ns"),
    [
        (0.1, 100_000_000),
        (0, 0),
        (10, 10_000_000_000),
        (1e-9, 1),
        ("0.1s", 100_000_000),
        ("5ms", 5_000_000),
        ("5 ms", 5_000_000),
        ("1.5us", 1_500),
        ("7ns", 7),
        (" 2 min ", 120_000_000_000),
        ("1h", 3_600_000_000_000),
        ("1e3s", 1_000_000_000_000),
        (".5s", 500_000_000),
        ("+1.s", 1_000_000_000),
        ("0.000000001s", 1),
        ("0e99s", 0),
        (Nanoseconds(3), 3),
    ],
)
def test_values(value: object, expected_ns: int) -> None:
    assert parse_time(value) == expected_ns


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (True, "got true"),
        (None, "got nothing"),
        ([1], "got a list"),
        ({}, "got a mapping"),
        ("", "got ''"),
        ("s", "got 's'"),
        ("ten s", "got 'ten s'"),
        ("1:30", "got '1:30'"),
        ("0x10s", "got '0x10s'"),
        ("1_0s", "got '1_0s'"),
        ("10", "'10' has no unit: write '10s' for seconds"),
        ("10sec", "unknown unit 'sec' in '10sec'; write '10s'"),
        ("10S", "unknown unit 'S'"),
        (float("nan"), "a time must be finite, got nan"),
        (float("inf"), "a time must be finite, got inf"),
        (-1, "a time must not be negative, got -1"),
        ("-1ms", "a time must not be negative, got -1ms"),
        (-0.5, "a time must not be negative, got -0.5"),
        ("0.5ns", "0.5ns is finer than a nanosecond"),
        (1e-10, "1e-10 is finer than a nanosecond"),
        ("1e-999999999s", "is finer than a nanosecond"),
        ("1e999999999s", "is too large: 64-bit nanoseconds end at 9223372036.854775807s"),
        (1e300, "is too large"),
        (9223372037, "9223372037 is too large"),
        (Nanoseconds(1.5), "expected an integer number of nanoseconds, got 1.5"),
        (Nanoseconds(True), "expected an integer number of nanoseconds, got True"),
        (Nanoseconds(-1), "a time must not be negative, got -1 ns"),
        (Nanoseconds(2**63), "is too large"),
    ],
)
def test_what_is_no_time_is_refused(value: object, message: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse_time(value)
    assert message in str(caught.value)


@given(times_ns)
def test_what_is_printed_reads_back_exactly(time_ns: int) -> None:
    assert parse_time(format_time(time_ns)) == time_ns


@given(times_ns, st.sampled_from(sorted(UNITS_NS)))
def test_every_unit_is_exact(time_ns: int, unit: str) -> None:
    count, rest_ns = divmod(time_ns, UNITS_NS[unit])
    assert parse_time(f"{count}{unit}") == time_ns - rest_ns
    if unit in ("us", "ms", "s"):
        assert parse_time(f"{Decimal(time_ns) / UNITS_NS[unit]:f}{unit}") == time_ns


@pytest.mark.parametrize(
    ("written", "expected_ns"),
    [
        # As floats of seconds, the first three would be off by some nanoseconds.
        ("1000000000.000000001", 1_000_000_000_000_000_001),
        ("10.000000001", 10_000_000_001),
        ("9007199.254740993", 9_007_199_254_740_993),
        ("0.1", 100_000_000),
        ("1_000.5", 1_000_500_000_000),
        ("1e3", 1_000_000_000_000),
        ("0x10", 16_000_000_000),
        ("0o17", 15_000_000_000),
        ("+3", 3_000_000_000),
        ("1.5ms", 1_500_000),
        ('"2 h"', 7_200_000_000_000),
    ],
)
def test_a_number_in_a_job_file_is_taken_from_its_text(
    tmp_path: Path, written: str, expected_ns: int
) -> None:
    path = tmp_path / "job.yaml"
    path.write_text(f"nodes: [{{node: m:N}}]\nstart: {written}\n", encoding="utf-8")
    assert load_job(path).start_ns == expected_ns


@given(times_ns)
def test_any_number_of_seconds_with_nine_decimals_is_exact_in_a_job_file(time_ns: int) -> None:
    from rsltrace.job.reading.yaml_source import parse_yaml

    text = format_time(time_ns).removesuffix("s")
    value = parse_yaml(f"start: {text}", "job.yaml").value
    assert isinstance(value, dict)
    assert parse_time(value["start"]) == time_ns
