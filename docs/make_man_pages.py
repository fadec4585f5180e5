"""Writes man/: a manual page for rsltrace and one for each of its commands, from the commands.

    python docs/make_man_pages.py

They go into share/man/man1 of a wheel; a test fails when one is stale.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import click

from rsltrace.cli.main import cli

FOLDER = Path(__file__).parent.parent / "man"
_AS_IT_IS = "\b"
_FAMILY = "User Commands"


def pages() -> dict[str, str]:
    """Return the pages by the names of their files."""
    context = click.Context(cli, info_name="rsltrace", **cli.context_settings)
    found = {"rsltrace.1": _page(context, "record, compare and step through runs of rclpy nodes")}
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        assert command is not None
        below = click.Context(command, info_name=name, parent=context)
        found[f"rsltrace-{name}.1"] = _page(below, command.get_short_help_str(200))
    return found


def _page(context: click.Context, short: str) -> str:
    name = context.command_path.replace(" ", "-")
    usage = " ".join(context.command.collect_usage_pieces(context))
    lines = [
        f'.TH {_text(name.upper())} 1 "" rsltrace "{_FAMILY}"',
        ".SH NAME",
        f"{_text(name)} \\- {_text(short.rstrip('.'))}",
        ".SH SYNOPSIS",
        f".B {_text(context.command_path)}",
        _text(usage),
        ".SH DESCRIPTION",
        *_prose(inspect.cleandoc(context.command.help or "")),
    ]
    records = [p.get_help_record(context) for p in context.command.get_params(context)]
    options = [record for record in records if record and record[1]]
    if options:
        lines.append(".SH OPTIONS")
        for names, text in options:
            lines += [".TP", f"\\fB{_text(names)}\\fR", *_lines(text)]
    if isinstance(context.command, click.Group):
        lines.append(".SH COMMANDS")
        for one in context.command.list_commands(context):
            command = context.command.get_command(context, one)
            assert command is not None
            short = command.get_short_help_str(200)
            lines += [
                ".TP",
                f"\\fB{_text(context.command_path)}\\-{_text(one)}\\fR(1)",
                *_lines(short),
            ]
    else:
        lines += [".SH SEE ALSO", "\\fBrsltrace\\fR(1)"]
    return "\n".join(lines) + "\n"


def _prose(text: str) -> Iterator[str]:
    """Yield the paragraphs of a help text; what click leaves as it is stays so."""
    for paragraph in re.split(r"\n\s*\n", text):
        lines = paragraph.strip("\n").splitlines()
        if lines and lines[0].strip() == _AS_IT_IS:
            yield from (".PP", ".nf", *map(_text, lines[1:]), ".fi")
        else:
            yield from (".PP", *_lines(" ".join(line.strip() for line in lines)))


def _lines(text: str) -> list[str]:
    """Return a text for roff to fill, a sentence on each line."""
    return [_text(one) for one in re.split(r"(?<=\.) +", text.strip())]


def _text(text: str) -> str:
    """Return text that roff prints as it is."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-").replace("'", "\\(aq")
    escaped = escaped.replace("`", "\\(ga").replace("…", "...").replace("→", "\\->")
    return f"\\&{escaped}" if escaped.startswith(".") else escaped


def main() -> None:
    """Write the pages and take away those of commands that are gone."""
    FOLDER.mkdir(exist_ok=True)
    made = pages()
    for path in FOLDER.glob("*.1"):
        if path.name not in made:
            path.unlink()
    for name, page in made.items():
        (FOLDER / name).write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
