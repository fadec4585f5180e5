"""The process between the client and the simulation processes.

Run as ``python -m rsltrace.debug.supervisor DESCRIPTOR SPEC`` by the client, until the client
disconnects. It runs no user code, so it can always answer.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from collections import deque
from collections.abc import Callable
from typing import Any

from rsltrace.debug.tree import CheckpointTree, ClientGoneError, SessionOverError
from rsltrace.errors import DebugError, RsltraceError
from rsltrace.line_protocol import Lines, Message


class Supervisor:
    def __init__(self, client: Lines, spec: dict[str, Any]) -> None:
        self.client = client
        self.waiting: deque[Message] = deque()
        self.tree = CheckpointTree(spec, client, self.waiting)
        self._breakpoints: dict[int, str] = {}
        self._last_number = 0
        self._do: dict[str, Callable[[Message], Any]] = {
            "position": lambda request: self.tree.position,
            "step": lambda request: self.tree.run({"until": self._index + _count(request)}),
            "next": self._next,
            "finish": lambda request: self._forward(until_ns=self.tree.position["stamp_ns"]),
            "run_to": self._run_to,
            "go_on": lambda request: self._forward(),
            "reverse_step": self._reverse_step,
            "reverse_next": lambda request: self.tree.go_back({"node": self._node(request)}),
            "reverse_go_on": lambda request: self.tree.go_back({"breakpoints": self._conditions()}),
            "go_to": lambda request: self.tree.go_to(self._place(request["to"])),
            "break": self._break,
            "clear": self._clear,
            "breakpoints": lambda request: self._conditions(),
            "inspect": self._ask_simulation,
            "evaluate": self._ask_copy,
            "node": self._ask_copy,
            "pdb": self._debug,
            "debugpy": self._debug,
            "event": self._ask_simulation,
            "sent_by": self._sent_by,
            "last_changed": self._last_changed,
            "first_true": self._first_true,
            "checkpoints": lambda request: self.tree.described(),
            "pause": lambda request: self.tree.position,
        }

    def serve(self) -> None:
        """Answer requests until the client disconnects, then end all processes."""
        try:
            self.client.send({"notice": "ready", **self.tree.start()})
            while True:
                request = self.tree.next_request()
                if request is None or request.get("do") == "quit":
                    break
                self.client.send({"id": request.get("id"), **self._answer(request)})
                self.tree.thin()
        except RsltraceError as error:
            if not isinstance(error, ClientGoneError):
                self.client.send({"notice": "failed", "error": _said(error)})
        except ConnectionError:
            pass
        finally:
            self.tree.family.kill_all()

    def _answer(self, request: Message) -> Message:
        try:
            do = self._do.get(str(request.get("do")))
            if do is None:
                raise DebugError(f"there is no request {request.get('do')!r}")
            return {"ok": do(request)}
        except (ClientGoneError, SessionOverError):
            raise
        except RsltraceError as error:
            return {"error": _said(error)}
        except (KeyError, TypeError, ValueError) as error:
            text = f"not a request of this protocol: {type(error).__name__}: {error}"
            return {"error": {"kind": "DebugError", "message": text}}

    @property
    def _index(self) -> int:
        return int(self.tree.position["index"])

    def _conditions(self) -> list[Message]:
        return [{"number": n, "text": text} for n, text in self._breakpoints.items()]

    def _forward(self, **goal: Any) -> Message:
        return self.tree.run({"breakpoints": self._conditions(), **goal})

    def _next(self, request: Message) -> Message:
        answer = self._forward(node=self._node(request))
        if answer["reason"] == "breakpoint" and answer["breakpoint"]["number"] == 0:
            answer = {"reason": "step", "position": answer["position"]}
        return answer

    def _node(self, request: Message) -> str:
        """Return the full name of the requested node, by default that of the event that is shown:
        the one about to run, or the last."""
        name = request.get("node")
        if name is not None:
            return str(self.tree.ask_cursor({"do": "node name", "name": name}))
        event = self.tree.position.get("next") or self.tree.position["event"]
        if event is None:
            raise DebugError("nothing has run yet: give a node (next ekf)")
        if not event["node"]:
            raise DebugError("this event belongs to no node: give a node")
        return str(event["node"])

    def _place(self, place: int | str) -> Message:
        """Return the goal for an index (an int, or digits) or a time of the run."""
        text = str(place).strip()
        if text.isascii() and text.isdigit():
            return {"until": int(text)}
        from rsltrace.job.values.times import parse_time_in_run

        try:
            return {"until_ns": parse_time_in_run(text).stamp_ns(self.tree.start_ns)}
        except ValueError as error:
            raise DebugError(
                f"{text!r} is neither an index (812) nor a time (2.5s): {error}"
            ) from None

    def _run_to(self, request: Message) -> Message:
        goal = self._place(request["to"])
        here = self._index if "until" in goal else int(self.tree.position["stamp_ns"])
        if next(iter(goal.values())) < here:
            raise DebugError(f"{request['to']} is in the past: use goto (in Python, go_to)")
        return self._forward(**goal)

    def _reverse_step(self, request: Message) -> Message:
        goal = self._index - _count(request)
        if self.tree.position["is_next"]:
            goal += 1  # it stands in the middle: first back to between the events
        answer = self.tree.go_to({"until": max(goal, 0)})
        if goal <= 0:
            answer["reason"] = "begin"
        return answer

    def _sent_by(self, request: Message) -> Message:
        event = self.tree.ask_cursor({"do": "event", "index": int(request["index"])})
        cause = event["cause_event"]
        if cause is None:
            raise DebugError(f"nothing in the run caused event {event['index']}")
        sender = self.tree.ask_cursor({"do": "event", "index": cause})
        return {"index": cause + 1, "stamp_ns": sender["stamp_ns"], "event": sender}

    def _last_changed(self, request: Message) -> Message:
        from rsltrace.checks.conditions.occurrences import NOT_THERE

        name = self._node(request)
        text = f"watch node({name!r}).{request['attribute']}"
        conditions = [{"number": 0, "text": text}]
        hit = self.tree.last_hit({"breakpoints": conditions}, self._index + 1)
        while hit is not None and hit["text"].endswith(f"-> {NOT_THERE}"):  # the node was destroyed
            hit = self.tree.last_hit({"breakpoints": conditions}, int(hit["index"]))
        if hit is None:
            raise DebugError(f"{name} has had no attribute {request['attribute']} so far")
        return dict(hit["position"])

    def _first_true(self, request: Message) -> Message:
        conditions = [{"number": 0, "text": str(request["condition"])}]
        found = self.tree.first_hit({"breakpoints": conditions}, self._index)
        if found is None:
            raise DebugError(f"{request['condition']} has not been true so far")
        return found

    def _break(self, request: Message) -> Message:
        text = str(request["at"])
        self.tree.ask_cursor({"do": "check", "text": text})
        self._last_number += 1
        self._breakpoints[self._last_number] = text
        return {"number": self._last_number, "text": text}

    def _clear(self, request: Message) -> None:
        if self._breakpoints.pop(request["number"], None) is None:
            raise DebugError(f"there is no breakpoint {request['number']}")

    def _ask_simulation(self, request: Message) -> Any:
        return self.tree.ask_cursor({k: v for k, v in request.items() if k != "id"})

    def _debug(self, request: Message) -> Any:
        """Let a copy continue under a Python debugger, until that ends."""
        answer = self.tree.ask_copy({k: v for k, v in request.items() if k != "id"}, None)
        if "raised" not in answer:
            return {"ended": answer.get("text", "the end of the run"), "raised": ""}
        return answer

    def _ask_copy(self, request: Message) -> Any:
        return self.tree.ask_copy({k: v for k, v in request.items() if k != "id"})


def _count(request: Message) -> int:
    count = int(request.get("count", 1))
    if count < 1:
        raise DebugError(f"a step has at least one event, not {count}")
    return count


def _said(error: RsltraceError) -> Message:
    kind = getattr(error, "kind", None) or type(error).__name__
    return {"kind": kind, "message": str(error)}


def main() -> None:
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    number, spec = int(sys.argv[1]), json.loads(sys.argv[2])
    os.set_inheritable(number, False)
    Supervisor(Lines(socket.socket(fileno=number)), spec).serve()


if __name__ == "__main__":
    main()
