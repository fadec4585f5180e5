"""Which installed packages are libraries, and which are the user's own.

The folder does not tell: colcon and pip install the user's packages into a ``site-packages``
folder, too. The installation does. A library comes as a wheel, with a list of its files
(``RECORD``). The user's packages come from a source folder (``direct_url.json``), from colcon (no
list), or as a wheel of a ROS package (``package.xml``) that is not ROS's own. Packages are
installed in such a folder, or in a folder of the import path with pip's records (``pip install
--target``).
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path

from rsltrace.guard.context import engage

# What an installed package does while it is imported is no part of the run. It may find a cache
# that the run before had to build, with a thread, a program or a wait. So an import has its own
# clocks and numbers, and waits in real time.

_LOOK_NS = 1_000


class LibraryImport:
    """One import of a package, with its own imports.

    ``passed_ns`` is the time that it has seen pass; ``at_end`` is called when it is over.
    """

    def __init__(self) -> None:
        self.passed_ns = 0
        self.at_end: list[Callable[[], None]] = []

    def look(self) -> int:
        """Let time pass as one read of a clock does; return the time passed so far."""
        self.passed_ns += _LOOK_NS
        return self.passed_ns


_present: ContextVar[LibraryImport | None] = ContextVar("library import", default=None)
"""Each call stack of user code (a greenlet) has its own."""

present_import = _present.get
"""Return the import of an installed package that the caller is part of, or None."""


@contextmanager
def importing(*, library: bool) -> Iterator[None]:
    """Import a module of a library, or one of user code, which a library may import."""
    outer = _present.get()
    if library and outer is not None:
        yield
        return
    inner = LibraryImport() if library else None
    before = _present.set(inner)
    try:
        yield
    finally:
        _present.reset(before)
        for call in inner.at_end if inner is not None else ():
            call()


_SITES = (f"{os.sep}site-packages{os.sep}", f"{os.sep}dist-packages{os.sep}")


def _targets() -> Iterator[str]:
    """Yield the folders of the import path that pip installed packages into."""
    for folder in sys.path:
        path = os.path.join(folder, "")
        with suppress(OSError):
            if (
                os.path.isabs(folder)
                and not path.endswith(_SITES)
                and any(name.endswith(".dist-info") for name in os.listdir(folder))
            ):
                yield path


TARGETS = tuple(_targets())
"""Such folders when the process started, mostly from ``PYTHONPATH``."""
INSTALLED = (*_SITES, *TARGETS)
"""A path that contains one of these belongs to an installed package."""
_OTHERS = (f"{os.sep}opt{os.sep}ros{os.sep}", "/usr/lib/python3/dist-packages/")
"""Folders of the system's package manager, which installs no packages of the user."""
_INTERFACES = frozenset(("msg", "srv", "action"))
_DISTRIBUTION = ".dist-info"
_PACKAGE_OF_ROS = re.compile(rb"share/ament_index/resource_index/packages/([^,/\n]+)")

_BUILT_FROM_SOURCES = frozenset(
    """
    ament_index_python cv_bridge image_geometry laser_geometry launch launch_pytest launch_ros
    launch_testing launch_testing_ros launch_xml launch_yaml message_filters osrf_pycommon
    python_qt_binding rclpy ros2bag ros2cli ros2component ros2interface ros2launch ros2lifecycle
    ros2node ros2param ros2pkg ros2run ros2service ros2topic rosbag2_py rosidl_adapter rosidl_cli
    rosidl_generator_c rosidl_generator_cpp rosidl_generator_py rosidl_parser rosidl_pycommon
    rosidl_runtime_py rpyutils rqt_gui rqt_gui_py rqt_py_common sensor_msgs_py sros2
    tf2_geometry_msgs tf2_kdl tf2_py tf2_ros tf2_sensor_msgs tf_transformations urdf_parser_py
    """.split()
)
"""ROS's own packages: if built from source, they lie in a workspace like the user's."""


def is_library(file: str) -> bool:
    """Return whether a source file is of an installed library or of generated interfaces."""
    for installed in INSTALLED:
        place = file.rfind(installed)
        if place >= 0:
            end = place + len(installed)
            parts = file[end:].split(os.sep, 2)
            return (
                file.startswith(_OTHERS)
                or (len(parts) == 3 and parts[1] in _INTERFACES)
                or _is_library(file[:end], parts[0].partition(".")[0])
            )
    return False


@lru_cache(maxsize=4096)
def _is_library(folder: str, name: str) -> bool:
    """Return whether the package of that name in a folder is a library."""
    if name in _BUILT_FROM_SOURCES:
        return True
    with engage(None):
        owners = _owners(folder, name)
        return bool(owners) and not any(
            _is_from_folder(path) or _is_of_workspace(path, record) for path, record in owners
        )


def _owners(folder: str, name: str) -> list[tuple[str, bytes]]:
    """Return the distributions that installed a name into a folder, with their lists of files.

    Distributions of the same or a similar name are tried first.
    """
    every = _distributions(folder)
    alike = name.lower().lstrip("_")
    named = [every[one] for one in (alike, f"ros_{alike}") if one in every]
    similar = [path for one, path in every.items() if alike in one]
    for some in (named, similar, every.values()):
        owners = list(_having(name, some))
        if owners:
            return owners
    return []


@lru_cache(maxsize=64)
def _distributions(folder: str) -> dict[str, str]:
    """Return the distributions in a folder by name, with pip's folder for each."""
    with suppress(OSError):
        names = [name for name in os.listdir(folder) if name.endswith(_DISTRIBUTION)]
        return {_name_of(name): os.path.join(folder, name) for name in names}
    return {}


def _having(name: str, distributions: Iterable[str]) -> Iterator[tuple[str, bytes]]:
    marks = tuple(b"\n" + os.fsencode(name) + after for after in (b"/", b"."))
    for path in distributions:
        record = b"\n" + _content(path, "RECORD")
        if any(mark in record for mark in marks):
            yield path, record


def _name_of(distribution: str) -> str:
    return distribution.partition("-")[0].lower().replace("-", "_").replace(".", "_")


def _content(path: str, name: str) -> bytes:
    with suppress(OSError):
        return Path(path, name).read_bytes()  # a node may have replaced open
    return b""


def _is_from_folder(path: str) -> bool:
    """Whether a distribution was installed from a source folder. (conda says so of all.)"""
    if _content(path, "INSTALLER").strip() == b"conda":
        return False
    with suppress(ValueError):
        return "dir_info" in json.loads(_content(path, "direct_url.json") or b"{}")
    return False


def _is_of_workspace(path: str, record: bytes) -> bool:
    """Whether a distribution is a ROS package; ROS's own are named ``ros-PACKAGE``."""
    own = _name_of(os.path.basename(path)).removeprefix("ros_")
    packages = {os.fsdecode(found) for found in _PACKAGE_OF_ROS.findall(record)}
    is_own = packages == {own} and _name_of(os.path.basename(path)) != own
    return bool(packages) and not is_own
