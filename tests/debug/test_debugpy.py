"""An editor that stops in a callback, by debugpy's own protocol (DAP) over a socket."""

from __future__ import annotations

import json
import queue
import socket
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace.errors import DebugError

pytest.importorskip("debugpy")
pytestmark = pytest.mark.ros

LIMIT_S = 240


class Editor:
    """The side of an editor: requests in, responses and events out."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=LIMIT_S)
        self._file = self._socket.makefile("rb")
        self._last = 0
        self.events: list[dict[str, Any]] = []

    def send(self, command: str, **arguments: Any) -> int:
        """Send a request; return its number."""
        self._last += 1
        text = {"seq": self._last, "type": "request", "command": command, "arguments": arguments}
        data = json.dumps(text).encode()
        self._socket.sendall(b"Content-Length: %d\r\n\r\n%b" % (len(data), data))
        return self._last

    def _receive(self) -> dict[str, Any]:
        length = 0
        while (line := self._file.readline().strip()) or not length:
            assert line, "debugpy has hung up"
            if line.lower().startswith(b"content-length:"):
                length = int(line.split(b":")[1])
        message: dict[str, Any] = json.loads(self._file.read(length))
        if message["type"] == "event":
            self.events.append(message)
        return message

    def response(self, number: int) -> Any:
        """Return the body of the response to a request."""
        while True:
            message = self._receive()
            if message["type"] == "response" and message["request_seq"] == number:
                assert message["success"], message
                return message.get("body")

    def ask(self, command: str, **arguments: Any) -> Any:
        """Send a request and return the body of its response."""
        return self.response(self.send(command, **arguments))

    def event(self, name: str) -> Any:
        """Return the body of the next event of a name."""
        while True:
            for index, message in enumerate(self.events):
                if message["event"] == name:
                    del self.events[index]
                    return message.get("body")
            self._receive()

    def attach(self, breakpoints: dict[str, list[int]]) -> None:
        """Attach as VS Code does."""
        self.ask("initialize", adapterID="debugpy", pathFormat="path")
        attached = self.send("attach", justMyCode=False)
        self.event("initialized")
        for path, lines in breakpoints.items():
            source, wanted = {"path": path}, [{"line": line} for line in lines]
            self.ask("setBreakpoints", source=source, breakpoints=wanted)
        self.ask("configurationDone")
        self.response(attached)

    def stopped_at(self) -> tuple[int, str, int, int]:
        """Wait for a stop; return thread, file name, line and frame."""
        thread = self.event("stopped")["threadId"]
        frame = self.ask("stackTrace", threadId=thread, levels=1)["stackFrames"][0]
        return thread, Path(frame["source"]["path"]).name, frame["line"], frame["id"]

    def value(self, expression: str, frame: int) -> str:
        """Evaluate in a frame."""
        return str(self.ask("evaluate", expression=expression, frameId=frame)["result"])

    def disconnect(self) -> None:
        """Go away; the run goes on."""
        self.ask("disconnect", restart=False, terminateDebuggee=False)

    def close(self) -> None:
        """Hang up."""
        self._file.close()
        self._socket.close()


@pytest.fixture
def under(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[str, rsltrace.DebugSession]]:
    """Have somebody debug with an editor from a breakpoint on; return how that ended."""
    monkeypatch.chdir(folder)

    def go(
        edit: Callable[[Editor], None], at: str = "entity /smooth"
    ) -> tuple[str, rsltrace.DebugSession]:
        ports: queue.Queue[int] = queue.Queue()

        def on_notice(notice: dict[str, Any]) -> None:
            if notice["notice"] == "debugpy":
                ports.put(notice["port"])

        with rsltrace.DebugSession("run.mcap", on_notice=on_notice) as session:
            session.break_at(at)
            before = session.go_on().position
            ended: list[str] = []
            thread = threading.Thread(target=lambda: ended.append(session.debugpy(0)))
            thread.start()
            with closing(Editor(ports.get(timeout=LIMIT_S))) as editor:
                edit(editor)
            thread.join(LIMIT_S)
            assert session.position == before, "it was a copy"
            after = session.step()
            assert after.reason == "step"
        return ended[0], session

    return go


def line_of(folder: Path, text: str) -> int:
    lines = (folder / "nodes_of_debug.py").read_text().splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


def test_an_editor_stops_in_the_first_line_and_time_stands_still(
    folder: Path, under: Callable[..., tuple[str, Any]]
) -> None:
    def edit(editor: Editor) -> None:
        path = str(folder / "nodes_of_debug.py")
        tick = line_of(folder, "self.count += 1")
        editor.attach({path: [tick]})
        thread, file, line, frame = editor.stopped_at()
        assert (file, line) == ("nodes_of_debug.py", line_of(folder, "self.last = message.data"))
        assert editor.value("message.data", frame) == "0.1875"
        now = "self.get_clock().now().nanoseconds"
        stamp = int(editor.value(now, frame))
        assert int(editor.value(now, frame)) == stamp
        editor.ask("continue", threadId=thread)
        thread, _, line, frame = editor.stopped_at()
        assert line == tick
        assert editor.value("self.count", frame) == "1"
        assert int(editor.value(now, frame)) == stamp + 10_000_000
        editor.ask("next", threadId=thread)
        _, _, line, frame = editor.stopped_at()
        assert line == tick + 1
        assert editor.value("self.count", frame) == "2"
        editor.disconnect()

    assert under(edit)[0] == "the editor has disconnected"


@pytest.mark.long
def test_without_breakpoints_it_runs_to_the_end(under: Callable[..., tuple[str, Any]]) -> None:
    def edit(editor: Editor) -> None:
        editor.attach({})
        thread, *_ = editor.stopped_at()
        editor.ask("continue", threadId=thread)
        editor.event("terminated")

    assert under(edit, at="t=2.95s")[0] == "duration of 3.000000000 s"


@pytest.mark.long
def test_a_port_that_is_taken_and_ctrl_c_while_it_waits(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    waiting = threading.Event()

    def on_notice(notice: dict[str, Any]) -> None:
        if notice["notice"] == "debugpy":
            waiting.set()

    with rsltrace.DebugSession("run.mcap", on_notice=on_notice) as session:
        session.step(20)
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen(1)
            with pytest.raises(DebugError, match="cannot listen at"):
                session.debugpy(taken.getsockname()[1])
        ended: list[str] = []
        thread = threading.Thread(target=lambda: ended.append(session.debugpy(0)))
        thread.start()
        assert waiting.wait(LIMIT_S)
        session.pause()
        thread.join(LIMIT_S)
        assert ended == ["interrupted"]
        assert session.step().position.index == 21
