"""Where processes run, that they start again, that a run may end with one, and what their callbacks
are called."""

from __future__ import annotations

import struct
import sysconfig
from collections.abc import Callable
from pathlib import Path

import pytest

from rsltrace.checks.conditions.trace_events import TraceCondition
from rsltrace.checks.evaluate import evaluate_checks
from rsltrace.diff.why.answer import why
from rsltrace.errors import ConditionError, JobError, TraceError
from rsltrace.job import job_from_text, load_job
from rsltrace.run import RunResult, run
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

Compiled = Callable[[str], Path]


def _run(folder: Path, program: Path, entry: str, name: str = "t.mcap") -> RunResult:
    text = f"nodes:\n  - program: {program}\n{entry}\nstop: {{duration: 2s}}\n"
    (folder / "job.yaml").write_text(text)
    return run(load_job(folder / "job.yaml"), folder / name)


def _counts(path: Path) -> list[tuple[int, int]]:
    """Return when (ms) which number was published."""
    with Trace.open(path) as trace:
        said = trace.messages("/count")
        return [(stamp // 1_000_000, struct.unpack("<Q", data[-8:])[0]) for stamp, _, data in said]


_LIBPYTHON = Path(*map(str, sysconfig.get_config_vars("LIBDIR", "LDLIBRARY")))


@pytest.mark.skipif(
    not sysconfig.get_config_var("Py_ENABLE_SHARED"), reason="needs a libpython of its own"
)
def test_a_process_may_load_python_late(compiled: Compiled, tmp_path: Path) -> None:
    """Python then finds the symbols that stand in for its own first."""
    entry = f"    environment: {{LATE_PYTHON: {_LIBPYTHON}}}"
    assert _run(tmp_path, compiled("counter.c"), entry).error is None


def test_a_process_has_an_environment_and_a_folder_of_its_own(
    compiled: Compiled, tmp_path: Path
) -> None:
    (tmp_path / "place").mkdir()
    (tmp_path / "place" / "more").write_text("7")
    entry = "    arguments: ['1000']\n    environment: {COUNT_FROM: 30}\n"
    entry += "    working_directory: place"
    assert _run(tmp_path, compiled("counter.c"), entry).error is None
    assert _counts(tmp_path / "t.mcap") == [(1000, 38), (2000, 39)]
    with pytest.raises(JobError, match="there is no folder nowhere to run in"):
        _run(tmp_path, compiled("counter.c"), "    working_directory: nowhere")


@pytest.mark.few(1)
@pytest.mark.parametrize(("action", "failed"), [("leave", False), ("crash", True)])
def test_a_process_starts_again_as_often_as_it_may(
    compiled: Compiled, tmp_path: Path, action: str, failed: bool
) -> None:
    """It has ended at 0.5 s, and begins again 0.25 s later; the second time nothing follows."""
    entry = f"    arguments: ['100', {action}]\n    respawn: {{delay: 250ms, times: 1}}"
    results = [_run(tmp_path, compiled("counter.c"), entry, f"{n}.mcap") for n in range(2)]
    assert results[0].digest == results[1].digest
    assert (results[0].error, results[0].exit_code) == (None, int(failed))
    counted = [100, 200, 300, 400, 500, 850, 950, 1050, 1150, 1250]
    numbers = [1, 2, 3, 4, 5] * 2
    assert _counts(tmp_path / "0.mcap") == list(zip(counted, numbers, strict=True))
    with Trace.open(tmp_path / "0.mcap") as trace:
        events = [trace.event(index) for index in range(trace.event_count)]
        starts = [event for event in events if event.kind is EventKind.CONSTRUCT]
        assert [event.stamp_ns for event in starts] == [0, 750_000_000]
        assert len({event.entity for event in starts}) == 2


def test_a_process_that_ends_at_once_starts_again(compiled: Compiled, tmp_path: Path) -> None:
    entry = "    arguments: [-c, 'echo again >> said']\n    respawn: {delay: 250ms, times: 2}"
    entry += "\n    working_directory: ."
    result = _run(tmp_path, Path("/bin/sh"), entry)
    assert (result.error, result.exit_code) == (None, 0)
    assert (tmp_path / "said").read_text() == "again\n" * 3


def test_a_run_ends_with_a_process_that_it_requires(compiled: Compiled, tmp_path: Path) -> None:
    entry = "    arguments: ['100', leave]\n    name: driver\n    required: true"
    result = _run(tmp_path, compiled("counter.c"), entry)
    assert (result.error, result.exit_code, result.end_ns) == (None, 0, 500_000_000)
    assert result.stop_reason.endswith("driver has ended, which the run requires")
    entry = entry.replace("leave", "exit") + "\n    on_exception: log"
    assert _run(tmp_path, compiled("counter.c"), entry, "u.mcap").exit_code == 1


def test_callbacks_have_the_names_that_rclcpp_tells_its_tracepoints(
    compiled: Compiled, tmp_path: Path
) -> None:
    entry = "    arguments: ['1000']\n    environment: {NAMED: 1}"
    assert _run(tmp_path, compiled("counter.c"), entry).error is None
    with Trace.open(tmp_path / "t.mcap") as trace:
        found = list(trace.entities.values())
    nodes = {entity.name: entity.id for entity in found if entity.kind is EntityKind.NODE}
    (timer,) = [entity for entity in found if entity.kind is EntityKind.TIMER]
    assert (timer.name, timer.node) == ("Counter::tick()", nodes["/counter"])  # not the last one
    (echo,) = [e for e in found if e.kind is EntityKind.SUBSCRIPTION]
    assert echo.detail["callback"] == "Counter::echo(UInt64)"


@pytest.mark.parametrize(("action", "notes"), [("intra", 1), ("both", 0)])
def test_topics_whose_messages_do_not_leave_a_process_are_named(
    compiled: Compiled, tmp_path: Path, action: str, notes: int
) -> None:
    result = _run(tmp_path, compiled("counter.c"), f"    arguments: ['100', {action}]")
    unseen = [note for note in result.notes if "messages on /count stay in process" in note]
    assert (result.error, len(unseen)) == (None, notes)
    assert bool(_counts(tmp_path / "t.mcap")) is not bool(notes)


def test_a_rule_for_a_topic_whose_messages_do_not_leave_a_process_is_refused(
    compiled: Compiled, tmp_path: Path
) -> None:
    node = f"{{program: {compiled('counter.c')}, arguments: ['100', intra]}}"
    (tmp_path / "job.yaml").write_text(f"nodes: [{node}]\nstop: {{topic: /count, duration: 1s}}\n")
    result = run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap")
    assert "intra-process communication, switch that off; a rule of the job goes by /count" in str(
        result.error
    )


def test_what_is_asked_of_a_topic_whose_messages_do_not_leave_a_process_is_refused(
    compiled: Compiled, tmp_path: Path
) -> None:
    _run(
        tmp_path,
        compiled("counter.c"),
        "    arguments: ['100', intra]\n    remappings: {echo: count}",
    )
    job = tmp_path / "checks.yaml"
    job.write_text("checks: [{rate: /count, at_least: 1}]\nnodes: [{node: a:B}]\n")
    with Trace.open(tmp_path / "t.mcap") as trace:
        asked = job_from_text(job.read_text(), "checks.yaml", str(tmp_path))
        with pytest.raises(JobError, match=r"/count stay in process .*counter and are"):
            evaluate_checks(trace, asked)
        with pytest.raises(ConditionError, match=r"/count stay in process .*counter"):
            TraceCondition("topic /count", trace)
        with pytest.raises(TraceError, match="cannot tell: messages on /count stay in process"):
            why(trace, "/counter", "/count")


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("node: a:B\n    respawn: 1s", "only a process is started again"),
        ("main: a:b\n    working_directory: x", "only a process has a folder of its own"),
        ("node: a:B\n    required: true", "a 'node' lasts as long as the run"),
        ("program: x\n    container: /c", "only a 'component' has 'container:'"),
        ("component: p/n::C", "say which 'container:' loads the component"),
        ("component: p/n::C\n    container: c", "from '/': write '/c'"),
        ("component: p\n    container: /c", "expected package/plugin"),
        ("component: p/n::C\n    container: /c\n    arguments: [x]", "a component takes 'param"),
        ("program: x\n    respawn: {times: 0}", "must be at least 1"),
        ("node: a:B\n    instant_sleep: true", "only a process can sleep in no time"),
    ],
)
def test_entries_that_make_no_sense_are_refused(tmp_path: Path, entry: str, expected: str) -> None:
    (tmp_path / "x").write_text("")
    (tmp_path / "job.yaml").write_text(f"nodes:\n  - {entry}\n")
    with pytest.raises(JobError, match=expected):
        load_job(tmp_path / "job.yaml")


def test_a_process_crashes_and_starts_again_where_the_job_says(
    compiled: Compiled, tmp_path: Path
) -> None:
    def counted(fault: str) -> list[tuple[int, int]]:
        entry = f"    arguments: ['100']\nfaults: [{fault}]"
        result = _run(
            tmp_path, compiled("counter.c"), entry, f"{len(list(tmp_path.iterdir()))}.mcap"
        )
        assert (result.error, result.exit_code) == (None, 0)
        assert result.path is not None
        return _counts(result.path)

    crash = counted("{crash: /counter, at: 350ms}")
    assert crash == [(100, 1), (200, 2), (300, 3)]
    again = counted("{restart: /counter, at: 350ms, for: 50ms}")
    assert again[:5] == [*crash, (500, 1), (600, 2)]
    entry = "    arguments: ['100']\nfaults: [{hang: /counter, at: 350ms}]"
    result = _run(tmp_path, compiled("counter.c"), entry, "hang.mcap")
    assert "job.yaml:4:10: /counter cannot hang: it is in a process of its own" in str(result.error)


def test_the_library_of_a_message_that_was_looked_for_is_named(
    tmp_path: Path, compiled: Callable[[str], Path], capfd: pytest.CaptureFixture[str]
) -> None:
    assert _run(tmp_path, compiled("no_typesupport.c"), "").exit_code == 3
    said = capfd.readouterr().err
    assert "has no type support for Fast DDS: Could not load library libnosuch_msgs__" in said
    assert "source the workspace that has its package. LD_LIBRARY_PATH is " in said
    assert "truncated" not in said
