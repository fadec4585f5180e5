"""Interface definitions that come with rsltrace: many robots use them, and no wheel has them.

Each file has the fields, defaults and constants of one interface of ROS 2 Jazzy and nothing else. A
package that is installed, sourced or in the workspace comes first.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rsltrace.source_packages import SourcePackage

BUNDLED = {
    "ackermann_msgs": "2.0.2",
    "control_msgs": "5.8.0",
    "example_interfaces": "0.12.0",
    "geographic_msgs": "1.0.5",
    "moveit_msgs": "2.6.0",
    "nav2_msgs": "1.3.13",
    "object_recognition_msgs": "2.0.0",
    "octomap_msgs": "2.0.0",
    "tf2_msgs": "0.36.4",
    "vision_msgs": "4.1.1",
}
"""The packages, each with the version whose definitions these are."""

_FOLDER = Path(__file__).with_name("definitions")


def bundled_packages() -> dict[str, SourcePackage]:
    from rsltrace.source_packages import SourcePackage

    return {name: SourcePackage(name, _FOLDER / name) for name in BUNDLED}


def is_bundled(package: SourcePackage) -> bool:
    """Return whether a package is one of these, not one of the workspace with its name."""
    return package.folder.parent == _FOLDER
