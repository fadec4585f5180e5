"""Makes ``tests/trace/make.py`` importable as ``trace_maker``, as in ``tests/trace``."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

if "trace_maker" not in sys.modules:
    _spec = importlib.util.spec_from_file_location(
        "trace_maker", Path(__file__).parent.parent / "trace" / "make.py"
    )
    assert _spec is not None
    assert _spec.loader is not None
    _module = importlib.util.module_from_spec(_spec)
    sys.modules["trace_maker"] = _module
    _spec.loader.exec_module(_module)
