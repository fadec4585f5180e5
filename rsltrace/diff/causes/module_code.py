"""What two traces tell of the code of modules: whether it means the same, and who uses whom."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from rsltrace.trace.format import METADATA_CODE
from rsltrace.trace.reader import Trace


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
