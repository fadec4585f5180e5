"""What messages load when their type is first used, without the generator that comes with it.

``rosidl_generator_py`` holds the one function that messages ask for, and a generator of Python code
with a template engine and a parser of IDL, a tenth of what a short command takes. In a run the
engine would be compiled as if it were a node's library, and the parser has warnings of old modules,
which ``pytest -W error`` makes a node's failure. Who asks the package for the generator gets it.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from contextlib import suppress
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any

_PACKAGE = "rosidl_generator_py"
_LOADER = "import_type_support"


def load_type_support() -> None:
    """Load what messages load, now and not in a run; it may be missing where nothing needs it."""
    with warnings.catch_warnings(), suppress(ImportError):
        warnings.simplefilter("ignore")
        importlib.import_module("rosidl_parser")
        if _PACKAGE not in sys.modules:
            spec = find_spec(_PACKAGE)
            if spec is not None and spec.submodule_search_locations:
                _load_in_part(spec)


def _load_in_part(spec: ModuleSpec) -> None:
    """Have the package with its one function; the rest is loaded when it is asked for."""
    package = sys.modules[_PACKAGE] = module_from_spec(spec)
    try:
        function = getattr(importlib.import_module(f"{_PACKAGE}.{_LOADER}_impl"), _LOADER)
    except (ImportError, AttributeError):  # not as the releases that we know
        _load_fully(package, spec)
        return
    setattr(package, _LOADER, function)

    def missing(name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {_PACKAGE!r} has no attribute {name!r}")
        _load_fully(package, spec)
        return getattr(package, name)

    package.__dict__["__getattr__"] = missing


def _load_fully(package: ModuleType, spec: ModuleSpec) -> None:
    package.__dict__.pop("__getattr__", None)
    assert spec.loader is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        spec.loader.exec_module(package)
