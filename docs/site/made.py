"""Parts of the reference that are made from the code when the site is built."""

from __future__ import annotations

import ast
import inspect
import re
from collections import defaultdict
from collections.abc import Iterator
from html import escape
from pathlib import Path

import click

import rsltrace
from rsltrace import errors
from rsltrace.cli.main import cli

SOURCES = Path(rsltrace.__file__).parent


def commands() -> str:
    """Return every command: usage, what it does, its options."""
    context = click.Context(cli, info_name="rsltrace")
    return "\n".join(
        _command(cli.get_command(context, name), name) for name in cli.list_commands(context)
    )


def _command(command: click.Command | None, name: str) -> str:
    assert command is not None
    context = click.Context(command, info_name=f"rsltrace {name}")
    usage = " ".join(command.get_usage(context).removeprefix("Usage: ").split())
    rows = ["| option | meaning |", "|---|---|"]
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is not None:
            option, meaning = (" ".join(text.split()) for text in record)
            rows.append(f"| <code>{_entities(option)}</code> | {_markdown(meaning)} |")
    text = "\n\n".join(_paragraphs(inspect.cleandoc(command.help or "")))
    return f"## {name}\n\n```text\n{usage}\n```\n\n{text}\n\n" + "\n".join(rows) + "\n"


def _paragraphs(text: str) -> Iterator[str]:
    """Yield the paragraphs of a command's help; those that click leaves as they are, as blocks."""
    for paragraph in text.split("\f")[0].split("\n\n"):
        if paragraph.startswith("\b"):
            yield "```text\n" + inspect.cleandoc(paragraph.partition("\n")[2]) + "\n```"
        else:
            yield _markdown(" ".join(paragraph.split()))


def _markdown(text: str) -> str:
    """Return plain text as Markdown: commands and options that it names become code."""
    text = re.sub(r"(?<![\w`-])(--[a-z][\w-]*)", r"`\1`", _entities(text))
    return re.sub(r"\bdocs/([\w-]+)\.md", r"`docs/\1.md`", text)


def _entities(text: str) -> str:
    return re.sub(r"[|*_`\[\]]", lambda mark: f"&#{ord(mark[0])};", escape(text, quote=False))


def error_index() -> str:
    """Return every error of ``rsltrace.errors``: its meaning, what to do, and its messages."""
    messages = _messages()
    return "\n".join(_error(kind, messages[kind.__name__]) for kind in _tree(errors.RsltraceError))


def _tree(root: type[errors.RsltraceError]) -> Iterator[type[errors.RsltraceError]]:
    yield root
    for child in root.__subclasses__():
        if child.__module__ == errors.__name__:
            yield from _tree(child)


def _error(kind: type[errors.RsltraceError], messages: set[str]) -> str:
    text = re.sub(r"``(.*?)``", r"`\1`", inspect.getdoc(kind) or "", flags=re.S)
    text = re.sub(r"(?<!`)docs/([\w-]+)\.md", r"`docs/\1.md`", text)
    text = text.replace("What to do:", "**What to do:**")
    base = kind.__base__
    below = f", a {base.__name__}" if base is not None and base is not Exception else ""
    listed = "\n".join(f"- <code>{_entities(message)}</code>" for message in sorted(messages))
    shown = f'??? note "Its messages ({len(messages)})"\n\n' + re.sub(
        "^", "    ", listed, flags=re.M
    )
    return f"## {kind.__name__}\n\n*Exit status {kind.exit_code}{below}.* {text}\n" + (
        f"\n{shown}\n" if messages else ""
    )


def _messages() -> defaultdict[str, set[str]]:
    """Return the texts with which each error is raised; ``…`` stands for what they fill in."""
    found: defaultdict[str, set[str]] = defaultdict(set)
    for path in sorted(SOURCES.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args:
                text = _text(node.args[0])
                if node.func.id in vars(errors) and text.strip("…: "):
                    found[node.func.id].add(text)
    return found


def _text(node: ast.expr) -> str:
    if isinstance(node, ast.Constant):
        return str(node.value).split("\n")[0]
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(value) for value in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left) + _text(node.right)
    return "…"


PARTS = {"commands": commands, "errors": error_index}
"""What ``<!-- made: NAME -->`` in a page stands for."""
