"""All processes of a run: how they start, and that none is left behind."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import field
from itertools import islice
from pathlib import Path

from rsltrace.adapters.processes.child import ProcessHandle
from rsltrace.adapters.processes.endpoints import QueueEndpoint
from rsltrace.adapters.processes.process import Process
from rsltrace.errors import RunError
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.simulation.loop.loop import Dispatchable
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.events.event import OutsideEvent
from rsltrace.simulation.middleware.events.failure import end_run, record_exception
from rsltrace.simulation.middleware.interface import MessageType, ServiceType
from rsltrace.trace.model.event import NO_EVENT, EventKind
from rsltrace.trace.model.finding import NondeterminismSource

_LOOKS_AHEAD = 64
"""How much of the ready queue is looked at for others that may begin."""


@dataclass(frozen=True, slots=True)
class ProcessProgram:
    """What to start as a process: the whole command line, and what it finds around it.

    Its addresses are ``fixed`` (the same in every run, where the system allows that), random, or,
    with None, what those of this process would be. If ``noise``, a seed, is not 0, its heap is
    fragmented first. Its sleeps take no simulated time with ``instant_sleep``; its messages may
    stay in it with ``intra_process``.
    """

    argv: Sequence[str]
    environment: Mapping[str, str] = field(default_factory=dict)
    folder: Path | None = None
    fixed: bool | None = True
    noise: int = 0
    instant_sleep: bool = False
    intra_process: bool = False


@dataclass(frozen=True, slots=True)
class TypeLookup:
    """Where the adapter gets types from, which it knows by name only."""

    message: Callable[[str], MessageType]
    service: Callable[[str], ServiceType]


Log = Callable[[int, str, str], None]
"""Shows a log record: severity, name of the logger, text."""


class ProcessAdapter:
    """The processes of one run. ``on_end`` is called with the key of each that has ended;
    ``follows_clock`` says of a node whether /clock drives its ROS time. ``note_answer`` takes what
    code has drawn or read (source, call, answer, stack, node, how often). ``clock`` is there if
    nodes have clocks of their own: given a node (None: nobody) and whether a ROS clock is looked
    at, it says what is shown, and whether that stays so throughout the event. ``parallel``:
    processes compute at the same time where the loop's order is first come, first served."""

    def __init__(self, domain: Domain, interfaces: TypeLookup, *, seed: int, log: Log) -> None:
        self.domain = domain
        self.log = log
        self.message_type = interfaces.message
        self.service_type = interfaces.service
        self.processes: list[Process] = []
        self.follows_clock: Callable[[str], bool] = lambda node: False
        self.clock: Callable[[str | None, bool], tuple[int, bool]] | None = None
        self.note_answer: Callable[[NondeterminismSource, str, str, str, str, int], None]
        self.note_answer = lambda source, call, answer, stack, node, calls: None
        self.on_end: Callable[[str], None] = lambda key: None
        self.parallel = False
        self._seed = seed

    def seed_of(self, key: str) -> int:
        """Return the number from which a process draws what others take for entropy."""
        return RandomStream(self._seed, f"process\0{key}").below(1 << 53)

    def start(
        self,
        program: ProcessProgram,
        *,
        name: str,
        key: str,
        log_failure: bool,
        cause: tuple[int, int] = (NO_EVENT, 0),
        on_start: Callable[[], None] = lambda: None,
    ) -> None:
        """Start a process and let it run up to its first wait, as one event."""
        domain = self.domain
        process = Process(
            self,
            name,
            key,
            log_failure=log_failure,
            instant_sleep=program.instant_sleep,
            intra_process=program.intra_process,
        )
        process.begun_ns = domain.loop.now_ns
        process.entity_id = domain.entities.new_id()
        domain.entities.pending.append(process)
        self.processes.append(process)

        def begin() -> None:
            on_start()
            argv, environment, folder = program.argv, program.environment, program.folder
            fixed, noise = program.fixed, program.noise
            process.begin(
                lambda: ProcessHandle(argv, environment, folder, name, fixed=fixed, noise=noise)
            )

        domain.dispatcher.run_outside(
            OutsideEvent(process.describe),
            EventKind.CONSTRUCT,
            process.entity_id,
            None,
            begin,
            cause,
        )

    def has_ended(self, process: Process) -> None:
        """Take note that a process has ended, in the event under way."""
        self.on_end(process.key)

    def begin_others(self, running: Process) -> None:
        """Let other processes begin with what comes next for them, while one computes.

        The next event of a process is the first of its own in the ready queue, whatever others
        send meanwhile: that comes behind it. What it says is taken when its turn comes, so the
        trace is the same. ``None`` stands for what is in rsltrace's process.
        """
        dispatcher = self.domain.dispatcher
        if not self.parallel or dispatcher.is_steered:
            return
        earlier: set[object] = {running}
        for thing in islice(dispatcher.loop.ready, _LOOKS_AHEAD):
            process = getattr(thing, "process", None)
            if (
                isinstance(thing, QueueEndpoint)
                and process not in earlier
                and thing.may_run()
                and not thing.process.has_begun
                and thing.process.wants(thing)
                and not thing.may_lose_arrivals(earlier)
            ):
                thing.begin()
            earlier.add(process)

    @property
    def exit_code(self) -> int:
        """1 if a process has failed that may, else 0."""
        return int(any(one.has_failed for one in self.processes))

    def end(self) -> None:
        """End all that still run, in the order of their start, each as one event."""
        for process in self.processes:
            if process.ended is not None or self.domain.outcome.error is not None:
                continue

            self.domain.dispatcher.run_outside(
                OutsideEvent(process.describe),
                EventKind.SHUTDOWN,
                process.entity_id,
                None,
                process.stop,
            )

    def close(self) -> None:
        """Kill what is left, however the run has ended."""
        for process in self.processes:
            with suppress(AttributeError):  # could not be started
                process.child.close()

    def raised(self, error: BaseException, handle: Dispatchable) -> None:
        """End the run because of what an event of a process has raised."""
        dispatcher = self.domain.dispatcher
        if isinstance(error, KeyboardInterrupt):
            dispatcher.loop.stop(Stop("interrupted", 130))
            return
        raised = record_exception(dispatcher, error, handle)
        end_run(dispatcher, raised, error if isinstance(error, RunError) else raised.as_error())
