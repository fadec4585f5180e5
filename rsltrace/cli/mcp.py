"""``rsltrace mcp``: tools for agents, over the Model Context Protocol."""

from __future__ import annotations

from pathlib import Path

import click

from rsltrace.errors import SetupError


@click.command()
@click.option(
    "--trust",
    is_flag=True,
    help="Let the agent run the code that jobs and traces name. Without it, the agent reads and "
    "compares traces.",
)
@click.option(
    "--folder",
    "folders",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    multiple=True,
    default=(".",),
    metavar="DIR",
    help="Let the agent name files below this folder only (default: the working directory). "
    "Repeatable; names are relative to the first.",
)
@click.option(
    "--limit",
    "limit_s",
    type=click.FloatRange(min=0, min_open=True),
    default=600.0,
    show_default=True,
    metavar="S",
    help="End a call after S seconds.",
)
def mcp(trust: bool, folders: tuple[Path, ...], limit_s: float) -> None:
    """Serve agents over the Model Context Protocol, on stdin and stdout.

    Tools record jobs, summarize and compare traces, walk through causes, inspect nodes, run
    forwards and backwards, try edits, and search for runs that fail. Your agent starts this
    command itself: see docs/mcp.md.

    \b
    Needs the package mcp: pip install 'rsltrace[mcp]'
    """
    from rsltrace.cli.mcp_server.access import Access

    try:
        from rsltrace.cli.mcp_server.server import serve
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("mcp", "anyio"):  # which mcp brings
            raise
        raise SetupError(
            "the server needs the package mcp, version 2: pip install 'rsltrace[mcp]'"
        ) from None
    serve(Access(tuple(folder.resolve() for folder in folders), trust, limit_s))
