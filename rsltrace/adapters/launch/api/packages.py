"""Where packages lie, for launch files; those that are not there have a folder that is not, either.

A launch file asks for the shares of packages whose nodes cannot be simulated anyway (Gazebo, Nav2):
what it wants of them is left out, and the rest of it goes on.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any

from rsltrace.adapters.launch.api.basics import NOWHERE, WHY, LaunchContext, calling_line
from rsltrace.job.reading.substitute import package_prefix

_ASKED = ("get_package_share_directory", "get_package_share_path", "get_package_prefix")


def names_missing_package(value: object) -> str | None:
    """Return a package that is not there, if a text (or one in a list) names a path in it."""
    for item in value if isinstance(value, (list, tuple)) else (value,):
        if isinstance(item, str) and f"{NOWHERE}/share/" in item:
            return item.partition(f"{NOWHERE}/share/")[2].partition("/")[0]
    return None


def prefix_of(package: str) -> str:
    """Return the prefix of a package; ``get_package_prefix`` of this process is asked."""
    try:
        from ament_index_python.packages import get_package_prefix
    except ImportError:
        prefix = package_prefix(package)
        return NOWHERE if prefix is None else str(prefix)
    return str(get_package_prefix(package))


def share_of(package: str) -> str:
    return os.path.join(prefix_of(package), "share", package)


@contextmanager
def missing_packages_allowed(context: LaunchContext) -> Iterator[None]:
    """Give packages that are not there a folder, and note them as left out.

    A launch file that catches ``PackageNotFoundError`` itself gets it.
    """
    if find_spec("ament_index_python") is None:
        yield
        return
    from ament_index_python import packages

    noted: set[str] = set()
    real = packages.get_package_prefix

    def get_package_prefix(package_name: str) -> Any:
        try:
            return real(package_name)
        except packages.PackageNotFoundError:
            if _is_caught_by_caller():
                raise
            if package_name not in noted:
                noted.add(package_name)
                context.launched.ignored.append(
                    f"{context.where or calling_line()}: there is no package {package_name!r}: "
                    f"{WHY}; what wants something of it is left out"
                )
            return NOWHERE

    def get_package_share_directory(package_name: str, print_warning: bool = True) -> str:
        return os.path.join(get_package_prefix(package_name), "share", package_name)

    def get_package_share_path(package_name: str, print_warning: bool = True) -> Path:
        return Path(get_package_share_directory(package_name))

    ours = (get_package_share_directory, get_package_share_path, get_package_prefix)
    with ExitStack() as stack:
        for name, function in zip(_ASKED, ours, strict=True):
            for key, module in list(sys.modules.items()):
                if key.startswith("ament_index_python") and hasattr(module, name):
                    stack.callback(setattr, module, name, getattr(module, name))
                    setattr(module, name, function)
        yield


def _is_caught_by_caller() -> bool:
    """Whether the launch file that asks knows the error: it may do something else then."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if "PackageNotFoundError" in frame.f_globals and not frame.f_globals.get(
            "__name__", ""
        ).startswith(("ament_index_python", "rsltrace.")):
            return True
        frame = frame.f_back
    return False
