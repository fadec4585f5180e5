"""``rsltrace completion``: scripts for the completion of commands, options and files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from rsltrace.terminal import say

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

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
