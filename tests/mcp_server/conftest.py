"""Servers over real stdio, with the client of the package mcp."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio

Call = tuple[str, dict[str, Any]]


def converse(folder: Path, *steps: Call | Callable[[], object], trust: bool = False) -> list[str]:
    """Start a server for a folder, make calls, and return the texts of the answers."""
    from mcp import ClientSession, StdioServerParameters
    from mcp.client.stdio import stdio_client

    words = ["-m", "rsltrace", "mcp", "--folder", str(folder)]
    server = StdioServerParameters(command=sys.executable, args=words + ["--trust"] * trust)

    async def speak() -> list[str]:
        answers = []
        with open(os.devnull, "w") as errors:
            async with (
                stdio_client(server, errlog=errors) as (incoming, outgoing),
                ClientSession(incoming, outgoing) as session,
            ):
                await session.initialize()
                for step in steps:
                    if callable(step):
                        step()
                        continue
                    done = await session.call_tool(*step)
                    [content] = done.content
                    answers.append(("ERROR " if done.is_error else "") + content.text)
        return answers

    return anyio.run(speak)
