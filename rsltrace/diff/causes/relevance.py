"""Which of the settings that differ can be why two runs diverge at a place.

A key that only says what is recorded, a delay of a topic that is not there, the code of another
node: they differ, and explain nothing. Naming them would hide what is nondeterministic.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import field
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any

from rsltrace.diff.alignment.entity_matching import EntityMatching
from rsltrace.diff.alignment.rows import ComparedTrace
from rsltrace.diff.causes.job_entries import TARGETS, JobEntries, job_entries
from rsltrace.diff.facts.evidence import Setting, SettingKind
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.format import METADATA_CODE, METADATA_EDITS, METADATA_SOURCES
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource
from rsltrace.trace.model.texts import ros_release
from rsltrace.trace.reader import Trace

# What differs outside of the events and the job: the environment, the code, the entities of the
# graph.
#
# None of it is a divergence by itself, and any of it may be why there is one.


_ENTITIES_MAX = 50


_FIRST = ("python", "rclpy")
"""What may change anything; other packages matter to who uses them."""


def environment_settings(a: Trace, b: Trace) -> tuple[Setting, ...]:
    """Return edits that differ, modules of the nodes whose code differs (comments and layout are
    no code), versions that differ."""
    found = []
    if (edits_a := _edits(a)) != (edits_b := _edits(b)):
        found.append(Setting(SettingKind.EDITS, "", edits_a, edits_b))
    for kind, of_a, of_b in (
        (SettingKind.CODE, a.metadata(METADATA_SOURCES), b.metadata(METADATA_SOURCES)),
        (SettingKind.ENVIRONMENT, a.environment, b.environment),
    ):
        is_code = kind is SettingKind.CODE
        for name in sorted({*of_a, *of_b}, key=lambda name: (name not in _FIRST, name)):
            if name == "math" and not (name in of_a and name in of_b):
                continue  # older traces do not tell it
            if of_a.get(name) != of_b.get(name) and not (is_code and _same_code(a, b, name)):
                file = name.removeprefix("file:")
                if file != name and None in (of_a.get(name), of_b.get(name)):
                    continue  # the jobs name other files, which is a setting of its own
                kind_of_it = kind if file == name else SettingKind.FILE
                value_a, value_b = (_with_release(name, of.get(name)) for of in (of_a, of_b))
                found.append(Setting(kind_of_it, file, value_a, value_b))
    return tuple(found)


def _with_release(name: str, version: str | None) -> str | None:
    """Return ``7.1.5 (jazzy)`` for rclpy's version, that of others as it is."""
    release = ros_release(version) if name == "rclpy" and version else ""
    return f"{version} ({release})" if release else version


def _edits(trace: Trace) -> str | None:
    """Return the edits of a branch (see ``rsltrace.replay.edits``)."""
    found = trace.metadata(METADATA_EDITS)
    return "; ".join(found[key] for key in sorted(found) if key != "of") or None


def entity_settings(matching: EntityMatching) -> tuple[Setting, ...]:
    """Return the entities that only one run has; of many, the first ones and how many more."""
    found = [Setting(SettingKind.ENTITY, "", str(matching.keys[n]), None) for n in matching.only_a]
    found += [Setting(SettingKind.ENTITY, "", None, str(matching.keys[n])) for n in matching.only_b]
    if len(found) > _ENTITIES_MAX:
        more = found[_ENTITIES_MAX:]
        only_a = sum(setting.b is None for setting in more)
        rest_a, rest_b = (f"{n} more" if n else None for n in (only_a, len(more) - only_a))
        found[_ENTITIES_MAX:] = [Setting(SettingKind.ENTITY, "", rest_a, rest_b)]
    return tuple(found)


# -- code ----------------------------------------------------------------------------------------


def _same_code(a: Trace, b: Trace, name: str) -> bool:
    """Whether a module means the same in both, as far as the traces tell. One that callbacks loaded
    in one run only is not a difference of the code."""
    one, other = _code(a, name), _code(b, name)
    if one and other:
        return one.get("hash") is not None and one.get("hash") == other.get("hash")
    return bool((one or other).get("late"))


def used_by(traces: tuple[Trace, Trace], module: str) -> set[str]:
    """Return the modules that a module imports, in either run, itself and theirs included."""
    found, waiting = {module}, [module]
    while waiting:
        name = waiting.pop()
        for trace in traces:
            imports = _code(trace, name).get("imports")
            for other in imports if isinstance(imports, list) else []:
                if isinstance(other, str) and other not in found:
                    found.add(other)
                    waiting.append(other)
    return found


def _code(trace: Trace, name: str) -> Mapping[str, Any]:
    try:
        value = json.loads(trace.metadata(METADATA_CODE).get(name, "{}"))
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


_NEVER = frozenset(
    ("record", "checks", "metrics", "vary", "livelock_limit", "stop", "parallel", "vars")
)
_WHEN = frozenset(
    ("timer_ties", "policy", "faults", "execution", "delay", "min_time_step", "executors", "bags")
)
"""Keys that decide when something happens and whether it arrives, not what a callback does."""

_CONSTRUCTING = frozenset(("parameters", "parameter_files", "name", "namespace", "remappings"))
"""Keys of a node that its constructor shows, if they change anything."""

_DRAWING_POLICY = "permutation"


@dataclass(frozen=True)
class DivergenceSite:
    """Where two runs diverge, as far as it matters for what can be the cause.

    ``nodes`` are the full names of those involved; ``constructing`` says that a node is being made,
    ``inside`` that a callback got the same at the same time, ``drawn`` that a random draw differs.
    """

    nodes: frozenset[str]
    constructing: bool = False
    inside: bool = False
    drawn: bool = False
    mains: frozenset[str] = frozenset()
    """The names of the mains involved, which belong to no node."""


@dataclass
class Relevance:
    """Judges settings for the two runs."""

    run_a: ComparedTrace
    run_b: ComparedTrace
    _used: dict[str, set[str]] = field(default_factory=dict)

    def of(self, settings: Sequence[Setting], place: DivergenceSite) -> tuple[Setting, ...]:
        """Return the settings that can be why the runs diverge there."""
        return tuple(setting for setting in settings if self._can_matter(setting, place))

    def _can_matter(self, setting: Setting, place: DivergenceSite) -> bool:
        if setting.kind is SettingKind.CODE:
            return self._is_code_of(setting.name, place)
        if setting.kind is SettingKind.FILE:
            if setting.name in self._parameter_files and not place.constructing:
                return False
            return self._is_code_of(f"file:{setting.name}", place)
        key, *rest = setting.key.split(".") if setting.key else [""]
        if key in _NEVER or (key in _WHEN and place.inside):
            return False
        if key == "seed":
            return place.drawn or self._draws(place)
        if key == "delay":
            return self._is_of_the_graph(setting, rest)
        if key == "nodes" and len(rest) > 1:
            if rest[1] in _CONSTRUCTING and not place.constructing:
                return False
            owners = self._nodes_of(rest[0], of_b=setting.a is None)
            return not owners or bool(owners & (place.nodes | place.mains))
        return True

    def _is_code_of(self, name: str, place: DivergenceSite) -> bool:
        """Whether a module or file is one that the nodes may use: not that of other nodes alone."""
        owners = {
            owner
            for entries in self._entries
            for owner, roots in entries.roots.items()
            if any(name in self._used_by(root) for root in roots)
        }
        involved = place.nodes | place.mains
        return not owners or not place.nodes or not owners.isdisjoint(involved)

    def _used_by(self, module: str) -> set[str]:
        if module not in self._used:
            self._used[module] = used_by(self._traces, module)
        return self._used[module]

    def _draws(self, place: DivergenceSite) -> bool:
        """Whether a node draws random numbers; what the guard does not see is taken for drawn."""
        if any(_value(job, "policy", "order") == _DRAWING_POLICY for job in self._jobs):
            return not place.inside
        if any(job.get("clocks") for job in self._jobs) or not all(map(_is_guarded, self._jobs)):
            return True
        drawing = {
            count.node
            for trace in self._traces
            for count in trace.guarded
            if count.source is NondeterminismSource.RANDOM
        }
        drawing |= {  # rclpy, whose calls are not counted, draws the ids of goals
            trace.node_of(entity).name
            for trace in self._traces
            for entity in trace.entities.values()
            if entity.kind is EntityKind.CLIENT and "action" in entity.detail
        }
        return not drawing.isdisjoint(place.nodes or drawing)

    def _is_of_the_graph(self, setting: Setting, rest: Sequence[str]) -> bool:
        """Whether a delay is of a topic or service that there is."""
        if rest[:1] in (["topics"], ["services"]) and len(rest) > 1:
            return self._has_topic(rest[1])
        if rest:
            return True
        for text in (setting.a, setting.b):
            try:
                delay = json.loads(text) if text else {}
            except ValueError:
                return True
            if not isinstance(delay, dict) or {*delay} - {"topics", "services"}:
                return True
            globs = [glob for part in delay.values() if isinstance(part, dict) for glob in part]
            if any(self._has_topic(glob) for glob in globs):
                return True
        return False

    def _has_topic(self, glob: str) -> bool:
        return any(fnmatchcase(name, glob) for name in self._names)

    def _nodes_of(self, entry: str, *, of_b: bool) -> set[str]:
        """Return the full names of the nodes of an entry of ``nodes:`` (its name, or its number in
        the job of a, or ``of_b``), and the main that made them."""
        found: set[str] = set()
        for side, (job, made) in enumerate(zip(self._jobs, self._entries, strict=True)):
            for number, node in enumerate(job.get("nodes") or []):
                names = {node.get("name"), str(number) if side == of_b else None} - {None}
                if entry in names:
                    nodes = made.nodes.get(number) or {
                        name for name, of in self._classes if of == (node.get("node") or "")
                    }
                    if nodes:
                        found |= nodes | {str(node[key]) for key in TARGETS if node.get(key)}
        return found

    def is_of_a_class(self, node: str) -> bool:
        """Whether a node has a state to record: one in a process of its own has no class here."""
        return any(name == node and of for name, of in self._classes)

    @cached_property
    def guard_is_off(self) -> bool:
        """Whether one of the runs had ``guard: false``."""
        return not all(map(_is_guarded, self._jobs))

    @cached_property
    def permissions(self) -> dict[str, str]:
        """What in the jobs lets the answers of a source differ, by source."""
        found: dict[str, str] = {}
        parts = (part for job in self._jobs for part in (job, *(job.get("nodes") or [])))
        for guard in filter(None, (_value(part, "guard") for part in parts)):
            for source in (one.value for one in NondeterminismSource):
                if _value(guard, "enabled") is False:
                    found[source] = "guard: false"
                elif _value(guard, source, "mode") == GuardMode.ALLOW:
                    found.setdefault(source, f"guard: {{{source}: allow}}")
                elif modules := _value(guard, source, "allow"):
                    modules = ", ".join(map(str, modules))
                    found.setdefault(source, f"guard: {{{source}: {{allow: [{modules}]}}}}")
        return found

    @cached_property
    def sets_are_in_order(self) -> bool:
        """Whether both runs went through sets in an order that does not change."""
        return all(
            _is_guarded(job)
            and _value(job, "guard", "order", "mode") in (None, GuardMode.VIRTUAL.value)
            and not any(_value(node, "guard") for node in job.get("nodes") or [])
            for job in self._jobs
        )

    @cached_property
    def _parameter_files(self) -> set[str]:
        """The parameter files of nodes and of command lines (with their other words)."""
        nodes = [node for job in self._jobs for node in job.get("nodes") or []]
        lists = [node.get(key) for node in nodes for key in ("parameter_files", "arguments")]
        lists += [job.get("ros_arguments") for job in self._jobs]
        return {str(word) for words in lists if isinstance(words, list) for word in words}

    @cached_property
    def _traces(self) -> tuple[Trace, Trace]:
        return self.run_a.trace, self.run_b.trace

    @cached_property
    def _jobs(self) -> tuple[dict[str, Any], dict[str, Any]]:
        return resolved_job(self._traces[0]), resolved_job(self._traces[1])

    @cached_property
    def _entries(self) -> tuple[JobEntries, JobEntries]:
        (a, b), (job_a, job_b) = self._traces, self._jobs
        return job_entries(a, job_a), job_entries(b, job_b)

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(e.name for trace in self._traces for e in trace.entities.values())

    @cached_property
    def _classes(self) -> frozenset[tuple[str, str]]:
        """Return (full name, class as ``module:Class``) of all nodes."""
        return frozenset(
            (entity.name, entity.type)
            for trace in self._traces
            for entity in trace.entities.values()
            if entity.kind is EntityKind.NODE
        )


def resolved_job(trace: Trace) -> dict[str, Any]:
    """Return a job with all defaults, nothing where the trace does not have it."""
    try:
        value = json.loads(trace.job.get("resolved") or "{}")
    except ValueError:  # of a later version, or damaged: the job files themselves are compared
        return {}
    return value if isinstance(value, dict) else {}


def _is_guarded(job: dict[str, Any]) -> bool:
    return _value(job, "guard", "enabled") is not False


def _value(job: dict[str, Any], *keys: str) -> Any:
    value: Any = job
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value
