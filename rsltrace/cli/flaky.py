"""``rsltrace flaky``: search for the order or delay with which a test fails."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import click

from rsltrace.cli.explore import budget_option, explore, jobs_option, output_option
from rsltrace.cli.job_source import JobArguments, RosArgsCommand, job_options

_DELAY = 'delay.default={"lognormal": {"median": "1ms", "sigma": 1.5}}'
"""Mostly a millisecond, one in a hundred over 30 ms: messages of other topics overtake each other
as on a loaded machine."""


@click.command(cls=RosArgsCommand)
@job_options
@budget_option("100")
@click.option("--stop-at-first", is_flag=True, help="Stop at the first run that fails.")
@jobs_option
@output_option
@click.option("--resume", is_flag=True, help="Continue the search in the output folder.")
@click.option("--force", is_flag=True, help="Replace the search in the output folder.")
@click.option("-q", "--quiet", is_flag=True, help="Show only the result, no progress.")
def flaky(given: JobArguments, **options: Any) -> int:
    """Run a test in many callback orders and with many delays, and keep the smallest run that
    fails and the nearest that passes.

    \b
      rsltrace flaky -- pytest test/test_nodes.py::test_reset
      rsltrace flaky -- ros2 launch my_robot nodes.launch.py -- pytest test/test_nodes.py
      rsltrace flaky -- build/my_robot/test_filter

    The test runs unmodified, in simulated time. It fails by an exception, an exit status, a
    deadlock or a crash. Messages are delayed by about a millisecond, some by much more; --set
    delay.default=T changes that.

    Exit status: 0 if it never failed, 1 if it did, 2 for an error.
    """
    if not given.program:
        raise click.UsageError("name the test after '--': rsltrace flaky -- pytest FILE")
    assert explore.callback is not None
    status: int = explore.callback(
        replace(given, overrides=(_DELAY, *given.overrides)),
        strategy="mixed",
        depth=None,
        seed=0,
        until=None,
        fork_after=None,
        timeout=None,
        cluster=None,
        form="flaky",
        minimize=True,
        job_folder=None,
        trust=False,
        history=None,
        **options,
    )
    return status
