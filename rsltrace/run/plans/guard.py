"""The guard of a run."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from rsltrace.errors import JobError
from rsltrace.guard.callers import is_rsltrace_module, module_of
from rsltrace.guard.guard import Guard, engage
from rsltrace.guard.install import installed
from rsltrace.guard.loading import when_loaded
from rsltrace.guard.pin import pinned_place
from rsltrace.guard.virtual.clocks import opencv_clock
from rsltrace.guard.virtual.original_code import CODE_READERS, show_original
from rsltrace.guard.virtual.randomness import seed_shared_generator
from rsltrace.guard.virtual.third_party_libraries import (
    CFFI_LOADER,
    PYTEST_REWRITER,
    TORCH_COMPILER,
    TorchStreams,
    one_tbb_thread,
    plain_in_graphs,
    pygame_clock,
    report_cffi_functions,
    rewrite_in_pytest,
    torch_streams,
)
from rsltrace.guard.virtual.user_modules import user_modules
from rsltrace.job import Job, NodeSpec, policy_of
from rsltrace.simulation.middleware.events.event import CurrentEvent
from rsltrace.simulation.middleware.events.observer import EventCall, EventObserver, ObserverOrder
from rsltrace.trace.format import METADATA_GUARD
from rsltrace.trace.model.finding import (
    Finding,
    GuardCount,
    GuardMode,
    NondeterminismSource,
    counts_text,
)
from rsltrace.trace.native import refuse_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

if TYPE_CHECKING:
    from rsltrace.adapters.rclpy.world import World


_ONE_PROCESSOR = "'taskset --cpu-list 0' before 'rsltrace record' gives it one processor"


class _TorchGenerators(EventObserver):
    """Gives each node its own state of torch's random generator."""

    order = ObserverOrder.GENERATORS

    def __init__(
        self, streams: TorchStreams, event: CurrentEvent, name_of: Callable[[], str]
    ) -> None:
        self._streams = streams
        self._event = event
        self._name_of = name_of

    def before_event(self, call: EventCall) -> bool:
        self._event.handle, self._event.node = call.handle, call.node
        self._streams.enter(self._name_of())
        return True

    def node_entered(self, node: object, *, is_made: bool) -> None:
        """Enter a node, or rename its maker's state to it."""
        (self._streams.rename if is_made else self._streams.enter)(self._name_of())


class RunGuard:
    """The guard of one run; without one (``guard: false``) everything here does nothing."""

    def __init__(self, job: Job, stack: ExitStack) -> None:
        self._job = job
        self._stack = stack
        self.guard: Guard | None = None
        self._world: World | None = None
        self._early: list[Finding] = []
        self._unpinned: list[tuple[str, str]] = []
        self._has_torch = False

    def begin(self, world: World, replay: Path | None = None) -> None:
        """Make the guard of a world; ``engaged`` activates it."""
        from rsltrace.adapters.rclpy.guard_context import GuardContext

        loop, dispatcher = world.domain.loop, world.domain.dispatcher

        def on_finding(finding: Finding) -> None:
            if dispatcher.recorder is not None:
                dispatcher.recorder.finding(finding, loop.now_ns)
            elif not loop.events:
                self._early.append(finding)  # of an import, before there is a trace

        self._world = world
        if replay is not None and not self._job.guard.enabled:
            raise JobError("'guard: false' in the job: nothing from outside can be given again")
        job = self._job
        if job.guard.enabled:
            self.guard = Guard(
                GuardContext(world.runtime, world.clocks),
                policy=policy_of(job.guard),
                seed=job.seed,
                packages=node_packages(job.nodes),
                on_finding=on_finding,
                one_policy=all(spec.guard is None for spec in job.nodes),
            )
            seed_shared_generator(self._stack, job.seed)
            for library, why in self._unpinned:
                self._report(self.guard, library, why, sys._getframe())
            if replay is not None:
                with Trace.open(replay) as trace:
                    refuse_native(trace, "no answers from outside are in it")
                    kept = [one for found in trace.findings.values() for one in found]
                self.guard.answers.replay(kept, str(replay))
        world.states.policy = policy_of(job.guard)
        if self.guard is not None and self.guard.is_virtual(NondeterminismSource.CLOCK):
            self._begin_log_time(loop.now_ns)
        if "torch" in sys.modules:
            self.torch_loaded()

    def _begin_log_time(self, now_ns: int) -> None:
        """Let ``logging`` count time from the start of the run."""
        module: Any = logging
        self._stack.callback(setattr, module, "_startTime", module._startTime)
        whole = isinstance(module._startTime, int)  # nanoseconds, from Python 3.13 on
        module._startTime = now_ns if whole else now_ns / 1e9

    def torch_loaded(self) -> None:
        """Give each node its own state of torch's generator from now on."""
        world, guard = self._world, self.guard
        if world is None or guard is None or self._has_torch:
            return
        self._has_torch = True
        streams = torch_streams(self._stack, guard)
        world.domain.dispatcher.add_observer(
            _TorchGenerators(streams, world.domain.event, guard.context.node)
        )
        streams.enter(guard.context.node())

    def report_unpinned_library(self, library: str, why: str) -> None:
        """Report a library whose threads cannot be pinned."""
        if self.guard is None:
            self._unpinned.append((library, why))  # met before the run
            return
        frame = sys._getframe()
        while is_rsltrace_module(module_of(frame)) and frame.f_back is not None:
            frame = frame.f_back
        self._report(self.guard, library, why, frame)

    def _report(self, guard: Guard, library: str, why: str, frame: FrameType) -> None:
        mode = guard.mode(NondeterminismSource.THREAD, frame)
        if mode is not GuardMode.ALLOW:
            call = f"the threads of TBB in {library}"
            guard.report(NondeterminismSource.THREAD, mode, call, f"{why}; {_ONE_PROCESSOR}", frame)

    def trace_begins(self, recorder: Recorder, now_ns: int) -> None:
        """Record the findings of imports, from before the trace was open."""
        for finding in self._early:
            recorder.finding(finding, now_ns)
        self._early.clear()

    @property
    def counts(self) -> tuple[GuardCount, ...]:
        counts = self.guard.counts if self.guard is not None else {}
        return tuple(GuardCount(*key, count) for key, count in sorted(counts.items()))

    def write(self, writer: TraceWriter) -> None:
        summary = {}
        if self.counts:
            summary["calls"] = counts_text(self.counts)
        states = self._world.states.by_node if self._world is not None else {}
        left_out = {name: state.left_out for name, state in states.items() if state.left_out}
        if left_out:
            summary["left_out"] = json.dumps(left_out, sort_keys=True, ensure_ascii=False)
        if summary:
            writer.add_metadata(METADATA_GUARD, summary)

    def engaged(self) -> AbstractContextManager[None]:
        """Let the guard apply to this thread."""
        return nullcontext() if self.guard is None else engage(self.guard)


def install_guard(stack: ExitStack, job: Job) -> RunGuard:
    """Install the replacements until ``stack`` ends."""
    made = RunGuard(job, stack)
    if job.guard.enabled:
        if job.guard.pins:
            stack.enter_context(pinned_place())
            stack.enter_context(one_tbb_thread(made.report_unpinned_library))
        stack.enter_context(installed())
        patches: dict[str, Callable[[], None]] = {
            "torch": made.torch_loaded,
            "cv2": lambda: opencv_clock(stack),
            "pygame": lambda: pygame_clock(stack),
            TORCH_COMPILER: plain_in_graphs,
            CFFI_LOADER: lambda: report_cffi_functions(stack),
            **{name: partial(show_original, name, stack) for name in CODE_READERS},
        }
        orders = _orders_sets(job)
        if orders:
            patches[PYTEST_REWRITER] = lambda: rewrite_in_pytest(stack)
        stack.enter_context(user_modules(node_packages(job.nodes), rewrites=orders))
        for name, patch in patches.items():
            when_loaded(stack, name, patch)
    return made


def _orders_sets(job: Job) -> bool:
    """Whether the guard rewrites uses of sets; otherwise code is compiled unchanged."""
    policies = [policy_of(job.guard)]
    policies += [policy_of(job.guard, spec.guard) for spec in job.nodes if spec.guard is not None]
    modes = (policy.modes.get(NondeterminismSource.ORDER, GuardMode.VIRTUAL) for policy in policies)
    return any(mode is not GuardMode.ALLOW for mode in modes)


def node_packages(nodes: Sequence[NodeSpec]) -> frozenset[str]:
    """Return the packages of the nodes: user code, wherever it is installed."""
    return frozenset(spec.package for spec in nodes) - {"", "rsltrace", "rclpy"}
