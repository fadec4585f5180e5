"""Runs commands of rsltrace in processes: a node's prints, crashes and memory stay there."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import anyio
from anyio.abc import Process

from rsltrace.child_processes import how_ended, kill_group, rsltrace_command
from rsltrace.cli.mcp_server.answers import Page, PageKeeper

GRACE_S = 1.2
"""From SIGTERM, at which a command closes its trace and ends its processes, to SIGKILL. Clients
wait two seconds for a server that shall end."""
_LAST_OUTPUT_S = 1.0
"""How long to read after the end of a command: what it has started may keep its output open."""


@dataclass(frozen=True, slots=True)
class CommandResult:
    """What a command has printed, and its exit status (None: it took too long)."""

    page: Page
    status: int | None

    @property
    def has_failed(self) -> bool:
        """Whether there is no answer: a usage error, a signal, the limit of time."""
        return self.status is None or self.status < 0 or self.status == 2

    @property
    def ended(self) -> str:
        """How it ended, in words."""
        return "took too long and was ended" if self.status is None else how_ended(self.status)


async def run_command(
    words: Sequence[str],
    limit_s: float,
    *,
    module: str = "rsltrace",
    keeper: PageKeeper | None = None,
) -> CommandResult:
    """Run a command of rsltrace; ``keeper`` keeps a page of what it prints, or its beginning.

    If the call is cancelled or takes too long, the command and all it has started end.
    """
    keeper = keeper or PageKeeper()
    process = await anyio.open_process(
        rsltrace_command(words, module),
        stdin=subprocess.DEVNULL,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    status = None
    try:
        with anyio.move_on_after(limit_s):
            status = await _finish(process, keeper)
    finally:
        with anyio.CancelScope(shield=True):
            await _end(process)
    return CommandResult(keeper.page(), status)


async def _finish(process: Process, keeper: PageKeeper) -> int:
    """Read the output of a process and return its exit status."""
    over = anyio.Event()

    async def read() -> None:
        assert process.stdout is not None
        with suppress(anyio.EndOfStream, anyio.BrokenResourceError, anyio.ClosedResourceError):
            while True:
                keeper.feed(await process.stdout.receive())
        over.set()

    async with anyio.create_task_group() as group:
        group.start_soon(read)
        status = await process.wait()
        with anyio.move_on_after(_LAST_OUTPUT_S):
            await over.wait()
        group.cancel_scope.cancel()
    return status


async def _end(process: Process) -> None:
    if process.returncode is None:
        with suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
        with anyio.move_on_after(GRACE_S):
            await process.wait()
    kill_group(process.pid)
    await process.aclose()
