"""Choosing faults that must show, and what a diff has to say of each."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from diff_simulator import MS, Fault, Logged, NodePlan, Plan, Simulation, Storage, random_plan

from rsltrace.diff.facts.causes import Root, Verdict
from rsltrace.diff.result import Diff, Divergence
from rsltrace.trace.model.event import EventKind

EVENTS_MAX = 1500


@dataclass(frozen=True)
class Planted:
    """Two runs that differ by one fault, and what is true of the difference.

    ``nodes`` are those of which one has to be named; ``index`` is where the runs diverge.
    """

    a: Path
    b: Path
    fault: str
    verdict: Verdict
    root: Root
    index: int
    nodes: tuple[str, ...]
    names: tuple[str, ...]
    note: str = ""

    def check(self, diff: Diff) -> list[str]:
        """Return what is wrong with a diff; nothing if it is right."""
        wrong = []
        if diff.verdict is not self.verdict:
            wrong.append(f"verdict {diff.verdict} instead of {self.verdict}")
        if diff.agreeing != self.index:
            wrong.append(f"diverges at {diff.agreeing} instead of {self.index}")
        if not diff.divergences:
            return [*wrong, "no divergence"]
        first = diff.divergences[0]
        if first.root is not self.root:
            wrong.append(f"root {first.root} instead of {self.root}")
        for view in (first.a, first.b):
            if view is not None and view.entity.node not in self.nodes:
                wrong.append(f"names node {view.entity.node} instead of {self.nodes}")
            if view is not None and view.entity.name not in self.names:
                wrong.append(f"names {view.entity.name} instead of {self.names}")
        if self.verdict is Verdict.SCHEDULE and first.a and first.b:
            named = {first.a.entity.name, first.b.entity.name}
            if named != set(self.names):
                wrong.append(f"names {named} instead of {self.names}")
        if len(diff.divergences) > 1:
            others = [_short(divergence) for divergence in diff.divergences[1:]]
            wrong.append(f"claims further independent divergences: {others}")
        if not diff.sentence or not first.root_sentence or not first.next_step:
            wrong.append("something is not put in words")
        return wrong


def _short(divergence: Divergence) -> str:
    a, b = divergence.a, divergence.b
    return f"{divergence.verdict.value} {a and a.index}/{b and b.index} {divergence.sentence}"


def storages(rng: random.Random) -> tuple[Storage, Storage]:
    """Return two layouts of files, often different ones."""

    def one() -> Storage:
        return Storage(
            rng.choice((3, 16, 64, 100, 4096)), rng.choice(("zstd", "")), rng.random() < 0.8
        )

    first = one()
    return first, (first if rng.random() < 0.3 else one())


def bounded_plan(rng: random.Random, folder: Path) -> tuple[Plan, Simulation]:
    """Return a random plan of a few hundred events and its run without faults."""
    while True:
        plan = random_plan(rng)
        run = Simulation(plan, folder / "a.mcap").run()
        if len(run.log) > EVENTS_MAX:
            end_ns = run.log[EVENTS_MAX].stamp_ns
            plan = replace(plan, end_ns=max(end_ns - end_ns % MS, MS))
            run = Simulation(plan, folder / "a.mcap").run()
        if 10 <= len(run.log) <= 4 * EVENTS_MAX:
            return plan, run


def plant(kind: str, rng: random.Random, folder: Path) -> Planted | None:
    """Write two runs with a fault of this kind between them; None if the job has no room for it."""
    plan, clean = bounded_plan(rng, folder)
    store_a, store_b = storages(rng)
    made = PLANTERS[kind](rng, plan, clean)
    if made is None:
        return None
    plan_a, plan_b, fault, expected = made
    a, b = folder / "a.mcap", folder / "b.mcap"
    Simulation(plan_a, a, storage=store_a).run()
    faults = (fault,) if fault is not None else ()
    Simulation(plan_b, b, faults, store_b).run()
    verdict, root, index, events = expected
    return Planted(
        a,
        b,
        kind,
        verdict,
        root,
        index,
        tuple(e[0] for e in events),
        tuple(e[1] for e in events),
        f"{fault} {store_a} {store_b}",
    )


Expected = tuple[Verdict, Root, int, list[tuple[str, str]]]
Made = tuple[Plan, Plan, "Fault | None", Expected]
Planter = Callable[[random.Random, Plan, Simulation], "Made | None"]


def _pick(rng: random.Random, clean: Simulation, suits: Callable[[Logged], bool]) -> Logged | None:
    suitable = [event for event in clean.log if suits(event)]
    return rng.choice(suitable) if suitable else None


def _name(event: Logged) -> tuple[str, str]:
    return event.node, event.name


def _bit(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    event = _pick(rng, clean, lambda e: e.outputs > 0 and e.kind is not EventKind.BAG)
    if event is None:
        return None
    fault = Fault("bit", event.index, rng.randrange(event.outputs))
    verdict = Verdict.SAME_INPUT_DIFFERENT_OUTPUT
    return plan, plan, fault, (verdict, Root.CALLBACK, event.index, [_name(event)])


def _swap(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    event = _pick(rng, clean, lambda e: len(e.ready) > 1 and e.kind is not EventKind.BAG)
    if event is None:
        return None
    which = rng.randrange(1, len(event.ready))
    one, other = event.ready[0], event.ready[which]
    if one == other:
        return None
    names = [_entity_name(clean, entity) for entity, _, _ in (one, other)]
    fault = Fault("swap", event.index, which)
    return plan, plan, fault, (Verdict.SCHEDULE, Root.SCHEDULE, event.index, names)


def _swap_timers(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    event = _pick(rng, clean, lambda e: e.due > 1)
    if event is None:
        return None
    which = rng.randrange(1, event.due)
    fault = Fault("swap", event.index, which)
    due = [e for e in clean.log if e.kind is EventKind.TIMER and e.stamp_ns == event.stamp_ns]
    later = [e for e in due if e.index > event.index]
    names = [_name(event), _name(later[which - 1])]
    return plan, plan, fault, (Verdict.SCHEDULE, Root.SCHEDULE, event.index, names)


def _drop(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    event = _pick(rng, clean, lambda e: bool(e.ready) and e.kind is not EventKind.BAG)
    if event is None:
        return None
    expected = (Verdict.MISSING, Root.MISSING, event.index, [_name(event)])
    return plan, plan, Fault("drop", event.index), expected


def _extra(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    event = _pick(rng, clean, lambda e: e.kind is not EventKind.BAG)
    if event is None:
        return None
    before = [e for e in clean.log if e.index < event.index and e.kind is EventKind.SUBSCRIPTION]
    if not before:
        return None
    which = rng.randrange(len(before))
    fault = Fault("extra", event.index, which)
    return plan, plan, fault, (Verdict.EXTRA, Root.EXTRA, event.index, [_name(before[which])])


def _late(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    event = _pick(rng, clean, lambda e: e.kind is EventKind.TIMER and e.due == 1)
    if event is None:
        return None
    delay_ns = rng.choice((1, MS, 2 * MS, 4 * MS))
    if event.stamp_ns + delay_ns > plan.end_ns:
        return None
    fault = Fault("late", event.index, delay_ns=delay_ns, new_deadline=rng.random() < 0.5)
    return plan, plan, fault, (Verdict.TIMING, Root.TIMING, event.index, [_name(event)])


def _raise(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    event = _pick(rng, clean, lambda e: e.kind is not EventKind.BAG)
    if event is None:
        return None
    expected = (Verdict.EXCEPTION, Root.EXCEPTION, event.index, [_name(event)])
    return plan, plan, Fault("raise", event.index), expected


def _seed(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    other = replace(plan, seed=plan.seed + 1)
    drawing = {node.name for node in plan.nodes if node.draws}
    for index, node in enumerate(plan.nodes):
        if node.draws_at_start:
            if any(other.starts_ns for other in plan.nodes):
                return None
            expected = (Verdict.ENVIRONMENT, Root.JOB, index, [(node.name, node.name)])
            return (plan, other, None, expected) if _first_only(plan, index) else None
    if len(drawing) > 1:
        return None  # further nodes that draw are further divergences, and rightly so
    twin = Simulation(other, clean.path.with_name("twin.mcap")).run()
    both = zip(clean.log, twin.log, strict=False)
    first = next((x for x, y in both if x.node in drawing and (x.outputs or y.outputs)), None)
    if first is None or first.kind is not EventKind.TIMER:
        return None
    verdict = Verdict.SAME_INPUT_DIFFERENT_OUTPUT
    return plan, other, None, (verdict, Root.CALLBACK, first.index, [_name(first)])


def _first_only(plan: Plan, index: int) -> bool:
    return sum(node.draws or node.draws_at_start for node in plan.nodes) == 1 and index >= 0


def _bag(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    played = [e for e in clean.log if e.kind is EventKind.BAG]
    if not played:
        return None
    which = rng.randrange(len(played))
    stamp, topic, value = plan.bag[which]
    other = replace(
        plan, bag=(*plan.bag[:which], (stamp, topic, value ^ 1), *plan.bag[which + 1 :])
    )
    event = played[which]
    expected = (Verdict.DIFFERENT_INPUT, Root.EXTERNAL_INPUT, event.index, [_name(event)])
    return plan, other, None, expected


def _bag_missing(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    played = [e for e in clean.log if e.kind is EventKind.BAG]
    if len(played) < 2:
        return None
    which = rng.randrange(len(played))
    if sum(topic == plan.bag[which][1] for _, topic, _ in plan.bag) < 2:
        return None  # the topic would be gone: another graph
    other = replace(plan, bag=(*plan.bag[:which], *plan.bag[which + 1 :]))
    if list(dict.fromkeys(t for _, t, _ in other.bag)) != list(
        dict.fromkeys(t for _, t, _ in plan.bag)
    ):
        return None
    event = played[which]
    return plan, other, None, (Verdict.MISSING, Root.MISSING, event.index, [_name(event)])


def _end(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    stamps = sorted({event.stamp_ns for event in clean.log})
    if len(stamps) < 3 or any(node.starts_ns for node in plan.nodes):
        return None
    end_ns = rng.choice(stamps[:-1])
    other = replace(plan, end_ns=end_ns)
    index = next(event.index for event in clean.log if event.stamp_ns > end_ns)
    event = clean.log[index - clean.log[0].index]
    if rng.random() < 0.5:
        return plan, other, None, (Verdict.ENDED_EARLY, Root.UNKNOWN, index, [_name(event)])
    return other, plan, None, (Verdict.RAN_LONGER, Root.UNKNOWN, index, [_name(event)])


def _graph(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    plan = _started_at_once(plan)
    where = rng.randrange(len(plan.nodes))
    node = plan.nodes[where]
    more = replace(node, services=(*node.services, "/more"))
    other = replace(plan, nodes=(*plan.nodes[:where], more, *plan.nodes[where + 1 :]))
    return plan, other, None, (Verdict.GRAPH, Root.JOB, where, [(node.name, node.name)])


def _node(rng: random.Random, plan: Plan, clean: Simulation) -> Made | None:
    plan = _started_at_once(plan)
    where = rng.randrange(len(plan.nodes) + 1)
    more = NodePlan("/more", timers=((10 * MS, ()),))
    other = replace(plan, nodes=(*plan.nodes[:where], more, *plan.nodes[where:]))
    return plan, other, None, (Verdict.GRAPH, Root.JOB, where, [("/more", "/more")])


def _started_at_once(plan: Plan) -> Plan:
    return replace(plan, nodes=tuple(replace(node, starts_ns=0) for node in plan.nodes))


def _entity_name(clean: Simulation, entity: int) -> tuple[str, str]:
    return next(_name(event) for event in clean.log if event.entity == entity)


PLANTERS: dict[str, Planter] = {
    "bit": _bit,
    "swap": _swap,
    "swap timers": _swap_timers,
    "drop": _drop,
    "extra": _extra,
    "late": _late,
    "raise": _raise,
    "seed": _seed,
    "bag": _bag,
    "bag missing": _bag_missing,
    "end": _end,
    "graph": _graph,
    "node": _node,
}
