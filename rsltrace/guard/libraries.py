"""Which installed packages are libraries, and which are the user's own, installed or not.

Where a package lies does not tell: a colcon workspace and pip put the user's packages into a
``site-packages`` folder, among all others. How it came there does: a library comes as a wheel, of
which pip keeps a list (``RECORD``). The user's come from a folder of sources (``direct_url.json``),
from colcon, which leaves no such list, or as a wheel of a package of ROS (``package.xml``) that is
not ROS's own. Installed is what lies in such a folder, or in one of the import path that holds what
pip writes of its packages (``pip install --target``).
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

from rsltrace.guard.engagement import engage

# What an installed package does while it is imported is no part of the run.
#
# It may find a cache that the run before had to build: with a thread for a warning, a program that
# is asked, a file that is waited for. So its clocks and numbers are its own, and it waits in real
# time.

_LOOK_NS = 1_000


class LibraryImport:
    """One import of a package, with all that it imports itself.

    ``passed_ns`` is how much time it has seen pass; ``at_end`` is called when it is over.
    """

    def __init__(self) -> None:
        self.passed_ns = 0
        self.at_end: list[Callable[[], None]] = []

    def look(self) -> int:
        """Let the time pass that looking at a clock takes; return all that has passed."""
        self.passed_ns += _LOOK_NS
        return self.passed_ns


_present: ContextVar[LibraryImport | None] = ContextVar("library import", default=None)
"""Each call stack of user code (a greenlet) has its own."""

present_import = _present.get
"""Return the import of an installed package that the caller is part of, or None."""


@contextmanager
def importing(*, library: bool) -> Iterator[None]:
    """Import a module of a library, or one of user code that may be imported by a library."""
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
    """Give the folders of the import path that pip installed packages into, by their records."""
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
"""Such folders as the process began with: ``PYTHONPATH``, mostly."""
INSTALLED = (*_SITES, *TARGETS)
"""A path that has one of these in it is of an installed package, be it a library's or not."""
_OTHERS = (f"{os.sep}opt{os.sep}ros{os.sep}", "/usr/lib/python3/dist-packages/")
"""Folders of the system's package manager, which installs no packages of the user's."""
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
"""Of ROS itself: who builds it from its sources has it in a workspace like packages of his own."""


def is_library(file: str) -> bool:
    """Return whether a source file is of an installed library (or of generated interfaces)."""
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
    """Return whether what lies by that name in a folder is a library."""
    if name in _BUILT_FROM_SOURCES:
        return True
    with engage(None):
        owners = _owners(folder, name)
        return bool(owners) and not any(
            _is_from_folder(path) or _is_of_workspace(path, record) for path, record in owners
        )


def _owners(folder: str, name: str) -> list[tuple[str, bytes]]:
    """Return the distributions that have installed what lies by a name in a folder, each with its
    list of files. Those of the same name are looked at first, then those of one like it."""
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
    """Return where a folder has what pip writes of its distributions, by their names."""
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
    with suppress(OSError), open(os.path.join(path, name), "rb") as file:
        return file.read()
    return b""


def _is_from_folder(path: str) -> bool:
    """Whether a distribution was installed from a folder of sources. (conda says so of all.)"""
    if _content(path, "INSTALLER").strip() == b"conda":
        return False
    with suppress(ValueError):
        return "dir_info" in json.loads(_content(path, "direct_url.json") or b"{}")
    return False


def _is_of_workspace(path: str, record: bytes) -> bool:
    """Whether a distribution is a package of ROS; ROS's own are named ``ros-PACKAGE``."""
    own = _name_of(os.path.basename(path)).removeprefix("ros_")
    packages = {os.fsdecode(found) for found in _PACKAGE_OF_ROS.findall(record)}
    is_own = packages == {own} and _name_of(os.path.basename(path)) != own
    return bool(packages) and not is_own
