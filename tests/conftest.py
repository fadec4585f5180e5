"""For all tests: which tier they are in, how Hypothesis searches, what garbage collection walks.

A loaded machine must not fail a test, nor may a test pass today and fail tomorrow. To look for new
counterexamples: ``HYPOTHESIS_PROFILE=new python -m pytest …``. README.md has the tiers.
"""

import gc
import os
import signal
import subprocess
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, settings

from rsltrace.cli.main import cli
from tests import golden_files, tiers
from tests.forked_command import Forks

settings.register_profile(
    "few",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
    max_examples=20,
)
settings.register_profile("many", settings.get_profile("few"), max_examples=200)
settings.register_profile("new", settings.get_profile("few"), derandomize=False, print_blob=True)

# A shell that starts us in the background has us ignore Ctrl-C, and so would all that we start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

APART = ("native", "long")
"""Marked sets that run when they are asked for: with ``-m``, or by the name of a file or test."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the switches of these tests."""
    parser.addoption("--update-golden", action="store_true", help="write the golden files anew")
    parser.addoption(
        "--many-cases", action="store_true", help="as many cases of each test as make test-all"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Pass the switches on, before any module of tests is imported."""
    golden_files.update = config.getoption("--update-golden")
    tiers.many = config.getoption("--many-cases")
    profile = os.environ.get("HYPOTHESIS_PROFILE", "many" if tiers.many else "few")
    settings.load_profile(profile)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Thousands of tests are made, and none becomes garbage."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish() -> None:
    """What was collected never becomes garbage."""
    gc.collect()


def pytest_runtest_setup() -> None:
    """Keep what there is out of garbage collection up to the end of the test's first run, which
    thaws it: each run collects garbage, and need not walk all tests and libraries."""
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the sets of ``APART`` unless they are asked for."""
    seen: Counter[str] = Counter()
    for item in items:
        if (few := item.get_closest_marker("few")) is not None:
            family = item.nodeid.partition("[")[0]
            seen[family] += 1
            if seen[family] > few.args[0]:
                item.add_marker("long")
    if config.option.markexpr:
        return
    named = {(config.invocation_params.dir / arg.split("::")[0]).resolve() for arg in config.args}
    left_out = {
        item
        for item in items
        if item.path not in named and any(item.get_closest_marker(name) for name in APART)
    }
    if left_out:
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=list(left_out))


@pytest.fixture
def own_domain() -> Iterator[None]:
    """A DDS domain that no other test and nobody else on this machine is in."""
    from rsltrace.native.support import domain

    with domain(None):
        yield


@pytest.fixture
def command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the rsltrace command in ``tmp_path``, in this process: starting one takes a second.

    For what it says and writes. Signals, pipes and the pin need a process of their own.
    """
    monkeypatch.chdir(tmp_path)

    def call(*words: object, charset: str = "utf-8") -> subprocess.CompletedProcess[str]:
        try:
            runner = CliRunner(mix_stderr=False, charset=charset)  # click before 8.2
        except TypeError:
            runner = CliRunner(charset=charset)
        texts = [str(word) for word in words]
        result = runner.invoke(cli, texts, prog_name="rsltrace", catch_exceptions=False)
        return subprocess.CompletedProcess(texts, result.exit_code, result.stdout, result.stderr)

    return call


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """Runs ``rsltrace record`` in a process that need not be started anew."""
    started = Forks()
    yield started
    started.close()
