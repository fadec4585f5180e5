"""A recording cut off anywhere gives the beginning of its messages, or an error; never a crash."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import BagError
from rsltrace.trace.recordings import open_bag


def whole_and_cut(path: Path, cut: Path, steps: int) -> list[int]:
    """Cut ``path`` at many places; return how many messages each piece still gives."""
    with open_bag(path) as bag:
        whole = list(bag.messages())
    data = path.read_bytes()
    counts = []
    errors: list[str] = []
    for step in range(steps):
        cut.write_bytes(data[: len(data) * step // steps])
        try:
            with open_bag(cut, recover=True) as bag:
                messages = list(bag.messages())
                assert bag.notes, "what is missing is said"
        except BagError as error:
            messages = []
            errors.append(str(error))
        assert messages == whole[: len(messages)]
        counts.append(len(messages))
    wrong = [error for error in errors if not error.startswith(f"{cut}: ")]
    assert not wrong, "the user's file is named, not a copy of it"
    assert counts == sorted(counts), "more of the file never gives less"
    return counts


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_an_mcap_cut_off_anywhere(
    mcap_maker: Callable[..., Path], samples: Any, tmp_path: Path, chunked: bool, compression: str
) -> None:
    from mcap.writer import CompressionType

    path = mcap_maker(
        tmp_path / "a.mcap",
        samples,
        chunk_size=120,
        use_chunking=chunked,
        compression=CompressionType[compression],
    )
    counts = whole_and_cut(path, tmp_path / "cut.mcap", 150)
    assert max(counts) == len(samples)  # all but the footer is there
    assert 0 in counts


def test_a_database_cut_off_anywhere(bag_maker: Callable[..., Path], tmp_path: Path) -> None:
    samples = [(1000 + i, "/t", b"\0\1\0\0" + bytes(2000)) for i in range(60)]
    (path,) = bag_maker(tmp_path / "bag", samples, storage="sqlite3").glob("*.db3")
    counts = whole_and_cut(path, tmp_path / "cut.db3", 40)
    assert max(counts) > len(samples) // 2
    assert 0 in counts
