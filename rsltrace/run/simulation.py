"""A run that its caller drives step by step, like a Gym environment."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

from rsltrace.errors import DeadlockError, RunError, near_or_all
from rsltrace.job import Job, load_job
from rsltrace.job.values.names import check_topic
from rsltrace.job.values.times import parse_time, parse_time_in_run
from rsltrace.run.driver import Driver
from rsltrace.run.forked import ForkedRun, ForkResult
from rsltrace.run.session import RunResult, RunSession
from rsltrace.simulation.loop.loop import NOTHING_LEFT
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.model.texts import format_seconds

if TYPE_CHECKING:
    from rsltrace.job import FaultSpec


class TopicTap:
    """The messages published on a topic since ``Simulation.subscribe`` was called.

    ``messages`` are (simulated ns, message), oldest first, the last ``depth`` of them; ``count`` is
    how many there were in all. Messages are seen when they are published, before any delay.
    """

    def __init__(
        self, topic: str, callback: Callable[[Any], object] | None, depth: int | None
    ) -> None:
        self.topic = topic
        self.messages: deque[tuple[int, Any]] = deque(maxlen=depth)
        self.count = 0
        self.callback = callback

    @property
    def latest(self) -> Any:
        return self.messages[-1][1] if self.messages else None

    def take(self) -> Any:
        return self.messages.popleft()[1] if self.messages else None

    def __iter__(self) -> Iterator[Any]:
        return iter([message for _, message in self.messages])

    def __len__(self) -> int:
        return len(self.messages)

    def add(self, stamp_ns: int, message: Any) -> None:
        self.count += 1
        self.messages.append((stamp_ns, message))


T = TypeVar("T")
Time = str | int | float
"""As in a job: seconds as a number, or text with a unit (``5ms``)."""


class Simulation:
    """The whole graph of a job as one controllable unit.

    >>> with rsltrace.Simulation("job.yaml") as sim:                  # doctest: +SKIP
    ...     scan = sim.subscribe("/scan")
    ...     while not sim.done:
    ...         sim.publish("/cmd_vel", policy(scan.latest))
    ...         sim.run_for(0.1)
    >>> sim.result.exit_code                                          # doctest: +SKIP

    Entering the block constructs the nodes, leaving it destroys them and closes the trace.
    Simulated time moves only within ``step``, ``run``, ``run_for``, ``run_until``,
    ``wait_for_message`` and ``call``; when a node fails, they raise its error, and the run is over.
    """

    def __init__(
        self,
        job: Job | str | os.PathLike[str],
        output: str | os.PathLike[str] | None = None,
        *,
        force: bool = False,
        echo: bool = False,
        forks: bool = False,
    ) -> None:
        """Take a job (or the path of a job file) and, to record it, the trace to write.

        ``force`` overwrites a trace, ``echo`` prints the nodes' log records on stderr. With
        ``forks`` the run can be continued in several ways (``fork``): its trace is kept in memory
        until it is over.

        :raises JobError: if the job file is wrong.
        """
        loaded = job if isinstance(job, Job) else load_job(job)
        path = None if output is None else Path(output)
        if forks:
            self._forking: ForkedRun | None = ForkedRun(loaded, path, force=force, echo=echo)
            self._session = self._forking.session
        else:
            self._forking = None
            self._session = RunSession(loaded, path, force=force, echo=echo)
        self._entered: Driver | None = None
        self._taps: dict[str, list[TopicTap]] = {}
        self._result: RunResult | None = None

    def __enter__(self) -> Simulation:
        """Construct the nodes and jump to the start; nothing has run yet.

        :raises RsltraceError: the job, the machine or a constructor is at fault.
        """
        if self._entered is not None:
            raise RunError("a Simulation is entered once: make another one for another run")
        if self._forking is not None:
            self._forking.begin()
        self._session.__enter__()
        self._entered = Driver(self._session)
        try:
            self._entered.begin()
        except BaseException as error:
            self.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        """Destroy the nodes, close the trace and fill in ``result``.

        :raises RunError: if a node fails when it is destroyed.
        """
        driver = self._driver
        try:
            driver.leave()
            if not driver.ended:
                driver.loop.stop(self._stop_on_exit(error))
            if self._forking is not None:
                self._forking.settle()
            self._result = self._session.finish()
            if error is None:
                driver.raise_error()
        finally:
            self._session.__exit__(kind, error, where)

    def _stop_on_exit(self, error: BaseException | None) -> Stop:
        if error is not None:
            return Stop(f"the driver of the simulation raised {type(error).__qualname__}", 1)
        loop = self._driver.loop
        idle = loop.next_ns() is None and not loop.ready and not loop.tasks
        return Stop(NOTHING_LEFT if idle else "left by the driver of the simulation")

    @property
    def _driver(self) -> Driver:
        if self._entered is None:
            raise RunError("enter the simulation first: with rsltrace.Simulation(job) as sim: …")
        return self._entered

    @property
    def result(self) -> RunResult:
        """How the run went, as ``record`` returns it; there once the block has been left."""
        if self._result is None:
            raise RunError("the result of a simulation is there when its block has been left")
        return self._result

    @property
    def done(self) -> bool:
        """Whether the run is over: a stop condition of the job, a node's shutdown, an error."""
        return self._result is not None or self._driver.ended

    @property
    def stop_reason(self) -> str | None:
        """Why the run is over, or None while it is not."""
        stop = self._session.stop or self._driver.loop.stopped
        return None if stop is None else stop.reason

    def stop(
        self, reason: str = "stopped by the driver of the simulation", exit_code: int = 0
    ) -> None:
        if not self.done:
            self._driver.loop.stop(Stop(reason, exit_code))

    @property
    def now_ns(self) -> int:
        return self._driver.loop.now_ns

    @property
    def events(self) -> int:
        """How many events (callbacks and the like) have run."""
        return self._driver.loop.events

    @property
    def digest(self) -> str:
        """The digest of the run so far; empty in a simulation that records nothing."""
        return self._session.digest if self._result is None else self._result.digest

    @property
    def nodes(self) -> list[Any]:
        """The nodes, in the order of their construction."""
        self._check_there()
        return self._session.world.all_nodes()

    def node(self, name: str) -> Any:
        """Return a node by its name (``ekf``) or its name with namespace (``/husky/ekf``).

        :raises RunError: if there is none of that name, or more than one.
        """
        names = {node.handle.key: node for node in self.nodes}
        found = [n for n in names if n == name or (name[:1] != "/" and n.endswith(f"/{name}"))]
        if len(found) == 1:
            return names[found[0]]
        if found:
            raise RunError(f"several nodes are named {name}: {', '.join(found)}; give one of these")
        raise RunError(f"there is no node named {name}{near_or_all(name, names)}")

    def step(self) -> bool:
        """Run the next time step: all that is ready now, or else all that is due next.

        Return whether there was one: False when the run is over or nothing is left to happen.

        :raises RunError: what went wrong in a node.
        """
        before = self._driver.position()
        self._driver.go(steps=1)
        return self._driver.position() != before

    def run(self) -> None:
        """Run to the end of the job, as ``record`` would.

        :raises RunError: what went wrong: in a node, a livelock, a deadlock.
        """
        self._driver.go(to_the_end=True)

    def run_for(self, duration: Time) -> bool:
        """Run everything up to and including ``duration`` from now; time stands still there.

        Return False if the run ended.
        """
        self._run_to(self.now_ns + parse_time(duration))
        return not self.done

    def run_until(self, goal: Time | Callable[[], object], *, timeout: Time | None = None) -> bool:
        """Run to a time since the start (``"@5s"``: to simulated time 5 s), or until ``goal()`` is
        true, asked after each time step.

        Return False if the run ended, or ``timeout`` (simulated time) passed, before that.
        """
        if not callable(goal):
            time_ns = self._goal_ns(goal)
            self._run_to(time_ns)
            return not self.done or self.now_ns >= time_ns
        limit_ns = None if timeout is None else self.now_ns + parse_time(timeout)
        while not goal():
            before = self._driver.position()
            if self.done or (limit_ns is not None and self.now_ns >= limit_ns):
                return False
            self._driver.go(steps=1, until_ns=limit_ns)
            if self._driver.position() == before:
                return bool(goal())
        return True

    def _goal_ns(self, goal: Time) -> int:
        if isinstance(goal, str):
            return parse_time_in_run(goal).stamp_ns(self._session.start_ns)
        return self._session.start_ns + parse_time(goal)

    def fork(
        self,
        function: Callable[[Simulation], T],
        output: str | os.PathLike[str] | None = None,
        *,
        faults: Sequence[FaultSpec | dict[str, Any]] = (),
    ) -> ForkResult[T]:
        """Call ``function`` with this simulation in a copy of the process, which goes on from here;
        return what it returns (pickled on the way) and how that run went. Here nothing changes.

        ``output`` is the trace to write of the whole run, from its beginning; ``faults`` go wrong
        in it beside those of the job. The copy has none of your own threads.

        :raises RunError: the simulation was made without ``forks=True``, cannot be copied, or the
            faults are not of what is to come; what goes wrong in the copy.
        :raises OutputError: the trace cannot be written.
        """
        self._driver.check_driver()
        self._check_going()
        if self._forking is None:
            raise RunError("a simulation forks if it is made with forks=True")
        job = self._forking.job_with(faults)
        path = None if output is None else Path(output)

        def go_on() -> ForkResult[T]:
            assert self._forking is not None
            self._forking.begin_copy(job, path)
            try:
                value = function(self)
            except BaseException as error:
                self.__exit__(type(error), error, error.__traceback__)
                raise
            self.__exit__(None, None, None)
            return ForkResult(value, self.result)

        found: ForkResult[T] = self._forking.in_copy(go_on)
        return found

    def _run_to(self, time_ns: int) -> None:
        if time_ns < self.now_ns:
            start_ns = self._session.start_ns
            raise RunError(
                f"simulated time is {format_seconds(self.now_ns - start_ns)} s already, past "
                f"{format_seconds(time_ns - start_ns)} s"
            )
        self._driver.go(until_ns=time_ns)

    def wait_for_message(self, topic: str, *, timeout: Time | None = None) -> Any:
        """Run until the next message on ``topic`` is published; return it, or None if none came."""
        tap = self.subscribe(topic, depth=1)
        try:
            self.run_until(lambda: tap.count, timeout=timeout)
            return tap.latest
        finally:
            self.unsubscribe(tap)

    def publish(self, topic: str, message: Any, *, qos: Any = 10) -> int:
        """Publish a message at the present time; return to how many subscriptions it goes.

        They receive it when time goes on. ``qos`` is a depth or an rclpy QoSProfile; that of a
        topic's first message counts. In the trace it is an event of kind ``outside``.

        :raises RunError: if the topic carries another type, or the run is over.
        """
        topic = _topic(topic)
        self._driver.check_outside()
        self._check_going()
        count = self._driver.outside.publish(topic, message, qos)
        self._driver.raise_error()
        return count

    def call(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        """Call a function within the simulation, as an event of kind ``outside``.

        It may do what a callback may: create entities, publish, and wait in simulated time (call a
        service, sleep), during which time goes on. What it raises is raised here.

        :raises DeadlockError: if it waits for what can never come.
        """
        self._driver.check_driver()
        self._check_going()

        def given() -> Any:
            return function(*arguments, **named)

        given.__qualname__ = getattr(function, "__qualname__", "a function")
        call = self._driver.outside.call(given)
        while not call.done:
            if self.done:
                raise RunError(
                    f"the run ended ({self.stop_reason}) while {given.__qualname__} waited"
                )
            before = self._driver.position()
            self._driver.go(steps=1)
            if self._driver.position() == before and not call.done and not self.done:
                raise DeadlockError(self._session.world.waiting())
        return call.result()

    def subscribe(
        self,
        topic: str,
        callback: Callable[[Any], object] | None = None,
        *,
        depth: int | None = 1000,
    ) -> TopicTap:
        """Listen to a topic from outside: it keeps the last ``depth`` messages (None: all).

        ``callback(message)`` is called at the end of the time step in which it was published. The
        nodes do not notice, and the trace is the same as without.
        """
        self._check_there()
        topic = _topic(topic)
        tap = TopicTap(topic, callback, depth)
        if topic not in self._taps:
            self._taps[topic] = []
            self._session.world.domain.watch(topic, self._watcher(self._taps[topic]))
        self._taps[topic].append(tap)
        return tap

    def unsubscribe(self, tap: TopicTap) -> None:
        taps = self._taps.get(tap.topic, [])
        if tap in taps:
            taps.remove(tap)

    def _watcher(self, taps: list[TopicTap]) -> Callable[[Any, bytes], None]:
        from rsltrace.adapters.rclpy.messages.codec import codec_for
        from rsltrace.adapters.rclpy.messages.interfaces import class_of

        driver = self._driver

        def watch(publisher: Any, data: bytes) -> None:
            for tap in taps:
                message = codec_for(class_of(publisher)).deserialize(data)
                tap.add(driver.loop.now_ns, message)
                if tap.callback is not None:
                    driver.call_listener_later(tap.callback, message)

        return watch

    def _check_going(self) -> None:
        if self.done:
            raise RunError(f"the run is over: {self.stop_reason}")

    def _check_there(self) -> None:
        if self._result is not None or self._entered is None:
            raise RunError("the nodes are there only within the block of the simulation")


def _topic(name: str) -> str:
    """Return a topic with its leading slash."""
    topic = name if name.startswith("/") else f"/{name}"
    try:
        check_topic(topic)
    except ValueError as error:
        raise RunError(str(error)) from None
    return topic
