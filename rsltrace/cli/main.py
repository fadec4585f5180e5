"""The ``rsltrace`` command: finds subcommands when they are used, and handles errors for all.

A subcommand is a module that is imported when it is called, so ``rsltrace --help`` costs what
click costs, however much the others need.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import IO, Any, NoReturn

import click

from rsltrace._version import __version__
from rsltrace.errors import EXIT_USAGE, RsltraceError
from rsltrace.guard.pin import pin_recording

EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
"""128 + SIGPIPE, what a shell reports of any program whose reader went away."""

_COMMANDS = {
    "record": "Run a job's nodes deterministically and record their trace.",
    "init": "Write a commented first job, from bags and nodes.",
    "verify": "Record a job many times in unlike surroundings and compare.",
    "audit": "Look into nodes' sources for what could make runs differ.",
    "check": "Check a job and show its graph, without running it.",
    "schema": "Print the JSON Schema of a job file, for editors.",
    "info": "Show what is in a trace: digest, counts, nodes, rates.",
    "cat": "Print the events of a trace, one per line.",
    "view": "Look at a trace in the terminal, or at two side by side.",
    "rerun": "Show a trace, or two side by side, in Rerun.",
    "export": "Write the messages of a trace as a plain rosbag2 bag.",
    "diff": "Find where two runs (or recordings) first diverge, and why.",
}
"""Each is the function of its name in the module of its name, beside this one."""


class LazyGroup(click.Group):
    """A group whose commands are imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of help."""
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command, or return None if there is none of that name."""
        if cmd_name not in _COMMANDS:
            return None
        command = getattr(importlib.import_module(f"rsltrace.cli.{cmd_name}"), cmd_name)
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

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; the one place where an error becomes a message and an exit status."""
        _tolerate_any_character(sys.stdout)
        _tolerate_any_character(sys.stderr)
        try:
            status = super().invoke(ctx)
            sys.stdout.flush()  # here, where a reader that went away is no traceback
        except RsltraceError as error:
            _fail(str(error), error.exit_code)
        except BrokenPipeError:
            _forget_output()
            sys.exit(EXIT_BROKEN_PIPE)
        except KeyboardInterrupt:
            sys.exit(EXIT_INTERRUPTED)
        except OSError as error:
            _forget_output()
            _fail(f"{error.strerror or error}{_of_file(error)}", EXIT_USAGE)
        if isinstance(status, int) and status:
            sys.exit(status)


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="rsltrace", message="%(prog)s %(version)s")
def cli() -> None:
    """Record what ROS 2 nodes (rclpy) do in a deterministic simulation, and look into it.

    Two runs of one job do the same, down to the last bit: their traces have the same digest.

    \b
    Start with a job.yaml that names your nodes:
      rsltrace init --from FILE.py:CLASS      write a first one, from nodes and bags
      rsltrace check job.yaml                 see what it means and who talks to whom
      rsltrace record job.yaml -o run.mcap    run it and write the trace
      rsltrace info run.mcap                  see what is in it
      rsltrace cat run.mcap | less            read every callback
      rsltrace view run.mcap                  step through it
      rsltrace diff run1.mcap run2.mcap       see where two runs diverge, and why

    "rsltrace COMMAND --help" explains a command.
    """


def main(words: Sequence[str] | None = None, *, prog_name: str = "rsltrace") -> NoReturn:
    """Run the command line (``words``: what follows the program's name) and exit."""
    words = sys.argv[1:] if words is None else words
    _open_standard_streams()
    pin_recording(words)
    cli.main(args=list(words), prog_name=prog_name)
    raise AssertionError("click exits")


def _open_standard_streams() -> None:
    """Put nothing in the place of output streams that whoever started us has closed.

    Python has None for them then, and the next file that is opened (the trace) would get their
    number, for all that writes to it below Python.
    """
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            devnull = os.open(os.devnull, os.O_WRONLY)
            if devnull != number:
                os.dup2(devnull, number)
                os.close(devnull)
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", closefd=False))


def _fail(message: str, status: int) -> NoReturn:
    click.echo(f"rsltrace: error: {message}", err=True)
    sys.exit(status)


def _of_file(error: OSError) -> str:
    return f": {error.filename}" if error.filename else ""


def _tolerate_any_character(stream: IO[str]) -> None:
    """Let a terminal without Unicode show names it cannot show as escapes instead of failing."""
    reconfigure = getattr(stream, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="backslashreplace")


def _forget_output() -> None:
    """Send what is still buffered to nowhere, or Python would fail on it again at exit."""
    try:
        devnull = os.open(os.devnull, os.O_WRONLY)
        os.dup2(devnull, sys.stdout.fileno())
        os.close(devnull)
    except (OSError, ValueError):
        pass  # not a real file: nothing is flushed to it later either


if __name__ == "__main__":
    main()
