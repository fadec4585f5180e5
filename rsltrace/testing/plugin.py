"""The pytest plugin: fixtures ``rsltrace_golden`` and ``rsltrace_node``, ``--rsltrace-update``,
``--rsltrace-history``.

Loaded in every pytest run of every environment with rsltrace in it, so it imports nothing heavy.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import pytest

from rsltrace.testing.golden import GoldenSession

if TYPE_CHECKING:
    from rsltrace.diff.options import DiffOptions
    from rsltrace.job import Job
    from rsltrace.replay.one_node.result import NodeReplayResult
    from rsltrace.run import RunResult

_PROPERTY = "rsltrace_golden_written"
_INTERNAL = ("_pytest.", "pluggy.")
_NOT_IN_NAME = re.compile(r"[^A-Za-z0-9_.-]+")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--rsltrace-update`` and ``--rsltrace-history``."""
    group = parser.getgroup("rsltrace")
    group.addoption(
        "--rsltrace-update",
        action="store_true",
        help="write the golden traces of rsltrace anew instead of comparing with them",
    )
    what = "append a line on each comparison with a golden trace to this file, folder or address"
    group.addoption("--rsltrace-history", metavar="PLACE", help=f"{what} (see rsltrace history)")
    parser.addini("rsltrace_history", what, default="")


def pytest_configure(config: pytest.Config) -> None:
    """Let tests without the fixture know of the options, too."""
    GoldenSession.update = bool(config.getoption("--rsltrace-update"))
    given = config.getoption("--rsltrace-history") or os.environ.get("RSLTRACE_HISTORY")
    place = given or str(config.getini("rsltrace_history"))
    if place and "://" not in place:  # tests may change the working directory
        place = os.path.join(Path.cwd() if given else config.rootpath, place)
    GoldenSession.history = place


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Begin to note which golden traces a test writes."""
    del item
    GoldenSession.written.clear()


def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Put those into its report, which xdist sends on."""
    item.user_properties += [(_PROPERTY, os.path.abspath(path)) for path in GoldenSession.written]


class GoldenFixture:
    """What the fixture ``rsltrace_golden`` gives: call it with a job or a result.

    ``path`` defaults to ``golden/<name of the test>.mcap``; relative paths are relative to the
    test's file. A job is recorded to the test's ``tmp_path``, where the trace stays for a look.
    """

    def __init__(self, request: pytest.FixtureRequest, tmp_path: Path) -> None:
        self._node: Any = request.node
        self._tmp_path = tmp_path
        self._calls = 0

    def __call__(
        self,
        job_or_result: Job | RunResult | str | os.PathLike[str],
        path: str | os.PathLike[str] | None = None,
        *,
        options: DiffOptions | None = None,
    ) -> RunResult | None:
        """Assert that it does what the golden trace did; return the result if a job was run."""
        __tracebackhide__ = True
        from rsltrace.errors import RsltraceError, RunError

        self._calls += 1
        try:
            return self._check(job_or_result, path, options)
        except RunError:
            raise  # the traceback is that of the node
        except RsltraceError as error:
            message = str(error)
        pytest.fail(message, pytrace=False)

    def _check(
        self,
        job_or_result: Job | RunResult | str | os.PathLike[str],
        path: str | os.PathLike[str] | None,
        options: DiffOptions | None,
    ) -> RunResult | None:
        __tracebackhide__ = True
        from rsltrace.testing.golden import check_golden, golden_run, run_job

        folder = Path(self._node.path).parent
        golden = folder / (self._default() if path is None else Path(path))
        result: RunResult | None = None
        given: Any = job_or_result
        if isinstance(given, str):
            given = Path(given)
        if isinstance(given, Path):
            given = folder / given
            is_job = given.suffix in (".yaml", ".yml")
        else:
            is_job = not hasattr(given, "digest")
        with golden_run(golden) as run:
            if is_job:
                given = result = run_job(given, self._tmp_path, name=f"run{self._number()}.mcap")
            check_golden(given, golden, run, None, options)
        return result

    def _default(self) -> Path:
        name = _NOT_IN_NAME.sub("_", self._node.name).strip("_")
        return Path("golden", f"{name}{self._number()}.mcap")

    def _number(self) -> str:
        """Return what distinguishes the second and later calls of one test."""
        return "" if self._calls == 1 else f"_{self._calls}"


@pytest.fixture
def rsltrace_golden(request: pytest.FixtureRequest, tmp_path: Path) -> GoldenFixture:
    """Compare runs with golden traces: ``rsltrace_golden("job.yaml")``; see ``GoldenFixture``."""
    return GoldenFixture(request, tmp_path)


@pytest.fixture
def rsltrace_node(request: pytest.FixtureRequest) -> Callable[..., NodeReplayResult]:
    """Run one node alone, fed from a recording: ``rsltrace_node("drive.mcap", "/ekf")``.

    Paths are relative to the test's file; the rest is as for ``assert_node_unchanged``.
    """
    folder = Path(request.path).parent

    def check(trace: str | Path, node: str, **options: Any) -> NodeReplayResult:
        __tracebackhide__ = True
        from rsltrace.errors import RsltraceError, RunError
        from rsltrace.testing.golden import NodeChanged, assert_node_unchanged

        for name in ("job_folder", "bag"):
            if isinstance(options.get(name), (str, Path)):
                options[name] = folder / options[name]
        try:
            return assert_node_unchanged(folder / trace, node, **options)
        except RunError:
            raise  # the traceback is that of the node
        except (RsltraceError, NodeChanged) as error:
            message = str(error)
        pytest.fail(message, pytrace=False)

    return check


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say which golden traces were written, so that nobody commits one unseen."""
    written = sorted(set(_written(terminalreporter)))
    if written:
        terminalreporter.section("golden traces written by --rsltrace-update")
        for path in written:
            terminalreporter.line(path)


def _written(terminalreporter: Any) -> Iterator[str]:
    for reports in terminalreporter.stats.values():
        for report in reports:
            for name, value in getattr(report, "user_properties", ()):
                if name == _PROPERTY:
                    yield str(value)


class _FirstFailure:
    """Keeps the exception of the first test that fails."""

    def __init__(self) -> None:
        self.error: BaseException | None = None

    def pytest_exception_interact(self, call: pytest.CallInfo[Any]) -> None:
        if self.error is None and call.excinfo is not None:
            self.error = call.excinfo.value


def _below_pytest(frames: TracebackType | None) -> TracebackType | None:
    """Leave out the frames of pytest itself, up to the test."""
    left = frames
    while left is not None and left.tb_frame.f_globals.get("__name__", "").startswith(_INTERNAL):
        left = left.tb_next
    return left or frames


def run_pytest() -> int:
    """Run pytest with the words of the command line as a main of a job, all tests in this process;
    the exception of the first test that fails is raised again, and so ends the run."""
    words = ["-p", "no:cacheprovider", *sys.argv[1:]]
    if importlib.util.find_spec("xdist") is not None:
        words += ["-n", "0"]
    first = _FirstFailure()
    status = pytest.main(words, plugins=[first])
    if first.error is not None:
        raise first.error.with_traceback(_below_pytest(first.error.__traceback__))
    return int(status)
