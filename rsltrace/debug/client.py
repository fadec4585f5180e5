"""The Python API of a debugging session. User code runs in a process of its own.

>>> import rsltrace
>>> with rsltrace.DebugSession("run.mcap") as session:    # doctest: +SKIP
...     session.go_to("2.5s")
...     session.evaluate('node("ekf").P[0][0]')
...     session.reverse_step()
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rsltrace import errors
from rsltrace.child_processes import Done, Processes, rsltrace_command, start_connected
from rsltrace.debug.checkpoints import Breakpoint, RunPosition, StopReport, position_of, stopped_of
from rsltrace.errors import DebugError, EditError, OutputError, RsltraceError
from rsltrace.line_protocol import Lines, Message
from rsltrace.replay.edits import parse_edit
from rsltrace.trace.model.regular_file import not_replaceable, replacement_of
from rsltrace.trace.model.texts import Stamp

# Branches of a debugging session: its run, repeated with edits.
#
# A branch is a trace, so a session continues in it as in any other.


_ERROR = "rsltrace: error: "
_HAS_PLACE = re.compile(r"\s*(t=)?@?[0-9][^:\"'(]*:")


class EditBranches:
    """Branches of the run of a trace or job. ``path`` is the trace of the last one."""

    def __init__(
        self, source: str | Path, job_folder: str | Path | None, overrides: Sequence[str]
    ) -> None:
        self.path: Path | None = None
        self._source = Path(source)
        self._job_folder = job_folder
        self._overrides = overrides
        self._count = 0
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        self._processes = Processes()

    @property
    def job_folder(self) -> str:
        """The folder of the job; known once a branch exists."""
        return str(self._job_folder)

    def close(self) -> None:
        self._processes.kill()
        if self._temporary is not None:
            self._temporary.cleanup()

    def make(self, text: str, index: int) -> Path:
        """Branch off with one more edit, which is at ``index`` if its text says no place.

        :raises EditError: it is none, or cannot be made.
        :raises DebugError: there is no run to branch off.
        """
        edit = parse_edit(text if _HAS_PLACE.match(text) else f"{index}: {text}").text
        folder = self._folder()
        before = self.path or self._first(folder)
        self._count += 1
        path = folder / f"branch-{self._count}.mcap"
        words = ["replay", str(before), "--edit", edit, "-o", str(path), "--trust", "--quiet"]
        done = self._run([*words, "--json", "--job-folder", str(self._job_folder)])
        try:
            result = json.loads(done.output)
            edits, path_made = result["edits"], result["path"]
        except (ValueError, KeyError, TypeError):
            raise EditError(_said(done)) from None
        if edit not in edits or path_made is None or done.exit_code not in (0, 1):
            raise DebugError(f"there is no branch: {result.get('ended')}")
        self.path = path
        return path

    def keep(self, output: str | Path, *, force: bool) -> Path:
        """Copy the trace of the last branch.

        :raises DebugError: there is none.
        :raises OutputError: the file exists, or cannot be written.
        """
        if self.path is None:
            raise DebugError("nothing has been edited in this session, so there is no branch")
        place = Path(output)
        if kind := not_replaceable(place):
            raise OutputError(f"{place} is {kind}; name a file, or remove it")
        if place.exists() and not force:
            raise OutputError(f"{place} exists; force=True replaces it")
        try:
            with replacement_of(place) as work:
                shutil.copyfile(self.path, work)
        except OSError as error:
            raise OutputError(f"{place} cannot be written: {error.strerror}") from error
        return place

    def _folder(self) -> Path:
        if self._temporary is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="rsltrace-branches-")
        return Path(self._temporary.name)

    def _first(self, folder: Path) -> Path:
        """Return the trace to branch from: the session's, or a recording of its job."""
        from rsltrace.diff.file_kind import is_trace

        if is_trace(os.fspath(self._source)):
            if self._job_folder is None:
                from rsltrace.replay.preparation import job_folder_of
                from rsltrace.trace.reader import Trace

                with Trace.open(self._source) as trace:
                    self._job_folder = job_folder_of(trace, None).absolute()
            return self._source
        self._job_folder = self._source.parent.absolute()
        path = folder / "run.mcap"
        words = ["record", str(self._source), "-o", str(path), "--quiet", "--json", "--force"]
        for override in self._overrides:
            words += ["--set", override]
        done = self._run(words)
        if not path.is_file():
            raise DebugError(_said(done))
        return path

    def _run(self, words: Sequence[str]) -> Done:
        return self._processes.run(rsltrace_command(words), cwd=Path.cwd(), env=os.environ)


def _said(done: Done) -> str:
    """Return the error message of a failed command."""
    before, error, message = done.errors.partition(_ERROR)
    return (message if error else before).strip() or f"it ended with status {done.exit_code}"


_END_S = 10.0


class DebugSession:
    """A run of a trace's job (or of a job file) that can be stopped, gone back in and asked.

    Use as a context manager, or ``close`` it. It begins before the first event. Indices count
    events from 0; a position with index 812 is the one in which events 0 to 811 have ended.

    ``events`` is how many the run has, None if unknown (a job). ``notes`` are texts for
    people: what is not as it was when the trace was recorded.
    """

    def __init__(
        self,
        source: str | Path,
        *,
        job_folder: str | Path | None = None,
        trust: bool = False,
        checkpoints: int = 64,
        memory_mib: int = 2048,
        echo: bool = False,
        overrides: Sequence[str] = (),
        on_notice: Callable[[Message], object] | None = None,
    ) -> None:
        """Open a trace or a job.

        ``job_folder`` and ``trust`` are those of ``rsltrace.replay``. There are ``checkpoints`` at
        most (500 are the most; 0: none, and going back is running again from the beginning), in
        ``memory_mib`` at most. ``echo`` has nodes' log records printed; what they print comes as
        notices of kind ``output`` to ``on_notice``, which is called with every notice (see
        docs/debug-protocol.md). ``overrides`` are settings for a job, as ``--set`` of
        ``rsltrace record``.

        :raises ReplayError, TraceError: the trace cannot be replayed here, or is not trusted.
        :raises JobError, SetupError, BagError: its job cannot run.
        :raises DebugError: the processes of the session cannot be made.
        """
        self.on_notice = on_notice or (lambda notice: None)
        spec: dict[str, Any] = {
            "source": os.fspath(source),
            "job_folder": None if job_folder is None else os.fspath(job_folder),
            "trust": trust,
            "checkpoints": max(int(checkpoints), 0),
            "memory_mib": memory_mib,
            "echo": echo,
            "overrides": list(overrides),
        }
        self._spec = spec
        self._branches: EditBranches | None = None
        self._last_id = 0
        self._lock = threading.Lock()
        self._sending = threading.Lock()
        self._open(spec)

    def _open(self, spec: dict[str, Any]) -> None:
        try:
            self._process, ours = start_connected(
                "rsltrace.debug.supervisor",
                [json.dumps(spec)],
                killed_with_parent=False,  # it kills what the session has started
                stdout=subprocess.DEVNULL,
            )
        except OSError as error:
            raise DebugError(f"no process can be made for the session: {error}") from error
        self._lines = Lines(ours)
        try:
            ready = self._until(lambda message: message.get("notice") == "ready")
        except BaseException:
            self._end()
            raise
        self.events: int | None = ready["events"]
        self.notes: tuple[str, ...] = tuple(ready["notes"])
        self.start_ns = int(ready["start_ns"])

    def __enter__(self) -> DebugSession:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the session with all its processes. A second call does nothing."""
        self._end()
        if self._branches is not None:
            self._branches.close()

    def _end(self) -> None:
        self._lines.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    # -- where it stands ---------------------------------------------------------------------------

    @property
    def position(self) -> RunPosition:
        return self._place("position")

    # -- forward -----------------------------------------------------------------------------------

    def step(self, count: int = 1) -> StopReport:
        """Run ``count`` events."""
        return self._stop("step", count=count)

    def next(self, node: str | None = None) -> StopReport:
        """Run to the end of the next event of a node (default: the node of the last event)."""
        return self._stop("next", node=node)

    def finish(self) -> StopReport:
        """Run to the end of the current time step."""
        return self._stop("finish")

    def run_to(self, place: int | str) -> StopReport:
        """Run to an index, or to the end of a simulated time (``"2.5s"``), or to a breakpoint."""
        return self._stop("run_to", to=place)

    def go_on(self) -> StopReport:
        """Run to the next breakpoint, or to the end."""
        return self._stop("go_on")

    def pause(self) -> None:
        """Stop a run that another thread waits for, after its current event; Ctrl-C does the same.
        A callback that does not return within five seconds is killed with its process; the session
        then stands where the run began."""
        self._send({"id": 0, "do": "pause"})

    # -- back --------------------------------------------------------------------------------------

    def reverse_step(self, count: int = 1) -> StopReport:
        """Go back ``count`` events."""
        return self._stop("reverse_step", count=count)

    def reverse_next(self, node: str | None = None) -> StopReport:
        """Go back to the end of a node's previous event."""
        return self._stop("reverse_next", node=node)

    def reverse_go_on(self) -> StopReport:
        """Go back to the previous place where a breakpoint stops, or to the beginning."""
        return self._stop("reverse_go_on")

    def go_to(self, place: int | str) -> StopReport:
        """Go to an index, or to the end of a simulated time, ahead or back. No breakpoint stops."""
        return self._stop("go_to", to=place)

    # -- breakpoints -------------------------------------------------------------------------------

    def break_at(self, text: str) -> Breakpoint:
        """Set a breakpoint.

        :raises ConditionError: naming the place in the text.
        """
        found = self._ask("break", at=text)
        return Breakpoint(found["number"], found["text"])

    def clear(self, number: int) -> None:
        self._ask("clear", number=number)

    @property
    def breakpoints(self) -> tuple[Breakpoint, ...]:
        """The breakpoints, in the order they were set."""
        return tuple(Breakpoint(one["number"], one["text"]) for one in self._ask("breakpoints"))

    # -- questions ---------------------------------------------------------------------------------

    def evaluate(self, expression: str, node: str | None = None) -> Any:
        """Return the value of an expression: as it is if JSON has such values, else its ``repr``.

        ``node("ekf")`` is a node; the attributes of ``node`` are names. It is evaluated in a copy
        of the simulation, so whatever it does changes nothing.
        """
        answer = self._ask("evaluate", expression=expression, node=node)
        return answer["value"] if "value" in answer else answer["repr"]

    def evaluated(self, expression: str, node: str | None = None) -> str:
        """Return the value of an expression as Python shows it (its ``repr``)."""
        return str(self._ask("evaluate", expression=expression, node=node)["repr"])

    def pdb(self, address: str) -> str:
        """Call the next callback under ``pdb``, which uses the Unix socket ``address``.

        The callback runs in a copy of the simulation, so the session does not change. Returns the
        exception that the callback raised as text, or "".

        :raises DebugError: the run is over or cannot be copied, or no client listens.
        """
        return str(self._ask("pdb", address=address)["raised"])

    def debugpy(self, port: int = 5678) -> str:
        """Continue in a copy of the run under ``debugpy``, on a local port (0: any free one).

        A notice ``debugpy`` says that it waits for an editor. The editor stops in the first line of
        the next callback and at its breakpoints; simulated time stands still meanwhile. The session
        itself does not move. Returns why the copy ended.

        :raises DebugError: the run is over or cannot be copied, or debugpy is missing.
        """
        return str(self._ask("debugpy", port=port)["ended"])

    def node(self, name: str) -> dict[str, str]:
        """Return the attributes of a node and its parameters, as Python shows them."""
        return dict(self._ask("node", name=name))

    def inspect(self, what: str) -> Any:
        """Return ``nodes``, ``queues``, ``timers``, ``stacks``, ``graph``, the ``message`` of the
        present event, or the ``source`` of its callback."""
        found = self._ask("inspect", what=what)
        if what == "timers":
            for one in found:
                due_ns = one["due_ns"]
                one["due_ns"] = None if due_ns is None else Stamp(due_ns, self.start_ns)
        return found

    def event(self, index: int) -> dict[str, Any]:
        """Return an event of the trace, or one that has already run."""
        return dict(self._ask("event", index=index))

    def last_changed(self, node: str, attribute: str) -> RunPosition:
        """Return where a node's attribute (``P[0][0]``) last changed, up to here."""
        return self._place("last_changed", node=node, attribute=attribute)

    def sent_by(self, index: int) -> RunPosition:
        """Return the position after the event that sent the input of event ``index``."""
        return self._place("sent_by", index=index)

    def first_true(self, condition: str) -> RunPosition:
        """Return the first position, up to here, at which a condition is true."""
        return self._place("first_true", condition=condition)

    def checkpoints(self) -> dict[str, Any]:
        """Return ``indices`` of the checkpoints, their memory in ``bytes`` (PSS), and ``why_not``:
        why there are none."""
        return dict(self._ask("checkpoints"))

    # -- what if -----------------------------------------------------------------------------------

    def edit(self, text: str) -> RunPosition:
        """Change something (docs/what-if.md) and continue in the resulting branch.

        A text without a place, as ``message.data = 3.0``, changes the next event. The whole run is
        repeated with the edit, and the session stands at the same position in the branch. A second
        edit branches off the branch.

        :raises EditError: the edit is invalid or cannot be made. The session is unchanged.
        """
        position = self.position
        if self._branches is None:
            spec = self._spec
            self._branches = EditBranches(spec["source"], spec["job_folder"], spec["overrides"])
        path = self._branches.make(text, position.index)
        breakpoints = self.breakpoints
        self._end()
        folder = self._branches.job_folder
        self._open({**self._spec, "source": str(path), "job_folder": folder, "trust": True})
        for one in breakpoints:
            self.break_at(one.text)
        return self.go_to(min(position.index, self.events or 0)).position

    def branch(self, output: str | Path, *, force: bool = False) -> Path:
        """Write the trace of the current branch. It holds the edits, and can be replayed.

        :raises DebugError: nothing has been edited.
        :raises OutputError: ``output`` exists (``force`` replaces it), or cannot be written.
        """
        if self._branches is None:
            raise DebugError("nothing has been edited in this session, so there is no branch")
        return self._branches.keep(output, force=force)

    # -- talking -----------------------------------------------------------------------------------

    def _stop(self, do: str, **values: Any) -> StopReport:
        return stopped_of(self._ask(do, **values), self.start_ns)

    def _place(self, do: str, **values: Any) -> RunPosition:
        return position_of(self._ask(do, **values), self.start_ns)

    def _ask(self, do: str, **values: Any) -> Any:
        with self._lock:
            self._last_id += 1
            number = self._last_id
            self._send({"id": number, "do": do, **values})
            try:
                answer = self._until(lambda message: message.get("id") == number)
            except KeyboardInterrupt:
                self.pause()
                answer = self._until(lambda message: message.get("id") == number)
        if "error" in answer:
            raise _error(answer["error"])
        return answer["ok"]

    def _send(self, request: Message) -> None:
        try:
            with self._sending:
                self._lines.send(request)
        except OSError:
            raise DebugError("the session is over") from None

    def _until(self, is_it: Callable[[Message], bool]) -> Message:
        """Return the message that satisfies ``is_it``; pass notices on."""
        while True:
            message = self._lines.receive()
            if message is None:
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(_END_S)
                raise DebugError("the session is over: its processes have ended")
            if is_it(message):
                return message
            if message.get("notice") == "failed":
                raise _error(message["error"])
            if "notice" in message:
                self.on_notice(message)


def _error(said: Message) -> RsltraceError:
    cls = getattr(errors, str(said.get("kind")), None)
    if isinstance(cls, type) and issubclass(cls, RsltraceError):
        error = cls.__new__(cls)
        Exception.__init__(error, said.get("message", ""))
        return error
    return DebugError(str(said.get("message", "")))
