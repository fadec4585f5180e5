"""CRC-32 is the one of MCAP whatever computes it, and is put together of the sums of parts."""

from __future__ import annotations

import subprocess
import sys
import zlib

from hypothesis import given
from hypothesis import strategies as st

from rsltrace.trace.mcap.records import crc32, crc_of, joined_crc


@given(st.lists(st.binary(max_size=300), max_size=5), st.integers(0, 2**32 - 1))
def test_it_is_zlibs_and_that_of_the_parts(parts: list[bytes], before: int) -> None:
    whole = b"".join(parts)
    assert crc32(whole) == zlib.crc32(whole)
    assert crc32(memoryview(whole), before) == zlib.crc32(whole, before)
    assert crc_of(tuple(parts)) == zlib.crc32(whole)
    rest = b"".join(parts[1:])
    if parts:
        assert joined_crc(zlib.crc32(parts[0]), zlib.crc32(rest), len(rest)) == zlib.crc32(whole)


def test_it_is_zlibs_where_the_fast_one_is_not_installed() -> None:
    code = (
        "import sys, zlib; sys.modules['zlib_ng'] = None\n"
        "from rsltrace.trace.mcap.records import crc32\n"
        "assert crc32 is zlib.crc32"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
