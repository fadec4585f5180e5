"""What differs outside of the events and the job: the environment, the code, the entities of the
graph.

None of it is a divergence by itself, and any of it may be why there is one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from rsltrace.diff.alignment.entity_matching import EntityMatching
from rsltrace.diff.facts.evidence import Setting, SettingKind
from rsltrace.trace.format import METADATA_CODE, METADATA_EDITS, METADATA_SOURCES
from rsltrace.trace.reader import Trace

_ENTITIES_MAX = 50


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
        for name in sorted({*of_a, *of_b}):
            if of_a.get(name) != of_b.get(name) and not (is_code and same_code(a, b, name)):
                file = name.removeprefix("file:")
                kind_of_it = kind if file == name else SettingKind.FILE
                found.append(Setting(kind_of_it, file, of_a.get(name), of_b.get(name)))
    return tuple(found)


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


def same_code(a: Trace, b: Trace, name: str) -> bool:
    """Whether a module means the same in both, as far as the traces tell."""
    one, other = (_code(trace, name).get("hash") for trace in (a, b))
    return one is not None and one == other


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
