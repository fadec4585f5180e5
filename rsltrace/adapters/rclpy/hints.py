"""Hints for errors that come from the environment of a node, such as packages that are missing.

``pip install <name>`` seldom works for interface packages: a few are on package indexes under other
names, the rest come from ROS 2.
"""

from __future__ import annotations

import linecache
import os
import re
import sys
from types import TracebackType
from typing import Any

from rsltrace.guard.virtual import set_order
from rsltrace.simulation.middleware.events.failure import as_printed, exception_text


def is_unmade(value: object) -> bool:
    """Return whether a value is a node whose ``Node.__init__`` has not run."""
    module = sys.modules.get("rclpy.node")
    return module is not None and isinstance(value, module.Node) and not hasattr(value, "handle")


def constructor_of(node: object) -> str:
    """Return the name of a node's class, and the place of its constructor."""
    kind: Any = type(node)
    code = getattr(kind.__init__, "__code__", None)
    place = f" ({code.co_filename}:{code.co_firstlineno})" if code is not None else ""
    return f"{kind.__qualname__}{place}"


_WHEELS = frozenset(
    """
    action_msgs actionlib_msgs builtin_interfaces diagnostic_msgs geometry_msgs lifecycle_msgs
    nav_msgs rcl_interfaces rosgraph_msgs sensor_msgs service_msgs shape_msgs std_msgs std_srvs
    stereo_msgs test_msgs trajectory_msgs type_description_interfaces unique_identifier_msgs
    visualization_msgs
    """.split()
)
"""Interface packages with wheels."""

_STANDS_STILL = (
    "\n  If that was a difference of two times: computing takes no simulated time, so a ROS clock "
    "shows the same throughout a callback, as it may under use_sim_time: allow for a difference "
    "of 0, measure from one callback to the next, or write clocks: {advances: true} in the job, "
    "which advances the clock by a nanosecond per reading"
)

_INITIALIZED = "Context.init() must only be called once"

_COMPILED = (
    "\n  The guard iterates sets in a fixed order; to turn that off, write "
    "'guard: {order: allow}' in the job"
)

_NAMED_LIKE_ONE = re.compile(r"_(msgs|interfaces|srvs|services|actions)$")


def where_to_get(package: str) -> str:
    """Return a sentence on how to make an interface package importable."""
    distro = os.environ.get("ROS_DISTRO") or "jazzy"
    debian = f"ros-{distro}-{package.replace('_', '-')}"
    if package in _WHEELS:
        return f"Source the ROS 2 workspace that holds it, or: pip install {debian}"
    return (
        "There is no wheel of it: put its sources (package.xml, .msg, .srv and .action "
        "files) into a folder of search_path, and its classes are made from them; or source the "
        f"ROS 2 workspace that holds it (for one of ROS's own: apt install {debian}, then source "
        f"/opt/ros/{distro}/setup.bash), and run rsltrace with the Python that it is built for"
    )


def cannot_import(module: str, error: ModuleNotFoundError) -> str:
    """Return why a module of user code cannot be imported, and what to do."""
    needed = error.name or "?"
    package = needed.partition(".")[0]
    place, line = _last_line(error.__traceback__)
    where = f" ({place})" if place else ""
    text = f"module {module!r} cannot be imported: it needs {needed!r}{where}. "
    if _is_interface(package, line):
        return f"{text}{package} holds ROS interfaces. {where_to_get(package)}"
    return (
        f"{text}If it is yours, add its folder to search_path; else install it for this Python "
        f"(pip install), or source the ROS 2 workspace that holds it"
    )


def import_raised(module: str, error: BaseException, said: str) -> str:
    """Return what a module of user code raised (``said``: its text) at import, and where."""
    if isinstance(error, SyntaxError) and error.filename:
        place, line = f"{error.filename}:{error.lineno}", error.text or ""
        said = error.msg
    else:
        place, line = _last_line(error.__traceback__)
    said = as_printed(type(error).__qualname__, said)
    hint = ""
    if isinstance(error, SystemExit):
        hint = (
            "; a module should only define things when it is imported: put the rest into a "
            "function (and name that with 'main:'), or run it as a program ('script:', 'module:')"
        )
    elif isinstance(error, RuntimeError) and said.endswith(_INITIALIZED):
        hint = (
            ": the nodes of a job share one process, where rclpy is initialized already; move "
            "rclpy.init() into a function that makes the node and spins, and name that with "
            "'main:', or run the file as a program ('script:')"
        )
    shown = f" ({place})\n    {line.strip()}" if place else ""
    return f"module {module!r} cannot be imported: it raised {said}{hint}{shown}"


def hint_for(error: BaseException) -> str:
    """Return a hint to append to the text of an exception of user code."""
    if isinstance(error, ZeroDivisionError):
        return _STANDS_STILL
    if _is_of_order(error):
        return _COMPILED
    if type(error).__name__ == "InvalidParameterTypeException":
        return _as_double(str(error))
    if isinstance(error, AttributeError) and is_unmade(error.obj):
        return f"; {constructor_of(error.obj)} must call super().__init__(name) first"
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return ""
    package = error.name.partition(".")[0]
    _, line = _last_line(error.__traceback__)
    return f"\n  {where_to_get(package)}" if _is_interface(package, line) else ""


def _is_of_order(error: BaseException) -> bool:
    """Return whether an error comes from the guard's functions that order sets."""
    if "__rsltrace_" in exception_text(error):
        return True
    traceback, last = error.__traceback__, None
    while traceback is not None:
        last, traceback = traceback.tb_frame.f_code.co_filename, traceback.tb_next
    return last == set_order.__file__


def parameter_in(error: BaseException | None) -> str | None:
    """Return the name of the parameter that an exception of rclpy is about, if any."""
    if not type(error).__name__.startswith("InvalidParameter"):
        return None
    found = re.search(r"\bparameter '([^']+)'", str(error))
    return found[1] if found is not None else None


def _as_double(said: str) -> str:
    """Return how to write an integer for a parameter of type double."""
    found = re.search(r"to '(-?[0-9]+)' of type 'INTEGER', expecting type 'DOUBLE'", said)
    if found is None:
        return ""
    return f"\n  write {found[1]}.0: ROS takes no integer for a parameter with a decimal point"


def _is_interface(package: str, line: str) -> bool:
    imported = re.search(rf"\b{re.escape(package)}\.(msg|srv|action)\b", line)
    return bool(imported or _NAMED_LIKE_ONE.search(package)) or package in _WHEELS


def _last_line(traceback: TracebackType | None) -> tuple[str, str]:
    """Return the place (``file:line``) and text of the import that failed."""
    found = ("", "")
    while traceback is not None:
        file, number = traceback.tb_frame.f_code.co_filename, traceback.tb_lineno
        if not file.startswith("<") and f"{os.sep}importlib{os.sep}" not in file:
            found = (f"{file}:{number}", linecache.getline(file, number))
        traceback = traceback.tb_next
    return found
