"""The ``rsltrace`` command: finds subcommands when they are used.

A subcommand is a module that is imported when it is called, so ``rsltrace --help`` costs what
click costs, however much the others need.
"""

from __future__ import annotations

import gc
import importlib
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import click

from rsltrace._version import __version__
from rsltrace.cli.output.exit_status import open_standard_streams, status_of
from rsltrace.guard.pin import pin_recording

_COMMANDS = {
    "record": "Run a job's nodes deterministically and record a trace.",
    "replay": "Run the job of a trace again and verify every event.",
    "debug": "Debug a run: set breakpoints, inspect nodes, step backwards.",
    "init": "Write a first job file from bags and nodes.",
    "verify": "Run a job many times under perturbed environments and compare.",
    "explore": "Search the callback orders of a job for runs that fail.",
    "flaky": "Search for the callback order or delay with which a test fails.",
    "bisect": "Find the commit that changed a job's behaviour.",
    "history": "Say which jobs of a suite changed at which commit, and which fail.",
    "audit": "Scan the sources of nodes for nondeterminism.",
    "check": "Check a job and show its node graph without running callbacks.",
    "schema": "Print the JSON Schema of job files, for editors.",
    "completion": "Print the completion script for bash, zsh or fish.",
    "info": "Summarize a trace: digest, counts, nodes, rates.",
    "cat": "Print the events of a trace, one per line.",
    "why": "Say why a callback did not come, or came late.",
    "latency": "Measure end-to-end latencies through chains of nodes.",
    "fit": "Fit a job's delays and execution times to a real-time run.",
    "analyze": "Compute worst-case response times of callback chains.",
    "view": "View a trace, or two side by side, in the terminal.",
    "rerun": "Show a trace, or two side by side, in Rerun.",
    "export": "Export a trace to a rosbag2 bag, Perfetto or a Foxglove layout.",
    "diff": "Show where two traces or recordings first diverge, and why.",
    "install-ros": "Install rclpy where ROS has no wheels for the machine.",
    "mcp": "Serve AI agents over the Model Context Protocol.",
}
"""Each is the function of its name in the module of its name, beside this one, or in that of a
command like it."""

_IN_MODULE_OF = {
    "audit": "check",
    "why": "cat",
    "flaky": "explore",
    "rerun": "export",
    "schema": "init",
    "completion": "options",
}


class LazyGroup(click.Group):
    """A group whose commands are imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command, or return None if there is none of that name."""
        if cmd_name not in _COMMANDS:
            return None
        name = cmd_name.replace("-", "_")
        module = importlib.import_module(f"rsltrace.cli.{_IN_MODULE_OF.get(name, name)}")
        command = getattr(module, name)
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that is meant; of a name that is none, say which is near."""
        name = args[0]
        if name not in _COMMANDS and not name.startswith("-"):
            import difflib

            near = difflib.get_close_matches(name, _COMMANDS, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            ctx.fail(f"No such command {name!r}.{hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(_COMMANDS.items()))

    def main(  # type: ignore[override]  # it never returns
        self, args: Any = None, prog_name: str | None = None, **more: Any
    ) -> NoReturn:
        more["standalone_mode"] = False
        sys.exit(status_of(lambda: super(LazyGroup, self).main(args, prog_name, **more)))


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="rsltrace", message="%(prog)s %(version)s")
def cli() -> None:
    """Record and debug deterministic simulations of ROS 2 nodes (rclpy and C++).

    Two runs of one job are bit-identical: their traces have the same digest.

    \b
    Start with a job.yaml that names your nodes:
      rsltrace init --from FILE.py:CLASS      write a first job file
      rsltrace check job.yaml                 check it and show the graph of nodes and topics
      rsltrace record job.yaml -o run.mcap    run it and write a trace
      rsltrace info run.mcap                  summarize the trace
      rsltrace cat run.mcap | less            list every callback
      rsltrace view run.mcap                  step through the trace
      rsltrace diff run1.mcap run2.mcap       show where two runs diverge, and why
      rsltrace replay run.mcap                run it again and stop where it diverges
      rsltrace debug run.mcap                 set breakpoints, inspect nodes, step backwards

    Run "rsltrace COMMAND --help" for the options of a command.
    """


OWN_PROCESS = "own process"
"""The object of click's context where the process is there for the command alone."""


def main(words: Sequence[str] | None = None, *, prog_name: str = "rsltrace") -> NoReturn:
    """Run the command line (``words``: what follows the program's name) and exit."""
    words = sys.argv[1:] if words is None else words
    open_standard_streams()
    pin_recording(words)
    try:
        cli.main(args=list(words), prog_name=prog_name, obj=OWN_PROCESS)
    finally:
        if "rsltrace.run.session" not in sys.modules:  # else there may be users' finalizers to run
            gc.freeze()  # at its end Python would look at all modules for garbage, several times
    raise AssertionError("click exits")


if __name__ == "__main__":
    main()
