"""The tools. Docstrings and arguments are what an agent reads of them.

To add one: a method here, and its name in ``TOOLS``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from rsltrace.cli.mcp_server.access import Access, RefusedError
from rsltrace.cli.mcp_server.answers import Page, PageKeeper, answer, page_of
from rsltrace.cli.mcp_server.commands import CommandResult, run_command
from rsltrace.cli.mcp_server.sessions import Sessions
from rsltrace.debug.prompt.show import position_line, stopped_lines

if TYPE_CHECKING:
    from rsltrace.debug.checkpoints import RunPosition
    from rsltrace.debug.client import DebugSession

Trace = Annotated[str, Field(description="A trace (.mcap)")]
Job = Annotated[str, Field(description="A job file (.yaml)")]
Event = Annotated[int, Field(description="Number of an event, as the tool events shows it", ge=0)]
NewTrace = Annotated[str, Field(description="The trace to write (.mcap)")]
Replace = Annotated[bool, Field(description="Replace the output if it exists")]
Skip = Annotated[int, Field(description="Leave out this many lines of the answer", ge=0)]
Globs = Annotated[list[str] | None, Field(description="Names or globs, such as /robot/*")]
Settings = Annotated[
    list[str] | None,
    Field(description="Settings of the job, such as stop.duration=10s or seed=3"),
]
Seconds = Annotated[float | None, Field(description="End the call after this long", gt=0)]

READING = ("overview", "events", "event", "why", "diff", "latency")
"""These run no code of a trace, except ``why`` of an attribute."""
RUNNING = ("check_job", "record", "node_state", "run_until", "what_if", "explore", "verify")
TOOLS = (*READING, *RUNNING)

_SMALL = re.compile(r"/small/(\d+)/")
_EVENT = re.compile(r"\bevent (\d{1,18})\b")


class Tools:
    """The tools of one server."""

    def __init__(self, access: Access, sessions: Sessions) -> None:
        self._access = access
        self._sessions = sessions

    # -- reading: runs nothing ---------------------------------------------------------------------

    async def overview(self, trace: Trace, skip: Skip = 0) -> str:
        """Summarize a run: its checks and whether they hold, digest, how it ended, nodes, topics,
        rates, findings. Start here with a trace."""
        path = str(self._access.existing(trace))
        checks = await self._run(["check", path])
        keeper = PageKeeper(skip=skip)
        then = [f"events({trace!r}, where=...) lists callbacks; event, why, node_state look at one"]
        if not checks.has_failed:  # as it has where there are no checks
            for line in (*checks.page.lines, ""):
                keeper.add(line)
        if checks.status == 1:
            then = _look_at(trace, checks.page) + then
        done = await self._run(["info", path], keeper=keeper)
        return self._answer(f"overview of {trace}", done, then)

    async def events(
        self,
        trace: Trace,
        nodes: Globs = None,
        topics: Globs = None,
        kinds: Annotated[
            list[str] | None, Field(description="timer, subscription, service, ...")
        ] = None,
        where: Annotated[
            str | None,
            Field(
                description="A condition: '/odom: pose.pose.position.x > 3', 'log warn', "
                "'exception', 'finding'"
            ),
        ] = None,
        start: Annotated[str | None, Field(description="Time of the run: 2.5s")] = None,
        end: Annotated[str | None, Field(description="Time of the run, inclusive")] = None,
        limit: Annotated[int, Field(ge=1, le=1000)] = 30,
        skip: Skip = 0,
    ) -> str:
        """List events (callbacks) of a run, in order, one per line: number, time, node, kind, topic
        or timer, line of code, outputs. All filters must match; of a list, one."""
        path = str(self._access.existing(trace))
        words = ["cat", path, "--code", f"--limit={skip + limit}"]
        words += _options("--node", nodes) + _options("--topic", topics)
        words += _options("--kind", kinds) + _options("--where", [where] if where else None)
        words += _options("--from", [start] if start else None)
        words += _options("--to", [end] if end else None)
        done = await self._run(words, skip=skip)
        then = [f"event({trace!r}, N) shows one of them, why({trace!r}, N) what caused it"]
        if len(done.page.lines) >= limit and not done.page.after:
            then.append(f"events(..., skip={skip + limit}) continues")
        return self._answer(f"events of {trace}", done, then)

    async def event(
        self,
        trace: Trace,
        event: Event,
        sections: Annotated[
            list[str] | None,
            Field(description="Closed sections to open: those that the answer names, such as in.x"),
        ] = None,
        skip: Skip = 0,
    ) -> str:
        """Show one event: what it received and sent (with fields), its cause, its effects, and the
        source lines of its callback."""
        then = [
            f"why({trace!r}, {event}) walks back through its causes",
            f"node_state({trace!r}, node, {event}) has the node's attributes after it",
        ]
        return await self._event_page("event", trace, event, then, sections or (), skip)

    async def why(
        self,
        trace: Trace,
        event: Annotated[
            int | None, Field(description="The event to explain; of an attribute: up to it", ge=0)
        ] = None,
        node: Annotated[
            str | None, Field(description="Of the attribute or callback: its node")
        ] = None,
        attribute: Annotated[
            str | None, Field(description="Explain this value of a node: stop_at, P[0][0]")
        ] = None,
        callback: Annotated[
            str | None,
            Field(description="Of node, did not come or came late: a topic, a service, on_scan"),
        ] = None,
        at: Annotated[str | None, Field(description="With callback: time of the run: 2.5s")] = None,
        skip: Skip = 0,
    ) -> str:
        """Explain an event, or the last change of a node's attribute: the chain of events that
        caused it, back to a timer or an input, each with its line of code. Or explain why a
        callback did not come, or came late: give node and callback."""
        if callback and node:
            words = ["why", *_options("--at", [at] if at else None)]
            words += ["--", str(self._access.existing(trace)), node, callback]
            then = [f"events({trace!r}, nodes=[...]) lists what the node to blame did"]
            return await self._read(f"why {callback} of {node} did not come", words, then, skip)
        if attribute and node:
            event = await self._last_change(trace, node, attribute, event)
        elif event is None:
            raise RefusedError("give an event, or node and attribute, or node and callback")
        then = [f"event({trace!r}, {event}) shows what it received and sent"]
        if event:
            then.append(f"node_state({trace!r}, node, {event - 1}) has the state before it")
        return await self._event_page("why", trace, event, then, (), skip)

    async def diff(
        self,
        a: Annotated[str, Field(description="The reference: a trace or a rosbag2 recording")],
        b: Annotated[str, Field(description="The other trace or recording")],
        nodes: Globs = None,
        topics: Globs = None,
        ignore: Annotated[
            list[str] | None, Field(description="Fields not to compare: header.stamp")
        ] = None,
        tolerances: Annotated[
            list[str] | None, Field(description="FIELD=TOL: |a-b| <= TOL is equal")
        ] = None,
        skip: Skip = 0,
    ) -> str:
        """Compare two runs: where they first diverge, the cause, the values, what it affects."""
        words = ["diff", str(self._access.existing(a)), str(self._access.existing(b))]
        words += _options("--node", nodes) + _options("--topic", topics)
        words += _options("--ignore", ignore) + _options("--abs", tolerances)
        done = await self._run(words, skip=skip)
        then = _look_at(b, done.page)
        if done.status == 0:
            then = ["they are identical: nothing more to find here"]
        return self._answer(f"diff of {a} and {b}", done, then)

    async def latency(
        self,
        trace: Trace,
        chain: Annotated[
            str | None, Field(description="Topics: /scan,/objects,/cmd_vel. Default: all chains")
        ] = None,
        skip: Skip = 0,
    ) -> str:
        """Measure the end-to-end latencies of callback chains, and where the time goes."""
        words = ["latency", str(self._access.existing(trace))]
        words += _options("--chain", [chain] if chain else None)
        then = [f"events({trace!r}, topics=[...]) lists the messages of a late chain"]
        return await self._read(f"latencies of {trace}", words, then, skip)

    # -- running: needs trust ----------------------------------------------------------------------

    async def check_job(self, job: Job, settings: Settings = None, skip: Skip = 0) -> str:
        """Check a job: construct its nodes without running a callback; show settings, graph and
        problems. Runs the nodes' constructors."""
        self._access.require_trust()
        words = ["check", str(self._access.existing(job)), *_options("--set", settings)]
        then = [f"record({job!r}, 'run.mcap') runs it"]
        return await self._read(f"check of {job}", words, then, skip)

    async def record(
        self,
        job: Job,
        output: NewTrace,
        settings: Settings = None,
        until: Annotated[str | None, Field(description="Stop at this time of the run: 5s")] = None,
        replace: Replace = False,
        seconds: Seconds = None,
    ) -> str:
        """Run a job's nodes deterministically and write a trace; evaluate its checks. The same job
        gives the same digest."""
        self._access.require_trust()
        path = self._access.new_trace(output)
        words = ["record", str(self._access.existing(job)), "-q", "-o", str(path)]
        words += _options("--set", settings) + _options("--until", [until] if until else None)
        words += ["--force"] * replace
        done = await self._run(words, end=True, seconds=seconds)
        then = [*_look_at(output, done.page), f"overview({output!r})"]
        return self._answer(f"record {job} to {output}", done, then)

    async def node_state(
        self,
        trace: Trace,
        node: Annotated[str, Field(description="Name of the node")],
        event: Event,
        attribute: Annotated[
            str, Field(description="Only attributes and parameters that begin so")
        ] = "",
        skip: Skip = 0,
    ) -> str:
        """Show the attributes and parameters of a node after an event, by running the trace's job
        again up to there."""

        def look(session: DebugSession) -> list[str]:
            position = session.go_to(event + 1).position
            values = session.node(node)
            lines = [f"{k} = {v}" for k, v in values.items() if k.startswith(attribute)]
            return [position_line(position), *sorted(lines)]

        lines = await self._sessions.use(self._access.existing(trace), look)
        then = [
            f"why({trace!r}, {event}, node={node!r}, attribute=...) finds what changed a value",
            f"run_until({trace!r}, 'when {node.strip('/')}.ATTRIBUTE > 1') finds when it is so",
        ]
        return answer(f"{node} after event {event} of {trace}", page_of(lines, skip), then)

    async def run_until(
        self,
        trace: Trace,
        condition: Annotated[
            str,
            Field(
                description="'node /ekf', 'topic /odom', '/odom: pose.pose.position.x > 3', "
                "'exception', 'log warn', 'when ekf.speed > 1', 'watch ekf.speed'"
            ),
        ],
        start: Annotated[
            int | None,
            Field(description="Number of the event to begin before (default: an end)", ge=0),
        ] = None,
        backwards: Annotated[bool, Field(description="Go back in time")] = False,
    ) -> str:
        """Run the trace's job again until a condition holds, forwards or backwards; show the event
        and the source of its callback."""

        def go(session: DebugSession) -> tuple[list[str], RunPosition | None]:
            point = session.break_at(condition)
            try:
                place = start if start is not None else _end(session) if backwards else 0
                session.go_to(place + backwards)  # going back leaves out what holds at its start
                stopped = session.reverse_go_on() if backwards else session.go_on()
                if backwards and stopped.position.is_next and stopped.position.index >= place:
                    stopped = session.reverse_go_on()
                source = session.inspect("source") if stopped.position.event else None
                lines = [*stopped_lines(stopped), *_source_lines(source)]
                return lines, stopped.position if stopped.breakpoint is not None else None
            finally:
                session.clear(point.number)

        lines, position = await self._sessions.use(self._access.existing(trace), go)
        if position is None:
            other = f"run_until({trace!r}, {condition!r}, backwards={not backwards})"
            return answer(f"{trace}: {condition}", page_of(lines), [other])
        at = position.index - (not position.is_next)
        on = max(at, 0) if backwards else position.index + position.is_next
        again = f"run_until({trace!r}, {condition!r}, start={on}, backwards={backwards})"
        then = [f"{again} goes on"]
        if at >= 0:
            then.append(f"why({trace!r}, {at}); node_state({trace!r}, node, {at})")
        return answer(f"{trace}: {condition}", page_of(lines), then)

    async def what_if(
        self,
        trace: Trace,
        edits: Annotated[
            list[str],
            Field(
                description="PLACE: CHANGE, such as '812: message.x = 3.0', '812: drop()', "
                "'2.5s: topic(\"/odom\").x += 1', '812: node(\"/ekf\").P = 1.0', "
                "'812: delay(\"5ms\")', '812: defer()'"
            ),
        ],
        output: NewTrace,
        replace: Replace = False,
        seconds: Seconds = None,
    ) -> str:
        """Run the trace's job again with edits (a branch), and compare the branch with the
        trace."""
        self._access.require_trust()
        path = self._access.new_trace(output)
        words = ["replay", str(self._access.existing(trace)), "--trust", "-q", "-o", str(path)]
        words += _options("--edit", edits) + ["--force"] * replace
        done = await self._run(words, seconds=seconds)
        then = [f"overview({output!r}) has its checks", f"diff({trace!r}, {output!r})"]
        return self._answer(f"branch of {trace} in {output}", done, then)

    async def explore(
        self,
        job: Job,
        output: Annotated[str, Field(description="Folder for the runs that fail")],
        budget: Annotated[str, Field(description="Runs or time: 200, 60s")] = "100",
        strategy: Annotated[
            str, Field(description="mixed, pct, random, feedback, systematic, faults or vary")
        ] = "mixed",
        settings: Settings = None,
        replace: Replace = False,
        seconds: Seconds = None,
    ) -> str:
        """Search the callback orders of a job for a run that fails a check, raises or deadlocks.
        Stops at the first and makes it small."""
        self._access.require_trust()
        words = ["explore", str(self._access.existing(job)), "-o", str(self._access.path(output))]
        words += ["-q", "--stop-at-first", "--minimize", f"--budget={budget}"]
        words += [f"--strategy={strategy}", *_options("--set", settings), *["--force"] * replace]
        done = await self._run(words, end=True, seconds=seconds)
        then = [f"a larger budget, or another strategy; verify({job!r})"]
        if done.status == 1:
            named = _SMALL.search("\n".join(done.page.lines))
            small = f"{output}/small/{named[1] if named else 'NUMBER'}"
            then = [
                f"diff('{small}/passing.mcap', '{small}/failing.mcap') shows what fails it",
                f"overview('{small}/failing.mcap'), if the job fails in its default order",
            ]
        return self._answer(f"search of {job}", done, then)

    async def verify(
        self,
        job: Job,
        runs: Annotated[int, Field(ge=2, le=100)] = 3,
        settings: Settings = None,
        seconds: Seconds = None,
    ) -> str:
        """Run a job several times under perturbed environments and compare: is its code itself
        deterministic?"""
        self._access.require_trust()
        words = ["verify", str(self._access.existing(job)), f"--runs={runs}"]
        done = await self._run([*words, *_options("--set", settings)], end=True, seconds=seconds)
        then = [f"explore({job!r}, 'found') searches the callback orders"]
        if done.status == 1:
            then = ["the report names the event and the perturbation; read that callback's code"]
        return self._answer(f"verify {job}", done, then)

    # -- in common ---------------------------------------------------------------------------------

    async def _last_change(self, trace: str, node: str, attribute: str, event: int | None) -> int:
        def find(session: DebugSession) -> int:
            session.go_to(_end(session) if event is None else event + 1)
            return session.last_changed(node, attribute).index - 1

        return await self._sessions.use(self._access.existing(trace), find)

    async def _event_page(
        self,
        form: str,
        trace: str,
        event: int,
        then: Sequence[str],
        sections: Sequence[str],
        skip: int,
    ) -> str:
        folders = json.dumps([str(one) for one in self._access.folders])
        path = str(self._access.existing(trace))
        words = [form, path, str(event), folders, json.dumps(list(sections))]
        done = await self._run(words, module="rsltrace.cli.mcp_server.event_page", skip=skip)
        return self._answer(f"{form}: event {event} of {trace}", done, then)

    async def _read(self, title: str, words: Sequence[str], then: Sequence[str], skip: int) -> str:
        return self._answer(title, await self._run(words, skip=skip), then)

    async def _run(
        self,
        words: Sequence[str],
        *,
        module: str = "rsltrace",
        skip: int = 0,
        end: bool = False,
        keeper: PageKeeper | None = None,
        seconds: float | None = None,
    ) -> CommandResult:
        limit_s = min(self._access.limit_s, seconds or self._access.limit_s)
        keeper = keeper or PageKeeper(skip=skip, end=end)
        return await run_command(words, limit_s, module=module, keeper=keeper)

    def _answer(self, title: str, done: CommandResult, then: Sequence[str]) -> str:
        """Return the answer of a command.

        :raises RefusedError: with the same, if the command could not do it.
        """
        if not done.has_failed:
            status = f" (exit status {done.status})" if done.status else ""
            return answer(f"{title}{status}", done.page, then)
        how = "change what the message names"
        if done.status is None:
            how = "ask for less (until, budget), or have the server started with a greater --limit"
        raise RefusedError(answer(f"{title}: it {done.ended}", done.page, [how]))


def _end(session: DebugSession) -> int:
    """Return the place before the nodes are destroyed, which changes every value."""
    index = session.events or 0
    while index and session.event(index - 1)["kind"] == "shutdown":
        index -= 1
    return index


def _options(name: str, values: Iterable[str] | None) -> list[str]:
    """One word each: a value that begins with - is none the less a value."""
    return [f"{name}={value}" for value in values or ()]


def _look_at(trace: str, page: Page) -> list[str]:
    """Return what to do with the first event that a text names."""
    named = _EVENT.search("\n".join(page.lines))
    if named is None:
        return []
    return [f"event({trace!r}, {named[1]}); why({trace!r}, {named[1]}) for the causes"]


def _source_lines(source: dict[str, object] | None) -> Iterator[str]:
    """Yield the source of a callback with its place."""
    if source is None:
        return
    first = int(str(source["line"]))
    yield f"{source['name']}, {Path(str(source['file'])).name}:{first}"
    lines = source["lines"]
    assert isinstance(lines, list)
    for number, text in enumerate(lines, first):
        yield f"  {number:>4}  {text}"
