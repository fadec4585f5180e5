"""The compiled module ``rsltrace._core``, built where a compiler is (``hatch_build.py``).

It replaces the hottest classes by equal ones: same bytes, same errors. ``RSLTRACE_COMPILED=0`` in
the environment switches it off.
"""

from __future__ import annotations

import os
from importlib import import_module
from types import ModuleType

core: ModuleType | None = None

if os.environ.get("RSLTRACE_COMPILED") != "0":
    try:
        core = import_module("rsltrace._core")
    except ImportError:
        pass  # not built
