"""Whose turn it is, in memory that a process and the loop share: who is awake is not woken."""

from __future__ import annotations

import mmap
import os
import struct

import pytest

from rsltrace.compiled import core

pytestmark = pytest.mark.skipif(core is None, reason="needs the compiled module")
_BATCHES, _LOOP_SLEEPS, _TURNS, _PROCESS_SLEEPS = range(8, 24, 4)


class _Process:
    """The words in memory, as a process has them."""

    def __init__(self) -> None:
        fd = os.memfd_create("turns")
        os.ftruncate(fd, 1 << 12)
        self._memory = mmap.mmap(fd, 0)
        assert core is not None
        self.loop = core.turns_of(fd)
        os.close(fd)

    def __getitem__(self, place: int) -> int:
        (number,) = struct.unpack_from("<I", self._memory, place)
        return int(number)

    def __setitem__(self, place: int, number: int) -> None:
        struct.pack_into("<I", self._memory, place, number)


def test_only_a_process_that_sleeps_is_woken() -> None:
    assert core is not None
    process = _Process()
    assert core.turn_given(process.loop) is False
    process[_PROCESS_SLEEPS] = 1
    assert core.turn_given(process.loop) is True
    assert (process[_TURNS], process[_PROCESS_SLEEPS]) == (2, 0)


def test_the_loop_asks_to_be_woken_where_there_is_no_batch() -> None:
    assert core is not None
    process = _Process()
    core.turn_given(process.loop)
    assert core.turn_over(process.loop) is False
    assert process[_LOOP_SLEEPS] == 1
    process[_BATCHES] = 1
    assert core.turn_over(process.loop) is True
    assert process[_LOOP_SLEEPS] == 0
    assert core.turn_over(process.loop) is False  # each batch is taken once


def test_what_shares_no_memory_has_no_turns() -> None:
    assert core is not None
    with pytest.raises(OSError, match="Bad file descriptor"):
        core.turns_of(1 << 20)
    with pytest.raises(ValueError, match="PyCapsule"):
        core.turn_given(object())
