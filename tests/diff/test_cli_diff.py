"""``rsltrace diff`` as it is called: exit statuses, formats, options, bad input."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from rsltrace.cli.main import cli
from rsltrace.trace.index import metadata_checksum

SAMPLES = Path(__file__).parent.parent.parent / "sample_traces"
PAIR = SAMPLES / "nondeterministic_callback"
A, B = PAIR / "a.mcap", PAIR / "b.mcap"

Done = subprocess.CompletedProcess[str]


@pytest.fixture
def diff(command: Callable[..., Done]) -> Callable[..., Done]:
    """Run ``rsltrace diff`` in this process; what only a process shows, tests below ask one."""
    return partial(command, "diff")


def test_the_exit_status_is_that_of_the_process(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    for other, status in ((A, 0), (B, 1), ("notes.txt", 2)):
        command = [sys.executable, "-m", "rsltrace", "diff", str(A), str(other)]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == status
        assert bool(done.stderr) == (status == 2)


def test_exit_status_0_for_identical_runs(diff: Callable[..., Done]) -> None:
    done = diff(A, A)
    assert (done.returncode, done.stderr) == (0, "")
    assert "identical" in done.stdout.splitlines()[0]


def test_exit_status_1_for_runs_that_part(diff: Callable[..., Done]) -> None:
    done = diff(A, B)
    assert (done.returncode, done.stderr) == (1, "")
    assert "received the same input" in done.stdout
    assert "\x1b" not in done.stdout


def test_a_tolerance_never_makes_traces_identical(diff: Callable[..., Done]) -> None:
    done = diff(A, B, "--abs", "*=1e-9")
    assert done.returncode == 3
    assert "equal within tolerance, not identical: the digests differ" in done.stdout
    assert json.loads(diff(A, B, "--abs", "*=1e-9", "--format", "json").stdout)["within_tolerance"]
    done = diff(A, B, "--abs", "*=1e-30")
    assert done.returncode == 1
    assert "equal within" not in done.stdout
    assert diff(A, A, "--abs", "*=1e-9").returncode == 0
    assert diff(A, A, B, "--abs", "*=1e-9").returncode == 3


def test_tolerance_at_the_divergence_is_not_enough(diff: Callable[..., Done]) -> None:
    done = diff(A, B, "--abs", "/push:*=1e-9")
    assert done.returncode == 1
    assert "not within tolerance: the messages first diverge on /cmd_vel" in done.stdout
    other = SAMPLES / "missing_event"
    done = diff(other / "a.mcap", other / "b.mcap", "--abs", "*=1e9", "--ignore", "*")
    assert done.returncode == 1, "an event that is missing is covered by nothing"
    assert "tolera" not in done.stdout


def test_formats(diff: Callable[..., Done], tmp_path: Path) -> None:
    content = json.loads(diff(A, B, "--format", "json").stdout)
    assert (content["kind"], content["exit_code"]) == ("traces", 1)
    assert diff(A, B, "--format", "markdown").stdout.startswith("### rsltrace: the runs diverge")
    ElementTree.fromstring(diff(A, B, "--format", "junit").stdout)
    assert diff(A, B, "--format", "github").stdout.startswith("::error file=")
    done = diff(A, B, "--format", "junit", "-o", "report.xml")
    assert done.returncode == 1
    assert len(done.stdout.splitlines()) == 1
    ElementTree.fromstring((tmp_path / "report.xml").read_text(encoding="utf-8"))


def test_output_that_cannot_be_written(diff: Callable[..., Done]) -> None:
    done = diff(A, B, "-o", "nowhere/report.txt")
    assert done.returncode == 2
    assert done.stderr.startswith("rsltrace: error: ")
    assert "nowhere/report.txt" in done.stderr


def test_fields_and_context(diff: Callable[..., Done]) -> None:
    ignored = diff(A, B, "--ignore", "x")
    assert "0.19956" not in ignored.stdout
    assert ignored.returncode == 1
    short = diff(A, B, "--context", "0").stdout
    assert "before it (" not in short
    assert "  62  " in diff(A, B, "--context", "2").stdout
    assert "  60  " not in diff(A, B, "--context", "1").stdout


def test_several_runs_make_a_table(diff: Callable[..., Done]) -> None:
    done = diff(A, A, B)
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert lines[0] == f"1 of 2 runs diverges from {A}."
    assert lines[2].split() == ["run", "verdict", "event", "time", "where"]
    assert lines[3].split()[:2] == [str(A), "identical"]
    row = f"{B} same-input-different-output 64 2.100000000 /obstacle_filter: subscription /scan"
    assert lines[4].split() == row.split()
    assert diff(A, A, A).returncode == 0
    assert json.loads(diff(A, A, B, "--format", "json").stdout)["kind"] == "several"


def test_one_unreadable_run_does_not_hide_the_others(
    diff: Callable[..., Done], tmp_path: Path
) -> None:
    done = diff(A, "gone.mcap", B)
    assert done.returncode == 2
    assert "rsltrace: error: gone.mcap does not exist" in done.stderr
    assert "same-input-different-output" in done.stdout


def test_a_trace_that_cannot_be_compared_is_an_error_for_ci(
    diff: Callable[..., Done], command: Callable[..., Done], tmp_path: Path
) -> None:
    """A file that is missing, or cut before its first event, is trouble and no regression."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(A.read_bytes()[:3500])
    done = diff(A, cut)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"{cut} is truncated before its first event" in done.stderr
    facts = command("info", cut).stdout
    assert "digest     none: the file is cut before its first event" in facts
    assert json.loads(command("info", cut, "--json").stdout)["digest"] is None
    for other in (cut, "gone.mcap"):
        done = diff(A, other, "--format", "junit")
        assert done.returncode == 2
        suite = ElementTree.fromstring(done.stdout)
        assert (suite.get("errors"), suite.get("failures")) == ("1", "0")
        error = suite.find(".//testcase/error")
        assert error is not None
        assert str(other) in error.get("message", "")
        done = diff(A, other, "--format", "github", "-o", tmp_path / "report")
        assert done.returncode == 2
        assert (tmp_path / "report").read_text().startswith("::error title=rsltrace%3A cannot ")
    several = ElementTree.fromstring(diff(A, A, "gone.mcap", "--format", "junit").stdout)
    assert (several.get("tests"), several.get("errors")) == ("2", "1")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((A,), "Missing argument 'B...'"),
        ((A, B, "--abs", "x"), "'x' is not FIELD=TOL"),
        ((A, B, "--abs", "x=much"), "'x=much' is not FIELD=TOL"),
        ((A, B, "--rel", "x=-1"), "the tolerance -1.0 of x is not a number of 0 or more"),
        ((A, B, "--by", "stamp"), "--by needs a recording"),
        ((A, B, "--format", "yaml"), "'yaml' is not one of"),
        ((A, "gone.mcap"), "gone.mcap does not exist"),
    ],
)
def test_wrong_usage_is_trouble(
    diff: Callable[..., Done], arguments: tuple[object, ...], message: str
) -> None:
    done = diff(*arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stdout == ""


def test_a_file_that_is_neither_trace_nor_recording(
    diff: Callable[..., Done], tmp_path: Path
) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty.mcap").write_bytes(b"")
    for name, message in (("notes.txt", "not MCAP"), ("empty.mcap", "is empty")):
        for arguments in ((A, name), (name, A)):
            done = diff(*arguments)
            assert done.returncode == 2
            assert message in done.stderr
            assert "Traceback" not in done.stderr


def test_another_format_version_is_named(diff: Callable[..., Done], tmp_path: Path) -> None:
    data = A.read_bytes()
    name = "rsltrace:format"
    with A.open("rb") as file:
        (found,) = [one for one in make_reader(file).iter_metadata() if one.name == name]
    mapping = {key: value for key, value in found.metadata.items() if key != "checksum"}
    newer = metadata_checksum(name, {**mapping, "version": "9"})
    version = struct.pack("<I", len("version")) + b"version" + struct.pack("<I", 1)
    for old, new in (
        (version + b"1", version + b"9"),
        (found.metadata["checksum"].encode(), newer.encode()),
    ):
        assert data.count(old) == 1
        data = data.replace(old, new)
    # cut off, so that the summary (with its checksum) does not matter
    (tmp_path / "new.mcap").write_bytes(data[:-100])
    done = diff(A, "new.mcap")
    assert done.returncode == 2
    assert "has trace format 9, this rsltrace reads 1" in done.stderr


def test_a_truncated_trace_is_said_and_compared(diff: Callable[..., Done], tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(A.read_bytes()[:-300])
    done = diff(A, "cut.mcap")
    assert done.returncode in (0, 1)
    assert "cut.mcap" in done.stdout
    assert "interrupted" in done.stdout
    assert diff("cut.mcap", B).returncode == 1


def test_a_corrupted_chunk_is_named(diff: Callable[..., Done], tmp_path: Path) -> None:
    from rsltrace.trace.reader import Trace

    with Trace.open(A) as trace:
        row = trace.segments[0]
        middle = int(row["events_offset"]) + int(row["events_length"]) // 2
    data = bytearray(B.read_bytes())
    data[middle] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    done = diff(A, "bad.mcap")
    assert done.returncode == 2
    assert "bad.mcap" in done.stderr
    assert "chunk" in done.stderr
    assert "Traceback" not in done.stderr


def test_check_finds_damage_where_a_diff_does_not_look(
    diff: Callable[..., Done], tmp_path: Path
) -> None:
    """Runs of the same digest are not read; who wants to know more says --check."""
    data = bytearray(A.read_bytes())
    data[len(data) // 2] ^= 0x10
    (tmp_path / "bad.mcap").write_bytes(data)
    assert diff(A, "bad.mcap").returncode == 0
    for arguments in ((A, "bad.mcap"), ("bad.mcap", A), (A, A, "bad.mcap")):
        done = diff(*arguments, "--check")
        assert done.returncode == 2
        assert "bad.mcap" in done.stderr
        assert "damaged" in done.stderr
    assert diff(A, B, "--check").returncode == 1
    assert diff(A, A, "--check").returncode == 0


def test_traces_of_different_jobs_are_said_first_and_compared(diff: Callable[..., Done]) -> None:
    done = diff(A, SAMPLES / "missing_event" / "a.mcap")
    assert done.returncode == 1
    assert done.stdout.startswith("These are runs of different jobs without a common node: ")
    assert "entity" in done.stdout, "and then compared"


def bag_of(trace: Path, path: Path, storage: str, drop: int = -1) -> Path:
    """Copy a trace's messages into a native recording."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from rsltrace.trace.reader import Trace

    store = get_typestore(Stores.ROS2_JAZZY)
    with (
        Trace.open(trace) as opened,
        Writer(path, version=9, storage_plugin=StoragePlugin[storage]) as writer,
    ):
        for channel in opened.channels.values():
            if not channel.topic.startswith("/rsltrace/"):
                connection = writer.add_connection(channel.topic, channel.type, typestore=store)
                for number, (stamp_ns, _, data) in enumerate(opened.messages(channel.topic)):
                    if number != drop:
                        writer.write(connection, stamp_ns + 10**18, data)
    return path


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
def test_a_trace_and_a_recording(diff: Callable[..., Done], tmp_path: Path, storage: str) -> None:
    bag = bag_of(A, tmp_path / "bag", storage)
    done = diff(A, bag)
    assert (done.returncode, done.stderr) == (0, "")
    assert "The recordings are equal" in done.stdout
    done = diff(B, bag, "--format", "json")
    content = json.loads(done.stdout)
    assert (done.returncode, content["kind"], content["verdict"]) == (1, "bags", "different")
    assert content["first"]["topic"] == "/push"
    assert [one["path"] for one in content["first"]["fields"]] == ["x"]
    done = diff(B, bag, "--abs", "*=1e-9")
    assert done.returncode == 3
    assert "equal within tolerance, not identical" in done.stdout
    dropped = bag_of(A, tmp_path / "dropped", storage, drop=10)
    done = diff(bag, dropped, "--topic", "/scan")
    assert done.returncode == 1
    assert "message 10 of a is missing in b" in " ".join(done.stdout.split())
    done = diff(bag, dropped, "--by", "stamp", "--topic", "/scan")
    assert "matched by stamp" in done.stdout
    assert diff(bag, dropped, "--node", "/x").returncode == 2


def test_recordings_that_cannot_be_read(diff: Callable[..., Done], tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    done = diff(A, "folder")
    assert done.returncode == 2
    assert "metadata.yaml" in done.stderr
    from mcap.writer import Writer

    with (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1", library="somebody")
        writer.finish()
    done = diff(A, "other.mcap")
    assert done.returncode == 2
    assert "profile" in done.stderr


def on_terminal(arguments: list[str], **environment: str) -> str:
    """Run a command with a terminal as its output, and return what it showed."""
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "rsltrace", *arguments],
        stdout=slave,
        env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "90", "LINES": "40", **environment},
    )
    os.close(slave)
    shown = b""
    while True:
        ready, _, _ = select.select([master], [], [], 240)
        try:
            piece = os.read(master, 65536) if ready else b""
        except OSError:
            break
        if not piece:
            break
        shown += piece
    os.close(master)
    process.wait(timeout=300)
    return shown.decode()


@pytest.mark.long
def test_colour_on_a_terminal_only() -> None:
    shown = on_terminal(["diff", str(A), str(B)])
    assert "\x1b[1;31m" in shown
    plain = on_terminal(["diff", str(A), str(B)], NO_COLOR="1")
    assert "\x1b[1;31m" not in plain
    lines = re.sub(r"\x1b\[[0-9;]*m|\r", "", plain).splitlines()
    assert len(lines) <= 40
    assert max(len(line) for line in lines if not line.startswith(("  a ", "  b ", "next"))) <= 90


@pytest.mark.few(1)
@pytest.mark.parametrize("sample", sorted(p.parent.name for p in SAMPLES.glob("*/a.mcap")))
def test_a_small_terminal_is_enough(sample: str) -> None:
    pair = [str(SAMPLES / sample / f"{name}.mcap") for name in "ab"]
    shown = on_terminal(["diff", *pair], NO_COLOR="1", COLUMNS="80", LINES="24")
    lines = re.sub(r"\x1b\[[0-9;]*m|\r", "", shown).splitlines()
    assert all(len(row) <= 80 for row in lines if not row.startswith("next: ")), lines
    text = "\n".join(lines)
    for needed in ("verdict: ", "cause: ", "next: rsltrace "):
        assert needed in text
    folded = ["", *lines]  # the command that was typed
    assert sum(max(len(row) - 1, 0) // 80 + 1 for row in folded) <= 24 - 1  # and the prompt
    assert not re.search(r"… 1 more", text)  # it would take no more room to say it


def test_a_terminal_without_unicode(diff: Callable[..., Done]) -> None:
    done = diff(A, B, charset="ascii")
    assert done.stdout.isascii()
    assert "\\u" not in done.stdout
    assert "`- 64 /obstacle_filter" in done.stdout


def test_a_diff_of_two_traces_loads_no_more_than_it_needs(tmp_path: Path) -> None:
    probe = (
        "import sys, contextlib\n"
        f"sys.argv = ['rsltrace', 'diff', {str(A)!r}, {{}}]\n"
        "from rsltrace.cli.main import main\n"
        "with contextlib.suppress(SystemExit):\n    main()\n"
        "heavy = ('rclpy', 'pydantic', 'ruamel', 'rich', 'rosbags', 'fsspec')\n"
        "print(*[name for name in heavy if name in sys.modules])"
    )
    for other, allowed in ((A, set()), (B, {"rosbags"})):
        done = subprocess.run(
            [sys.executable, "-c", probe.format(repr(str(other)))],
            capture_output=True,
            text=True,
            check=True,
        )
        assert set(done.stdout.splitlines()[-1].split()) <= allowed


def test_the_command_is_listed_and_explained() -> None:
    for arguments, text in ((["--help"], "diff "), (["diff", "--help"], "--abs FIELD=TOL")):
        done = subprocess.run(
            [sys.executable, "-m", "rsltrace", *arguments],
            capture_output=True,
            text=True,
            check=True,
        )
        assert text in done.stdout


def test_nothing_is_written_beside_the_traces(diff: Callable[..., Done], tmp_path: Path) -> None:
    for name, source in (("a.mcap", A), ("b.mcap", B)):
        shutil.copy(source, tmp_path / name)
    before = sorted(tmp_path.iterdir())
    diff("a.mcap", "b.mcap", "--all")
    assert sorted(tmp_path.iterdir()) == before


def test_a_bug_is_trouble_and_not_a_divergence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import rsltrace.diff.traces.diff

    def broken(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(rsltrace.diff.traces.diff, "diff_traces", broken)
    result = CliRunner().invoke(cli, ["diff", str(A), str(B)])
    assert result.exit_code == 2
    assert "ZeroDivisionError: a bug" in result.output + capsys.readouterr().err
