"""Which entity of one run is which of the other.

Ids count up in creation order, so one entity more shifts all ids after it. Nodes are therefore
matched by name, other entities by node, kind, name and type, and their number among equal ones.
Everything behind this module speaks of *numbers*, which mean the same entity in both runs.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import field
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.entities import EntityKey

_NODE = EntityKind.NODE.label


@dataclass(frozen=True)
class EntityMatching:
    """The entities of two runs. Numbers count from 0, which is the run itself.

    ``keys`` and ``nodes`` (the number of the owning node) go by number; ``numbers_a`` and
    ``numbers_b`` give the number of an id, shape (largest id + 1,), -1 where there is no entity.
    ``same_ids`` says that no id means something else in the other run. ``renamed`` are the mains
    that have another name in b: names in a and b.
    """

    keys: tuple[EntityKey, ...]
    nodes: tuple[int, ...]
    numbers_a: npt.NDArray[np.int64]
    numbers_b: npt.NDArray[np.int64]
    only_a: tuple[int, ...]
    only_b: tuple[int, ...]
    same_ids: bool
    by_key: Mapping[EntityKey, int] = field(repr=False)
    renamed: tuple[tuple[str, str], ...] = ()

    def numbers(self, trace: Trace, ids: npt.NDArray[Any], *, of_b: bool) -> npt.NDArray[np.int64]:
        """Return the numbers of entity ids. Raises TraceError if the trace has no such entity."""
        table = self.numbers_b if of_b else self.numbers_a
        places = ids.astype(np.int64)
        unknown = places >= len(table)
        numbers: npt.NDArray[np.int64] = table[np.where(unknown, 0, places)]
        unknown |= numbers < 0
        if unknown.any():
            raise TraceError(f"{trace.name} has no entity {int(places[int(np.argmax(unknown))])}")
        return numbers

    def node_number(self, key: EntityKey) -> int:
        """Return the number of the node that an entity belongs to (0: the run)."""
        return self.nodes[self.by_key[key]]

    @property
    def different_jobs(self) -> bool:
        """Whether both runs have nodes and no node is in both: they are runs of different jobs."""
        only_a, only_b = set(self.only_a), set(self.only_b)
        nodes = {number for number, key in enumerate(self.keys) if key.kind == _NODE}
        return bool(nodes & only_a and nodes & only_b) and nodes <= only_a | only_b


def match_entities(a: Trace, b: Trace) -> EntityMatching:
    """Match the entities of two runs. Reads all entities of both."""
    nodes_a, nodes_b = _node_names(a), _node_names(b)
    others = _other_names(a, b, same_nodes=nodes_a == nodes_b)
    keys_a, keys_b = _keys(a, nodes_b, {}), _keys(b, nodes_a, others)
    by_key: dict[EntityKey, int] = {}
    for key in (*keys_a.values(), *keys_b.values()):
        by_key.setdefault(key, len(by_key))
    numbers_a, numbers_b = _table(keys_a, by_key), _table(keys_b, by_key)
    shared = min(len(numbers_a), len(numbers_b))
    both = (numbers_a[:shared] >= 0) & (numbers_b[:shared] >= 0)
    in_a, in_b = set(keys_a.values()), set(keys_b.values())
    nodes = [0] * len(by_key)
    for trace, keys in ((a, keys_a), (b, keys_b)):
        for entity_id, key in keys.items():
            owner = trace.entities[entity_id].node
            nodes[by_key[key]] = by_key[keys[owner]] if owner in keys else 0
    return EntityMatching(
        keys=tuple(by_key),
        nodes=tuple(nodes),
        numbers_a=numbers_a,
        numbers_b=numbers_b,
        only_a=tuple(number for key, number in by_key.items() if key not in in_b),
        only_b=tuple(number for key, number in by_key.items() if key not in in_a),
        same_ids=bool((numbers_a[:shared] == numbers_b[:shared])[both].all()),
        by_key=by_key,
        renamed=tuple((name, b.entities[one].name) for one, name in others.items()),
    )


def _node_names(trace: Trace) -> set[str]:
    return {one.name for one in trace.entities.values() if one.kind is EntityKind.NODE}


def _other_names(a: Trace, b: Trace, *, same_nodes: bool) -> dict[int, str]:
    """Return what mains of ``b`` that ``a`` has not are called there, by id.

    An executable may lie elsewhere, or have another name: two builds of one program, say. It is
    the one of the same file name; if the nodes are the same in both, the one in the same place
    among those left over.
    """
    mains = [[e for e in t.entities.values() if e.kind is EntityKind.MAIN] for t in (a, b)]
    names_a, names_b = ({main.name for main in each} for each in mains)
    left_a = [main for main in mains[0] if main.name not in names_b]
    left_b = [main for main in mains[1] if main.name not in names_a]
    found: dict[int, str] = {}
    for short in (_file_name, _no_name) if same_nodes else (_file_name,):
        for name in dict.fromkeys(short(main.name) for main in left_b):
            same_a = [main for main in left_a if short(main.name) == name]
            same_b = [main for main in left_b if short(main.name) == name]
            if len(same_a) == len(same_b):
                found.update((y.id, x.name) for x, y in zip(same_a, same_b, strict=True))
                left_a = [main for main in left_a if main not in same_a]
                left_b = [main for main in left_b if main not in same_b]
    return found


def _file_name(name: str) -> str:
    return name.rpartition("/")[2]


def _no_name(name: str) -> str:
    return ""


def _keys(
    trace: Trace, other_names: Container[str], names: Mapping[int, str]
) -> dict[int, EntityKey]:
    """Return the key of every entity, by id, in creation order; ``names`` are those to be used in
    place of entities' own.

    A node is that of its name: its class may be another one, or unknown if its constructor raised.
    """
    seen: dict[tuple[str, str, str, str], int] = {}
    keys: dict[int, EntityKey] = {}
    for entity in trace.entities.values():
        kind = entity.type
        if entity.kind is EntityKind.NODE and entity.name in other_names:
            kind = ""
        owner = trace.entities.get(entity.node)
        node = "" if owner is None else names.get(owner.id, owner.name)
        what = (node, entity.kind.label, names.get(entity.id, entity.name), kind)
        ordinal = seen.get(what, 0)
        seen[what] = ordinal + 1
        keys[entity.id] = EntityKey(*what, ordinal)
    return keys


def _table(keys: Mapping[int, EntityKey], by_key: Mapping[EntityKey, int]) -> npt.NDArray[np.int64]:
    table = np.full(max(keys) + 1, -1, dtype=np.int64)
    for entity_id, key in keys.items():
        table[entity_id] = by_key[key]
    return table
