"""Where a module is, found without importing anything: neither it nor the packages that it is in.

``importlib``'s own search of a package without ``__init__.py`` asks ``sys.modules`` for what is
around it, which is not there.
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
    """Return the spec of a module that is looked for in the folders ``path``, None if there is
    none; ``otherwise`` is asked for what is not in them.

    The folder of a ROS package that has an ``__init__.py`` beside its ``package.xml`` is taken for
    a module only if there is no other of its name: installed, it is none.
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
