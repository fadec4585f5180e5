"""Find a module without importing anything, not even its packages.

``importlib`` looks up the parents of a namespace package in ``sys.modules``.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path


def find_module(
    name: str,
    path: Sequence[str],
    otherwise: Callable[[str], ModuleSpec | None] = lambda name: None,
) -> ModuleSpec | None:
    """Return the spec of a module in the folders ``path`` or by ``otherwise``, None if there is
    none.

    The folder of a ROS package with an ``__init__.py`` beside its ``package.xml`` counts as a
    module only if there is no other of that name: installed, it is none.
    """
    spec: ModuleSpec | None = None
    places: Sequence[str] | None = path
    parts = name.split(".")
    for depth, part in enumerate(parts, 1):
        if places is None or not part.isidentifier():
            return None
        full = ".".join(parts[:depth])
        spec = _in_folders(full, places) or otherwise(full)
        if spec is None:
            return None
        places = spec.submodule_search_locations
    return spec


def _in_folders(name: str, places: Sequence[str]) -> ModuleSpec | None:
    portions: list[str] = []
    folder_of_package: ModuleSpec | None = None
    for place in places:
        finder = pkgutil.get_importer(place)
        found = None if finder is None else finder.find_spec(name, None)
        if found is None:
            continue
        if found.loader is None:
            portions += found.submodule_search_locations or ()
        elif not is_beside_package_xml(found.origin):
            return found
        else:
            folder_of_package = folder_of_package or found
    if folder_of_package is not None or not portions:
        return folder_of_package
    namespace = ModuleSpec(name, None, is_package=True)
    namespace.submodule_search_locations = list(dict.fromkeys(portions))
    return namespace


def is_beside_package_xml(file: str | None) -> bool:
    """Whether a file is an ``__init__.py`` in the folder of a ROS package."""
    if file is None or not file.endswith("__init__.py"):
        return False
    return Path(file).with_name("package.xml").is_file()
