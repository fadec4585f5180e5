"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rsltrace.terminal import say

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Set a key of the job, such as stop.duration=10s or nodes.ekf.parameters.rate=20.0. "
    "Repeatable.",
)
seed_option = click.option(
    "--seed", type=click.IntRange(min=0), help="Use this seed instead of the job's."
)
until_option = click.option(
    "--until",
    metavar="T",
    help="Stop T after the start of the run (seconds, 90s, 5ms), or at simulated time @T.",
)
timeout_option = click.option(
    "--timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="S",
    help="Kill a run after S seconds of real time (default: 30 times the duration of the first "
    "run, at least 120).",
)
no_pin_option = click.option(
    "--no-pin",
    is_flag=True,
    help="Do not pin the hash seed, memory addresses, time zone, locale and thread counts.",
)
job_folder_option = click.option(
    "--job-folder",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="The folder of the job file (default: the trace's folder, or the working directory).",
)
trust_option = click.option(
    "--trust", is_flag=True, help="Run the code that TRACE names without asking."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
history_option = click.option(
    "--history",
    metavar="PLACE",
    envvar="RSLTRACE_HISTORY",
    help="Append a line on this run to a file, or put it as a file of its own into a folder or "
    'at an address (s3://…). "rsltrace history" reads them. Default: $RSLTRACE_HISTORY.',
)


_PROGRAM = "rsltrace"


def complete_files(
    context: click.Context, parameter: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Let the shell complete files for arguments that may also be addresses."""
    from click.shell_completion import CompletionItem

    return [CompletionItem(incomplete, type="file")]


@click.command()
@click.argument("shell", type=click.Choice(("bash", "zsh", "fish")))
def completion(shell: str) -> None:
    """Print the script that completes the commands and options of rsltrace in a shell.

    \b
      bash: eval "$(rsltrace completion bash)"                 in ~/.bashrc
      zsh:  eval "$(rsltrace completion zsh)"                  in ~/.zshrc
      fish: rsltrace completion fish | source                  in ~/.config/fish/config.fish
    """
    from click.shell_completion import get_completion_class

    from rsltrace.cli.main import cli

    made = get_completion_class(shell)
    assert made is not None
    say(made(cli, {}, _PROGRAM, f"_{_PROGRAM.upper()}_COMPLETE").source())
