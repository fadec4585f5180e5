"""The processes of a session: the cursor, and the checkpoints behind it."""

from __future__ import annotations

import os
import select
import time
from collections import deque
from contextlib import suppress
from typing import Any

from rsltrace.debug.checkpoints import COUNT_MAX, Checkpoint, Checkpoints
from rsltrace.debug.processes import Family, Lost, SimProcess, memory_bytes
from rsltrace.errors import DebugError
from rsltrace.line_protocol import Lines, Message

_INTERVAL_S = 0.05
_APART_LIMIT_S = 20.0
_PAUSE_LIMIT_S = 5.0
_LOOK_S = 0.2
"""A wait counts for no more than that: a machine that stands still is no callback that hangs."""
_NEARLY = 0.8
_PIPE_BYTES = 1 << 16


class ClientGoneError(DebugError):
    """The client has disconnected."""


class SessionOverError(DebugError):
    """The session cannot continue. The message says why."""


class RefusedRequestError(DebugError):
    """An error that a simulation process returned; ``kind`` is its class."""

    def __init__(self, message: str, kind: str) -> None:
        super().__init__(message)
        self.kind = kind


class CheckpointTree:
    """The processes of a session: the cursor, and checkpoints. ``position`` is the cursor's."""

    def __init__(self, spec: dict[str, Any], client: Lines, waiting: deque[Message]) -> None:
        self.family = Family()
        self.position: Message = {}
        self.start_ns = 0
        self._spec = {**spec, "supervisor": os.getpid()}
        self._client = client
        self._waiting = waiting
        self._checkpoints = Checkpoints(min(int(spec["checkpoints"]), COUNT_MAX))
        self._memory_max = int(spec["memory_mib"]) << 20
        self._weighed = 0
        self._thinned_at = 0
        self._cursor: SimProcess
        self._is_quiet = False
        self._left_s = 0.0
        """How long what runs may still go on, if the client asked to stop it."""
        self._recovers = False
        """Whether it goes back to where it was, which is not to be stopped: it would be nowhere."""
        self._why_no_checkpoints = ""
        self._output, self._output_end = os.pipe()
        os.set_blocking(self._output, False)

    def start(self) -> Message:
        """Open the source; return what is known of it.

        :raises DebugError: it cannot be run; ``kind`` says why.
        """
        root, ready = self._new_root()
        self.start_ns = int(ready["start_ns"])
        try:
            self._cursor = self._copy_of(root)
        except RefusedRequestError as error:
            self._no_checkpoints(str(error))
            self._cursor = root
        else:
            self._checkpoints.add(Checkpoint(0, self.start_ns, root))
        self.position = self._ask(self._cursor, {"do": "position"})
        return {key: value for key, value in ready.items() if key != "notice"}

    def _new_root(self) -> tuple[SimProcess, Message]:
        """Start a process at the beginning of the run."""
        root = self.family.start(self._spec, self._output_end)
        try:
            while True:
                message = self._message_of(root)
                if message.get("notice") == "ready":
                    return root, message
                if message.get("notice") == "failed":
                    error = message["error"]
                    raise RefusedRequestError(error["message"], error["kind"])
        except DebugError:
            self.family.kill(root)
            raise

    def ask_cursor(
        self, request: Message, *, whole: bool = False, limit_s: float | None = None
    ) -> Any:
        """Send a request to the process at the session's position.

        :raises Lost: that process ended; another one stands there now.
        """
        try:
            return self._ask(self._cursor, request, whole=whole, limit_s=limit_s)
        except Lost as error:
            raise self._recover(self.position, error) from None

    def ask_copy(self, request: Message, limit_s: float | None = _APART_LIMIT_S) -> Any:
        """Have a copy run user code, or the cursor itself if it cannot be copied; it may be
        killed."""
        answer = self.ask_cursor(request, whole=True, limit_s=limit_s)
        if "with" not in answer:
            return answer["ok"]
        copy = SimProcess(Lines(_socket(answer["with"][0])), answer["ok"]["pid"])
        try:
            return self._ask(copy, None, limit_s=limit_s)
        finally:
            self.family.kill(copy)

    def run(self, goal: Message) -> Message:
        """Run the cursor forward; return where and why it stopped.

        :raises Lost: its process ended; the session is back where it was.
        """
        before = self.position
        request = {"do": "run", "interval_s": self._interval(), **goal}
        if "until" in goal:
            request["ladder"] = self._checkpoints.ladder(int(before["index"]), goal["until"])
        answer: Message = self.ask_cursor(request)
        self.position = answer["position"]
        return answer

    def _recover(self, before: Message, error: Lost) -> Lost:
        """Return the session to its position after its process ended."""
        self.family.kill(self._cursor)
        index = int(before["index"])
        where = f"somewhere after event {index - 1}" if index else "at the start"
        self._recovers, self._left_s = True, 0.0
        for is_last in (False, True):  # who kills one process may just have killed another
            try:
                self._cursor, answer = self._at({"until": index})
            except ClientGoneError:
                raise
            except DebugError as again:
                if is_last:
                    why = f"the simulation cannot go on: {error}; nor again: {again}"
                    raise SessionOverError(why) from None
            else:
                break
        self._recovers = False
        self.position = answer["position"]
        return Lost(f"the simulation was lost {where}: {error}; the session is back at {index}")

    def go_to(self, goal: Message) -> Message:
        if "until" in goal:
            here = int(self.position["index"])
            if goal["until"] == here and not self.position["is_next"]:
                return {"reason": "step", "position": self.position}
            is_ahead = goal["until"] > here
        else:
            is_ahead = goal["until_ns"] >= int(self.position["stamp_ns"])
        if is_ahead and not self._jumps_ahead(goal):
            return self.run(goal)
        cursor, answer = self._at(goal)
        self._leave_cursor()
        self._cursor, self.position = cursor, answer["position"]
        return answer

    def _jumps_ahead(self, goal: Message) -> bool:
        """Whether a checkpoint lies between here and a goal ahead."""
        found = self._checkpoints_before(goal)
        return bool(found) and found[0].index > int(self.position["index"])

    def _leave_cursor(self) -> None:
        """Keep the cursor's process as a checkpoint, or end it."""
        position = self.position
        can_copy = self._checkpoints.count_max and not self._why_no_checkpoints
        if can_copy and not position["is_next"] and not position.get("over"):
            one = Checkpoint(int(position["index"]), int(position["stamp_ns"]), self._cursor)
            if self._checkpoints.add(one):
                return
        self.family.kill(self._cursor)

    def _at(self, goal: Message) -> tuple[SimProcess, Message]:
        """Return a new process that stands at a goal, and its answer."""
        process, index = self._wake(self._checkpoints_before(goal))
        request = {"do": "run", "interval_s": self._interval(), **goal}
        if "until" in goal:
            request["ladder"] = self._checkpoints.ladder(index, goal["until"])
        try:
            return process, self._ask_silently(process, request)
        except DebugError:
            self.family.kill(process)
            raise

    def _checkpoints_before(self, goal: Message) -> list[Checkpoint]:
        if "until" in goal:
            return self._checkpoints.before(goal["until"])
        return self._checkpoints.before_time(goal["until_ns"])

    def _wake(self, bases: list[Checkpoint]) -> tuple[SimProcess, int]:
        """Return a copy of the first usable checkpoint, or a process at the beginning."""
        for one in bases:
            try:
                return self._copy_of(one.process), one.index
            except Lost:
                self._forget(one)
            except RefusedRequestError as error:
                self._no_checkpoints(str(error))
                break
        if not bases or self._why_no_checkpoints:
            self._tell({"notice": "again", "text": "running again from the beginning"})
        root, _ = self._new_root()
        return root, 0

    def go_back(self, conditions: Message) -> Message:
        """Go back to the last place where a condition was true, else to the beginning."""
        # Where it stands before a callback, what ended just before that is behind, too.
        hit = self.last_hit(conditions, int(self.position["index"]) + self.position["is_next"])
        if hit is None:
            answer = self.go_to({"until": 0})
            return {**answer, "reason": "begin"}
        goal = {"until": hit["index"]}
        if hit["is_next"]:
            goal["is_next_at"] = hit["index"]
        answer = self.go_to(goal)
        if hit["breakpoint"]["number"]:
            answer = {**answer, "reason": "breakpoint", "breakpoint": hit["breakpoint"]}
            answer["text"] = hit["text"]
        return answer

    def last_hit(self, conditions: Message, below: int) -> Message | None:
        """Return the last place before index ``below`` where a condition was true."""
        end = min(below, int(self.position["index"]))
        while True:
            bases = self._checkpoints.before(max(end - 1, 0))
            process, index = self._wake(bases)
            try:
                answer = self._ask_silently(
                    process,
                    {
                        "do": "run",
                        "until": end,
                        "below": below,
                        "searches": True,
                        "interval_s": self._interval(),
                        **conditions,
                    },
                )
            finally:
                self.family.kill(process)
            hit: Message | None = answer.get("hit")
            if hit is not None or index == 0:
                return hit
            end, below = index, index + 1

    def first_hit(self, conditions: Message, end: int) -> Message | None:
        """Return the first place up to index ``end`` where a condition was true."""
        process, _ = self._wake(self._checkpoints.before(0))
        try:
            answer = self._ask_silently(process, {"do": "run", "until": end, **conditions})
        finally:
            self.family.kill(process)
        return answer["position"] if answer["reason"] == "breakpoint" else None

    def _interval(self) -> float:
        return _INTERVAL_S if self._checkpoints.count_max else 0.0

    def _copy_of(self, process: SimProcess) -> SimProcess:
        """Return a copy of a process, which stands where it does."""
        answer = self._ask(process, {"do": "fork"}, whole=True)
        return SimProcess(Lines(_socket(answer["with"][0])), answer["ok"]["pid"])

    def _no_checkpoints(self, why: str) -> None:
        if why != self._why_no_checkpoints:
            self._why_no_checkpoints = why
            self._tell({"notice": "no checkpoints", "text": why})

    def _forget(self, one: Checkpoint) -> None:
        self._checkpoints.remove(one)
        self.family.kill(one.process)

    def thin(self) -> None:
        """Keep checkpoints within their limits of number and memory, after a move."""
        cursor = int(self.position["index"])
        if cursor == self._thinned_at:
            return
        self._thinned_at = cursor
        while len(self._checkpoints) > self._checkpoints.count_max:
            if not self._drop_one(cursor):
                return
        self._measure_next()
        while self._memory_known() > _NEARLY * self._memory_max:
            if self.memory() <= self._memory_max or not self._drop_one(cursor):
                return

    def _drop_one(self, cursor: int) -> bool:
        worst = self._checkpoints.least_useful(cursor)
        if worst is not None:
            self._forget(worst)
        return worst is not None

    def _measure_next(self) -> None:
        """Measure the memory of one checkpoint, in turn: all at once would be slow."""
        everyone = self._checkpoints.all()
        if everyone:
            self._weighed += 1
            one = everyone[self._weighed % len(everyone)]
            one.bytes = memory_bytes(one.process.pid)

    def _memory_known(self) -> int:
        return sum(one.bytes for one in self._checkpoints.all())

    def memory(self) -> int:
        """Measure the memory of all checkpoints, in bytes (PSS)."""
        for one in self._checkpoints.all():
            one.bytes = memory_bytes(one.process.pid)
        return self._memory_known()

    def described(self) -> Message:
        return {
            "indices": [one.index for one in self._checkpoints.all()],
            "bytes": self.memory(),
            "why_not": self._why_no_checkpoints,
        }

    def next_request(self) -> Message | None:
        """Wait for the client's next request; None once it has disconnected."""
        while not self._waiting:
            if self._client.ended:
                return None
            self._wait_for(None, None)
        return self._waiting.popleft()

    def _ask_silently(self, process: SimProcess, request: Message) -> Message:
        """Send a request to a process that repeats known events: its output is dropped."""
        self._is_quiet = True
        try:
            answer: Message = self._ask(process, request)
            if answer["reason"] == "paused":
                raise DebugError("interrupted: the session stays where it was")
            return answer
        finally:
            self._pass_output_on()
            self._is_quiet = False

    def _ask(
        self,
        process: SimProcess,
        request: Message | None,
        *,
        whole: bool = False,
        limit_s: float | None = None,
    ) -> Any:
        """Send a request to a process and return its answer."""
        if request is not None:
            try:
                process.lines.send({"id": 0, **request})
            except OSError:
                raise Lost(self.family.how_ended(process)) from None
        self._left_s = 0.0
        while True:
            message = self._message_of(process, limit_s)
            if "error" in message:
                raise RefusedRequestError(message["error"]["message"], message["error"]["kind"])
            if "ok" in message:
                return message if whole else message["ok"]

    def _message_of(self, process: SimProcess, limit_s: float | None = None) -> Message:
        """Wait for a message of a process that is not a notice."""
        while True:
            message = process.lines.next()
            if message is None:
                if process.lines.ended:
                    self._pass_output_on()
                    raise Lost(self.family.how_ended(process))
                self._wait_for(process, limit_s)
            elif message.get("notice") == "checkpoint":
                self._add(message)
            elif message.get("notice") == "debugpy":
                self._tell(message)
            elif message.get("notice") == "no checkpoint":
                self._no_checkpoints(message["text"])
            else:
                return message

    def _add(self, message: Message) -> None:
        copy = SimProcess(Lines(_socket(message["with"][0])), message["pid"])
        position = message["position"]
        one = Checkpoint(int(position["index"]), int(position["stamp_ns"]), copy)
        if not self._checkpoints.add(one):
            self.family.kill(copy)
            return
        self._why_no_checkpoints = ""
        one.bytes = memory_bytes(copy.pid)
        self._measure_next()
        is_heavy = self._memory_known() > self._memory_max
        if is_heavy or len(self._checkpoints) > self._checkpoints.count_max:
            self._drop_one(one.index)

    def _wait_for(self, process: SimProcess | None, limit_s: float | None) -> None:
        """Wait for a process, the client, or output of a node."""
        ends: list[Any] = [self._output]
        if process is not None:
            ends.append(process.lines)
        if not self._client.ended:
            ends.append(self._client)
        is_paused = process is not None and self._left_s > 0
        began_s = time.monotonic()
        ready = select.select(ends, [], [], _LOOK_S if is_paused else limit_s)[0]
        is_over = not ready
        if self._output in ready:
            self._pass_output_on()
        if is_paused:
            self._left_s -= min(time.monotonic() - began_s, _LOOK_S)
            is_over = self._left_s <= 0
        if is_over:
            self._left_s = 0.0
            raise Lost("its callback did not come back, and was ended")
        if self._client in ready:
            self._read_client(process)
        if process is not None and process.lines in ready:
            process.lines.read()
        self.family.reap()

    def _read_client(self, process: SimProcess | None) -> None:
        self._client.read()
        while (request := self._client.next()) is not None:
            if process is not None and request.get("do") == "pause":
                # Once: a second Ctrl-C does not wait longer, and many would fill the socket.
                if not self._left_s and not self._recovers:
                    process.lines.send({"id": 0, "do": "pause"})
                    self._left_s = _PAUSE_LIMIT_S
            else:
                self._waiting.append(request)
        if self._client.ended and process is not None:
            raise ClientGoneError("the client is gone")

    def _pass_output_on(self) -> None:
        """Send what nodes have printed to the client: once what the pipe holds, as a node that
        prints without end would not let the client stop it."""
        with suppress(BlockingIOError):
            data = os.read(self._output, _PIPE_BYTES)
            if not self._is_quiet:
                self._tell({"notice": "output", "text": data.decode("utf-8", "replace")})

    def _tell(self, notice: Message) -> None:
        self._client.send(notice)


def _socket(number: int) -> Any:
    import socket

    return socket.socket(fileno=number)
