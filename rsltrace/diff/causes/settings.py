"""What differs outside of the events and the job: the environment, the entities of the graph.

None of it is a divergence by itself, and any of it may be why there is one.
"""

from __future__ import annotations

from rsltrace.diff.alignment.entity_matching import EntityMatching
from rsltrace.diff.causes.module_code import same_code
from rsltrace.diff.result.settings import Setting
from rsltrace.trace.format import METADATA_EDITS, METADATA_SOURCES
from rsltrace.trace.reader import Trace

_ENTITIES_MAX = 50


def environment_settings(a: Trace, b: Trace) -> tuple[Setting, ...]:
    """Return edits that differ, modules of the nodes whose code differs (comments and layout are
    no code), versions that differ."""
    found = []
    if (edits_a := _edits(a)) != (edits_b := _edits(b)):
        found.append(Setting("edits", edits_a, edits_b))
    for label, record in (("code of module", METADATA_SOURCES), ("environment:", None)):
        of_a = a.environment if record is None else a.metadata(record)
        of_b = b.environment if record is None else b.metadata(record)
        for name in sorted({*of_a, *of_b}):
            if of_a.get(name) != of_b.get(name) and not (record and same_code(a, b, name)):
                place = name.replace("file:", "file ") if name[:5] == "file:" else f"{label} {name}"
                found.append(Setting(place, of_a.get(name), of_b.get(name)))
    return tuple(found)


def _edits(trace: Trace) -> str | None:
    """Return the edits of a branch (see ``rsltrace.replay.edits``)."""
    found = trace.metadata(METADATA_EDITS)
    return "; ".join(found[key] for key in sorted(found) if key != "of") or None


def entity_settings(matching: EntityMatching) -> tuple[Setting, ...]:
    """Return the entities that only one run has; of many, the first ones and how many more."""
    found = [Setting("entity", str(matching.keys[n]), None) for n in matching.only_a]
    found += [Setting("entity", None, str(matching.keys[n])) for n in matching.only_b]
    if len(found) > _ENTITIES_MAX:
        more = found[_ENTITIES_MAX:]
        only_a = sum(setting.b is None for setting in more)
        rest_a, rest_b = (f"{n} more" if n else None for n in (only_a, len(more) - only_a))
        found[_ENTITIES_MAX:] = [Setting("entity", rest_a, rest_b)]
    return tuple(found)
