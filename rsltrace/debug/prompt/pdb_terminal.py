"""The terminal's side of ``pdb`` in a callback: what it writes is shown, lines are read for it."""

from __future__ import annotations

import json
import select
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rsltrace.terminal import say

_LOOK_S = 0.1


def talk(start: Callable[[str], Any], read: Callable[[str], str | None]) -> Any:
    """Call ``start`` with the address at which we listen, serve ``pdb`` until it hangs up, and
    return what ``start`` returns (or raise what it raises).

    ``read`` gives the next line for a prompt, None if there are no more.
    """
    with _listening() as (listener, address):
        answer: list[Any] = []
        failure: list[BaseException] = []

        def call() -> None:
            try:
                answer.append(start(address))
            except BaseException as error:
                failure.append(error)

        thread = threading.Thread(target=call, name="pdb", daemon=True)
        thread.start()
        while thread.is_alive():
            if select.select([listener], [], [], _LOOK_S)[0]:
                connection, _ = listener.accept()
                with connection:
                    _serve(connection, read)
                break
        thread.join()
    if failure:
        raise failure[0]
    return answer[0]


@contextmanager
def _listening() -> Iterator[tuple[socket.socket, str]]:
    """Listen where only this user can connect."""
    with tempfile.TemporaryDirectory(prefix="rsltrace-pdb-") as folder:
        address = str(Path(folder, "socket"))
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(address)
            listener.listen(1)
            yield listener, address


def _serve(connection: socket.socket, read: Callable[[str], str | None]) -> None:
    """Show and read until the other side hangs up."""
    begun = ""
    with connection.makefile("rw", encoding="utf-8") as lines:
        for text in lines:
            message = json.loads(text)
            if "write" in message:
                whole, newline, begun = (begun + str(message["write"])).rpartition("\n")
                if newline:
                    say(whole)
            elif "read" in message:
                line = _line(begun, read)
                begun = ""
                lines.write(json.dumps({"line": line}) + "\n")
                lines.flush()
    if begun:
        say(begun)


def _line(prompt: str, read: Callable[[str], str | None]) -> str | None:
    while True:
        try:
            return read(prompt)
        except KeyboardInterrupt:
            say()
