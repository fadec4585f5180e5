"""Of a native run only the last seconds are kept, and written to a file when there is a reason."""

from __future__ import annotations

import ctypes
import os
import signal
import struct
import subprocess
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.adapters.processes.build import OBSERVER, find_compiler
from rsltrace.adapters.rclpy.messages.interfaces import message_type
from rsltrace.errors import SetupError
from rsltrace.job import job_from_text
from rsltrace.job.parts.record import LastSpec
from rsltrace.native import last_seconds
from rsltrace.native.last_seconds import LastSeconds, LiveChecks
from rsltrace.native.observed_entities import ObservedEntity
from rsltrace.native.processes import record_file
from rsltrace.native.processes.record_file import RecordFile, RecordKind
from rsltrace.native.span_recorder import CallbackError, CallbackSpan, EmittedLog, SentMessage
from rsltrace.trace.chain import hash64
from rsltrace.trace.contents import check_contents
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace
from tests.native.running import COMMAND, PATIENCE_S, environment, job, record, wait_until
from tests.processes.conftest import compiled

__all__ = ["compiled"]

pytestmark = [pytest.mark.ros, pytest.mark.native]

S = 10**9
CAPACITY = 1 << 20


def test_the_library_hashes_as_traces_do(tmp_path: Path) -> None:
    header = next(path for path in OBSERVER if path.name == "hash64.h")
    source = tmp_path / "hash.cpp"
    source.write_text(
        f'#include "{header}"\nextern "C" std::uint64_t hash(const std::uint8_t *data, '
        "std::size_t size) { return rsltrace::hash64(data, size); }\n"
    )
    try:
        compiler = find_compiler()
    except SetupError as error:
        pytest.skip(str(error))
    built = tmp_path / "hash.so"
    subprocess.run(
        [*compiler, "-std=c++17", "-O1", "-shared", "-fPIC", source, "-o", built], check=True
    )
    hashed = ctypes.CDLL(str(built)).hash
    hashed.restype, hashed.argtypes = ctypes.c_uint64, (ctypes.c_char_p, ctypes.c_size_t)
    data = os.urandom(5000)
    for size in (*range(260), 511, 512, 1023, 1024, 1025, 1088, 2048, 4999):
        assert hashed(data[:size], size) == hash64(data[:size]), size


# The file of a process whose oldest records are written over.


class Writing:
    """Writes as the library does (``Ring`` in observer.cpp)."""

    def __init__(self, path: Path) -> None:
        path.write_bytes(
            struct.pack("=2Q", record_file._MAGIC, CAPACITY).ljust(4096, b"\0")
            + bytes(CAPACITY + record_file._MADE_SIZE)
        )
        self.file = RecordFile(path)
        self.part = -1

    def reserve(self, size: int) -> None:
        self.file._head[record_file._RESERVED] = self.file._head[record_file._WRITTEN] + size

    def add(self, number: int, size: int) -> None:
        file = self.file
        at = file._head[record_file._WRITTEN]
        self.reserve(size)
        part = at // (CAPACITY // record_file._PARTS) % record_file._PARTS
        if part != self.part:
            file._head[record_file._STARTS + part] = at
        self.part = part
        record = struct.pack("=IIqqII", size, RecordKind.WAIT, number, 0, 7, 0).ljust(size, b"x")
        for place, byte in enumerate(record, start=at):
            file._map[4096 + place % CAPACITY] = byte
        file._head[record_file._WRITTEN] = at + size

    def numbers(self) -> list[int]:
        _, left = self.file.last()
        return [one.steady_ns for one in left]


def test_the_oldest_records_make_room_and_all_others_are_there(tmp_path: Path) -> None:
    writing = Writing(tmp_path / "7.1")
    size = 8008
    for number in range(50):
        writing.add(number, size)
    assert writing.numbers() == list(range(50))
    assert not writing.file.overwritten
    for number in range(50, 400):
        writing.add(number, size)
    found = writing.numbers()
    assert found == list(range(found[0], 400))
    assert CAPACITY - len(found) * size < 3 * size
    assert writing.file.overwritten
    writing.reserve(5 * size)  # it is killed as it writes over them
    assert writing.numbers() == list(range(found[0] + 5, 400))


# What is kept of spans, and when a file is written.


def span(start_ns: int, *outputs: Entity | SentMessage) -> CallbackSpan:
    return CallbackSpan(
        int(EventKind.TIMER), None, start_ns, 0, 1, None, end_ns=start_ns + 1, outputs=[*outputs]
    )


class Source:
    """Gives what it was given."""

    until_ns = 0

    def __init__(self) -> None:
        self.spans: list[CallbackSpan] = []

    def finished(self, patience_ns: int | None) -> list[CallbackSpan]:
        spans, self.spans = self.spans, []
        return spans


class Kept:
    """The last ten seconds, at a time that tests set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = 100 * S
        self.source = Source()
        self.reasons: list[str] = []
        monkeypatch.setattr(last_seconds, "now_ns", lambda: self.now_ns)
        spec = LastSpec(duration="10s", memory="1MiB", largest="1kB", keep_on=["/stop"])
        self.last = LastSeconds(
            spec, self.source, None, lambda name: name != "/camera", self.reasons.append
        )

    def look(self, after_ns: int, spans: Iterable[CallbackSpan] = ()) -> None:
        self.now_ns += after_ns
        self.source.spans += spans
        self.last.look()


def sent(topic: str, data: bytes = b"data") -> SentMessage:
    entity = ObservedEntity(5, 1, EntityKind.PUBLISHER, topic)
    return SentMessage(int(OutputKind.MESSAGE), entity, hash64(data), data, 1, 0, 0)


def test_old_events_go_and_the_entities_of_them_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = Kept(monkeypatch)
    node = Entity(1, 1, EntityKind.NODE, "/node", "", 0, {})
    kept.look(0, [span(kept.now_ns, node), span(kept.now_ns + 5 * S)])
    kept.look(12 * S, [span(kept.now_ns + 11 * S)])
    before, *others = kept.last.finished(None)
    assert before.outputs == [node]
    assert [one.start_ns for one in others] == [105 * S, 111 * S]
    assert kept.last.missing == []


def test_memory_is_bounded_and_it_is_said_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = Kept(monkeypatch)
    for _ in range(3000):
        kept.look(1000, [span(kept.now_ns)])
    assert 1000 < len(kept.last.finished(None)) < 2000
    assert kept.last.missing == ["of Python nodes, what was before: the memory was full"]


def test_only_the_hash_is_kept_of_what_is_large_or_not_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept = Kept(monkeypatch)
    messages = [sent("/a"), sent("/a", bytes(1001)), sent("/camera")]
    kept.look(0, [span(kept.now_ns, *messages)])
    assert [len(one.data) for one in messages] == [4, 0, 0]
    assert messages[1].digest == hash64(bytes(1001))


def test_reasons_that_come_again_and_again_give_a_file_for_each_ten_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept = Kept(monkeypatch)
    kept.look(0, [span(kept.now_ns, sent("/stop"))])
    assert kept.reasons == []  # what comes of it is to be there, too
    for _ in range(250):
        kept.look(S // 10, [span(kept.now_ns, sent("/stop"))])
    assert kept.reasons == ["a message on /stop"] * 3
    kept.last.trigger("SIGUSR1", at_once=True)
    kept.look(S)
    assert kept.reasons[-1] == "a message on /stop, SIGUSR1"
    assert len(kept.reasons) == 4


# Checks while the run goes on.


class Checked:
    """Checks in a run that began at 0, and what they say."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, checks: str) -> None:
        monkeypatch.setattr(last_seconds, "now_ns", lambda: 0)
        job = job_from_text(f"nodes: [{{node: a:B}}]\nchecks:\n{checks}", "job.yaml", ".")
        self.said: list[str] = []
        self.lacks: list[str] = []
        self.checks = LiveChecks(
            job, int, lambda name, reason: self.said.append(reason), self.lacks.append
        )

    def add(self, at_ns: int, *outputs: Any) -> None:
        self.checks.add([span(at_ns, *outputs)])

    def look(self, until_ns: int) -> list[str]:
        self.checks.look(until_ns)
        said, self.said[:] = [*self.said], []
        return said


def number(value: int) -> SentMessage:
    from std_msgs.msg import UInt64

    message = sent("/n", bytes.fromhex("00010000") + value.to_bytes(8, "little"))
    message.entity.sends = message_type(UInt64)
    return message


def test_checks_say_what_is_wrong_in_the_order_of_time(monkeypatch: pytest.MonkeyPatch) -> None:
    checked = Checked(
        monkeypatch,
        "- {name: small, always: /n.data < 5}\n- never: exception ValueError\n"
        "- {never: log warn, after: /n.data == 2, within: 2s}\n"
        "- {name: three, eventually: /n.data == 3, after: /n.data == 2, within: 3s}\n",
    )
    assert checked.checks.later == []
    log = EmittedLog(number(0).entity, 30, "a", "so bad", "", "", 0)
    checked.add(4 * S, log)
    checked.add(1 * S, log)
    checked.add(2 * S, CallbackError("KeyError", "'x'", ""), number(7))
    checked.add(3 * S, number(2))
    assert checked.look(2 * S) == []
    assert checked.look(5 * S) == [
        "check small: not /n.data < 5 (data = 7)",
        "check never log warn within 2 s after /n.data == 2: log 'so bad'",
    ]
    checked.add(5 * S, CallbackError("ValueError", "of it", ""))
    assert checked.look(7 * S) == [
        "check never exception ValueError: raised ValueError: of it",
        "check three: it does not happen within 3 s",
    ]
    assert checked.look(9 * S) == checked.lacks == []
    assert checked.checks.failed["small"] == 1


def test_a_topic_that_stops_is_too_slow_once(monkeypatch: pytest.MonkeyPatch) -> None:
    checked = Checked(monkeypatch, "- {rate: /n, at_least: 2 Hz}\n")
    for tenth in range(20, 50):
        checked.add(tenth * S // 10, number(1))
        assert checked.look(tenth * S // 10 + 1) == []
    assert checked.look(59 * S // 10) == [
        "check rate /n at least 2 Hz: 1 messages from here to 5.800000000 s: 1 Hz, at least 2 Hz"
    ]
    assert len(checked.look(70 * S // 10)) == 1
    assert checked.look(99 * S) == []


def test_what_cannot_be_judged_is_said_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    checked = Checked(
        monkeypatch,
        "- always: /n.data < 5\n- eventually: /n\n- never: finding clock\n- function: m:f\n"
        "- latency: {from: /n, to: /m, below: 1s}\n",
    )
    assert checked.checks.later == [
        "eventually /n: it has no 'within'",
        "never finding clock: it is not about messages of one topic, log records or exceptions",
        "function m:f: it is about the whole run",
        "latency of /n → /m below 1 s: it is about the whole run",
    ]
    message = number(1)
    message.data = b""
    checked.add(0, message)
    checked.add(1, number(9))
    assert checked.look(S) == []
    assert checked.lacks == [
        "check always /n.data < 5 is not judged any more: a message on /n is too large, or of an "
        "unknown type"
    ]


# As a user has it.


@pytest.mark.long
def test_a_check_that_fails_writes_a_file(tmp_path: Path, compiled: Callable[[str], Path]) -> None:
    """Of a program whose messages are not kept, and of a Python node."""
    text = f"""
nodes:
  - {{node: robot:Talker}}
  - {{program: {compiled("counter.c")}, arguments: ['100']}}
record: {{last: 10s, exclude: [/count, /numbers]}}
checks:
  - {{CHECK}}
stop: {{duration: 300s}}
"""
    for number, (check, reason) in enumerate(
        (
            ("{name: few, always: /count.data < 7}", "check few: not /count.data < 7 (data = 7)"),
            ("{never: /numbers.data == 9}", "check never /numbers.data == 9: /numbers.data == 9"),
        )
    ):
        path = job(tmp_path, text.replace("{CHECK}", check))
        process = subprocess.Popen(
            [*COMMAND, "record", "--native", str(path), "-o", f"{number}.mcap"],
            cwd=tmp_path,
            env=environment(tmp_path),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        try:
            kept = tmp_path / f"{number}-1.mcap"
            wait_until(kept.exists, process)
            process.send_signal(signal.SIGINT)
            process.wait(timeout=PATIENCE_S)
        finally:
            process.kill()
            process.wait()
        with Trace.open(kept) as trace:
            assert trace.result["stop_reason"].startswith(f"kept: {reason}")


@pytest.mark.long
def test_a_killed_program_a_signal_and_the_end_write_files(
    tmp_path: Path, compiled: Callable[[str], Path]
) -> None:
    text = f"""
nodes:
  - {{node: robot:Talker}}
  - program: {compiled("counter.c")}
    arguments: ['10', kill]
    on_exception: log
    start_after: {{started: robot:Talker, delay: 1s}}  # there is a file soon after its end
  - {{program: {compiled("../native/counting.c")}, arguments: [b, "200000", "10"], name: b}}
record: {{last: 25s}}
"""
    process = subprocess.Popen(
        [*COMMAND, "record", "--native", str(job(tmp_path, text)), "-o", "run.mcap"],
        cwd=tmp_path,
        env=environment(tmp_path),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        wait_until((tmp_path / "run-1.mcap").exists, process)
        time.sleep(25.5)  # more than what is kept, and a machine may stand still
        process.send_signal(signal.SIGUSR1)
        wait_until((tmp_path / "run-2.mcap").exists, process)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130, said
    reasons = []
    for name in ("run-1", "run-2", "run"):
        with Trace.open(tmp_path / f"{name}.mcap") as trace:
            trace.check()
            check_contents(trace)
            reasons.append(trace.result["stop_reason"])
            assert {"/numbers", "/b", "/talker0"} <= {one.name for one in trace.entities.values()}
            counts = [trace.decode("/count", data).data for _, _, data in trace.messages("/count")]  # type: ignore[attr-defined]
            assert counts == ([1, 2, 3, 4, 5] if name == "run-1" else [])
            missing = trace.result.get("missing", "")
            assert bool(missing) == (name == "run-1"), (name, missing, said)
    assert reasons[0].startswith("kept: ")
    assert "was killed by SIGKILL" in reasons[0]
    assert reasons[1:] == ["kept: SIGUSR1", "interrupted"]


@pytest.mark.long
def test_what_would_have_to_be_looked_at_is_refused(tmp_path: Path) -> None:
    for more, said in (
        ("stop: {events: 9}", "end it by a time"),
        ("stop: {duration: 1s}", "start_after takes only"),
    ):
        text = f"""
nodes:
  - {{node: robot:Talker}}
  - {{node: robot:Listener, start_after: {{topic: /same}}}}
record: {{last: 1s}}
{more}
"""
        done = record(tmp_path, text)
        assert (done.returncode, said in done.stderr) == (2, True), done.stderr
