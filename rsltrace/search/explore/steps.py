"""The choices of a run, and what each step touched.

A search that changes the order of a run needs to know which changes could matter. Two steps commute
unless one writes what the other reads or writes: a node (its own callbacks), a topic or service
(the queue of its subscription), or everything (an entity is created or destroyed, an exception).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rsltrace.run.session import RunSession
from rsltrace.search.explore.trial import TrialStep
from rsltrace.simulation.loop.ordered import OrderedLoop
from rsltrace.simulation.loop.policy import Candidate, ChoicePoint
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventFlag, OutputKind
from rsltrace.trace.model.finding import NondeterminismSource
from rsltrace.trace.reader import Trace

# What a run did, as hashes that other runs of the job can be compared with.

Hashes = npt.NDArray[np.uint64]

_FACTORS = tuple(
    np.uint64(factor)
    for factor in (
        0x9E3779B97F4A7C15,
        0xC2B2AE3D27D4EB4F,
        0x165667B19E3779F9,
        0x27D4EB2F165667C5,
        0x94D049BB133111EB,
    )
)
_SHIFT = np.uint64(29)


def identities(trace: Trace) -> dict[int, str]:
    """Return a name for each entity that it has in other runs, too: node, kind, name, and which
    one of several that are called alike."""
    names: dict[int, str] = {}
    seen: dict[str, int] = {}
    for entity in trace.entities.values():
        name = f"{_node(trace, entity)} {entity.kind.label} {entity.name}"
        seen[name] = seen.get(name, 0) + 1
        names[entity.id] = name if seen[name] == 1 else f"{name} ({seen[name]})"
    return names


def _node(trace: Trace, entity: Entity) -> str:
    return trace.node_of(entity).name if entity.node else ""


def events_of(trace: Trace) -> npt.NDArray[np.void]:
    """Return the events of a run before its nodes were destroyed."""
    pieces = list(trace.events(0, trace.ended_after))
    return np.concatenate(pieces) if pieces else np.empty(0, dtype=[("entity", "<u4")])


def behaviours_of(trace: Trace) -> tuple[int, ...]:
    """Return a hash for each kind of thing that happened: an event with its content and the state
    of its node after it, and two events of a node one after the other."""
    events = events_of(trace)
    if not len(events):
        return ()
    by_id, nodes = _tables(trace)
    entity = events["entity"]
    name = by_id[entity]
    kind = events["kind"].astype(np.uint64)
    done = _mixed(name, kind, events["input_hash"], events["output_hash"], events["state_hash"])
    node = nodes[entity]
    order = np.argsort(node, kind="stable")
    same = node[order][1:] == node[order][:-1]
    first, second = name[order][:-1][same], name[order][1:][same]
    return tuple(np.unique(np.concatenate([done, _mixed(first, second)])).tolist())


def final_state_of(trace: Trace) -> str:
    """Return a hash of how the nodes were at the end: 16 hex digits.

    A node counts with the hash of its state where that is made (``guard: state``), else with all
    of its events in their order: two runs with the same hash have left the same nodes then.
    """
    events = events_of(trace)
    if not len(events):
        return ""
    by_id, nodes = _tables(trace)
    owner = nodes[events["entity"]]
    total, names = 0, identities(trace)
    for node in np.unique(owner).tolist():
        own = events[owner == node]
        last = int(own["state_hash"][-1])
        if last == 0:
            done = _mixed(by_id[own["entity"]], own["input_hash"], own["output_hash"])
            last = hash64(done.tobytes())
        total ^= hash64(f"{names[node]}\0{last:016x}".encode())
    return f"{total:016x}"


def _tables(trace: Trace) -> tuple[Hashes, npt.NDArray[np.int64]]:
    """Return a hash of the name, and the node, of each entity by its id."""
    size = max(trace.entities) + 1
    hashes, nodes = np.zeros(size, dtype=np.uint64), np.zeros(size, dtype=np.int64)
    for number, name in identities(trace).items():
        hashes[number] = hash64(name.encode())
        nodes[number] = trace.entity(number).node
    return hashes, nodes


def _mixed(*columns: npt.NDArray[np.uint64]) -> Hashes:
    """Return one hash for each row."""
    total = np.zeros(len(columns[0]), dtype=np.uint64)
    for column, factor in zip(columns, _FACTORS, strict=False):
        total = (total ^ column) * factor
        total ^= total >> _SHIFT
    return total


EVERYTHING = "*"
_TALK = frozenset((OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE))
_CHANGES_ALL = frozenset((OutputKind.ENTITY, OutputKind.SHUTDOWN, OutputKind.EXCEPTION))
_LISTENS = frozenset((EntityKind.SUBSCRIPTION, EntityKind.CLIENT, EntityKind.SERVICE))
_COMES_AND_GOES = frozenset((EntityKind.TASK, EntityKind.THREAD, EntityKind.MAIN))
_ROSOUT = "/rosout"

_Timers = tuple[tuple[str, int, bool], ...]


@dataclass(frozen=True, slots=True)
class _PolicyChoice:
    """One choice of the policy: (entity id, kind, node, entity) of all that could run."""

    ready: tuple[tuple[int, str, str, str], ...]
    chosen: int
    phase: int
    events: int


@dataclass(frozen=True, slots=True)
class _PhaseEnd:
    """The end of a phase: number of events, time, and state of the timers."""

    events: int
    now_ns: int
    timers: _Timers


class TrialObserver:
    """Observes the choices of a run's policy, from before it begins."""

    def __init__(self, session: RunSession, *, steps: bool, fork_ns: int = -1) -> None:
        """``fork_ns``: since the start of the run, when others are forked from it (-1: never)."""
        self.order: list[tuple[int, int]] = []
        """Of each choice, which of how many was taken."""
        self.entities: set[tuple[int, int]] = set()
        """All that could run at some time: entity and thread."""
        self.choices_before = 0
        """How many choices there have been up to ``fork_ns``."""
        self._fork_ns = fork_ns
        self._session = session
        self._asked: list[_PolicyChoice] = []
        self._lulls: list[_PhaseEnd] = []
        loop = session.loop
        if isinstance(loop, OrderedLoop):
            loop.on_choice = self._note
            self._keeps = steps
            if steps:
                loop.on_lull = self._note_lull

    def _note(self, ready: Sequence[Candidate], chosen: int, moment: ChoicePoint) -> None:
        self.entities.update([(one.entity_id, one.thread) for one in ready])
        if len(ready) > 1:
            self.order.append((chosen, len(ready)))
            if moment.now_ns - self._session.start_ns <= self._fork_ns:
                self.choices_before += 1
        if not self._keeps:
            return
        what = tuple((one.entity_id, one.kind, one.node, one.entity) for one in ready)
        self._asked.append(_PolicyChoice(what, chosen, len(self._lulls), moment.events))

    def _note_lull(self) -> None:
        domain, loop = self._session.world.domain, self._session.loop
        timers = tuple(
            (f"{node.key} {timer.entity_id}", timer.state.deadline_ns, timer.state.canceled)
            for node in domain.graph.nodes
            for timer in node.timers
        )
        self._lulls.append(_PhaseEnd(loop.events, loop.now_ns, timers))

    # -- after the run ---------------------------------------------------------------------------

    def steps(self, trace: Trace) -> tuple[TrialStep, ...]:
        """Return the steps of the run, whose trace this is."""
        if not self._asked:
            return ()
        names = identities(trace)
        touches = _TouchedNames(trace, self._programs())
        states = _states(trace, self._lulls, self._may_merge(trace))
        counts: dict[str, int] = {}
        found = []
        for index, one in enumerate(self._asked):
            after = self._asked[index + 1] if index + 1 < len(self._asked) else None
            end = self._lulls[one.phase].events if one.phase < len(self._lulls) else None
            if after is not None and after.phase == one.phase:
                end = after.events
            last = trace.ended_after if end is None else end
            ready = [_name(names, *what) for what in one.ready]
            chosen = ready[one.chosen]
            found.append(
                TrialStep(
                    tuple(_numbered(ready, counts)),
                    one.chosen,
                    one.phase,
                    touches.of(one.ready[one.chosen], one.events, last or one.events),
                    states[one.phase],
                )
            )
            counts[chosen] = counts.get(chosen, 0) + 1
        return tuple(found)

    def _programs(self) -> dict[str, str]:
        """Return, for nodes that live in a process with others, the process."""
        nodes = self._session.world.domain.graph.nodes
        numbers: dict[int, str] = {}
        return {
            node.fully_qualified_name: numbers.setdefault(
                id(node.process), f"process of {node.fully_qualified_name}"
            )
            for node in nodes
            if node.process is not None
        }

    def _may_merge(self, trace: Trace) -> bool:
        """Whether the hashes of nodes' states cover all that later behaviour depends on."""
        job = self._session.job
        if job.delay is not None or job.execution is not None or job.executors is not None:
            return False  # messages may be in transit, workers busy
        if any(entity.kind in _COMES_AND_GOES for entity in trace.entities.values()):
            return False
        return not any(met.source is NondeterminismSource.RANDOM for met in trace.guarded)


def _name(names: dict[int, str], entity_id: int, kind: str, node: str, entity: str) -> str:
    named = names.get(entity_id) if entity_id else None
    if named is None:
        return f"{node} {kind} {entity}"
    return f"{named}, resumed" if kind == "resume" else named


def _numbered(ready: list[str], counts: dict[str, int]) -> list[str]:
    """Number the events of each entity: a second message of a topic comes after the first."""
    here: dict[str, int] = {}
    found = []
    for name in ready:
        here[name] = here.get(name, -1) + 1
        found.append(f"{name} #{counts.get(name, 0) + here[name]}")
    return found


class _TouchedNames:
    """The names that events touch: True for those they write."""

    def __init__(self, trace: Trace, programs: dict[str, str]) -> None:
        self._trace = trace
        self._programs = programs
        self._heard = {one.name for one in trace.entities.values() if one.kind in _LISTENS}

    def of(self, ran: tuple[int, str, str, str], first: int, last: int) -> dict[str, bool]:
        """Return what was touched when something ran, as events ``first`` to ``last`` - 1."""
        touched: dict[str, bool] = {}
        if ran[2]:
            touched[self._place(ran[2])] = True
        elif first >= last and ran[0] == 0:
            touched[EVERYTHING] = True
        for index in range(first, last):
            self._add(touched, index)
        return touched

    def _add(self, touched: dict[str, bool], index: int) -> None:
        trace = self._trace
        event = trace.event(index)
        entity = trace.entity(event.entity)
        if entity.node == 0:
            touched[EVERYTHING] = True
            return
        touched[self._place(trace.node_of(entity).name)] = True
        if entity.kind in _LISTENS:
            touched.setdefault(entity.name, False)
        for output in trace.outputs_of(index):
            if output.kind in _CHANGES_ALL:
                touched[EVERYTHING] = True
            elif output.kind is OutputKind.LOG and _ROSOUT in self._heard:
                touched[_ROSOUT] = True
            elif output.kind in _TALK:
                name = trace.entity(output.entity).name
                if name in self._heard:
                    touched[name] = True

    def _place(self, node: str) -> str:
        return self._programs.get(node, node)


def _states(trace: Trace, lulls: list[_PhaseEnd], may_merge: bool) -> list[str]:
    """Return a hash of everything at the beginning of each phase.

    A node counts with its state hash if that covers everything, else with all its events; what was
    published on transient-local topics counts, too.
    """
    done: dict[int, int] = {}
    states = [hash64(b"begin")]
    at = 0
    latched = _latched(trace)
    for lull in lulls:
        for index in range(at, lull.events):
            event = trace.event(index)
            node = trace.entity(event.entity).node
            if event.flags & EventFlag.SUSPENDED:
                may_merge = False
            content = f"{event.entity} {event.input_hash} {event.output_hash}"
            if event.state_hash and may_merge:
                done[node] = event.state_hash
            else:
                done[node] = hash64(content.encode(), done.get(node, 0))
            for output in trace.outputs_of(index) if latched else ():
                if output.entity in latched:
                    key = -output.entity
                    done[key] = hash64(str(output.hash).encode(), done.get(key, 0))
        at = lull.events
        whole = f"{lull.now_ns} {sorted(done.items())} {lull.timers}"
        states.append(hash64(whole.encode()))
    return [f"{state:016x}" for state in states]


def _latched(trace: Trace) -> frozenset[int]:
    found = (
        one.id
        for one in trace.entities.values()
        if one.kind is EntityKind.PUBLISHER and "transient" in str(one.detail).lower()
    )
    return frozenset(found)
