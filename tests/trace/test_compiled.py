"""The compiled module makes the same records, and the same errors, as the Python it replaces."""

from __future__ import annotations

import contextlib
import gc
import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from rsltrace import compiled
from rsltrace.trace.format import EVENT_REST, OUTPUT_CONTENT
from rsltrace.trace.mcap.chunk_builder import LARGE_BYTES, messages_chunk
from rsltrace.trace.recorder import PythonEventChain
from rsltrace.trace.writer import PythonRecordBuffer

ROOT = Path(__file__).resolve().parents[2]
core: Any = compiled.core
needs_core = pytest.mark.skipif(core is None, reason="no compiler has built rsltrace._core")


class Writer:
    """What an event chain needs of a writer; each chunk is noted."""

    def __init__(self, buffer: Any, chain: Any, *, direct: bool) -> None:
        self.log: list[Any] = []
        self.fails = False
        self.sequences = [0, 0, 2**32 - 5]
        self.buffer = buffer(
            self.write_segment,
            self.write_payloads,
            self.sequences,
            events_max=20,
            outputs_max=30,
            payload_bytes_max=400,
        )
        for name in ("add_event", "add_output", "add_sequence", "add_payload"):
            method = getattr(self.buffer, name)
            # As of a writer of its own, such as a debugger's.
            setattr(self, name, method if direct else self._noted(name, method))
        self.chain = chain(self)

    def _noted(self, name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def noted(*args: Any) -> Any:
            self.log.append((name, args))
            return method(*args)

        return noted

    def write_segment(self) -> None:
        self.log.append((self.buffer.events, self.buffer.outputs, self.buffer.rows()))
        if self.fails:
            raise OSError("the disk is full")
        self.buffer.clear_rows()

    def write_payloads(self) -> None:
        self.log.append((self.buffer.payload_bytes, self.buffer.take_payloads()))

    def state(self) -> Any:
        chain, buffer = self.chain, self.buffer
        return (
            (chain.index, chain.chain_hash, chain.outputs, chain.output_hash),
            (buffer.events, buffer.outputs, buffer.rows()),
            (self.sequences, buffer.payload_bytes),
            self.log,
        )


def _number(rng: random.Random, bits: int) -> Any:
    if rng.random() < 0.02:
        return rng.choice([-1, 2**bits, 2**70, 1.5, "1", None, np.uint64(7), np.int32(-3)])
    return rng.choice([0, 1, 2**bits - 1, rng.getrandbits(bits)])


def _step(rng: random.Random) -> tuple[str, tuple[Any, ...]]:
    def number(bits: int) -> Any:
        return _number(rng, bits)

    match rng.randrange(5):
        case 0:
            return "draw", (number(32), number(64))
        case 1:
            sequence = (rng.getrandbits(32),) if rng.random() < 0.5 else ()
            return "output", (number(32), number(32), number(64), *sequence)
        case 2:
            channel, data = rng.choice([-1, 0, 1, 1, 2, 9]), rng.randbytes(rng.randrange(90))
            return "message", (number(32), number(32), channel, number(64), data, number(64))
        case _:
            state = (number(64),) if rng.random() < 0.5 else ()
            rest = (number(32), number(64), number(32), number(64))
            return "end_event", (number(64), number(8), number(8), *rest, *state)


def _outcome(function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    try:
        return function(*args)
    except Exception as error:
        return type(error), str(error)


@needs_core
@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("seed", range(10))
def test_records_and_errors_are_the_same(seed: int, direct: bool) -> None:
    rng = random.Random(seed)
    ours = Writer(core.RecordBuffer, core.EventChain, direct=direct)
    python = Writer(PythonRecordBuffer, PythonEventChain, direct=direct)
    both, told = (ours, python), ([], [])
    for number in range(400):
        if number == 200:
            for writer, list_ in zip(both, told, strict=True):
                writer.chain.tell([lambda *output, to=list_: to.append(output)])
        ours.fails = python.fails = rng.random() < 0.02
        name, args = _step(rng)
        was, expected = (_outcome(getattr(writer.chain, name), args) for writer in both)
        assert was == expected, (name, args)
        if isinstance(was, tuple):  # such a run is over
            ours.chain.index = python.chain.index = number
            for writer in both:
                writer.buffer.clear_rows()
                writer.buffer.take_payloads()
        assert ours.state() == python.state(), (name, args)
        assert told[0] == told[1]
    for writer in both:
        writer.buffer.drop_unfinished()
        writer.write_payloads()
    assert ours.state() == python.state()


@needs_core
@pytest.mark.parametrize("sizes", [(1, -1), (1, 0, 0), (0, 1, 0, 1)])
def test_large_messages_are_pieces_of_their_own(sizes: tuple[int, ...]) -> None:
    datas = [bytes(size if size > 0 else LARGE_BYTES + size) for size in sizes]
    taken = []
    for class_ in (core.RecordBuffer, PythonRecordBuffer):
        buffer = class_(len, len, [0, 0], events_max=1, outputs_max=1, payload_bytes_max=1 << 30)
        for number, data in enumerate(datas):
            buffer.add_payload(1, number, data)
        headers, parts = buffer.take_payloads()
        large = [data for data in datas if len(data) >= LARGE_BYTES]
        assert [part for part in parts if any(part is data for data in large)] == large
        assert buffer.payload_bytes == 0
        assert buffer.take_payloads() == (b"", ())
        taken.append((headers, parts))
    assert taken[0] == taken[1]


@needs_core
def test_unfinished_events_are_dropped_alike() -> None:
    for events in (0, 1, 3):
        states = []
        for buffer, chain in (
            (core.RecordBuffer, core.EventChain),
            (PythonRecordBuffer, PythonEventChain),
        ):
            writer = Writer(buffer, chain, direct=True)
            for _ in range(events):
                writer.chain.draw(1, 2)
                writer.chain.message(1, 2, 1, 3, b"abc", 4)
                writer.chain.end_event(1, 2, 0, 3, 4, 5, 6)
            writer.chain.draw(1, 2)
            writer.chain.output(1, 2, 3)
            writer.buffer.drop_unfinished()
            states.append(writer.state())
        assert states[0] == states[1]


@needs_core
def test_garbage_that_adds_a_message_while_they_are_taken_loses_none() -> None:
    class Garbage:
        def __init__(self, buffer: Any) -> None:
            self.itself, self.buffer = self, buffer

        def __del__(self) -> None:
            self.buffer.add_payload(1, 5, b"late")

    for later in range(20):
        buffer = core.RecordBuffer(
            len, len, [0, 0], events_max=1, outputs_max=1, payload_bytes_max=1 << 30
        )
        buffer.add_payload(1, 1, b"early")
        gc.collect()
        Garbage(buffer)
        kept = gc.get_threshold()
        gc.set_threshold(gc.get_count()[0] + later)
        try:
            taken = [buffer.take_payloads()]
        finally:
            gc.set_threshold(*kept)
        gc.collect()
        taken.append(buffer.take_payloads())
        chunks = [messages_chunk(*each) for each in taken if each[0]]
        assert sum(count for chunk in chunks for _, count, _ in chunk.indexes) == 2, later


@needs_core
@pytest.mark.parametrize("size", [LARGE_BYTES - 1, LARGE_BYTES])
def test_a_message_without_memory_is_not_added_by_half(size: int) -> None:
    testing = pytest.importorskip("_testcapi")
    for number in range(1, 5):
        buffer = core.RecordBuffer(
            len, len, [0, 0], events_max=1, outputs_max=1, payload_bytes_max=1 << 30
        )
        for _ in range(3):
            buffer.add_payload(1, 1, bytes(20_000))
        data = bytes(size)
        with contextlib.suppress(MemoryError):
            testing.set_nomemory(number, number + 1)
            try:
                buffer.add_payload(1, 1, data)
            finally:
                testing.remove_mem_hooks()
        assert messages_chunk(*buffer.take_payloads()).indexes, number


@needs_core
def test_a_chain_does_not_begin_anew_while_it_adds() -> None:
    writer = Writer(core.RecordBuffer, core.EventChain, direct=True)
    with pytest.raises(TypeError, match="begins once"):
        writer.chain.__init__(writer)  # its buffer could go while a message is added to it


@needs_core
def test_the_buffer_refuses_rows_of_other_sizes() -> None:
    writer = Writer(core.RecordBuffer, core.EventChain, direct=True)
    for call in (
        lambda: writer.buffer.add_event(b"short", 1),
        lambda: writer.buffer.add_output(bytes(OUTPUT_CONTENT.size + 1)),
    ):
        with pytest.raises(ValueError, match="bytes where"):
            call()
    with pytest.raises(TypeError, match="got 0 arguments"):
        writer.chain.end_event()
    with pytest.raises(OverflowError):
        writer.buffer.add_event(bytes(EVENT_REST.size), -1)


@needs_core
def test_calls_leave_no_memory_behind() -> None:
    code = (
        "from pathlib import Path\n"
        "from tests.trace.test_compiled import Writer, core\n"
        "writer = Writer(core.RecordBuffer, core.EventChain, direct=True)\n"
        "def run(times):\n"
        "    for number in range(times):\n"
        "        writer.chain.message(1, 2, 1, number << 40, bytes(9), number << 40)\n"
        "        writer.chain.draw(1, 1 << 50)\n"
        "        writer.chain.end_event(number << 40, 1, 0, 1, 2**64 - 1, 0, 0)\n"
        "        try: writer.chain.output(-1, number, number)\n"
        "        except Exception: pass\n"
        "        writer.log.clear()\n"
        "    return int(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])\n"
        "first = run(3000)\n"
        "assert run(30000) - first < 500, 'KiB'\n"
    )
    subprocess.run([sys.executable, "-X", "dev", "-c", code], cwd=ROOT, check=True)


@needs_core
@pytest.mark.ros
def test_a_run_has_the_same_bytes_without_it(tmp_path: Path) -> None:
    files = []
    job = ROOT / "examples/rslcpp_determinism/job.yaml"
    record = [sys.executable, "-m", "rsltrace", "record", job, "-q"]
    for setting in ("0", "1"):
        files.append(tmp_path / f"{setting}.mcap")
        environment = {**os.environ, "RSLTRACE_COMPILED": setting}
        subprocess.run([*record, "-o", files[-1]], cwd=ROOT, env=environment, check=True)
    assert files[0].read_bytes() == files[1].read_bytes()


def test_a_module_older_than_its_source_is_not_used(tmp_path: Path) -> None:
    built = tmp_path / "core.so"
    built.touch()
    module = ModuleType("core")
    module.__file__ = str(built)
    assert not compiled._is_older_than_its_source(module)
    os.utime(built, (0, 0))
    assert compiled._is_older_than_its_source(module)


def _other_pythons() -> list[Path]:
    """Return interpreters of other versions that have headers, those of pyenv among them."""
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    places = [*root.glob("versions/3.*/bin/python"), *Path("/usr/bin").glob("python3.1?")]
    asks = "import sys, sysconfig; print(*sys.version_info[:2], sysconfig.get_path('include'))"
    found = {}
    for place in sorted(places):
        said = subprocess.run([place, "-c", asks], capture_output=True, text=True).stdout.split()
        if said and (Path(said[-1]) / "Python.h").exists() and int(said[1]) >= 10:
            found[int(said[1])] = place
    return [place for minor, place in found.items() if minor != sys.version_info[1]]


_MAKES = """
import pathlib, sys
import hatch_build
sys.exit(hatch_build.compile_core(pathlib.Path(sys.argv[1])) or 0)
"""
_IN_PLACE_OF_OURS = """
import importlib.util, sys
import pytest
spec = importlib.util.spec_from_file_location("rsltrace._core", sys.argv[1])
sys.modules["rsltrace._core"] = module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
from rsltrace import compiled
assert compiled.core is module
for _ in range(50_000):
    module.RecordBuffer(None, None, [], *[1] * 3).clear_rows()
sys.exit(pytest.main(["-q", "-p", "no:cacheprovider", "-k", "same", *sys.argv[2:]]))
"""


@pytest.mark.long
@needs_core
def test_what_headers_of_another_version_make_works_here(tmp_path: Path) -> None:
    """One wheel serves all versions: what their headers inline must fit them all."""
    others = _other_pythons()
    if not others:
        pytest.skip("there is no other Python with headers")
    for number, other in enumerate(others):
        made = tmp_path / f"{number}.abi3.so"
        subprocess.run([other, "-c", _MAKES, made], cwd=ROOT, check=True)
        command = [sys.executable, "-c", _IN_PLACE_OF_OURS, made, __file__]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, f"{other}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
