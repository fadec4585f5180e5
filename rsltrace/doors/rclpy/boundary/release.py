"""Whether this rclpy is one whose C-extension boundary rsltrace can stand behind.

Each release of ROS 2 adds a few names to the boundary. One that rclpy's Python code uses and that
has no stand-in here would fail in the middle of a run, so it is looked for before the first one.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from rsltrace.errors import SetupError

KNOWN = "Jazzy (rclpy 7.1) and Kilted (rclpy 9.1)"
_NAME = re.compile(r"\b_rclpy\.([A-Za-z]\w*)")
_UNUSED = {"add_to_waitset"}  # executors get no wait set here
_CALL = re.compile(r"\.([a-z]\w*)\(")


def check_release(real: Any, stand_ins: Any, handles: dict[str, type], package: Path) -> None:
    """Make sure that nothing rclpy uses is missing.

    ``real`` is the extension, ``stand_ins`` what takes its place, ``handles`` the classes of the
    objects it makes by their names in the extension, ``package`` the folder of rclpy's sources.

    :raises SetupError: naming what is missing.
    """
    missing = missing_parts(real, stand_ins, handles, package)
    if missing:
        raise SetupError(
            f"the rclpy in {package} is of a release of ROS 2 that this version of rsltrace cannot "
            f"simulate: it uses {', '.join(missing)} of its C extension, for which rsltrace has no "
            f"stand-in. It works with {KNOWN}: update rsltrace, source one of these, or install "
            "the wheels into an environment of their own: pip install 'rsltrace[ros]'"
        )


def missing_parts(real: Any, stand_ins: Any, handles: dict[str, type], package: Path) -> list[str]:
    """Return what rclpy's sources use of the extension and has no stand-in, sorted."""
    names: set[str] = set()
    calls: set[str] = set()
    for path in sorted(package.rglob("*.py")):
        text = path.read_text("utf-8", "replace")
        names.update(_NAME.findall(text))
        calls.update(_CALL.findall(text))
    # Sources also mention names that only a type checker sees; the extension has none of those.
    missing = [n for n in names if hasattr(real, n) and not hasattr(stand_ins, n)]
    for name, handle in handles.items():
        methods = calls.intersection(vars(getattr(real, name, object))) - _UNUSED
        missing += [f"{name}.{method}" for method in methods if not hasattr(handle, method)]
    return sorted(missing)
