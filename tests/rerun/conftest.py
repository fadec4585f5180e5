"""Makes ``tests/trace/make.py`` and ``gallery.py`` importable; Rerun shall not phone home."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

os.environ["RERUN_ANALYTICS_ENABLED"] = "0"

_HERE = Path(__file__).parent
for _name, _path in (
    ("trace_maker", _HERE.parent / "trace" / "make.py"),
    ("rerun_gallery", _HERE / "gallery.py"),
):
    if _name not in sys.modules:
        _spec = importlib.util.spec_from_file_location(_name, _path)
        assert _spec is not None
        assert _spec.loader is not None
        _module = importlib.util.module_from_spec(_spec)
        sys.modules[_name] = _module
        _spec.loader.exec_module(_module)
