"""Patches of modules: made now if a module is loaded, else in the moment it has been.

A start is nearly all imports, so a run loads no module only to patch it. A finder before all others
sees those that are to be patched: nobody gets one before that, as the import system lets other
threads wait until a module's loader is done.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from rsltrace.guard.context import engage

apart: list[Callable[[], AbstractContextManager[None]]] = [partial(engage, None)]
"""Contexts in which Python's own modules and numpy's are loaded, as they are before a run: others
are loaded in the next run, too, but these may be used outside of runs as well."""

_APART = sys.stdlib_module_names | {"numpy"}


class _Loader:
    """Loads a module as its real loader does, and has it patched."""

    def __init__(self, real: Any, patches: list[Callable[[], None]]) -> None:
        self._real = real
        self._patches = patches

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        module: ModuleType | None = self._real.create_module(spec)
        return module

    def exec_module(self, module: Any) -> None:
        module.__spec__.loader = module.__loader__ = self._real
        with ExitStack() as stack:
            if module.__name__.partition(".")[0] in _APART:
                for context in apart:
                    stack.enter_context(context())
            self._real.exec_module(module)
            for patch in list(self._patches):
                patch()


class _Finder:
    """Finds the modules that are to be patched, as the other finders do."""

    def __init__(self) -> None:
        self.patches: dict[str, list[Callable[[], None]]] = {}

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name not in self.patches:
            return None
        spec = found_otherwise(self, name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = _Loader(spec.loader, self.patches[name])  # type: ignore[assignment]
        return spec


_finder = _Finder()


def found_otherwise(
    finder: object, name: str, path: Sequence[str] | None, target: ModuleType | None
) -> ModuleSpec | None:
    """Ask the finders after one: editable packages have their own."""
    for other in sys.meta_path[sys.meta_path.index(finder) + 1 :]:  # type: ignore[arg-type]
        find_spec = getattr(other, "find_spec", None)
        if find_spec is not None:
            spec: ModuleSpec | None = find_spec(name, path, target)
            if spec is not None:
                return spec
    return None


def when_loaded(stack: ExitStack, name: str, patch: Callable[[], None]) -> None:
    """Call ``patch`` now if a module is loaded, and whenever it is until ``stack`` ends.

    ``patch`` may enter ``stack`` what takes it back.
    """
    patches = _finder.patches
    patches.setdefault(name, []).append(patch)
    stack.callback(_forget, name, patch)
    if sys.meta_path[:1] != [_finder]:
        sys.meta_path[:] = [_finder, *(one for one in sys.meta_path if one is not _finder)]
    if name in sys.modules:
        patch()


def _forget(name: str, patch: Callable[[], None]) -> None:
    patches = _finder.patches
    patches[name].remove(patch)
    if not patches[name]:
        del patches[name]
    if not patches and _finder in sys.meta_path:
        sys.meta_path.remove(_finder)
