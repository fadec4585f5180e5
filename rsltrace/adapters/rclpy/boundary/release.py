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
_UNUSED = {"add_to_waitset"}  # executors get no wait set here


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
    # Sources also mention names that only a type checker sees; the extension has none of those.
    lacking = [
        (rf"\b_rclpy\.{name}\b", name)
        for name in dir(real)
        if name[0].isalpha() and not hasattr(stand_ins, name)
    ]
    for name, handle in handles.items():
        for method in vars(getattr(real, name, object)):
            if method[0].isalpha() and method not in _UNUSED and not hasattr(handle, method):
                lacking.append((rf"\.{method}\(", f"{name}.{method}"))
    if not lacking:
        return []
    sources = "\n".join(path.read_text("utf-8", "replace") for path in package.rglob("*.py"))
    return sorted(name for use, name in lacking if re.search(use, sources))
