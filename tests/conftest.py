"""For all tests: how hypothesis searches, what garbage collection walks, which sets stay out.

A loaded machine must not fail a test, nor may a test pass today and fail tomorrow. To look for new
counterexamples: ``HYPOTHESIS_PROFILE=explore python -m pytest …``.
"""

import gc
import os
import signal
import subprocess
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, settings

from rsltrace.cli.main import cli
from tests import golden_files
from tests.forked_command import Forks

settings.register_profile(
    "same", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile(
    "explore", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.register_profile("long", settings.get_profile("same"), max_examples=400)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

# A shell that starts us in the background has us ignore Ctrl-C, and so would all that we start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

APART = ("native", "long")
"""Marked sets that run when they are asked for: with ``-m``, or by the name of a file or test."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the one switch for all golden files."""
    parser.addoption("--update-golden", action="store_true", help="write the golden files anew")


def pytest_configure(config: pytest.Config) -> None:
    """Pass the switch to ``golden_files``."""
    golden_files.update = config.getoption("--update-golden")


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
    if config.option.markexpr:
        return
    named = {(config.invocation_params.dir / arg.split("::")[0]).resolve() for arg in config.args}
    left_out = [
        item
        for item in items
        if item.path not in named and any(item.get_closest_marker(name) for name in APART)
    ]
    if left_out:
        items[:] = [item for item in items if item not in set(left_out)]
        config.hook.pytest_deselected(items=left_out)


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
