"""``rsltrace info`` and ``rsltrace cat``, and what the command does with errors and pipes.

The texts people read are in ``golden/``. After a change that is meant, run this with
``--update-golden`` and review the difference.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import struct
import subprocess
import sys
import termios
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner, Result
from trace_maker import (
    CDR,
    START_NS,
    Feeder,
    Opened,
    boundaries,
    log_message,
    opcodes,
    uint64_message,
    write_run,
)

from rsltrace.cli.main import cli
from rsltrace.guard.pin import THREAD_VARIABLES
from rsltrace.terminal import tell, terminal_width
from rsltrace.trace.cdr import log_content
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_SEQUENCE, EventKind, OutputKind
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.phrases import table
from tests.golden_files import check_golden

GOLDEN = Path(__file__).parent / "golden"


def golden(name: str, text: str) -> None:
    """Compare ``text`` with a golden file."""
    check_golden(GOLDEN / name, text)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Feeder]:
    """A small run, not compressed so that its size does not depend on the version of zstd."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    return path, write_run(path, 40, compression="")


@pytest.fixture(scope="module")
def interrupted(run: tuple[Path, Feeder], tmp_path_factory: pytest.TempPathFactory) -> Path:
    data = run[0].read_bytes()
    offsets = boundaries(data)
    last = max(i for i, opcode in enumerate(opcodes(data, offsets)) if opcode == 0x07)
    path = tmp_path_factory.mktemp("interrupted") / "cut.mcap"
    path.write_bytes(data[: offsets[last + 1] + 5])
    return path


def call(*arguments: object) -> Result:
    try:
        runner = CliRunner(mix_stderr=False)  # click before 8.2
    except TypeError:
        runner = CliRunner()
    return runner.invoke(cli, [str(argument) for argument in arguments])


def output(*arguments: object) -> str:
    result = call(*arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def lines(*arguments: object) -> list[str]:
    return output("cat", *arguments).splitlines()


def objects(*arguments: object) -> list[dict]:
    return [json.loads(line) for line in lines("--json", *arguments)]


def indexes(*arguments: object) -> list[int]:
    found = [event["index"] for event in objects(*arguments)]
    assert [int(line.split()[0]) for line in lines(*arguments)] == found
    return found


# -- info ------------------------------------------------------------------------------------


def test_info_of_a_run(run: tuple[Path, Feeder]) -> None:
    golden("info.txt", output("info", run[0]))


def test_info_reads_the_entities_as_often_of_many_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once for each node took minutes for a trace of a few megabytes."""

    class Counted(dict[int, Entity]):
        reads = 0

        def values(self) -> Any:
            Counted.reads += 1
            return super().values()

    entities = Trace.entities.func
    counted = cached_property(lambda trace: Counted(entities(trace)))
    counted.__set_name__(Trace, "entities")
    monkeypatch.setattr(Trace, "entities", counted)
    reads = []
    for nodes in (1, 50):
        with Opened(tmp_path / f"{nodes}.mcap") as feeder:
            for number in range(nodes):
                feeder.entity(EntityKind.NODE, f"/n{number}")
            feeder.writer.close(result={"stop_reason": "nothing", "exit_code": "0"})
        Counted.reads = 0
        assert f"nodes: {nodes}\n" in output("info", tmp_path / f"{nodes}.mcap")
        reads.append(Counted.reads)
    assert reads[0] == reads[1]


def test_info_of_an_interrupted_run(interrupted: Path) -> None:
    golden("info_interrupted.txt", output("info", interrupted))


def test_info_of_a_run_without_anything(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    with Opened(path, compression="") as feeder:
        feeder.writer.close(result={})
    golden("info_empty.txt", output("info", path))


def test_info_as_json_says_the_same(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    data = json.loads(output("info", path, "--json"))
    assert data["digest"] == feeder.digest
    assert data["complete"] is True
    assert data["events"] == len(feeder.events) == sum(data["event_kinds"].values())
    assert data["outputs"] == sum(map(len, feeder.outputs)) == sum(data["output_kinds"].values())
    assert data["nodes"] == ["/talker", "/listener"]
    assert data["start_ns"] == START_NS
    assert data["duration_ns"] == data["end_ns"] - START_NS
    assert data["result"]["exit_code"] == "3"
    assert data["environment"]["ros_distro"] == "jazzy"
    entities = {(e["kind"], e["name"]): e for e in data["entities"]}
    timer = entities["timer", "tick"]
    assert timer["events"] == sum(e.kind is EventKind.TIMER for e in feeder.events)
    assert timer["rate_hz"] == 50
    assert timer["detail"] == {"period_ns": 20_000_000}
    publisher = entities["publisher", "/count"]
    assert (publisher["events"], publisher["rate_hz"]) == (0, 50)
    assert publisher["outputs"] == timer["events"]  # not counting that it was created
    assert {t["name"]: t["messages"] for t in data["topics"]}["/count"] == timer["events"]


def test_info_leaves_out_what_every_node_has_and_nobody_used(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path, compression="") as feeder:
        node = feeder.entity(EntityKind.NODE, "/n")
        for name in ("/n/get_parameters", "/n/set_parameters", "/n/my_service"):
            feeder.entity(EntityKind.SERVICE, name, node=node)
        for name in ("/rosout", "/parameter_events", "/silent"):
            feeder.entity(EntityKind.PUBLISHER, name, node=node)
        feeder.output(OutputKind.LOG, 5, b"")
        feeder.event(EventKind.SERVICE, 3, 1)  # set_parameters was called, and logged
        feeder.writer.close(result={})
    short, full = output("info", path), output("info", path, "--all")
    for text in (short, full):
        assert "entities: 7" in text
        for name in ("set_parameters", "/n/my_service", "/rosout", "/silent"):
            assert f" {name}" in text or f"/n/{name}" in text
    assert "2 unused built-in ones are hidden; --all shows them" in short
    assert "get_parameters" not in short
    assert "/parameter_events" not in short
    assert "get_parameters" in full
    assert "/parameter_events" in full
    assert len(json.loads(output("info", path, "--json"))["entities"]) == 7


def test_info_of_a_trace_that_is_checked_says_the_same() -> None:
    sample = Path(__file__).parents[2] / "sample_traces" / "schedule" / "a.mcap"
    assert output("info", sample, "--check") == output("info", sample)


def test_info_finds_an_environment_that_was_changed(
    run: tuple[Path, Feeder], tmp_path: Path
) -> None:
    path, _ = run
    changed = tmp_path / "changed.mcap"
    changed.write_bytes(path.read_bytes().replace(b"3.12.3", b"3.12.4"))
    for option in ([], ["--check"], ["--json"]):
        result = call("info", changed, *option)
        assert result.exit_code == 2
        assert re.search("(the metadata|the data section) at offset .* is damaged", result.stderr)


# -- cat -------------------------------------------------------------------------------------


def test_cat_of_a_run(run: tuple[Path, Feeder]) -> None:
    golden("cat.txt", output("cat", run[0]))


def test_cat_leaves_out_hashes_where_a_terminal_has_no_room_for_outputs(
    run: tuple[Path, Feeder], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = lines(run[0])
    both = re.search(r"  [0-9a-f]{16}  [0-9a-f]{16}(?=  )", whole[2])
    assert both is not None
    start = both.start()
    without = [line[:start] + line[start + len(both[0]) :] for line in whole]
    for columns, shown in ((119, without), (130, whole)):
        monkeypatch.setenv("COLUMNS", str(columns))
        monkeypatch.setattr("rsltrace.cli.cat.terminal_width", lambda: width_of(True))
        assert [line.split() for line in lines(run[0])] == [line.split() for line in shown]
    assert width_of(False) is None


def test_info_fits_into_a_terminal(
    run: tuple[Path, Feeder], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = output("info", run[0], "--all").splitlines()
    columns = "id node kind name type events outputs Hz code".split()
    for width, missing in ((120, []), (90, ["code"]), (80, ["type", "code"])):
        monkeypatch.setattr("rsltrace.cli.info.terminal_width", lambda width=width: width)
        shown = output("info", run[0], "--all").splitlines()
        assert [line for line in shown if len(line) > width] == []
        assert " ".join(" ".join(shown).split())[:400] == " ".join(" ".join(whole).split())[:400]
        head = next(line.split() for line in shown if line.split()[:2] == ["id", "node"])
        assert head == [name for name in columns if name not in missing]
        note = f"(no room for {', '.join(missing)}: "
        assert any(note in line for line in shown) == bool(missing)


def width_of(is_terminal: bool) -> int | None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", SimpleNamespace(isatty=lambda: is_terminal))
        return terminal_width()


def test_cat_of_an_interrupted_run_is_that_of_the_whole(
    run: tuple[Path, Feeder], interrupted: Path
) -> None:
    whole = output("cat", run[0]).splitlines()
    cut = output("cat", interrupted).splitlines()
    assert [line.split() for line in cut] == [line.split() for line in whole]


def test_of_a_trace_without_events_it_says_that_there_are_none(
    run: tuple[Path, Feeder], tmp_path: Path
) -> None:
    data = run[0].read_bytes()
    offsets = boundaries(data)
    first = opcodes(data, offsets).index(0x06)
    (tmp_path / "cut.mcap").write_bytes(data[: offsets[first]])
    assert call("cat", tmp_path / "cut.mcap").stderr.endswith("still runs): it has no events\n")


@pytest.mark.parametrize("command", ["cat", "check", "latency", "why"])
def test_what_is_read_from_a_truncated_trace_says_so(
    run: tuple[Path, Feeder], interrupted: Path, command: str
) -> None:
    more = ["/source"] if command == "why" else []
    note = f"rsltrace: note: {interrupted} is truncated (its run was killed, or still runs): it has"
    assert note in call(command, interrupted, *more).stderr
    assert "is truncated" not in call(command, run[0], *more).stderr


def test_cat_as_json(run: tuple[Path, Feeder]) -> None:
    golden("cat.jsonl", output("cat", run[0], "--json"))


def test_cat_as_json_with_payloads(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    golden("cat_payloads.jsonl", output("cat", path, "--json", "--payloads", "--from", "0.1"))
    values = [
        out["message"]["data"]
        for event in objects(path, "--payloads")
        for out in event["outputs"]
        if out["kind"] == "message"
    ]
    assert values == [int.from_bytes(data[4:], "little") for _, data in feeder.payloads[5]]


def test_json_has_every_field_of_an_event(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    for event, data in zip(feeder.events, objects(path), strict=True):
        assert data["stamp_ns"] == event.stamp_ns
        assert int(data["chain_hash"], 16) == event.chain_hash
        assert int(data["input_hash"], 16) == event.input_hash
        assert int(data["output_hash"], 16) == event.output_hash
        assert data["entity"] == event.entity
        assert data["kind"] == event.kind.label
        assert (data["cause_event"] is None) == (event.cause_event == 2**64 - 1)
        assert len(data["outputs"]) == event.outputs


def test_cat_selects_by_topic(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    on_count = [
        event.index
        for event, outputs in zip(feeder.events, feeder.outputs, strict=True)
        if event.kind is EventKind.SUBSCRIPTION
        or any(feeder.entities[out.entity].name == "/count" for out in outputs)
    ]
    assert indexes(path, "--topic", "/count") == on_count
    assert indexes(path, "--topic", "/c*t") == on_count
    both = indexes(path, "--topic", "/count", "--topic", "/check")
    assert set(both) > set(on_count)
    assert indexes(path, "--topic", "/rosout", "--kind", "subscription") == [
        event.index
        for event, outputs in zip(feeder.events, feeder.outputs, strict=True)
        if any(out.kind is OutputKind.LOG for out in outputs)
    ]


def test_cat_selects_by_node_entity_and_kind(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    talker = [e.index for e in feeder.events if e.entity in (1, 2, 3, 4, 5)]
    assert indexes(path, "--node", "/talker") == talker
    assert indexes(path, "--node", "/ta*") == talker
    timer = [e.index for e in feeder.events if e.entity == 4]
    assert indexes(path, "--entity", "tick") == indexes(path, "--entity", "4") == timer
    assert indexes(path, "--kind", "timer") == timer
    assert indexes(path, "--kind", "timer", "--node", "/listener") == []
    assert indexes(path, "--entity", "0") == [0, 1]
    assert indexes(path, "--kind", "construct", "--kind", "timer") == sorted([0, 1, *timer])


def test_cat_selects_by_time_both_ends_included(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    low, high = 10_060_000_000, 10_100_000_000
    expected = [e.index for e in feeder.events if low <= e.stamp_ns <= high]
    assert indexes(path, "--from", "0.06", "--to", "0.1") == expected
    assert indexes(path, "--from", "@10.06", "--to", "@10.1") == expected
    assert indexes(path, "--from", "60ms", "--to", "100000000ns") == expected
    assert indexes(path, "--from", "0.060000001", "--to", "0.099999999") != expected
    assert indexes(path, "--from", "1h") == []
    assert "--from is after the end of" in call("cat", path, "--from", "1h").stderr
    assert indexes(path, "--to", "@0") == []


def test_cat_limits_after_selecting(run: tuple[Path, Feeder]) -> None:
    path, _ = run
    assert indexes(path, "--limit", 3) == [0, 1, 2]
    timers = indexes(path, "--kind", "timer")
    assert indexes(path, "--kind", "timer", "--limit", 2) == timers[:2]
    assert lines(path, "--limit", 0) == []


def test_cat_selects_across_segments(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    feeder = write_run(path, 9000)
    calls = [e.index for e in feeder.events if e.kind is EventKind.CLIENT]
    assert [int(line.split()[0]) for line in lines(path, "--kind", "client")] == calls
    last = feeder.events[-1]
    assert int(lines(path, "--from", f"@{last.stamp_ns}ns")[-1].split()[0]) == last.index


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--node", "taler"], "has no node taler; did you mean '/talker'?"),
        (["--node", "/talker", "--node", "x"], "has no node x; there are /listener, /talker"),
        (["--topic", "/x"], "has no topic or service /x; "),
        (["--entity", "99"], "has no entity 99; there are "),
        (["--from", "0.1", "--to", "0.05"], "--to is before --from"),
    ],
)
def test_what_matches_nothing_is_an_error(
    run: tuple[Path, Feeder], words: list[str], said: str
) -> None:
    path, _ = run
    result = call("cat", path, *words)
    assert (result.exit_code, result.stdout) == (2, "")
    assert said in result.stderr


@pytest.mark.parametrize("name", ["localizer", "/localiser"])
def test_every_command_says_which_name_was_meant(name: str) -> None:
    folder = Path(__file__).parents[2] / "sample_traces/delayed_input"
    a, b = folder / "a.mcap", folder / "b.mcap"
    for words in (
        ["cat", a, "--node", name],
        ["diff", a, b, "--node", name],
        ["latency", a, "--from", "/odom", "--via", f"/{name}x"],
        ["cat", a, "--where", f"node /{name}x"],
    ):
        result = call(*words)
        assert result.exit_code == 2
        assert "; did you mean '/localizer'?" in result.stderr, words


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--from", "soon"], "expected a time"),
        (["--from", "-30"], "must not be negative"),
        (["--to", "1 parsec"], "unknown unit 'parsec'"),
        (["--to", "0.1234567891"], "finer than a nanosecond"),
        (["--kind", "time"], "'time' is not one of"),
        (["--payloads"], "--payloads needs --json"),
    ],
)
def test_wrong_options_are_usage_errors(
    run: tuple[Path, Feeder], options: list[str], message: str
) -> None:
    result = call("cat", run[0], *options)
    assert result.exit_code == 2
    assert re.search(message, result.stderr)
    assert "Traceback" not in result.stderr


def hostile(path: Path) -> Path:
    """A trace with names and texts that try things, and outputs whose payload is not there."""
    escape = "\x1b[31mred\x1b[0m\nsecond line\u202e\x07"
    with Opened(path) as feeder:
        node = feeder.entity(EntityKind.NODE, f"/n{escape}")
        rosout = feeder.entity(EntityKind.PUBLISHER, "/rosout", node=node)
        topic = feeder.entity(EntityKind.PUBLISHER, "/t" * 100, node=node, type_=escape)
        log = log_message(0, 30, "n", escape)
        # A schema that does not fit: the log's text cannot be shown, the event can.
        channel = feeder.writer.add_channel("/rosout", "x/msg/Bad", "nonsense[")
        feeder.output(OutputKind.LOG, rosout, log_content(log), feeder.payload(channel, 0, log))
        feeder.output(OutputKind.LOG, rosout, b"not kept")
        feeder.output(OutputKind.MESSAGE, topic, b"not kept")
        feeder.output(OutputKind.MESSAGE, 4_000_000_000, b"of nobody", NO_SEQUENCE)
        feeder.detail(OutputKind.EXCEPTION, node, 0, escape)
        feeder.detail(OutputKind.TIMER, node, 0, escape)
        feeder.detail(OutputKind.EXCEPTION, node, 0, "")
        feeder.event(EventKind.TIMER, 3_000_000_000, 1)
        feeder.writer.add_metadata("rsltrace:environment", {escape: escape, "long": "x" * 5000})
        feeder.writer.close(result={"stop_reason": escape})
    return path


def test_nothing_of_a_trace_steers_the_terminal(tmp_path: Path) -> None:
    path = hostile(tmp_path / "run.mcap")
    for arguments in (["info"], ["cat"], ["cat", "--json"], ["info", "--json"]):
        text = output(*arguments, path)
        assert not set(text) & set("\x1b\x07\u202e")
    (line,) = lines(path)
    assert r"exception \x1b[31mred\x1b[0m second line\u202e\x07" in line
    assert r"\x1b[31mred\x1b[0m\nsecond line\u202e\x07" in line
    assert "#3000000000" in line
    assert "#4000000000" in line
    assert "5000 characters; --json shows them" in output("info", path)


def test_printable_keeps_what_can_be_printed() -> None:
    assert printable("ünïcode 漢字 \\ ok") == "ünïcode 漢字 \\ ok"
    assert printable("\t\r\n\0\x9b\ud800\u2028") == r"\t\r\n\x00\x9b\ud800\u2028"


def test_tables_are_aligned_and_end_without_spaces() -> None:
    rows = [("a", "1", ""), ("bbb", "22", "x")]
    assert table(rows, right=frozenset((1,))) == ["a     1", "bbb  22  x"]
    long = "/robot" * 20
    assert table([("a", "1"), ("bbb", "2"), (long, "3")]) == ["a    1", "bbb  2", f"{long}  3"]


# -- the command -----------------------------------------------------------------------------


def rsltrace(*arguments: object, **options: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "rsltrace.cli.main", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


@pytest.mark.parametrize("command", ["info", "cat"])
def test_an_error_is_one_line_and_status_2(tmp_path: Path, command: str) -> None:
    done = rsltrace(command, tmp_path / "nothing.mcap")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == f"rsltrace: error: {tmp_path / 'nothing.mcap'} does not exist\n"


def test_help_says_what_to_do_first_and_needs_little() -> None:
    script = """
import sys
from rsltrace.cli.main import cli
try:
    cli.main(["--help"], prog_name="rsltrace")
except SystemExit:
    pass
heavy = {"rclpy", "numpy", "pydantic", "rich", "textual", "rerun", "rosbags", "ruamel", "mcap"}
print(sorted(heavy & {name.partition(".")[0] for name in sys.modules}))
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.endswith("[]\n")
    text = done.stdout
    assert text.index("rsltrace record job.yaml") < text.index("rsltrace info") < text.index("cat")
    for command in ("record", "info", "cat"):
        assert f"\n  {command} " in text


_REPORTS = ("asyncio", "pydantic", "rclpy", "rich", "rosbags", "ruamel.yaml", "textual", "jinja2")
_HEAVY = (
    "numpy",
    "ctypes",
    "json",
    "mcap",
    "rerun",
    "rsltrace.trace.format",
    "rsltrace.fast_dataclass",
)


@pytest.mark.parametrize(
    ("words", "not_needed"),
    [
        (["--help"], _HEAVY),
        (["--version"], _HEAVY),
        (
            ["info", "a.mcap"],
            (
                *("rsltrace.diff", "rsltrace.checks.conditions", "rsltrace.trace.decode"),
                *("rsltrace.replay", "rsltrace.job"),
            ),
        ),
        (
            ["cat", "a.mcap"],
            (
                *("rsltrace.diff", "rsltrace.replay", "rsltrace.trace.decode"),
                *("rsltrace.checks.conditions", "rsltrace.job"),
            ),
        ),
        (
            ["diff", "a.mcap", "a.mcap"],
            (
                *("rsltrace.diff.causes", "rsltrace.diff.traces.comparison", "rsltrace.diff.bags"),
                *(
                    "rsltrace.diff.alignment.align",
                    "rsltrace.checks.conditions",
                    "rsltrace.trace.decode",
                ),
                *("numpy", "rsltrace.trace.segments", "rsltrace.cli.output.search_progress"),
            ),
        ),
    ],
    ids=["help", "version", "info", "cat", "diff"],
)
def test_a_command_loads_nothing_that_it_does_not_need(
    tmp_path: Path, words: list[str], not_needed: tuple[str, ...]
) -> None:
    write_run(tmp_path / "a.mcap", 10)
    command = [sys.executable, "-X", "importtime", "-m", "rsltrace", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    loaded = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "rsltrace.cli.main" in loaded
    assert [name for name in (*_REPORTS, *not_needed) if name in loaded] == []


_THREADS = """
import atexit, os, sys
atexit.register(lambda: print(len(os.listdir("/proc/self/task")), "numpy" in sys.modules))
from rsltrace.cli.start import main
sys.argv = ["rsltrace", "cat", "a.mcap"]
main()
"""


def test_reading_starts_no_threads(tmp_path: Path) -> None:
    write_run(tmp_path / "a.mcap", 10)
    environment = {n: value for n, value in os.environ.items() if n not in THREAD_VARIABLES}
    done = subprocess.run(
        [sys.executable, "-c", _THREADS], cwd=tmp_path, env=environment, capture_output=True
    )
    # numpy's BLAS starts one for each core but one, if it may.
    assert done.stdout.splitlines()[-1] == b"1 True"


def test_version() -> None:
    from rsltrace import __version__

    assert rsltrace("--version").stdout == f"rsltrace {__version__}\n"


def test_an_unknown_command_is_a_usage_error() -> None:
    done = rsltrace("recrod")
    assert done.returncode == 2
    assert "recrod" in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX")
@pytest.mark.parametrize("command", ["cat", "cat --json"])
def test_head_ends_it_quietly(tmp_path: Path, command: str) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 20_000)
    shell = f"'{sys.executable}' -m rsltrace.cli.main {command} '{path}' | head -n 2; "
    done = subprocess.run(
        ["bash", "-c", shell + "echo ${PIPESTATUS[0]}"], capture_output=True, text=True, check=True
    )
    first, second, status = done.stdout.splitlines()
    assert first != second
    assert status == "141"
    assert done.stderr == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has /dev/full")
def test_output_that_cannot_be_written_is_an_error(run: tuple[Path, Feeder]) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "rsltrace.cli.main", "cat", str(run[0])],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr == "rsltrace: error: No space left on device: standard output\n"


def test_a_terminal_without_unicode_shows_escapes(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:
        node = feeder.entity(EntityKind.NODE, "/größe")
        feeder.event(EventKind.TIMER, node, 1)
        feeder.writer.close(result={})
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = rsltrace("cat", path, env=environment)
    assert done.returncode == 0, done.stderr
    assert r"/gr\xf6\xdfe" in done.stdout


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells the peak there")
def test_memory_of_cat_does_not_grow_with_the_trace(tmp_path: Path) -> None:
    script = """
import re, sys
from rsltrace.cli.main import cli
try:
    cli.main(["cat", sys.argv[1]], prog_name="rsltrace")
except SystemExit:
    pass
# Not getrusage: its maximum is inherited from the process that started this one.
print(re.search(r"VmHWM:\\s+([0-9]+) kB", open("/proc/self/status").read())[1], file=sys.stderr)
"""
    peaks = []
    for events in (10_000, 50_000):
        path = tmp_path / f"{events}.mcap"
        write_run(path, events)
        done = subprocess.run(
            [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True
        )
        assert len(done.stdout.splitlines()) >= events
        peaks.append(int(done.stderr))
    assert peaks[1] - peaks[0] < 4_000  # kB; the events alone would be 20 MB as objects


def test_payloads_that_were_not_kept_are_no_error(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:
        publisher = feeder.entity(EntityKind.PUBLISHER, "/t", node=0, type_="std_msgs/msg/UInt64")
        client = feeder.entity(EntityKind.CLIENT, "/s", node=0, type_="std_srvs/srv/Trigger")
        feeder.output(OutputKind.MESSAGE, publisher, uint64_message(1))
        feeder.output(OutputKind.REQUEST, client, CDR)
        feeder.event(EventKind.TIMER, 1, 1)
        feeder.writer.close(result={})
    (event,) = objects(path, "--payloads")
    assert [out["sequence"] for out in event["outputs"]] == [None, None]
    assert "/t, call /s" in lines(path)[0]


def test_a_table_of_long_names_has_its_columns_below_their_heads() -> None:
    names = [f"/{'long' * 20}_{number}" for number in (8, 9, 10, 11)]
    lines = table([("node", "events"), *((name, "7") for name in names)], right=frozenset((1,)))
    assert {len(line) for line in lines} == {len(names[-1]) + 2 + len("events")}


def test_notes_on_a_terminal_break_at_words_and_commands_do_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 30, 0, 0))
    with os.fdopen(theirs, "w") as screen:
        monkeypatch.setattr(sys, "stderr", screen)
        tell("rsltrace: note: an-event that is-not kept\n  rsltrace view run.mcap --at 12345678")
        tell("next: rsltrace view run.mcap --at 12345678")
    shown = b""
    with suppress(OSError):  # the other end is closed
        while data := os.read(ours, 1000):
            shown += data
    os.close(ours)
    assert shown.decode().replace("\r\n", "\n") == (
        "rsltrace: note: an-event that\nis-not kept\n"
        "  rsltrace view run.mcap --at 12345678\nnext: rsltrace view run.mcap --at 12345678\n"
    )
